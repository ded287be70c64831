"""Measurement logs, bearing logs, maps, routes and their maps: archives of arrays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np

import fgslam as fg
from fgslam.core.bearings import BearingLog, HomingStart, TwoViewVector
from fgslam.core.log import MeasurementLog
from fgslam.core.sensors import CameraRig, Increment, Observations, Odometry
from fgslam.core.store import pack, write_arrays
from fgslam.frontend.homing.two_view import make_local_map
from fgslam.frontend.homing.vector import estimate_homing_vector
from fgslam.frontend.settings import HomingVectorSettings
from fgslam.homing.route import MetricPoses
from fgslam.worlds.settings import SimulatedBearingsSettings
from fgslam.worlds.simulated_bearings import simulate_homing
from scripts.fuzz.damage import Arrays, Rng, damaged_arrays, damaged_bytes, written


@dataclass(frozen=True)
class Archive:
    """A sort of archive.

    Attributes:
        suffix: of its files.
        make: an undamaged one, as an object with ``save``.
        load: what reads a file.
        contents: the arrays of what was read.
    """

    suffix: str
    make: Callable[[], Any]
    load: Callable[[Path], Any]
    contents: Callable[[Any], Arrays]

    @cached_property
    def whole(self) -> bytes:
        """An undamaged file."""
        with TemporaryDirectory(prefix="fgslam-fuzz-") as scratch:
            path = Path(scratch) / f"whole{self.suffix}"
            self.make().save(path)
            return path.read_bytes()

    @cached_property
    def arrays(self) -> Arrays:
        """The arrays of the undamaged file."""
        with TemporaryDirectory(prefix="fgslam-fuzz-") as scratch:
            path = written(Path(scratch) / f"whole{self.suffix}", self.whole)
            with np.load(path) as archive:
                return dict(archive)

    @cached_property
    def _same(self) -> dict[str, bytes]:
        with TemporaryDirectory(prefix="fgslam-fuzz-") as scratch:
            path = written(Path(scratch) / f"whole{self.suffix}", self.whole)
            return _bits(self.contents(self.load(path)))

    def of_damaged_bytes(self, rng: Rng, folder: Path) -> Path:
        """A file with some bytes changed."""
        return written(folder / f"bytes{self.suffix}", damaged_bytes(rng, self.whole))

    def of_odd_values(self, rng: Rng, folder: Path) -> Path:
        """A whole archive with one array changed in type, shape or value."""
        path = folder / f"values{self.suffix}"
        write_arrays(path, damaged_arrays(rng, self.arrays))
        return path

    def is_same(self, found: Any) -> bool:
        """Whether what was read is the undamaged one to the bit."""
        return _bits(self.contents(found)) == self._same


def _bits(arrays: Arrays) -> dict[str, bytes]:
    return {name: array.tobytes() for name, array in arrays.items()}


def _measurement_log() -> MeasurementLog:
    rng = np.random.default_rng(3)
    rig = CameraRig(320, 240, 200.0, 200.0, 159.5, 119.5, 0.1, None, np.eye(4))
    log = MeasurementLog(rig, {"kind": "recorded"})
    for k in range(4):
        seen = Observations(
            np.arange(10 * k, 10 * k + 5),
            rng.uniform(1.0, 100.0, (5, 3)),
            np.tile(np.eye(3), (5, 1, 1)),
            np.full((5, 3, 2), np.nan),
            np.ones(5, bool),
        )
        empty = np.zeros(0, np.int64)
        odometry = Odometry(np.eye(4), np.eye(6)) if k else None
        log.append(Increment(k, 0.1 * k, odometry, seen, np.zeros(5, bool), empty, empty))
    return log


def _bearing_log() -> BearingLog:
    rng = np.random.default_rng(3)
    simulated = simulate_homing(SimulatedBearingsSettings(), rng)
    vector = estimate_homing_vector(simulated.matches, HomingVectorSettings(), rng)
    if not isinstance(vector, TwoViewVector):
        raise TypeError(vector)
    distance = make_local_map(vector, simulated.matches).distance
    rows = np.flatnonzero(vector.inliers & np.isfinite(distance) & (distance > 0.0))
    matches = simulated.matches.select(rows)
    start = HomingStart(simulated.time, vector, make_local_map(vector, matches), matches)
    tracks, truth = simulated.followed(rows)
    return BearingLog(start, list(tracks), truth, {"kind": "simulated"})


def _map() -> fg.Map:
    recording = fg.rendered_recording("lab", frames=3)
    slam = fg.Slam(recording.rig)
    for t, images, odometry in recording:
        slam.track(t, images, odometry)
    return slam.result().map


def _route() -> fg.PathMemory:
    """Four views of one scene of noise, a step apart, with poses."""
    rng = np.random.default_rng(3)
    camera = fg.load_camera("equirectangular", (256, 128))
    scene = cv2.GaussianBlur(rng.integers(0, 255, (128, 256, 3), np.uint8), (5, 5), 0)
    views = [np.roll(scene, 4 * k, axis=1) for k in range(4)]
    metric = MetricPoses(np.tile(np.eye(4), (4, 1, 1)), np.tile(0.01 * np.eye(6), (4, 1, 1)))
    return replace(fg.teach(views, camera), metric=metric)


def _route_map() -> fg.RouteMap:
    route = replace(_route(), metric=None)
    return fg.RouteMap.join({"one": route, "other": route})


def _saved(found: fg.Map | fg.PathMemory | fg.RouteMap) -> Arrays:
    with TemporaryDirectory(prefix="fgslam-fuzz-") as scratch:
        path = Path(scratch) / "again.fgmap"
        found.save(path)
        with np.load(path) as archive:
            return dict(archive)


MEASUREMENTS = Archive(".npz", _measurement_log, MeasurementLog.load, pack)
BEARINGS = Archive(".npz", _bearing_log, BearingLog.load, pack)
MAP = Archive(".fgmap", _map, fg.Map.load, _saved)
ROUTE = Archive(".fgpath", _route, fg.PathMemory.load, _saved)
ROUTE_MAP = Archive(".fgmap", _route_map, fg.RouteMap.load, _saved)
