"""Image files: listing a folder, reading one image completely or not at all, frames of a rig."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from fgslam.cameras.rig import StereoRig
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import CalibrationError, DatasetError, FrameError
from fgslam.core.files import require_file
from fgslam.core.sensors import CAMERA_NAMES
from fgslam.datasets.image_bytes import fault_of_bytes
from fgslam.datasets.loose_files import IMAGE_SUFFIXES


def list_numbered_images(folder: Path) -> dict[int, Path]:
    """Images of a folder by the number that is their name (``000012.png`` is 12).

    Raises:
        DatasetError: two images carry the same number.
    """
    numbered: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in IMAGE_SUFFIXES or not path.stem.isdecimal():
            continue
        number = int(path.stem)
        if number in numbered:
            raise DatasetError(
                f"{folder} has two images of frame {number}: {numbered[number].name} and "
                f"{path.name}; remove one"
            )
        numbered[number] = path
    return numbered


def read_grey_image(path: Path, bits: int = 16) -> Image:
    """The image (height, width) in grey, uint8; ``bits`` are those that 16 of a pixel hold.

    A truncated or damaged file is refused, never returned half grey.

    Raises:
        FrameError: the file is absent, incomplete or no image.
    """
    return decode_grey(_bytes_of(path), str(path), bits)


def read_sized_image(path: Path, width: int, height: int, bits: int = 16) -> Image:
    """The image in grey, as :func:`read_grey_image`. Raises FrameError if of another size, too."""
    return sized(read_grey_image(path, bits), f"image {path}", width, height)


def sized(image: Image, name: str, width: int, height: int) -> Image:
    """The image itself. Raises FrameError where it has another size than calibrated."""
    if image.shape[:2] != (height, width):
        raise FrameError(
            f"{name} is {size(image)} but the calibration says {width}x{height}; restore the "
            "right file"
        )
    return image


def read_colour_image(path: Path, bits: int = 16) -> Image:
    """The image (height, width, 3) in red, green, blue, uint8; else as :func:`read_grey_image`."""
    return decode_colour(_bytes_of(path), str(path), bits)


def encoded_png(image: Image) -> bytes:
    """A grey image, or one in red, green, blue, as a PNG file."""
    shown = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    return bytes(cv2.imencode(".png", shown)[1])


def read_depth_image(path: Path) -> npt.NDArray[Any]:
    """A depth image (height, width), uint16 or float, as it is stored; 0 where unknown.

    The largest integer is no depth: 7-Scenes and saturated sensors mark with it what is unknown.

    Raises:
        FrameError: absent, incomplete, no image, or of colours or 8 bits.
    """
    image = _decoded(_bytes_of(path), str(path), cv2.IMREAD_UNCHANGED)
    if image.ndim != 2 or image.dtype == np.uint8:
        raise FrameError(
            f"image {path} is no depth image: {image.dtype} of {image.ndim} dimensions; 16 bits or "
            "floats of one channel are needed"
        )
    return without_unknown(image)


def without_unknown(depth: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Depths with 0 for the largest value of 16 bits."""
    if depth.dtype != np.uint16:
        return depth
    return np.where(depth == np.iinfo(np.uint16).max, np.uint16(0), depth)


def decode_grey(data: bytes, name: str, bits: int = 16) -> Image:
    """The image (height, width) in grey, uint8, of an encoded image's bytes.

    Of more than 8 bits the upper 8 are kept (:func:`of_8_bits`).

    Args:
        data: PNG, JPEG or another known format.
        name: in messages.
        bits: that 16 of a pixel hold.

    Raises:
        FrameError: incomplete, or no image.
    """
    return of_8_bits(_decoded(data, name, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH), name, bits)


def decode_colour(data: bytes, name: str, bits: int = 16) -> Image:
    """The image (height, width, 3) in red, green, blue, uint8; else as :func:`decode_grey`."""
    image = of_8_bits(_decoded(data, name, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH), name, bits)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def decode_stored(data: bytes, name: str) -> npt.NDArray[Any]:
    """An encoded image's pixels as they are stored. Raises FrameError as :func:`decode_grey`."""
    return _decoded(data, name, cv2.IMREAD_UNCHANGED)


# --------------------------------------------------------------------------------------------
# More than eight bits


_BITS = (8, 10, 12, 14, 16)
"""Of the sensors whose pixels are stored in 16."""

_LOOKED_AT = 9  # frames from first to last, by which it is decided how many bits are used


def of_8_bits(image: npt.NDArray[Any], name: str, bits: int = 16) -> Image:
    """The upper eight of ``bits`` bits of 16-bit pixels, what is brighter as 255; uint8 as it is.

    One number of bits for a recording (:func:`bits_held`): stretching each image to its own
    contrast would change its features from frame to frame. Raises FrameError for other types.
    """
    if image.dtype == np.uint16:
        return np.ascontiguousarray(np.minimum(image >> (bits - 8), 255), np.uint8)
    if image.dtype != np.uint8:
        raise FrameError(
            f"image {name} has pixels of type {image.dtype}; convert it to 8 or 16 bits a pixel"
        )
    return np.ascontiguousarray(image, np.uint8)


def bits_held(count: int, stored: Callable[[int], npt.NDArray[Any]]) -> tuple[int, tuple[str, ...]]:
    """How many bits the 16-bit images of a recording hold, and a note where fewer than 16.

    By the largest value of a few frames over the whole recording; 16 where images have 8 bits, or
    nothing can be read.

    Args:
        count: of frames.
        stored: the pixels of a frame as they are stored; raises FrameError.
    """
    largest = 0
    for frame in np.unique(np.linspace(0, count - 1, _LOOKED_AT).astype(int)).tolist():
        try:
            pixels = stored(frame)
        except FrameError:
            continue
        if pixels.dtype != np.uint16:
            return 16, ()
        largest = max(largest, int(pixels.max()))
    bits = next(bits for bits in _BITS if largest < 1 << bits) if largest else 16
    if bits == 16:
        return bits, ()
    return bits, (
        f"pixels of 16 bits hold {bits}: none of {min(count, _LOOKED_AT)} frames looked at has one "
        f"above {largest}; {(1 << bits) - 1} is taken as white",
    )


def bits_of(paths: Sequence[Path]) -> tuple[int, tuple[str, ...]]:
    """:func:`bits_held` of image files, one a frame."""
    return bits_held(len(paths), lambda k: decode_stored(_bytes_of(paths[k]), str(paths[k])))


# --------------------------------------------------------------------------------------------
# Mosaics of colours


_MOSAIC = 1.2
"""Neighbours' difference over that of the next but one: 0.50 to 0.87 in 97 grey pictures, 1.00 in
noise alone, 1.5 to 13 in mosaics of colourful ones."""


def mosaic_note(count: int, grey: Callable[[int], Image]) -> tuple[str, ...]:
    """What to tell where images are mosaics of a colour filter (Bayer's) and not of grey pixels.

    In one, pixels next to each other differ more than those two apart, which have one colour; in a
    grey image they differ less, and as much only in noise.

    Args:
        count: of frames.
        grey: an image of a frame; raises FrameError.
    """
    found = []
    for frame in sorted({0, count // 2, count - 1}):
        try:
            found.append(_neighbours(grey(frame)))
        except FrameError:
            continue
    if not found or np.median(found) < _MOSAIC:
        return ()
    return (
        f"neighbouring pixels differ {np.median(found):.2g} times as much as those two apart: the "
        "images look like the raw mosaic of a colour camera (Bayer), whose pattern features see; "
        "convert them, e.g. by OpenCV's cvtColor with COLOR_BayerGB2GRAY or as the camera has it",
    )


def _neighbours(image: Image) -> float:
    """Mean difference of neighbours over that of the next but one; of both axes the smaller."""
    if min(image.shape) < 3:
        return 0.0
    pixels = image.astype(np.float32)
    ratios = []
    for turned in (pixels, pixels.T):
        one, two = (np.abs(turned[k:] - turned[:-k]).mean() for k in (1, 2))
        ratios.append(float(one) / max(float(two), 1e-9))
    return min(ratios)


def _bytes_of(path: Path) -> bytes:
    remedy = "restore the file, or leave the frame out with dataset.start/stop/stride"
    if path.exists() and not path.is_file():
        require_file(path, FrameError, remedy)  # who reads a pipe waits, a device may have no end
    try:
        return path.read_bytes()
    except OSError as cause:
        raise FrameError(f"image {path} cannot be read: {cause.strerror}; {remedy}") from cause


def _decoded(data: bytes, name: str, mode: int) -> npt.NDArray[Any]:
    fault = fault_of_bytes(data)
    if fault is not None:
        raise FrameError(f"image {name} {fault}")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), mode) if data else None
    except cv2.error:  # absurd sizes in a damaged header
        image = None
    if image is None:
        raise FrameError(f"image {name} is not an image that can be decoded; restore the file")
    return image


# --------------------------------------------------------------------------------------------
# Frames of several cameras


_NAMED_IN_NOTES = 5


@dataclass(frozen=True, eq=False)
class StereoFiles:
    """Where the images of every frame are; readable by index.

    Attributes:
        paths: per frame the files of right, left[, top] camera; they need not exist.
        width, height: the calibrated size in pixels.
        bits: that pixels of 16 bits hold.
    """

    paths: tuple[tuple[Path, ...], ...]
    width: int
    height: int
    bits: int = 16

    def load(self, index: int) -> tuple[Image, ...]:
        """Images of a frame. Raises FrameError when one is missing, damaged or of another size."""
        return tuple(
            read_sized_image(path, self.width, self.height, self.bits) for path in self.paths[index]
        )

    def load_colour(self, index: int) -> tuple[Image, ...]:
        """The same in red, green, blue."""
        return tuple(
            sized(read_colour_image(path, self.bits), f"image {path}", self.width, self.height)
            for path in self.paths[index]
        )

    def with_bits(self) -> tuple[StereoFiles, tuple[str, ...]]:
        """The same, with as many bits as the right images hold, and what to tell of them."""
        right = [paths[0] for paths in self.paths]
        bits, notes = bits_of(right)
        seen = mosaic_note(len(right), lambda frame: read_grey_image(right[frame], bits))
        return replace(self, bits=bits), (*notes, *seen)

    def first_images(self) -> tuple[Image, ...] | None:
        """Images of the first frame that can be read, whatever their size; None without any."""
        for paths in self.paths:
            try:
                return tuple(read_grey_image(path) for path in paths)
            except FrameError:
                continue
        return None


@dataclass(frozen=True, eq=False)
class RawImages:
    """Raw images of a rig, rectified when read."""

    files: StereoFiles
    rig: StereoRig

    def load(self, index: int) -> tuple[Image, ...]:
        """Rectified (right, left[, top]) images. Raises FrameError as StereoFiles does."""
        return self.rig.rectified(self.files.load(index))

    def load_colour(self, index: int) -> tuple[Image, ...]:
        """The same in red, green, blue."""
        return self.rig.rectified(self.files.load_colour(index))


def first_size(paths: Iterable[Path]) -> tuple[int, int] | None:
    """Width and height of the first image that can be read; None without any."""
    for path in paths:
        try:
            height, width = read_grey_image(path).shape
        except FrameError:
            continue
        return width, height
    return None


def size(image: Image) -> str:
    """Width and height in words."""
    return f"{image.shape[1]}x{image.shape[0]}"


def check_sizes(files: StereoFiles, where: Path) -> None:
    """Compare the first readable frame with the calibration; later frames are checked when read.

    Raises:
        DatasetError: no frame can be read, or the cameras' images differ in size.
        CalibrationError: their size is not the calibrated one.
    """
    images = files.first_images()
    if images is None:
        raise DatasetError(
            f"{where}: not one of {len(files.paths)} frames has a readable image from each of "
            f"{len(files.paths[0])} cameras; {_why_unreadable(files.paths[0])}"
        )
    sizes = [size(image) for image in images]
    if len(set(sizes)) > 1:
        named = ", ".join(f"{n} {s}" for n, s in zip(CAMERA_NAMES, sizes, strict=False))
        raise DatasetError(
            f"{where}: the cameras' images differ in size ({named}); all must be rectified to one "
            "size: resize the larger ones, and calibrate them so"
        )
    if sizes[0] != f"{files.width}x{files.height}":
        raise CalibrationError(
            f"{where}: images are {sizes[0]} but the calibration says {files.width}x{files.height}"
            "; if the images were resized, scale fx, fy, cx, cy, width and height alike"
        )


def _why_unreadable(paths: Sequence[Path]) -> str:
    """What is wrong with the images of the first frame."""
    if not all(path.exists() for path in paths):
        return "check that the file names fit the list of times"
    try:
        for path in paths:
            read_grey_image(path)
    except FrameError as error:
        return f"of the first: {error}"
    return "restore the files"


def missing_notes(files: StereoFiles, stamps: FloatArray) -> tuple[str, ...]:
    """In words, which frames lack an image (existence only: damage shows when reading)."""
    missing = [
        (k, CAMERA_NAMES[c])
        for k, paths in enumerate(files.paths)
        for c, path in enumerate(paths)
        if not path.is_file()
    ]
    frames = sorted({k for k, _ in missing})
    if not frames:
        return ()
    first = ", ".join(f"{k} ({camera})" for k, camera in missing[:_NAMED_IN_NOTES])
    more = ", ..." if len(missing) > _NAMED_IN_NOTES else ""
    return (f"{len(frames)} of {len(stamps)} frames lack an image: {first}{more}",)


def require_folder(path: Path, what: str) -> None:
    """Raises DatasetError unless the folder exists."""
    if not path.is_dir():
        raise DatasetError(
            f"{what} {path} does not exist; check dataset.path and the layout, or say where the "
            "recording is: --set dataset.path=FOLDER"
        )
