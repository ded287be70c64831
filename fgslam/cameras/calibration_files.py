"""Which format a calibration file has, and what it says: every format that is read."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeAlias

from fgslam.cameras.corrected import read_own_format
from fgslam.cameras.formats import kalibr, kitti, makers, opencv, own, ros, slam_settings
from fgslam.cameras.formats.trees import Tree, read_tree
from fgslam.cameras.raw_cameras import Calibration
from fgslam.cameras.rectification import Rectifier
from fgslam.core.errors import CalibrationError
from fgslam.core.files import read_text, shown_in

Size: TypeAlias = tuple[int, int]
Reader: TypeAlias = Callable[[Path, Tree, Size | None], Calibration]

KNOWN = (
    "known: calib.json of fgslam, Kalibr's camchain, OpenCV's stereo files (M1, D1, M2, D2, R, T), "
    "left.yaml and right.yaml of ROS camera_info, KITTI's calib.txt, EuRoC's sensor.yaml, settings "
    "of ORB-SLAM, stella_vslam, VINS and SVO, files of Basalt, OAK, ZED, RealSense and OCamCalib"
)


def _without_size(read: Callable[[Path, Tree], Calibration]) -> Reader:
    return lambda path, tree, _: read(path, tree)


def _rectified(path: Path, tree: Tree, _: Size | None) -> Calibration:
    found = read_own_format(path, "vertical_baseline_m" in tree)
    rig = found.rig if isinstance(found, Rectifier) else found
    return own.calibration_of(rig, path, own.stated_corrections(path, tree))


_READERS: tuple[tuple[Callable[[Tree], bool], Reader], ...] = (
    (makers.is_realsense, _without_size(makers.read_realsense)),
    (own.is_rectified, _rectified),
    (own.is_raw, _without_size(own.read_raw)),
    (makers.is_basalt, _without_size(makers.read_basalt)),
    (makers.is_oak, _without_size(makers.read_oak)),
    (kalibr.is_camchain, _without_size(kalibr.read_camchain)),
    (kalibr.is_asl, _without_size(kalibr.read_asl)),
    (ros.is_camera_info, _without_size(ros.read_camera_info)),
    (slam_settings.is_vins, _without_size(slam_settings.read_vins)),
    (slam_settings.is_camodocal, _without_size(slam_settings.read_camodocal)),
    (slam_settings.is_orb_slam, slam_settings.read_orb_slam),
    (slam_settings.is_stella, _without_size(slam_settings.read_stella)),
    (slam_settings.is_multicol, _without_size(slam_settings.read_multicol)),
    (slam_settings.is_svo, _without_size(slam_settings.read_svo)),
    (opencv.is_opencv_pair, opencv.read_opencv_pair),
    (opencv.is_opencv_single, opencv.read_opencv_single),
)
"""What recognises a format by its keys, and reads it; the first that fits counts."""


def read_calibration_file(
    path: Path, other: Path | None = None, size: Size | None = None
) -> Calibration:
    """What a calibration file, a folder of them, or two files say; recognised by the content.

    Args:
        path: a file, or a folder that holds one.
        other: the second of two files: the right camera's, or OpenCV's extrinsics.
        size: width and height of the images, for formats that do not state it; cameras of others
            keep theirs.

    Raises:
        CalibrationError: the format or a camera model is not known, or a value is missing or
            impossible.
    """
    if other is not None:
        return _of_two(path, other, size)
    if path.is_dir():
        return _of_folder(path, size)
    text = read_text(path, CalibrationError, f"restore the file; {KNOWN}")
    if kitti.is_kitti(text):
        return kitti.read_kitti(path, size)
    if makers.is_zed(text):
        return makers.read_zed(path, text, size)
    if makers.is_ocamcalib(text):
        return makers.read_ocam(path)
    tree = read_tree(path)
    if tree is None:
        raise CalibrationError(f"{path} holds no keys and values of a calibration; {KNOWN}")
    beside = _partner(path, tree)
    return _of_tree(path, tree, size) if beside is None else _of_two(*beside, size)


def _of_tree(path: Path, tree: Tree, size: Size | None) -> Calibration:
    for recognises, read in _READERS:
        if recognises(tree):
            return read(path, tree, size)
    raise CalibrationError(f"{path}: not a calibration that is known; {KNOWN}")


_PARTNERS = (
    ("left.yaml", "right.yaml"),
    ("intrinsics.yml", "extrinsics.yml"),
    ("LeftCameraParams.yaml", "RightCameraParams.yaml"),
)
"""Names of files that belong together, as the tools that write them give."""


def _partner(path: Path, tree: Tree) -> tuple[Path, Path] | None:
    """The two files of a pair, where this is one of them and the other lies beside it."""
    alone = kalibr.is_asl(tree) or ros.is_camera_info(tree) or opencv.is_half(tree)
    for names in _PARTNERS:
        first, second = (path.with_name(name) for name in names)
        if alone and path.name in names and first.is_file() and second.is_file():
            return first, second
    return None


# --------------------------------------------------------------------------------------------
# Two files


def _of_two(first: Path, second: Path, size: Size | None) -> Calibration:
    trees = tuple(read_tree(path) for path in (first, second))
    if trees[0] is None or trees[1] is None:
        wrong = first if trees[0] is None else second
        raise CalibrationError(f"{wrong} holds no keys and values of a calibration; {KNOWN}")
    both = (trees[0], trees[1])
    if all(map(ros.is_camera_info, both)):
        return ros.read_camera_info_pair((first, second), both)
    if all(map(kalibr.is_asl, both)):
        cameras = tuple(
            kalibr.read_asl_camera(path, tree)
            for path, tree in zip((first, second), both, strict=True)
        )
        return Calibration(f"{first} and {second}", "ASL sensor.yaml, a pair", cameras)
    merged = {**trees[1], **trees[0]}
    if any(map(opencv.is_opencv_pair, both)):
        return opencv.read_opencv_pair(first, merged, size)
    one = [_of_tree(path, tree, size) for path, tree in zip((first, second), both, strict=True)]
    raise CalibrationError(
        f"{first} ({one[0].format}) and {second} ({one[1].format}) do not say how the cameras "
        "stand to each other; give a calibration of the pair"
    )


# --------------------------------------------------------------------------------------------
# A folder


_SUFFIXES = (".yaml", ".yml", ".json", ".xml", ".txt", ".conf")


def _of_folder(folder: Path, size: Size | None) -> Calibration:
    root = folder / "mav0" if (folder / "mav0").is_dir() else folder
    if (root / "cam0" / "sensor.yaml").is_file():
        return _of_two(root / "cam0" / "sensor.yaml", root / "cam1" / "sensor.yaml", size)
    for name in ("calib.json", *(pair[0] for pair in _PARTNERS)):
        if (folder / name).is_file():
            return read_calibration_file(folder / name, size=size)
    if (folder / "right.yaml").is_file():
        raise CalibrationError(f"{folder}: has right.yaml but no left.yaml; a pair needs both")
    found = tuple(_rigs(shown_in(folder), size))
    by_name = tuple(one for one in found if one.source.endswith("camchain.yaml"))
    found = by_name if len(by_name) == 1 else found
    if len(found) == 1:
        return found[0]
    if found:
        names = ", ".join(Path(one.source).name for one in found)
        raise CalibrationError(f"{folder}: holds several calibrations ({names}); name one")
    own = [path for path in shown_in(folder) if path.suffix.lower() in _SUFFIXES[:4]]
    if len(own) == 1 and own[0].is_file():
        _require_readable(own[0], size)
    raise CalibrationError(f"{folder}: holds no calibration of a stereo rig; {KNOWN}")


def _require_readable(path: Path, size: Size | None) -> None:
    """Raises CalibrationError where the only file that may be meant is at fault."""
    read_calibration_file(path, size=size)


def _rigs(files: Iterable[Path], size: Size | None) -> Iterable[Calibration]:
    """Of the files those that describe two cameras or more."""
    for path in files:
        if path.suffix.lower() not in _SUFFIXES or not path.is_file():
            continue
        try:
            found = read_calibration_file(path, size=size)
        except CalibrationError:
            continue
        if len(found.cameras) > 1:
            yield found
