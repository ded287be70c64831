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
    is_rigid,
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
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")

# --------------------------------------------------------------------------------------------
# Images


_Code: TypeAlias = int | None  # of cv2.cvtColor; None: the pixels as they are

_GREY = {"mono8", "8UC1", "mono16", "16UC1"}

_PLANES: Mapping[str, int] = {"nv12": cv2.COLOR_YUV2RGB_NV12, "nv21": cv2.COLOR_YUV2RGB_NV21}
"""Encodings of a plane of grey, and one of two colours and half its height below it."""

_COLOURS: Mapping[str, tuple[int, _Code, _Code]] = {
    **dict.fromkeys(("bgr8", "8UC3", "bgr16"), (3, cv2.COLOR_BGR2GRAY, cv2.COLOR_BGR2RGB)),
    **dict.fromkeys(("rgb8", "rgb16"), (3, cv2.COLOR_RGB2GRAY, None)),
    **dict.fromkeys(("bgra8", "8UC4"), (4, cv2.COLOR_BGRA2GRAY, cv2.COLOR_BGRA2RGB)),
    "rgba8": (4, cv2.COLOR_RGBA2GRAY, cv2.COLOR_RGBA2RGB),
    **dict.fromkeys(("yuv422", "uyvy"), (2, cv2.COLOR_YUV2GRAY_UYVY, cv2.COLOR_YUV2RGB_UYVY)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (2, cv2.COLOR_YUV2GRAY_YUYV, cv2.COLOR_YUV2RGB_YUYV)),
}
"""Encodings of colour: channels, and how they become grey, and red, green, blue."""

# ROS names the first pixels of the first two rows, OpenCV those of the second row from the second.
_MOSAICS = {
    "rggb": (cv2.COLOR_BayerBG2GRAY, cv2.COLOR_BayerBG2RGB),
    "bggr": (cv2.COLOR_BayerRG2GRAY, cv2.COLOR_BayerRG2RGB),
    "gbrg": (cv2.COLOR_BayerGR2GRAY, cv2.COLOR_BayerGR2RGB),
    "grbg": (cv2.COLOR_BayerGB2GRAY, cv2.COLOR_BayerGB2RGB),
}


def grey_of(message: Any, where: str, bits: int = 16) -> Image:
    """Grey image (height, width), uint8, of an Image or CompressedImage message.

    Args:
        message: the message.
        where: in messages to the user.
        bits: that pixels of 16 bits hold.

    Raises:
        FrameError: its encoding is not known, or its data are incomplete.
    """
    if hasattr(message, "encoding"):
        pixels, grey, _ = _raw(message, where)
        return of_8_bits(_converted(pixels, grey), where, bits)
    data, mosaic = _compressed(message)
    if mosaic is not None and (stored := decode_stored(data, where)).ndim == 2:
        return of_8_bits(_converted(stored, mosaic[0]), where, bits)
    return decode_grey(data, where, bits)


def colour_of(message: Any, where: str, bits: int = 16) -> Image:
    """The same in red, green, blue, (height, width, 3); in grey where it has no colour."""
    if hasattr(message, "encoding"):
        if message.encoding in _PLANES:
            return _colour_of_planes(message, where)
        pixels, _, colour = _raw(message, where)
        return of_8_bits(_converted(pixels, colour), where, bits)
    data, mosaic = _compressed(message)
    stored = decode_stored(data, where)
    if stored.ndim == 2:
        return of_8_bits(stored if mosaic is None else _converted(stored, mosaic[1]), where, bits)
    return decode_colour(data, where, bits)


def stored_of(message: Any, where: str) -> npt.NDArray[Any]:
    """The pixels as they are stored. Raises FrameError as :func:`grey_of`."""
    if hasattr(message, "encoding"):
        return _raw(message, where)[0]
    return decode_stored(_compressed(message)[0], where)


def _raw(message: Any, where: str) -> tuple[npt.NDArray[Any], _Code, _Code]:
    """Pixels (height, width[, channels]), and how they become grey, and red, green, blue."""
    encoding, height, width = message.encoding, int(message.height), int(message.width)
    mosaic = _mosaic_of(encoding)
    if encoding not in (*_GREY, *_PLANES, *_COLOURS) and mosaic is None:
        known = ", ".join((*sorted(_GREY), *_PLANES, *_COLOURS, "bayer_*"))
        raise FrameError(f"{where}: encoding {encoding!r} is not read; known: {known}")
    channels, grey, colour = _COLOURS.get(encoding, (1, *(mosaic or (None, None))))
    pixels = _pixels(message, encoding, channels, where)
    shape = (height, width) if channels == 1 else (height, width, channels)
    return pixels.reshape(shape), grey, colour


def _colour_of_planes(message: Any, where: str) -> Image:
    """Red, green, blue (height, width, 3) of grey above colours of half the resolution."""
    height, width = int(message.height), int(message.width)
    if height % 2 or width % 2:
        raise FrameError(
            f"{where}: {width}x{height} is no size of {message.encoding}, whose colours belong to "
            "two by two pixels; record it in another encoding"
        )
    pixels = _pixels(message, message.encoding, 1, where, planes=1.5)
    return np.asarray(cv2.cvtColor(pixels, _PLANES[message.encoding]), np.uint8)


def _compressed(message: Any) -> tuple[bytes, tuple[int, int] | None]:
    """The encoded image, and how its mosaic becomes grey and colour, where it may be one."""
    mosaic = _mosaic_of(message.format.partition(";")[0])
    return bytes(memoryview(message.data)), mosaic


def _converted(pixels: npt.NDArray[Any], code: _Code) -> npt.NDArray[Any]:
    return pixels if code is None else cv2.cvtColor(np.ascontiguousarray(pixels), code)


def _mosaic_of(encoding: str) -> tuple[int, int] | None:
    return _MOSAICS.get(encoding[6:10]) if encoding.startswith("bayer_") else None


def _pixels(
    message: Any, encoding: str, channels: int, where: str, planes: float = 1.0
) -> npt.NDArray[Any]:
    """The rows of the image, ``planes`` times its height, without their padding."""
    wide = encoding.endswith("16") or encoding.startswith("16")
    kind = np.dtype(np.float32 if encoding == "32FC1" else np.uint16 if wide else np.uint8)
    if kind.itemsize > 1 and message.is_bigendian:
        kind = kind.newbyteorder(">")
    data = np.frombuffer(memoryview(message.data), np.uint8)
    height = int(planes * int(message.height))
    used = int(message.width) * channels * kind.itemsize
    step = int(message.step) or used
    if height < 1 or used < 1 or step < used or len(data) < height * step:
        raise FrameError(
            f"{where}: {len(data)} bytes are no image of {message.width}x{message.height} "
            f"{encoding}; record it again"
        )
    rows = data[: height * step].reshape(height, step)[:, :used]
    return np.ascontiguousarray(rows).view(kind).astype(kind.newbyteorder("="), copy=False)


# --------------------------------------------------------------------------------------------
# Depth


_HEADER = 12  # bytes before a compressed depth: a kind, and two numbers by which floats are coded


def depth_of(message: Any, where: str) -> npt.NDArray[np.float32]:
    """Depths (height, width) in metres of an Image or CompressedImage; 0 or NaN where unknown.

    Integers are millimetres, floats metres (REP 118); the transport of compressed depth codes
    floats by their inverse.

    Raises:
        FrameError: it is no depth, or its data are incomplete.
    """
    if hasattr(message, "encoding"):
        if message.encoding not in ("32FC1", "16UC1", "mono16"):
            raise FrameError(
                f"{where}: encoding {message.encoding!r} is no depth: 16UC1 or 32FC1 is"
            )
        pixels = _pixels(message, message.encoding, 1, where)
        return pixels if message.encoding == "32FC1" else _of_millimetres(pixels)
    data = bytes(memoryview(message.data))
    packed = "compressedDepth" in message.format
    if "rvl" in message.format.lower():
        raise FrameError(f"{where}: depth in the format RVL is not read; record it as PNG, or raw")
    stored = decode_stored(data[_HEADER:] if packed else data, where)
    if stored.dtype != np.uint16 or stored.ndim != 2:
        raise FrameError(f"{where}: its images of {stored.dtype} are no depth; record them as PNG")
    if packed and message.format.startswith("32FC1"):
        a, b = np.frombuffer(data[4:_HEADER], "<f4")
        with np.errstate(divide="ignore"):
            return np.where(stored > 0, a / (stored.astype(np.float32) - b), np.float32(np.nan))
    return _of_millimetres(stored)


def _of_millimetres(pixels: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    return without_unknown(pixels).astype(np.float32) * np.float32(1e-3)


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

    def __init__(self, transforms: Iterable[tuple[str, str, FloatArray]] = ()) -> None:
        """Takes what :meth:`add` takes."""
        self._parents: dict[str, tuple[str, FloatArray]] = {}
        self._moving: set[str] = set()
        self._other: dict[str, str] = {}
        self.add(transforms, static=True)

    def add(self, transforms: Iterable[tuple[str, str, FloatArray]], static: bool) -> None:
        """Takes parent, child, and (7,) position and quaternion x, y, z, w of the child in it.

        Of several transforms of one child the last counts, as in tf. Those that are not from
        tf_static count as long as they stay the same.
        """
        for parent, child, numbers in transforms:
            if child in self._moving:
                continue
            before = self._parents.get(child)
            if before is not None and before[0] != parent:
                text = f"{child} has two parents, {before[0]} and {parent}; the latter counts"
                self._other[child] = f"tf_static: {text}"
            elif before is not None and not static and np.abs(before[1] - numbers).max() > _STILL:
                self._moving.add(child)
                del self._parents[child]
                continue
            self._parents[child] = parent, numbers

    @property
    def notes(self) -> tuple[str, ...]:
        """What is not as it should be, a line each."""
        return tuple(self._other.values())

    def __bool__(self) -> bool:
        return bool(self._parents)

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
        for name in (frame, base):
            if name not in names:
                more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
                raise CalibrationError(
                    f"tf_static has no frame {name or 'without a name'}; it has "
                    f"{', '.join(names[:_NAMED]) + more or 'none'}"
                )
        ups = [self._up(name) for name in (frame, base)]
        common = next((name for name in ups[0] if name in ups[1]), None)
        if common is None:
            raise CalibrationError(f"tf_static does not connect {frame} with {base}")
        return np.asarray(inverse(ups[1][common]) @ ups[0][common])

    def _up(self, frame: str) -> dict[str, FloatArray]:
        """Poses of a frame in itself and in all that are above it, nearest first."""
        found = {frame: np.eye(4)}
        while frame in self._parents:
            parent, numbers = self._parents[frame]
            if parent in found:
                circle = " under ".join([*list(found)[list(found).index(parent) :], parent])
                raise CalibrationError(f"tf_static runs in a circle: {circle}")
            found[parent] = _rigid_pose(frame, numbers) @ found[frame]
            frame = parent
        return found


def _rigid_pose(child: str, numbers: FloatArray) -> FloatArray:
    quaternion = numbers[3:]
    if np.isfinite(numbers).all() and np.linalg.norm(quaternion) > 0.5:
        found = pose(rotation_from_quaternion(quaternion), numbers[:3])
        if is_rigid(found):
            return found
    raise CalibrationError(
        f"tf_static: the transform of {child} is none: {', '.join(f'{v:g}' for v in numbers)}"
    )


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
