"""The smoother of a bounded lag: what has left the lag may leave memory, too, and come back.

Nothing revises a pose or a landmark that the lag has left, not even a loop closure. So a landmark
comes back exactly as it left, and a run with some of them on disk gives the answers of one without.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Protocol

import numpy as np

from fgslam.backend.filters.filtered import placed
from fgslam.backend.filters.set_aside import SetAside
from fgslam.backend.smoothers.admission import Track
from fgslam.backend.smoothers.graph_builder import TrackedFrame
from fgslam.backend.smoothers.smoother import GraphProblem, Smoother
from fgslam.backend.smoothers.solver import GraphSolver
from fgslam.backend.smoothers.tracks_aside import arrays_of, tracks_of
from fgslam.core.arrays import BoolArray, FloatArray, IntArray, StateArrays
from fgslam.core.estimates import EgoMotion, LandmarkMap, Prediction
from fgslam.core.geometry import adjoint, congruence, inverse
from fgslam.core.measurements import Increment

_HOLD_A_POSE = 6
"""Landmarks in three dimensions: twice as many as determine a pose."""


class LagSolver(GraphSolver, Protocol):
    """A solver that lets go for good what is older than its lag."""

    @property
    def oldest(self) -> int:
        """The first frame within the lag."""
        ...

    def pose(self, frame: int) -> Prediction:
        """A frame's pose; final before the lag."""
        ...


class LagSmoother(Smoother):
    """A smoother of a bounded lag, on :class:`fgslam.backend.filters.set_aside.SetsAside`."""

    def __init__(self, problem: GraphProblem, solver: LagSolver) -> None:
        """Starts at the problem's prior pose with an empty map."""
        super().__init__(problem, solver)
        self._lag = solver
        self._away = np.empty(0, np.int64)  # identities, ascending
        self._inputs.keep_in(None)

    @property
    def homes(self) -> IntArray:
        """(n,) frame that first saw each landmark of the map."""
        return self.tracker.homes

    def poses_of(self, frames: IntArray) -> FloatArray:
        """Poses (k, 4, 4) of earlier frames as known now."""
        return np.array([self._lag.pose(k).wTc for k in frames.tolist()]).reshape(-1, 4, 4)

    def settled(self, ids: IntArray) -> BoolArray:
        """(k,) which landmarks have left the lag: what it sees does not change them any more."""
        tracks, oldest = self.builder.admission.tracks, self._lag.oldest
        seen_within = self.tracker.held_aside(ids).lasts >= oldest
        within = [
            track is not None and (track.variable >= 0 or track.last.frame >= oldest)
            for track in map(tracks.get, ids.tolist())
        ]
        return ~(seen_within | np.array(within, np.bool_))

    def held_aside(self, ids: IntArray) -> SetAside:
        """Copies of landmarks, with what it takes to give them back; nothing changes."""
        aside = self.tracker.held_aside(ids)
        gain, information = self._doubt.held_aside(ids)
        tracks = arrays_of(self.builder.admission, ids)
        return dataclasses.replace(
            aside,
            poses=self.poses_of(aside.frames),
            doubt_gain=gain,
            doubt_information=information,
            tracks=tracks,
        )

    def give_up(self, ids: IntArray) -> None:
        """Forgets landmarks that somebody else holds now; they are settled."""
        self.tracker.give_up(ids)
        self._doubt.forget(ids)
        self.builder.admission.start_anew(ids.tolist(), "")
        self._away = np.union1d(self._away, ids)

    def take_back(self, aside: SetAside) -> None:
        """Landmarks come back as they were."""
        ids = aside.landmarks.ids
        where_tracked = dataclasses.replace(
            aside,
            poses=self.tracker.poses_of(aside.frames),
            doubt_information=np.zeros_like(aside.doubt_information),  # the tracker's has none
        )
        self.tracker.take_back(where_tracked)
        self._doubt.take_back(ids, aside.doubt_gain, aside.doubt_information)
        self.builder.admission.tracks.update(tracks_of(aside.tracks, ids))
        self._away = np.setdiff1d(self._away, ids)

    def reported(self, aside: SetAside) -> LandmarkMap:
        """Landmarks where they were when they left, with what the rig's doubt adds."""
        known = aside.landmarks
        positions, covariances = known.positions.copy(), known.covariances.copy()
        for identity, track in tracks_of(aside.tracks, known.ids).items():
            row = int(np.searchsorted(known.ids, identity))
            positions[row], covariances[row] = self._left(track)
        found = LandmarkMap(known.ids, positions, covariances)
        return self._doubt.added(found, aside.doubt_gain) if self._doubt.present else found

    def keep_record_in(self, folder: Path) -> None:
        """From now on what it was given is in files of the folder, but for the last frames.

        Without: in a file that goes with the process, and its state is whole.
        """
        self._inputs.keep_in(folder)

    def state(self) -> StateArrays:
        """Everything that was put in, and which landmarks are away."""
        return super().state() | ({"away": self._away} if len(self._away) else {})

    def restore(self, state: StateArrays) -> None:
        """Repeats all updates of :meth:`state`; those away are with who keeps them."""
        super().restore(state)
        if "away" in state:
            self.give_up(state["away"])

    def _admitted(self, increment: Increment, tracking: EgoMotion) -> TrackedFrame:
        """The frame; one that was found without a prior is where a map that has left has it."""
        tracked = super()._admitted(increment, tracking)
        observed = increment.observations
        matched = observed.ids[~observed.is_new][tracking.inliers]
        if not increment.relocalised or self._within(matched) >= _HOLD_A_POSE:
            return tracked
        return dataclasses.replace(tracked, located=self._located(matched, tracking))

    def _within(self, ids: IntArray) -> int:
        """How many of them are variables of the lag: those hold a frame by their factors."""
        tracks = self.builder.admission.tracks
        return sum(i in tracks and tracks[i].variable >= 0 for i in ids.tolist())

    def _located(self, matched: IntArray, tracking: EgoMotion) -> FloatArray:
        """(6, 6) of a pose in a map that has left: as tracked, and as the map is known itself.

        Its landmarks are as uncertain as the pose of the frame that began them, in the middle.
        """
        known = self.tracker.landmarks()
        homes = self.tracker.homes[known.rows(matched[np.isin(matched, known.ids)])]
        if not len(homes):
            return tracking.covariance
        home = self._lag.pose(int(np.sort(homes)[len(homes) // 2]))
        there = adjoint(inverse(tracking.wTc) @ home.wTc)
        return tracking.covariance + congruence(there, home.covariance)

    def _left(self, track: Track) -> tuple[FloatArray, FloatArray]:
        """Place and covariance with which a landmark left, or as its last sighting has it."""
        if track.left_at is not None:
            return track.left_at
        last = track.last
        pose = self._lag.pose(last.frame)
        measured = last.measurement[None], last.covariance[None]
        places, covariances = placed(self._sensor, pose.wTc, *measured, pose.covariance)
        return places[0], covariances[0]
