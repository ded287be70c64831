"""Our own layout: left/, right/[, top/], calib.json, times.txt (docs/datasets/image_folder.md)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from fgslam.cameras.formats import read_json_object
from fgslam.cameras.rig import StereoRig
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import CalibrationError, DatasetError
from fgslam.core.estimates import Trajectory
from fgslam.core.geometry import right_from_left_camera
from fgslam.datasets.calibrated import loaded_rig, mounted, on_wheels
from fgslam.datasets.images import (
    RawImages,
    StereoFiles,
    check_sizes,
    first_size,
    list_numbered_images,
    missing_notes,
    require_folder,
)
from fgslam.datasets.layouts import layout_hint
from fgslam.datasets.odometry_files import file_odometry, find_odometry
from fgslam.datasets.recording import Recording, recording_identity, select_frames
from fgslam.datasets.settings import ImageFolderSettings, RecordedOdometrySettings
from fgslam.datasets.tables import (
    Table,
    read_table,
    read_tum_table,
    require_increasing,
    trajectory_at_frames,
)

TRUTH_LEFT = "gt_left_cam.txt"
TRUTH_RIGHT = "gt_right_cam.txt"
_DEFAULT_NOISE = RecordedOdometrySettings()
_LAST_NUMBER = 2.0**53  # beyond it a float is no single whole number


def open_image_folder(
    settings: ImageFolderSettings, odometry: RecordedOdometrySettings = _DEFAULT_NOISE
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
    require_folder(root, "the recording")
    folders = _camera_folders(root, settings.use_top)
    listed = [list_numbered_images(folder) for folder in folders]
    rig = _cameras(root, settings, listed)
    numbers, stamps = _read_times(root / "times.txt")
    chosen = select_frames(len(stamps), settings)
    files = _files(folders, listed, numbers, rig)
    check_sizes(files, root)
    files, held = files.with_bits()
    odometry_file = find_odometry(root, settings.odometry_file)
    rig, mounting = on_wheels(rig, settings, odometry_file)
    images = RawImages(files, rig)
    truth = _read_truth(root, rig.baseline)
    defining = [
        *([_camera_file(root, settings)] if _camera_file(root, settings).is_file() else []),
        root / "times.txt",
        *([odometry_file] if odometry_file else []),
    ]
    return Recording(
        name=root.resolve().name,
        rig=rig.plain(),
        rectifier=rig.rectifier,
        timestamps=stamps[chosen],
        identity=recording_identity(defining, (p for images in listed for p in images.values())),
        ground_truth=None if truth is None else trajectory_at_frames(truth, stamps[chosen]),
        notes=(
            rig.remarks
            + mounting
            + held
            + missing_notes(files, stamps)
            + _unlisted(folders, listed, numbers)
            + (_missing_top(root, settings.use_top) if settings.camera_file is None else ())
        ),
        indices=chosen,
        load_images=images.load,
        load_colour=images.load_colour,
        odometry_source=file_odometry(odometry_file, odometry),
    )


def _camera_folders(root: Path, use_top: bool) -> list[Path]:
    """Folders of the cameras, right first. Raises DatasetError when one is absent or empty."""
    folders = [root / "right", root / "left"]
    absent = [folder.name for folder in folders if not folder.is_dir()]
    if absent:
        lacking = f"{root} has no folder {' and no folder '.join(absent)}"
        other = layout_hint(root, "image_folder")
        if other:
            raise DatasetError(f"{lacking}; {other}")
        raise DatasetError(
            f"{lacking}: a recording of one camera "
            "cannot be used, a stereo pair (left/ and right/) is the least; check dataset.path"
        )
    if use_top and (root / "top").is_dir():
        folders.append(root / "top")
    for folder in folders:
        if not list_numbered_images(folder):
            raise DatasetError(
                f"{folder} holds no image named by its number (000000.png ...): the whole camera "
                "is missing; restore it"
            )
    return folders


def _camera_file(root: Path, settings: ImageFolderSettings) -> Path:
    return root / "calib.json" if settings.camera_file is None else Path(settings.camera_file)


def _cameras(root: Path, settings: ImageFolderSettings, listed: list[dict[int, Path]]) -> StereoRig:
    """The rectified rig, with what rectifies the images where they are raw."""
    path, three = _camera_file(root, settings), len(listed) == 3
    chosen = ((0, 1, 2) if three else (0, 1)) if settings.camera_file is None else None
    size = first_size(listed[0].values())
    rig = loaded_rig(settings, path, size=size, cameras=chosen, pair=not three)
    if three and rig.vertical_baseline is None and not _outer_two(rig):
        raise CalibrationError(
            f"{path} knows two cameras, but {root} has a third one, top/; give a calibration of "
            "all three, or leave it out: --set dataset.use_top=false"
        )
    return mounted(rig if three else replace(rig, vertical_baseline=None), settings)


def _outer_two(rig: StereoRig) -> bool:
    """Whether these are two of three cameras in a line whose file says which images are theirs."""
    known = None if rig.rectifier is None else rig.rectifier.calibration
    return known is not None and known.sided and len(known.cameras) == 3


def _read_times(path: Path) -> tuple[IntArray, FloatArray]:
    """Image numbers (n,) and stamps (n,) in seconds."""
    table = read_table(path, ("image number", "time"))
    stated = table.column(0)
    wrong = np.flatnonzero((stated != np.floor(stated)) | (stated < 0) | (stated > _LAST_NUMBER))
    if len(wrong):
        line = table.lines[wrong[0]]
        raise DatasetError(
            f"{path}, line {line}: the image number {table.values[wrong[0], 0]:g} is not a whole "
            "number from 0; the line must be: number, seconds"
        )
    numbers = stated.astype(np.int64)
    _require_unique(table, numbers)
    require_increasing(table, table.column(1))
    return numbers, table.column(1)


def _require_unique(table: Table, numbers: IntArray) -> None:
    _, first = np.unique(numbers, return_index=True)
    repeated = np.setdiff1d(np.arange(len(numbers)), first)
    if len(repeated):
        k = int(repeated[0])
        raise DatasetError(
            f"{table.path}, line {table.lines[k]}: image number {numbers[k]} is listed twice; "
            "remove one of the lines"
        )


def _files(
    folders: list[Path], listed: list[dict[int, Path]], numbers: IntArray, rig: StereoRig
) -> StereoFiles:
    """Files of all frames; an absent one gets the name that it should have."""
    suffixes = [next(iter(images.values())).suffix for images in listed]
    cameras = list(zip(folders, listed, suffixes, strict=True))
    paths = tuple(
        tuple(images.get(n, folder / f"{n:06d}{suffix}") for folder, images, suffix in cameras)
        for n in numbers.tolist()
    )
    return StereoFiles(paths, *rig.image_size)


def _unlisted(
    folders: list[Path], listed: list[dict[int, Path]], numbers: IntArray
) -> tuple[str, ...]:
    known = set(numbers.tolist())
    extra = [
        (f.name, len(images.keys() - known)) for f, images in zip(folders, listed, strict=True)
    ]
    return tuple(f"{n} images of {name}/ are not in times.txt and unused" for name, n in extra if n)


def _missing_top(root: Path, use_top: bool) -> tuple[str, ...]:
    """A note where the calibration has a third camera but the folder has none."""
    stated = "vertical_baseline_m" in read_json_object(root / "calib.json")
    if not (use_top and stated) or (root / "top").is_dir():
        return ()
    return ("calib.json states a vertical baseline but there is no top/: read as two cameras",)


def _read_truth(root: Path, baseline: float) -> Trajectory | None:
    """True poses of the reference (right) camera at their own stamps, or None."""
    if (root / TRUTH_RIGHT).is_file():
        return read_tum_table(root / TRUTH_RIGHT)[1]
    if (root / TRUTH_LEFT).is_file():
        left = read_tum_table(root / TRUTH_LEFT)[1]
        return Trajectory(left.timestamps, right_from_left_camera(left.poses, baseline))
    return None
