"""Which format a calibration file has, and what it says: every format that is read."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeAlias

from fgslam.cameras.corrected import read_own_format
from fgslam.cameras.formats import (
    kalibr,
    kitti,
    makers,
    opencv,
    own,
    published,
    ros,
    slam_settings,
)
from fgslam.cameras.formats.trees import Tree, is_camera_text, read_tree
from fgslam.cameras.raw_cameras import Calibration
from fgslam.cameras.rectification import Rectifier
from fgslam.core.errors import CalibrationError
from fgslam.core.files import read_text, shown_in
from fgslam.core.sides import camera_pairs

Size: TypeAlias = tuple[int, int]
Reader: TypeAlias = Callable[[Path, Tree, Size | None], Calibration]

KNOWN = (
    "known: calib.json of fgslam, Kalibr's camchain, OpenCV's stereo files (M1, D1, M2, D2, R, T), "
    "left.yaml and right.yaml of ROS camera_info, KITTI's calib.txt, EuRoC's sensor.yaml, settings "
    "of ORB-SLAM, stella_vslam and VINS, files of Basalt, OAK, ZED, RealSense and OCamCalib"
)


def _without_size(read: Callable[[Path, Tree], Calibration]) -> Reader:
    return lambda path, tree, _: read(path, tree)


def _rectified(path: Path, tree: Tree, _: Size | None) -> Calibration:
    if path.suffix.lower() != ".json":
        raise CalibrationError(
            f"{path}: {', '.join(sorted(own.OWN & tree.keys()))} are keys of fgslam's calib.json; "
            "write it so (docs/datasets/image_folder.md has its keys)"
        )
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
    (published.is_rgbd, _without_size(published.read_rgbd)),
    (published.is_nerfstudio, _without_size(published.read_nerfstudio)),
    (opencv.is_opencv_pair, opencv.read_opencv_pair),
    (opencv.is_opencv_single, opencv.read_opencv_single),
)
"""What recognises a format by its keys, and reads it; the first that fits counts."""


_TEXTS: tuple[tuple[Callable[[str], bool], Callable[[Path, str, Size | None], Calibration]], ...]
_TEXTS = (
    (kitti.is_kitti, lambda path, _, size: kitti.read_kitti(path, size)),
    (makers.is_zed, makers.read_zed),
    (published.is_colmap, lambda path, text, _: published.read_colmap(path, text)),
    (makers.is_ocamcalib, lambda path, *_: makers.read_ocam(path)),
)
"""The same of files that are no keys and values."""


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
    if remedy := _REMEDIES.get(path.suffix.lower()):
        raise CalibrationError(f"{path} is not read: {remedy}")
    archive = path.suffix.lower() == ".npz"
    text = "" if archive else read_text(path, CalibrationError, f"restore the file; {KNOWN}")
    for recognises, read in _TEXTS:
        if recognises(text):
            return read(path, text, size)
    tree = read_tree(path)
    if tree is None:
        raise CalibrationError(f"{path} holds no keys and values of a calibration; {KNOWN}")
    beside = _partner(path, tree)
    return _of_tree(path, tree, size) if beside is None else _of_two(*beside, size)


_REMEDIES = {
    ".mat": "in MATLAB, [K1,D1,K2,D2,R,T] = stereoParametersToOpenCV(stereoParams), then write "
    "jsonencode of a struct with M1, D1, M2, D2, R, T and image_size to a .json (--unit 0.001 "
    "where the squares were in millimetres)",
    ".pkl": "a pickle may run programs; save its arrays by numpy.savez as M1, D1, M2, D2, R, T",
}
"""What to do with files that hold calibrations in a form that nobody else can read."""


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
    if not _is_alone(tree):
        return None
    for names in _PARTNERS:
        first, second = (path.with_name(name) for name in names)
        if path.name in names and first.is_file() and second.is_file():
            return first, second
    pairs = [pair for pair in _pairs_beside(path.parent) if path in pair]
    return pairs[0] if len(pairs) == 1 else None


def _is_alone(tree: Tree) -> bool:
    """Whether it is one file of two that belong together."""
    return kalibr.is_asl(tree) or ros.is_camera_info(tree) or _is_half(tree)


def _is_half(tree: Tree) -> bool:
    """Whether it is OpenCV's intrinsics or extrinsics; other files have matrices of a pair, too."""
    known = next((read for recognises, read in _READERS if recognises(tree)), None)
    return known is opencv.read_opencv_pair and opencv.is_half(tree)


def _pairs_beside(folder: Path) -> list[tuple[Path, Path]]:
    """Files of a folder that belong together: by the side in their names, or OpenCV's halves."""
    trees = {path: tree for path in shown_in(folder) if (tree := _tree_or_none(path)) is not None}
    halves = [path for path, tree in trees.items() if _is_half(tree)]
    inner = [path for path in halves if opencv.has_intrinsics(trees[path])]
    if len(halves) == 2 and len(inner) == 1:
        return [(inner[0], next(path for path in halves if path != inner[0]))]
    sided = {path.name: path for path in trees if path not in halves and _is_alone(trees[path])}
    return [(sided[left], sided[right]) for left, right in camera_pairs(sided)]


def _tree_or_none(path: Path) -> Tree | None:
    if path.suffix.lower() not in (*_TREES, ".txt") or not path.is_file():
        return None
    try:
        if path.suffix.lower() == ".txt" and not is_camera_text(read_text(path, CalibrationError)):
            return None
        return read_tree(path)
    except CalibrationError:
        return None


_TREES = (".yaml", ".yml", ".json", ".xml", ".npz")


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
        inner = second if opencv.has_intrinsics(trees[1]) else first
        return opencv.read_opencv_pair(inner, merged, size)
    one = [_of_tree(path, tree, size) for path, tree in zip((first, second), both, strict=True)]
    raise CalibrationError(
        f"{first} ({one[0].format}) and {second} ({one[1].format}) do not say how the cameras "
        "stand to each other; give a calibration of the pair"
    )


# --------------------------------------------------------------------------------------------
# A folder


_SUFFIXES = (*_TREES, ".txt", ".conf")


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
    kalibr_alone = all(one.format == by_name[0].format for one in found) if by_name else False
    found = by_name if len(by_name) == 1 and kalibr_alone else found
    if len(found) == 1:
        return found[0]
    if found:
        names = ", ".join(Path(one.source).name for one in found)
        raise CalibrationError(f"{folder}: holds several calibrations ({names}); name one")
    own = [path for path in shown_in(folder) if path.suffix.lower() in _TREES]
    if len(own) == 1 and own[0].is_file():
        _require_readable(own[0], size)
    raise CalibrationError(f"{folder}: holds no calibration of a stereo rig; {KNOWN}")


def _require_readable(path: Path, size: Size | None) -> None:
    """Raises CalibrationError where the only file that may be meant is at fault."""
    read_calibration_file(path, size=size)


def _rigs(files: Iterable[Path], size: Size | None) -> Iterable[Calibration]:
    """Of the files those that describe two cameras or more; two that belong together once."""
    sources = set()
    for path in files:
        if path.suffix.lower() not in _SUFFIXES or not path.is_file():
            continue
        try:
            found = read_calibration_file(path, size=size)
        except CalibrationError:
            continue
        if len(found.cameras) > 1 and found.source not in sources:
            sources.add(found.source)
            yield found
