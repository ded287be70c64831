"""Which landmarks are in view of a pose, and their matches (Se et al. 3.1, 3.2 and 4.4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from fgslam.core.arrays import BoolArray, ByteArray, FloatArray, IntArray, Rows
from fgslam.core.geometry import (
    congruence,
    point_pose_jacobian,
    rotate_covariances,
    transform_to_camera,
)
from fgslam.core.sensors import CameraRig, measures_one_image
from fgslam.core.types import Prediction, StereoFeatures
from fgslam.frontend.features.matching import pairs_in_gates, pick, resembling
from fgslam.frontend.settings import AppearanceSettings, DatabaseSettings, MapMatchingSettings

Pairs: TypeAlias = tuple[IntArray, IntArray, FloatArray]
"""(k,) landmarks, features, and distances of their descriptors."""
Wanted: TypeAlias = Callable[[IntArray, FloatArray], BoolArray]
"""Of rows (k,) of the map and their distances by which sizes shrink: which to consider at all."""
_SCALE_RATIO = 1.5
"""Largest ratio to the predicted scale: one level of the scale space (Se et al., IJRR 2002)."""
WINDOW_PX = 5.0  # side of the search window in the image, as in Se et al. 3.1
REFINE_SHIFT_PX = 0.25 * WINDOW_PX
"""Landmarks that a first pose shifts by more, in the median, are matched again around it. Measured:
on steps that the odometry foretells within it (roads) a second matching changes nothing."""
_DISPARITY_PX = 2.0  # largest difference from the predicted disparity, likewise before widening
MAX_WINDOW_PX = 80.0
"""Side that widening may not exceed, also of the disparity gate: a quarter of 320 px, beyond
which most candidates are of other landmarks."""
_ORIENTATION = np.deg2rad(20.0)  # largest difference to the predicted one, as between images


class MapMatcher:
    """Search window, disparity, scale and orientation gates, then the appearance."""

    def __init__(self, settings: MapMatchingSettings, appearance: AppearanceSettings) -> None:
        """Takes the gates and the use of descriptors."""
        self._settings = settings
        self._appearance = appearance
        self._limit = 0.5 * MAX_WINDOW_PX

    def match(
        self,
        expected: ExpectedLandmarks,
        features: StereoFeatures,
        uncertainty: FloatArray | None = None,
    ) -> MapMatches:
        """Matches one frame.

        Args:
            expected: landmarks in view with predicted characteristics.
            features: the frame's stereo features.
            uncertainty: (v, 3) standard deviations of the predicted (column, row, disparity) by
                which the gates are widened; None keeps the fixed window.
        """
        return self._match_within(expected, features, self._reach(len(expected), uncertainty))

    def _reach(self, count: int, uncertainty: FloatArray | None) -> FloatArray:
        """Half widths (v, 3) of the gates in column, row and disparity."""
        half = 0.5 * WINDOW_PX
        base = np.array([half, half, _DISPARITY_PX])
        if uncertainty is None:
            return np.tile(base, (count, 1))
        widened = base + self._settings.widen_sigmas * uncertainty
        return np.asarray(np.minimum(widened, np.maximum(self._limit, base)))

    def _match_within(
        self, expected: ExpectedLandmarks, features: StereoFeatures, reach: FloatArray
    ) -> MapMatches:
        # Images are wide: the column leaves the fewest pairs to the others.
        order = np.argsort(features.measurement[:, 0], kind="stable")
        columns, (center, half) = features.measurement[order, 0], (expected.measurement, reach)
        first = np.searchsorted(columns, center[:, 0] - half[:, 0], side="left")
        last = np.searchsorted(columns, center[:, 0] + half[:, 0], side="right")
        seen_as = expected.scale, expected.orientation
        wanted = np.column_stack([center[:, 1:], half[:, 1:], *seen_as])
        of_one = measures_one_image(features.measurement_covariance)
        seen = (features.measurement[:, 1:], features.scale, features.orientation, of_one)
        gates = first, last, wanted, np.column_stack(seen)[order], _SCALE_RATIO, _ORIENTATION
        count, found = np.array([len(order)]), np.empty((2, 0), np.int64)
        while found.shape[1] < count[0]:  # once more, if there are more than features
            found = np.empty((2, count[0]), np.int64)
            pairs_in_gates(*gates, found, count)
        i, j = found[0, : count[0]], order[found[1, : count[0]]]
        descriptors = (expected.descriptors, features.descriptors)
        pairs = resembling(i, j, descriptors, self._appearance)
        had_candidates = np.zeros(len(features), np.bool_)
        had_candidates[pairs[1]] = True
        if features.complete is None:
            return MapMatches(*pick(pairs, self._appearance), had_candidates)
        return MapMatches(*self._pick_complete_first(pairs, features.complete), had_candidates)

    def _pick_complete_first(self, pairs: Pairs, complete: BoolArray) -> tuple[IntArray, IntArray]:
        """Matches as without incomplete features, then with them what nothing else resembles."""
        i, j, cost = pairs
        whole = complete[j]
        rest = np.isin(i, i[whole], invert=True)
        first = pick((i[whole], j[whole], cost[whole]), self._appearance)
        second = pick((i[rest], j[rest], cost[rest]), self._appearance)
        order = np.argsort(found := np.concatenate([first[0], second[0]]), kind="stable")
        return found[order], np.concatenate([first[1], second[1]])[order]

    def match_anywhere(self, expected: ExpectedLandmarks, features: StereoFeatures) -> MapMatches:
        """Matches within the largest window, regardless of the predicted uncertainty."""
        reach = np.full((len(expected), 3), self._limit)
        return self._match_within(expected, features, reach)

    @property
    def widens(self) -> bool:
        """True if the gates widen with the predicted uncertainty."""
        return self._settings.widen_sigmas > 0.0

    @property
    def refines(self) -> bool:
        """True if a frame is matched a second time, around the pose found."""
        return self._settings.refine

    @property
    def rescues(self) -> bool:
        """Whether :meth:`match_anywhere` is to be tried where too few match.

        Never without descriptors: in so large a window all would be ambiguous.
        """
        return self._settings.rescue and self._appearance.mode == "descriptor"


@dataclass(frozen=True, slots=True, eq=False)
class MapMatches:
    """Matches between expected landmarks and features.

    Attributes:
        landmarks: (k,) indices into the expected landmarks, ascending.
        features: (k,) indices into the features.
        had_candidates: (n,) features that resemble a landmark near by, matched or ambiguous: they
            start no landmark, which would make the ambiguity worse.
    """

    landmarks: IntArray
    features: IntArray
    had_candidates: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class ExpectedLandmarks:
    """Landmarks expected in view, with their predicted characteristics (Se et al. 3.1).

    Attributes:
        ids: (v,) landmark identities, ascending.
        rows: (v,) their rows in the estimator's map.
        measurement: (v, 3) predicted (column, row, disparity).
        scale: (v,) predicted scale, pixels.
        orientation: (v,) radians.
        descriptors: (v, 128).
        certain: (v,) well inside the view, so that no match is a miss; those at its border may be
            matched (else each frame would start them again) but are not missed, nor are those
            seen from farther than ever, or from a direction from which they were never matched
            (6.3).
    """

    ids: IntArray
    rows: IntArray
    measurement: FloatArray
    scale: FloatArray
    orientation: FloatArray
    descriptors: ByteArray
    certain: BoolArray

    def __len__(self) -> int:
        return len(self.ids)


# ------------------------------------------------------------------------------------------
# Which landmarks are expected in view of a pose

BORDER_PX = 8.0  # nearer to an image's edge a landmark is not missed
CONE_DEG = 30.0  # half angle of the cone in which the paper expects landmarks (4.4)
_NEAREST_M = 0.1
_SLACK_PX = 1e-6  # of the rough test before the exact one; far above rounding


class FieldOfView:
    """Common field of view of the cameras, by the settings."""

    def __init__(self, rig: CameraRig, settings: DatabaseSettings, max_disparity_px: float) -> None:
        """Points of more than ``max_disparity_px`` are outside."""
        self._rig = rig
        self._cone = settings.field_of_view == "cone"
        self._tangent = np.tan(np.deg2rad(CONE_DEG))
        self._max_disparity = max_disparity_px

    def select(
        self,
        wTc: FloatArray,
        positions: FloatArray,
        wanted: Wanted | None = None,
    ) -> InView:
        """The points (n, 3) of the world that may be in view from ``wTc``.

        Args:
            wTc: (4, 4) pose.
            positions: (n, 3) points.
            wanted: asked about those roughly in view.
        """
        points = transform_to_camera(wTc, positions)
        rows = self._roughly(points)
        if wanted is not None:
            rows = rows[wanted(rows, points[rows, 2])]
        points = points[rows]
        measurement = self._rig.predict(points)
        if self._cone:
            inside = np.abs(points[:, :2]) < self._tangent * points[:, 2:]
            possible = certain = np.asarray(inside.all(axis=1))
        else:
            possible = self._in_images(measurement, -BORDER_PX)
            certain = self._in_images(measurement, BORDER_PX)
        keep = possible & (measurement[:, 2] <= self._max_disparity)
        return InView(rows, points, measurement, certain).select(keep)

    def _roughly(self, points: FloatArray) -> IntArray:
        """Rows (k,) of all points (n, 3) in view and few others: no division, few points a test.

        The reference image with its border, widened by a hair, as planes through the camera.
        """
        rows = np.flatnonzero(points[:, 2] > _NEAREST_M)
        rig, reach = self._rig, BORDER_PX + _SLACK_PX
        if self._cone:
            return rows
        for axis, (focal, centre, size) in enumerate(
            ((rig.fx, rig.cx, rig.width), (rig.fy, rig.cy, rig.height))
        ):
            along, depth = focal * points[rows, axis], points[rows, 2]
            inside = along >= (-reach - centre) * depth
            inside &= along <= (size - 1 + reach - centre) * depth
            rows = rows[inside]
        return rows

    def _in_images(self, measurement: FloatArray, border: float) -> BoolArray:
        """True if a landmark projects into all images of the rig, the border excluded."""
        rig = self._rig
        column, row, disparity = measurement.T
        vertical = (
            0.0
            if rig.vertical_baseline is None
            else disparity * (rig.fy * rig.vertical_baseline) / (rig.fx * rig.baseline)
        )
        inside = (column >= border) & (column + disparity <= rig.width - 1 - border)
        inside &= (row >= border) & (row + vertical <= rig.height - 1 - border)
        return np.asarray(inside)


@dataclass(frozen=True, slots=True, eq=False)
class InView(Rows):
    """Points that may be in view.

    Attributes:
        rows: (v,) which of the points, ascending.
        points: (v, 3) in the camera's frame, metres.
        measurement: (v, 3) predicted (column, row, disparity).
        certain: (v,) well inside the view.
    """

    rows: IntArray
    points: FloatArray
    measurement: FloatArray
    certain: BoolArray


def predicted_covariance(
    rig: CameraRig, prediction: Prediction, positions: FloatArray, covariances: FloatArray
) -> FloatArray:
    """Covariance (v, 3, 3) of predicted (column, row, disparity), without measurement noise.

    Args:
        rig: the cameras.
        prediction: pose and its covariance.
        positions: (v, 3) landmarks in the world, in front of the camera.
        covariances: (v, 3, 3) theirs.
    """
    points = transform_to_camera(prediction.wTc, positions)
    by_pose = point_pose_jacobian(points)
    weighted = (by_pose.reshape(-1, 6) @ prediction.covariance).reshape(by_pose.shape)
    in_camera = rotate_covariances(prediction.wTc[:3, :3].T, covariances)
    in_camera += weighted @ np.swapaxes(by_pose, 1, 2)
    return congruence(rig.jacobian(points), in_camera)


def directions_to(wTc: FloatArray, points: FloatArray) -> FloatArray:
    """View vectors (v, 3): unit, world, from the camera to points (v, 3) of its own frame."""
    turned = points @ wTc[:3, :3].T
    return np.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True))


def lean(rig: CameraRig, wTc: FloatArray, points: FloatArray) -> FloatArray:
    """(v,) how far the world's y axis is turned in the image, at points (v, 3) of the camera.

    Radians, clockwise from the image's y axis, as SIFT's orientation. Level cameras have none. A
    feature's orientation turns with it when the camera rolls, pitches, or sees it elsewhere in a
    tilted image; along a ray parallel to the axis it is not defined.
    """
    x, y, z = points.T
    down = wTc[1, :3]
    right, below = rig.fx * (down[0] * z - x * down[2]), rig.fy * (down[1] * z - y * down[2])
    return np.asarray(np.arctan2(-right, below))
