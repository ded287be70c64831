"""KITTI raw: a synchronised and rectified drive in its native layout (docs/datasets/kitti.md)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from fgslam.cameras.rig import StereoRig
from fgslam.cameras.stereo_formats import (
    KITTI_RAW,
    KITTI_RAW_COLOUR,
    left_on_inertial_unit,
    read_kitti,
)
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError, DatasetError
from fgslam.core.estimates import Trajectory
from fgslam.core.geometry import pose
from fgslam.datasets.calibrated import loaded_rig, mounted, read_rig
from fgslam.datasets.images import RawImages, StereoFiles, check_sizes, first_size
from fgslam.datasets.layouts import kitti_raw_drive
from fgslam.datasets.loose_files import CameraFiles, images_in, pair_files
from fgslam.datasets.oxts import Oxts, read_oxts
from fgslam.datasets.recording import Recording, recording_identity, select_frames
from fgslam.datasets.settings import KittiRawSettings, RecordedOdometrySettings
from fgslam.datasets.stamps import stamps_of
from fgslam.datasets.tables import trajectory_at_frames

CALIBRATION = "calib_cam_to_cam.txt"
_OF_360 = Path("calibration", "perspective.txt")  # of KITTI-360
_INSIDE = ("data", "data_rect")
_PAIRS = (("image_00", "image_01"), ("image_02", "image_03"))
"""Folders of the left and the right camera: grey, else colour."""

_MAX_TRUTH_GAP_S = 0.25  # synchronised drives have a row a frame, every 0.1 s


_DEFAULT_NOISE = RecordedOdometrySettings()


def open_kitti_raw(
    settings: KittiRawSettings, odometry: RecordedOdometrySettings = _DEFAULT_NOISE
) -> Recording:
    """Open a drive; ``settings.path`` is its folder, or that of a date with one drive in it.

    Raises:
        DatasetError: a folder or list of times is missing or malformed, or no frame is left.
        CalibrationError: calib_cam_to_cam.txt is missing or of other images.
    """
    drive = kitti_raw_drive(Path(settings.path))
    if drive is None:
        raise DatasetError(f"{settings.path} holds no drive of KITTI raw; check dataset.path")
    names = next((pair for pair in _PAIRS if all(_images(drive / n) for n in pair)), None)
    if names is None:
        raise DatasetError(
            f"{drive} has no two cameras' images (image_00 and image_01, or image_02 and image_03, "
            "each with data/ or data_rect/); unpack the drive's synced and rectified data"
        )
    left, right = (_images(drive / name) for name in names)
    pairs, notes = pair_files(CameraFiles(left, right, drive, interleaved=False))
    folder = drive / names[1]
    stamps, assumed, lists = stamps_of([path for path, _ in pairs], (folder,), None, right)
    rig, iTc = _rig(settings, drive, names, first_size(right))
    oxts = read_oxts(drive)
    files = StereoFiles(pairs, *rig.image_size)
    check_sizes(files, drive)
    files, held = files.with_bits()
    images = RawImages(files, rig)
    chosen = select_frames(len(pairs), settings)
    return Recording(
        name=drive.resolve().name,
        rig=rig.plain(),
        rectifier=rig.rectifier,
        timestamps=stamps[chosen],
        identity=recording_identity(lists, (path for pair in pairs for path in pair)),
        ground_truth=_true_poses(oxts, iTc, stamps[chosen]),
        notes=(*rig.remarks, *held, *notes, *assumed, *_untrue(oxts, iTc)),
        indices=chosen,
        load_images=images.load,
        load_colour=images.load_colour,
        odometry_source=None if oxts is None else oxts.odometry(odometry),
    )


def _true_poses(oxts: Oxts | None, iTc: FloatArray | None, frames: FloatArray) -> Trajectory | None:
    """True poses of the reference camera at the frames' stamps (n,); None where unknown."""
    if oxts is None or iTc is None:
        return None
    unit = trajectory_at_frames(oxts.poses(), frames, _MAX_TRUTH_GAP_S)
    return Trajectory(unit.timestamps, unit.poses @ iTc)


def _untrue(oxts: Oxts | None, iTc: FloatArray | None) -> tuple[str, ...]:
    if oxts is None or iTc is not None:
        return ()
    return (
        "oxts is used as odometry of a camera that looks ahead, and not as truth: beside "
        f"{CALIBRATION} there are no calib_imu_to_velo.txt and calib_velo_to_cam.txt",
    )


def _images(camera: Path) -> tuple[Path, ...]:
    inside = next((camera / name for name in _INSIDE if (camera / name).is_dir()), None)
    return () if inside is None else tuple(images_in(inside))


def _rig(
    settings: KittiRawSettings, drive: Path, names: tuple[str, str], size: tuple[int, int] | None
) -> tuple[StereoRig, FloatArray | None]:
    """The rig, and the pose (4, 4) of the right camera on the inertial unit where it is known."""
    root = drive.resolve().parent
    places = (drive / CALIBRATION, root / CALIBRATION, root / _OF_360, root.parent / _OF_360)
    path = next((p for p in places if p.is_file()), None)
    keys = KITTI_RAW if names == _PAIRS[0] else KITTI_RAW_COLOUR
    if settings.camera_file is not None:
        rig = loaded_rig(settings, Path(settings.camera_file), size=size)
    elif path is None:
        raise CalibrationError(
            f"{drive}: no {CALIBRATION} in it or beside it; unpack the calibration of that date, "
            "or give one by --camera FILE"
        )
    else:
        rig = read_rig(settings, read_kitti(path, size, keys), size)
    iTl = None if path is None else left_on_inertial_unit(path, keys)
    if iTl is None:
        return mounted(rig, settings), None
    iTc = iTl @ pose(np.eye(3), np.array([rig.baseline, 0.0, 0.0]))
    return mounted(replace(rig, bTc=iTc), settings), iTc
