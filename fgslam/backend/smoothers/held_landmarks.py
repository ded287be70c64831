"""Landmarks of a whole drive: where each was when it left a window, and what was known of it."""

from __future__ import annotations

import numpy as np

from fgslam.backend.loops import home_changes, rotated, transported
from fgslam.backend.smoothers.window_parts import Landmarks
from fgslam.core.arrays import BoolArray, FloatArray, GrowingColumns, IntArray


class HeldLandmarks:
    """By variable: place, mean and information given the poses, frame with which it is off."""

    def __init__(self) -> None:
        """None yet."""
        self._rows = GrowingColumns(
            point=np.empty((0, 3)),
            mean=np.empty((0, 3)),
            information=np.empty((0, 3, 3)),
            home=np.empty(0, np.int64),
            saved=np.empty(0, np.bool_),
        )

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def points(self) -> FloatArray:
        """(m, 3) places; may be written to."""
        return self._rows["point"]

    @property
    def homes(self) -> IntArray:
        """(m,) the last frame that saw each before it left a window; -1: it never did."""
        return self._rows["home"]

    @property
    def saved(self) -> BoolArray:
        """(m,) whether it is known from a saved map, which no change of this drive moves."""
        return self._rows["saved"]

    def enter(self, point: FloatArray) -> None:
        """A new variable, of which nothing is known."""
        row = {"point": point, "mean": point, "information": np.zeros((3, 3))}
        last = {"home": np.array(-1), "saved": np.array(False)}
        self._rows.append({name: value[None] for name, value in (row | last).items()})

    def know(self, variable: int, mean: FloatArray, covariance: FloatArray, saved: bool) -> None:
        """What is known of a new variable beforehand, from a ``saved`` map or from this drive."""
        self._rows["mean"][variable] = mean
        self._rows["information"][variable] = np.linalg.inv(covariance)
        self._rows["saved"][variable] = saved

    def begin(self, variables: IntArray, points: FloatArray) -> None:
        """They are elsewhere, at points (k, 3): what was known of them was of others."""
        rows = self._rows
        rows["point"][variables] = rows["mean"][variables] = points
        rows["information"][variables] = 0.0
        rows["home"][variables] = -1
        rows["saved"][variables] = False

    def carried_along(self, by_frame: FloatArray) -> None:
        """Moves each with the frame with which it is off, by motions of the world (n, 4, 4)."""
        by = home_changes(np.where(self.saved, -1, self.homes), by_frame)
        self.points[:] = transported(by, self.points)
        self._rows["information"][:] = rotated(by, self._rows["information"])

    def of(self, variables: IntArray) -> Landmarks:
        """Some of them, for a window."""
        rows = self._rows
        names = ("point", "mean", "information")
        return Landmarks(variables, *(rows[name][variables] for name in names))

    def left(self, landmarks: Landmarks, home: int) -> None:
        """Takes back what has left a window, last seen in a frame."""
        at = landmarks.variables
        self._rows["point"][at], self._rows["mean"][at] = landmarks.points, landmarks.mean
        self._rows["information"][at] = landmarks.information
        self._rows["home"][at] = home
