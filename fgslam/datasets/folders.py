"""Folders of images: our own layout, and any two folders, or one with the side in the names.

docs/datasets/images.md.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from fgslam.cameras.calib_json import read_json_object, rectified_values
from fgslam.cameras.rig import StereoRig
from fgslam.core.arrays import FloatArray, Image, IntArray
from fgslam.core.errors import CalibrationError, DatasetError
from fgslam.core.files import make_subfolder, write_bytes, write_text
from fgslam.core.sensors import CAMERA_NAMES, CameraRig
from fgslam.core.types import Trajectory
from fgslam.datasets.images import (
    encoded_png,
    first_size,
    list_numbered_images,
    open_frames,
)
from fgslam.datasets.layouts import files_of, find_cameras, images_in
from fgslam.datasets.ledger import IMAGES, PAIRING, Entry
from fgslam.datasets.recording import (
    Recording,
    calibrated_rig,
    folder_recording,
    loaded_rig,
    mounted,
    numbered,
    numbered_frames,
    rig_of_views,
)
from fgslam.datasets.settings import (
    ImageFolderSettings,
    LooseImagesSettings,
    RecordedOdometrySettings,
)
from fgslam.datasets.times import named_unit, pair_files, read_table, require_increasing, stamps_of

# ------------------------------------------------------------------------------------------
# Our own layout: left/, right/[, top/], calib.json, times.txt

_LAST_NUMBER = 2.0**53  # beyond it a float is no single whole number


def open_image_folder(
    settings: ImageFolderSettings, odometry: RecordedOdometrySettings
) -> Recording:
    """Open a recording in the image-folder layout.

    Args:
        settings: where it is and which frames are used.
        odometry: noise and limits of recorded odometry; read only when a motion is asked for.

    Raises:
        DatasetError: a folder or file is missing or malformed, or no frame is left.
        CalibrationError: calib.json is missing, not finite or impossible.
    """
    root = Path(settings.path)
    cameras = _numbered_images(root)
    own, three = settings.camera_file is None, len(cameras) == 3
    calibration = Path(settings.camera_file or root / "calib.json")
    chosen = ((0, 1, 2) if three else (0, 1)) if own else None
    size = first_size(cameras[root / "right"].values())
    rig = loaded_rig(settings, calibration, size=size, cameras=chosen, pair=not three)
    # Two of three cameras in a line may be the outer ones, where the file states the images' sides.
    known = None if rig.rectifier is None else rig.rectifier.calibration
    outer_two = known is not None and known.sided and len(known.cameras) == 3
    if three and rig.vertical_baseline is None and not outer_two:
        raise CalibrationError(
            f"{calibration} knows two cameras, but {root} has a third one, top/; give a "
            "calibration of all three, or move top/ elsewhere"
        )
    rig = mounted(rig if three else replace(rig, vertical_baseline=None), settings)
    numbers, stamps, timed = _read_times(root / "times.txt")
    files, listed, ledger = numbered_frames(cameras, numbers.tolist(), root / "times.txt")
    images, noticed = open_frames(files, rig, root)
    stated = set(numbers.tolist())
    unlisted = {folder.name: len(found.keys() - stated) for folder, found in cameras.items()}
    notes = [
        f"{n} images of {k}/ are not in times.txt and unused" for k, n in unlisted.items() if n
    ]
    if own and not three and "vertical_baseline_m" in read_json_object(calibration):
        notes.append(
            "calib.json states a vertical baseline but there is no top/: read as two cameras"
        )
    present = [path for path in (calibration,) if path.is_file()]
    defined = [*present, root / "times.txt"], listed
    all_notes = (*timed, *noticed, *notes)
    return folder_recording(
        settings, odometry, root, rig, stamps, images, defined, all_notes, ledger=ledger
    )


def write_image_folder(
    folder: Path, rig: CameraRig, shots: Iterable[tuple[float, Sequence[Image]]]
) -> None:
    """Writes images, times and calibration in the layout that :func:`open_image_folder` reads.

    Args:
        folder: where; it exists.
        rig: the cameras, rectified.
        shots: time (s) and images of each frame: right, left[, top].

    Raises:
        OutputError: a file cannot be written.
    """
    lines = []
    for i, (t, images) in enumerate(shots):
        lines.append(f"{i:06d} {t:.9f}\n")
        for name, image in zip(CAMERA_NAMES, images, strict=False):
            write_bytes(make_subfolder(folder, name) / f"{i:06d}.png", encoded_png(image))
    write_text(folder / "times.txt", "".join(lines))
    write_text(folder / "calib.json", json.dumps(rectified_values(rig), indent=1) + "\n")


def write_poses(path: Path, poses: Trajectory) -> None:
    """Writes poses in TUM's format under this layout's names, which do not end in .tum."""
    poses.save(path.with_suffix(".tum"))
    path.with_suffix(".tum").replace(path)


def _numbered_images(root: Path) -> dict[Path, dict[int, Path]]:
    """Images by number of the cameras' folders, right first. Raises DatasetError without any."""
    folders = [root / "right", root / "left"]
    absent = [folder.name for folder in folders if not folder.is_dir()]
    if absent:
        raise DatasetError(
            f"{root} has no folder {' and no folder '.join(absent)}; a recording of one camera "
            "cannot be used, a stereo pair (left/ and right/) is the least; check dataset.path, "
            "and dataset.kind where it has another layout"
        )
    if (root / "top").is_dir():
        folders.append(root / "top")
    cameras = {folder: list_numbered_images(folder) for folder in folders}
    for folder, images in cameras.items():
        if not images:
            raise DatasetError(
                f"{folder} holds no image named by its number (000000.png ...); restore them"
            )
    return cameras


def _read_times(path: Path) -> tuple[IntArray, FloatArray, tuple[str, ...]]:
    """Image numbers (n,), stamps (n,) in seconds, and a note where the file has another unit."""
    table = read_table(path, ("image number", "time"))
    stated = table.values[:, 0]
    wrong = np.flatnonzero((stated != np.floor(stated)) | (stated < 0) | (stated > _LAST_NUMBER))
    if len(wrong):
        line = table.lines[wrong[0]]
        raise DatasetError(
            f"{path}, line {line}: the image number {stated[wrong[0]]:g} is not a whole "
            "number from 0; the line must be: number, seconds"
        )
    numbers = stated.astype(np.int64)
    _, first = np.unique(numbers, return_index=True)
    repeated = np.setdiff1d(np.arange(len(numbers)), first)
    if len(repeated):
        k = int(repeated[0])
        raise DatasetError(
            f"{path}, line {table.lines[k]}: image number {numbers[k]} is listed twice; remove one"
        )
    require_increasing(table, table.values[:, 1])
    unit, note = named_unit(table.values[:, 1], str(path))
    return numbers, unit * table.values[:, 1], note


# ------------------------------------------------------------------------------------------
# Any two cameras


def open_loose_images(
    settings: LooseImagesSettings, odometry: RecordedOdometrySettings
) -> Recording:
    """Open images of two cameras that lie in two folders, or in one with the side in their names.

    Raises:
        DatasetError: there are no two cameras, their images do not pair, or times are malformed.
        CalibrationError: there is no calibration, or it is none of these images.
    """
    given = Path(settings.path)
    folder, files = (given, None) if given.is_dir() else (given.parent, files_of(given))
    cameras = find_cameras(folder, files)
    root, whole, notes = folder, None, tuple[str, ...]()
    paths: Sequence[tuple[Path, ...]]
    if cameras is None:
        every = tuple(files or images_in(folder))
        whole = first_size(every)
        rig, how = _rig_of_views(settings, given, whole)
        paths, pairing = [(path,) for path in every], Entry(PAIRING, "in one image", how)
        sides = Entry(IMAGES, f"both views, {how}", "the calibrated size")
        notes = (f"each image is taken as both views, {how}",)
    else:
        root, every = cameras.folder, cameras.right
        paths, notes, pairing = pair_files(cameras)
        rig = calibrated_rig(settings, root, first_size(pair[0] for pair in paths))
        rig = numbered(rig) if cameras.numbered else rig
        own = every[0].parent
        cameras_by = f"{own.name} is the right camera's" if own != root else "names with the side"
        also = ", ".join(" with ".join(pair) for pair in cameras.others)
        if also:
            notes = (f"also there: {also}; leave one pair of folders to take that", *notes)
        sides = Entry(IMAGES, cameras_by, "names of folders and files", "", bool(also))
    right = [pair[0] for pair in paths]
    places = (right[0].parent, right[0].parent.parent, root)
    stamps, assumed, lists, timing = stamps_of(right, places, settings.fps, every)
    images, noticed = open_frames(paths, rig, root, whole)
    listed = lists, (path for pair in paths for path in pair)
    notes, ledger = (*noticed, *notes, *assumed), (sides, timing, pairing)
    return folder_recording(
        settings, odometry, root, rig, stamps, images, listed, notes, ledger=ledger
    )


def _rig_of_views(
    settings: LooseImagesSettings, given: Path, whole: tuple[int, int] | None
) -> tuple[StereoRig, str]:
    """The rig of images that show both views, and how. Raises DatasetError: there is none."""
    own, fault = given if given.is_dir() else given.parent, ""
    if whole is not None:
        try:
            return rig_of_views(whole, lambda size, _: calibrated_rig(settings, own, size))
        except CalibrationError as error:
            fault = f" ({error})" if settings.camera_file else ""
    raise DatasetError(
        f"{given}: no images of a left and a right camera, by the names of folders (left/ and "
        "right/) or files (*_left.png and *_right.png); one camera alone is not enough, with a "
        "gyroscope, too (of a mirror or panoramas: fgslam teach); where each image shows both "
        f"views, give the calibration of one pair of views by --camera FILE{fault}"
    )
