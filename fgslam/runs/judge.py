"""`fgslam judge`: are the covariances of a trajectory credible, whichever program made it?

Without truth an estimate of one of our runs is judged by itself: its log is replayed with each half
of the landmarks alone, and the difference of the two is held against the sum of their covariances.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.errors import ConfigError, DatasetError
from fgslam.core.files import as_path, make_subfolder
from fgslam.core.geometry import adjoint, change_tangent_frame, inverse, pose
from fgslam.core.log import MeasurementLog
from fgslam.core.types import LAGS, Estimate, Trajectory
from fgslam.datasets.stated import TANGENT_WORDS, StatedPoses, read_stated
from fgslam.evaluation.credibility import (
    Tangent,
    accumulated,
    credibility,
    guess_tangent,
    turned_axes,
)
from fgslam.evaluation.judging import Truth, judge_answer, lone_answer
from fgslam.evaluation.statistics import (
    SAME_TIME_S,
    JsonValue,
    associate,
    to_estimate_world,
    value_at,
)
from fgslam.evaluation.truth import sound_truth
from fgslam.report.content import Column, TextTable, read_metrics, write_json
from fgslam.report.results import (
    NO_LANDMARKS,
    ReportData,
    judged_report,
    truth_in_their_world,
)
from fgslam.runs.config import load_config
from fgslam.runs.folder import LOG_FILE, METRICS_FILE, REPORT_FILE, RUN_MARKER, is_run_folder
from fgslam.runs.results import number_text
from fgslam.runs.slam_comparison import GROUND_TRUTH_FILE
from fgslam.runs.tasks.slam_map_entry import arrival_of
from fgslam.slam.replay import replay

if TYPE_CHECKING:
    import pandas as pd
    from plotly import graph_objects as go

Given: TypeAlias = str | Path | tuple[Trajectory, FloatArray]
"""A file, ``BAG:/topic``, a run folder or an estimator's in it; or poses and covariances."""

_OWN = frozenset({"rotation_first", "local", "radians"})
_FINAL = "final.tum"
_JOINT = "motions are judged by the joint covariances of the run"
_ACCUMULATED = (
    "motions: no joint covariances are known; as in dead reckoning, what is added on the way is "
    "taken as independent of what was before"
)
_HALVES = (
    "no truth: two halves of the landmarks, each replayed alone, are held against each other and "
    "the sum of their covariances; what both share cancels, as errors of odometry and calibration, "
    "so that more than 1 shows overconfidence and less than 1 shows nothing"
)


COLUMNS = (
    ("poses", "NEES|pose", ("nees.pose.per_dof",), ".2f", "squared errors over stated variances, "
     "per degree of freedom: 1 is right, more is overconfident; the first pose is aligned"),
    ("poses", "95 % band of a|consistent one", ("nees.pose.lower", "nees.pose.upper"), ".2f",
     "for as many errors as are independent, by their autocorrelation"),
    ("poses", "verdict", ("nees.pose.verdict",), "", "by that band"),
    ("poses", "NEES rotation|position", ("nees.rotation.per_dof", "nees.position.per_dof"), ".2f",
     "the same of both alone"),
    ("poses", "mend:|sigma x", ("sigma_factor.pose",), ".2f", "root of the NEES: what stated "
     "deviations are to be multiplied by"),
    ("errors", "ATE m", ("ate_rmse_m",), ".3f", "root mean square position error, SE3 aligned"),
    ("errors", "NEES best|aligned", ("nees_best.per_dof",), ".2f", "of the poses, aligned where it "
     "is least"),
    ("errors", "NEES motions|1 5 20 frames", tuple(
        f"nees_relative.{lag}.per_dof" for lag in LAGS), ".2f",
     "of the motions over so many frames"),
    ("errors", "within 1 2 3|sigma, %", ("within_sigma.1", "within_sigma.2", "within_sigma.3"),
     "%", "shares of errors; right are 68, 95 and 99.7 %"),
)  # fmt: skip
"""Table, heading, places in metrics.json, format and meaning of what is shown."""


@dataclass(frozen=True, eq=False, repr=False)
class JudgedEstimates:
    """Estimates and how credible their covariances are.

    Attributes:
        values: numbers of each by name, as metrics.json has them.
        notes: what was guessed, assumed or left out, in words.
        estimates: in the truth's world, the first pose aligned; covariances in the tangent space
            at the poses, [rotation, translation].
        truth: true poses that each was judged by.
    """

    values: Mapping[str, Mapping[str, Any]]
    notes: tuple[str, ...]
    estimates: Mapping[str, Estimate]
    truth: Mapping[str, Trajectory]

    def __repr__(self) -> str:
        return f"<judged: {', '.join(self.values)}>"

    def table(self) -> pd.DataFrame:
        """A row for each estimate: ate_rmse_m, nees_pose_per_dof, ...; NaN where not known."""
        import pandas as pd  # half a second, and only tables need it

        paths = [path for _, _, group, *_ in COLUMNS for path in group]
        rows = [[value_at(v, path) for path in paths] for v in self.values.values()]
        names = [path.replace(".", "_") for path in paths]
        return pd.DataFrame(rows, index=list(self.values), columns=names)

    def text_tables(self) -> tuple[TextTable, ...]:
        """The same to be read; a name with a guessed tangent space has a mark."""
        found = []
        for key, heading in _HEADINGS.items():
            shown = [column for column in COLUMNS if column[0] == key]
            rows = tuple(
                (
                    name + GUESSED * bool(values["tangent_guessed"]),
                    tuple(_cell(values, paths, form) for _, _, paths, form, _ in shown),
                )
                for name, values in self.values.items()
            )
            columns = tuple(Column(head.replace("|", "\n"), text) for _, head, *_, text in shown)
            found.append(TextTable(key, heading, "estimate", columns, rows))
        return tuple(found)

    def report(self) -> ReportData:
        """The page: errors next to three stated deviations, along axes and over time, and NEES."""
        known = next(iter(self.truth.values()))
        found = tuple(
            replace(
                judged_report(name, name, one, None, self.truth[name]),
                verdict=value_at(self.values[name], "nees.pose.verdict"),
                nees_per_dof=value_at(self.values[name], "nees.pose.per_dof"),
            )
            for name, one in self.estimates.items()
        )
        return ReportData(
            title="Are the covariances credible?",
            subtitle=", ".join(self.values),
            estimators=found,
            truth=truth_in_their_world(found, known),
            notes=self.notes,
            tables=self.text_tables(),
        )

    def plot(self) -> go.Figure:
        """Paths with their ellipses, errors next to three stated deviations, NEES over time."""
        from fgslam.report.figures import plot  # loads Plotly

        return plot(self.estimates, next(iter(self.truth.values())))


GUESSED = " (guess)"
"""Mark of an estimate whose tangent space no file states."""
_HEADINGS = {"poses": "stated covariances against errors", "errors": "errors, motions, coverage"}


def _cell(values: Mapping[str, Any], paths: Sequence[str], form: str) -> str:
    found = [value_at(values, path) for path in paths]
    if form == "%":
        return " ".join(number_text(None if v is None else 100.0 * v, ".0f") for v in found)
    return " ".join(number_text(value, form) for value in found)


def judge(
    estimates: Given | Sequence[str | Path] | Mapping[str, Given],
    truth: str | Path | Trajectory | None = None,
    covariance: str | Path | None = None,
    tangent: str = "",
) -> JudgedEstimates:
    """How credible the covariances of trajectories are, whichever program made them.

    ::

        judged = fgslam.judge("vio.txt", truth="ground_truth.csv")
        judged.table(), judged.notes

    Args:
        estimates: one, several, or by the names that they shall have: files of poses (TUM, EuRoC,
            OpenVINS, cnspy), ``BAG:/topic``, run folders of ours, or poses with covariances
            (n, 6, 6) in the tangent space at them, [rotation, translation].
        truth: true poses, a file of the same kinds; None: an estimate of one of our runs is judged
            by two halves of its landmarks.
        covariance: covariances of the one estimate, in a file of their own.
        tangent: what the covariances are of, where no file states it: `rotation_first` or
            `translation_first`, one of `local`, `global`, `split_local`, `split_global`, and
            `degrees` or `radians`, with commas; what is left out is told from the errors.

    Raises:
        ConfigError: an argument is wrong.
        DatasetError: a file cannot be used, an estimate has no covariances, or its times are not
            those of the truth.
    """
    named = _named(estimates)
    if covariance is not None and len(named) != 1:
        raise ConfigError(
            f"--covariance is of one estimate, and {len(named)} are given; judge them one by one, "
            "or put each one's covariances into its rows"
        )
    words, true = _tangent_words(tangent), None
    if truth is not None:
        true = StatedPoses(truth) if isinstance(truth, Trajectory) else read_stated(truth)
    notes: list[str] = list(true.notes) if true else []
    values, estimated, truths = {}, {}, {}
    for name, one in named.items():
        stated, run = _opened(one, None if covariance is None else Path(covariance))
        about: dict[str, JsonValue] = {"tangent_guessed": False}
        if true is None:
            space, turned = Tangent(), np.eye(4)
            estimate, by = _halves(name, stated.trajectory, run)
            covariances = estimate.covariances
            notes.append(_HALVES)
        else:
            by = _of_same_frame(name, stated, true, run)
            covariances = _covariances(name, stated)
            _require_same_times(name, stated.trajectory, by)
            axes = turned_axes(stated.trajectory, by)
            turned = pose(axes, np.zeros(3))
            if not np.array_equal(axes, np.eye(3)):
                by = replace(by, poses=by.poses @ turned)
                notes.append(f"{name}: x, y, z are {_axes_words(axes)} of the truth (guess)")
            found = guess_tangent(
                stated.trajectory, covariances, by, stated.words | words, stated.usual
            )
            space = found.tangent
            notes += [f"{name}: covariances are {space} ({found.how})", *stated.notes]
            advice = f"--tangent {str(found.fitting or space).replace(', ', ',')}"
            if space.unit == "degrees" and "degrees" not in stated.words | words:
                raise DatasetError(
                    f"{name}: its rotations fit as degrees, not as radians; write radians, or "
                    f"state what they are: {advice} (or ...,radians)"
                )
            if found.fitting is not None and not found.guessed:
                notes.append(f"{name}: {found.fitting} fits the errors far better; if so, {advice}")
            about = {"tangent_guessed": found.guessed}
            local = space.to_local(stated.trajectory.poses, covariances)
            relative = accumulated(stated.trajectory.poses, local)
            estimate = Estimate(stated.trajectory, local, NO_LANDMARKS, relative=relative)
            own = (
                run is not None
                and truth is not None
                and not isinstance(truth, Trajectory)
                and (Path(truth).resolve() == (run[0] / GROUND_TRUTH_FILE).resolve())
            )
            joint = _joint(*run) if own and run else None
            about |= {"nees_relative": joint} if joint else {}
            notes.append(_JOINT if joint else _ACCUMULATED)
        values[name] = _numbers(name, space, estimate, covariances, by) | {
            "tangent": str(space),
            **about,
        }
        estimated[name], truths[name] = _as_drawn(estimate, by, turned)
    return JudgedEstimates(values, tuple(dict.fromkeys(notes)), estimated, truths)


def write_judged(found: JudgedEstimates, folder: Path) -> Path:
    """Writes metrics.json and the page into a folder, and returns the page. Raises OutputError."""
    from fgslam.report.page import write_report  # loads Plotly

    make_subfolder(folder.parent, folder.name)
    write_json(folder / METRICS_FILE, {"notes": found.notes, "estimators": dict(found.values)})
    write_report(folder / REPORT_FILE, found.report())
    return folder / REPORT_FILE


# --------------------------------------------------------------------------------------------
# What is given


def _named(given: Any) -> dict[str, Given]:
    if isinstance(given, Mapping):
        return dict(given)
    if isinstance(given, tuple) and len(given) == 2 and isinstance(given[0], Trajectory):
        return {"estimate": given}
    many = [given] if isinstance(given, str | Path) else list(given)
    paths = [str(as_path(one, DatasetError, "estimate")) for one in many]
    short = [
        Path(path).parent.name if path.endswith("/final.tum") else Path(path).stem for path in paths
    ]
    return dict(zip(short if len(set(short)) == len(short) else paths, paths, strict=True))


def _tangent_words(text: str) -> frozenset[str]:
    words = [word for part in text.split(",") if (word := part.strip())]
    known = [word for group in TANGENT_WORDS.values() for word in group]
    for word in words:
        if word not in known:
            raise ConfigError(f"--tangent: no word {word!r}; use {', '.join(known)}, with commas")
    return frozenset(words)


def _opened(one: Given, covariance: Path | None) -> tuple[StatedPoses, tuple[Path, str] | None]:
    """What an estimate states, and of one of our runs its folder and the estimator's title."""
    if isinstance(one, tuple):
        trajectory, matrices = one
        if np.shape(matrices) != (len(trajectory), 6, 6):
            raise ConfigError(
                f"covariances of shape {np.shape(matrices)} for {len(trajectory)} poses; give "
                f"({len(trajectory)}, 6, 6)"
            )
        return StatedPoses(trajectory, np.asarray(matrices, np.float64), _OWN), None
    path = Path(one)
    if is_run_folder(path):
        path = path / load_config(path / RUN_MARKER).estimator.title
    path = path / _FINAL if (path / _FINAL).is_file() else path
    beside = path.with_name("covariance.csv")
    if path.name == _FINAL and covariance is None and beside.is_file():
        covariance = beside
    folder = path.parent
    run = (folder.parent, folder.name) if is_run_folder(folder.parent) else None
    return read_stated(path, covariance), run


def _covariances(name: str, stated: StatedPoses) -> FloatArray:
    if stated.covariances is None:
        raise DatasetError(
            f"{name}: states no covariances; give them by --covariance FILE, a row a pose: 21 "
            "numbers (upper triangle of a 6x6) or 36, with the time before them"
        )
    return stated.covariances


def _of_same_frame(
    name: str, stated: StatedPoses, truth: StatedPoses, run: tuple[Path, str] | None
) -> Trajectory:
    """The truth as poses of what the estimate is of."""
    frame = stated.trajectory.frame
    if not (truth.frame_stated and stated.frame_stated) or truth.trajectory.frame == frame:
        return replace(truth.trajectory, frame=frame)
    if run is None:
        raise DatasetError(
            f"{name}: {stated.trajectory.named}, and the truth {truth.trajectory.named}; give both "
            "of one frame: fgslam export RUN --trajectory FILE --frame left|right|body"
        )
    return truth.trajectory.of(frame, MeasurementLog.load(run[0] / LOG_FILE).rig)


def _axes_words(axes: FloatArray) -> str:
    rows = np.abs(axes).argmax(axis=0)
    return ", ".join("-" * int(axes[row, k] < 0.0) + "xyz"[row] for k, row in enumerate(rows))


def _require_same_times(name: str, estimate: Trajectory, truth: Trajectory) -> None:
    """Raises DatasetError unless three poses have a truth."""
    rows, _ = associate(estimate.timestamps, truth.timestamps)
    if len(rows) < 3:
        spans = [f"{t[0]:.3f} to {t[-1]:.3f} s" if len(t) else "empty"
                 for t in (estimate.timestamps, truth.timestamps)]  # fmt: skip
        raise DatasetError(
            f"{name}: from {spans[0]}, the truth from {spans[1]}: {len(rows)} poses have a true "
            f"one within {SAME_TIME_S:g} s; give both the times of one clock"
        )


def _joint(run: Path, title: str) -> JsonValue:
    """NEES of motions by joint covariances, as the run judged them; None where it did not."""
    path = run / METRICS_FILE
    found = read_metrics(path) if path.is_file() else {}
    return value_at(found, f"estimators.{title}.nees_relative") or None


# --------------------------------------------------------------------------------------------
# Numbers


def _numbers(
    name: str, space: Tangent, estimate: Estimate, stated: FloatArray, truth: Trajectory
) -> dict[str, Any]:
    path = estimate.trajectory
    sound = sound_truth(path, truth).trajectory
    found = None if sound is None else to_estimate_world(path, sound)
    if found is None:
        raise DatasetError(f"{name}: no pose has a true one; give the truth of its times")
    rows, true = found[0][1:], found[1][1:]  # the first is aligned
    judged = credibility(space, path.poses[rows], stated[rows], true)
    metrics = judge_answer(lone_answer(estimate), Truth(truth)).metrics.as_json()
    return metrics | asdict(judged)


def _as_drawn(
    estimate: Estimate, truth: Trajectory, turned: FloatArray
) -> tuple[Estimate, Trajectory]:
    """Both as poses of what the truth is of, in its world, the first pose aligned: to be drawn."""
    path, back = estimate.trajectory, inverse(turned)
    rows, of = associate(path.timestamps, truth.timestamps)
    world = truth.poses[of[0]] @ inverse(path.poses[rows[0]])
    moved = replace(path, poses=world @ path.poses @ back)
    covariances = change_tangent_frame(turned, estimate.covariances)
    known = replace(truth, poses=truth.poses @ back)
    return replace(estimate, trajectory=moved, covariances=covariances), known


def _halves(
    name: str, path: Trajectory, run: tuple[Path, str] | None
) -> tuple[Estimate, Trajectory]:
    """One half's poses with the covariances of their difference, and the other half's as truth."""
    if run is None:
        raise ConfigError(
            f"{name}: is no run of fgslam, which could be judged by itself; give --truth FILE"
        )
    folder, title = run
    config = load_config(folder / RUN_MARKER)
    settings = next((one for one in config.estimators if one.title == title), None)
    if settings is None:
        raise DatasetError(f"{folder}: its configuration has no {title}; give --truth FILE")
    log = MeasurementLog.load(folder / LOG_FILE)
    arrival, halves = arrival_of(folder), []
    for half in (0, 1):
        found = replay(half_of(log, half), settings, config.frontend.ego_motion, arrival=arrival)
        if found.failure:
            raise DatasetError(f"{name}: half of its landmarks do not do: {found.failure}; give "
                               "--truth FILE")  # fmt: skip
        halves.append(found.estimate)
    first, second = halves
    carry = adjoint(inverse(first.trajectory.poses) @ second.trajectory.poses)
    both = first.covariances + carry @ second.covariances @ np.swapaxes(carry, 1, 2)
    relative = {lag: one + second.relative[lag] for lag, one in first.relative.items()
                if lag in second.relative}  # fmt: skip
    return Estimate(first.trajectory, both, NO_LANDMARKS, relative=relative), second.trajectory


def half_of(log: MeasurementLog, half: int) -> MeasurementLog:
    """The log with every second landmark alone; those that a loop merges stay together."""
    same = {int(a): int(b) for one in log for loop in one.loops for a, b in loop.merged}

    def kept(ids: IntArray) -> BoolArray:
        roots = ids.tolist()
        for _ in same:
            following = [same.get(root, root) for root in roots]
            if following == roots:
                break
            roots = following
        return np.array([root % 2 == half for root in roots], np.bool_)

    out = MeasurementLog(log.rig, log.motion_model)
    for one in log:
        loops = tuple(
            replace(loop, observations=loop.observations.select(kept(loop.observations.ids)),
                    merged=loop.merged[kept(loop.merged[:, 0])]) for loop in one.loops)  # fmt: skip
        mine = kept(one.observations.ids)
        out.append(replace(
            one, observations=one.observations.select(mine), rejected=one.rejected[mine],
            missed_ids=one.missed_ids[kept(one.missed_ids)],
            pruned_ids=one.pruned_ids[kept(one.pruned_ids)], loops=loops))  # fmt: skip
    return out
