"""What the messages of a bag mean: images, depth, calibrations, motions, transforms of frames."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import CalibrationError, FrameError
from fgslam.core.geometry import (
    BODY_FORWARD_LEFT_UP_FROM_CAMERA,
    inverse,
    pose,
    rotation_from_quaternion,
)
from fgslam.datasets.images import (
    decode_colour,
    decode_grey,
    decode_stored,
    of_8_bits,
    without_unknown,
)

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
ODOMETRY = "nav_msgs/msg/Odometry"
TWIST = "geometry_msgs/msg/TwistStamped"
TWIST_WITH_COVARIANCE = "geometry_msgs/msg/TwistWithCovarianceStamped"
IMU = "sensor_msgs/msg/Imu"
NUMBER = "std_msgs/msg/Float32"
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")

# --------------------------------------------------------------------------------------------
# Images and depth


_Codes: TypeAlias = tuple[int | None, int | None]
"""Of cv2.cvtColor: how pixels become grey, and red, green, blue; None: as they are."""

# ROS names the first pixels of the first two rows, OpenCV those of the second row from the second.
_MOSAICS: Mapping[str, _Codes] = {
    f"bayer_{pattern}{bits}": (grey, colour)
    for pattern, grey, colour in (
        ("rggb", cv2.COLOR_BayerBG2GRAY, cv2.COLOR_BayerBG2RGB),
        ("bggr", cv2.COLOR_BayerRG2GRAY, cv2.COLOR_BayerRG2RGB),
        ("gbrg", cv2.COLOR_BayerGR2GRAY, cv2.COLOR_BayerGR2RGB),
        ("grbg", cv2.COLOR_BayerGB2GRAY, cv2.COLOR_BayerGB2RGB),
    )
    for bits in (8, 16)
}
_ENCODINGS: Mapping[str, tuple[int, _Codes]] = {
    name: (channels, (grey, colour))
    for names, channels, grey, colour in (
        ("mono8 8UC1 mono16 16UC1", 1, None, None),
        ("bgr8 8UC3 bgr16", 3, cv2.COLOR_BGR2GRAY, cv2.COLOR_BGR2RGB),
        ("rgb8 rgb16", 3, cv2.COLOR_RGB2GRAY, None),
        ("bgra8 8UC4", 4, cv2.COLOR_BGRA2GRAY, cv2.COLOR_BGRA2RGB),
        ("rgba8", 4, cv2.COLOR_RGBA2GRAY, cv2.COLOR_RGBA2RGB),
        ("yuv422 uyvy", 2, cv2.COLOR_YUV2GRAY_UYVY, cv2.COLOR_YUV2RGB_UYVY),
        ("yuv422_yuy2 yuyv", 2, cv2.COLOR_YUV2GRAY_YUYV, cv2.COLOR_YUV2RGB_YUYV),
        ("nv12", 1, cv2.COLOR_YUV2GRAY_NV12, cv2.COLOR_YUV2RGB_NV12),
        ("nv21", 1, cv2.COLOR_YUV2GRAY_NV21, cv2.COLOR_YUV2RGB_NV21),
    )
    for name in names.split()
} | {name: (1, codes) for name, codes in _MOSAICS.items()}
"""Encodings of an Image: channels, and how they become grey and colour."""


def image_of(message: Any, where: str, bits: int = 16, colour: bool = False) -> Image:
    """Grey (height, width) of an Image or CompressedImage; or red, green, blue, if it has colour.

    Args:
        message: the message.
        where: in messages to the user.
        bits: that pixels of 16 bits hold.
        colour: whether colours are asked for.

    Raises:
        FrameError: its encoding is not known, or its data are incomplete.
    """
    if hasattr(message, "encoding"):
        pixels = stored_of(message, where)
        codes = _ENCODINGS[message.encoding][1]
    else:
        decode = decode_colour if colour else decode_grey
        data = bytes(memoryview(message.data))
        mosaic = _MOSAICS.get(message.format.partition(";")[0])
        if mosaic is None and not colour:
            return decode_grey(data, where, bits)
        pixels = decode_stored(data, where)
        if pixels.ndim == 3:
            return decode(data, where, bits)
        codes = mosaic or (None, None)
    code = codes[colour]
    if code is not None:
        pixels = cv2.cvtColor(np.ascontiguousarray(pixels), code)
    return of_8_bits(pixels, where, bits)


def stored_of(message: Any, where: str) -> npt.NDArray[Any]:
    """The pixels as they are stored. Raises FrameError as :func:`image_of`."""
    if not hasattr(message, "encoding"):
        return decode_stored(bytes(memoryview(message.data)), where)
    encoding = message.encoding
    if encoding not in _ENCODINGS:
        known = ", ".join(_ENCODINGS)
        raise FrameError(f"{where}: encoding {encoding!r} is not read; known: {known}")
    # Of nv12 and nv21 a plane of colours of half the height follows that of grey.
    half = int(message.height) // 2 if encoding.startswith("nv") else 0
    return _pixels(message, _ENCODINGS[encoding][0], where, half)


def _pixels(message: Any, channels: int, where: str, more_rows: int = 0) -> npt.NDArray[Any]:
    """Pixels (height + more_rows, width[, channels]) without the padding of their rows."""
    encoding = message.encoding
    wide = encoding.endswith("16") or encoding.startswith("16")
    kind = np.dtype(np.float32 if encoding == "32FC1" else np.uint16 if wide else np.uint8)
    if kind.itemsize > 1 and message.is_bigendian:
        kind = kind.newbyteorder(">")
    data = np.frombuffer(memoryview(message.data), np.uint8)
    height, used = int(message.height) + more_rows, int(message.width) * channels * kind.itemsize
    step = int(message.step) or used
    odd = more_rows and (int(message.height) % 2 or int(message.width) % 2)
    if height < 1 or used < 1 or step < used or len(data) < height * step or odd:
        raise FrameError(
            f"{where}: {len(data)} bytes are no image of {message.width}x{message.height} "
            f"{encoding}; record it again"
        )
    rows = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :used])
    pixels = rows.view(kind).astype(kind.newbyteorder("="), copy=False)
    return pixels if channels == 1 else pixels.reshape(height, -1, channels)


_HEADER = 12  # bytes before a compressed depth: a kind, and two numbers by which floats are coded


def depth_of(message: Any, where: str) -> npt.NDArray[Any]:
    """Depths (height, width) of an Image or CompressedImage as stored; 0 or NaN where unknown.

    Integers are in a unit of their own (by REP 118 millimetres), floats metres; the transport of
    compressed depth codes floats by their inverse.

    Raises:
        FrameError: it is no depth, or its data are incomplete.
    """
    if hasattr(message, "encoding"):
        if message.encoding not in ("32FC1", "16UC1", "mono16"):
            raise FrameError(
                f"{where}: encoding {message.encoding!r} is no depth: 16UC1 or 32FC1 is"
            )
        stored = _pixels(message, 1, where)
        if message.encoding == "32FC1":
            return stored
    else:
        data = bytes(memoryview(message.data))
        packed = "compressedDepth" in message.format
        if "rvl" in message.format.lower():
            raise FrameError(f"{where}: depth in the format RVL is not read; record it as PNG")
        stored = decode_stored(data[_HEADER:] if packed else data, where)
        if stored.dtype != np.uint16 or stored.ndim != 2:
            text = f"{where}: its images of {stored.dtype} are no depth; record them as PNG"
            raise FrameError(text)
        if packed and message.format.startswith("32FC1"):
            a, b = np.frombuffer(data[4:_HEADER], "<f4")
            with np.errstate(divide="ignore"):
                inverses = a / (stored.astype(np.float32) - b)
            return np.where(stored > 0, inverses, np.float32(np.nan))
    return without_unknown(stored)


# --------------------------------------------------------------------------------------------
# Calibration, motion


def calibration_of(message: Any) -> dict[str, Any]:
    """Keys and values of a CameraInfo message, as in the files of camera_calibration.

    ``binning`` and ``roi`` (columns and rows) say which part of the calibrated image is sent.
    """

    def numbers(letter: str) -> dict[str, list[float]]:  # capital in ROS 1, small in ROS 2
        values = getattr(message, letter, None)
        values = getattr(message, letter.upper()) if values is None else values
        return {"data": [float(v) for v in values]}

    roi = message.roi
    return {
        "image_width": int(message.width),
        "image_height": int(message.height),
        "distortion_model": message.distortion_model,
        "distortion_coefficients": numbers("d"),
        "camera_matrix": numbers("k"),
        "rectification_matrix": numbers("r"),
        "projection_matrix": numbers("p"),
        "binning": (max(int(message.binning_x), 1), max(int(message.binning_y), 1)),
        "roi": tuple(int(v) for v in (roi.x_offset, roi.y_offset, roi.width, roi.height)),
    }


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


# --------------------------------------------------------------------------------------------
# Where frames sit on the robot


_NAMED = 8  # frames that a message lists
_STILL = 1e-5  # metres, and of a quaternion; less is rounding
_UPWARD = 0.7071  # cosine of 45 degrees


def frame_of(message: Any) -> str:
    """The frame in which a message is given; of an Odometry that whose motion it is."""
    own = message.header.frame_id
    return str(getattr(message, "child_frame_id", own)).strip("/")


def transforms_of(message: Any) -> list[tuple[str, str, FloatArray]]:
    """Of a TFMessage: parent, child, and (7,) position and quaternion x, y, z, w of the child."""
    found = []
    for each in message.transforms:
        p, q = each.transform.translation, each.transform.rotation
        numbers = np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w])
        found.append((each.header.frame_id.strip("/"), each.child_frame_id.strip("/"), numbers))
    return found


class FrameTree:
    """Transforms between frames that do not move against each other."""

    def __init__(self) -> None:
        """An empty tree."""
        self._parents: dict[str, tuple[str, FloatArray]] = {}
        self._moving: set[str] = set()

    def add(self, transforms: Iterable[tuple[str, str, FloatArray]], static: bool) -> None:
        """Takes parent, child, and (7,) position and quaternion x, y, z, w of the child in it.

        Of several transforms of one child the last counts, as in tf. Those that are not from
        tf_static count as long as they stay the same.
        """
        for parent, child, numbers in transforms:
            name, before = self._parents.get(child, ("", numbers))
            if not static and name == parent and np.abs(before - numbers).max() > _STILL:
                self._moving.add(child)
                del self._parents[child]
            if child not in self._moving:
                self._parents[child] = parent, numbers

    @property
    def frames(self) -> set[str]:
        """Names of all frames."""
        return {*self._parents, *(parent for parent, _ in self._parents.values())}

    def pose(self, frame: str, base: str) -> FloatArray:
        """Pose (4, 4) of a frame in the axes of another.

        Raises:
            CalibrationError: the tree does not connect them, runs in a circle, or has a number that
                is none.
        """
        names = sorted(self.frames)
        above = []  # of both frames the poses in themselves and in all above, nearest first
        for at in (frame, base):
            if at not in names:
                more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
                raise CalibrationError(
                    f"tf_static has no frame {at or 'without a name'}; it has "
                    f"{', '.join(names[:_NAMED]) + more or 'none'}"
                )
            found = {at: np.eye(4)}
            while at in self._parents:
                parent, numbers = self._parents[at]
                if parent in found:
                    circle = " under ".join([*list(found)[list(found).index(parent) :], parent])
                    raise CalibrationError(f"tf_static runs in a circle: {circle}")
                if not np.isfinite(numbers).all() or np.linalg.norm(numbers[3:]) <= 0.5:
                    listed = ", ".join(f"{v:g}" for v in numbers)
                    raise CalibrationError(f"tf_static: the transform of {at} is none: {listed}")
                found[parent] = pose(rotation_from_quaternion(numbers[3:]), numbers[:3]) @ found[at]
                at = parent
            above.append(found)
        common = next((name for name in above[0] if name in above[1]), None)
        if common is None:
            raise CalibrationError(f"tf_static does not connect {frame} with {base}")
        return np.asarray(inverse(above[1][common]) @ above[0][common])


def view_axes(tree: FrameTree, left: str, right: str, body: str) -> tuple[FloatArray, str]:
    """Pose (4, 4) of a camera in its frame, and what was assumed.

    Images are given in axes x right, y down, z ahead, and their frame's name states "optical"
    (REP 103). Some give a frame with the axes of a robot, x ahead and z up: there the cameras sit
    next to each other along y, or would point upwards.
    """
    robot = False
    if "optical" not in left + right:
        try:
            apart = tree.pose(left, right)[:3, 3]
            robot = abs(apart[1]) > 2.0 * abs(apart[0])
            if not apart.any():
                robot = tree.pose(right, body)[2, 2] > _UPWARD
        except CalibrationError:
            robot = False
    if not robot:
        return np.eye(4), ""
    return BODY_FORWARD_LEFT_UP_FROM_CAMERA, (
        f"frame {right} of the camera has the axes of a robot, z up: the camera is taken to look "
        "along its x axis"
    )
