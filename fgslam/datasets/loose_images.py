"""Folders of images with any names, with or without times (docs/datasets/loose_images.md)."""

from __future__ import annotations

from pathlib import Path

from fgslam.core.errors import DatasetError
from fgslam.datasets.calibrated import calibrated_rig, numbered, on_wheels
from fgslam.datasets.images import RawImages, StereoFiles, check_sizes, first_size
from fgslam.datasets.layouts import files_of
from fgslam.datasets.loose_files import CameraFiles, find_cameras, pair_files
from fgslam.datasets.odometry_files import file_odometry, find_odometry
from fgslam.datasets.recording import Recording, recording_identity, select_frames
from fgslam.datasets.settings import LooseImagesSettings, RecordedOdometrySettings
from fgslam.datasets.stamps import stamps_of


def open_loose_images(
    settings: LooseImagesSettings, odometry: RecordedOdometrySettings
) -> Recording:
    """Open images of two cameras that lie in two folders, or in one with the side in their names.

    Raises:
        DatasetError: there are no two cameras, their images do not pair, or times are malformed.
        CalibrationError: there is no calibration, or it is none of these images.
    """
    cameras = _cameras(Path(settings.path))
    root = cameras.folder
    pairs, unpaired = pair_files(cameras, settings.pairing_tolerance_ms)
    own = [right.parent for right, _ in pairs[:1]]
    stamps, assumed, lists = stamps_of(
        [right for right, _ in pairs], (*own, own[0].parent, root), settings.fps, cameras.right
    )
    rig = calibrated_rig(settings, root, first_size(right for right, _ in pairs))
    if cameras.numbered:
        rig = numbered(rig)
    files = StereoFiles(pairs, *rig.image_size)
    check_sizes(files, root)
    files, held = files.with_bits()
    chosen = select_frames(len(pairs), settings)
    odometry_file = find_odometry(root, settings.odometry_file)
    rig, mounting = on_wheels(rig, settings, odometry_file)
    images = RawImages(files, rig)
    also = ", ".join(" with ".join(pair) for pair in cameras.others)
    others = (f"also there: {also}; leave one pair of folders to take that",) if also else ()
    return Recording(
        name=root.resolve().name,
        rig=rig.plain(),
        rectifier=rig.rectifier,
        timestamps=stamps[chosen],
        identity=recording_identity(
            [*lists, *([odometry_file] if odometry_file else [])],
            (p for pair in pairs for p in pair),
        ),
        ground_truth=None,
        notes=(*rig.remarks, *mounting, *held, *others, *unpaired, *assumed),
        indices=chosen,
        load_images=images.load,
        load_colour=images.load_colour,
        odometry_source=file_odometry(odometry_file, odometry),
    )


def _cameras(given: Path) -> CameraFiles:
    files = None if given.is_dir() else files_of(given)
    found = find_cameras(given if given.is_dir() else given.parent, files)
    if found is None:
        raise DatasetError(
            f"{given}: no images of a left and a right camera: two folders such as left/ and "
            "right/, or names such as *_left.png and *_right.png; one camera alone is not enough"
        )
    return found
