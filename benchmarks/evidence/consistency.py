"""Joint filters by their errors, as Zhang et al. (2017) set them side by side: NEES over worlds.

The same drives with the pose's errors and the landmarks' apart (`SO(3)`), with those of the `ekf`,
with derivatives at first estimates (Huang, Mourikis and Roumeliotis 2010), and right-invariant.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from benchmarks.evidence.honesty import Drive
from benchmarks.runs import say
from benchmarks.tables import Cell, Table
from fgslam.backend.filters.ekf import Correction, FullEkf, Matches, PoseMeasurement
from fgslam.backend.filters.invariant_ekf import InvariantEkf
from fgslam.backend.settings import EkfSettings
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.geometry import adjoint, inverse, moved_apart
from fgslam.core.sensors import CameraRig, Increment, Observations
from fgslam.core.types import Floor, Prediction

_TURNS = (
    "dataset.drive.path=sharp_turns", "dataset.drive.turn_deg_per_frame=15",
    "dataset.detection.features=40", "dataset.stop=120",
)  # fmt: skip
WORLDS = {
    "planar": _TURNS,
    "stereo": (*_TURNS, "frontend.ego_motion.dof=6", "dataset.rig.vertical_baseline_m=null"),
}
"""Spins and tight bends, on a floor with three cameras, and in space with two; 10 cm apart."""


class PlainEkf(FullEkf):
    """Errors of rotation, position and landmarks each by itself, in the world's axes."""

    def _retracted(
        self, wTc: FloatArray, positions: FloatArray, step: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        _, moved = super()._retracted(wTc, positions, step)
        return self._floor.constrain(moved_apart(wTc, step[:6])), moved

    def _change(self, wTc: FloatArray, moved: FloatArray) -> FloatArray:
        turned = np.eye(4)
        turned[:3, :3] = moved[:3, :3].T @ wTc[:3, :3]
        return adjoint(turned)

    def _carry_errors(self, wTc: FloatArray, moved: FloatArray, positions: FloatArray) -> None:
        change, front = self._change(wTc, moved), self._covariance.front()
        front = front @ change.T
        front[:6] = change @ front[:6]
        self._covariance.set_front(front)


class FirstEstimateEkf(PlainEkf):
    """Derivatives at predicted poses, from prediction to prediction, and at first positions."""

    def __init__(
        self, sensor: CameraRig, settings: EkfSettings, floor: Floor, prior: Prediction
    ) -> None:
        super().__init__(sensor, settings, floor, prior)
        self._first: dict[int, FloatArray] = {}

    def _change(self, wTc: FloatArray, moved: FloatArray) -> FloatArray:
        return adjoint(inverse(moved) @ wTc)

    def _correction(
        self, increment: Increment, seen: Observations, wTc: FloatArray, front: FloatArray
    ) -> Correction:
        seen = seen.select(np.isin(seen.ids, self._ids))
        blocks = self._blocks(seen.ids)
        first = np.array([self._first[one] for one in seen.ids.tolist()]).reshape(-1, 3)
        at_first = Matches.of(self._sensor, wTc, blocks, first, seen)
        now = Matches.of(self._sensor, wTc, blocks, self._positions[blocks], seen)
        matches = replace(at_first, innovation=now.innovation)
        floor = PoseMeasurement.of_floor(self._floor, wTc)
        return self._corrected(increment.index, front, matches, floor)

    def _add(self, ids: IntArray, points: FloatArray, covariances: FloatArray) -> None:
        super()._add(ids, points, covariances)
        self._first |= zip(ids.tolist(), self._positions[len(self._ids) - len(ids) :], strict=True)


FILTERS: dict[str, Callable[..., FullEkf]] = {
    "SO(3)": PlainEkf,
    "`ekf`": FullEkf,
    "first estimates": FirstEstimateEkf,
    "`invariant_ekf`": InvariantEkf,
}


def tables(seeds: Sequence[int] = range(50)) -> list[Table]:
    """Means over paired drives, a row a world and filter."""
    rows: list[tuple[Cell, ...]] = []
    for world, overrides in WORLDS.items():
        found: dict[str, list[tuple[float, ...]]] = {name: [] for name in FILTERS}
        for seed in seeds:
            say(f"{world}: drive {seed}")
            drive = Drive.of(seed, *overrides)
            rig = drive.recording.log.rig
            floor = Floor.under(rig, drive.ego_motion.dof)
            for name, make in FILTERS.items():
                prior = Prediction(np.eye(4), np.zeros((6, 6)))
                one = drive.judged(make(rig, EkfSettings(), floor, prior))
                found[name].append((one.final, one.landmarks, one.ate_cm))
        for name, numbers in found.items():
            mean, spread = np.mean(numbers, axis=0), np.std(numbers, axis=0, ddof=1)
            interval = 2.0 * spread[0] / np.sqrt(len(numbers))
            rows.append((world, name, float(mean[0]), float(interval), *map(float, mean[1:])))
    return [Table(f"Joint filters by their errors, {len(seeds)} drives each", _COLUMNS, rows)]


_COLUMNS = ("world", "errors", "NEES pose", "+-", "NEES landmarks", "ATE cm")
