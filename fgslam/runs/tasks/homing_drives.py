"""Tasks `homing` and `path_following`: closed loop in a simulated world, over seeds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np

from fgslam.backend.homing.factory import make_homing_estimator
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import OutputError
from fgslam.datasets.simulated_homing import open_house
from fgslam.homing.closed_loop import Driver, World, follow
from fgslam.homing.front_end import HomingFrontEnd, make_front_end
from fgslam.homing.path_following import HomingChain
from fgslam.homing.path_memory import PathMemory
from fgslam.homing.settings import FrontEndSettings
from fgslam.homing.steering import Steering, make_avoider
from fgslam.runs.config_models import DrivingConfig
from fgslam.runs.engine import Context, Opening, RunResult, Status, Task
from fgslam.runs.tasks.homing_drive_files import DrivenSeed
from fgslam.runs.tasks.homing_drive_pictures import DriveWatcher, Unwrapping
from fgslam.runs.tasks.homing_drive_results import finish_drives
from fgslam.runs.units import each_apart

_TRIES = 50  # places drawn for a start that is free


class PathWorld(World, Protocol):
    """A world with a path in it: target images, where they were taken, and walls to draw."""

    @property
    def targets(self) -> Sequence[Image]:
        """Target images, in order."""
        ...

    @property
    def target_poses(self) -> FloatArray:
        """(m, 3) where they were taken."""
        ...

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


Opened: TypeAlias = tuple[PathWorld, HomingFrontEnd]
Opener: TypeAlias = Callable[[DrivingConfig, int], Opened]
"""Opens the world of one seed, and makes the front-end for it; of a module's top level."""


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
    world = open_house(config.dataset, seed)
    settings = FrontEndSettings(config.features, config.homing_vector, config.wrong_matches)
    return world, make_front_end(world.camera, settings, seed)


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
    world, front_end = task.opener(config, task.seed)
    if config.start_offset_m > 0.0:
        world.put(_displaced(world, config.start_offset_m, np.random.default_rng((task.seed, 7))))
    memory = PathMemory.of([front_end.describe(image) for image in world.targets])
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
    record = follow(world, follower, driver, behaviour.loop, world.target_poses, watcher)
    leg = float(np.hypot(*(world.target_poses[0, :2] - start[:2])))
    views = () if watcher is None else watcher.views(shown)
    return DrivenSeed(task.seed, record, memory, tuple(world.outlines), leg, views)


def _displaced(world: PathWorld, radius: float, rng: np.random.Generator) -> FloatArray:
    """The start, moved and turned at random to a place that is free; itself where none is found."""
    pose = np.array(world.true_pose, np.float64)
    room = float(world.clearance(pose[None, :2])[0])
    for _ in range(_TRIES):
        distance, angle = radius * np.sqrt(rng.random()), rng.uniform(-np.pi, np.pi)
        place = pose[:2] + distance * np.array([np.cos(angle), np.sin(angle)])
        if world.clearance(place[None])[0] >= min(room, 0.5):
            return np.array([*place, rng.uniform(-np.pi, np.pi)])
    return pose
