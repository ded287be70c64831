"""Truth about landmarks from rendered depth: where they truly are, and which are in view."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.estimates import LandmarkMap
from fgslam.core.geometry import transform_to_world
from fgslam.core.measurement_log import MeasurementLog
from fgslam.core.recordings import LandmarkTruth, Sequence
from fgslam.core.saved_map import SavedMap
from fgslam.core.sensors import CameraRig
from fgslam.frontend.settings import FrontendSettings
from fgslam.frontend.tracking.database import LandmarkDatabase

_LEAST_SIGHTINGS = 3
_SAME_SURFACE = 0.03
"""Relative spread of the four depths around a pixel that one surface may have."""

_NORMAL_MAD = 1.4826  # median absolute deviation to standard deviation, normal distribution
_MEDIAN_TO_MEAN = 1.2533  # standard error of a median over that of the mean


@runtime_checkable
class TrueDepth(Protocol):
    """A recording whose exact depth is known."""

    def depth(self, i: int) -> FloatArray:
        """Depth (height, width) of the reference image of frame ``i``, metres."""
        ...


def rendered_landmark_truth(
    sequence: Sequence, log: MeasurementLog
) -> tuple[LandmarkTruth, FloatArray] | None:
    """Where the landmarks truly are: the median of the world points under their pixels.

    Each sighting that the run did not reject gives the point where the ray of its pixel meets the
    rendered surface. The truth has an error of its own: a feature's pixel is known to a fraction
    of a pixel only, and at a curved or slanted surface the blob that is matched is no point.

    Args:
        sequence: the recording; frame k is the log's.
        log: the run's measurements.

    Returns:
        Positions in the world of the ground truth, and the standard error (n,) of each in metres,
        from the scatter of its sightings; landmarks with fewer than three are left out. None
        where the recording knows no depth.
    """
    truth = sequence.ground_truth
    if not isinstance(sequence, TrueDepth) or truth is None:
        return None
    ids: list[IntArray] = [np.empty(0, np.int64)]
    points: list[FloatArray] = [np.empty((0, 3))]
    for k, increment in enumerate(log):
        seen = increment.observations.select(~increment.rejected)
        if not len(seen):
            continue
        local, known = points_under(sequence.rig, sequence.depth(k), seen.measurement[:, :2])
        ids.append(seen.ids[known])
        points.append(transform_to_world(truth.poses[k], local[known]))
    return _medians(np.concatenate(ids), np.concatenate(points))


def points_under(
    rig: CameraRig, depth: FloatArray, pixels: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Points (n, 3) of the camera's frame under sub-pixel places (n, 2), and which are known.

    The inverse depth is interpolated, which is exact on a plane; at an edge of depth, where the
    four pixels around do not belong to one surface, the point is not known (NaN).
    """
    low = np.floor(pixels).astype(np.int64)
    height, width = depth.shape
    inside = np.all((low >= 0) & (low < [width - 1, height - 1]), axis=1)
    column, row = np.where(inside[:, None], low, 0).T
    around = np.stack([depth[row + dr, column + dc] for dr in (0, 1) for dc in (0, 1)], axis=1)
    spread = around.max(axis=1) - around.min(axis=1)
    # False where a depth is not known.
    known = np.asarray(inside & (spread <= _SAME_SURFACE * around.min(axis=1)))
    right, below = (pixels - low).T
    weights = np.stack(
        [(1 - below) * (1 - right), (1 - below) * right, below * (1 - right), below * right], axis=1
    )
    z = np.full(len(pixels), np.nan)
    z[known] = 1.0 / (weights[known] / around[known]).sum(axis=1)
    x, y = (pixels[:, 0] - rig.cx) / rig.fx, (pixels[:, 1] - rig.cy) / rig.fy
    return np.column_stack([x * z, y * z, z]), known


def _medians(ids: IntArray, points: FloatArray) -> tuple[LandmarkTruth, FloatArray]:
    """Median and its standard error of each landmark's points, those seen often enough."""
    order = np.argsort(ids, kind="stable")
    unique, start = np.unique(ids[order], return_index=True)
    groups = np.split(points[order], start[1:])
    kept = [k for k, group in enumerate(groups) if len(group) >= _LEAST_SIGHTINGS]
    medians = np.array([np.median(groups[k], axis=0) for k in kept]).reshape(-1, 3)
    sigma = [_standard_error(groups[k], median) for k, median in zip(kept, medians, strict=True)]
    return LandmarkTruth(unique[kept], medians), np.array(sigma)


def _standard_error(points: FloatArray, median: FloatArray) -> float:
    """Of the median of points (n, 3), as a distance, robustly from their scatter."""
    deviation = _NORMAL_MAD * np.median(np.abs(points - median), axis=0)
    return float(_MEDIAN_TO_MEAN * np.linalg.norm(deviation) / np.sqrt(len(points)))


_BEHIND = 1.05  # times the rendered depth, plus the next: what is farther off is hidden
_BEHIND_M = 0.05


@dataclass(frozen=True, slots=True)
class Sighted:
    """How many landmarks are truly in view of a pose; -1 where that is not known.

    Attributes:
        visible: in all images, not too near and not too small for the rig, and not hidden.
        familiar: of these, seen from a direction from which they were seen before.
    """

    visible: int = -1
    familiar: int = -1


class TrueSights:
    """Counts the landmarks in view of true poses, by the database's own expectation."""

    def __init__(
        self,
        saved: SavedMap,
        landmarks: LandmarkMap,
        sequence: Sequence,
        frontend: FrontendSettings,
    ) -> None:
        """Of ``landmarks``, those of the map that count; of a recording without depth nothing."""
        self._sequence = sequence if isinstance(sequence, TrueDepth) else None
        self._landmarks = landmarks
        self._rig = sequence.rig
        self._database: LandmarkDatabase | None = None
        if self._sequence is not None:
            largest = frontend.stereo.max_disparity_px
            self._database = LandmarkDatabase(sequence.rig, frontend.database, largest)
            self._database.load(saved)

    def of(self, i: int, wTc: FloatArray) -> Sighted:
        """In the selected frame ``i``, whose true pose in the map's world is ``wTc``."""
        if self._sequence is None or self._database is None or not np.isfinite(wTc).all():
            return Sighted()
        rig, depth = self._rig, self._sequence.depth(i)
        expected = self._database.expected(self._landmarks, wTc)
        column, row, disparity = expected.measurement.T
        rise = 0.0
        if rig.vertical_baseline is not None:
            rise = disparity * (rig.fy * rig.vertical_baseline) / (rig.fx * rig.baseline)
        inside = (column >= 0.0) & (column + disparity <= rig.width - 1.0)
        inside &= (row >= 0.0) & (row + rise <= rig.height - 1.0)
        at = np.rint(np.column_stack([row, column])[inside]).astype(np.int64)
        near = depth[at[:, 0], at[:, 1]]
        shown = rig.fx * rig.baseline / disparity[inside] <= _BEHIND * near + _BEHIND_M
        familiar = shown & expected.certain[inside]
        return Sighted(int(shown.sum()), int(familiar.sum()))
