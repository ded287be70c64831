"""Tasks `homing` and `path_following`: closed loop in a simulated world, over seeds."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeAlias

import numpy as np

from fgslam.backend.homing.factory import make_homing_estimator
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import OutputError
from fgslam.homing.avoidance import make_avoider
from fgslam.homing.closed_loop import Driver, World, follow
from fgslam.homing.front_end import HomingFrontEnd
from fgslam.homing.path_following import HomingChain
from fgslam.homing.path_memory import PathMemory
from fgslam.homing.steering import Steering
from fgslam.runs.config_models import DrivingConfig
from fgslam.runs.folder import ExistingFolder
from fgslam.runs.homing_results import HomingResult, Progress, Status, Stopped, begin, jobs_of
from fgslam.runs.processes import WorkerEnded, run_apart
from fgslam.runs.tasks.homing_drive_pictures import DriveWatcher, Unwrapping
from fgslam.runs.tasks.homing_drive_results import finish_drives
from fgslam.runs.tasks.homing_driven import DrivenSeed

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


def run_driving(
    config: DrivingConfig,
    folder: Path,
    existing: ExistingFolder,
    progress: Progress,
    stopped: Stopped,
    opener: Opener,
) -> HomingResult:
    """Drives the path once for each seed; stopped early, the drives that are done count."""
    begin(config, folder, existing, {"dataset": {"name": config.dataset.kind}})
    tasks = [DriveTask(config, config.seed + k, opener) for k in range(config.trials)]
    driven: list[DrivenSeed] = []
    failures: list[str] = []
    progress("drives", 0, len(tasks))
    for _, result in run_apart(perform_drive, tasks, jobs_of(config), stopped, True):
        if isinstance(result, WorkerEnded):
            failures.append(f"seed {result.argument.seed}: {result.why}")
        else:
            driven.append(result)
        progress("drives", len(driven) + len(failures), len(tasks))
    if not driven and not stopped():
        raise OutputError(f"no drive was finished; {failures[0]}")
    driven.sort(key=lambda one: one.seed)
    status: Status = "finished" if len(driven) == len(tasks) else "interrupted"
    return finish_drives(config, folder, status, driven, sorted(failures))


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
        behaviour.path,
    )
    driver = Driver(Steering(behaviour.steering), make_avoider(behaviour.avoidance))
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


def with_one_leg(config: DrivingConfig) -> DrivingConfig:
    """The same with a path of one leg: a single homing."""
    path = dataclasses.replace(config.dataset.path, legs=1)
    return config.model_copy(update={"dataset": dataclasses.replace(config.dataset, path=path)})
