"""Tasks `homing`, `path_following`, `crossroads`: closed loop in the rendered house, over seeds.

One task with a path inside: its first leg, all of it, or a way over two routes that were taught
apart. Units: drives, one a seed. Files: legs.csv, commands.csv, trajectory.csv, logs,
path_memory.npz, views of the legs, metrics.json, the page.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from fgslam.backend.homing.estimators import make_homing_estimator
from fgslam.core.arrays import ByteArray, FloatArray, StateArrays
from fgslam.core.bearings import BearingLog, HomingTruth
from fgslam.core.errors import OutputError, StoredMapError
from fgslam.core.geometry import between, wrap
from fgslam.core.kernels import make_kernels
from fgslam.core.store import restore, state_of
from fgslam.datasets.omni import OmniRecording
from fgslam.datasets.opening import open_checked, open_house
from fgslam.evaluation.statistics import JsonValue, spread
from fgslam.frontend.homing.tracking import ReplenishedTracker
from fgslam.homing.active import ActiveHoming
from fgslam.homing.api import teach
from fgslam.homing.closed_loop import (
    ARRIVED_M,
    STAGES,
    DriveRecord,
    HomingLog,
    corners,
    cross_track,
    end_distance,
    follow,
    pass_distances,
    slope_by_leg,
    truly_arrived,
)
from fgslam.homing.controller import HomingChain
from fgslam.homing.front_end import ImageFrontEnd, make_front_end
from fgslam.homing.route import PathMemory
from fgslam.homing.settings import FrontEndSettings
from fgslam.homing.steering import Command, CorridorAvoidance, HomingState, Steering
from fgslam.homing.topological_map import RouteMap
from fgslam.report.content import UNKNOWN, Column, Figure, Picture, TextTable, write_csv
from fgslam.report.homing_figures import (
    PASS_RADIUS_M,
    Drive,
    Line,
    catchment_figure,
    curve_figure,
    drive_figure,
    local_map_figure,
)
from fgslam.runs.config import CrossroadsConfig, DrivingConfig, OmniVideoConfig
from fgslam.runs.engine import Context, Opening, RunResult, Task, provenance_of
from fgslam.runs.results import draw_picture, finish, median, numbers_table
from fgslam.runs.tasks.homing_replay import replay_homing, save_bearing_logs

if TYPE_CHECKING:
    from fgslam.datasets.opening import OmniWorld


MEMORY_FILE = "path_memory.npz"
_ROUTES = ("first", "second")
_PICTURES = 1000  # of a route; their noise differs
_TRIES = 50  # places drawn for a start that is free
_TRAIL = 15  # images

# --------------------------------------------------------------------------------------------
# One drive


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


def way_over_routes(
    world: OmniWorld, config: CrossroadsConfig, seed: int
) -> tuple[PathMemory, FloatArray]:
    """A way over two routes, from the end of one to that of the other, where the robot is put.

    Returns:
        The path, and (m, 3) poses where its images were taken.
    """
    poses = world.crossing_routes()
    routes = {}
    for number, name in enumerate(_ROUTES):
        places = enumerate(poses[number])
        pictures = [world.picture(pose, number * _PICTURES + k) for k, pose in places]
        routes[name] = teach(pictures, world.calibration)
    joined = RouteMap.join(routes, seed=seed)
    every = np.vstack(poses)
    start, goal = (0, -1) if not config.back else (-1, 0)
    world.put(every[start])
    place, end = joined.locate(world.image(0.0), seed=seed), joined.names[goal]
    way = joined.way(end, end)  # the goal alone where none is known
    if place:
        with suppress(StoredMapError):  # no way
            way = joined.way(place, end)
    at = [joined.names.index(name) for name in way.names]
    return PathMemory(way.images, way.names), every[at]


def perform_drive(config: DrivingConfig, seed: int) -> DrivenSeed:
    """One drive from start to end. Raises FgslamError where the house cannot be built."""
    world = open_house(config.dataset, seed)
    settings = FrontEndSettings(config.features, config.homing_vector, config.wrong_matches)
    front_end = make_front_end(world.calibration, settings, seed)
    if isinstance(config, CrossroadsConfig):
        memory, poses = way_over_routes(world, config, seed)
    else:
        taught = teach(world.targets, world.calibration, features=config.features)
        # The front-end has the camera.
        memory, poses = PathMemory.of(taught.images), world.target_poses
    behaviour = config.behaviour
    if config.start_offset_m > 0.0:
        rng = np.random.default_rng((seed, 7))
        world.put(displaced_start(world, config.start_offset_m, rng))
    follower = HomingChain(
        front_end,
        memory.images,
        lambda start: make_homing_estimator(start, config.estimator),
    )
    steering = Steering(behaviour.steering)
    avoider = CorridorAvoidance(behaviour.steering.max_turn_deg_s)
    start = np.array(world.true_pose)
    shown = config.output.pictures if seed == config.seed else 0
    watcher = DriveWatcher(front_end, follower) if shown else None
    record = follow(world, follower, steering, avoider, behaviour.loop, poses, watcher)
    leg = float(np.hypot(*(poses[0, :2] - start[:2])))
    views = () if watcher is None else watcher.views(shown)
    return DrivenSeed(seed, record, memory, tuple(world.outlines), leg, views)


def displaced_start(world: OmniWorld, radius: float, rng: np.random.Generator) -> FloatArray:
    """The start, moved and turned at random to a place that is free; itself where none is found."""
    pose = np.array(world.true_pose, np.float64)
    room = float(world.clearance(pose[None, :2])[0])
    for _ in range(_TRIES):
        distance, angle = radius * np.sqrt(rng.random()), rng.uniform(-np.pi, np.pi)
        place = pose[:2] + distance * np.array([np.cos(angle), np.sin(angle)])
        if world.clearance(place[None])[0] >= min(room, 0.5):
            return np.array([*place, rng.uniform(-np.pi, np.pi)])
    return pose


class DriveWatcher:
    """Keeps each leg's last view; see :data:`fgslam.homing.closed_loop.Watcher`."""

    def __init__(self, front_end: ImageFrontEnd, follower: HomingChain) -> None:
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
        places = self._front_end.places(homing.tracked)
        self._trails = trails_after(before, homing.tracked.ids.tolist(), places)
        caption = (
            f"{command.time:.1f} s, {len(places)} tracks, {command.remaining:.2f} of the leg left"
        )
        self._last[command.target] = (image, self._trails, caption)

    def views(self, most: int) -> tuple[LegView, ...]:
        """At most so many legs, spread evenly, the last one among them."""
        targets = sorted(self._last)
        count = min(most, len(targets))
        chosen = np.linspace(len(targets), 0, count, endpoint=False).round().astype(int)[::-1] - 1
        views = []
        for target in (targets[k] for k in chosen):
            image, trails, caption = self._last[target]
            view = self._front_end.unwrapped(image)
            views.append(LegView(target, view, tuple(trails.values()), caption))
        return tuple(views)


def trails_after(
    before: dict[int, FloatArray], ids: Sequence[int], places: FloatArray
) -> dict[int, FloatArray]:
    """The last places (k, 2) of those points that are still there, at ``places`` (n, 2) now."""
    none = np.empty((0, 2))
    return {
        identity: np.vstack([before.get(identity, none)[1 - _TRAIL :], place])
        for identity, place in zip(ids, places, strict=True)
    }


# --------------------------------------------------------------------------------------------
# The task


def open_drives(config: DrivingConfig, opening: Opening) -> Task[RunResult]:
    """Drives in the rendered house, which each process builds for itself."""
    return Task({"dataset": {"name": config.dataset.kind}}, partial(_run, config))


def _run(config: DrivingConfig, context: Context) -> RunResult:
    """Stopped early, the drives that are done count."""
    make_kernels(context.progress)  # before several processes do
    seeds = range(config.seed, config.seed + config.trials)
    work = partial(perform_drive, config)
    done = context.perform(("drives", "drives"), work, seeds, DrivenSeed)
    driven = list(done.results.values())
    failures = sorted(f"seed {seeds[k]}: {why}" for (k,), why in done.ended)
    if not driven and not context.stopped():
        raise OutputError(f"no drive was finished; {failures[0]}")
    return finish_drives(config, context.folder, driven, failures)


def finish_drives(
    config: DrivingConfig, folder: Path, driven: Sequence[DrivenSeed], failures: Sequence[str]
) -> RunResult:
    """All files, numbers and the page of drives. Raises OutputError."""
    records = [one.record for one in driven]
    write_csv(folder / "legs.csv", _LEG_COLUMNS, _leg_rows(driven))
    write_csv(folder / "commands.csv", _COMMAND_COLUMNS, _command_rows(driven))
    write_csv(folder / "trajectory.csv", _TRAJECTORY_COLUMNS, _pose_rows(driven))
    for one in driven[: config.output.logs]:
        logs = {
            f"seed_{one.seed:04d}_leg_{homing.target + 1:02d}_homing_{k:03d}": bearing_log(
                one.record, homing
            )
            for k, homing in enumerate(one.record.homings)
            if homing.tracks
        }
        save_bearing_logs(folder, logs)
    numbers = drive_numbers(records, len(failures))
    if driven:
        numbers["kilobytes_per_image"] = driven[0].memory.save(folder / MEMORY_FILE)
    numbers["seeds"] = [one.seed for one in driven]
    subtitle = f"seeds {config.seed} to {config.seed + config.trials - 1}, {len(driven)} driven"
    if config.trials == 1:
        subtitle = f"one drive, seed {config.seed}"
    return finish(
        config,
        folder,
        len(driven) == config.trials,
        numbers,
        subtitle,
        tuple(_figures(config, driven)),
        draw_leg_views(folder, driven[0].seed, driven[0].views) if driven else (),
        lines=_sentences(numbers),
        tables=_leg_tables(records),
        notes=tuple(failures),
    )


# --------------------------------------------------------------------------------------------
# Numbers: arrivals, distances to targets and across the way, and whether these grow


def drive_numbers(records: Sequence[DriveRecord], failed: int = 0) -> dict[str, JsonValue]:
    """Metrics over drives; null where nothing is known.

    Args:
        records: of the drives that left one.
        failed: drives that broke down; they did not arrive, and passed no target.
    """
    drives = len(records) + failed
    passed, across = [pass_distances(r) for r in records], [cross_track(r) for r in records]
    reached = _finite(passed)
    legs = [leg for record in records for leg in record.legs]
    results = [leg.result for leg in legs]
    arrived = sum(map(truly_arrived, records))
    ends = _finite([np.array([end_distance(r)]) for r in records if r.arrived])
    # Targets whose place is known, aimed at or not.
    targets = int(np.count_nonzero(~np.isnan(np.concatenate([np.empty(0), *passed]))))
    targets += failed * max(map(len, passed), default=0)
    return {
        "drives": drives,
        "failed": failed,
        "arrived": arrived,
        "arrival_rate": arrived / drives if drives else None,
        "false_arrivals": sum(record.arrived for record in records) - arrived,
        "end_distance_median_m": median(ends),
        "end_distance_max_m": float(ends.max()) if len(ends) else None,
        "legs": {name: results.count(name) for name in dict.fromkeys(results)},
        "initialisations_median": median([leg.initialisations for leg in legs]),
        "pass_distance_median_m": median(reached),
        "pass_distance_max_m": float(reached.max()) if len(reached) else None,
        "passed_within_0_2_m": float(np.count_nonzero(reached <= PASS_RADIUS_M)) / targets
        if targets
        else None,
        "targets": targets,
        "targets_aimed_at": len(reached),
        # At the last target the robot stops where the switch fraction is left, by design.
        "pass_distance_slope": _slope([distances[:-1] for distances in passed]),
        "cross_track_median_m": median(_finite(across)),
        "cross_track_slope": _slope(across),
        "cross_track_slope_beside_corners": _slope(across, [corners(r) for r in records]),
        "duration_median_s": median([float(r.time[-1] - r.time[0]) for r in records if len(r)]),
        "overridden": float(np.mean(np.concatenate([r.overridden for r in records])))
        if records
        else None,
        "stage_ms": {
            name: spread(1e3 * np.concatenate([r.seconds[name] for r in records]))
            if records
            else None
            for name in STAGES
        },
    }


def _finite(values: Sequence[FloatArray]) -> FloatArray:
    every: FloatArray = np.concatenate([np.empty(0), *values])
    return np.asarray(every[np.isfinite(every)])


def _slope(
    values: Sequence[FloatArray], known: Sequence[FloatArray] | None = None
) -> dict[str, JsonValue]:
    """Growth of values, one array a drive and one value a leg, with the leg's number."""
    legs = np.concatenate([np.empty(0, np.int64), *(np.arange(len(v)) + 1 for v in values)])
    explained = None if known is None else np.concatenate([np.empty(0), *known])
    slope = slope_by_leg(legs, np.concatenate([np.empty(0), *values]), explained)
    return {**asdict(slope), "flat": slope.flat if np.isfinite(slope.value) else None}


def _sentences(numbers: dict[str, Any]) -> tuple[str, ...]:
    lines = [
        f"{numbers['arrived']} of {numbers['drives']} drives arrive at the last target (within "
        f"{ARRIVED_M:g} m)."
    ]
    if numbers["false_arrivals"]:
        lines.append(f"{numbers['false_arrivals']} more claim an arrival and stand farther away.")
    if numbers["pass_distance_median_m"] is not None:
        lines.append(
            f"Targets are passed at {100.0 * numbers['pass_distance_median_m']:.0f} cm (median), "
            f"at most {100.0 * numbers['pass_distance_max_m']:.0f} cm."
        )
    slope = numbers["cross_track_slope"]
    if slope["flat"] is not None:
        # An interval that holds zero may be wide, too: no proof that nothing grows.
        within = "within" if slope["flat"] else "outside"
        lines.append(
            f"The error across the way changes by {100.0 * slope['value']:.2f} cm a leg; zero lies "
            f"{within} its 95 % interval [{100.0 * slope['low']:.2f}, {100.0 * slope['high']:.2f}]."
        )
    return tuple(lines)


_LEG_TABLE = (
    Column("arrived", "drives that counted this target as reached, of those that aimed at it"),
    Column("pass distance cm median", "nearest to the place of the target's image"),
    Column("max", "the worst drive"),
    Column("across the way cm", "root mean square distance from the leg's straight line, median"),
    Column("initialisations", "mean number of times that the target was matched"),
)


def _leg_tables(records: Sequence[DriveRecord]) -> tuple[TextTable, ...]:
    """A table with a row for each leg of the path; none without drives."""
    rows = []
    for k in range(max((len(record.targets) for record in records), default=0)):
        legs = [leg for record in records for leg in record.legs if leg.target == k]
        passed = _finite([pass_distances(record)[k : k + 1] for record in records])
        across = _finite([cross_track(record)[k : k + 1] for record in records])
        times = [leg.initialisations for leg in legs]
        cells = (
            f"{sum(leg.result == 'arrived' for leg in legs)} of {len(legs)}",
            f"{100.0 * np.median(passed):.1f}" if len(passed) else UNKNOWN,
            f"{100.0 * passed.max():.1f}" if len(passed) else UNKNOWN,
            f"{100.0 * np.median(across):.1f}" if len(across) else UNKNOWN,
            f"{np.mean(times):.1f}" if times else UNKNOWN,
        )
        rows.append((f"leg {k + 1}", cells))
    return (TextTable("legs", "The legs", "leg", _LEG_TABLE, tuple(rows)),) if rows else ()


# --------------------------------------------------------------------------------------------
# Files, pictures, figures

_LEG_COLUMNS = (
    "seed", "leg", "result", "began_s", "ended_s", "initialisations", "remaining",
    "pass_distance_m", "cross_track_m", "reason",
)  # fmt: skip
_COMMAND_COLUMNS = (
    "seed", "time", "target", "state", "heading_deg", "sigma_heading_deg", "remaining",
    "sigma_remaining", "rotation_deg", "speed_mps", "turn_deg_s", "overridden", "reason",
)  # fmt: skip
_TRAJECTORY_COLUMNS = ("seed", "time", "x_m", "y_m", "heading_deg", "target")


def _leg_rows(driven: Sequence[DrivenSeed]) -> Iterator[tuple[Any, ...]]:
    for one in driven:
        passed, across = pass_distances(one.record), cross_track(one.record)
        for leg in one.record.legs:
            k = leg.target
            errors = (passed[k], across[k]) if k < len(passed) else (None, None)
            ended = leg.result, leg.began, leg.ended, leg.initialisations, leg.remaining
            yield one.seed, k + 1, *ended, *errors, leg.reason


def _command_rows(driven: Sequence[DrivenSeed]) -> Iterator[tuple[Any, ...]]:
    for one in driven:
        r = one.record
        with np.errstate(invalid="ignore"):
            sigma = np.sqrt(np.diagonal(r.covariance, axis1=1, axis2=2))
        heading, sigma_heading = np.rad2deg(r.heading), np.rad2deg(sigma[:, 1])
        rotation, turn = np.rad2deg(r.rotation), np.rad2deg(r.turn_rate)
        columns = (
            r.time, r.target + 1, r.state, heading, sigma_heading, r.remaining, sigma[:, 0],
            rotation, r.speed, turn, r.overridden, r.reason,
        )  # fmt: skip
        yield from ((one.seed, *row) for row in zip(*columns, strict=True))


def _pose_rows(driven: Sequence[DrivenSeed]) -> Iterator[tuple[Any, ...]]:
    for one in driven:
        r = one.record
        columns = r.time, *r.truth[:, :2].T, np.rad2deg(r.truth[:, 2]), r.target + 1
        yield from ((one.seed, *row) for row in zip(*columns, strict=True))


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


def draw_leg_views(folder: Path, seed: int, views: Sequence[LegView]) -> tuple[Picture, ...]:
    """A picture for each view. Raises OutputError."""
    from fgslam.report.overlays import draw_view_tracks

    pictures = []
    for one in views:
        name = f"leg_{one.target + 1:02d}.png"
        caption = f"Seed {seed}, leg {one.target + 1}, {one.caption}"
        draw = partial(draw_view_tracks, view=one.view, trails=one.trails, title=caption)
        pictures.append(draw_picture(folder, name, caption, draw))
    return tuple(pictures)


def drive_of(record: DriveRecord, outlines: Sequence[FloatArray] = ()) -> Drive:
    """What the figure of the drive shows; headings are those of the estimator, in the world.

    There is none while the robot stands or drives blind: its command's heading means nothing then.
    """
    known = np.array([state == HomingState.DRIVE.value for state in record.state], np.bool_)
    headings = np.where(known, wrap(record.truth[:, 2] + record.heading), np.nan)
    return Drive(
        record.time, record.truth, record.target, headings, record.targets, tuple(outlines)
    )


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
    lines = [
        Line(f"seed {one.seed}", k, one.record.time, one.record.remaining)
        for k, one in enumerate(driven[: config.output.logs] or driven[:1])
    ]
    about = "As the robot believes it; each leg begins at 1."
    yield curve_figure(
        ("remaining", "Part of the leg that is left", about),
        lines,
        ("time (s)", "left (legs)"),
        y={"rangemode": "tozero"},
    )
    if config.start_offset_m > 0.0 and len(driven) > 1:
        records = {one.seed: one.record for one in driven if one.record.legs}
        offsets = [between(r.targets[0], r.truth[0])[:2] for r in records.values()]
        arrived = [  # by what the robot reports, and in truth
            r.legs[0].result == "arrived" and bool(pass_distances(r)[0] <= ARRIVED_M)
            for r in records.values()
        ]
        reasons = [f"seed {seed}: {r.legs[0].reason}" for seed, r in records.items()]
        yield catchment_figure(np.array(offsets).reshape(-1, 2), np.array(arrived), reasons)


# ------------------------------------------------------------------------------------------
# Task `omni_video`: points tracked through a mirror camera's recording

SAVE_EVERY_S = 2.0
_STATE = "state"
# New points are added where fewer than the first are left, up to the second.
_POINTS = (110, 160)


@dataclass(slots=True, eq=False)
class _Tracks:
    """What is recorded, frame by frame (rows of frames.csv) and point by point; kept in units.

    ``tracker`` is the tracker's state after the last frame, to go on from.
    """

    frames: list[tuple[str, float, int, int, int]] = field(default_factory=list)
    first: dict[int, int] = field(default_factory=dict)
    last: dict[int, int] = field(default_factory=dict)
    track_ms: list[float] = field(default_factory=list)
    read_ms: list[float] = field(default_factory=list)
    trails: dict[int, FloatArray] = field(default_factory=dict)
    pictures: list[Picture] = field(default_factory=list)
    tracker: StateArrays = field(default_factory=dict)


def open_video(config: OmniVideoConfig, opening: Opening) -> Task[RunResult]:
    """Opens the recording and checks its mirror. Raises DatasetError."""
    recording = open_checked(config.dataset)
    return Task(provenance_of(recording), lambda context: _run_video(config, recording, context))


def _run_video(config: OmniVideoConfig, recording: OmniRecording, context: Context) -> RunResult:
    """Tracks from the first frame, or after the last saved one, to the last.

    Stopped early, the frames so far count.
    """
    make_kernels(context.progress)
    folder = context.folder
    tracker = ReplenishedTracker(recording.camera, *_POINTS)
    tracks = _Tracks()
    if saved := context.store.load(_STATE, _Tracks).get(0):
        tracks = saved
        restore(tracker, saved.tracker)

    def save() -> None:
        tracks.tracker = state_of(tracker)
        context.store.add(_STATE, {0: tracks}, _Tracks)

    shown = np.linspace(0, len(recording), config.output.pictures + 1).astype(int)[1:] - 1
    last_saved = perf_counter()
    for i in context.steps("tracking", range(len(tracks.frames), len(recording))):
        if perf_counter() - last_saved >= SAVE_EVERY_S:
            save()
            last_saved = perf_counter()
        _take(tracks, tracker, recording, i)
        if i in shown:
            tracks.pictures.append(_draw(tracks, tracker, recording, folder))
    if len(tracks.frames) < len(recording):
        save()
    write_csv(folder / "frames.csv", ("frame", "time", "points", "added", "lost"), tracks.frames)
    rows = [(i, first, tracks.last[i]) for i, first in sorted(tracks.first.items())]
    write_csv(folder / "tracks.csv", ("id", "first_frame", "last_frame"), rows)
    numbers = _numbers(tracks)
    names = {
        "frames": "frames",
        "points a frame, median": "points_median",
        "points a frame, least": "points_least",
        "tracks": "tracks",
        "life of a track, median, frames": "track_life_median_frames",
        "the same of those that ended": "ended_track_life_median_frames",
        "frames a second, unwrapping and tracking": "frames_a_second",
    }
    frames = np.arange(len(tracks.frames), dtype=np.float64)
    counts = np.array([frame[2] for frame in tracks.frames], np.float64)
    words = ("points", "Points followed", "In each frame, new ones included.")
    figure = curve_figure(
        words, [Line("points", 0, frames, counts)], ("frame", "points"), y={"rangemode": "tozero"}
    )
    sentence = (
        f"{len(counts)} frames: {numbers['points_median']} points in each (median), each followed "
        f"through {numbers['track_life_median_frames']} frames (median)."
    )
    return finish(
        config,
        folder,
        len(tracks.frames) == len(recording),
        numbers,
        f"{len(tracks.frames)} frames of {recording.name}",
        (figure,),
        tracks.pictures,
        lines=(sentence if len(counts) else "No frame was tracked.",),
        tables=(numbers_table("video", "The tracks", numbers, names),),
        notes=recording.notes,
    )


def _take(tracks: _Tracks, tracker: ReplenishedTracker, recording: OmniRecording, i: int) -> None:
    """Tracks into frame i and records it."""
    start = perf_counter()
    image = recording.image(i)
    read = perf_counter()
    stamp = float(recording.timestamps[i])
    time = stamp if np.isfinite(stamp) else float(i)
    found = tracker.take(image, time)
    tracks.track_ms.append(1e3 * (perf_counter() - read))
    tracks.read_ms.append(1e3 * (read - start))
    ids = found.tracked.ids.tolist()
    lost = (tracks.frames[-1][2] if tracks.frames else 0) - found.survivors
    tracks.frames.append((recording.names[i], time, len(ids), len(found.added), lost))
    for identity in ids:
        tracks.first.setdefault(identity, i)
        tracks.last[identity] = i
    tracks.trails = trails_after(tracks.trails, ids, tracker.pixels())


def _draw(
    tracks: _Tracks, tracker: ReplenishedTracker, recording: OmniRecording, folder: Path
) -> Picture:
    """The last frame with the paths of its points."""
    from fgslam.report.overlays import draw_view_tracks

    i = len(tracks.frames) - 1
    name, _, points, added, _ = tracks.frames[i]
    caption = f"{name}: {points} points, {added} of them new"
    view, trails = tracker.view(recording.image(i)), list(tracks.trails.values())
    draw = partial(draw_view_tracks, view=view, trails=trails, title=caption)
    return draw_picture(folder, f"tracks_{i:06d}.png", caption, draw)


def _numbers(tracks: _Tracks) -> dict[str, JsonValue]:
    lives = np.array([tracks.last[i] - first + 1 for i, first in tracks.first.items()], np.int64)
    counts = np.array([frame[2] for frame in tracks.frames])
    last = len(tracks.frames) - 1
    ended = np.array([tracks.last[i] < last for i in tracks.first], np.bool_)
    spent = float(np.sum(tracks.track_ms))
    return {
        "frames": len(tracks.frames),
        "points_median": median(counts),
        "points_least": int(counts.min()) if len(counts) else None,
        "tracks": len(lives),
        "track_life_median_frames": median(lives),
        "ended_track_life_median_frames": median(lives[ended]),
        "alive_at_the_end": int(np.count_nonzero(~ended)),
        "frames_a_second": 1e3 * len(tracks.frames) / spent if spent else None,
        "track_ms": spread(np.array(tracks.track_ms)),
        "read_ms": spread(np.array(tracks.read_ms)),
    }
