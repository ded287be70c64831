"""Odometry's clock, unit and axes against what the images show of the turns, without any truth.

The camera's rotation between two frames needs no depth and no map: two images say it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from fgslam.core.arrays import FloatArray, Image, IntArray
from fgslam.core.errors import FrameError, OdometryError
from fgslam.core.geometry import so3_log, triangulate
from fgslam.core.sensors import Odometry
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
    source = recording.odometry_source
    if source is None:
        return Judged()
    rows = _telling(recording)
    seen = SeenTurns.of(recording, rows, source)
    if len(seen.rows) < _FEWEST_STEPS:
        return Judged()
    return judged(seen)


def judged(seen: SeenTurns) -> Judged:
    """The same of turns that were seen already; raises as :func:`judged_turns`."""
    size = float(np.median(np.linalg.norm(seen.turns, axis=1)))
    best = seen.best_shift()
    now, then = seen.errors(0.0), seen.errors(best)
    left = _median(then)
    if size > _LEAST_TURN_RAD:
        _require_radians(seen, best)
    if size > _CLEAR_TURN_RAD and left > _AGREES * size and seen.by_gyroscope:
        return Judged(fault=True, note=_disagreement(left, size))
    known = np.isfinite(now) & np.isfinite(then)
    gain = left < _CLEAR_GAIN * _median(now)
    if not gain or abs(best) < _LEAST_SHIFT_S or not _smaller(then[known], now[known]):
        return Judged()
    return Judged(time_offset_s=round(best, 3), note=_offset(best, _median(now), left))


def _smaller(then: FloatArray, now: FloatArray) -> bool:
    """Whether errors (k,) fell, step by step: Wilcoxon's signed ranks."""
    from scipy.stats import wilcoxon  # half a second to load

    return bool(wilcoxon(now - then, alternative="greater").pvalue < _BY_CHANCE)


def _median(errors: FloatArray) -> float:
    """Infinite where too few are known."""
    known = errors[np.isfinite(errors)]
    return float(np.median(known)) if len(known) >= _FEWEST_STEPS else np.inf


def _offset(best: float, now: float, left: float) -> str:
    return (
        f"the odometry's clock is {abs(1e3 * best):.0f} ms {'ahead' if best < 0.0 else 'behind'} "
        f"by the turns that the images show ({np.degrees(left):.2g} instead of "
        f"{np.degrees(now):.2g} degrees a step): odometry.time_offset_s is {best:.3f}"
    )


def _disagreement(left: float, size: float) -> str:
    return (
        "the gyroscope does not turn as the images do (off by "
        f"{np.degrees(left):.2g} of {np.degrees(size):.2g} degrees a step) and is not used; give a "
        "calibration that states where it sits (T_BS, T_cam_imu), or correct its axes or its unit, "
        "radians/s (where something large moves through most of these images, they are wrong)"
    )


def _require_radians(seen: SeenTurns, shift: float) -> None:
    """Raises OdometryError where the odometry turns 57 times as much as the images."""
    dt = np.diff(seen.stamps)[seen.rows - 1][:, None]
    odometry, images = (_varying(turns / dt) for turns in (seen.by_odometry(shift), seen.turns))
    known = np.isfinite(odometry) & (images >= np.median(images))
    scale = float(np.median(odometry[known] / images[known])) if known.any() else 1.0
    if _DEGREES / _LIKE_DEGREES < scale < _DEGREES * _LIKE_DEGREES:
        raise OdometryError(
            f"the odometry of {seen.name} turns {scale:.0f} times as fast as the images: its "
            "angular velocity is in degrees/s, radians/s are expected; name the columns so "
            "(gyro_x_dps), or convert them"
        )


def _varying(rates: FloatArray) -> FloatArray:
    """(k,) how far rates (k, 3) are from their median, which a bias may be."""
    return np.asarray(np.linalg.norm(rates - np.nanmedian(rates, axis=0), axis=1))


def _telling(recording: Recording) -> IntArray:
    """Steps i (to frame i) in which the odometry's turn rate changes most, ascending."""
    turns = np.full((len(recording), 3), np.nan)
    for i in range(1, len(recording)):
        step = recording.odometry(i)
        if step is not None:
            turns[i] = so3_log(step.motion[:3, :3])
    rates = turns[1:] / np.diff(recording.timestamps)[:, None]
    change = np.linalg.norm(np.diff(rates, axis=0, prepend=rates[:1]), axis=1)
    change = np.where(np.isfinite(change), change, -1.0)
    chosen = np.argsort(-change, kind="stable")[:_STEPS]
    return np.sort(chosen[change[chosen] >= 0.0]) + 1


@dataclass(frozen=True, slots=True, eq=False)
class SeenTurns:
    """Turns of the body (k, 3) by the images, in the steps ``rows``; and the odometry."""

    name: str
    rows: IntArray
    turns: FloatArray
    stamps: FloatArray
    source: OdometrySource
    by_gyroscope: bool

    @staticmethod
    def of(recording: Recording, rows: IntArray, source: OdometrySource) -> SeenTurns:
        """What the images of those steps show, where they show it."""
        bRc = recording.rig.bTc[:3, :3]
        rig = recording.rig
        camera = np.array([[rig.fx, 0.0, rig.cx], [0.0, rig.fy, rig.cy], [0.0, 0.0, 1.0]])
        found, turns, features = [], [], SampledFeatures(recording)
        for i in rows.tolist():
            turn = turn_between(features.at(i - 1), features.at(i), camera)
            if turn is not None:
                found.append(i)
                turns.append(bRc @ turn)
        steps = (recording.odometry(i) for i in range(1, len(recording)))
        first = next((step for step in steps if step is not None), None)
        return SeenTurns(
            recording.name,
            np.array(found, np.int64),
            np.array(turns).reshape(-1, 3),
            recording.timestamps,
            source,
            first is not None and first.turned,
        )

    def by_odometry(self, shift: float) -> FloatArray:
        """(k, 3) with its stamps later by ``shift`` seconds; NaN where not covered."""
        used = np.unique(np.concatenate([self.rows - 1, self.rows]))
        steps = self.source(self.stamps[used] - shift)
        at = np.searchsorted(used, self.rows) - 1
        return np.array([_vector(steps[k]) for k in at])

    def differences(self, shift: float) -> FloatArray:
        """(k, 3) of images less odometry, without a constant rate: the gyroscope's bias."""
        difference = self.turns - self.by_odometry(shift)
        if not self.by_gyroscope:
            return np.asarray(difference[:, 2:])  # wheels measure the heading alone
        dt = (self.stamps[self.rows] - self.stamps[self.rows - 1])[:, None]
        known = np.isfinite(difference).all(axis=1)
        bias = np.median(difference[known] / dt[known], axis=0) if known.any() else 0.0
        return np.asarray(difference - bias * dt)

    def errors(self, shift: float) -> FloatArray:
        """(k,) radians a step; NaN where the shifted odometry does not cover it."""
        try:
            return np.asarray(np.linalg.norm(self.differences(shift), axis=1))
        except OdometryError:  # shifted beyond all frames
            return np.full(len(self.rows), np.nan)

    def best_shift(self) -> float:
        """Seconds to be added to the odometry's stamps, on a coarse grid, then on a fine one."""
        middle = self._best_of(_grid(_RANGE_S, _COARSE_S))
        return self._best_of(middle + _grid(_COARSE_S, _FINE_S))

    def _best_of(self, shifts: FloatArray) -> float:
        nearest = shifts[np.argsort(np.abs(shifts), kind="stable")]  # of equals the least shift
        return float(nearest[int(np.argmin([_median(self.errors(s)) for s in nearest]))])


def _grid(reach: float, step: float) -> FloatArray:
    return np.asarray(step * np.arange(-round(reach / step), round(reach / step) + 1), np.float64)


def _vector(step: Odometry | None) -> FloatArray:
    return np.full(3, np.nan) if step is None else so3_log(step.motion[:3, :3])


class SampledFeatures:
    """Features of frames, the last two kept."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._detector = cv2.ORB.create(_FEATURES)
        self._kept: dict[int, FrameFeatures] = {}

    def at(self, i: int) -> FrameFeatures:
        """Of frame ``i``; empty where it cannot be read."""
        if i not in self._kept:
            self._kept = {k: v for k, v in self._kept.items() if k >= i - 1}
            self._kept[i] = self._look(i)
        return self._kept[i]

    def _look(self, i: int) -> FrameFeatures:
        try:
            right, left = (self._found(x) for x in self._recording.frame(i).images[:2])
        except FrameError:
            return FrameFeatures(np.empty((0, 2)), np.empty((0, 32), np.uint8), np.empty((0, 3)))
        points = np.full((len(right[0]), 3), np.nan)
        rows, partners = _matches(right[1], left[1])
        disparity = left[0][partners, 0] - right[0][rows, 0]
        level = np.abs(left[0][partners, 1] - right[0][rows, 1]) < _INLIER_PX
        good = level & (disparity > 1.0)
        measured = np.column_stack([right[0][rows], disparity])[good]
        points[rows[good]] = triangulate(self._recording.rig, measured)
        return FrameFeatures(right[0], right[1], points)

    def _found(self, image: Image) -> tuple[FloatArray, Image]:
        points, descriptors = self._detector.detectAndCompute(image, None)
        pixels = np.array([p.pt for p in points], np.float64).reshape(-1, 2)
        return pixels, np.asarray(descriptors if len(points) else np.empty((0, 32)), np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class FrameFeatures:
    """Pixels (n, 2), descriptors (n, 32), and points (n, 3) by stereo, NaN where there is none."""

    pixels: FloatArray
    descriptors: Image
    points: FloatArray


def _matches(first: Image, second: Image) -> tuple[IntArray, IntArray]:
    """Rows of descriptors (n, 32) that are clearly each other's nearest."""
    if min(len(first), len(second)) < 2:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(first, second, 2)
    good = [a for a, b in pairs if a.distance < _RATIO * b.distance]
    found = [(m.queryIdx, m.trainIdx) for m in good]
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
