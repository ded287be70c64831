"""A folder of panoramas, with or without surveyed poses (docs/datasets/panoramas.md)."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import sparse

from fgslam.cameras.omni.camera_files import make_camera
from fgslam.core.arrays import FloatArray, Image, IntArray
from fgslam.core.errors import DatasetError, FrameError
from fgslam.core.files import read_text
from fgslam.core.planar import wrap
from fgslam.datasets.images import read_colour_image, require_folder
from fgslam.datasets.loose_files import IMAGE_SUFFIXES
from fgslam.datasets.omni_recording import (
    ColourLoader,
    OmniRecording,
    ids_of,
    pictures_in,
    times_of,
)
from fgslam.datasets.omni_settings import PanoramasSettings
from fgslam.datasets.recording import recording_identity, select_frames

POSES_FILE = "poses.csv"
_PICTURES = "panos"
_NUMBERS = ("x_m", "y_m", "heading_deg")
_COLUMNS = ("id", "file", *_NUMBERS)


@dataclass(frozen=True, slots=True)
class _Place:
    """A row of poses.csv."""

    line: int
    id: int
    file: str
    pose: tuple[float, float, float]
    room: str


def open_panoramas(settings: PanoramasSettings) -> OmniRecording:
    """Open a folder of panoramas: those in ``poses.csv`` in its order, else all by their numbers.

    Raises:
        DatasetError: the folder, a picture or a row is missing, malformed or listed twice.
        CalibrationError: the panorama's elevations are impossible.
        FrameError: the first picture cannot be read.
    """
    root = Path(settings.path)
    require_folder(root, "the folder of panoramas")
    table = root / POSES_FILE
    places = _read_places(table) if table.is_file() else None
    paths = pictures_in(_pictures_folder(root)) if places is None else _listed(root, places)
    chosen = select_frames(len(paths), settings)
    first = read_colour_image(paths[int(chosen[0])])
    size = (first.shape[1], first.shape[0])
    reduced = _reduced_size(size, settings, root)
    recording = OmniRecording(
        name=root.resolve().name,
        identity=recording_identity([] if places is None else [table], paths),
        camera=make_camera(settings.camera, reduced, root),
        ids=ids_of([p.stem for p in paths]) if places is None else _ids(places),
        names=tuple(path.name for path in paths),
        timestamps=times_of(paths, root),
        poses=None if places is None else _poses(places),
        rooms=None if places is None or not any(p.room for p in places) else _rooms(places),
        notes=() if places is None else _unlisted(root, paths),
        load_image=_loader(paths, size, reduced),
    )
    return recording.select(chosen)


def _pictures_folder(root: Path) -> Path:
    return root / _PICTURES if (root / _PICTURES).is_dir() else root


def _reduced_size(
    size: tuple[int, int], settings: PanoramasSettings, root: Path
) -> tuple[int, int]:
    if settings.width is None or settings.width == size[0]:
        return size
    if settings.width > size[0]:
        raise DatasetError(
            f"dataset.width is {settings.width} but the panoramas of {root} have only {size[0]} "
            "columns; give a smaller width, or null"
        )
    return settings.width, max(2, round(settings.width * size[1] / size[0]))


def _loader(paths: Sequence[Path], size: tuple[int, int], reduced: tuple[int, int]) -> ColourLoader:
    reduction = None if reduced == size else PanoramaReduction(size, reduced)

    def load(i: int) -> Image:
        image = read_colour_image(paths[i])
        if (image.shape[1], image.shape[0]) != size:
            raise FrameError(
                f"panorama {paths[i]} has {image.shape[1]}x{image.shape[0]} pixels, the first one "
                f"{size[0]}x{size[1]}; all must have one size"
            )
        return image if reduction is None else reduction(image)

    return load


# --------------------------------------------------------------------------------------------
# poses.csv


def _read_places(path: Path) -> list[_Place]:
    lines = read_text(path).splitlines()
    reader = csv.DictReader(lines, strict=True)
    try:
        header = reader.fieldnames or ()
        absent = [name for name in _COLUMNS if name not in header]
        if absent:
            raise DatasetError(
                f"{path}, line 1: no column {', '.join(absent)}; the header must name "
                f"{', '.join(_COLUMNS)}"
            )
        places = [_place(path, reader.line_num, row) for row in reader]
    except csv.Error as cause:
        raise DatasetError(
            f"{path}, line {reader.reader.line_num}: {cause}; correct the line"
        ) from cause
    if not places:
        raise DatasetError(f"{path} lists no panorama; add rows, or remove the file")
    _require_different(path, places)
    return places


def _place(path: Path, line: int, row: dict[str, str | None]) -> _Place:
    values = []
    for name in _COLUMNS:
        if not (row[name] or "").strip():
            raise DatasetError(f"{path}, line {line}: {name} is empty; complete the row")
    for name in _NUMBERS:
        value = _number(row[name] or "")
        if not math.isfinite(value):
            raise DatasetError(
                f"{path}, line {line}: {name} is {row[name]!r}, not a finite number; correct it"
            )
        values.append(value)
    word = (row["id"] or "").strip()
    if not word.isdecimal():
        raise DatasetError(f"{path}, line {line}: id is {word!r}, not a whole number from 0")
    pose = (values[0], values[1], float(wrap(np.array(math.radians(values[2])))))
    return _Place(
        line, int(word), (row["file"] or "").strip(), pose, (row.get("room") or "").strip()
    )


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return math.nan


def _require_different(path: Path, places: list[_Place]) -> None:
    seen: dict[int | str, int] = {}
    for place in places:
        for key, what in ((place.id, "id"), (place.file, "file")):
            if key in seen:
                raise DatasetError(
                    f"{path}, line {place.line}: {what} {key} is in line {seen[key]} already; "
                    "remove one of the rows"
                )
            seen[key] = place.line


def _listed(root: Path, places: list[_Place]) -> list[Path]:
    """Files of the rows, in the folder itself or in panos/."""
    paths = []
    for place in places:
        candidates = [root / place.file, root / _PICTURES / place.file]
        path = next((p for p in candidates if p.is_file()), None)
        if path is None or path.suffix.lower() not in IMAGE_SUFFIXES:
            raise DatasetError(
                f"{root / POSES_FILE}, line {place.line}: there is no picture {place.file} in "
                f"{root} or its {_PICTURES}/; restore it, or remove the row"
            )
        paths.append(path)
    return paths


def _ids(places: list[_Place]) -> IntArray:
    return np.array([p.id for p in places], dtype=np.int64)


def _poses(places: list[_Place]) -> FloatArray:
    return np.array([p.pose for p in places], dtype=np.float64)


def _rooms(places: list[_Place]) -> tuple[str, ...]:
    return tuple(p.room for p in places)


def _unlisted(root: Path, paths: list[Path]) -> tuple[str, ...]:
    """A note where pictures lie in panos/ that no row names; beside poses.csv lie plans, too."""
    folder = root / _PICTURES
    if not folder.is_dir():
        return ()
    extra = [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and p not in paths]
    return (f"{len(extra)} pictures of {_PICTURES}/ are not in {POSES_FILE}",) if extra else ()


# --------------------------------------------------------------------------------------------
# Smaller pictures


class PanoramaReduction:
    """Averages pictures (height, width, 3) of one size to a smaller one, around the seam.

    Plain resizing keeps the picture's *borders* in place; a panorama's first and last columns (and
    rows) must keep their *centres*, or bearings would be off by half a pixel at the seam.
    """

    def __init__(self, before: tuple[int, int], after: tuple[int, int]) -> None:
        """Sizes are (width, height); ``after`` must not be larger."""
        self._across = _averaging(before[0], after[0], periodic=True)
        self._down = _averaging(before[1], after[1], periodic=False)

    def __call__(self, image: Image) -> Image:
        """The smaller picture, rounded."""
        height, width, bands = image.shape
        rows = self._down @ image.reshape(height, -1).astype(np.float32)
        columns = rows.reshape(-1, width, bands).transpose(1, 0, 2).reshape(width, -1)
        out = (self._across @ columns).reshape(-1, rows.shape[0], bands).transpose(1, 0, 2)
        return np.ascontiguousarray(out + np.float32(0.5)).astype(np.uint8)


def _averaging(before: int, after: int, periodic: bool) -> sparse.csr_array:
    """(after, before) weights: each new pixel is the mean over the old ones that it covers."""
    step = (before - 1) / (after - 1)
    centres = np.arange(after) * step
    reach = int(np.ceil(0.5 * step + 0.5))
    old = np.rint(centres).astype(np.int64)[:, None] + np.arange(-reach, reach + 1)
    weights: FloatArray = np.clip(
        np.minimum(centres[:, None] + 0.5 * step, old + 0.5)
        - np.maximum(centres[:, None] - 0.5 * step, old - 0.5),
        0.0,
        None,
    )
    if periodic:
        # The first and the last column look the same way.
        old = np.mod(old, before - 1)
    else:
        weights = np.where((old >= 0) & (old < before), weights, 0.0)
        old = np.clip(old, 0, before - 1)
    weights /= weights.sum(axis=1, keepdims=True)
    new = np.repeat(np.arange(after), old.shape[1])
    entries = (weights.ravel().astype(np.float32), (new, old.ravel()))
    return sparse.csr_array(entries, shape=(after, before))
