"""Landmarks out of a filter's hands: what it takes to have them back as if they had never left."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from fgslam.backend.filters.loop_correction import changes, home_changes, rotated, transported
from fgslam.core.arrays import BoolArray, FloatArray, IntArray, StateArrays
from fgslam.core.estimates import LandmarkMap


@dataclass(frozen=True, slots=True, eq=False)
class SetAside:
    """Landmarks as they were, anchored to the frames that first saw them.

    Attributes:
        landmarks: n of them, in the world as it was then.
        counts: (n,) frames in which each was seen.
        homes: (n,) frame with which each moves when a loop is closed; -1 for one that stays.
        lasts: (n,) frame that saw each last.
        frames: (k,) the homes, ascending, each once.
        timestamps: (k,) theirs, seconds.
        poses: (k, 4, 4) theirs, as they were then.
        doubt_gain: (n, 3, q) error columns, world axes; zero where there are none: derivatives by
            the rig's shared terms (:mod:`fgslam.backend.filters.online_doubt`) and, of the filter
            of single landmarks, drawn samples (:mod:`fgslam.backend.filters.sampled_errors`).
        doubt_information: (n, 3, 3) given the poses; zero where there is no doubt.
        tracks: what else their estimator knows of them.
    """

    landmarks: LandmarkMap
    counts: IntArray
    homes: IntArray
    lasts: IntArray
    frames: IntArray
    timestamps: FloatArray
    poses: FloatArray
    doubt_gain: FloatArray
    doubt_information: FloatArray
    tracks: StateArrays = dataclasses.field(default_factory=dict)

    def moved(self, poses: FloatArray) -> SetAside:
        """The landmarks beside their homes' poses (k, 4, 4) as known now; to the bit if unmoved."""
        if np.array_equal(poses, self.poses):
            return self
        place = np.where(self.homes < 0, -1, np.searchsorted(self.frames, self.homes))
        by_landmark = home_changes(place, changes(self.poses, poses))
        landmarks = self.landmarks
        there = LandmarkMap(
            landmarks.ids,
            transported(by_landmark, landmarks.positions),
            rotated(by_landmark, landmarks.covariances),
        )
        return dataclasses.replace(
            self,
            landmarks=there,
            poses=poses,
            doubt_gain=by_landmark[:, :3, :3] @ self.doubt_gain,
            doubt_information=rotated(by_landmark, self.doubt_information),
        )


@runtime_checkable
class SetsAside(Protocol):
    """An estimator whose landmarks may leave its memory and come back; optional.

    It keeps no correlations between landmarks: those that are away cannot be updated by what those
    that are there see.
    """

    @property
    def homes(self) -> IntArray:
        """(n,) frame with which each landmark of the map moves; -1 for one that stays."""
        ...

    def poses_of(self, frames: IntArray) -> FloatArray:
        """Poses (k, 4, 4) of earlier frames as known now."""
        ...

    def settled(self, ids: IntArray) -> BoolArray:
        """(k,) which landmarks may leave now."""
        ...

    def held_aside(self, ids: IntArray) -> SetAside:
        """Copies of landmarks (ascending), with what it takes to give them back."""
        ...

    def give_up(self, ids: IntArray) -> None:
        """Forgets landmarks that somebody else holds now."""
        ...

    def reported(self, aside: SetAside) -> LandmarkMap:
        """The landmarks as :meth:`Estimator.estimate` would have them, if they were back."""
        ...

    def take_back(self, aside: SetAside) -> None:
        """Landmarks come back, moved by what closures have corrected their homes since."""
        ...
