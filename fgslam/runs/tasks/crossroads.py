"""Task `crossroads`: routes taught on their own are joined, and a way over both of them is driven.

In the rendered house two routes meet in the corridor. The way leads from where the one begins to
where the other ends, or back. The robot knows neither: an image of where it stands finds it.

Units, files and numbers: those of `path_following`.
"""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import StoredMapError
from fgslam.homing.api import teach
from fgslam.homing.route import PathMemory
from fgslam.homing.topological_map import RouteMap
from fgslam.runs.config_models import CrossroadsConfig
from fgslam.runs.engine import Opening, RunResult, Task
from fgslam.runs.tasks.homing_drives import Opened, drives_task, open_house_front_end

if TYPE_CHECKING:
    from fgslam.datasets.opening import OmniWorld

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
