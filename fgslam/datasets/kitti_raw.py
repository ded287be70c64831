"""KITTI raw: a synchronised and rectified drive in its native layout (docs/datasets/kitti.md)."""

from __future__ import annotations

from pathlib import Path

from fgslam.cameras.assembly import at_size
from fgslam.cameras.formats import kitti
from fgslam.cameras.rig import StereoRig, load_rig, rig_of
from fgslam.core.errors import CalibrationError, DatasetError
from fgslam.datasets.calibrated import mounted
from fgslam.datasets.images import RawImages, StereoFiles, check_sizes, first_size
from fgslam.datasets.layouts import kitti_raw_drive
from fgslam.datasets.loose_files import CameraFiles, images_in, pair_files
from fgslam.datasets.recording import Recording, recording_identity, select_frames
from fgslam.datasets.settings import KittiRawSettings
from fgslam.datasets.stamps import stamps_of

CALIBRATION = "calib_cam_to_cam.txt"
_PAIRS = (("image_00", "image_01"), ("image_02", "image_03"))
"""Folders of the left and the right camera: grey, else colour."""


def open_kitti_raw(settings: KittiRawSettings) -> Recording:
    """Open a drive; ``settings.path`` is its folder, or that of a date with one drive in it.

    Raises:
        DatasetError: a folder or list of times is missing or malformed, or no frame is left.
        CalibrationError: calib_cam_to_cam.txt is missing or of other images.
    """
    drive = kitti_raw_drive(Path(settings.path))
    if drive is None:
        raise DatasetError(f"{settings.path} holds no drive of KITTI raw; check dataset.path")
    names = next((pair for pair in _PAIRS if all(_has_images(drive / n) for n in pair)), None)
    if names is None:
        raise DatasetError(
            f"{drive} has no two cameras' images (image_00 and image_01, or image_02 and image_03, "
            "each with data/); unpack the drive's synced and rectified data"
        )
    left, right = (tuple(images_in(drive / name / "data")) for name in names)
    pairs, notes = pair_files(CameraFiles(left, right, drive, interleaved=False))
    folder = drive / names[1]
    stamps, assumed, lists = stamps_of([path for path, _ in pairs], (folder,), None)
    rig = _rig(settings, drive, names, first_size(right))
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
        ground_truth=None,
        notes=(*rig.remarks, *held, *notes, *assumed),
        indices=chosen,
        load_images=images.load,
        load_colour=images.load_colour,
    )


def _has_images(camera: Path) -> bool:
    return (camera / "data").is_dir() and bool(images_in(camera / "data"))


def _rig(
    settings: KittiRawSettings, drive: Path, names: tuple[str, str], size: tuple[int, int] | None
) -> StereoRig:
    if settings.camera_file is not None:
        return mounted(load_rig(settings.camera_file, size=size, scale=settings.resized), settings)
    path = next((p for p in (drive / CALIBRATION, drive.parent / CALIBRATION) if p.is_file()), None)
    if path is None:
        raise CalibrationError(
            f"{drive}: no {CALIBRATION} in it or beside it; unpack the calibration of that date, "
            "or give one by --camera FILE"
        )
    keys = kitti.RAW if names == _PAIRS[0] else kitti.RAW_COLOUR
    found = at_size(kitti.read_kitti(path, size, keys), size, settings.resized)
    return mounted(rig_of(found), settings)
