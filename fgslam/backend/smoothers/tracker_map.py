"""The tracker's map beside the graph's: what it takes over from a solution, and what is reported.

The tracker holds every landmark that is matched against; the graph only those that are
constrained. Those that wait outside move with the frame that saw them last.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from fgslam.backend.filters.filtered import placed
from fgslam.backend.filters.kalman import LandmarkKalman
from fgslam.backend.smoothers.admission import LandmarkAdmission, Sighting
from fgslam.backend.smoothers.solver import (
    Smoothed,
    Solution,
)
from fgslam.backend.smoothers.window_parts import WindowValues
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.estimates import LandmarkMap, Prediction
from fgslam.core.geometry import (
    inverse,
    transform_to_world,
)
from fgslam.core.sensors import CameraRig
from fgslam.factors.graphs import landmarks_in, pose_key, poses_of_frame


class TrackerMap:
    """Keeps the tracker's map in step with the graph's."""

    def __init__(
        self, sensor: CameraRig, tracker: LandmarkKalman, admission: LandmarkAdmission
    ) -> None:
        """The two maps, both still empty."""
        self._sensor = sensor
        self._tracker = tracker
        self._admission = admission
        self._anchors: dict[int, FloatArray] = {}

    def entered(self, frame: int, wTc: FloatArray) -> None:
        """Notes the pose (4, 4) with which a frame entered the graph."""
        self._anchors[frame] = wTc

    def take_over(self, smoothed: Smoothed, current: Prediction) -> None:
        """Lets the tracker go on from a solution, at its ``current`` pose.

        Landmarks that the graph knows nothing of stay; where a loop moved the map they
        move along with the last pose, near which they are, unless they are a saved map's.
        """
        ids, variables, frames = self._admission.recent(smoothed.since)
        inside = variables >= 0
        waiting_ids, waiting_positions = self._waiting(
            smoothed.values, ids[~inside], frames[~inside]
        )
        ids, positions = self._in_graph(smoothed.values, ids[inside], variables[inside])
        ids = np.concatenate([ids, waiting_ids])
        positions = np.concatenate([positions, waiting_positions])
        if smoothed.by_loop:
            known = self._tracker.landmarks()
            rest = np.flatnonzero(~np.isin(known.ids, ids) & (self._tracker.homes >= 0))
            moved = current.wTc @ inverse(self._tracker.predict(None).wTc)
            ids = np.concatenate([ids, known.ids[rest]])
            positions = np.concatenate(
                [positions, transform_to_world(moved, known.positions[rest])]
            )
        self._tracker.correct(current, ids, positions)

    def reported(self, answer: Solution) -> LandmarkMap:
        """The tracker's landmarks where the graph has them; those that wait, from their pose."""
        known = self._tracker.landmarks()
        positions, covariances = known.positions.copy(), known.covariances.copy()
        waiting: dict[int, list[tuple[int, Sighting]]] = {}
        for row, identity in enumerate(known.ids.tolist()):
            track = self._admission.tracks.get(identity)
            if track is None:
                continue
            if track.variable in answer.points:
                positions[row] = answer.points[track.variable]
                covariances[row] = answer.point_covariances[track.variable]
            elif track.left_at is not None:
                positions[row], covariances[row] = track.left_at
            else:
                waiting.setdefault(track.last.frame, []).append((row, track.last))
        for frame, seen in waiting.items():
            rows = [row for row, _ in seen]
            found = self._seen_from(answer, frame, [sighting for _, sighting in seen])
            positions[rows], covariances[rows] = found
        return LandmarkMap(known.ids.copy(), positions, covariances)  # theirs change later

    def _in_graph(
        self, values: Any, ids: IntArray, wanted: IntArray
    ) -> tuple[IntArray, FloatArray]:
        """Those landmarks (k,) of the tracker that ``values`` hold by variables (k,); positions."""
        inside = isinstance(values, WindowValues)
        variables, positions = values.landmarks() if inside else landmarks_in(values)
        known = np.isin(wanted, variables) & np.isin(ids, self._tracker.landmarks().ids)
        return ids[known], positions[np.searchsorted(variables, wanted[known])]

    def _waiting(self, values: Any, ids: IntArray, frames: IntArray) -> tuple[IntArray, FloatArray]:
        """Landmarks (k,) outside the graph, moved along with the frames (k,) that saw them last."""
        present = [f for f in np.unique(frames).tolist() if values.exists(pose_key(f))]
        anchors = {frame: poses_of_frame(values, frame) for frame in present}
        order = np.argsort(frames, kind="stable")
        order = order[np.isin(frames[order], present)]
        ids, frames = ids[order], frames[order]
        known = self._tracker.landmarks()
        positions = known.positions[known.rows(ids)]
        first = np.searchsorted(frames, [*present, np.inf])
        for k, (frame, wTc) in enumerate(anchors.items()):
            # One just taken out of the graph is where the graph had it, and follows from here.
            moved = wTc @ inverse(self._anchors.get(frame, wTc))
            own = slice(first[k], first[k + 1])
            positions[own] = transform_to_world(moved, positions[own])
        self._anchors = anchors
        return ids, positions

    def _seen_from(
        self, answer: Solution, frame: int, sightings: list[Sighting]
    ) -> tuple[FloatArray, FloatArray]:
        """Positions (k, 3) and covariances (k, 3, 3) of landmarks, each by one sighting of it."""
        measured = np.array([sighting.measurement for sighting in sightings])
        covariances = np.array([sighting.covariance for sighting in sightings])
        pose_covariance = answer.pose_covariances[frame]
        return placed(self._sensor, answer.poses[frame], measured, covariances, pose_covariance)
