"""Tasks `homing` and `path_following`: closed loop in a simulated world, over seeds.

Units: drives, one a seed. Files: legs.csv, commands.csv, trajectory.csv, logs, path_memory.npz,
metrics.json, views of the legs, the page. Numbers: arrivals, distances to the targets and across
the way, and whether these grow from leg to leg.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, runtime_checkable

import numpy as np

from fgslam.backend.homing.estimators import make_homing_estimator
from fgslam.core.arrays import ByteArray, FloatArray
from fgslam.core.errors import OutputError
from fgslam.core.files import make_subfolder
from fgslam.core.homing import TrackedBearings
from fgslam.core.planar import between
from fgslam.datasets.opening import open_house
from fgslam.homing.active import ActiveHoming
from fgslam.homing.api import teach
from fgslam.homing.closed_loop import (
    ARRIVED_M,
    Driver,
    DriveRecord,
    World,
    follow,
    pass_distances,
)
from fgslam.homing.controller import HomingChain
from fgslam.homing.front_end import HomingFrontEnd, ImageFrontEnd, make_front_end
from fgslam.homing.route import PathMemory
from fgslam.homing.settings import FrontEndSettings
from fgslam.homing.steering import Command, Steering, make_avoider
from fgslam.report.content import Figure, Picture
from fgslam.report.homing_figures import (
    Line,
    catchment_figure,
    curve_figure,
    drive_figure,
    local_map_figure,
)
from fgslam.runs.config_models import DrivingConfig
from fgslam.runs.engine import Context, Opening, RunResult, Status, Task, write_document, write_page
from fgslam.runs.homing_comparison import replay_homing
from fgslam.runs.tasks.homing_drive_results import (
    bearing_log,
    drive_numbers,
    drive_of,
    drive_sentences,
    leg_tables,
    write_drive,
    write_legs,
    write_logs,
)
from fgslam.runs.units import each_apart

if TYPE_CHECKING:
    from fgslam.datasets.opening import OmniWorld

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
