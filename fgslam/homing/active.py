"""One homing under way, from one matching of the target to the next: estimator, tracks, faults."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from fgslam.backend.homing.parts import HomingEstimator
from fgslam.core.arrays import BoolArray, FloatArray, middle
from fgslam.core.bearings import (
    BearingMatches,
    HomeVector,
    HomingEstimate,
    HomingStart,
    TrackedBearings,
    TwoViewVector,
    common_rows,
)
from fgslam.core.errors import EstimatorError
from fgslam.core.geometry import circular_median, wrap

MAX_ACROSS = 0.1
"""Deviation of the target's place across the way, in parts of the leg, beyond which the target is
matched again."""

CONTRADICTION_DEG = 30.0
"""A new homing vector that differs by more from a consistent estimate (and by more than four
deviations) must be confirmed by another image."""

_MAX_RESIDUAL_DEG = 5.0
"""Median difference of the bearings from the estimate's prediction beyond which the estimate counts
as diverged."""

MIN_TRACKS = 10  # with fewer the target is matched again, while the estimate is still used
_FEWEST_TRACKS = 4
"""With fewer than this the estimate is not used any more (a third view needs three
bearings)."""

EstimatorMaker: TypeAlias = Callable[[HomingStart], HomingEstimator]

_FARTHEST = 3.0  # legs; an estimate farther away has diverged
_FASTEST_TURN = np.deg2rad(120.0)  # a second between two images: no wheelchair turns faster
_TURN_MARGIN = np.deg2rad(20.0)  # what near features and noise make of a common turn
_KEPT_SHARE = 0.7  # of the tracks; fewer count as weak even where there were few to begin with
_BOUND_SIGMAS = 2.0  # of the part of the leg that is surely left at most
_SIGMAS = 4.0  # between two homing vectors of which one must be wrong


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """A target seen in passing, without tracks of its features.

    Attributes:
        vector: the homing vector.
        matches: its inliers.
    """

    vector: TwoViewVector
    matches: BearingMatches


@dataclass(frozen=True, slots=True)
class Fault:
    """What is wrong with a homing under way, and whether its estimate is still usable."""

    reason: str
    usable: bool


class ActiveHoming:
    """An estimator that is fed with tracks, and the checks of its estimate.

    Attributes:
        start: what it began with.
        unit: its leg in parts of the leg where the robot first set out for this target.
        tracked: the last image's bearings, at first those of the start.
        history: all images that the estimator was given.
        estimate: the last state.
        home: its steering vector, with distance and covariance in legs where the robot set out.
    """

    def __init__(
        self,
        start: HomingStart,
        make_estimator: EstimatorMaker,
        unit: float,
    ) -> None:
        """Makes the estimator.

        Raises:
            EstimatorError: the start cannot be solved.
        """
        self.start, self.unit = start, unit
        self._estimator = make_estimator(start)
        self.estimate = self._estimator.estimate()
        # Averages of bearings have neither map nor covariance; estimators with a map have both.
        self._maps = bool(np.isfinite(self.estimate.landmarks).all())
        self.home = self._home()
        self.tracked = _seen_at(start)
        self.history: list[TrackedBearings] = []

    def _home(self) -> HomeVector:
        with np.errstate(invalid="ignore"):  # the direction's variance at the target itself
            home = self.estimate.home()
            scale = np.array([self.unit, 1.0, 1.0])
            covariance = home.covariance * scale[:, None] * scale
        return HomeVector(self.unit * home.distance, home.direction, home.rotation, covariance)

    @property
    def supported(self) -> bool:
        """Whether the estimate rests on tracks in the map and has a covariance.

        Without them a filter or graph only carries the last motion on, and so might into the
        target. Always so of estimators that never have either.
        """
        misfit = tracked_misfit(self.estimate, self.tracked)
        return not self._maps or (self._determined and bool(np.isfinite(misfit)))

    @property
    def _determined(self) -> bool:
        return bool(np.isfinite(self.estimate.covariance).all())

    def update(self, tracked: TrackedBearings) -> Fault | None:
        """Updates the estimate by one image; the worst fault afterwards, or None."""
        fault = self._unusable(tracked)
        if fault is not None:
            return fault
        try:
            self._estimator.update(tracked)
        except EstimatorError as error:
            return Fault(str(error), False)
        self.tracked = tracked
        self.estimate = self._estimator.estimate(landmarks=False)
        self.history.append(tracked)
        self.home = self._home()
        return self._divergence() or self._weakness()

    def _unusable(self, tracked: TrackedBearings) -> Fault | None:
        """The fault of an image with too few tracks, or turned faster than a robot can turn."""
        if len(tracked) < _FEWEST_TRACKS:
            return Fault(f"{len(tracked)} tracks left", False)
        step = tracked.time - self.tracked.time
        turn = common_turn(self.tracked, tracked)
        limit = _FASTEST_TURN * step + _TURN_MARGIN
        if abs(turn) > limit:
            degrees = np.rad2deg(turn)
            return Fault(f"image turned by {degrees:.0f} deg within {step:.2f} s", False)
        return None

    def _divergence(self) -> Fault | None:
        distance = self.home.distance / self.unit
        if not distance <= _FARTHEST:
            return Fault(f"estimate diverged: {distance:.1f} legs to go", False)
        for name, misfit in (
            ("tracks", tracked_misfit(self.estimate, self.tracked)),
            ("target's bearings", target_misfit(self.estimate, self.start)),
        ):
            if misfit > np.deg2rad(_MAX_RESIDUAL_DEG):
                degrees = np.rad2deg(misfit)
                return Fault(f"estimate diverged: {name} misfit by {degrees:.1f} deg", False)
        return None

    def _weakness(self) -> Fault | None:
        count = len(self.tracked)
        if count < min(MIN_TRACKS, _KEPT_SHARE * len(self.start.matches)):
            return Fault(f"{count} tracks left", True)
        if self._maps and not self._determined:
            return Fault("target uncertain: the estimator has no covariance", True)
        home = self.home
        with np.errstate(invalid="ignore"):
            across = float(home.distance * np.sqrt(home.covariance[1, 1]))
        if np.isfinite(across) and across > MAX_ACROSS:
            return Fault(f"target uncertain by {across:.2f} legs across", True)
        return None

    def contradicts(self, vector: TwoViewVector) -> bool:
        """Whether direction or rotation of a new homing vector contradicts the estimate."""
        return bool(self._contradictions(vector).any())

    def turned_otherwise(self, vector: TwoViewVector) -> bool:
        """Whether the rotation of a new homing vector contradicts the estimate."""
        return bool(self._contradictions(vector)[1])

    def _contradictions(self, vector: TwoViewVector) -> BoolArray:
        """(2,) whether direction and rotation differ by more than their limits."""
        home = self.home
        turns = [vector.direction - home.direction, vector.rotation - home.rotation]
        variance = np.diag(vector.covariance) + np.nan_to_num(np.diag(home.covariance)[1:])
        limit = np.deg2rad(CONTRADICTION_DEG)
        allowed = np.maximum(limit, _SIGMAS * np.sqrt(variance))
        return np.abs(wrap(np.array(turns))) > allowed


def _seen_at(start: HomingStart) -> TrackedBearings:
    """Bearings of the start image, in the form of a tracked image."""
    seen = start.matches
    return TrackedBearings(
        time=start.time,
        ids=start.local_map.ids,
        bearing=seen.bearing_a,
        sigma_bearing=seen.sigma[:, 0],
        elevation=seen.elevation_a,
        sigma_elevation=seen.sigma[:, 1],
    )


# --------------------------------------------------------------------------------------------
# Whether an estimate still fits the bearings it was made of. An estimator's own covariance is not
# enough: it holds only if the model does. Medians, so that the wrong matches among the tracks, a
# minority, decide nothing.


_FEWEST = 3  # fewer bearings say nothing about a pose with three unknowns


def tracked_misfit(estimate: HomingEstimate, tracked: TrackedBearings) -> float:
    """Median absolute difference of tracked bearings from their prediction, radians.

    NaN where fewer than three features are both tracked and in the map.
    """
    mine, other = common_rows(estimate.ids, tracked.ids)
    return _misfit(estimate.robot, estimate.landmarks[mine], tracked.bearing[other])


def target_misfit(estimate: HomingEstimate, start: HomingStart) -> float:
    """Median absolute difference of the target's bearings from their prediction, radians."""
    ids = start.local_map.ids
    mine, other = common_rows(estimate.ids, ids)
    return _misfit(estimate.target, estimate.landmarks[mine], start.matches.bearing_b[other])


def _misfit(pose: FloatArray, landmarks: FloatArray, seen: FloatArray) -> float:
    x, y = (landmarks - pose[:2]).T
    apart = (seen + pose[2] - np.arctan2(y, x))[np.isfinite(x + y)]
    if len(apart) < _FEWEST:
        return float("nan")
    return middle(np.abs(wrap(apart)))


def parallax(matches: BearingMatches, rotation: float) -> float:
    """Median absolute parallax of matches (n), n > 0, radians: what the turn does not explain.

    It falls to zero at the target, and needs no direction: a measure of how near the target is.
    """
    return float(np.median(np.abs(wrap(matches.bearing_a - matches.bearing_b - rotation))))


def surely_left(begun: HomingStart, seen: Sighting) -> float:
    """Bound of the part of the leg from ``begun`` that is left, by the features common to both.

    A feature's distance from the target, triangulated in units of either leg, gives the ratio of
    the legs. The bound is that of the ratios' median at two deviations, by their order alone, so
    that wrong matches, a minority, widen it and do not move it. 1 where too few are common, or
    where they agree on nothing.
    """
    before, now = _common(begun.matches, seen.matches)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = _far_from_target(before, begun.vector) / _far_from_target(now, seen.vector)
    ratios = np.sort(np.where(ratios > 0.0, ratios, np.inf))
    count = len(ratios)
    last = int(np.ceil(0.5 * (count + _BOUND_SIGMAS * np.sqrt(count)))) if count else 0
    return min(1.0, float(ratios[last])) if last < count else 1.0


def _common(a: BearingMatches, b: BearingMatches) -> tuple[BearingMatches, BearingMatches]:
    """Rows of both with the same feature of the target."""
    of_target_a, of_target_b = (2 * m.index_b + m.kind for m in (a, b))
    _, of_a, of_b = np.intersect1d(of_target_a, of_target_b, return_indices=True)
    return a.select(of_a), b.select(of_b)


def _far_from_target(matches: BearingMatches, vector: TwoViewVector) -> FloatArray:
    """(n,) distances of features from the target, in legs; not positive where rays diverge."""
    across = np.sin(matches.bearing_b + vector.rotation - matches.bearing_a)
    return np.asarray(np.sin(matches.bearing_a - vector.direction) / across)


def common_turn(before: TrackedBearings, now: TrackedBearings) -> float:
    """Turn of the robot between two images, radians; NaN without common features.

    The circular median of the bearings' changes, the other way round: translation moves bearings,
    too, but to both sides.
    """
    mine, other = common_rows(before.ids, now.ids)
    if not len(mine):
        return float("nan")
    change = wrap(before.bearing[mine] - now.bearing[other])
    return circular_median(change)
