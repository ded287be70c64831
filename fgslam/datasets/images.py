"""Image files: listing a camera's folder, reading one image completely or not at all."""

from __future__ import annotations

import zlib
from pathlib import Path

import cv2
import numpy as np

from fgslam.core.arrays import Image
from fgslam.core.errors import DatasetError, FrameError

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".pgm", ".bmp", ".tif", ".tiff")
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
# Some writers pad a JPEG after its end marker.
_JPEG_TAIL = 64


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


def read_grey_image(path: Path) -> Image:
    """The image (height, width) in grey, uint8.

    A truncated or damaged file is refused, never returned half grey.

    Raises:
        FrameError: the file is absent, incomplete or no image.
    """
    return _decoded(path, cv2.IMREAD_GRAYSCALE)


def read_colour_image(path: Path) -> Image:
    """The image (height, width, 3) in red, green, blue, uint8; else as :func:`read_grey_image`."""
    return np.asarray(cv2.cvtColor(_decoded(path, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB), np.uint8)


def _decoded(path: Path, mode: int) -> Image:
    try:
        data = path.read_bytes()
    except OSError as cause:
        raise FrameError(
            f"image {path} cannot be read: {cause.strerror}; restore the file, or leave the frame "
            "out with dataset.start/stop/stride"
        ) from cause
    _require_complete(path, data)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), mode) if data else None
    if image is None:
        raise FrameError(f"image {path} is not an image that can be decoded; restore the file")
    return np.ascontiguousarray(image, np.uint8)


def _require_complete(path: Path, data: bytes) -> None:
    if data.startswith(_PNG_SIGNATURE):
        fault = _png_fault(data)
    elif data.startswith(_JPEG_START):
        fault = None if _JPEG_END in data[-_JPEG_TAIL:] else "is truncated (no end marker)"
    else:
        fault = None if data else "is empty"
    if fault is not None:
        raise FrameError(f"image {path} {fault}; copy the file again from its source")


def _png_fault(data: bytes) -> str | None:
    """What is wrong with the chunks of a PNG file, or None. The decoder would fill in grey."""
    at = len(_PNG_SIGNATURE)
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        kind, end = data[at + 4 : at + 8], at + 8 + length
        if end + 4 > len(data):
            break
        if zlib.crc32(data[at + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            return f"is damaged (checksum of its {kind.decode('latin-1')} chunk)"
        if kind == b"IEND":
            return None
        at = end + 4
    return f"is truncated at {len(data)} bytes"
