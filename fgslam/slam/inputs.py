"""Input of a session, checked before it touches any state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from fgslam.cameras.rig import StereoRig
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import ConfigError, FrameError, OdometryError
from fgslam.core.geometry import is_rigid
from fgslam.core.measurements import Odometry
from fgslam.core.sensors import CameraRig
from fgslam.datasets.odometry import pose_noise
from fgslam.datasets.settings import OdometrySettings, RecordedOdometrySettings
from fgslam.frontend.features.sift import grey_image
from fgslam.slam.feature_stream import FeatureExtractor
from fgslam.slam.motion import MotionModel

Images: TypeAlias = Sequence[npt.ArrayLike]
"""Images (left, right[, top]) of one instant."""

_NAMES = ("left", "right", "top")
_SYMMETRY = 1e-6  # relative: covariances that were added up in another order


def checked_extractor(features: FeatureExtractor | None) -> FeatureExtractor | None:
    """Raises ConfigError for what cannot be called."""
    if features is not None and not callable(features):
        raise ConfigError(
            f"features: {type(features).__name__} cannot be called; give a function from an image "
            "to fgslam.Features, or None for SIFT"
        )
    return features


def _is_colour(image: np.ndarray) -> bool:
    """Whether an array is one image with colours, and not several images."""
    return image.ndim == 3 and image.shape[2] in (3, 4)


def checked_images(images: Images, rig: CameraRig) -> tuple[Image, ...]:
    """Grey rectified images (right, left[, top]) of the rig's size from (left, right[, top]).

    Copies: tracking needs the last images again, and a camera loop may fill the same ones again.

    Raises:
        FrameError: another number of images, or one of another size, type or shape.
    """
    wanted = ", ".join(_NAMES[: rig.cameras])
    try:
        if isinstance(images, str | bytes | Mapping):
            raise TypeError
        given = len(images)
    except TypeError:
        raise FrameError(
            f"the images are a {type(images).__name__}; give a tuple ({wanted}), or None where the "
            "cameras gave nothing"
        ) from None
    if isinstance(images, np.ndarray) and (images.ndim < 3 or _is_colour(images)):
        raise FrameError(f"one image given instead of {rig.cameras}; give ({wanted})")
    if given != rig.cameras:
        other = {2: ", or a rig without vertical_baseline", 3: ", or a rig with one more camera"}
        raise FrameError(
            f"{given} images given, the rig has {rig.cameras} cameras; give ({wanted})"
            f"{other.get(given, '')}"
        )
    grey, size = [], rig.image_size if isinstance(rig, StereoRig) else (rig.width, rig.height)
    for name, image in zip(_NAMES, images, strict=False):
        converted = grey_image(image, f"{name} image")
        if converted.shape[::-1] != size:
            height, width = converted.shape
            raise FrameError(
                f"{name} image is {width}x{height}, the rig's are {size[0]}x{size[1]}; give images "
                "of that size, or the calibration of these"
            )
        grey.append(converted.copy())
    left, right, *top = grey
    inside = (right, left, *top)
    return rig.rectified(inside) if isinstance(rig, StereoRig) else inside


def checked_odometry(
    given: Odometry | npt.ArrayLike | None, settings: OdometrySettings | MotionModel
) -> Odometry | None:
    """Motion of the body with covariance; a bare (4, 4) gets the noise of settings.

    Raises:
        OdometryError: it is not finite, of another shape, no rigid motion, or its covariance is
            not symmetric and positive semi-definite.
    """
    if given is None:
        return None
    if isinstance(given, Odometry):
        motion = _rigid(given.motion)
        return replace(given, motion=motion, covariance=_covariance(given.covariance))
    motion = _rigid(given)
    noise = settings if isinstance(settings, RecordedOdometrySettings) else None
    return Odometry(motion, pose_noise(motion, noise or RecordedOdometrySettings()))


def _numbers(given: npt.ArrayLike, what: str, shape: tuple[int, int]) -> FloatArray:
    try:
        array = np.array(given, np.float64)
    except (TypeError, ValueError):
        raise OdometryError(f"odometry: the {what} is no array of numbers; give {shape}") from None
    if array.shape != shape:
        raise OdometryError(f"odometry: the {what} has shape {array.shape}; give {shape}")
    if not np.isfinite(array).all():
        raise OdometryError(
            f"odometry: the {what} is not finite; give None where nothing was measured"
        )
    return array


def _rigid(given: npt.ArrayLike) -> FloatArray:
    motion = _numbers(given, "motion", (4, 4))
    if not is_rigid(motion):
        raise OdometryError(
            "odometry: the motion is no rigid motion; give the pose (4, 4) of the body now in its "
            "frame before: an orthonormal rotation, metres, and 0 0 0 1 below"
        )
    return motion


def _covariance(given: npt.ArrayLike) -> FloatArray:
    covariance = _numbers(given, "covariance", (6, 6))
    scale = float(np.abs(covariance).max())
    symmetric = np.allclose(covariance, covariance.T, rtol=0.0, atol=_SYMMETRY * scale)
    if not symmetric or np.linalg.eigvalsh(covariance).min() < -_SYMMETRY * scale:
        raise OdometryError(
            "odometry: the covariance is not symmetric and positive; give that of the tangent "
            "vector [rotation, translation], radians and metres"
        )
    return covariance
