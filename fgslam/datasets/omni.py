"""Pictures of an omnidirectional camera: folders, panoramas with surveyed poses, videos.

docs/datasets/omnidirectional.md, docs/datasets/omnidirectional.md.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from fgslam.cameras.omni import Equirectangular, LensCamera, OmniCamera, RadialCamera
from fgslam.cameras.omni_files import make_camera
from fgslam.cameras.rings import MirrorCircle, find_mirror_circle
from fgslam.core.arrays import FloatArray, Image, IntArray, thinned
from fgslam.core.errors import CalibrationError, DatasetError
from fgslam.core.files import read_text, shown_in
from fgslam.core.geometry import wrap
from fgslam.datasets.images import (
    read_colour_image,
    readable,
    require_folder,
    require_size,
)
from fgslam.datasets.layouts import IMAGE_SUFFIXES, natural
from fgslam.datasets.recording import recording_identity, select_frames
from fgslam.datasets.settings import OmniPathSettings, OmniVideoSettings, PanoramasSettings
from fgslam.datasets.times import finite_number, written_stamps
from fgslam.datasets.video import VideoFrames, moments_of

if TYPE_CHECKING:
    from scipy import sparse

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
        name, of = f"{self.name}: picture {self.names[i]}", self.camera
        return require_size(self.load_image(i), name, of.width, of.height)

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


# --------------------------------------------------------------------------------------------
# Pictures of a mirror: a folder along a path, a video


def open_omni_video(settings: OmniVideoSettings) -> OmniRecording:
    """Open a video file; times come from its rate or its frames, the first of which is at 0 s.

    Raises:
        DatasetError: the file is absent or no video.
        CalibrationError: the camera is impossible, or calibrated for another size.
        FrameError: the first frame cannot be decoded.
    """
    path = Path(settings.path)
    frames = VideoFrames(path)
    chosen = select_frames(frames.count, settings, settings.path)
    first = frames.load(int(chosen[0]))
    numbers, times, timed, _ = moments_of([frames], frames.rate, stated=False)
    camera = make_camera(settings.camera, (first.shape[1], first.shape[0]), path.parent)
    identity, names = recording_identity([path], []), [f"frame {k}" for k in range(frames.count)]
    shown = numbers[:, 0], tuple(names), times, frames.load
    notes = (*frames.notes, *timed)
    return OmniRecording(path.stem, identity, camera, *shown, notes=notes).select(chosen)


def pictures_in(folder: Path, pattern: str = "*") -> list[Path]:
    """Picture files of a folder in the order of the numbers in their names.

    Raises:
        DatasetError: the folder is absent or holds no such picture.
    """
    require_folder(folder, "the folder of pictures")
    found = [
        path
        for path in shown_in(folder)
        if fnmatchcase(path.name, pattern)
        and path.suffix.lower() in IMAGE_SUFFIXES
        and path.is_file()
    ]
    if not found:
        # Folders in this one may hold pictures, as of a stereo recording.
        inside = {p.parent for p in folder.glob("*/*") if p.suffix.lower() in IMAGE_SUFFIXES}
        shown = ", ".join(path.name for path in sorted(inside, key=natural)[:3])
        raise DatasetError(
            f"{folder} holds no picture named {pattern} ({', '.join(IMAGE_SUFFIXES)}); "
            + (
                f"folders in it do ({shown}): give that of the one camera"
                if inside
                else "check dataset.path"
            )
        )
    return sorted(found, key=natural)


def ids_of(names: Sequence[str]) -> IntArray:
    """(n,) last number in each name where all have one and all differ; else 0 to n - 1."""
    numbers = [re.findall(r"\d+", name) for name in names]
    last = [int(n[-1]) if n and len(n[-1]) < 18 else -1 for n in numbers]
    known = -1 not in last and len(set(last)) == len(last)
    return np.array(last if known else range(len(names)), np.int64)


# --------------------------------------------------------------------------------------------
# A folder of panoramas, with or without surveyed poses


POSES_FILE = "poses.csv"
_PICTURES = "panos"
_NUMBERS = ("x_m", "y_m", "heading_deg")
_COLUMNS = ("id", "file", *_NUMBERS)


def open_pictures(settings: PanoramasSettings | OmniPathSettings) -> OmniRecording:
    """Open a folder of pictures in the order of the numbers in their names.

    Of panoramas, those in ``poses.csv`` in its order, where that is there.

    Raises:
        DatasetError: the folder, a picture or a row is missing, malformed or listed twice.
        CalibrationError: the camera is impossible, or calibrated for another size.
        FrameError: the first picture cannot be read.
    """
    root = Path(settings.path)
    table, inner, listed, width = root / POSES_FILE, root / _PICTURES, None, None
    if isinstance(settings, OmniPathSettings):
        paths = pictures_in(root, settings.pattern)
    else:
        width, listed = settings.width, _read_places(table) if table.is_file() else None
        paths = listed[0] if listed else pictures_in(inner if inner.is_dir() else root)
    chosen = select_frames(len(paths), settings, settings.path)
    first = read_colour_image(paths[int(chosen[0])])
    size = reduced = (first.shape[1], first.shape[0])
    if width is not None and width != size[0]:
        if width > size[0]:
            raise DatasetError(
                f"dataset.width is {width} but the panoramas of {root} have only {size[0]} "
                "columns; give a smaller width, or null"
            )
        reduced = (width, max(2, round(width * size[1] / size[0])))
    reduction = None if reduced == size else PanoramaReduction(size, reduced)

    def load(i: int) -> Image:
        image = read_colour_image(paths[i])
        if reduction is None:
            return image
        return reduction(require_size(image, f"picture {paths[i]}", *size))

    written = written_stamps(paths, [root])
    stamps = np.full(len(paths), np.nan) if written is None else written.seconds
    identity = recording_identity([table] if listed else [], paths)
    camera = make_camera(settings.camera, reduced, root)
    ids, names = ids_of([path.stem for path in paths]), tuple(path.name for path in paths)
    recording = OmniRecording(
        root.resolve().name, identity, camera, ids, names, stamps, load_image=load
    )
    if listed is not None:
        # Plans lie next to poses.csv, too; pictures that no row names are looked for in panos/.
        inside = inner.iterdir() if inner.is_dir() else ()
        extra = [p for p in inside if p.suffix.lower() in IMAGE_SUFFIXES and p not in paths]
        note = f"{len(extra)} pictures of {_PICTURES}/ are not in {POSES_FILE}"
        _, own, poses, rooms = listed
        recording = replace(
            recording,
            ids=np.array(own, np.int64),
            poses=np.array(poses, np.float64),
            rooms=tuple(rooms) if any(rooms) else None,
            notes=(note,) if extra else (),
        )
    return recording.select(chosen)


def _read_places(
    path: Path,
) -> tuple[list[Path], list[int], list[tuple[float, float, float]], list[str]]:
    """Picture, id, pose and room of each row of poses.csv."""
    reader = csv.DictReader(read_text(path).splitlines(), strict=True)
    files, ids, poses, rooms = [], [], [], []
    seen: dict[int | str, int] = {}
    try:
        if absent := [name for name in _COLUMNS if name not in (reader.fieldnames or ())]:
            raise DatasetError(
                f"{path}, line 1: no column {', '.join(absent)}; name {', '.join(_COLUMNS)}"
            )
        for row in reader:
            line, where = reader.line_num, f"{path}, line {reader.line_num}"
            words = {name: (row.get(name) or "").strip() for name in (*_COLUMNS, "room")}
            if empty := next((name for name in _COLUMNS if not words[name]), None):
                raise DatasetError(f"{where}: {empty} is empty; complete the row")
            x, y, heading = (finite_number(words[name], f"{where}: {name}") for name in _NUMBERS)
            if not words["id"].isdecimal():
                raise DatasetError(f"{where}: id is {words['id']!r}, not a whole number from 0")
            angle = float(wrap(np.array(math.radians(heading))))
            number, file = int(words["id"]), words["file"]
            # In the folder itself or in panos/.
            known = (path.parent / file, path.parent / _PICTURES / file)
            listed = [p for p in known if p.is_file() and p.suffix.lower() in IMAGE_SUFFIXES]
            if not listed:
                raise DatasetError(
                    f"{where}: there is no picture {file} in {path.parent} or its {_PICTURES}/; "
                    "restore it, or remove the row"
                )
            files.append(listed[0])
            ids.append(number)
            poses.append((x, y, angle))
            rooms.append(words["room"])
            for key, what in ((number, "id"), (file, "file")):
                if seen.setdefault(key, line) != line:
                    raise DatasetError(
                        f"{where}: {what} {key} is in line {seen[key]} already; remove one"
                    )
    except csv.Error as cause:
        where = f"{path}, line {reader.reader.line_num}"
        raise DatasetError(f"{where}: {cause}; correct the line") from cause
    if not ids:
        raise DatasetError(f"{path} lists no panorama; add rows, or remove the file")
    return files, ids, poses, rooms


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
    from scipy import sparse  # of pictures that are not made smaller nothing needs it

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


# --------------------------------------------------------------------------------------------
# Whether the pictures can be of the camera that is stated for them


_CHECKED = 3  # the rim may be as dark as its holder in one of them
_CLEARLY_OFF = 0.025
"""Of the radius: a calibrated mirror was seen off by 0.015, its rim and its axis not being one
(docs/datasets/omnidirectional.md); this is an error of 1.4 degrees at the rim, more within."""
_LEAST_OFF_PX = 3.0
_UNEVEN = 1.25  # columns over rows a degree, or the reverse, that no one means
_BLACK = 16.0  # mean of red, green and blue; a film's black is up to that
_DARK_SIDES = 0.01  # of the width: so many black columns are no dark corner
_SPREAD_OVER = 5  # pictures all over the recording: in one, an edge may lie at its ends
_NEAR_ENDS = 0.01  # of the width at either side: whose steps the step around is compared with
_APART = 2.25
"""Median step around over those: 1.4 at most in whole panoramas of two buildings, 3 to 10 where 5
degrees are missing."""
_POLE = 0.15
"""Spread along a pole's row over that of the row where it is largest: a pole is one point, 0.03 at
most; ordinary pictures have 0.25 and more."""
_CORNER = 0.06, 0.03  # of height and width: outside the circle of a lens all four are black


def camera_notes(recording: OmniRecording, stated: bool = True) -> tuple[str, ...]:
    """What the pictures show of the stated mirror or panoramas, and what a file does not state.

    The latter, and a mirror that is where it should be, only of a camera that is stated here, not
    of one that a route brings along.

    Raises:
        DatasetError: the pictures of a panorama's camera are no panoramas.
    """
    camera = recording.camera
    if isinstance(camera, Equirectangular):
        return (*_panorama_notes(camera), *_end_notes(recording, camera))
    if isinstance(camera, LensCamera):
        middle, other = ("up", "down") if camera.up else ("down", "up")
        turns = ("clockwise", "false"), ("counter-clockwise", "true")
        turn, opposite = turns[not camera.clockwise]
        assumed = (
            f"the picture's middle is taken to look {middle}, bearings to grow {turn} in it (--set "
            f"dataset.camera.middle={other}, --set dataset.camera.clockwise={opposite} otherwise)",
        )
        hole, rim = camera.ring
        # A mirror reflects its camera in the middle; a lens has no rim that must be in the picture.
        shows_rim = hole > 0.0 or camera.lens == "ocam"
        mirror = _mirror_notes(recording, camera.centre, rim, stated) if shows_rim else ()
        return (*(assumed if stated else ()), *mirror)
    if isinstance(camera, RadialCamera):
        return _mirror_notes(recording, camera.frame.centre, camera.outer_radius, stated)
    return ()


def _panorama_notes(camera: Equirectangular) -> tuple[str, ...]:
    """A note where columns and rows are not equally fine: a cropped panorama, or none at all."""
    view = np.rad2deg(camera.top_elevation - camera.bottom_elevation)
    across, down = (camera.width - 1) / 360.0, (camera.height - 1) / view
    if max(across, down) <= _UNEVEN * min(across, down):
        return ()
    return (
        f"pictures of {camera.width}x{camera.height} pixels over 360 x {view:g} degrees have "
        f"{across:.1f} columns but {down:.1f} rows a degree: are they whole panoramas? Else give "
        "dataset.camera.top_elevation_deg and dataset.camera.bottom_elevation_deg",
    )


def _end_notes(recording: OmniRecording, camera: Equirectangular) -> tuple[str, ...]:
    """A note where the pictures do not go on from their last column to the first one.

    In whole panoramas these are neighbours; here the step between them is larger than those next to
    it, or what is next to the picture proper is black.

    Raises:
        DatasetError: they have no poles either, or are round: they are no panoramas at all.
    """
    at_pole = np.isclose([camera.top_elevation, -camera.bottom_elevation], 0.5 * np.pi)
    found = []
    for image in readable(recording.image, thinned(len(recording), _SPREAD_OVER).tolist()):
        grey = image.mean(axis=2)
        lit = np.flatnonzero(grey.max(axis=0) > _BLACK)
        if not len(lit):
            continue
        black = grey.shape[1] - int(lit[-1] - lit[0] + 1)
        steps = np.abs(np.diff(grey)).mean(axis=0)
        near = max(2, round(_NEAR_ENDS * len(steps)))
        typical = max(float(np.median([*steps[:near], *steps[-near:]])), 1.0 / near)
        around = float(np.abs(grey[:, -1] - grey[:, 0]).mean()) / typical
        spread = grey.std(axis=1)
        pole = float(np.max(spread[[0, -1]] * at_pole / max(spread.max(), 1.0)))
        found.append((black, around, pole, _is_round(grey[:, lit[0] : lit[-1] + 1])))
    if not found:
        return ()
    black, around, pole, round_share = np.median(found, axis=0)
    if round_share == 1.0 or (around > _APART and pole > _POLE):
        why = (
            "their corners are black, as of one fisheye or two side by side"
            if round_share == 1.0
            else "their right and left ends do not meet, and they have no poles"
        )
        raise DatasetError(
            f"{recording.name}: the pictures are no panoramas: {why}; stitch them first, or give "
            "the camera that took them, --camera FILE"
        )
    if black > _DARK_SIDES * camera.width:
        what = f"{black:.0f} columns of the pictures are black at the sides"
    elif around > _APART:
        what = "the right and left ends of the pictures do not meet"
    else:
        return ()
    return (
        f"{recording.name}: {what}: they are no panoramas of all 360 degrees from end to end, so "
        "directions are wrong; cut off what is next to them, or give the camera that took them",
    )


def _is_round(grey: FloatArray) -> bool:
    """Whether all corners are black in rows that are not black all along, as outside a circle."""
    height, width = (max(1, round(s * n)) for s, n in zip(_CORNER, grey.shape, strict=True))
    rows = grey[[*range(height), *range(-height, 0)]]
    corners = rows[:, [*range(width), *range(-width, 0)]]
    return float(corners.max()) <= _BLACK < float(rows.mean(axis=1).max())


def _mirror_notes(
    recording: OmniRecording, centre: tuple[float, float], radius: float, always: bool
) -> tuple[str, ...]:
    """A note on where the rim is in the first pictures; of one in its place only where asked."""

    def circle(image: Image, near: tuple[tuple[float, float], float] | None) -> MirrorCircle | None:
        with suppress(CalibrationError):
            return find_mirror_circle(image, np.random.default_rng(0), near)
        return None

    circles = []
    for image in readable(recording.image, range(min(_CHECKED, len(recording)))):
        # The rim near where it should be, else around any circle: its holder's, say, is concentric.
        found = circle(image, (centre, radius))
        if found is None and (around := circle(image, None)) is not None:
            found = circle(image, (around.centre, radius))
        if found is not None:
            circles.append(found)
    if not circles:
        return (
            f"the mirror's rim is not found in {recording.names[0]}, so its centre is unchecked",
        )
    column, row = np.median([c.centre for c in circles], axis=0)
    away = float(np.hypot(column - centre[0], row - centre[1]))
    if away <= max(_CLEARLY_OFF * radius, _LEAST_OFF_PX):
        in_place = f"the mirror's rim is found, {away:.1f} px from where it is stated"
        return (in_place,) if always else ()
    return (
        f"the mirror lies {away:.1f} px off its stated centre ({centre[0]:.1f}, {centre[1]:.1f}): "
        f"its rim's is ({column:.1f}, {row:.1f}); bearings are wrong by up to "
        f"{np.degrees(away / radius):.1f} degrees at the rim and more within: correct "
        "dataset.camera or the calibration",
    )
