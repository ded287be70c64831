"""A few consecutive frames as one set of features: a short submap, seen from its last camera."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence as Items
from dataclasses import dataclass

import numpy as np

from fgslam.backend.settings import LandmarkKalmanSettings
from fgslam.core.arrays import FloatArray
from fgslam.core.estimates import Trajectory
from fgslam.core.features import LandmarkAppearances, StereoFeatures
from fgslam.core.geometry import (
    congruence,
    project,
    projection_jacobian,
    rotate_covariances,
    transform_to_camera,
)
from fgslam.core.measurements import Odometry
from fgslam.core.recordings import Frame, Sequence
from fgslam.core.sensors import CameraRig
from fgslam.datasets.settings import OdometrySettings
from fgslam.frontend.settings import FrontendSettings
from fgslam.slam.factory import make_pipeline
from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.motion import body_motion
from fgslam.slam.pipeline import SlamPipeline

_NEAREST_M = 0.1  # of the last camera's plane: nearer ones have no size in its image


@dataclass(frozen=True, eq=False)
class Window:
    """Consecutive frames of a recording as one of its own; a ``Sequence``.

    Attributes:
        whole: the recording.
        start: its frame that is the first one here.
        count: frames in the window.
    """

    whole: Sequence
    start: int
    count: int

    @property
    def name(self) -> str:
        """The recording's."""
        return self.whole.name

    @property
    def rig(self) -> CameraRig:
        """The recording's."""
        return self.whole.rig

    @property
    def timestamps(self) -> FloatArray:
        """(count,) seconds."""
        return self.whole.timestamps[self.start : self.start + self.count]

    @property
    def identity(self) -> str:
        """The recording's."""
        return self.whole.identity

    @property
    def notes(self) -> tuple[str, ...]:
        """The recording's."""
        return self.whole.notes

    @property
    def ground_truth(self) -> Trajectory | None:
        """None: a window is not judged."""
        return None

    def __len__(self) -> int:
        return self.count

    def frame(self, i: int) -> Frame:
        """Images of the window's frame ``i``."""
        return self.whole.frame(self.start + i)

    def odometry(self, i: int) -> Odometry | None:
        """Motion to the window's frame ``i``; what was before the window is not known."""
        return None if i == 0 else self.whole.odometry(self.start + i)


def submap_features(
    window: Window,
    found: Items[FeatureFrame],
    frontend: FrontendSettings,
    odometry: OdometrySettings,
) -> tuple[StereoFeatures, FloatArray]:
    """Tracks the window's frames by the ordinary loop and hands over its landmarks.

    Args:
        window: the frames; each in the image of its reference camera.
        found: their features, in order.
        frontend: the configuration's; neither loops are closed nor lost cameras found.
        odometry: the configuration's.

    Returns:
        The submap's landmarks in the last camera's frame, with fused covariances and their last
        looks; those outside its image, too. And the covariance (6, 6) of that camera in the
        submap, which whoever is located by the submap has beside the map's.
    """
    plain = dataclasses.replace(frontend, loops=None, lost=None)
    pipeline = make_pipeline(window.rig, plain, odometry, LandmarkKalmanSettings())
    stats = None
    for i, one in enumerate(found):
        timestamp = float(window.timestamps[i])
        body = body_motion(window, i, pipeline.motion)
        stats = pipeline.process(dataclasses.replace(one, i=i), i, timestamp, body).stats
    if stats is None:
        raise ValueError("a submap needs at least one frame")
    return _as_features(pipeline, window.rig, stats.wTc), stats.covariance


def _as_features(pipeline: SlamPipeline, rig: CameraRig, wTc: FloatArray) -> StereoFeatures:
    """The landmarks as the camera at ``wTc`` would measure them, were its image large enough."""
    landmarks = pipeline.estimator.landmarks()
    looks = _last_looks(pipeline.tracker.database.appearances(landmarks.ids))
    points = transform_to_camera(wTc, landmarks.positions)
    covariances = rotate_covariances(wTc[:3, :3].T, landmarks.covariances)
    keep = np.abs(points[:, 2]) > _NEAREST_M
    points, covariances = points[keep], covariances[keep]
    looks = looks.of(landmarks.ids[keep])
    measurement, noise = _measured(rig, points, covariances)
    pixels = np.full((len(points), 3, 2), np.nan)
    pixels[:, 0] = measurement[:, :2]
    return StereoFeatures(
        measurement=measurement,
        measurement_covariance=noise,
        scale=looks.size / np.abs(points[:, 2]),
        orientation=looks.orientation,
        descriptors=looks.descriptors,
        position=points,
        position_covariance=covariances,
        pixels=pixels,
    )


def _last_looks(appearances: LandmarkAppearances) -> LandmarkAppearances:
    """The view of each landmark that was seen last."""
    last = np.flatnonzero(np.diff(appearances.ids, append=-1))
    return LandmarkAppearances(
        appearances.ids[last],
        appearances.descriptors[last],
        appearances.size[last],
        appearances.orientation[last],
        appearances.direction[last],
    )


def _measured(
    rig: CameraRig, points: FloatArray, covariances: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Image measurements (n, 3) of points and their covariances; NaN of those behind the camera."""
    before = points[:, 2] > 0.0
    measurement = np.full((len(points), 3), np.nan)
    noise = np.full((len(points), 3, 3), np.nan)
    measurement[before] = project(rig, points[before])
    noise[before] = congruence(projection_jacobian(rig, points[before]), covariances[before])
    return measurement, noise
