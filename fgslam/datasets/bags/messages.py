"""What the messages of a bag mean: images in grey, calibrations, motions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import FrameError
from fgslam.datasets.images import decode_grey, grey_of_16_bits

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
ODOMETRY = "nav_msgs/msg/Odometry"
TWIST = "geometry_msgs/msg/TwistStamped"
TWIST_WITH_COVARIANCE = "geometry_msgs/msg/TwistWithCovarianceStamped"
IMU = "sensor_msgs/msg/Imu"

_GREY = {"mono8", "8UC1", "mono16", "16UC1"}
_COLOURS: Mapping[str, tuple[int, int]] = {
    "bgr8": (3, cv2.COLOR_BGR2GRAY),
    "8UC3": (3, cv2.COLOR_BGR2GRAY),
    "rgb8": (3, cv2.COLOR_RGB2GRAY),
    "bgra8": (4, cv2.COLOR_BGRA2GRAY),
    "8UC4": (4, cv2.COLOR_BGRA2GRAY),
    "rgba8": (4, cv2.COLOR_RGBA2GRAY),
    "bgr16": (3, cv2.COLOR_BGR2GRAY),
    "rgb16": (3, cv2.COLOR_RGB2GRAY),
    "yuv422": (2, cv2.COLOR_YUV2GRAY_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2GRAY_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2GRAY_YUYV),
    "yuyv": (2, cv2.COLOR_YUV2GRAY_YUYV),
}
"""Encodings of colour: channels, and how they become grey."""

# ROS names the first pixels of the first two rows, OpenCV those of the second row from the second.
_MOSAICS = {
    "rggb": cv2.COLOR_BayerBG2GRAY,
    "bggr": cv2.COLOR_BayerRG2GRAY,
    "gbrg": cv2.COLOR_BayerGR2GRAY,
    "grbg": cv2.COLOR_BayerGB2GRAY,
}


def grey_of(message: Any, where: str) -> Image:
    """The image of an Image or CompressedImage message in grey, (height, width) uint8.

    Raises:
        FrameError: its encoding is not known, or its data are incomplete.
    """
    if hasattr(message, "encoding"):
        return _grey_of_raw(message, where)
    data = bytes(memoryview(message.data))
    mosaic = _mosaic_of(message.format.partition(";")[0])
    image = decode_grey(data, where)
    return image if mosaic is None else np.asarray(cv2.cvtColor(image, mosaic), np.uint8)


def _grey_of_raw(message: Any, where: str) -> Image:
    encoding, height, width = message.encoding, int(message.height), int(message.width)
    mosaic = _mosaic_of(encoding)
    if encoding not in _GREY and encoding not in _COLOURS and mosaic is None:
        known = ", ".join((*sorted(_GREY), *_COLOURS, "bayer_*"))
        raise FrameError(f"{where}: encoding {encoding!r} is not read; known: {known}")
    channels, code = _COLOURS.get(encoding, (1, mosaic))
    pixels = _pixels(message, encoding, channels, where).reshape(height, width, channels)
    grey = pixels[:, :, 0] if code is None else cv2.cvtColor(np.ascontiguousarray(pixels), code)
    if grey.dtype == np.uint16:
        return grey_of_16_bits(np.asarray(grey, np.uint16))
    return np.ascontiguousarray(grey, np.uint8)


def _mosaic_of(encoding: str) -> int | None:
    return _MOSAICS.get(encoding[6:10]) if encoding.startswith("bayer_") else None


def _pixels(message: Any, encoding: str, channels: int, where: str) -> npt.NDArray[Any]:
    """The rows of the image without their padding."""
    wide = encoding.endswith("16") or encoding.startswith("16")
    kind = np.dtype(np.uint16 if wide else np.uint8)
    if wide and message.is_bigendian:
        kind = kind.newbyteorder(">")
    data = np.frombuffer(memoryview(message.data), np.uint8)
    height, used = int(message.height), int(message.width) * channels * kind.itemsize
    step = int(message.step) or used
    if height < 1 or used < 1 or step < used or len(data) < height * step:
        raise FrameError(
            f"{where}: {len(data)} bytes are no image of {message.width}x{height} {encoding}; "
            "record it again"
        )
    rows = data[: height * step].reshape(height, step)[:, :used]
    return np.ascontiguousarray(rows).view(kind).astype(kind.newbyteorder("="), copy=False)


# --------------------------------------------------------------------------------------------
# Calibration


def calibration_of(message: Any) -> dict[str, Any]:
    """Keys and values of a CameraInfo message, as in the files of camera_calibration."""
    d, k, r, p = (_letters(message, letter) for letter in "dkrp")
    return {
        "image_width": int(message.width),
        "image_height": int(message.height),
        "distortion_model": message.distortion_model,
        "camera_matrix": {"data": k},
        "distortion_coefficients": {"data": d},
        "rectification_matrix": {"data": r},
        "projection_matrix": {"data": p},
    }


def _letters(message: Any, letter: str) -> list[float]:
    # Capital in ROS 1, small in ROS 2.
    values = getattr(message, letter, None)
    return [float(v) for v in (getattr(message, letter.upper()) if values is None else values)]


# --------------------------------------------------------------------------------------------
# Motion


def motion_of(message: Any) -> FloatArray:
    """The numbers of a message by its type.

    Of an Odometry (7,) position and quaternion x, y, z, w; of a twist (2,) m/s and rad/s; of an Imu
    (3,) rad/s about its axes.
    """
    if hasattr(message, "angular_velocity"):
        rate = message.angular_velocity
        return np.array([rate.x, rate.y, rate.z])
    if hasattr(message, "pose"):
        p, q = message.pose.pose.position, message.pose.pose.orientation
        return np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w])
    twist = getattr(message.twist, "twist", message.twist)
    return np.array([twist.linear.x, twist.angular.z])
