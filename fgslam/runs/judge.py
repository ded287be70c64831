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
from fgslam.core.geometry import change_tangent_frame, inverse, pose
from fgslam.core.log import MeasurementLog
from fgslam.core.types import LAGS, NO_LANDMARKS, Estimate, Trajectory
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
    associate,
    best_aligned,
    value_at,
)
from fgslam.evaluation.truth import sound_truth
from fgslam.report.content import TextTable, read_metrics, write_json
from fgslam.report.results import ReportData, judged_report
from fgslam.runs.config import load_config
from fgslam.runs.export import log_of, results_folder
from fgslam.runs.folder import METRICS_FILE, REPORT_FILE, RUN_MARKER, is_run_folder
from fgslam.runs.slam_comparison import GROUND_TRUTH_FILE
from fgslam.runs.tables import JUDGED_COLUMNS, judged_tables
from fgslam.runs.tasks.slam_map_entry import arrival_of
from fgslam.slam.replay import replay

if TYPE_CHECKING:
    import pandas as pd
    from plotly import graph_objects as go

Given: TypeAlias = str | Path | tuple[Trajectory, FloatArray]
"""A file, ``BAG:/topic``, a run folder or an estimator's in it; or poses and covariances."""

GUESSED = " (guess)"
"""Mark of an estimate whose tangent space nothing states."""
_FINAL = "final.tum"
_JOINT = "motions are judged by the joint covariances of the run"
_ACCUMULATED = (
    "motions: no joint covariances are known; as in dead reckoning, what is added on the way is "
    "taken as independent of what was before"
)
_EXACT = 1e-6  # of the usual variance
_UNCERTAIN = "its first pose is uncertain, so the truth is aligned where the NEES is least"
_HALVES = (
    "no truth: two halves of the landmarks, each replayed alone, are held against each other and "
    "the sum of their covariances; what both share cancels, as errors of odometry and calibration, "
    "so that more than 1 shows overconfidence and less than 1 shows nothing"
)


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
        """A row for each estimate: `ate_m`, `nees_pose`, `sigma_factor`, ...; NaN: not known."""
        import pandas as pd  # half a second, and only tables need it

        rows = [[value_at(v, path) for _, path in JUDGED_COLUMNS] for v in self.values.values()]
        return pd.DataFrame(rows, list(self.values), [name for name, _ in JUDGED_COLUMNS])

    def text_tables(self) -> tuple[TextTable, ...]:
        """The same to be read; a name whose tangent space was guessed has a mark."""
        return judged_tables({name + GUESSED * v["guessed"]: v for name, v in self.values.items()})

    def plot(self) -> go.Figure:
        """Paths with their ellipses, errors next to three stated deviations, NEES over time."""
        from fgslam.report.figures import plot  # loads Plotly

        return plot(self.estimates, next(iter(self.truth.values())))


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
            `degrees` or `radians`, with commas; what is left out is found from the errors.

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
    words, true = frozenset(filter(None, map(str.strip, tangent.split(",")))), None
    for word in sorted(words - frozenset(TANGENT_WORDS)):
        raise ConfigError(f"--tangent: no word {word!r}; use {', '.join(TANGENT_WORDS)}")
    if truth is not None:
        true = StatedPoses(truth) if isinstance(truth, Trajectory) else read_stated(truth)
    notes: list[str] = list(true.notes) if true else []
    values, estimated, truths = {}, {}, {}
    for name, one in named.items():
        stated, run = _opened(one, None if covariance is None else Path(covariance))
        space, about = Tangent(), {"guessed": False, "tangent": str(Tangent())}
        if true is None:
            estimate, by = _halves(name, run)
            notes.append(_HALVES)
        else:
            by = _of_same_frame(name, stated, true)
            space, estimate, found = _in_world_of(name, stated, words, by)
            notes += [*stated.notes, *found]
            about = {"tangent": str(space), "guessed": any("(guess: " in note for note in found)}
            joint = _joint(run, truth)
            about |= {"nees_relative": joint} if joint else {}
            notes.append(_JOINT if joint else _ACCUMULATED)
        values[name] = _numbers(estimate, by, space.split) | about
        if values[name]["aligned"] == "best":
            notes.append(f"{name}: {_UNCERTAIN}")
        estimated[name], truths[name] = estimate, by
    return JudgedEstimates(values, tuple(dict.fromkeys(notes)), estimated, truths)


def write_judged(found: JudgedEstimates, folder: Path) -> Path:
    """Writes metrics.json and the page into a folder, and returns the page. Raises OutputError."""
    from fgslam.report.page import write_report  # loads Plotly

    make_subfolder(folder.parent, folder.name)
    write_json(folder / METRICS_FILE, {"notes": found.notes, "estimators": dict(found.values)})
    reports = tuple(
        replace(
            judged_report(name, name, one, None, found.truth[name]),
            verdict=value_at(found.values[name], "nees.pose.verdict"),
            nees_per_dof=value_at(found.values[name], "nees.pose.per_dof"),
        )
        for name, one in found.estimates.items()
    )
    data = ReportData(
        title="Are the covariances credible?",
        subtitle=", ".join(found.values),
        estimators=reports,
        truth=next(iter(found.truth.values())),
        notes=found.notes,
        tables=found.text_tables(),
    )
    write_report(folder / REPORT_FILE, data)
    return folder / REPORT_FILE


# --------------------------------------------------------------------------------------------
# What is given


def _named(given: Any) -> dict[str, Given]:
    if isinstance(given, Mapping):
        return dict(given)
    if isinstance(given, tuple) and len(given) == 2 and isinstance(given[0], Trajectory):
        return {"estimate": given}
    many = [given] if isinstance(given, str | Path) else list(given)
    paths = [as_path(one, DatasetError, "estimate") for one in many]
    short = [path.parent.name if path.name == _FINAL else path.stem for path in paths]
    names = short if len(set(short)) == len(short) else map(str, paths)
    return dict(zip(names, map(str, paths), strict=True))


def _opened(one: Given, covariance: Path | None) -> tuple[StatedPoses, tuple[Path, str] | None]:
    """What an estimate states, and of one of our runs its folder and the estimator's title."""
    if isinstance(one, tuple):
        shape = (len(one[0]), 6, 6)
        if np.shape(one[1]) != shape:
            raise ConfigError(f"covariances of shape {np.shape(one[1])}; give {shape}, one a pose")
        return StatedPoses(*one, frozenset(("rotation_first", "local", "radians"))), None
    path = Path(one)
    if is_run_folder(path):
        path = path / results_folder(path, None)
    path = path / _FINAL if (path / _FINAL).is_file() else path
    known = path.with_name("covariance.csv")
    if path.name == _FINAL and covariance is None and known.is_file():
        covariance = known
    run = path.parent.parent
    return read_stated(path, covariance), (run, path.parent.name) if is_run_folder(run) else None


def _of_same_frame(name: str, stated: StatedPoses, truth: StatedPoses) -> Trajectory:
    """The truth as poses of what the estimate is of. Raises DatasetError: other times or frames."""
    path, known = stated.trajectory, truth.trajectory
    rows, _ = associate(path.timestamps, known.timestamps)
    if len(rows) < 3:
        spans = [f"{t[0]:.3f} to {t[-1]:.3f} s" for t in (path.timestamps, known.timestamps)]
        raise DatasetError(
            f"{name}: from {spans[0]}, the truth from {spans[1]}: {len(rows)} poses have a true "
            f"one within {SAME_TIME_S:g} s; give both the times of one clock"
        )
    if truth.frame_stated and stated.frame_stated and known.frame != path.frame:
        raise DatasetError(
            f"{name}: {path.named}, and the truth {known.named}; give both of one frame: fgslam "
            "export RUN --trajectory FILE --frame left|right|body"
        )
    return replace(known, frame=path.frame)


def _in_world_of(
    name: str, stated: StatedPoses, words: frozenset[str], truth: Trajectory
) -> tuple[Tangent, Estimate, list[str]]:
    """Its tangent space; the estimate with the truth's world and axes, and what was noted."""
    path, covariances = stated.trajectory, stated.covariances
    if covariances is None:
        raise DatasetError(
            f"{name}: states no covariances; give them by --covariance FILE, a row a pose: 21 "
            "numbers (upper triangle of a 6x6) or 36, with the time before them"
        )
    axes, notes = turned_axes(path, truth), []
    turned = pose(axes, np.zeros(3))
    if not np.array_equal(axes, np.eye(3)):
        way = ", ".join("-" * int(one.min() < 0.0) + "xyz"[abs(one).argmax()] for one in axes.T)
        notes.append(f"{name}: x, y, z are {way} of the truth (guess)")
    known = words | stated.words
    seen = replace(truth, poses=truth.poses @ turned)
    space, why, fitting = guess_tangent(path, covariances, seen, known, stated.usual)
    if space.unit == "degrees" and "degrees" not in known:
        raise DatasetError(
            f"{name}: its rotations fit as degrees, not as radians; write radians, or state what "
            f"they are: --tangent {space} (or ...,radians)"
        )
    notes.append(f"{name}: covariances are {space} ({why or 'stated'})")
    if fitting is not None and not why:
        notes.append(f"{name}: {fitting} fits the errors far better; if so, --tangent {fitting}")
    rows, of = associate(path.timestamps, truth.timestamps)
    poses = truth.poses[of[0]] @ turned @ inverse(path.poses[rows[0]]) @ path.poses @ turned.T
    local = change_tangent_frame(turned, space.to_local(path.poses, covariances))
    relative = {lag: accumulated(poses, local, lag) for lag in LAGS if lag < len(poses)}
    return (
        space,
        Estimate(replace(path, poses=poses), local, NO_LANDMARKS, relative=relative),
        notes,
    )


def _joint(run: tuple[Path, str] | None, truth: Any) -> Any:
    """NEES of motions by joint covariances, as the run judged them by this truth; else None."""
    if run is None or isinstance(truth, Trajectory):
        return None
    if Path(truth).resolve() != log_of(run[0]).with_name(GROUND_TRUTH_FILE).resolve():
        return None
    return value_at(read_metrics(run[0] / METRICS_FILE), f"estimators.{run[1]}.nees_relative")


# --------------------------------------------------------------------------------------------
# Numbers


def _numbers(estimate: Estimate, truth: Trajectory, split: bool) -> dict[str, Any]:
    path = estimate.trajectory
    sound = sound_truth(path, truth).trajectory or truth
    rows, of = associate(path.timestamps, sound.timestamps)
    poses, covariances = path.poses[rows], estimate.covariances[rows]
    true = poses[0] @ inverse(sound.poses[of[0]]) @ sound.poses[of]
    sizes = np.trace(covariances, axis1=1, axis2=2)
    exact = int(not sizes[0] > _EXACT * np.nanmedian(sizes))  # then it is the gauge, and no error
    if not exact:
        true = best_aligned(poses, covariances, true)
    judged = credibility(poses[exact:], covariances[exact:], true[exact:], split)
    metrics = judge_answer(lone_answer(estimate), Truth(truth)).metrics.as_json()
    return metrics | asdict(judged) | {"aligned": "first_pose" if exact else "best"}


def _halves(name: str, run: tuple[Path, str] | None) -> tuple[Estimate, Trajectory]:
    """One half's poses with the covariances of their difference, and the other half's as truth."""
    if run is None:
        raise ConfigError(
            f"{name}: is no run of fgslam, which could be judged by itself; give --truth FILE"
        )
    config, file = load_config(run[0] / RUN_MARKER), log_of(run[0])
    settings = next((one for one in config.estimators if one.title == run[1]), config.estimator)
    log, arrival = MeasurementLog.load(file), arrival_of(file.parent)
    halves = []
    for half in (0, 1):
        found = replay(part_of(log, half), settings, config.frontend.ego_motion, arrival=arrival)
        if found.failure:
            raise DatasetError(f"{name}: half of its landmarks do not do: {found.failure}")
        halves.append(found.estimate)
    first, second = halves
    both = first.covariances + change_tangent_frame(
        inverse(first.trajectory.poses) @ second.trajectory.poses, second.covariances
    )
    relative = {lag: one + second.relative[lag] for lag, one in first.relative.items()}
    return Estimate(first.trajectory, both, NO_LANDMARKS, relative=relative), second.trajectory


def part_of(log: MeasurementLog, part: int, parts: int = 2) -> MeasurementLog:
    """The log with one landmark in so many alone; those that a loop merges stay together.

    What is measured of poses alone stays in all, as odometry does.
    """
    stays: dict[int, int] = {}

    def root(identity: int) -> int:
        while identity in stays:
            identity = stays[identity]
        return identity

    for ends, stay in (pair for one in log for loop in one.loops for pair in loop.merged.tolist()):
        if root(ends) != root(stay):
            stays[root(ends)] = root(stay)

    def kept(ids: IntArray) -> BoolArray:
        return np.array([root(i) % parts == part for i in ids.tolist()], np.bool_)

    def own(seen: Any) -> Any:
        return seen.select(kept(seen.ids))

    out = MeasurementLog(log.rig, log.motion_model)
    for one in log:
        loops = (
            replace(loop, observations=own(loop.observations),
                    merged=loop.merged[kept(loop.merged[:, 0])])
            for loop in one.loops
        )  # fmt: skip
        out.append(
            replace(
                one,
                observations=own(one.observations),
                rejected=one.rejected[kept(one.observations.ids)],
                missed_ids=one.missed_ids[kept(one.missed_ids)],
                pruned_ids=one.pruned_ids[kept(one.pruned_ids)],
                loops=tuple(loops),
                measured=tuple(m if m.of_pose else own(m) for m in one.measured),
            )
        )
    return out
