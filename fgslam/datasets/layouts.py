"""Layouts of recordings: of a folder by the files in it, of files by their endings.

Needs no image library and no arrays: commands recognise layouts before these are loaded.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from fgslam.core.errors import DatasetError
from fgslam.core.files import shown_in
from fgslam.core.sides import camera_pairs, camera_trio, differ_in_number, is_view

IMAGE_SUFFIXES = (
    *(".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".pnm", ".bmp", ".tif", ".tiff", ".webp"),
)
VIDEO_ENDINGS = (".mp4", ".avi", ".mov", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg", ".wmv")
_PLAIN_BAGS = (".bag", ".db3", ".mcap")
_PACKED_BAG = ".zstd"
_INSIDE = "data"  # where EuRoC and KITTI keep a camera's images


@dataclass(frozen=True, slots=True)
class Layout:
    """One of the known layouts.

    Attributes:
        name: what people call it.
        lacking: the parts that a folder would need to have it and has not.
        begun: whether a folder has parts that no other layout has.
        endings: of files that are a recording of this layout by themselves.
        last: counts where no other layout is complete.
    """

    name: str
    lacking: Callable[[Path], tuple[str, ...]]
    begun: Callable[[Path], bool] = lambda folder: False
    endings: tuple[str, ...] = ()
    last: bool = False


def recognise_layout(folder: Path, kind: str | None = None) -> dict[str, str]:
    """The keys of ``dataset`` in a configuration that open this folder: kind, path and so on.

    A folder that has all parts of one layout has that layout. One that has some parts of one
    alone counts as that, so that its reader states what is missing. Of several KITTI drives the
    first is taken.

    Args:
        folder: of the recording; or its file, or a pattern of file names.
        kind: the layout, where it is known; None: it is recognised.

    Raises:
        DatasetError: there is no such recording, it has none of the known layouts, or several.
    """
    fitting = fitting_layouts(folder)
    if kind not in LAYOUTS:
        if len(fitting) > 1:
            names = "; ".join(_with_lacking(folder, LAYOUTS[kind]) for kind in fitting)
            raise DatasetError(
                f"{folder} fits several layouts equally well: {names}; say which, e.g. --set "
                f"dataset.kind={fitting[0]}"
            )
        kind = fitting[0]
    return _kitti_keys(folder) if kind == "kitti" else {"kind": kind, "path": str(folder)}


def fitting_layouts(given: Path) -> tuple[str, ...]:
    """Kinds of the layouts that a folder has; where it has none, of those it has parts of.

    Of a file, or a pattern of file names, those whose endings they have.

    Raises:
        DatasetError: there is no such folder or file, or nothing in it belongs to a known layout.
    """
    if not given.is_dir():
        return _fitting_files(given)
    complete = [kind for kind, layout in LAYOUTS.items() if not layout.lacking(given)]
    if complete != ["rgbd", "loose_images"]:  # a depth camera's folder may have its pair, too
        complete = [kind for kind in complete if not LAYOUTS[kind].last] or complete
    begun = [kind for kind, layout in LAYOUTS.items() if layout.begun(given)]
    fitting = complete or [kind for kind in begun if not LAYOUTS[kind].last] or begun
    if not fitting:
        raise DatasetError(_unknown(given))
    return tuple(fitting)


def is_recording(given: Path) -> bool:
    """Whether this is a folder, or a file or pattern of files of a known layout."""
    if given.is_dir():
        return True
    files = files_of(given)
    return bool(files) and any(_all_end(files, layout) for layout in LAYOUTS.values())


def files_of(given: Path) -> list[Path]:
    """What a path or a pattern of file names means: the path itself where it is there."""
    if given.exists() or not any(mark in given.name for mark in "*?["):
        return [given]
    found = given.parent.glob(given.name)
    return sorted((path for path in found if not path.name.startswith(".")), key=natural)


def _fitting_files(given: Path) -> tuple[str, ...]:
    files = files_of(given)
    if not files or not all(file.exists() for file in files):
        raise DatasetError(
            f"{given}: no such folder or experiment file; give the folder of a recording, its "
            "file, or an experiment's .yaml"
        )
    fitting = tuple(kind for kind, layout in LAYOUTS.items() if _all_end(files, layout))
    if fitting:
        return fitting
    known = [f"{kind.name}: {', '.join(kind.endings)}" for kind in LAYOUTS.values() if kind.endings]
    raise DatasetError(
        f"{given} is neither a folder nor an experiment's .yaml nor a file of a known kind "
        f"({'; '.join(known)}); give the recording's folder"
    )


def _all_end(files: list[Path], layout: Layout) -> bool:
    if layout.last and len(files) < 2:
        return False
    return all(file.is_file() and file.suffix.lower() in layout.endings for file in files)


def _unknown(folder: Path) -> str:
    """What was looked for in each layout, and what of it is missing."""
    if (folder / "config.yaml").is_file():
        return (
            f"{folder} is a run folder, not a recording; give what it was made from: "
            f"{folder / 'config.yaml'}"
        )
    if not shown_in(folder):
        return f"{folder} is empty; give the folder of a recording, docs/datasets/ has the layouts"
    if inside := _recordings_in(folder):
        return f"{folder} has none of the known layouts; in it has {inside}: give that folder"
    missing = "; ".join(_with_lacking(folder, layout) for layout in LAYOUTS.values())
    return f"{folder} has none of the known layouts: {missing}; docs/datasets/ describes each"


def has_both_views(folder: Path) -> bool:
    """Whether images right in a folder may show both views: not colour and depth, nor a run's."""
    found = [] if (folder / "config.yaml").is_file() else images_in(folder)
    mixed = any("depth" in path.stem.lower() for path in found)
    return bool(found) and not mixed and not _recordings_in(folder)


_SEARCHED = 50  # folders of one level


def _recordings_in(folder: Path) -> str:
    """Folders of a known layout in this one, at most two levels deep, in words; perhaps none."""
    level = [folder]
    for _ in range(2):
        inside = [path for above in level for path in shown_in(above)]
        level = [path for path in inside if path.is_dir() and is_view(path.name)][:_SEARCHED]
        found = [
            str(path)
            for path in level
            if any(not layout.lacking(path) for layout in LAYOUTS.values()) or images_in(path)
        ]
        if found:
            more = f" or {len(found) - 3} more" if len(found) > 3 else ""
            return " or ".join(found[:3]) + more
    return ""


def _with_lacking(folder: Path, layout: Layout) -> str:
    lacking = layout.lacking(folder)
    return f"{layout.name} (lacks {', '.join(lacking)})" if lacking else layout.name


def _absent(folder: Path, *parts: str) -> tuple[str, ...]:
    return tuple(part for part in parts if not (folder / part).exists())


# --------------------------------------------------------------------------------------------
# KITTI, EuRoC


def kitti_drives(root: Path) -> tuple[str, ...]:
    """Names of the drives (two digits) in a KITTI odometry folder, ascending; perhaps none."""
    names = sorted(path.name for path in root.glob("sequences/??") if path.is_dir())
    return tuple(name for name in names if name.isdecimal())


def _kitti_keys(folder: Path) -> dict[str, str]:
    """A drive's own folder is ROOT/sequences/NN; of a root the first drive is taken."""
    if drives := kitti_drives(folder):
        return {"kind": "kitti", "path": str(folder), "sequence": drives[0]}
    if _is_kitti_drive(folder):
        here = folder.resolve()
        return {"kind": "kitti", "path": str(here.parent.parent), "sequence": here.name}
    raise DatasetError(
        f"{folder} seems to be one KITTI drive, but it is not in a folder sequences/ under two "
        "digits; move it to ROOT/sequences/00 (its poses to ROOT/poses/00.txt) and give ROOT"
    )


def _is_kitti_drive(folder: Path) -> bool:
    """Whether this is one KITTI drive in its place, ROOT/sequences/NN."""
    here = folder.resolve()
    return here.parent.name == "sequences" and here.name in kitti_drives(here.parent.parent)


def _lacking_of_kitti(folder: Path) -> tuple[str, ...]:
    if kitti_drives(folder) or _is_kitti_drive(folder):
        return ()
    drive = _absent(folder, "image_0", "image_1", "calib.txt", "times.txt")
    return (
        "sequences/NN",
        f"or of one drive {', '.join(drive) or 'its place in ROOT/sequences/NN'}",
    )


def kitti_raw_drive(folder: Path) -> Path | None:
    """The folder of a KITTI raw drive: this one, or the only one in the folder of a date."""
    if any((folder / name / "timestamps.txt").is_file() for name in ("image_00", "image_02")):
        return folder
    places = (folder, folder / "data_2d_raw")  # KITTI-360 has it in there
    inside = [p for place in places for p in place.glob("*_drive_*") if p.is_dir()]
    return kitti_raw_drive(inside[0]) if len(inside) == 1 else None


def _lacking_of_kitti_raw(folder: Path) -> tuple[str, ...]:
    if kitti_raw_drive(folder) is not None:
        return ()
    return "image_00/data and image_01/data, or image_02 and image_03", "timestamps.txt"


def _lacking_of_euroc(folder: Path) -> tuple[str, ...]:
    inside = folder / "mav0" if (folder / "mav0").is_dir() else folder
    absent = _absent(inside, "cam0", "cam1") or _absent(inside, "cam0/data.csv", "cam1/data.csv")
    return tuple(f"mav0/{part}" for part in absent)


# --------------------------------------------------------------------------------------------
# Files: bags, films


def is_bag(file: Path) -> bool:
    """Whether a file is a bag by its name."""
    return file.suffix in _PLAIN_BAGS or is_packed_bag(file)


def is_packed_bag(file: Path) -> bool:
    """Whether it is one of ROS 2 that is compressed as a whole (compression mode file)."""
    return file.suffix == _PACKED_BAG and Path(file.stem).suffix in (*_PLAIN_BAGS, _PACKED_BAG)


def films_in(given: Path) -> list[Path]:
    """The film, or the left, right[, third] one, of a file, folder or pattern; none if unclear."""
    within = sorted(shown_in(given), key=natural) if given.is_dir() else files_of(given)
    films = {p.name: p for p in within if p.suffix.lower() in VIDEO_ENDINGS and p.is_file()}
    if len(films) == 1:
        return list(films.values())
    if len(films) == 3:
        return [films[name] for name in camera_trio(films)]
    pairs = camera_pairs(films)
    return [films[name] for name in pairs[0]] if len(pairs) == 1 and len(films) == 2 else []


# --------------------------------------------------------------------------------------------
# Colour and depth


_COLOUR_FOLDERS = (
    *("rgb", "color", "colour", "image", "images"),
    *("rgbs", "colors", "rgb_images", "color_images"),
)
_DEPTH_FOLDERS = (
    *("aligned_depth", "aligned_depth_to_color", "depth_aligned", "depth"),
    *("depths", "depth_images", "depth_image"),
)
"""Of several the first: next to one that is registered to colour, depth is as it was measured."""


def colour_and_depth(folder: Path) -> tuple[Path, Path] | None:
    """Folders of colour and of depth images in one folder, or None."""
    colour, depth = (
        next((folder / name for name in names if (folder / name).is_dir()), None)
        for names in (_COLOUR_FOLDERS, _DEPTH_FOLDERS)
    )
    return None if colour is None or depth is None else (colour, depth)


def numbers_in(stem: str) -> list[int]:
    """All numbers of a name."""
    return [int(n) for n in re.findall(r"\d+", stem)]


def colour_and_depth_files(folder: Path) -> tuple[list[Path], list[Path]] | None:
    """Colour and depth images of a folder that holds both; None where it does not.

    Depth is called so in its names, as in Replica (frame000000.jpg, depth000000.png) and 7-Scenes;
    numbers are those of the colour images.
    """
    found = images_in(folder)
    depths = [path for path in found if "depth" in path.stem.lower()]
    colours = [path for path in found if "depth" not in path.stem.lower()]
    alike = [numbers_in(path.stem) for path in colours] == [
        numbers_in(path.stem) for path in depths
    ]
    return (colours, depths) if depths and alike else None


def _lacking_of_rgbd(folder: Path) -> tuple[str, ...]:
    folders = colour_and_depth(folder)
    if folders or colour_and_depth_files(folder):
        deeper = [path.name for path in folders or () if not images_in(path) and shown_in(path)]
        return tuple(f"images right in {name}" for name in deeper)
    return _absent(folder, "depth") or ("rgb, or color",)


# --------------------------------------------------------------------------------------------
# Images of two cameras in folders with any names: which files they are


@dataclass(frozen=True, slots=True)
class CameraFiles:
    """Image files of both cameras, each in natural order.

    Attributes:
        left, right: the files.
        folder: that of all.
        interleaved: both cameras' files lie in one folder, and their names say which is which.
        others: further pairs of folders, which are not taken.
        sides: what the cameras are called, left first.
    """

    left: tuple[Path, ...]
    right: tuple[Path, ...]
    folder: Path
    interleaved: bool
    others: tuple[tuple[str, str], ...] = ()
    sides: tuple[str, str] = ("left", "right")

    @property
    def numbered(self) -> bool:
        """Whether numbers identify the cameras, as in a calibration's file, and not sides."""
        left, right = (str(files[0].relative_to(self.folder)) for files in (self.left, self.right))
        if not self.interleaved:
            left, right = (name.partition("/")[0] for name in (left, right))
        return differ_in_number(left, right)


def natural(path: Path) -> tuple[tuple[int, str], ...]:
    """Sorts names with numbers by their values, so that 10 comes after 9; words as they are."""
    words = re.split(r"(\d+)", path.name)
    return tuple((int(w), "") if w.isdecimal() else (-1, w) for w in words)


def images_in(folder: Path) -> list[Path]:
    """Image files of a folder, in natural order; by time where all names are times."""
    files = (p for p in shown_in(folder) if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file())
    found = sorted(files, key=natural)
    times = time_parts([path.stem for path in found])
    if times is None:
        return found
    # Digits behind the point sort as text: .98 comes after .1234567.
    return [path for _, _, path in sorted(zip(*times, found, strict=True))]


# Names of files that are times are numbers of ten digits or more, or a whole name of seconds to the
# microsecond (ETH3D). Ten digits with zeros before them count images, as in KITTI's drives.
_NAME = re.compile(r"^([1-9]\d{9,18}|\d{1,9}(?=\.\d{6,9}$))(?:\.(\d+)|[_-](\d{3,9}))?$")
_AMID = re.compile(r"(?<!\d)([1-9]\d{9,18})(?:\.(\d+)|[_-](\d{3,9})(?!\d))?(?!\d)")


def time_parts(names: Sequence[str]) -> tuple[list[int], list[str]] | None:
    """Whole numbers, and digits of the fractions, of names that are times; None where they are not.

    So are names that are the same but for one time, ``camera_1225719876.123_left``.
    What follows a dash or an underscore is a fraction, with zeros before it where its width
    varies, unless it counts by one.
    """
    found = [match for name in names if (match := _NAME.match(name))]
    if len(found) < len(names):
        found = _times_amid(names)
    if not found:
        return None
    width = max(len(match[3] or "") for match in found)
    parts = [match[2] or (match[3] or "").zfill(width) or "0" for match in found]
    whole = [int(match[1]) for match in found]
    if not counts_by_one([int(match[3]) for match in found if match[3]]):
        return whole, parts
    return (whole, ["0"] * len(whole)) if len(set(whole)) == len(whole) else None


def _times_amid(names: Sequence[str]) -> list[re.Match[str]]:
    """The one number in which names differ, where it may be a time and is no counter; else none."""
    for found in zip(*(_AMID.finditer(name) for name in names), strict=False):
        around = {
            match.string[: match.start()] + "\0" + match.string[match.end() :] for match in found
        }
        if len(around) == 1 and not counts_by_one([int(match[1]) for match in found]):
            return list(found)
    return []


def counts_by_one(numbers: Sequence[int]) -> bool:
    """Whether most of the numbers are one more than that before."""
    steps = [b - a for a, b in pairwise(numbers)]
    return len(steps) > 0 and 2 * steps.count(1) > len(steps)


def find_cameras(root: Path, files: Sequence[Path] | None = None) -> CameraFiles | None:
    """The files of a left and a right camera; None where there is no such pair.

    Two folders side by side (left and right, image_0 and image_1, cam0 and cam1), or one folder in
    which names differ in the side alone, or end in the camera's number (12_0 and 12_1), or have it
    behind the word image (image_0_12 and image_1_12).

    Args:
        root: the folder.
        files: of it, only these; None for all.
    """
    if files is None:
        if (found := _two_folders(root)) is not None:
            return found
        files = [path for path in images_in(root) if is_view(path.stem)]
    named = {path.name: path for path in files}
    pairs = camera_pairs(named, any_number=False)
    if not pairs:
        return next(filter(None, (_by_number(files, root, split) for split in NUMBERED)), None)
    left, right = (tuple(sorted({named[p[k]] for p in pairs}, key=natural)) for k in (0, 1))
    return CameraFiles(left, right, root, interleaved=True)


def _two_folders(root: Path) -> CameraFiles | None:
    """Two folders of images whose names differ in the side, and further pairs of them."""
    with_images: dict[str, tuple[Path, ...]] = {}
    for folder in (path for path in shown_in(root) if path.is_dir() and is_view(path.name)):
        places = [place for place in (folder, folder / _INSIDE) if place.is_dir()]
        images = next(filter(None, map(images_in, places)), [])
        inside = camera_pairs([path.name for path in images], any_number=False)
        both = 2 * len({name for pair in inside for name in pair}) > len(images)
        if images and not both:  # else it holds the images of both cameras
            with_images[folder.name] = tuple(images)
    # Of a first and a second camera the first one may have no number: rgb and rgb2.
    second = [(name, f"{name}2") for name in sorted(with_images) if f"{name}2" in with_images]
    pairs = camera_pairs(with_images) or second
    if not pairs:
        return None
    words = [pair for pair in pairs if not re.search(r"\d", pair[0])]
    left, right = (words or list(pairs))[0]
    others = tuple(pair for pair in pairs if not {left, right} & set(pair))
    return CameraFiles(with_images[left], with_images[right], root, False, others)


NUMBERED = (
    re.compile(r"(.*\d)[_-](\d+)()$"),
    re.compile(r"(.*?(?:image|img)[_-]?)(\d+)([_-].*\d.*)$", re.IGNORECASE),
)
"""A name with the camera's number at its end, or in it: what is before and behind."""

_FEWEST_NUMBERED = 4  # files: of two pairs


def _by_number(files: Sequence[Path], root: Path, split: re.Pattern[str]) -> CameraFiles | None:
    """Both cameras by a number in the names, where that is one of two for all of them."""
    ends = {path: int(match[2]) for path in files if (match := split.match(path.stem))}
    numbers = sorted(set(ends.values()))
    if len(ends) < len(files) or len(files) < _FEWEST_NUMBERED or numbers not in ([0, 1], [1, 2]):
        return None
    left, right = (tuple(path for path in files if ends[path] == n) for n in numbers)
    moments = [{split.sub(r"\1\3", path.stem) for path in paths} for paths in (left, right)]
    if len(moments[0] & moments[1]) * 2 < len(left):
        return None
    return CameraFiles(left, right, root, interleaved=True)


# --------------------------------------------------------------------------------------------
# The layouts


def _some(*parts: str) -> Callable[[Path], bool]:
    """Whether a folder has one of the parts."""
    return lambda folder: len(_absent(folder, *parts)) < len(parts)


def _found(find: Callable[[Path], object], lacking: str) -> Callable[[Path], tuple[str, ...]]:
    """What a folder lacks in which nothing is found."""
    return lambda folder: () if find(folder) else (lacking,)


_FILMS = "one film, or one of a left and one of a right camera (and one of a top one)"
_PAIR = "images of a left and a right camera, by their names"
LAYOUTS = {
    "image_folder": Layout(
        "image folder",
        lambda folder: _absent(folder, "left", "right", "calib.json", "times.txt"),
        lambda f: _some("left", "right")(f) or not _absent(f, "calib.json", "times.txt"),
    ),
    "kitti": Layout("KITTI odometry", _lacking_of_kitti, _some("image_0", "image_1")),
    "euroc": Layout("EuRoC native", _lacking_of_euroc, _some("mav0", "cam0/sensor.yaml")),
    "kitti_raw": Layout("KITTI raw", _lacking_of_kitti_raw),
    "bag": Layout(
        "ROS bag",
        _found(lambda folder: any(map(is_bag, shown_in(folder))), "a file *.bag, *.db3 or *.mcap"),
        endings=(*_PLAIN_BAGS, _PACKED_BAG),
    ),
    "video": Layout("film", _found(films_in, _FILMS), endings=VIDEO_ENDINGS),
    "rgbd": Layout("colour and depth", _lacking_of_rgbd, _some("depth.txt")),
    "loose_images": Layout(
        "folder of images", _found(find_cameras, _PAIR), has_both_views,
        IMAGE_SUFFIXES, last=True,
    ),
}  # fmt: skip
"""By the value of ``dataset.kind`` that opens it."""
