"""How large the errors of landmark measurements are, and how long they persist, from residuals.

A graph, and a filter, takes the errors of a landmark's measurements to be independent from frame to
frame. Those of SIFT are not: the appearance changes slowly with the view. What that costs a path is
the power of the errors in their slowest part, the one that leans a landmark's whole track forwards
or backwards as a drift of the camera would. docs/derivations/measurements.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.backend.open_tracks import LONGEST, OpenTracks, Tracks, tracks_of
from fgslam.core.arrays import BoolArray, FloatArray, IntArray, StateArrays
from fgslam.core.geometry import in_front, inverse, inverse_spd3, reorthonormalise
from fgslam.core.sensors import CameraRig, Increment, Observations
from fgslam.core.store import Kept
from fgslam.core.types import EgoMotion

_EVERY = 5  # frames between judgements
_ITERATIONS = 5
_KERNEL_WIDTH = 4.0  # deviations at which the weight of a residual falls while the place is fitted
_OUTLIER = 4.0  # times the track's own median residual: it holds a wrong match
_SINGULAR = 1e12  # of a condition number: what is beyond has hardly a digit
_LEAST_PART = 0.1  # of a leaning, that no other place of the landmark explains
STATED = np.array([30.0, 0.3])
"""Samples that the stated noise counts for: numbers of single residuals, longest tracks."""
_BOUNDS = (0.05, 400.0)  # of variances over the stated ones
_FITS = 3.2
"""Medians of an image residual within which 99.9 % lie that are normal in column and row."""


@dataclass(frozen=True, slots=True)
class StatedNoise:
    """Noise as stated, times a factor of the settings when it is weighed."""

    factor: float

    @property
    def spread(self) -> float:
        """One."""
        return 1.0

    @property
    def power(self) -> float:
        """The factor squared."""
        return self.factor**2

    def expect(self, variance: float) -> None:
        """Nothing."""

    def learn(self, frame: int, step: FloatArray | None, accepted: Observations) -> None:
        """Nothing."""

    def smoothed(self, frames: list[int], poses: FloatArray) -> None:
        """Nothing."""


class Persistence:
    """Variances of measurements over the stated ones: of a single one, and by whole tracks."""

    _tracks: Kept[OpenTracks]
    _pose: Kept[FloatArray]
    _poses: Kept[dict[int, FloatArray]]
    _sums: Kept[FloatArray]
    _expected: Kept[float]

    def __init__(self, sensor: CameraRig) -> None:
        """As stated, until tracks have ended."""
        self._sensor = sensor
        self._tracks = OpenTracks()
        self._pose = np.eye(4)
        self._poses = {}
        # Of single residuals and of leanings (rows) the sum of squares, and its expectation.
        self._sums = np.column_stack([STATED, STATED])
        self._expected = 1.0

    @property
    def spread(self) -> float:
        """Variance of a single measurement over the stated one, by which a wrong match is judged.

        From the residuals of tracks that have ended.
        """
        return self._ratio(0)

    @property
    def power(self) -> float:
        """Variance over the stated one by which a graph of independent measurements weighs them.

        What independent measurements would need to lean those tracks as much as they do.
        """
        return self._ratio(1)

    def expect(self, variance: float) -> None:
        """The samples to begin with are of this variance over the stated one."""
        self._expected = variance

    def learn(self, frame: int, step: FloatArray | None, accepted: Observations) -> None:
        """Takes in a frame's observations that fit, and judges tracks that have ended.

        Poses are chained by steps: a smoother's correction of the whole path leans no track. An
        unmeasured step would: all tracks end before it.

        ``step`` (4, 4) leads there from the frame before; None: no landmark has measured it.
        """
        if step is None:
            self._judge(frame, *self._tracks.take_all())
            step = np.eye(4)
        self._pose = reorthonormalise(self._pose @ step)
        self._poses[frame] = self._pose
        self._tracks.add(frame, accepted)
        if frame % _EVERY == 0:
            self._judge(frame, *self._tracks.take_ended(frame))

    def smoothed(self, frames: list[int], poses: FloatArray) -> None:
        """Takes in how the latest frames lie to each other, for tracks that are still to be judged.

        Steps alone would lean tracks where some of a tracker's map has moved.
        """
        known = [frame in self._poses for frame in frames]
        if any(known):
            first = known.index(True)
            by = self._poses[frames[first]] @ inverse(poses[first])
            for frame, wTc in zip(frames[first:], poses[first:], strict=True):
                self._poses[frame] = reorthonormalise(by @ wTc)
            self._pose = self._poses[frames[-1]]

    def _ratio(self, which: int) -> float:
        squares, expectation = self._sums[which]
        squares += STATED[which] * (self._expected - 1.0)
        return float(np.clip(squares / expectation, *_BOUNDS))

    def _judge(self, frame: int, ended: StateArrays, counts: IntArray) -> None:
        """Tracks of so many sightings (m,) that were taken out."""
        if len(counts):
            fitted = _Sightings.of(ended, counts, self._poses).fitted(self._sensor)
            if fitted is not None:
                self._sums += fitted.powers()
        first = self._tracks.first_frame(frame)
        self._poses = {k: wTc for k, wTc in self._poses.items() if k >= first}


def learn_from(
    noise: Persistence | StatedNoise,
    frame: int,
    increment: Increment,
    tracking: EgoMotion,
    before: FloatArray,
) -> None:
    """Teaches what fits of a frame.

    Args:
        noise: that learns.
        frame: its number.
        increment: its measurements.
        tracking: its pose, and the matches used.
        before: wTc (4, 4) of the last frame.
    """
    observed = increment.observations
    matched = observed.select(~observed.is_new).select(_fits(tracking))
    step = None
    if tracking.status.measured:
        step = inverse(before) @ tracking.wTc
        noise.expect(tracking.noise)
    noise.learn(frame, step, matched.join(observed.select(observed.is_new)))


def _fits(tracking: EgoMotion) -> BoolArray:
    """(k,) matches that teach the noise: those that the pose was found by.

    Where these are the fewer, the noise is not what they were judged by: then what is not far off
    next to the others.
    """
    if tracking.coherent:
        return tracking.inliers
    off_px = tracking.residuals
    return np.asarray(off_px <= _FITS * np.median(off_px))


def inverses_of_blocks(normal: FloatArray) -> FloatArray:
    """(m, 3, 3); of one that is singular the pseudo-inverse, which takes six times as long."""
    with np.errstate(all="ignore"):
        found = inverse_spd3(normal)
        condition = np.trace(normal, axis1=1, axis2=2) * np.trace(found, axis1=1, axis2=2)
    odd = ~((condition > 0.0) & (condition < _SINGULAR))
    if odd.any():
        found[odd] = np.linalg.pinv(normal[odd])
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Sightings:
    """All sightings (n) of m tracks.

    Attributes:
        cTw: (n, 4, 4) poses from which they were made.
        measurement: (n, 3).
        whitening: (n, 3, 3).
        tracks: which are whose.
    """

    cTw: FloatArray
    measurement: FloatArray
    whitening: FloatArray
    tracks: Tracks

    @staticmethod
    def of(seen: StateArrays, counts: IntArray, poses: dict[int, FloatArray]) -> _Sightings:
        return _Sightings(
            inverse(np.array([poses[k] for k in seen["frame"].tolist()])),
            seen["measurement"],
            np.asarray(np.linalg.inv(np.linalg.cholesky(seen["covariance"])), np.float64),
            tracks_of(counts),
        )

    def select(self, kept: BoolArray) -> _Sightings:
        """Those of some tracks (m,), a mask."""
        rows, tracks = kept[self.tracks.track], self.tracks.select(kept)
        return _Sightings(self.cTw[rows], self.measurement[rows], self.whitening[rows], tracks)

    def fitted(self, sensor: CameraRig) -> Fitted | None:
        """With each landmark where its sightings have it; without those that hold a wrong match."""
        last = self.tracks.start + self.tracks.counts - 1
        local = sensor.triangulate(self.measurement[last])
        wTc = inverse(self.cTw[last])
        places = np.einsum("mij,mj->mi", wTc[:, :3, :3], local) + wTc[:, :3, 3]
        found = self
        for iteration in range(_ITERATIONS):
            points = found._points(places)
            sound = in_front(points) & np.isfinite(points).all(axis=1)
            before = np.logical_and.reduceat(sound, found.tracks.start)
            if not before.all():
                found, places = found.select(before), places[before]
                if not len(places):
                    return None
                points = found._points(places)
            residual, jacobian = found._linear(sensor, points)
            length = np.linalg.norm(residual, axis=1) / _KERNEL_WIDTH
            # At first all count: where the last sighting has the landmark may be wrong itself.
            weight = 1.0 / (1.0 + length**2) if iteration else np.ones(len(length))
            places = places + found._step(residual, jacobian, weight)
        return Fitted.of(found.tracks, *found._linear(sensor, found._points(places)))

    def _points(self, places: FloatArray) -> FloatArray:
        moved = np.einsum("nij,nj->ni", self.cTw[:, :3, :3], places[self.tracks.track])
        return np.asarray(moved + self.cTw[:, :3, 3])

    def _linear(self, sensor: CameraRig, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Normalised residuals (n, 3) and their derivative (n, 3, 3) by the place."""
        off = self.measurement - sensor.predict(points)
        jacobian = sensor.jacobian(points) @ self.cTw[:, :3, :3]
        return np.einsum("nij,nj->ni", self.whitening, off), self.whitening @ jacobian

    def _step(self, residual: FloatArray, jacobian: FloatArray, weight: FloatArray) -> FloatArray:
        weighed = weight[:, None, None] * jacobian
        start = self.tracks.start
        normal = np.add.reduceat(np.swapaxes(weighed, 1, 2) @ jacobian, start)
        gradient = np.add.reduceat(np.einsum("nci,nc->ni", weighed, residual), start)
        return np.asarray(np.einsum("mij,mj->mi", inverses_of_blocks(normal), gradient))


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """Tracks' normalised residuals (n, 3) after the least squares of each landmark's place."""

    tracks: Tracks
    residual: FloatArray
    jacobian: FloatArray
    inverse_normal: FloatArray

    @staticmethod
    def of(tracks: Tracks, residual: FloatArray, jacobian: FloatArray) -> Fitted | None:
        """Without tracks that hold a residual far beyond their others.

        Args:
            tracks: whose sightings they are.
            residual: (n, 3) with each landmark near its place.
            jacobian: (n, 3, 3) their derivatives by the place.
        """
        length = np.linalg.norm(residual, axis=1)
        start, counts = tracks.start, tracks.counts
        ranked = length[np.lexsort((length, tracks.track))]
        median = 0.5 * (ranked[start + (counts - 1) // 2] + ranked[start + counts // 2])
        good = np.maximum.reduceat(length, start) <= _OUTLIER * median
        if not good.any():
            return None
        rows = good[tracks.track]
        kept = tracks.select(good)
        residual, jacobian = residual[rows], jacobian[rows]
        turned = np.swapaxes(jacobian, 1, 2)
        normal = inverses_of_blocks(np.add.reduceat(turned @ jacobian, kept.start))
        gradient = np.add.reduceat(np.einsum("nci,nc->ni", jacobian, residual), kept.start)
        step = np.einsum("mij,mj->mi", normal, gradient)
        residual = residual - np.einsum("nci,ni->nc", jacobian, step[kept.track])
        return Fitted(kept, residual, jacobian, normal)

    def powers(self) -> FloatArray:
        """Sum and expectation of the squares of single residuals, and of leanings (2, 2).

        Expected of independent errors of variance one; what another place of the landmark would
        explain is missing from both.
        """
        start, track = self.tracks.start, self.tracks.track
        counts = self.tracks.counts
        single = (self.residual**2).sum(), 3.0 * (counts - 1.0).sum()
        ramp = np.arange(len(track)) - start[track] - 0.5 * (counts[track] - 1.0)
        ramp /= np.sqrt(np.add.reduceat(ramp**2, start))[track]
        lean = np.add.reduceat(ramp[:, None] * self.residual, start)
        by_place = np.add.reduceat(ramp[:, None, None] * self.jacobian, start)
        part = 1.0 - np.einsum("mci,mij,mcj->mc", by_place, self.inverse_normal, by_place)
        counted = part >= _LEAST_PART
        # What a track measures of a drift goes with the square of its length, times its sightings.
        weight = np.broadcast_to((counts / LONGEST)[:, None] ** 3, part.shape)[counted]
        return np.array([single, (weight @ (lean**2)[counted], weight @ part[counted])])
