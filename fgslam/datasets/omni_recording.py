"""What all readers of an omnidirectional camera's pictures return."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TypeAlias

import numpy as np

from fgslam.cameras.omni.camera import OmniCamera
from fgslam.core.arrays import FloatArray, Image, IntArray
from fgslam.core.errors import DatasetError, FrameError
from fgslam.core.files import shown_in
from fgslam.datasets.loose_files import IMAGE_SUFFIXES, natural
from fgslam.datasets.stamps import written_stamps

ColourLoader: TypeAlias = Callable[[int], Image]
"""Picture (height, width, 3) in R, G, B by place in the recording; raises FrameError."""


@dataclass(frozen=True, eq=False)
class OmniRecording:
    """Pictures of one omnidirectional camera; read when asked for.

    Attributes:
        name: short name for titles.
        identity: hexadecimal digest of the recording.
        camera: of all pictures.
        ids: (n,) the recording's own numbers, all different.
        names: (n,) of the pictures, as people know them: file names, or frames of a video.
        timestamps: (n,) seconds, strictly increasing; NaN where times are unknown.
        load_image: reads a picture by its place.
        poses: (n, 3) planar poses x, y in metres and heading of the camera (of the centre column
            of a panorama) in radians, in the recording's world; None where there is no truth.
        rooms: (n,) name of the room of each picture, or None.
        notes: what was tolerated when opening.
    """

    name: str
    identity: str
    camera: OmniCamera
    ids: IntArray
    names: tuple[str, ...]
    timestamps: FloatArray
    load_image: ColourLoader
    poses: FloatArray | None = None
    rooms: tuple[str, ...] | None = None
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.ids)

    def image(self, i: int) -> Image:
        """Picture ``i`` (camera.height, camera.width, 3) in R, G, B, 0 <= i < len.

        Raises:
            FrameError: it is missing or damaged, or has another size than the camera.
        """
        if not 0 <= i < len(self):
            raise IndexError(f"picture {i} of {self.name}: expected 0 to {len(self) - 1}")
        image = self.load_image(i)
        if image.shape[:2] != (self.camera.height, self.camera.width):
            raise FrameError(
                f"{self.name}: picture {self.names[i]} has {image.shape[1]}x{image.shape[0]} "
                f"pixels, but the camera is calibrated for {self.camera.width}x"
                f"{self.camera.height}; all pictures must have that size"
            )
        return image

    def select(self, chosen: IntArray) -> OmniRecording:
        """Those pictures alone, in that order."""
        places = [int(i) for i in chosen]
        load = self.load_image
        return replace(
            self,
            ids=self.ids[chosen],
            names=tuple(self.names[i] for i in places),
            timestamps=self.timestamps[chosen],
            poses=None if self.poses is None else self.poses[chosen],
            rooms=None if self.rooms is None else tuple(self.rooms[i] for i in places),
            load_image=lambda i: load(places[i]),
        )


def pictures_in(folder: Path, pattern: str = "*") -> list[Path]:
    """Picture files of a folder in the order of the numbers in their names.

    Raises:
        DatasetError: the folder is absent or holds no such picture.
    """
    if not folder.is_dir():
        raise DatasetError(
            f"{folder} does not exist or is no folder; check dataset.path, or say where the "
            "recording is: --set dataset.path=FOLDER"
        )
    found = [
        path
        for path in shown_in(folder)
        if fnmatchcase(path.name, pattern)
        and path.suffix.lower() in IMAGE_SUFFIXES
        and path.is_file()
    ]
    if not found:
        raise DatasetError(
            f"{folder} holds no picture named {pattern} ({', '.join(IMAGE_SUFFIXES)}); "
            f"{_within(folder) or 'check dataset.path'}"
        )
    return sorted(found, key=natural)


def _within(folder: Path) -> str:
    """What to give instead where folders in this one hold pictures, as of a stereo recording."""
    inner = sorted(
        {p.parent for p in folder.glob("*/*") if p.suffix.lower() in IMAGE_SUFFIXES}, key=natural
    )
    shown = ", ".join(path.name for path in inner[:3])
    return f"folders in it do ({shown}): give that of the one camera" if inner else ""


def ids_of(names: Sequence[str]) -> IntArray:
    """(n,) last number in each name where all have one and all differ; else 0 to n - 1."""
    numbers = [re.findall(r"\d+", name) for name in names]
    last = [int(n[-1]) if n and len(n[-1]) < 18 else -1 for n in numbers]
    if -1 in last or max(Counter(last).values()) > 1:
        return np.arange(len(names), dtype=np.int64)
    return np.array(last, dtype=np.int64)


def times_of(images: Sequence[Path], folder: Path) -> FloatArray:
    """Time stamps (n,) of a folder's images, by a list beside them or their names; NaN without.

    Raises:
        DatasetError: the list is malformed, or lacks an image.
    """
    written = written_stamps(images, [folder])
    return no_times(len(images)) if written is None else written[0]


def no_times(count: int) -> FloatArray:
    """Time stamps (n,) of a recording that has none."""
    return np.full(count, np.nan)
