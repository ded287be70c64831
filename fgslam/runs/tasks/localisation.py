"""Task `localisation` and `fgslam localize`: where in a map were a recording's frames taken?

Units: queries, one frame or a short submap each. Files: localisation.csv, timing.csv, metrics.json,
a picture, the page. Numbers: queries answered, right, inexact and false ones, errors, NEES, times.
"""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.backend.settings import LandmarkKalmanSettings
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import ConfigError, FgslamError, MapError, OutputError
from fgslam.core.files import make_subfolder
from fgslam.core.geometry import congruence, rotate_covariances, transform_to_camera, yaw_pitch_roll
from fgslam.core.log import ImageSequence
from fgslam.core.saved_map import SavedMap, require_rig
from fgslam.core.types import NO_LANDMARKS, Floor, LandmarkMap, Relocalisation, StereoFeatures
from fgslam.datasets.settings import OdometrySettings
from fgslam.evaluation.localisation import (
    Answers,
    Bounds,
    LocalisationErrors,
    enough,
    localisation_errors,
    score,
)
from fgslam.evaluation.statistics import JsonValue, spread
from fgslam.frontend.settings import FrontendSettings
from fgslam.report.content import UNKNOWN, Column, TextTable, write_csv
from fgslam.report.homing_figures import located_figure
from fgslam.runs.bare import dataset_of, require_no_camera
from fgslam.runs.config import (
    ExperimentConfig,
    LocalisationConfig,
    OutputSettings,
    as_task,
    load_config,
    load_experiment,
    make_experiment,
)
from fgslam.runs.engine import (
    Context,
    LocatedShare,
    Opening,
    RunResult,
    Task,
    provenance_of,
    run_task,
)
from fgslam.runs.folder import ExistingFolder, is_run_folder, write_config
from fgslam.runs.opening import open_sequence
from fgslam.runs.results import PICTURES, number_text, write_document, write_page
from fgslam.runs.session import drives_of
from fgslam.runs.tasks.slam import drive_first
from fgslam.runs.tasks.slam_map_entry import FIRST_FOLDER, MAP_FILE, GivenMap, open_map
from fgslam.runs.tasks.slam_results import true_sights, truth_in_map
from fgslam.runs.units import Progress, Stopped
from fgslam.slam.build import make_pipeline, make_relocaliser, make_stereo, make_stream, trusted
from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.motion import body_motion

_STREAM = 13  # of random numbers, next to those of the recording
_STAGE = "queries"
SAVE_EVERY_S = 2.0
_NEAREST_M = 0.1  # of the last camera's plane: nearer ones have no size in its image
_WRONG_M, _WRONG_DEG = 0.30, 5.0  # an accepted pose farther off than this is false
_LEAST_VISIBLE = 20
"""A pose from which fewer of the map's landmarks are visible is counted apart; where depth is not
known all count."""

# ------------------------------------------------------------------------------------------
# Queries and their answers


@dataclass(frozen=True, slots=True, eq=False)
class Attempt:
    """One query and its answer.

    Attributes:
        i: place of the query's last frame among the selected ones.
        frame: its number in the recording.
        frames: how many frames it had.
        features: that were looked up.
        found: the answer; of a frame that could not be read None.
        problem: why it could not; empty where it could.
        truth: (4, 4) true pose in the map's world; NaN where unknown.
        visible, familiar: landmarks truly in view of it, and of these, seen before from about
            there; -1 where unknown.
        milliseconds: for the answer, without features.
        frontend_ms: for the frame's features in all images, and for matching them.
    """

    i: int
    frame: int
    frames: int
    features: int
    found: Relocalisation | None
    problem: str
    truth: FloatArray
    visible: int
    familiar: int
    milliseconds: float
    frontend_ms: float

    @property
    def accepted(self) -> bool:
        """Whether there is a pose that counts."""
        return self.found is not None and self.found.found

    @property
    def verdict(self) -> str:
        """The relocalisation's status; ``no_image`` of a frame that could not be read."""
        return "no_image" if self.found is None else self.found.status.value


@dataclass(frozen=True, slots=True, eq=False)
class Asked:
    """All queries of a run.

    Attributes:
        attempts: by frames of a query, then in order.
        landmarks: that could be recognised.
        alignment: how truth and map were brought together, in words.
        whole: whether all that was wanted has been done.
    """

    attempts: tuple[Attempt, ...]
    landmarks: LandmarkMap
    alignment: str
    whole: bool

    def of(self, frames: int) -> tuple[Attempt, ...]:
        """The queries of so many frames."""
        return tuple(one for one in self.attempts if one.frames == frames)


_ANSWERS = tuple[Attempt, ...]


def ask_all(
    config: LocalisationConfig, given: GivenMap, sequence: ImageSequence, context: Context
) -> Asked:
    """All queries of a configuration; those of an earlier session are not asked again.

    Raises:
        MapError: other cameras made the map, or it holds no landmark.
        ConfigError: the recording is shorter than a query.
    """
    wanted, frontend = config.localisation, config.frontend
    longest = max(wanted.frames)
    if len(sequence) < longest:
        raise ConfigError(
            f"{sequence.name}: {len(sequence)} frames are selected, and a query takes "
            f"{longest}; lower the frames of a query, or select more"
        )
    require_rig(given.saved, sequence.rig, str(given.path))
    landmarks, appearances = trusted(given.saved, frontend.database.valid_hits)
    if not len(landmarks):
        raise MapError(f"{given.path}: holds no trusted landmark; make the map again")
    stereo = make_stereo(sequence.rig, frontend)
    relocaliser = make_relocaliser(sequence.rig, frontend)
    relocaliser.learn(landmarks, appearances)
    floor = Floor.under(sequence.rig, frontend.ego_motion.dof)
    truth, alignment = truth_in_map(given.saved, sequence, config.as_experiment())
    in_view = true_sights(given.saved, landmarks, sequence, frontend)

    def ask(found: list[FeatureFrame], sighted: tuple[int, int]) -> Attempt:
        """One query: consecutive frames, the last of which is to be located."""
        last, count, asked, answer = found[-1], len(found), 0, None
        frame = config.dataset.start + last.i * config.dataset.stride
        milliseconds, frontend_ms = float("nan"), last.sift_ms
        if last.frame is not None:
            rng = np.random.default_rng([config.seed, _STREAM, frame, count])
            start = time.perf_counter()
            if count == 1:
                features, spread = stereo.match(last.frame, last.features).whole, None
            else:
                features, spread = submap_features(sequence, found, frontend, config.odometry)
            matched = time.perf_counter()
            asked, answer = len(features), relocaliser.locate(features, rng)
            milliseconds = 1e3 * (time.perf_counter() - matched)
            frontend_ms += 1e3 * (matched - start)
            if spread is not None and np.isfinite(answer.covariance).all():
                own = floor.allowed_part(answer.wTc, spread)
                answer = dataclasses.replace(answer, covariance=answer.covariance + own)
        about = (last.i, frame, count, asked, answer, last.problem, truth[last.i], *sighted)
        return Attempt(*about, milliseconds, frontend_ms)

    # Answers by number of the query, kept in the run folder now and then.
    queries = len(range(longest - 1, len(sequence), wanted.every))
    kept: dict[int, _ANSWERS] = context.store.load(_STAGE, _ANSWERS)
    # Killed while it tidied up, a run has lost the first answers, but not the last ones.
    first = next(k for k in range(queries + 1) if k not in kept)
    done, fresh = {k: kept[k] for k in range(first)}, dict[int, _ANSWERS]()
    context.progress("localising", len(done), queries)
    saved = time.perf_counter()
    for k, found in _queries(config, sequence, first):
        sighted = in_view(found[-1].i, truth[found[-1].i])
        fresh[k] = tuple(ask(found[len(found) - n :], sighted) for n in wanted.frames)
        context.progress("localising", len(done) + len(fresh), queries)
        stopped = context.stopped()
        if stopped or k == queries - 1 or time.perf_counter() - saved >= SAVE_EVERY_S:
            done |= context.store.add(_STAGE, fresh, _ANSWERS)
            fresh, saved = {}, time.perf_counter()
        if stopped:
            break
    attempts = [attempt for answers in done.values() for attempt in answers]
    attempts.sort(key=lambda one: (wanted.frames.index(one.frames), one.i))
    return Asked(tuple(attempts), landmarks, alignment, whole=len(done) == queries)


def _queries(
    config: LocalisationConfig, sequence: ImageSequence, first: int
) -> Iterator[tuple[int, list[FeatureFrame]]]:
    """Number and frames of each query from the ``first`` on, the longest submap's.

    Each frame's features are found once.
    """
    longest, every = max(config.localisation.frames), config.localisation.every
    held: deque[FeatureFrame] = deque(maxlen=longest)
    start = first * every
    if start + longest > len(sequence):
        return
    stream = make_stream(sequence, config.frontend)(start=start)
    try:
        for found in stream:
            held.append(found)
            k, rest = divmod(found.i - longest + 1, every)
            if found.i >= start + longest - 1 and not rest:
                yield k, list(held)
    finally:
        stream.close()


def submap_features(
    sequence: ImageSequence,
    found: Sequence[FeatureFrame],
    frontend: FrontendSettings,
    odometry: OdometrySettings,
) -> tuple[StereoFeatures, FloatArray]:
    """Landmarks of a few consecutive frames that the ordinary loop has tracked.

    Args:
        sequence: the recording.
        found: the frames' features, in order, at least one.
        frontend: the configuration's; neither loops are closed nor lost cameras found, and every
            frame's features are used: a sub-map is to show as much as it can.
        odometry: the configuration's; what was before the first of the frames is not used.

    Returns:
        The submap's landmarks in the last camera's frame, with fused covariances and their last
        appearances; those outside its image, too. And the covariance (6, 6) of that camera in the
        submap, which is added to the map's where the submap is located.
    """
    rig = sequence.rig
    plain = dataclasses.replace(frontend, tracking="sift", loops=False, lost=False)
    pipeline = make_pipeline(rig, plain, odometry, LandmarkKalmanSettings())
    for k, one in enumerate(found):
        timestamp = float(sequence.timestamps[one.i])
        body = body_motion(sequence, one.i, pipeline.motion) if k else None
        stats = pipeline.process(dataclasses.replace(one, i=k), k, timestamp, body).stats
    # The landmarks as the last camera would measure them, were its image large enough.
    landmarks = pipeline.estimator.landmarks()
    views = pipeline.tracker.database.appearances(landmarks.ids)
    views = views.select(np.flatnonzero(np.diff(views.ids, append=-1)))  # the last of each
    points = transform_to_camera(stats.wTc, landmarks.positions)
    covariances = rotate_covariances(stats.wTc[:3, :3].T, landmarks.covariances)
    keep = np.abs(points[:, 2]) > _NEAREST_M
    points, covariances = points[keep], covariances[keep]
    views = views.of(landmarks.ids[keep])
    # As measured in the image; NaN of those behind the camera.
    before = points[:, 2] > 0.0
    measurement, noise = np.full((len(points), 3), np.nan), np.full((len(points), 3, 3), np.nan)
    measurement[before] = rig.predict(points[before])
    noise[before] = congruence(rig.jacobian(points[before]), covariances[before])
    pixels = np.full((len(points), 3, 2), np.nan)
    pixels[:, 0] = measurement[:, :2]
    features = StereoFeatures(
        measurement=measurement,
        measurement_covariance=noise,
        scale=views.size / np.abs(points[:, 2]),
        orientation=views.orientation,
        descriptors=views.descriptors,
        position=points,
        position_covariance=covariances,
        pixels=pixels,
    )
    return features, stats.covariance


# ------------------------------------------------------------------------------------------
# The task


@dataclass(frozen=True, slots=True, eq=False)
class LocalisationResult(RunResult):
    """How a localisation run ended; ``asked`` are all queries with their answers."""

    config: LocalisationConfig
    asked: Asked = field(kw_only=True)


def open_localisation(config: LocalisationConfig, opening: Opening) -> Task[LocalisationResult]:
    """Opens the recording, and the map where it is there already. Raises FgslamError."""
    given = None if config.map.load is None else open_map(Path(config.map.load))
    return _task(config, given, open_sequence(config.as_experiment(), opening.progress))


def _task(
    config: LocalisationConfig, given: GivenMap | None, sequence: ImageSequence
) -> Task[LocalisationResult]:
    if given is not None:
        require_rig(given.saved, sequence.rig, str(given.path))
    return Task(_provenance(given, sequence), partial(_run, config, given, sequence))


def _run(
    config: LocalisationConfig, given: GivenMap | None, sequence: ImageSequence, context: Context
) -> LocalisationResult:
    """The drive that makes the map, where the run asks for one, and all queries."""
    folder = context.folder
    if given is None:
        ended = drive_first(config.as_experiment(), context)
        if ended is not None and ended.status == "interrupted":
            nothing = Asked((), NO_LANDMARKS, "the map was not finished", whole=False)
            return result_of(config, folder, nothing, sequence.notes)
        given = open_map(folder / FIRST_FOLDER / MAP_FILE)
        write_config(folder, config, _provenance(given, sequence))
    asked = ask_all(config, given, sequence, context)
    subtitle = f"{sequence.name}, in a map of {len(asked.landmarks)} landmarks"
    # Features found otherwise than when the map was made are recognised less often.
    made_with = settings_of_map(given.saved).get("frontend") or {}
    other = settings_that_differ(made_with, config.as_values()["frontend"])
    keys = " and ".join(f"frontend.{name}" for name in other)
    why = f"{keys} differs from that of the map's drive: fewer features will be recognised"
    notes = (*([why] if other else []), *sequence.notes)
    return result_of(config, folder, asked, notes, given, subtitle)


def _provenance(given: GivenMap | None, sequence: ImageSequence) -> dict[str, Any]:
    out = provenance_of(sequence)
    if given is not None:
        out["map"] = {"path": str(given.path), "sha256": given.identity}
    return out


# ------------------------------------------------------------------------------------------
# The answers judged


@dataclass(frozen=True, slots=True, eq=False)
class Scored:
    """The queries of one length.

    Attributes:
        frames: of a query.
        attempts: all of them.
        answers: the same as arrays.
        errors: of the accepted ones.
        numbers: as metrics.json has them: the score of those from which enough landmarks are
            visible; that of those from which enough are visible from about where they were seen
            before, ``familiar_view``, and ``too_few_in_view``; verdicts and times.
    """

    frames: int
    attempts: tuple[Attempt, ...]
    answers: Answers
    errors: LocalisationErrors
    numbers: dict[str, Any]


def bounds_of(config: LocalisationConfig) -> Bounds:
    """What the configuration calls right and false."""
    wanted = config.localisation
    within, wrong = np.deg2rad([wanted.within_deg, _WRONG_DEG]).tolist()
    return Bounds(wanted.within_m, within, _WRONG_M, wrong, _LEAST_VISIBLE)


def scored(config: LocalisationConfig, asked: Asked) -> tuple[Scored, ...]:
    """The answers judged, by frames of a query."""
    bounds = bounds_of(config)
    out = []
    for frames in config.localisation.frames:
        attempts = asked.of(frames)
        answers = answers_of(attempts)
        visible, familiar = (enough(n, bounds) for n in (answers.visible, answers.familiar))
        times = np.array([(a.milliseconds, a.frontend_ms) for a in attempts]).reshape(-1, 2)
        numbers = {
            **score(answers.select(visible), bounds),
            "familiar_view": score(answers.select(familiar), bounds),
            "too_few_in_view": score(answers.select(~visible), bounds),
            "verdicts": dict(sorted(Counter(one.verdict for one in attempts).items())),
            "locate_ms": spread(times[:, 0]),
            "frontend_ms": spread(times[:, 1]),
        }
        out.append(Scored(frames, attempts, answers, localisation_errors(answers), numbers))
    return tuple(out)


def answers_of(attempts: Sequence[Attempt]) -> Answers:
    """The same as arrays; NaN where there is no covariance or no truth."""
    found = [one.found for one in attempts]
    poses = [np.eye(4) if f is None else f.wTc for f in found]
    covariances = [np.full((6, 6), np.nan) if f is None else f.covariance for f in found]
    return Answers(
        accepted=np.array([one.accepted for one in attempts], np.bool_),
        poses=np.array(poses, np.float64).reshape(-1, 4, 4),
        covariances=np.array(covariances, np.float64).reshape(-1, 6, 6),
        truth=np.array([one.truth for one in attempts], np.float64).reshape(-1, 4, 4),
        visible=np.array([one.visible for one in attempts], np.int64),
        familiar=np.array([one.familiar for one in attempts], np.int64),
    )


def result_of(
    config: LocalisationConfig,
    folder: Path,
    asked: Asked,
    notes: Sequence[str],
    given: GivenMap | None = None,
    subtitle: str = "",
) -> LocalisationResult:
    """Sentences and tables of a run; with its map all files. Raises OutputError."""
    judged = scored(config, asked)
    verdicts = [one.numbers["verdicts"] for one in judged]
    rows = tuple(
        (name, tuple(str(count.get(name, 0)) for count in verdicts))
        for name in sorted(set().union(*verdicts))
    )
    columns = tuple(Column(in_frames(j.frames), "queries that ended so") for j in judged)
    result = LocalisationResult(
        config=config,
        folder=folder,
        status="finished" if asked.whole else "interrupted",
        lines=tuple(_sentence(config, one) for one in judged),
        tables=(
            _score_table(config, judged),
            TextTable("verdicts", "Verdicts", "verdict", columns, rows),
        ),
        notes=(*notes, asked.alignment),
        particulars=(("queries", str(folder / "localisation.csv")),),
        asked=asked,
    )
    if given is not None:
        write_results(result, judged, given, subtitle)
    return result


def in_frames(count: int) -> str:
    """``1 frame``, ``3 frames``."""
    return "1 frame" if count == 1 else f"{count} frames"


def _within(config: LocalisationConfig) -> str:
    wanted = config.localisation
    return f"within {100 * wanted.within_m:g} cm and {wanted.within_deg:g} degrees"


def _sentence(config: LocalisationConfig, judged: Scored) -> str:
    counts, few = judged.numbers, judged.numbers["too_few_in_view"]
    start = (
        f"from {in_frames(judged.frames)}: {counts['accepted']} of {counts['asked']} queries found"
    )
    if not counts["with_truth"]:
        return f"{start}; their errors are not known"
    apart = (
        f"; counted apart: {few['asked']} poses from which fewer than {_LEAST_VISIBLE} landmarks "
        f"are visible, {few['accepted']} of them found, {few['false']} false"
    ) * bool(few["asked"])
    return (
        f"{start}, {counts['right']} ({number_text(counts['share_right'], '.1%')}) "
        f"{_within(config)}, {counts['inexact']} less exact, {counts['false']} false{apart}"
    )


def _score_table(config: LocalisationConfig, judged: Sequence[Scored]) -> TextTable:
    columns = (
        Column("queries", "asked; those with too few landmarks in view are counted apart"),
        Column("right", f"accepted, {_within(config)}"),
        Column("less exact", "accepted, neither right nor false"),
        Column("false", f"accepted, off by more than {_WRONG_M:g} m or {_WRONG_DEG:g} deg"),
        Column("refused", "no pose is certain"),
        Column("cm: 50, 95, 100 %", "errors of accepted positions: median, 95 %, largest"),
        Column("deg: 50, 95, 100 %", "the same of rotations"),
        Column("NEES", "mean normalised error squared per degree of freedom; 1 is consistent"),
        Column("in 95 %", "share of the true poses in the 95 % region of the covariance"),
        Column("ms: 50, 95 %", "time of an answer, without the features"),
    )
    rows = []
    for one in judged:
        name, counts, ms = in_frames(one.frames), one.numbers, one.numbers["locate_ms"]
        familiar, few = counts["familiar_view"], counts["too_few_in_view"]
        times = f"{number_text(ms['median'], '.0f')}, {number_text(ms['p95'], '.0f')}"
        shown = {name: (counts, times)}
        if few["asked"] or familiar["asked"] != counts["asked"]:
            shown[f"{name}, {_LEAST_VISIBLE} in view from familiar sides"] = familiar, UNKNOWN
            shown[f"{name}, fewer than {_LEAST_VISIBLE} in view"] = few, UNKNOWN
        rows += [(text, (*_score_cells(part), last)) for text, (part, last) in shown.items()]
    return TextTable("score", "Localisation", "query", columns, tuple(rows))


def _score_cells(counts: Mapping[str, Any]) -> tuple[str, ...]:
    judged = [str(counts[name]) for name in ("right", "inexact", "false")]
    centimetres, degrees = (
        ", ".join(
            number_text(factor * value, spec) for value in values.values() if value is not None
        )
        for values, factor, spec in (
            (counts["error_m"], 100.0, ".1f"),
            (counts["error_deg"], 1.0, ".2f"),
        )
    )
    return (
        str(counts["asked"]),
        *(judged if counts["with_truth"] else [UNKNOWN] * 3),
        str(counts["asked"] - counts["accepted"]),
        centimetres or UNKNOWN,
        degrees or UNKNOWN,
        number_text(counts["nees_per_dof"]),
        number_text(counts["share_in_95_percent"], ".1%"),
    )


def sigmas_of(found: Relocalisation) -> tuple[float, float]:
    """Standard deviation of position and of rotation, metres and degrees."""
    variances = np.diagonal(found.covariance)
    turned, moved = np.sqrt(variances[:3].sum()), np.sqrt(variances[3:].sum())
    return float(moved), float(np.rad2deg(turned))


# --------------------------------------------------------------------------------------------
# Files

_COLUMNS = (
    "frame", "frames", "verdict", "x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg",
    "sigma_position_m", "sigma_rotation_deg", "features", "candidates", "inliers", "expected",
    "second", "residual_px", "visible", "familiar", "error_m", "error_deg", "nees", "nees_dof",
    "why",
)  # fmt: skip


def write_results(
    result: LocalisationResult, judged: Sequence[Scored], given: GivenMap, subtitle: str
) -> None:
    """All files of a run into its folder, which holds its config.yaml. Raises OutputError."""
    folder, asked = result.folder, result.asked
    rows = (row for one in judged for row in _rows(one))
    write_csv(folder / "localisation.csv", _COLUMNS, rows)
    timing = ((a.frame, a.frames, a.milliseconds, a.frontend_ms) for a in asked.attempts)
    write_csv(folder / "timing.csv", ("frame", "frames", "locate_ms", "frontend_ms"), timing)
    numbers: dict[str, JsonValue] = {
        "landmarks": len(asked.landmarks),
        "alignment": asked.alignment,
        "notes": list(result.notes),
        "queries": {str(one.frames): one.numbers for one in judged},
    }
    write_document(result, numbers)
    bounds = bounds_of(result.config)
    landmarks, drive = given.saved.landmarks.positions, given.saved.trajectory.poses
    figures = []
    for one in judged:
        errors = one.errors
        false = (errors.metres > bounds.wrong_m) | (errors.radians > bounds.wrong_rad)
        words = f"localisation-{one.frames}", f"Found from {in_frames(one.frames)}"
        figures.append(located_figure(words, landmarks, drive, one.answers, np.asarray(false)))
    if result.config.output.pictures:
        from fgslam.report.pictures import draw_figure  # Matplotlib takes a second

        for one, figure in zip(judged, figures, strict=True):
            path = make_subfolder(folder, PICTURES) / f"localisation_{one.frames}.png"
            draw_figure(path, figure, figure.heading)
    write_page(result, subtitle, figures)


def _rows(judged: Scored) -> Iterator[tuple[Any, ...]]:
    errors = judged.errors
    for k, attempt in enumerate(judged.attempts):
        found = attempt.found
        query = attempt.frame, attempt.frames, attempt.verdict
        if found is None:
            yield *query, *[None] * (len(_COLUMNS) - 4), attempt.problem
            continue
        pose: Sequence[float | None] = [None] * 8
        if np.isfinite(found.covariance).all():
            angles = np.rad2deg(yaw_pitch_roll(found.wTc))
            pose = [*found.wTc[:3, 3], *angles, *sigmas_of(found)]
        yield (
            *query,
            *pose,
            attempt.features,
            found.candidates,
            len(found.ids),
            found.expected,
            found.second,
            found.residual_px,
            *(n if n >= 0 else None for n in (attempt.visible, attempt.familiar)),
            errors.metres[k],
            np.rad2deg(errors.radians[k]),
            errors.nees[k],
            errors.dof[k],
            found.why,
        )


# ------------------------------------------------------------------------------------------
# fgslam localize


@dataclass(frozen=True, slots=True)
class Wanted:
    """What is asked.

    Attributes:
        map_file: the saved map.
        recording: a recording's folder, or an experiment's .yaml for its data set.
        overrides: ``a.b=value`` of the experiment.
        frame: number of the one frame to locate; None: all of them, one by one.
        frames: of a query: 1, or a short submap of so many.
        out: folder of the results; None: none are written.
        existing: what to do where it holds a run already.
        camera: calibration of a recording, in place of its own.
    """

    map_file: Path
    recording: Path
    overrides: tuple[str, ...] = ()
    frame: int | None = None
    frames: int = 1
    out: Path | None = None
    existing: ExistingFolder = "refuse"
    camera: Path | None = None


def localize(wanted: Wanted, progress: Progress, stopped: Stopped) -> LocalisationResult:
    """Locates frames of a recording in a map without any prior.

    Raises:
        FgslamError: map, recording, frame or configuration cannot be used.
    """
    out = wanted.out
    if out is not None and wanted.existing == "refuse" and is_run_folder(out):
        raise OutputError(f"{out} holds a run already; choose another --out, or add --overwrite")
    given = open_map(wanted.map_file)
    config = _config_of(wanted, settings_of_map(given.saved))
    opener = partial(_open_wanted, wanted, given)
    with tempfile.TemporaryDirectory(prefix="fgslam-localize-") as scratch:
        if out is None:
            out, quiet = Path(scratch) / "run", OutputSettings(pictures=False, report=False)
            config = config.model_copy(update={"output": quiet})
        result = run_task(opener, config, out, wanted.existing, progress, stopped)
    if wanted.out is None:
        result = dataclasses.replace(result, particulars=())
    attempts = result.asked.attempts
    share = LocatedShare(sum(one.accepted for one in attempts), len(attempts))
    if len(attempts) == 1:
        lines = tuple(f"{name:<18}{value}" for name, value in _details(attempts[0]))
        return dataclasses.replace(result, lines=lines, tables=(), located=share)
    lines = (*map(_answer_line, attempts), *result.lines)
    return dataclasses.replace(result, lines=lines, located=share)


def _config_of(wanted: Wanted, made_with: Mapping[str, Any]) -> LocalisationConfig:
    """The experiment's settings for queries in this map; of a folder those that made the map."""
    where, overrides = str(wanted.recording), wanted.overrides
    if wanted.recording.suffix.lower() in (".yaml", ".yml"):
        require_no_camera(wanted.recording, wanted.camera)
        given = load_experiment(wanted.recording, overrides)
        if not isinstance(given, ExperimentConfig | LocalisationConfig):
            load_config(wanted.recording)  # states which task this cannot do
            raise ConfigError(f"{where}: holds no recording of stereo images; give another")
        values, overrides = given.as_values(), ()
    else:
        values = {
            "name": "localize",
            "dataset": dataset_of(wanted.recording, wanted.camera, overrides),
            "odometry": {"kind": "recorded"},
            "frontend": made_with.get("frontend", {}),
        }
    known = LocalisationConfig.model_fields
    kept = {name: value for name, value in values.items() if name in known}
    queries = {**kept.get("localisation", {}), "frames": [wanted.frames], "every": 1}
    kept |= {"task": "localisation", "localisation": queries, "map": {"load": str(wanted.map_file)}}
    config = as_task(LocalisationConfig, make_experiment(kept, where, overrides), where)
    frame, dataset = wanted.frame, config.dataset
    if frame is None:
        return config
    first = frame - (wanted.frames - 1) * dataset.stride
    selected = (frame - dataset.start) % dataset.stride == 0
    if frame < dataset.start or not selected or (dataset.stop or frame + 1) <= frame:
        raise ConfigError(
            f"--frame {frame}: not among the frames selected (start {dataset.start}, stop "
            f"{dataset.stop}, stride {dataset.stride}); choose another, or other --start, ..."
        )
    if first < dataset.start:
        raise ConfigError(
            f"--frame {frame}: too few frames before it for a submap of {wanted.frames}; lower "
            "--frames"
        )
    one = dataclasses.replace(dataset, start=first, stop=frame + 1)
    return config.model_copy(update={"dataset": one})


def _open_wanted(
    wanted: Wanted, given: GivenMap, config: LocalisationConfig, opening: Opening
) -> Task[LocalisationResult]:
    frame, where = wanted.frame, "" if wanted.frame is None else f"--frame {wanted.frame}: "
    try:
        sequence = open_sequence(config.as_experiment(), opening.progress)
    except FgslamError as error:
        raise type(error)(f"{where}{error}") from None
    if frame is not None and len(sequence) < wanted.frames:
        last = config.dataset.start + (len(sequence) - 1) * config.dataset.stride
        raise ConfigError(f"{where}{sequence.name} ends with frame {last}; choose a smaller one")
    return _task(config, given, sequence)


def settings_of_map(saved: SavedMap) -> dict[str, Any]:
    """Settings of the last drive that made the map; empty where it holds none."""
    settings = (drives_of(saved) or [{}])[-1].get("settings")
    return settings if isinstance(settings, dict) else {}


def settings_that_differ(made: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Groups of the front-end by which features are recognised, where they differ.

    Only what both know counts: maps of other versions have fewer settings or more.
    """
    different = []
    for name in ("sift", "appearance", "stereo"):
        then = made.get(name) or {}
        if any(then[key] != now[name][key] for key in then.keys() & now[name].keys()):
            different.append(name)
    return different


def _answer_line(attempt: Attempt) -> str:
    """One query in a line, for the terminal."""
    start = f"frame {attempt.frame:>5}  {attempt.verdict:<16}"
    found = attempt.found
    if found is None:
        return f"{start}{attempt.problem}"
    if not found.found:
        return f"{start}{found.why}"
    x, y, z = found.wTc[:3, 3]
    yaw = np.rad2deg(yaw_pitch_roll(found.wTc)[0])
    metres, degrees = sigmas_of(found)
    where = f"({x:7.3f}, {y:6.3f}, {z:7.3f}) m  heading {yaw:7.2f} deg"
    return (
        f"{start}{where}  sigma {100 * metres:4.1f} cm {degrees:4.2f} deg  "
        f"inliers {len(found.ids)} of {found.candidates}"
    )


def _details(attempt: Attempt) -> Iterator[tuple[str, str]]:
    """One query in full: name and value of what there is to know."""
    yield "frame", f"{attempt.frame}, from {in_frames(attempt.frames)}"
    yield "verdict", attempt.verdict
    found = attempt.found
    if found is None:
        yield "why", attempt.problem
        return
    if np.isfinite(found.covariance).all():
        x, y, z = found.wTc[:3, 3]
        yaw, pitch, roll = np.rad2deg(yaw_pitch_roll(found.wTc))
        metres, degrees = sigmas_of(found)
        uncertain = "" if found.found else ", not certain"
        yield "position", f"{x:.3f} {y:.3f} {z:.3f} m (right, down, ahead){uncertain}"
        yield "yaw, pitch, roll", f"{yaw:.2f} {pitch:.2f} {roll:.2f} deg"
        yield "sigma", f"{100 * metres:.1f} cm, {degrees:.2f} deg"
    yield "features", str(attempt.features)
    yield "candidates", f"{found.candidates} tentative matches by appearance"
    yield "inliers", f"{len(found.ids)} matches that agree with the pose"
    yield "expected", f"{found.expected} landmarks that should be recognised from there"
    yield "residual", f"{found.residual_px:.2f} px" if len(found.ids) else UNKNOWN
    yield "second-best place", f"{found.second} inliers"
    yield "why", found.why
    errors = localisation_errors(answers_of([attempt]))
    if np.isfinite(errors.metres[0]):
        yield "error", f"{100 * errors.metres[0]:.1f} cm, {np.rad2deg(errors.radians[0]):.2f} deg"
