"""Tasks `homing` and `path_following`: closed loop in a simulated world, over seeds.

Units: drives, one a seed. Files: legs.csv, commands.csv, trajectory.csv, logs, path_memory.npz,
metrics.json, views of the legs, the page. Numbers: arrivals, distances to the targets and across
the way, and whether these grow from leg to leg.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, runtime_checkable

import numpy as np

from fgslam.backend.homing.estimators import make_homing_estimator
from fgslam.core.arrays import ByteArray, FloatArray, Image, IntArray
from fgslam.core.bearings import (
    BearingLog,
    BearingMatches,
    HomingStart,
    HomingTruth,
    Refusal,
    TrackedBearings,
)
from fgslam.core.errors import OutputError, StoredMapError
from fgslam.core.files import make_subfolder
from fgslam.core.geometry import between, wrap
from fgslam.datasets.opening import open_house, open_simulated_homing
from fgslam.evaluation.homing import HomingErrors
from fgslam.evaluation.statistics import JsonValue, Nees, UpdateTime
from fgslam.frontend.homing.settings import HomingVectorSettings
from fgslam.frontend.homing.two_view import make_local_map
from fgslam.frontend.homing.vector import estimate_homing_vector
from fgslam.homing.active import ActiveHoming
from fgslam.homing.api import teach
from fgslam.homing.closed_loop import (
    ARRIVED_M,
    STAGES,
    Driver,
    DriveRecord,
    HomingLog,
    Slope,
    World,
    corners,
    cross_track,
    end_distance,
    follow,
    pass_distances,
    slope_by_leg,
    truly_arrived,
)
from fgslam.homing.controller import HomingChain
from fgslam.homing.front_end import HomingFrontEnd, ImageFrontEnd, make_front_end
from fgslam.homing.route import PathMemory
from fgslam.homing.settings import FrontEndSettings
from fgslam.homing.steering import Command, HomingState, Steering, make_avoider
from fgslam.homing.topological_map import RouteMap
from fgslam.report.content import Cell, Column, Figure, Picture, TextTable, write_csv
from fgslam.report.homing_figures import (
    PASS_RADIUS_M,
    Drive,
    Line,
    catchment_figure,
    curve_figure,
    drive_figure,
    local_map_figure,
    sorted_errors,
)
from fgslam.runs.config import CrossroadsConfig, DrivingConfig, HomingTrialsConfig
from fgslam.runs.engine import Context, Opening, RunResult, Status, Task, write_document, write_page
from fgslam.runs.folder import TIMING_FILE, TRIALS_FILE
from fgslam.runs.homing_comparison import (
    ESTIMATOR_COLUMNS,
    NEES_NAMES,
    JudgedHoming,
    finished_errors,
    replay_homing,
    save_bearing_logs,
    summary_numbers,
    summary_of,
    table_row,
    update_time_of,
)
from fgslam.runs.units import each_apart

if TYPE_CHECKING:
    from fgslam.datasets.opening import OmniWorld


# ------------------------------------------------------------------------------------------
# What follows from drives: arrivals, distances to targets, whether errors build up; files

_UNKNOWN = "-"


def drive_numbers(records: Sequence[DriveRecord], failed: int = 0) -> dict[str, JsonValue]:
    """Metrics over drives; null where nothing is known.

    Args:
        records: of the drives that left one.
        failed: drives that broke down; they did not arrive, and passed no target.
    """
    passed = [pass_distances(record) for record in records]
    across = [cross_track(record) for record in records]
    reached = _finite(passed)
    results = [leg.result for record in records for leg in record.legs]
    arrived = sum(truly_arrived(record) for record in records)
    claimed = sum(record.arrived for record in records)
    ends = _finite([np.array([end_distance(r)]) for r in records if r.arrived])
    targets = _known(passed) + failed * max((len(p) for p in passed), default=0)
    return {
        "drives": len(records) + failed,
        "failed": failed,
        "arrived": arrived,
        "arrival_rate": arrived / (len(records) + failed) if records or failed else None,
        "false_arrivals": claimed - arrived,
        "end_distance_median_m": _median(ends),
        "end_distance_max_m": float(ends.max()) if len(ends) else None,
        "legs": {name: results.count(name) for name in dict.fromkeys(results)},
        "initialisations_median": _median([leg.initialisations for r in records for leg in r.legs]),
        "pass_distance_median_m": _median(reached),
        "pass_distance_max_m": float(reached.max()) if len(reached) else None,
        "passed_within_0_2_m": float(np.count_nonzero(reached <= PASS_RADIUS_M)) / targets
        if targets
        else None,
        "targets": targets,
        "targets_aimed_at": len(reached),
        # At the last target the robot stops where the switch fraction is left, by design.
        "pass_distance_slope": _slope([distances[:-1] for distances in passed]),
        "cross_track_median_m": _median(_finite(across)),
        "cross_track_slope": _slope(across),
        "cross_track_slope_beside_corners": _slope(across, [corners(r) for r in records]),
        "duration_median_s": _median([float(r.time[-1] - r.time[0]) for r in records if len(r)]),
        "overridden": float(np.mean(np.concatenate([r.overridden for r in records])))
        if records
        else None,
        "stage_ms": _stages(records),
    }


def _finite(values: Sequence[FloatArray]) -> FloatArray:
    every: FloatArray = np.concatenate([np.empty(0), *values])
    return np.asarray(every[np.isfinite(every)])


def _known(passed: Sequence[FloatArray]) -> int:
    """Targets whose place is known, aimed at or not."""
    return sum(int(np.count_nonzero(~np.isnan(distances))) for distances in passed)


def _slope(
    values: Sequence[FloatArray], known: Sequence[FloatArray] | None = None
) -> dict[str, JsonValue]:
    """Growth of values, one array a drive and one value a leg, with the leg's number."""
    legs = np.concatenate([np.empty(0, np.int64), *(np.arange(len(v)) + 1 for v in values)])
    beside = None if known is None else np.concatenate([np.empty(0), *known])
    slope = slope_by_leg(legs, np.concatenate([np.empty(0), *values]), beside)
    return {**asdict(slope), "flat": _flat(slope)}


def _median(values: Sequence[float] | FloatArray) -> float | None:
    return float(np.median(values)) if len(values) else None


def _flat(slope: Slope) -> bool | None:
    return slope.flat if np.isfinite(slope.value) else None


def _stages(records: Sequence[DriveRecord]) -> dict[str, JsonValue]:
    return {
        name: asdict(UpdateTime.of(1e3 * np.concatenate([r.seconds[name] for r in records])))
        if records
        else None
        for name in STAGES
    }


def drive_sentences(numbers: dict[str, JsonValue]) -> tuple[str, ...]:
    """What the numbers of :func:`drive_numbers` say, in sentences."""
    lines = [
        f"{numbers['arrived']} of {numbers['drives']} drives arrive at the last target (within "
        f"{ARRIVED_M:g} m)."
    ]
    if numbers["false_arrivals"]:
        lines.append(f"{numbers['false_arrivals']} more claim an arrival and stand farther away.")
    median, largest = numbers["pass_distance_median_m"], numbers["pass_distance_max_m"]
    if isinstance(median, float) and isinstance(largest, float):
        lines.append(
            f"Targets are passed at {100.0 * median:.0f} cm (median), at most "
            f"{100.0 * largest:.0f} cm."
        )
    slope = numbers["cross_track_slope"]
    if isinstance(slope, dict) and slope["flat"] is not None:
        # An interval that holds zero may be wide, too: no proof that nothing grows.
        within = "within" if slope["flat"] else "outside"
        lines.append(
            f"The error across the way changes by {100.0 * slope['value']:.2f} cm a leg; zero lies "
            f"{within} its 95 % interval [{100.0 * slope['low']:.2f}, {100.0 * slope['high']:.2f}]."
        )
    return tuple(lines)


_COLUMNS = (
    Column(
        "arrived",
        "drives that counted this target as reached, by what they saw, of those that aimed at it",
    ),
    Column("pass distance cm median", "nearest to the place of the target's image"),
    Column("max", "the worst drive"),
    Column("across the way cm", "root mean square distance from the leg's straight line, median"),
    Column("initialisations", "mean number of times that the target was matched"),
)


def leg_tables(records: Sequence[DriveRecord]) -> tuple[TextTable, ...]:
    """A table with a row for each leg of the path; none without drives."""
    count = max((len(record.targets) for record in records), default=0)
    rows = tuple((f"leg {k + 1}", _row(records, k)) for k in range(count))
    return (TextTable("legs", "The legs", "leg", _COLUMNS, rows),) if rows else ()


def _row(records: Sequence[DriveRecord], k: int) -> tuple[str, ...]:
    legs = [leg for record in records for leg in record.legs if leg.target == k]
    passed = _finite([pass_distances(record)[k : k + 1] for record in records])
    across = _finite([cross_track(record)[k : k + 1] for record in records])
    arrived = sum(leg.result == "arrived" for leg in legs)
    times = [leg.initialisations for leg in legs]
    return (
        f"{arrived} of {len(legs)}",
        f"{100.0 * np.median(passed):.1f}" if len(passed) else _UNKNOWN,
        f"{100.0 * passed.max():.1f}" if len(passed) else _UNKNOWN,
        f"{100.0 * np.median(across):.1f}" if len(across) else _UNKNOWN,
        f"{np.mean(times):.1f}" if times else _UNKNOWN,
    )


# --------------------------------------------------------------------------------------------
# Files


LEGS_FILE = "legs.csv"
COMMANDS_FILE = "commands.csv"
TRAJECTORY_FILE = "trajectory.csv"
LEG_COLUMNS = (
    "seed",
    "leg",
    "result",
    "began_s",
    "ended_s",
    "initialisations",
    "remaining",
    "pass_distance_m",
    "cross_track_m",
    "reason",
)
_COMMAND_COLUMNS = (
    "seed",
    "time",
    "target",
    "state",
    "heading_deg",
    "sigma_heading_deg",
    "remaining",
    "sigma_remaining",
    "rotation_deg",
    "speed_mps",
    "turn_deg_s",
    "overridden",
    "reason",
)
_TRAJECTORY_COLUMNS = ("seed", "time", "x_m", "y_m", "heading_deg", "target")


def write_legs(folder: Path, records: Sequence[tuple[int, DriveRecord]]) -> None:
    """legs.csv: a row for each leg of each seed. Raises OutputError."""
    rows = (row for seed, record in records for row in _legs(seed, record))
    write_csv(folder / LEGS_FILE, LEG_COLUMNS, rows)


def write_drive(folder: Path, records: Sequence[tuple[int, DriveRecord]]) -> None:
    """commands.csv and trajectory.csv: a row for each step of each seed. Raises OutputError."""
    commands = (row for seed, record in records for row in _commands(seed, record))
    write_csv(folder / COMMANDS_FILE, _COMMAND_COLUMNS, commands)
    poses = (row for seed, record in records for row in _poses(seed, record))
    write_csv(folder / TRAJECTORY_FILE, _TRAJECTORY_COLUMNS, poses)


def write_logs(folder: Path, seed: int, record: DriveRecord) -> None:
    """A bearing log for each homing of a drive, with its truth. Raises OutputError."""
    logs = {
        f"seed_{seed:04d}_leg_{homing.target + 1:02d}_homing_{k:03d}": bearing_log(record, homing)
        for k, homing in enumerate(record.homings)
        if homing.tracks
    }
    save_bearing_logs(folder, logs)


def bearing_log(record: DriveRecord, homing: HomingLog) -> BearingLog:
    """One homing as estimators were given it; true places of its features are not known."""
    start = record.truth[homing.first_step]
    truth = None
    if homing.target < len(record.targets) and np.isfinite(record.targets[homing.target]).all():
        truth = HomingTruth(
            target=between(start, record.targets[homing.target]),
            robots=between(start, record.truth[homing.steps]),
            landmarks=np.full((len(homing.start.local_map), 2), np.nan),
        )
    provenance = {"target": homing.target, "first_step": homing.first_step}
    return BearingLog(homing.start, list(homing.tracks), truth, provenance)


def drive_of(record: DriveRecord, outlines: Sequence[FloatArray] = ()) -> Drive:
    """What the figure of the drive shows; headings are those of the estimator, in the world.

    There is none while the robot stands or drives blind: its command's heading means nothing then.
    """
    known = np.array([state == HomingState.DRIVE.value for state in record.state], np.bool_)
    headings = np.where(known, wrap(record.truth[:, 2] + record.heading), np.nan)
    return Drive(
        record.time, record.truth, record.target, headings, record.targets, tuple(outlines)
    )


def _legs(seed: int, record: DriveRecord) -> Iterator[list[Cell]]:
    passed, across = pass_distances(record), cross_track(record)
    for leg in record.legs:
        known = leg.target < len(passed)
        yield [
            seed,
            leg.target + 1,
            leg.result,
            leg.began,
            leg.ended,
            leg.initialisations,
            leg.remaining,
            float(passed[leg.target]) if known else None,
            float(across[leg.target]) if known else None,
            leg.reason,
        ]


def _commands(seed: int, record: DriveRecord) -> Iterator[list[Cell]]:
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt(np.diagonal(record.covariance, axis1=1, axis2=2))
    for k in range(len(record)):
        yield [
            seed,
            float(record.time[k]),
            int(record.target[k]) + 1,
            record.state[k],
            float(np.rad2deg(record.heading[k])),
            float(np.rad2deg(sigma[k, 1])),
            float(record.remaining[k]),
            float(sigma[k, 0]),
            float(np.rad2deg(record.rotation[k])),
            float(record.speed[k]),
            float(np.rad2deg(record.turn_rate[k])),
            bool(record.overridden[k]),
            record.reason[k],
        ]


def _poses(seed: int, record: DriveRecord) -> Iterator[list[Cell]]:
    for k, (x, y, heading) in enumerate(record.truth.tolist()):
        time, target = float(record.time[k]), int(record.target[k]) + 1
        yield [seed, time, x, y, float(np.rad2deg(heading)), target]


_TRIES = 50  # places drawn for a start that is free


class PathWorld(World, Protocol):
    """A world to put a robot into, with walls to draw."""

    @property
    def outlines(self) -> Sequence[FloatArray]:
        """Polylines (k, 2) of walls and furniture, metres."""
        ...

    def put(self, pose: FloatArray) -> None:
        """Puts the robot elsewhere (3,)."""
        ...

    def clearance(self, points: FloatArray) -> FloatArray:
        """(n,) metres from places (n, 2) to the nearest obstacle."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Opened:
    """What a drive begins with.

    Attributes:
        world: with the robot where it starts.
        front_end: for its camera.
        memory: the path.
        poses: (m, 3) where its images were taken.
    """

    world: PathWorld
    front_end: HomingFrontEnd
    memory: PathMemory
    poses: FloatArray


Opener: TypeAlias = Callable[[Any, int], Opened]
"""Opens the world of one seed of a configuration; of a module's top level."""


@dataclass(frozen=True, slots=True, eq=False)
class LegView:
    """The last image of a leg in which the target was tracked.

    Attributes:
        target: its number.
        view: (h, w) grey, unwrapped.
        trails: (k, 2) of each point, its place in the last k images, the present one last.
        caption: what the robot made of it.
    """

    target: int
    view: ByteArray
    trails: tuple[FloatArray, ...]
    caption: str


@dataclass(frozen=True, slots=True, eq=False)
class DrivenSeed:
    """One drive.

    Attributes:
        seed: of world and chance.
        record: of the drive.
        memory: the path as it is remembered.
        outlines: of the world.
        leg_m: true length of the first leg as driven: start to target.
        views: what the camera saw at the legs' ends; of the first seed alone.
    """

    seed: int
    record: DriveRecord
    memory: PathMemory
    outlines: tuple[FloatArray, ...]
    leg_m: float
    views: tuple[LegView, ...] = ()


@dataclass(frozen=True, slots=True)
class DriveTask:
    """One seed for one process."""

    config: DrivingConfig
    seed: int
    opener: Opener


def open_drives(config: DrivingConfig, opening: Opening) -> Task[RunResult]:
    """Drives in the rendered house, which each process builds for itself."""
    return drives_task(config, open_house_drive)


def drives_task(config: DrivingConfig, opener: Opener) -> Task[RunResult]:
    """Drives of the path, once for each seed, in worlds that ``opener`` opens."""
    provenance = {"dataset": {"name": config.dataset.kind}}
    return Task(provenance, lambda context: _run(config, opener, context))


def open_house_drive(config: DrivingConfig, seed: int) -> Opened:
    """World and front-end of one seed. Raises FgslamError where the house cannot be built."""
    world, front_end = open_house_front_end(config, seed)
    taught = teach(world.targets, world.calibration, features=config.features)
    memory = PathMemory.of(taught.images)  # the front-end has the camera
    return Opened(world, front_end, memory, world.target_poses)


def open_house_front_end(config: DrivingConfig, seed: int) -> tuple[OmniWorld, ImageFrontEnd]:
    """The house of one seed, and the front-end for its camera as calibrated. Raises as above."""
    world = open_house(config.dataset, seed)
    settings = FrontEndSettings(config.features, config.homing_vector, config.wrong_matches)
    return world, make_front_end(world.calibration, settings, seed)


def _run(config: DrivingConfig, opener: Opener, context: Context) -> RunResult:
    """Stopped early, the drives that are done count."""
    tasks = [DriveTask(config, config.seed + k, opener) for k in range(config.trials)]
    done = context.perform(each_apart(("drives", "drives"), perform_drive, tasks, DrivenSeed))
    driven = list(done.results.values())
    failures = sorted(f"seed {config.seed + k}: {why}" for (k,), why in done.ended)
    if not driven and not context.stopped():
        raise OutputError(f"no drive was finished; {failures[0]}")
    status: Status = "finished" if len(driven) == config.trials else "interrupted"
    return finish_drives(config, context.folder, status, driven, failures)


def perform_drive(task: DriveTask) -> DrivenSeed:
    """One drive from start to end."""
    config, behaviour = task.config, task.config.behaviour
    opened = task.opener(config, task.seed)
    world, front_end, memory = opened.world, opened.front_end, opened.memory
    if config.start_offset_m > 0.0:
        world.put(
            displaced_start(world, config.start_offset_m, np.random.default_rng((task.seed, 7)))
        )
    follower = HomingChain(
        front_end,
        memory.images,
        lambda start: make_homing_estimator(start, config.estimator),
        behaviour.control,
    )
    avoider = make_avoider(behaviour.avoidance, behaviour.steering.max_turn_deg_s)
    driver = Driver(Steering(behaviour.steering), avoider)
    start = np.array(world.true_pose)
    shown = config.output.pictures if task.seed == config.seed else 0
    watcher = (
        DriveWatcher(front_end, follower) if shown and isinstance(front_end, Unwrapping) else None
    )
    record = follow(world, follower, driver, behaviour.loop, opened.poses, watcher)
    leg = float(np.hypot(*(opened.poses[0, :2] - start[:2])))
    views = () if watcher is None else watcher.views(shown)
    return DrivenSeed(task.seed, record, memory, tuple(world.outlines), leg, views)


def displaced_start(world: PathWorld, radius: float, rng: np.random.Generator) -> FloatArray:
    """The start, moved and turned at random to a place that is free; itself where none is found."""
    pose = np.array(world.true_pose, np.float64)
    room = float(world.clearance(pose[None, :2])[0])
    for _ in range(_TRIES):
        distance, angle = radius * np.sqrt(rng.random()), rng.uniform(-np.pi, np.pi)
        place = pose[:2] + distance * np.array([np.cos(angle), np.sin(angle)])
        if world.clearance(place[None])[0] >= min(room, 0.5):
            return np.array([*place, rng.uniform(-np.pi, np.pi)])
    return pose


FOLDER = "pictures"
_TRAIL = 15  # images


@runtime_checkable
class Unwrapping(Protocol):
    """A front-end that can show its view; those of landmark worlds cannot."""

    def unwrapped(self, image: ByteArray) -> ByteArray:
        """(h, w) grey view of an image."""
        ...

    def places(self, tracked: TrackedBearings) -> FloatArray:
        """(m, 2) column and row of tracked points in that view."""
        ...


class DriveWatcher:
    """Looks over the robot's shoulder; see :data:`fgslam.homing.closed_loop.Watcher`."""

    def __init__(self, front_end: Unwrapping, follower: HomingChain) -> None:
        self._front_end, self._follower = front_end, follower
        self._homing: ActiveHoming | None = None
        self._trails: dict[int, FloatArray] = {}
        self._last: dict[int, tuple[ByteArray, dict[int, FloatArray], str]] = {}

    def __call__(self, command: Command, image: ByteArray) -> None:
        """Notes the image if the tracks are those in it."""
        homing = self._follower.controller.active
        if homing is None or homing.tracked.time != command.time:
            return
        before = self._trails if homing is self._homing else {}
        self._homing = homing
        none = np.empty((0, 2))
        places = self._front_end.places(homing.tracked)
        self._trails = {
            i: np.vstack([before.get(i, none)[1 - _TRAIL :], place])
            for i, place in zip(homing.tracked.ids.tolist(), places, strict=True)
        }
        caption = (
            f"{command.time:.1f} s, {len(places)} tracks, {command.remaining:.2f} of the leg left"
        )
        self._last[command.target] = (image, self._trails, caption)

    def views(self, most: int) -> tuple[LegView, ...]:
        """At most so many legs, spread evenly, the last one among them."""
        targets = sorted(self._last)
        count = min(most, len(targets))
        chosen = np.linspace(len(targets), 0, count, endpoint=False).round().astype(int)[::-1] - 1
        return tuple(self._view(targets[k]) for k in chosen.tolist())

    def _view(self, target: int) -> LegView:
        image, trails, caption = self._last[target]
        return LegView(target, self._front_end.unwrapped(image), tuple(trails.values()), caption)


MEMORY_FILE = "path_memory.npz"


def finish_drives(
    config: DrivingConfig,
    folder: Path,
    status: Status,
    driven: Sequence[DrivenSeed],
    failures: Sequence[str],
) -> RunResult:
    """All files, numbers and the page of drives. Raises OutputError."""
    records = [(one.seed, one.record) for one in driven]
    every = [record for _, record in records]
    write_legs(folder, records)
    write_drive(folder, records)
    for one in driven[: config.output.logs]:
        write_logs(folder, one.seed, one.record)
    numbers = drive_numbers(every, len(failures))
    if driven:
        numbers["kilobytes_per_image"] = driven[0].memory.save(folder / MEMORY_FILE)
    numbers["seeds"] = [one.seed for one in driven]
    result = RunResult(
        config, folder, status, drive_sentences(numbers), leg_tables(every), tuple(failures)
    )
    write_document(result, numbers)
    subtitle = f"seeds {config.seed} to {config.seed + config.trials - 1}, {len(driven)} driven"
    if config.trials == 1:
        subtitle = f"one drive, seed {config.seed}"
    pictures = draw_leg_views(folder, driven[0].seed, driven[0].views) if driven else ()
    write_page(result, subtitle, figures=tuple(_figures(config, driven)), pictures=pictures)
    return result


def draw_leg_views(folder: Path, seed: int, views: Sequence[LegView]) -> tuple[Picture, ...]:
    """A picture for each view. Raises OutputError."""
    from fgslam.report.pictures import draw_view_tracks  # Matplotlib takes a second

    pictures = []
    for view in views:
        path = make_subfolder(folder, FOLDER) / f"leg_{view.target + 1:02d}.png"
        caption = f"Seed {seed}, leg {view.target + 1}, {view.caption}"
        draw_view_tracks(path, view.view, view.trails, caption)
        pictures.append(Picture(caption, path.read_bytes()))
    return tuple(pictures)


def _figures(config: DrivingConfig, driven: Sequence[DrivenSeed]) -> Iterator[Figure]:
    if not driven:
        return
    first = driven[0]
    words = f"The drive of seed {first.seed}, from above"
    yield drive_figure(drive_of(first.record, first.outlines), heading=words)
    homing = next((h for h in first.record.homings if h.tracks), None)
    if homing is not None:
        log = bearing_log(first.record, homing)
        replayed = replay_homing(log.start, log.images, config.estimator, landmarks=True)
        heading = f"The local map on the way to target {homing.target + 1}"
        # Averages of bearings have no map to show.
        if replayed.estimates and np.isfinite(replayed.estimates[-1].landmarks).all():
            yield local_map_figure(replayed.estimates, log.truth, heading=heading)
    yield _remaining(driven[: config.output.logs] or driven[:1])
    if config.start_offset_m > 0.0 and len(driven) > 1:
        yield _catchment(driven)


def _remaining(driven: Sequence[DrivenSeed]) -> Figure:
    lines = [
        Line(f"seed {one.seed}", k, one.record.time, one.record.remaining)
        for k, one in enumerate(driven)
    ]
    words = (
        "remaining",
        "Part of the leg that is left",
        "As the robot believes it; each leg begins at 1.",
    )
    return curve_figure(words, lines, ("time (s)", "left (legs)"), y={"rangemode": "tozero"})


def _catchment(driven: Sequence[DrivenSeed]) -> Figure:
    known = [one for one in driven if len(one.record)]
    offsets = [between(one.record.targets[0], one.record.truth[0])[:2] for one in known]
    arrived = np.array([_reached_first(one.record) for one in known])
    reasons = [f"seed {one.seed}: {one.record.legs[0].reason}" for one in known if one.record.legs]
    return catchment_figure(np.array(offsets), arrived, reasons)


def _reached_first(record: DriveRecord) -> bool:
    """Whether the first target was reached: by what the robot says, and in truth."""
    said = bool(record.legs) and record.legs[0].result == "arrived"
    return said and bool(pass_distances(record)[0] <= ARRIVED_M)


# ------------------------------------------------------------------------------------------
# Task `crossroads`: routes taught on their own are joined, and a way over both of them is driven

_ROUTES = ("first", "second")
_PICTURES = 1000  # of a route; their noise differs


def open_crossroads(config: CrossroadsConfig, opening: Opening) -> Task[RunResult]:
    """Drives in the rendered house, which each process builds for itself."""
    return drives_task(config, open_crossroads_drive)


def open_crossroads_drive(config: CrossroadsConfig, seed: int) -> Opened:
    """World, front-end and way of one seed. Raises FgslamError where the house cannot be built."""
    world, front_end = open_house_front_end(config, seed)
    poses = world.crossing_routes()
    routes = {name: _taught(world, k, poses[k]) for k, name in enumerate(_ROUTES)}
    joined = RouteMap.join(routes, seed=seed)
    places = np.vstack(poses)
    ends = [joined.names[0], joined.names[-1]]
    start, goal = (0, -1) if not config.back else (-1, 0)
    world.put(places[start])
    way = _way(joined, world.image(0.0), ends[goal], seed)
    at = [joined.names.index(name) for name in way.names]
    return Opened(world, front_end, PathMemory(way.images, way.names), places[at])


def _taught(world: OmniWorld, number: int, poses: FloatArray) -> PathMemory:
    """What is kept of a route."""
    pictures = [world.picture(pose, number * _PICTURES + k) for k, pose in enumerate(poses)]
    return teach(pictures, world.calibration)


def _way(joined: RouteMap, image: Image, goal: str, seed: int) -> PathMemory:
    """The way from where an image was taken; the goal alone where none is known."""
    place = joined.locate(image, seed=seed)
    if place:
        with suppress(StoredMapError):  # no way
            return joined.way(place, goal)
    return joined.way(goal, goal)


# ------------------------------------------------------------------------------------------
# Task `homing_trials`: simulated homings of bearings, many estimators on the same ones

Unit: TypeAlias = tuple[HomingTrialsConfig, int, int]
"""Configuration, number of the share of outliers, and of the trial."""

TRIALS_A_BLOCK = 20  # trials a process: starting one takes as long as some trials
_TRIAL_COLUMNS = (
    "outliers",
    "trial",
    "estimator",
    "refused",
    "failure",
    "inliers",
    "wrong_inliers",
    "images",
    "direction_error_deg",
    "rotation_error_deg",
    "distance_error_legs",
    *(f"{what}_{name}" for name in NEES_NAMES for what in ("nees", "dof")),
)


@dataclass(frozen=True, slots=True, eq=False)
class HomingTrial:
    """One simulated homing.

    Attributes:
        share: part of outliers.
        trial: its number.
        refused: why there was no homing vector; empty where there was one.
        inliers, wrong_inliers: matches that support the vector; wrong ones among them.
        tried: by title of the estimator.
        log: of the bearings, where it is to be kept.
    """

    share: float
    trial: int
    refused: str
    inliers: int
    wrong_inliers: int
    tried: dict[str, JudgedHoming]
    log: BearingLog | None = None


def open_trials(config: HomingTrialsConfig, opening: Opening) -> Task[RunResult]:
    """Simulated homings need no data."""
    provenance = {"dataset": {"name": "simulated bearings"}}
    return Task(provenance, lambda context: _trial_run(config, context))


def _trial_run(config: HomingTrialsConfig, context: Context) -> RunResult:
    """Runs all trials; stopped early, those finished count."""
    units = _units(config)
    done = context.perform(
        each_apart(("trials", "trials"), perform_trial, units, HomingTrial, TRIALS_A_BLOCK)
    )
    trials = sorted(done.results.values(), key=lambda trial: (trial.share, trial.trial))
    failures = sorted(_failure([units[k] for k in block], why) for block, why in done.ended)
    logs = {trial_name(trial): trial.log for trial in trials if trial.log is not None}
    save_bearing_logs(context.folder, logs)
    status: Status = "finished" if len(trials) == len(units) else "interrupted"
    return finish_trials(config, context.folder, status, trials, failures)


def _failure(units: Sequence[Unit], why: str) -> str:
    _, share, first = units[0]
    return f"{len(units)} trials, from trial {first} of share {share} on: {why}"


def trial_name(trial: HomingTrial) -> str:
    """Of a trial's log: share of outliers in percent, and number."""
    return f"outliers_{100.0 * trial.share:02.0f}_trial_{trial.trial:04d}"


def perform_trial(unit: Unit) -> HomingTrial:
    """One trial; its noise depends on the seed, the share's number and its own number alone."""
    config, share, trial = unit
    rng = np.random.default_rng((config.seed, share, trial))
    part = config.outliers[share]
    simulated = open_simulated_homing(config.dataset, part, rng)
    begun = start_from_matches(simulated.time, simulated.matches, config.homing_vector, rng)
    if isinstance(begun, Refusal):
        return HomingTrial(part, trial, begun.reason.value, 0, 0, {})
    start, rows = begun
    tracks, truth = simulated.followed(rows)
    tried = {
        settings.title: replay_homing(start, tracks, settings).judged(truth)
        for settings in config.estimators
    }
    wrong = int(np.count_nonzero(~simulated.correct[rows]))
    log = BearingLog(start, list(tracks), truth) if trial < config.output.logs else None
    return HomingTrial(part, trial, "", len(rows), wrong, tried, log)


def _units(config: HomingTrialsConfig) -> list[Unit]:
    """All trials; those of one block are of one share, and the shares take turns."""
    return [
        (config, share, trial)
        for first in range(0, config.trials, TRIALS_A_BLOCK)
        for share in range(len(config.outliers))
        for trial in range(first, min(first + TRIALS_A_BLOCK, config.trials))
    ]


def start_from_matches(
    time: float,
    matches: BearingMatches,
    settings: HomingVectorSettings,
    rng: np.random.Generator,
) -> tuple[HomingStart, IntArray] | Refusal:
    """Homing vector and local map of the matches that support it.

    Returns:
        The start, whose features are numbered from 0, and the rows (n,) of ``matches`` that they
        were; or why there is none.
    """
    vector = estimate_homing_vector(matches, settings, rng)
    if isinstance(vector, Refusal):
        return vector
    rows = np.flatnonzero(vector.inliers)
    kept = matches.select(rows)
    of_kept = dataclasses.replace(vector, inliers=np.ones(len(rows), np.bool_))
    return HomingStart(time, of_kept, make_local_map(of_kept, kept), kept), rows


# --------------------------------------------------------------------------------------------
# Files


def finish_trials(
    config: HomingTrialsConfig,
    folder: Path,
    status: Status,
    trials: Sequence[HomingTrial],
    failures: Sequence[str],
) -> RunResult:
    """trials.csv, metrics.json and the page. Raises OutputError."""
    titles = [settings.title for settings in config.estimators]
    write_csv(folder / TRIALS_FILE, _TRIAL_COLUMNS, _rows(trials, titles))
    timing = ("outliers", "trial", "estimator", "median_ms", "p95_ms", "max_ms")
    write_csv(folder / TIMING_FILE, timing, _times(trials, titles))
    groups = {share: [t for t in trials if t.share == share] for share in config.outliers}
    found = {title: _of_estimator(groups, title) for title in titles}
    tables = tuple(_table(share, group, titles) for share, group in groups.items() if group)
    result = RunResult(config, folder, status, _best(groups, titles), tables, tuple(failures))
    refused = {f"{share:g}": sum(bool(t.refused) for t in group) for share, group in groups.items()}
    numbers: dict[str, JsonValue] = {
        "trials": config.trials,
        "outliers": list(config.outliers),
        "trials_done": {f"{share:g}": len(group) for share, group in groups.items()},
        "refused": refused,
    }
    kinds = {settings.title: settings.kind for settings in config.estimators}
    estimators = {title: {"kind": kinds[title], **values} for title, values in found.items()}
    write_document(result, numbers, estimators)
    subtitle = f"{len(trials)} simulated homings of bearings alone, seed {config.seed}"
    write_page(result, subtitle, figures=tuple(_trial_figures(groups, titles)))
    return result


# --------------------------------------------------------------------------------------------
# Numbers, tables, figures


def _of(trials: Sequence[HomingTrial], title: str) -> list[JudgedHoming]:
    """What one estimator made of the trials that had a homing vector."""
    return [t.tried[title] for t in trials if title in t.tried]


def _of_estimator(groups: dict[float, list[HomingTrial]], title: str) -> dict[str, JsonValue]:
    every = [trial for group in groups.values() for trial in group]
    failures = [
        f"outliers {t.share:g}, trial {t.trial}: {t.tried[title].failure}"
        for t in every
        if title in t.tried and t.tried[title].failure
    ]
    shares: dict[str, JsonValue] = {
        f"{share:g}": summary_numbers(_of(group, title)) for share, group in groups.items()
    }
    return {
        "outliers": shares,
        "update_ms": asdict(update_time_of(_of(every, title))),
        "failures": list(failures),
    }


def _rows(trials: Sequence[HomingTrial], titles: Sequence[str]) -> Iterator[list[Cell]]:
    for trial in trials:
        start: list[Cell] = [trial.share, trial.trial]
        if trial.refused:
            yield [*start, "", trial.refused, *[None] * (len(_TRIAL_COLUMNS) - 4)]
        for title in titles if trial.tried else ():
            tried = trial.tried[title]
            about: list[Cell] = [title, "", tried.failure, trial.inliers, trial.wrong_inliers]
            yield [*start, *about, len(tried.update_ms), *_last(tried.errors)]


def _last(errors: HomingErrors | None) -> list[Cell]:
    if errors is None:
        return [None] * (3 + 2 * len(NEES_NAMES))
    last = errors.last()
    degrees = np.rad2deg([last.direction[0], last.rotation[0]]).tolist()
    judged: list[Nees] = [getattr(last, name) for name in NEES_NAMES]
    cells = [value for one in judged for value in (_value(one), int(one.dof[0]))]
    return [*degrees, float(last.distance[0]), *cells]


def _value(one: Nees) -> float | None:
    return float(one.values[0]) if one.dof[0] else None


def _times(trials: Sequence[HomingTrial], titles: Sequence[str]) -> Iterator[list[Cell]]:
    for trial in trials:
        for title in titles if trial.tried else ():
            time = UpdateTime.of(trial.tried[title].update_ms)
            yield [trial.share, trial.trial, title, time.median, time.p95, time.max]


def _table(share: float, group: Sequence[HomingTrial], titles: Sequence[str]) -> TextTable:
    refused = sum(bool(t.refused) for t in group)
    rows = tuple((title, table_row(_of(group, title))) for title in titles)
    heading = f"{100.0 * share:.0f} % outliers, {len(group)} trials"
    heading += f", {refused} of them refused" if refused else ""
    return TextTable(f"share-{100.0 * share:.0f}", heading, "estimator", ESTIMATOR_COLUMNS, rows)


def _best(groups: dict[float, list[HomingTrial]], titles: Sequence[str]) -> tuple[str, ...]:
    lines = []
    for share, group in groups.items():
        summaries = [(summary_of(_of(group, title)), title) for title in titles]
        ranked = sorted((s.direction_median_deg, title) for s, title in summaries if s is not None)
        if ranked:
            error, title = ranked[0]
            lines.append(
                f"At {100.0 * share:.0f} % outliers {title} has the smallest median error of the "
                f"home direction: {error:.2f} degrees."
            )
    return tuple(lines) or ("No trial gave a result.",)


def _trial_figures(
    groups: dict[float, list[HomingTrial]], titles: Sequence[str]
) -> Iterator[Figure]:
    for share, group in groups.items():
        errors = {title: _directions(group, title) for title in titles}
        if any(map(len, errors.values())):
            heading = f"Error of the home direction at {100.0 * share:.0f} % outliers"
            figure = sorted_errors(errors, "degrees", (f"direction-{100.0 * share:.0f}", heading))
            figure.drawing.update_xaxes(type="log")
            yield figure


def _directions(group: Sequence[HomingTrial], title: str) -> np.ndarray:
    last = [errors.last().direction for errors in finished_errors(_of(group, title))]
    return np.rad2deg(np.concatenate(last)) if last else np.empty(0)
