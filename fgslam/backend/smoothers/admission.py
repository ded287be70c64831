"""Which landmarks enter the graph, wait outside, start again or leave it.

A landmark enters only once it is constrained: seen in enough frames, with enough parallax.
Nothing is lost by waiting: its first observation has as many numbers as the landmark, and so
measures nothing of poses. One that is contradicted frame after frame has moved, and starts again.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from fgslam.backend.filters.filtered import placed
from fgslam.backend.self_calibration import RigChange
from fgslam.backend.settings import GraphSettings
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.sensors import CameraRig, Observations
from fgslam.core.types import EgoMotion, LandmarkMap

LEAST_SIGHTINGS = 2  # frames in which a landmark is seen before it enters: one match may be wrong
LEAST_PARALLAX = 3.0
"""Range over its deviation below which a landmark waits: its depth is not normally distributed."""
CONTRADICTED_AFTER = 3
"""Rejected in so many frames in a row, which agree on another place, a landmark has moved."""
_SAME_PLACE = 16.3  # 99.9 % quantile of chi-square with three degrees of freedom
_OUTLIER_PX = 12.0  # where nothing is left out: farther off, a match speaks against its landmark


@dataclass(slots=True, eq=False)
class Sighting:
    """One observation of a landmark: frame, measurement (3,) and its covariance (3, 3)."""

    frame: int
    measurement: FloatArray
    covariance: FloatArray

    @staticmethod
    def by_others(frame: int) -> Sighting:
        """One by another sensor than the camera."""
        return Sighting(frame, np.full(3, np.nan), np.full((3, 3), np.nan))


@dataclass(slots=True, eq=False)
class Track:
    """What the graph knows of a landmark.

    Attributes:
        least_parallax: below this it waits; raised when a solver failed on it.
        last: its latest sighting.
        variable: number of its variable, -1 while it waits outside.
        waiting: its sightings while it waits.
        sightings: in how many frames it was seen.
        elsewhere: world positions and covariances of its rejected sightings since the last one
            that fitted.
        left_at: world position and covariance with which it last left a bounded lag.
    """

    least_parallax: float
    last: Sighting
    variable: int = -1
    waiting: list[Sighting] = field(default_factory=list)
    sightings: int = 0
    elsewhere: list[tuple[FloatArray, FloatArray]] = field(default_factory=list)
    left_at: tuple[FloatArray, FloatArray] | None = None

    @property
    def by_camera(self) -> bool:
        """Whether the camera has seen it."""
        return bool(np.isfinite(self.last.measurement[0]))


class LandmarkAdmission:
    """The landmarks of a run, by identity, and whether the graph holds them.

    Attributes:
        tracks: by the landmark's identity.
        first_frame: of a bounded lag; 0 where there is none.
        staying: variables in a lag of landmarks that no measurement fixes by itself.
        remarks: which landmarks started again, in words.
    """

    def __init__(self, sensor: CameraRig, settings: GraphSettings) -> None:
        """No landmark yet."""
        self._sensor = sensor
        self._settings = settings
        self._saved: dict[int, tuple[FloatArray, FloatArray]] = {}
        self.first_frame, self.staying = 0, set[int]()
        self.tracks: dict[int, Track] = {}
        self.by_last_sighting: dict[int, Track] = {}
        self.remarks: list[str] = []

    # -- what a frame's observations say of their landmarks --------------------------------------

    def judge(self, tracking: EgoMotion) -> tuple[BoolArray, BoolArray]:
        """Which matched observations are used, and which speak against their landmark's place.

        Args:
            tracking: the frame's least squares, over its (m,) matched observations.

        Returns:
            Two masks (m,).
        """
        gate_px = self._settings.gate_px
        outliers = ~tracking.inliers & ~(tracking.residuals <= (gate_px or _OUTLIER_PX))
        return (~outliers if gate_px else np.ones(len(outliers), np.bool_)), outliers

    def confirmed(self, identities: IntArray) -> None:
        """Notes that landmarks were seen where they should be: nothing speaks against them."""
        for identity in identities.tolist():
            track = self.tracks.get(identity)
            if track is not None:
                track.elsewhere.clear()

    def contradicted(self, rejected: Observations, wTc: FloatArray) -> Observations:
        """Those rejected observations whose landmark must have moved: they start it again.

        It has when it was rejected in several frames in a row, and they agree on where it is: wrong
        matches do not.

        Args:
            rejected: a frame's matched observations that do not fit.
            wTc: (4, 4) the frame's pose.
        """
        after = CONTRADICTED_AFTER
        if not len(rejected):
            return rejected.select(np.zeros(len(rejected), np.bool_))
        measured = rejected.measurement, rejected.covariance
        places, covariances = placed(self._sensor, wTc, *measured)
        moved = np.zeros(len(rejected), np.bool_)
        for i, identity in enumerate(rejected.ids.tolist()):
            track = self.tracks.get(identity)
            if track is not None:
                track.elsewhere.append((places[i], covariances[i]))
                moved[i] = len(track.elsewhere) >= after and _agree(track.elsewhere[-after:])
        return rejected.select(moved)

    def recalibrate(self, change: RigChange) -> None:
        """Corrects again what sightings measured; what contradicted may not any more."""
        every = (s for t in self.tracks.values() for s in (t.last, *t.waiting))
        sightings = {id(s): s for s in every if s.frame >= change.since}
        if not sightings:
            return
        measured = change.measured(np.array([s.measurement for s in sightings.values()]))
        for sighting, measurement in zip(sightings.values(), measured, strict=True):
            sighting.measurement = measurement
        for track in self.tracks.values():
            track.elsewhere.clear()

    # -- coming and going ------------------------------------------------------------------------

    def know(self, landmarks: LandmarkMap) -> None:
        """Landmarks of a saved map: each enters with its first sighting, on its own prior.

        The priors are independent of one another. One that turns out to have moved, or to lie
        elsewhere, becomes a landmark like any other.
        """
        places = zip(landmarks.positions, landmarks.covariances, strict=True)
        self._saved = dict(zip(landmarks.ids.tolist(), places, strict=True))

    def saved(self, identity: int) -> tuple[FloatArray, FloatArray] | None:
        """Position (3,) and covariance (3, 3) of a saved map's landmark, while they hold."""
        return self._saved.get(identity)

    def sighted(self, identity: int, sighting: Sighting) -> Track:
        """The landmark's track with one sighting more."""
        track = self.tracks.get(identity)
        if track is None:
            track = self.tracks[identity] = Track(LEAST_PARALLAX, sighting)
        self.by_last_sighting.pop(identity, None)  # the order is that of the last sightings
        self.by_last_sighting[identity] = track
        track.last = sighting
        track.sightings += 1
        return track

    def admits(self, identity: int, parallax: float) -> bool:
        """True once a waiting landmark is constrained, or known from a saved map.

        Args:
            identity: of the landmark, which is in :attr:`tracks`.
            parallax: its range over the range's standard deviation.
        """
        track = self.tracks[identity]
        if track.waiting and track.waiting[0].frame < self.first_frame:
            track.waiting = [s for s in track.waiting if s.frame >= self.first_frame]
        seldom = len(track.waiting) < LEAST_SIGHTINGS
        return identity in self._saved or not (seldom or parallax < track.least_parallax)

    def pruned(self, identities: IntArray) -> None:
        """Drops landmarks as the front-end did; what they measured stays in the graph."""
        for identity in identities.tolist():
            self.tracks.pop(identity, None)
            self.by_last_sighting.pop(identity, None)
            self._saved.pop(identity, None)

    def restart(self, identities: Iterable[int], why: str) -> None:
        """Closes the variables of landmarks; their next sighting begins new ones."""
        for identity in identities:
            self._saved.pop(identity, None)
            self.by_last_sighting.pop(identity, None)
            track = self.tracks.pop(identity, None)
            if track is not None and why:
                self.remarks.append(
                    f"landmark {identity} (seen {track.sightings} times, last in frame "
                    f"{track.last.frame}) {why}"
                )

    def taken_out(self, identity: int, variable: int) -> None:
        """A landmark on which a solver failed waits until it is known twice as well."""
        self._saved.pop(identity, None)
        track = self.tracks.get(identity)
        if track is not None and track.variable == variable:
            track.variable = -1
            track.waiting = []
            track.least_parallax = 2.0 * max(track.least_parallax, 1.0)

    def leave_before(self, frame: int) -> list[tuple[int, Track]]:
        """Landmarks last seen before the frame at which a bounded lag begins.

        Returns:
            Identity and track of each; it keeps its variable until the caller closes it.
        """
        self.first_frame = frame
        left = [
            (i, track)
            for i, track in self.by_last_sighting.items()
            if track.last.frame < frame and track.variable not in self.staying
        ]
        for identity, _ in left:
            del self.by_last_sighting[identity]
        return [(i, track) for i, track in left if track.variable >= 0]

    def recent(self, since: int) -> tuple[IntArray, IntArray, IntArray]:
        """Landmarks (k,) seen in a frame or later, latest first.

        Returns:
            Their identities, variables (-1: it waits outside) and the frames that saw them last.
        """
        latest = reversed(self.by_last_sighting.items())
        seen = list(itertools.takewhile(lambda each: each[1].last.frame >= since, latest))
        variables = [track.variable for _, track in seen]
        frames = [track.last.frame for _, track in seen]
        identities = [identity for identity, _ in seen]
        return (
            np.array(identities, np.int64),
            np.array(variables, np.int64),
            np.array(frames, np.int64),
        )

    def in_graph(self) -> list[tuple[int, Track]]:
        """Landmarks that are in the graph, the one seen last first."""
        latest = reversed(self.by_last_sighting.items())
        return [(i, track) for i, track in latest if track.variable >= 0]

    def describe(self, identity: int, variable: int) -> str:
        """A landmark's identity and sightings, in words."""
        track = self.tracks.get(identity)
        if track is None or track.variable != variable:
            return f"landmark {identity} (no longer in use)"
        return (
            f"landmark {identity} (seen {track.sightings} times, last from frame "
            f"{track.last.frame})"
        )


def _agree(places: list[tuple[FloatArray, FloatArray]]) -> bool:
    """True if positions (3,) with covariances (3, 3) may be one place, each next to the last."""
    last, uncertainty = places[-1]
    for place, covariance in places[:-1]:
        offset = place - last
        if offset @ np.linalg.solve(covariance + uncertainty, offset) > _SAME_PLACE:
            return False
    return True
