"""Image files: read completely or not at all, in 8 bits; the files of all frames of a rig."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from fgslam.cameras.rig import StereoRig
from fgslam.core.arrays import Image, thinned
from fgslam.core.errors import CalibrationError, DatasetError, FrameError, OneImageError
from fgslam.core.files import require_file
from fgslam.core.sensors import CAMERA_NAMES
from fgslam.datasets.layouts import IMAGE_SUFFIXES

ImageLoader: TypeAlias = Callable[[int, bool], tuple[Image, ...]]
"""Images (right, left[, top]) of one of the recording's own frames, grey or, where the flag is set,
in red, green, blue if it has colour; raises FrameError."""

Depth: TypeAlias = npt.NDArray[np.float32]
"""Depths (height, width) in metres; 0, infinite or NaN where unknown."""

DepthLoader: TypeAlias = Callable[[int], Depth]
"""Of one of the recording's own frames the depth of the reference image; raises FrameError."""


# ------------------------------------------------------------------------------------------
# Files of frames

LEAVE_OUT = "leave the frame out by dataset.start, dataset.stop or dataset.stride"
_NAMED_IN_NOTES = 5


def open_frames(
    paths: Sequence[tuple[Path, ...]],
    rig: StereoRig,
    where: Path,
    whole: tuple[int, int] | None = None,
) -> tuple[ImageLoader, tuple[str, ...]]:
    """What reads and rectifies the images of a frame, and what was noticed.

    The first readable frame is checked.

    Args:
        paths: per frame the files of right, left[, top] camera; they need not exist.
        rig: of the cameras.
        where: the recording, in messages.
        whole: width and height of images that show both views; None: each has its own.

    Raises:
        DatasetError: no frame can be read, or the cameras' images differ in size.
        CalibrationError: their size is not the calibrated one.
    """
    bits, size, notes = 16, rig.image_size, []
    if paths:  # else it is refused where frames are selected
        if whole is None:
            _check_sizes(paths, size, where)
        right = [frame[0] for frame in paths]
        bits, held = bits_of(right)
        notes += [*held, *mosaic_note(len(right), lambda k: read_grey_image(right[k], bits))]
    # Existence only: damage shows when reading.
    missing = [
        (k, name)
        for k, frame in enumerate(paths)
        for name, path in zip(CAMERA_NAMES, frame, strict=False)
        if not path.is_file()
    ]
    if missing:
        first = ", ".join(f"{k} ({camera})" for k, camera in missing[:_NAMED_IN_NOTES])
        more = ", ..." if len(missing) > _NAMED_IN_NOTES else ""
        count = len({k for k, _ in missing})
        notes.append(f"{count} of {len(paths)} frames lack an image: {first}{more}")

    def load(index: int, colour: bool) -> tuple[Image, ...]:
        read = read_colour_image if colour else read_grey_image
        if whole is not None:
            (path,) = paths[index]
            shown = require_size(read(path, bits), f"image {path}", *whole)
            return rig.rectified(both_views(shown, size))
        return images_of_cameras(
            lambda path: require_size(read(path, bits), f"image {path}", *size), paths[index], rig
        )

    return load, tuple(notes)


_Place = TypeVar("_Place", Path, int)


def images_of_cameras(
    read: Callable[[_Place], Image], places: Sequence[_Place], rig: StereoRig
) -> tuple[Image, ...]:
    """The rectified images of a frame, by what reads one and where those of its cameras are.

    Raises:
        OneImageError: some cannot be read; its frame is all, with black ones in place of those, and
            the first camera whose own is there.
        FrameError: none can be read.
    """
    images, faults = {}, []
    for camera, place in enumerate(places):
        try:
            images[camera] = read(place)
        except FrameError as error:
            faults.append(error)
    if faults and not images:
        raise faults[0]
    first = min(images)
    black = np.zeros_like(images[first])
    filled = rig.rectified(tuple(images.get(k, black) for k in range(len(places))))
    if faults:
        fault = OneImageError(str(faults[0]))
        fault.frame = filled, first
        raise fault
    return filled


def _check_sizes(paths: Sequence[tuple[Path, ...]], size: tuple[int, int], where: Path) -> None:
    faults: list[FrameError] = []
    of_frames = readable(lambda frame: [read_grey_image(path) for path in frame], paths, faults)
    if (images := next(of_frames, None)) is None:
        why = "check that the file names fit the list of times"
        if all(path.exists() for path in paths[0]):
            why = f"of the first: {faults[0]}"
        raise DatasetError(
            f"{where}: not one of {len(paths)} frames has a readable image from each of "
            f"{len(paths[0])} cameras; {why}"
        )
    sizes = [f"{image.shape[1]}x{image.shape[0]}" for image in images]
    if len(set(sizes)) > 1:
        named = ", ".join(f"{n} {s}" for n, s in zip(CAMERA_NAMES, sizes, strict=False))
        raise DatasetError(
            f"{where}: the cameras' images differ in size ({named}); all must be rectified to one "
            "size: resize the larger ones, and calibrate them so"
        )
    if sizes[0] != f"{size[0]}x{size[1]}":
        raise CalibrationError(
            f"{where}: images are {sizes[0]} but the calibration states {size[0]}x{size[1]}"
            "; if the images were resized, scale fx, fy, cx, cy, width and height alike"
        )


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
                f"{folder} has two of {number}: {numbered[number].name}, {path.name}; remove one"
            )
        numbered[number] = path
    return numbered


def first_size(
    paths: Iterable[Path], faults: list[FrameError] | None = None
) -> tuple[int, int] | None:
    """Width and height of the first image that can be read; None without any; see readable."""
    image = next(readable(read_grey_image, paths, faults), None)
    return None if image is None else (image.shape[1], image.shape[0])


_P = TypeVar("_P")
_T = TypeVar("_T")


def readable(
    read: Callable[[_P], _T], places: Iterable[_P], faults: list[FrameError] | None = None
) -> Iterator[_T]:
    """What is read at those places where nothing is missing or damaged; else ``faults`` grows."""
    for place in places:
        try:
            found = read(place)
        except FrameError as error:
            if faults is not None:
                faults.append(error)
            continue
        yield found


def require_folder(path: Path, what: str) -> None:
    """Raises DatasetError unless the folder exists."""
    if not path.is_dir():
        raise DatasetError(f"{what} {path} does not exist; check dataset.path and dataset.kind")


# ------------------------------------------------------------------------------------------
# One image


def read_grey_image(path: Path, bits: int = 16) -> Image:
    """Grey image (height, width), uint8; ``bits`` are those that 16 of a pixel hold.

    Raises:
        FrameError: the file is absent, incomplete or no image.
    """
    return decode_grey(_bytes_of(path), str(path), bits)


def read_colour_image(path: Path, bits: int = 16) -> Image:
    """Image (height, width, 3) in red, green, blue, uint8; else as :func:`read_grey_image`."""
    return decode_colour(_bytes_of(path), str(path), bits)


def read_depth_image(path: Path) -> npt.NDArray[Any]:
    """Depth image (height, width), uint16 or float, as it is stored; 0 where unknown.

    The largest integer is no depth: 7-Scenes and saturated sensors mark with it what is unknown.

    Raises:
        FrameError: absent, incomplete, no image, or of colours or 8 bits.
    """
    image = decode_stored(_bytes_of(path), str(path))
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


def _bytes_of(path: Path) -> bytes:
    remedy = f"restore the file, or {LEAVE_OUT}"
    if path.exists() and not path.is_file():
        require_file(path, FrameError, remedy)  # reading a pipe waits, a device may have no end
    try:
        return path.read_bytes()
    except OSError as cause:
        raise FrameError(f"image {path} cannot be read: {cause.strerror}; {remedy}") from cause


def decode_grey(data: bytes, name: str, bits: int = 16) -> Image:
    """Grey image (height, width), uint8, of an encoded image's bytes.

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
    """Image (height, width, 3) in red, green, blue, uint8; else as :func:`decode_grey`."""
    image = of_8_bits(_decoded(data, name, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH), name, bits)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def decode_stored(data: bytes, name: str) -> npt.NDArray[Any]:
    """An encoded image's pixels as they are stored. Raises FrameError as :func:`decode_grey`."""
    return _decoded(data, name, cv2.IMREAD_UNCHANGED)


def _decoded(data: bytes, name: str, mode: int) -> npt.NDArray[Any]:
    if fault := _fault_of_bytes(data):
        remedy = "" if ";" in fault else "; copy the file again from its source"
        raise FrameError(f"image {name} {fault}{remedy}")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), mode)
    except cv2.error:  # absurd sizes in a damaged header
        image = None
    if image is None:
        raise FrameError(f"image {name} is not an image that can be decoded; restore the file")
    return image


def require_size(image: Image, name: str, width: int, height: int) -> Image:
    """The image itself. Raises FrameError where it has another size than calibrated."""
    if image.shape[:2] != (height, width):
        raise FrameError(
            f"{name} is {image.shape[1]}x{image.shape[0]} but the calibration states "
            f"{width}x{height}; restore the right file"
        )
    return image


_USUAL_SHAPE = 1.5  # width over height of a camera's image


def shown_together(size: tuple[int, int]) -> list[tuple[str, int, int]]:
    """How images of a size may show two views, the usual shape of these first.

    Each in words, with the columns and rows of views.
    """
    ways = [("side by side", 2, 1), ("over under", 1, 2)]
    width, height = size
    return sorted(ways, key=lambda w: abs(math.log(width * w[2] / (height * w[1]) / _USUAL_SHAPE)))


def both_views(image: Image, size: tuple[int, int]) -> tuple[Image, Image]:
    """Right and left view, each of ``size`` (width, height), of an image that shows both."""
    width, height = size
    return image[-height:, -width:], image[:height, :width]


def encoded_png(image: Image) -> bytes:
    """A grey image, or one in red, green, blue, as a PNG file."""
    shown = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    return bytes(cv2.imencode(".png", shown)[1])


# ------------------------------------------------------------------------------------------
# More than eight bits; mosaics of colours

_BITS = (8, 10, 12, 14, 16)
"""Of the sensors whose pixels are stored in 16."""
_SAMPLED_FRAMES = 9  # from first to last, by which it is decided how many bits are used
_MOSAIC = 1.2
"""Neighbours' difference over that of the next but one: 0.50 to 0.87 in 97 grey pictures, 1.00 in
noise alone, 1.5 to 13 in mosaics of colourful ones."""


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
    for pixels in readable(stored, thinned(count, _SAMPLED_FRAMES).tolist()):
        if pixels.dtype != np.uint16:
            return 16, ()
        largest = max(largest, int(pixels.max()))
    bits = next(bits for bits in _BITS if largest < 1 << bits) if largest else 16
    if bits == 16:
        return bits, ()
    return bits, (
        f"pixels of 16 bits hold {bits}: none of {min(count, _SAMPLED_FRAMES)} frames looked at "
        f"has one above {largest}; {(1 << bits) - 1} is taken as white",
    )


def bits_of(paths: Sequence[Path]) -> tuple[int, tuple[str, ...]]:
    """:func:`bits_held` of image files, one a frame."""
    return bits_held(len(paths), lambda k: decode_stored(_bytes_of(paths[k]), str(paths[k])))


def mosaic_note(count: int, grey: Callable[[int], Image]) -> tuple[str, ...]:
    """A note where images are mosaics of a colour filter (Bayer's) and not of grey pixels.

    In one, pixels next to each other differ more than those two apart, which have one colour; in a
    grey image they differ less, and as much only in noise.

    Args:
        count: of frames.
        grey: an image of a frame; raises FrameError.
    """
    found = [
        _neighbour_ratio(image) for image in readable(grey, sorted({0, count // 2, count - 1}))
    ]
    if not found or np.median(found) < _MOSAIC:
        return ()
    return (
        f"neighbouring pixels differ {np.median(found):.2g} times as much as those two apart: the "
        "images look like the raw mosaic of a colour camera (Bayer), whose pattern features see; "
        "convert them, e.g. by OpenCV's cvtColor with COLOR_BayerGB2GRAY or as the camera has it",
    )


def _neighbour_ratio(image: Image) -> float:
    """Mean difference of neighbours over that of the next but one; of both axes the smaller."""
    if min(image.shape) < 3:
        return 0.0
    pixels = image.astype(np.float32)
    ratios = []
    for turned in (pixels, pixels.T):
        one, two = (np.abs(turned[k:] - turned[:-k]).mean() for k in (1, 2))
        ratios.append(float(one) / max(float(two), 1e-9))
    return min(ratios)


# ------------------------------------------------------------------------------------------
# What is wrong with the bytes of a file, before a decoder would fill in grey

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
_JPEG_TAIL = 64  # some writers pad a JPEG after its end marker
# The largest cameras have that many; SIFT would need 30 GB for one such image.
_MOST_PIXELS = 100_000_000


def _fault_of_bytes(data: bytes) -> str | None:
    if not data:
        return "is empty"
    if data.startswith(_PNG_SIGNATURE):
        return _png_fault(data)
    if data.startswith(_JPEG_START):
        return None if _JPEG_END in data[-_JPEG_TAIL:] else "is truncated (no end marker)"
    if data.startswith(b"version https://git-lfs"):
        return "is a pointer of Git LFS; get the image itself: git lfs pull"
    return None


def _png_fault(data: bytes) -> str | None:
    """What is wrong with the chunks of a PNG file."""
    at = len(_PNG_SIGNATURE)
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        kind, end = data[at + 4 : at + 8], at + 8 + length
        if end + 4 > len(data):
            break
        if zlib.crc32(data[at + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            return f"is damaged (checksum of its {kind.decode('latin-1')} chunk)"
        if kind == b"IHDR":  # a few bytes of header may stand for gigabytes
            width, height = (int.from_bytes(data[k : k + 4], "big") for k in (at + 8, at + 12))
            if not 0 < width * height <= _MOST_PIXELS:
                most = f"{_MOST_PIXELS / 1e6:.0f} megapixels"
                return f"claims to be {width}x{height}, at most {most} are read"
        if kind == b"acTL":
            return "is animated; give one file an image"
        if kind == b"IEND":
            return None
        at = end + 4
    return f"is truncated at {len(data)} bytes"
