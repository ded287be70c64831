"""Rendered frames on disk: one uncompressed file a frame with its checksum, written atomically."""

from __future__ import annotations

import hashlib
import json
import os
import struct
import threading
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.core.arrays import Image
from fgslam.core.errors import DatasetError

_MAGIC = b"FGSLAB1\n"
_HEADER = struct.Struct("<8sIIII")


def cache_root() -> Path:
    """``$FGSLAM_CACHE``, or ``~/.cache/fgslam``."""
    named = os.environ.get("FGSLAM_CACHE")
    return Path(named).expanduser() if named else Path.home() / ".cache" / "fgslam"


def content_hash(description: Mapping[str, Any]) -> str:
    """SHA-256 of the canonical JSON of a description."""
    text = json.dumps(description, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


class RenderCache:
    """The clean frames of one rendering, each a uint8 array (cameras, height, width)."""

    def __init__(self, digest: str, description: Mapping[str, Any], shape: tuple[int, int, int]):
        """Opens or makes the folder. Raises DatasetError when it cannot be made or written."""
        self.folder = cache_root() / f"lab-{digest[:20]}"
        self._shape = shape
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            note = self.folder / "settings.json"
            if not note.exists():
                self._replace(note, json.dumps(description, indent=1, sort_keys=True).encode())
        except OSError as error:
            raise _cannot_write(self.folder, error) from error

    def path(self, index: int) -> Path:
        """File of one frame."""
        return self.folder / f"frame_{index:06d}.raw"

    def present(self, index: int) -> bool:
        """Whether a file of the right length is there (its checksum is tested on reading)."""
        try:
            size = self.path(index).stat().st_size
        except OSError:
            return False
        return size == _HEADER.size + int(np.prod(self._shape))

    def read(self, index: int) -> Image | None:
        """Images of one frame, or None where the file is absent, foreign, cut or damaged."""
        try:
            content = self.path(index).read_bytes()
        except OSError:
            return None
        if len(content) != _HEADER.size + int(np.prod(self._shape)):
            return None
        magic, cameras, height, width, checksum = _HEADER.unpack_from(content)
        if magic != _MAGIC or (cameras, height, width) != self._shape:
            return None
        pixels = memoryview(content)[_HEADER.size :]
        if zlib.crc32(pixels) != checksum:
            return None
        return np.frombuffer(pixels, dtype=np.uint8).reshape(self._shape)

    def write(self, index: int, images: Image) -> None:
        """Stores one frame; another process sees the whole of it or nothing.

        Raises:
            DatasetError: the folder cannot be written or the disk is full.
        """
        pixels = np.ascontiguousarray(images).tobytes()
        header = _HEADER.pack(_MAGIC, *self._shape, zlib.crc32(pixels))
        try:
            self._replace(self.path(index), header + pixels)
        except OSError as error:
            raise _cannot_write(self.folder, error) from error

    def _replace(self, path: Path, content: bytes) -> None:
        beside = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}")
        try:
            beside.write_bytes(content)
            os.replace(beside, path)
        finally:
            beside.unlink(missing_ok=True)


def _cannot_write(folder: Path, error: OSError) -> DatasetError:
    return DatasetError(
        f"rendered frames cannot be stored in {folder}: {error.strerror or error}; "
        "set FGSLAM_CACHE to a folder that can be written"
    )
