"""What is wrong with the bytes of an image file, before a decoder would make something of them."""

from __future__ import annotations

import zlib

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
# Some writers pad a JPEG after its end marker.
_JPEG_TAIL = 64
_MOST_PIXELS = 100_000_000
"""The largest cameras have that many; SIFT would need 30 GB for one such image."""

_NO_IMAGES = (
    (b"version https://git-lfs", "is a pointer of Git LFS; get the image itself: git lfs pull"),
    (b"<!doctype html", "is a web page, as a download that failed leaves it; download it again"),
    (b"<html", "is a web page, as a download that failed leaves it; download it again"),
)
"""Beginnings of files that stand in the place of one, in small letters."""


def fault_of_bytes(data: bytes) -> str | None:
    """What is wrong with an encoded image and the remedy, in words; None where nothing is known."""
    if data.startswith(_PNG_SIGNATURE):
        fault = _png_fault(data)
    elif data.startswith(_JPEG_START):
        fault = None if _JPEG_END in data[-_JPEG_TAIL:] else "is truncated (no end marker)"
    else:
        fault = _other_fault(data)
    if fault is None or ";" in fault:
        return fault
    return f"{fault}; copy the file again from its source"


def _other_fault(data: bytes) -> str | None:
    """Of what is neither PNG nor JPEG: nothing, or what files leave that are not there."""
    start = data[:64].lstrip().lower()
    found = (fault for beginning, fault in _NO_IMAGES if start.startswith(beginning))
    return next(found, None) if data else "is empty"


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
        if kind == b"IHDR" and (fault := _size_fault(data[at + 8 : end])):
            return fault
        if kind == b"acTL":
            return "is animated; give one file an image"
        if kind == b"IEND":
            return None
        at = end + 4
    return f"is truncated at {len(data)} bytes"


def _size_fault(header: bytes) -> str | None:
    """What is wrong with the size in a PNG's header: a few bytes may stand for gigabytes."""
    width, height = (int.from_bytes(header[k : k + 4], "big") for k in (0, 4))
    if 0 < width * height <= _MOST_PIXELS:
        return None
    return f"claims to be {width}x{height}, at most {_MOST_PIXELS / 1e6:.0f} megapixels are read"
