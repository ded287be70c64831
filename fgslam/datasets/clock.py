"""Odometry's clock, unit and axes against what the images show of the turns, without any truth.

The camera's rotation between two frames needs no depth and no map: two images say it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np

from fgslam.core.arrays import FloatArray, Image, IntArray
from fgslam.core.errors import FrameError, OdometryError
from fgslam.core.geometry import so3_log
from fgslam.core.sensors import CameraRig, Odometry
from fgslam.datasets.odometry import OdometrySource
from fgslam.datasets.recording import Recording

_STEPS = 60  # those in which the turn changes most: a steady one states nothing of the clock
_FEWEST_STEPS = 15
_FEATURES, _RATIO, _FEWEST_MATCHES = 1000, 0.8, 20
_INLIER_PX = 2.0
_RANGE_S = 0.24
_COARSE_S, _FINE_S = 0.04, 0.005
_LEAST_SHIFT_S = 0.01
_CLEAR_GAIN = 0.7
"""By which the median error must fall: as where truth shows the clock."""
_BY_CHANCE = 1e-3
_LEAST_TURN_RAD, _CLEAR_TURN_RAD = np.radians(0.1), np.radians(1.0)
"""Median turn of a step from which its unit can be judged, and its axes."""
_DEGREES = np.degrees(1.0)
_LIKE_DEGREES = 2.0  # factor about 57.3 within which a scale means them
_AGREES = 0.5
"""Largest median error, of the median turn, at which axes and unit count as right."""


@dataclass(frozen=True, slots=True)
class Judged:
    """What the images say of the odometry's turns.

    Attributes:
        time_offset_s: to be added to its stamps; 0 where nothing significant is.
        fault: why it cannot be used; empty where it can.
        note: the same, or the offset, in a line; empty where all is well.
    """

    time_offset_s: float = 0.0
    fault: bool = False
    note: str = ""


def judged_turns(recording: Recording) -> Judged:
    """Clock, unit and axes of a recording's odometry by the turns that its images show.

    Nothing is reported of recordings that hardly turn, or whose images do not match.

    Raises:
        OdometryError: the odometry is malformed, or its turns are in degrees.
    """
    source, rig, stamps = recording.odometry_source, recording.rig, recording.timestamps
    if source is None:
        return Judged()
    steps = [recording.odometry(i) for i in range(1, len(recording))]
    # The steps in which the odometry's turn rate changes most.
    rates = _turns(steps) / np.diff(stamps)[:, None]
    change = np.linalg.norm(np.diff(rates, axis=0, prepend=rates[:1]), axis=1)
    change = np.where(np.isfinite(change), change, -1.0)
    chosen = np.argsort(-change, kind="stable")[:_STEPS]
    features: dict[int, FrameFeatures] = {}
    rows, turns = [], []
    for i in (np.sort(chosen[change[chosen] >= 0.0]) + 1).tolist():
        for k in (i - 1, i):
            features[k] = features.get(k) or _features_of(recording, k)
        turn = turn_between(features[i - 1], features[i], rig.matrix)
        features = {i: features[i]}
        if turn is not None:
            rows.append(i)
            turns.append(rig.bTc[:3, :3] @ turn)
    return judged(SeenTurns.of(recording, np.array(rows), np.array(turns)))


def _turns(steps: Sequence[Odometry | None]) -> FloatArray:
    """Rotation vectors (n, 3) of the steps; NaN where there is none."""
    unknown = np.full(3, np.nan)
    return np.array([unknown if s is None else so3_log(s.motion[:3, :3]) for s in steps])


@dataclass(frozen=True, slots=True, eq=False)
class SeenTurns:
    """Turns of the body (k, 3) by the images, in the steps ``rows``; and the odometry."""

    name: str
    rows: IntArray
    turns: FloatArray
    stamps: FloatArray
    source: OdometrySource
    by_gyroscope: bool

    @classmethod
    def of(cls, recording: Recording, rows: IntArray, turns: FloatArray) -> SeenTurns:
        """Turns in those steps of a recording that has odometry."""
        source, steps = recording.odometry_source, map(recording.odometry, range(1, len(recording)))
        assert source is not None  # noqa: S101 - for the type checker
        first = next((step for step in steps if step is not None), None)
        stamps = recording.timestamps
        turned = first is not None and first.turned
        return cls(recording.name, rows, turns, stamps, source, turned)

    def by_odometry(self, shift: float) -> FloatArray:
        """(k, 3) with its stamps later by ``shift`` seconds; NaN where not covered."""
        used = np.unique(np.concatenate([self.rows - 1, self.rows]))
        steps = self.source(self.stamps[used] - shift)
        return _turns([steps[k] for k in np.searchsorted(used, self.rows) - 1])

    def errors(self, shift: float) -> FloatArray:
        """(k,) radians a step, without a gyroscope's bias; NaN where the odometry is unknown."""
        try:
            difference = self.turns - self.by_odometry(shift)
        except OdometryError:  # shifted beyond all frames
            return np.full(len(self.rows), np.nan)
        if not self.by_gyroscope:
            difference = difference[:, 2:]  # wheels measure the heading alone
        else:
            dt = (self.stamps[self.rows] - self.stamps[self.rows - 1])[:, None]
            known = np.isfinite(difference).all(axis=1)
            bias = np.median(difference[known] / dt[known], axis=0) if known.any() else 0.0
            difference = difference - bias * dt
        return np.asarray(np.linalg.norm(difference, axis=1))


def _median(errors: FloatArray) -> float:
    """Infinite where too few are known."""
    known = errors[np.isfinite(errors)]
    return float(np.median(known)) if len(known) >= _FEWEST_STEPS else np.inf


def judged(seen: SeenTurns) -> Judged:
    """The same of turns that were seen already; raises as :func:`judged_turns`."""
    if len(seen.rows) < _FEWEST_STEPS:
        return Judged()
    size = float(np.median(np.linalg.norm(seen.turns, axis=1)))
    best = 0.0  # seconds to be added to the stamps, on a coarse grid, then on a fine one
    for reach, step in ((_RANGE_S, _COARSE_S), (_COARSE_S, _FINE_S)):
        count, middle = round(reach / step), np.inf
        while abs(best - middle) > reach - step:  # the best is at the grid's edge: go on there
            middle = best
            shifts = middle + step * np.arange(-count, count + 1)
            nearest = shifts[np.argsort(np.abs(shifts), kind="stable")]  # of equals the least
            best = float(nearest[int(np.argmin([_median(seen.errors(s)) for s in nearest]))])
    now, then = seen.errors(0.0), seen.errors(best)
    before, left = _median(now), _median(then)
    if size > _LEAST_TURN_RAD:
        # The odometry may turn 57 times as much as the images.
        dt = np.diff(seen.stamps)[seen.rows - 1][:, None]
        rates = (turns / dt for turns in (seen.by_odometry(best), seen.turns))
        # How far they are from their median, which a bias may be.
        odometry, images = (np.linalg.norm(r - np.nanmedian(r, axis=0), axis=1) for r in rates)
        known = np.isfinite(odometry) & (images >= np.median(images))
        scale = float(np.median(odometry[known] / images[known])) if known.any() else 1.0
        if _DEGREES / _LIKE_DEGREES < scale < _DEGREES * _LIKE_DEGREES:
            raise OdometryError(
                f"the odometry of {seen.name} turns {scale:.0f} times as fast as the camera: its "
                "angular velocity is in degrees/s, not radians/s; name the columns so (gyro_x_dps)"
            )
    if size > _CLEAR_TURN_RAD and left > _AGREES * size and seen.by_gyroscope:
        return Judged(
            fault=True,
            note="the gyroscope does not turn as the images do (off by "
            f"{np.degrees(left):.2g} of {np.degrees(size):.2g} degrees a step) and is not used; "
            "give a calibration that states where it sits (T_BS, T_cam_imu), or correct its axes "
            "or its unit, radians/s (where something large moves through most of these images, "
            "they are wrong)",
        )
    if left >= _CLEAR_GAIN * before or abs(best) < _LEAST_SHIFT_S:
        return Judged()
    from scipy.stats import wilcoxon  # half a second to load

    # Whether errors fell, step by step: signed ranks.
    known = np.isfinite(now) & np.isfinite(then)
    if wilcoxon(now[known] - then[known], alternative="greater").pvalue >= _BY_CHANCE:
        return Judged()
    return Judged(
        time_offset_s=round(best, 3),
        note=f"the odometry's clock is {abs(1e3 * best):.0f} ms "
        f"{'ahead' if best < 0.0 else 'behind'} by the turns that the images show "
        f"({np.degrees(left):.2g} instead of {np.degrees(before):.2g} degrees a step): "
        f"odometry.time_offset_s is {best:.3f}",
    )


# --------------------------------------------------------------------------------------------
# Turns by images


Found: TypeAlias = tuple[FloatArray, Image]
"""Pixels (n, 2) and descriptors (n, 32) of the features of an image."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameFeatures:
    """Pixels (n, 2), descriptors (n, 32), and points (n, 3) by stereo, NaN where there is none."""

    pixels: FloatArray
    descriptors: Image
    points: FloatArray


def _features_of(recording: Recording, i: int) -> FrameFeatures:
    """Features of frame ``i``; empty where it cannot be read."""
    detector = cv2.ORB.create(_FEATURES)
    found: list[Found] = []
    try:
        for image in recording.frame(i).images[:2]:
            points, descriptors = detector.detectAndCompute(image, None)
            pixels = np.array([p.pt for p in points], np.float64).reshape(-1, 2)
            rows = descriptors if len(points) else np.empty((0, 32))
            found.append((pixels, np.asarray(rows, np.uint8)))
    except FrameError:
        return FrameFeatures(np.empty((0, 2)), np.empty((0, 32), np.uint8), np.empty((0, 3)))
    return stereo_features(recording.rig, *found)


def stereo_features(rig: CameraRig, right: Found, left: Found) -> FrameFeatures:
    """The features of the right image, with points where the left one has them, too."""
    points = np.full((len(right[0]), 3), np.nan)
    rows, partners = _matches(right[1], left[1])
    disparity = left[0][partners, 0] - right[0][rows, 0]
    level = np.abs(left[0][partners, 1] - right[0][rows, 1]) < _INLIER_PX
    good = level & (disparity > 1.0)
    points[rows[good]] = rig.triangulate(np.column_stack([right[0][rows], disparity])[good])
    return FrameFeatures(*right, points)


def _matches(first: Image, second: Image) -> tuple[IntArray, IntArray]:
    """Rows of descriptors (n, 32) that are clearly each other's nearest."""
    if min(len(first), len(second)) < 2:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(first, second, 2)
    found = [(a.queryIdx, a.trainIdx) for a, b in pairs if a.distance < _RATIO * b.distance]
    rows, partners = np.array(found, np.int64).reshape(-1, 2).T
    return rows, partners


def turn_between(
    before: FrameFeatures, after: FrameFeatures, camera: FloatArray
) -> FloatArray | None:
    """Rotation vector (3,) of the camera, in its own axes, between two images; None if unclear."""
    rows, partners = _matches(before.descriptors, after.descriptors)
    known = np.isfinite(before.points[rows, 0])
    rows, partners = rows[known], partners[known]
    if len(rows) < _FEWEST_MATCHES:
        return None
    cv2.setRNGSeed(0)  # RANSAC draws the same samples each time
    try:
        found, turn, _, inliers = cv2.solvePnPRansac(
            before.points[rows], after.pixels[partners], camera, np.zeros(4),
            reprojectionError=_INLIER_PX, iterationsCount=300, flags=cv2.SOLVEPNP_SQPNP,
        )  # fmt: skip
    except cv2.error:  # those that agree lie in one place
        return None
    if not found or inliers is None or len(inliers) < _FEWEST_MATCHES:
        return None
    # It takes points from the first camera to the second: the inverse of the camera's own turn.
    return np.asarray(-turn.ravel(), np.float64)
