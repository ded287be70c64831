"""The layout of a recording: of a folder by the files in it, of files by their endings."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from fgslam.core.errors import DatasetError
from fgslam.core.files import shown_in
from fgslam.core.sides import camera_pairs, camera_trio, is_view
from fgslam.datasets.loose_files import (
    IMAGE_SUFFIXES,
    find_cameras,
    images_in,
    natural,
    one_camera,
)

_DRIVE = ("image_0", "image_1", "calib.txt", "times.txt")
_RUN_CONFIG = "config.yaml"


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
    begun: Callable[[Path], bool]
    endings: tuple[str, ...] = ()
    last: bool = False


def recognise_layout(folder: Path, kind: str | None = None) -> dict[str, str]:
    """The keys of ``dataset`` in a configuration that open this folder: kind, path and so on.

    A folder that has all parts of one layout has that layout. One that has some parts of one
    alone counts as that, so that its reader says what is missing. Of several KITTI drives the
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
            raise DatasetError(_ambiguous(folder, fitting))
        kind = fitting[0]
    if kind == "kitti":
        return _kitti_keys(folder)
    return {"kind": kind, "path": str(folder)}


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
    fitting = complete or [kind for kind, layout in LAYOUTS.items() if layout.begun(given)]
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
    if not fitting and (remedy := _REMEDIES.get(files[0].suffix.lower())):
        raise DatasetError(f"{given} is not read: {remedy}")
    if not fitting:
        known = "; ".join(
            f"{layout.name}: {', '.join(layout.endings)}"
            for layout in LAYOUTS.values()
            if layout.endings
        )
        raise DatasetError(
            f"{given} is neither a folder nor an experiment's .yaml nor a file of a known kind "
            f"({known}); give the recording's folder"
        )
    return fitting


_UNPACK = "unpack it, and give the folder"
_REMEDIES = {
    **dict.fromkeys((".zip", ".tar", ".gz", ".tgz", ".7z", ".rar", ".bz2", ".xz"), _UNPACK),
    **dict.fromkeys(
        (".svo", ".svo2"),
        "only the maker's program can; export it as a film of both views side by side (ZED's SVO "
        "export), with the calibration SN*.conf by --camera",
    ),
    **dict.fromkeys(
        (".oni", ".klg", ".sens", ".h5", ".hdf5"),
        "export its images to folders, as rgb/ and depth/, or left/ and right/",
    ),
}
"""What to do with files of recordings that others' programs alone can read."""


def _all_end(files: list[Path], layout: Layout) -> bool:
    if layout.last and len(files) < 2:
        return False
    return all(file.is_file() and file.suffix.lower() in layout.endings for file in files)


def layout_hint(folder: Path, kind: str) -> str:
    """What to set where the folder has another layout than that of ``kind``; else empty."""
    try:
        found = recognise_layout(folder)
    except DatasetError:
        return ""
    if found["kind"] == kind:
        return ""
    changed = {key: value for key, value in found.items() if value != str(folder)}
    keys = " ".join(f"--set dataset.{key}={value}" for key, value in changed.items())
    name = LAYOUTS[found["kind"]].name
    return f"this is {'an' if name[0] in 'aeiouE' else 'a'} {name} folder: {keys}"


def kitti_drives(root: Path) -> tuple[str, ...]:
    """Names of the drives (two digits) in a KITTI odometry folder, ascending; perhaps none."""
    parent = root / "sequences"
    if not parent.is_dir():
        return ()
    return tuple(
        sorted(
            path.name
            for path in parent.iterdir()
            if path.is_dir() and len(path.name) == 2 and path.name.isdecimal()
        )
    )


def _kitti_keys(folder: Path) -> dict[str, str]:
    """A drive's own folder is ROOT/sequences/NN; of a root the first drive is taken."""
    if kitti_drives(folder):
        return {"kind": "kitti", "path": str(folder), "sequence": kitti_drives(folder)[0]}
    if _is_drive(folder):
        here = folder.resolve()
        return {"kind": "kitti", "path": str(here.parent.parent), "sequence": here.name}
    raise DatasetError(
        f"{folder} looks like one KITTI drive, but it is not in a folder sequences/ under two "
        "digits; move it to ROOT/sequences/00 (its poses to ROOT/poses/00.txt) and give ROOT"
    )


def _ambiguous(folder: Path, fitting: tuple[str, ...]) -> str:
    names = "; ".join(_with_lacking(folder, LAYOUTS[kind]) for kind in fitting)
    return (
        f"{folder} fits several layouts equally well: {names}; say which, e.g. --set "
        f"dataset.kind={fitting[0]}"
    )


def _unknown(folder: Path) -> str:
    """What was looked for in each layout, and what of it is missing."""
    if (folder / _RUN_CONFIG).is_file():
        return (
            f"{folder} is a run folder, not a recording; give what it was made from: "
            f"{folder / _RUN_CONFIG}"
        )
    if not shown_in(folder):
        return f"{folder} is empty; give the folder of a recording, docs/datasets/ has the layouts"
    if inside := _recordings_in(folder):
        return f"{folder} has none of the known layouts; in it has {inside}: give that folder"
    if (alone := one_camera(folder)) is not None:
        return (
            f"{alone} holds images of one camera only; a stereo pair is the least, beside a "
            "gyroscope, too: images of a left and a right camera by the names of folders or files "
            "(of a mirror or panoramas: fgslam teach; where each shows both views side by side, "
            "cut them into left/ and right/, or make a film of them, which is read as it is)"
        )
    for path in shown_in(folder):
        if path.is_file() and (remedy := _REMEDIES.get(path.suffix.lower())):
            return f"{folder} has none of the known layouts, and {path.name} is not read: {remedy}"
    missing = "; ".join(_with_lacking(folder, layout) for layout in LAYOUTS.values())
    return f"{folder} has none of the known layouts: {missing}; docs/datasets/ describes each"


_LOOKED_INTO = 50  # folders of one level


def _recordings_in(folder: Path) -> str:
    """Folders of a known layout in this one, at most two levels deep, in words; perhaps none."""
    level = [folder]
    for _ in range(2):
        inside = [path for above in level for path in shown_in(above)]
        level = [path for path in inside if path.is_dir() and is_view(path.name)]
        level = level[:_LOOKED_INTO]
        found = [str(path) for path in level if _has_layout(path)]
        if found:
            more = f" or {len(found) - 3} more" if len(found) > 3 else ""
            return " or ".join(found[:3]) + more
    return ""


def _has_layout(folder: Path) -> bool:
    return any(not layout.lacking(folder) for layout in LAYOUTS.values())


def _with_lacking(folder: Path, layout: Layout) -> str:
    lacking = layout.lacking(folder)
    return f"{layout.name} (lacks {', '.join(lacking)})" if lacking else layout.name


# --------------------------------------------------------------------------------------------
# What each layout needs, and what tells it from the others


def _absent(folder: Path, parts: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(part for part in parts if not (folder / part).exists())


def _lacking_of_euroc(folder: Path) -> tuple[str, ...]:
    inside = folder / "mav0" if (folder / "mav0").is_dir() else folder
    cameras = _absent(inside, ("cam0", "cam1"))
    lists = () if cameras else _absent(inside, ("cam0/data.csv", "cam1/data.csv"))
    return tuple(f"mav0/{part}" for part in (*cameras, *lists))


def _euroc_begun(folder: Path) -> bool:
    return (folder / "mav0").is_dir() or (folder / "cam0" / "sensor.yaml").is_file()


def _lacking_of_kitti(folder: Path) -> tuple[str, ...]:
    if kitti_drives(folder) or _is_drive(folder):
        return ()
    drive = ", ".join(_absent(folder, _DRIVE)) or "its place in ROOT/sequences/NN"
    return ("sequences/NN", f"or of one drive {drive}")


def _kitti_begun(folder: Path) -> bool:
    return (folder / "image_0").is_dir() or (folder / "image_1").is_dir()


def _is_drive(folder: Path) -> bool:
    """Whether this is one KITTI drive in its place, ROOT/sequences/NN."""
    here = folder.resolve()
    return here.parent.name == "sequences" and here.name in kitti_drives(here.parent.parent)


def _image_folder_begun(folder: Path) -> bool:
    pair = (folder / "left").is_dir() or (folder / "right").is_dir()
    return pair or not _absent(folder, ("calib.json", "times.txt"))


_PLAIN_BAGS = (".bag", ".db3", ".mcap")
_PACKED = ".zstd"
BAG_ENDINGS = (*_PLAIN_BAGS, _PACKED)


def is_bag(file: Path) -> bool:
    """Whether a file is a bag by its name."""
    return file.suffix in _PLAIN_BAGS or is_packed_bag(file)


def is_packed_bag(file: Path) -> bool:
    """Whether it is one of ROS 2 that is compressed as a whole (compression mode file)."""
    return file.suffix == _PACKED and Path(file.stem).suffix in BAG_ENDINGS


def _lacking_of_bag(folder: Path) -> tuple[str, ...]:
    found = any(map(is_bag, shown_in(folder)))
    return () if found else ("a file *.bag, *.db3 or *.mcap",)


def _lacking_of_kitti_raw(folder: Path) -> tuple[str, ...]:
    drive = kitti_raw_drive(folder)
    if drive is None:
        return ("image_00/data and image_01/data, or image_02 and image_03", "timestamps.txt")
    return ()


def kitti_raw_drive(folder: Path) -> Path | None:
    """The folder of a KITTI raw drive: this one, or the only one in the folder of a date."""
    if (folder / "image_00" / "timestamps.txt").is_file() or (
        folder / "image_02" / "timestamps.txt"
    ).is_file():
        return folder
    places = (folder, folder / "data_2d_raw")  # KITTI-360 has it in there
    inside = [p for place in places for p in place.glob("*_drive_*") if p.is_dir()]
    return kitti_raw_drive(inside[0]) if len(inside) == 1 else None


VIDEO_ENDINGS = (".mp4", ".avi", ".mov", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg", ".wmv")


def films_in(given: Path) -> list[Path]:
    """The film, or the left, right[, third] one, of a file, folder or pattern; none if unclear."""
    within = sorted(shown_in(given), key=natural) if given.is_dir() else files_of(given)
    films = {p.name: p for p in within if p.suffix.lower() in VIDEO_ENDINGS and p.is_file()}
    pairs = camera_pairs(films)
    if len(films) == 1:
        return list(films.values())
    if len(films) == 3:
        return [films[name] for name in camera_trio(films)]
    return [films[name] for name in pairs[0]] if len(pairs) == 1 and len(films) == 2 else []


def _lacking_of_video(folder: Path) -> tuple[str, ...]:
    lacking = "one film, or one of a left and one of a right camera (and one of a top one)"
    return () if films_in(folder) else (lacking,)


_COLOUR_FOLDERS = (
    *("rgb", "color", "colour", "image", "images"),
    *("rgbs", "colors", "rgb_images", "color_images"),
)


_DEPTH_FOLDERS = (
    *("aligned_depth", "aligned_depth_to_color", "depth_aligned", "depth"),
    *("depths", "depth_images", "depth_image"),
)
"""Of several the first: beside one that is registered to colour, depth is as it was measured."""


def colour_and_depth(folder: Path) -> tuple[Path, Path] | None:
    """Folders of colour and of depth images beside each other, or None."""
    colour, depth = (
        next((folder / name for name in names if (folder / name).is_dir()), None)
        for names in (_COLOUR_FOLDERS, _DEPTH_FOLDERS)
    )
    return None if colour is None or depth is None else (colour, depth)


def colour_and_depth_files(folder: Path) -> tuple[list[Path], list[Path]] | None:
    """Colour and depth images of a folder that holds both; None where it does not.

    Depth is called so in its names, as in Replica (frame000000.jpg, depth000000.png) and 7-Scenes;
    numbers are those of the colour images.
    """
    found = images_in(folder)
    depths = [path for path in found if "depth" in path.stem.lower()]
    colours = [path for path in found if "depth" not in path.stem.lower()]
    numbers = [[re.findall(r"\d+", path.stem) for path in files] for files in (colours, depths)]
    return (colours, depths) if depths and numbers[0] == numbers[1] else None


def _lacking_of_rgbd(folder: Path) -> tuple[str, ...]:
    folders = colour_and_depth(folder)
    if folders or colour_and_depth_files(folder):
        deeper = [path.name for path in folders or () if not images_in(path) and shown_in(path)]
        return tuple(f"images right in {name}" for name in deeper)
    return _absent(folder, ("depth",)) or ("rgb, or color",)


def _lacking_of_loose_images(folder: Path) -> tuple[str, ...]:
    found = find_cameras(folder)
    return () if found else ("images of a left and a right camera, by their names",)


LAYOUTS = {
    "image_folder": Layout(
        "image folder",
        lambda folder: _absent(folder, ("left", "right", "calib.json", "times.txt")),
        _image_folder_begun,
    ),
    "kitti": Layout("KITTI odometry", _lacking_of_kitti, _kitti_begun),
    "euroc": Layout("EuRoC native", _lacking_of_euroc, _euroc_begun),
    "kitti_raw": Layout("KITTI raw", _lacking_of_kitti_raw, lambda folder: False),
    "bag": Layout("ROS bag", _lacking_of_bag, lambda folder: False, BAG_ENDINGS),
    "video": Layout("film", _lacking_of_video, lambda folder: False, VIDEO_ENDINGS),
    "rgbd": Layout(
        "colour and depth", _lacking_of_rgbd, lambda folder: (folder / "depth.txt").is_file()
    ),
    "loose_images": Layout(
        "folder of images",
        _lacking_of_loose_images,
        lambda folder: False,
        IMAGE_SUFFIXES,
        last=True,
    ),
}
"""By the value of ``dataset.kind`` that opens it."""
