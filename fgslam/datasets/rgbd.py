"""Colour and depth images, as in TUM RGB-D or in two folders (docs/datasets/rgbd.md).

Depth is measured as disparity: what a second camera beside the colour camera would see is made from
the depth image, and found again by the front-end as in any stereo pair.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fgslam.cameras.formats import rgbd_part
from fgslam.cameras.lenses import RawCamera
from fgslam.cameras.rig import at_size, read_calibration_file
from fgslam.cameras.trees import read_tree
from fgslam.core.arrays import FloatArray, Image, IntArray
from fgslam.core.checks import is_finite_number
from fgslam.core.errors import CalibrationError, DatasetError, FrameError
from fgslam.core.estimates import Trajectory
from fgslam.core.files import read_lines, shown_in
from fgslam.core.sensors import CameraRig
from fgslam.datasets.calibrated import mounted, on_wheels
from fgslam.datasets.depth_view import (
    BASELINE_M,
    Depth,
    DepthFrames,
    Undistorted,
    depth_sigma_px,
    in_words,
    require_one_camera,
)
from fgslam.datasets.images import first_size, read_colour_image, read_depth_image, sized
from fgslam.datasets.layouts import colour_and_depth, colour_and_depth_files
from fgslam.datasets.loose_files import CameraFiles, images_in, pair_files
from fgslam.datasets.odometry_files import file_odometry, find_odometry
from fgslam.datasets.pairing import NANOSECONDS, pair_stamps
from fgslam.datasets.recording import Recording, recording_identity, select_frames
from fgslam.datasets.settings import RecordedOdometrySettings, RgbdSettings
from fgslam.datasets.stamps import stamps_of
from fgslam.datasets.tables import read_tum_table, trajectory_at_frames

_DEFAULT_LIMITS = RecordedOdometrySettings()
_TUM_SCALE, _MILLIMETRES = 5000.0, 1000.0
_NEAREST_M, _FARTHEST_M = 0.05, 50.0  # of the median depth of an image
# Where 16 bits are only assumed to be millimetres: farther than RealSense, Kinect and Orbbec see.
_FARTHEST_GUESSED_M = 10.0
_NEAREST_OF_TUM_M = 0.4  # nearer than Kinect sees in its near mode, of which TUM's layout is
_ENDS = (1.0, 99.0)  # percentiles of depth that are its nearest and farthest: few pixels are wrong
_SAMPLES = 5  # depth images, over the whole recording
_SCALES = ("depth_scale", "DepthMapFactor", "RGBD.DepthMapFactor", "png_depth_scale", "scale")
_TUM_CAMERAS = {
    "1": (517.3, 516.5, 318.6, 255.3),
    "2": (520.9, 521.0, 325.1, 249.7),
    "3": (535.4, 539.2, 320.1, 247.6),
}
"""fx, fy, cx, cy of the colour cameras, as TUM publishes them; their distortion is left out."""


def open_rgbd(
    settings: RgbdSettings, odometry: RecordedOdometrySettings = _DEFAULT_LIMITS
) -> Recording:
    """Open colour and depth images; the colour camera is the reference.

    Args:
        settings: where they are, and of which camera.
        odometry: noise and limits of a file of odometry beside them.

    Raises:
        DatasetError: images are missing or do not pair, or depths are in another unit.
        CalibrationError: nothing says the colour camera's focal length.
    """
    root = Path(settings.path)
    pairs, stamps, notes, lists = _pairs(root, settings)
    size = first_size(colour for colour, _ in pairs)
    if size is None:
        raise DatasetError(f"{root}: not one colour image can be read; check dataset.path")
    require_one_camera(settings)
    camera, known = _camera(root, settings, size)
    odometry_file = find_odometry(root, settings.odometry_file)
    rig, mounting = _rig(camera, settings, odometry_file)
    scale, said = _scale(root, pairs, settings, size)
    chosen = select_frames(len(pairs), settings)
    images = DepthFrames(_Files(pairs, size, scale).read, rig, Undistorted.of(camera))
    truth = root / "groundtruth.txt"
    defining = (*lists, *([odometry_file] if odometry_file else []))
    return Recording(
        name=root.resolve().name,
        rig=rig,
        timestamps=stamps[chosen],
        identity=recording_identity(defining, (path for pair in pairs for path in pair)),
        ground_truth=_true_poses(truth, stamps[chosen]) if truth.is_file() else None,
        notes=(*notes, *known, *said, *mounting),
        indices=chosen,
        load_images=images.load,
        load_colour=images.load_colour,
        odometry_source=file_odometry(odometry_file, odometry),
        disparity_sigma_px=depth_sigma_px(settings.scale * rig.fx, settings.depth_sigma_m),
    )


def _true_poses(path: Path, frames: FloatArray) -> Trajectory:
    return trajectory_at_frames(read_tum_table(path)[1], frames)


# --------------------------------------------------------------------------------------------
# Files


def _pairs(
    root: Path, settings: RgbdSettings
) -> tuple[tuple[tuple[Path, Path], ...], FloatArray, tuple[str, ...], tuple[Path, ...]]:
    """Colour and depth of each frame, their stamps (n,) in seconds, notes and lists."""
    lists = (root / "rgb.txt", root / "depth.txt")
    if all(path.is_file() for path in lists):
        (colour_at, colours), (depth_at, depths) = (_listed(path) for path in lists)
        tolerance = 1e-3 * settings.pairing_tolerance_ms
        names = (str(lists[0]), str(lists[1]))
        (rows, partners), notes = pair_stamps(colour_at, depth_at, tolerance, names)
        named = zip(rows.tolist(), partners.tolist(), strict=True)
        pairs = tuple((colours[i], depths[j]) for i, j in named)
        words = tuple(map(in_words, notes))
        return pairs, NANOSECONDS * colour_at[rows].astype(np.float64), words, lists
    colour_files, depth_files = _both(root)
    cameras = CameraFiles(depth_files, colour_files, root, interleaved=False)
    pairs, notes = pair_files(cameras, settings.pairing_tolerance_ms)
    colours = [colour for colour, _ in pairs]
    places = (colours[0].parent, root)
    stamps, assumed, used = stamps_of(colours, places, None, colour_files)
    return pairs, stamps, (*map(in_words, notes), *assumed), used


def _both(root: Path) -> tuple[tuple[Path, ...], tuple[Path, ...]]:
    """Files of colour and of depth, in two folders or in one."""
    folders = colour_and_depth(root)
    if folders is None:
        mixed = colour_and_depth_files(root)
        if mixed is None:
            raise DatasetError(f"{root} has no folders of colour and depth images (rgb/, depth/)")
        return tuple(mixed[0]), tuple(mixed[1])
    found = [tuple(images_in(folder)) for folder in folders]
    for folder, files in zip(folders, found, strict=True):
        if not files:
            raise DatasetError(f"{folder} holds no image; restore it")
    return found[0], found[1]


def _listed(path: Path) -> tuple[IntArray, list[Path]]:
    """Stamps (n,) in nanoseconds and files of a list ``seconds file``."""
    stamps, files = [], []
    for number, text in read_lines(path):
        words = text.split()
        if len(words) < 2 or re.fullmatch(r"\d+(\.\d+)?", words[0]) is None:
            raise DatasetError(f"{path}, line {number}: expected seconds and a file; correct it")
        whole, _, part = words[0].partition(".")
        stamps.append(int(whole) * 10**9 + int(part[:9].ljust(9, "0") or 0))
        files.append(path.parent / words[1])
    if not stamps or np.any(np.diff(stamps) <= 0):
        raise DatasetError(f"{path}: lists no image, or times do not increase; restore the file")
    return np.array(stamps, np.int64), files


def _scale(
    root: Path,
    pairs: tuple[tuple[Path, Path], ...],
    settings: RgbdSettings,
    size: tuple[int, int],
) -> tuple[float, tuple[str, ...]]:
    """Units a metre, and the depth that follows from it in words. Raises DatasetError."""
    seen, of_integers = _some_depths(root, pairs, size)
    stated = settings.depth_scale or _stated_scale(root, settings)
    doubt: tuple[str, ...] = ()
    if stated is None and of_integers:
        scale, doubt = _assumed_scale(root, seen)
    else:
        scale = stated or 1.0
    median = float(np.median(seen)) / scale
    guessed = stated is None and of_integers
    if not _NEAREST_M < median < (_FARTHEST_GUESSED_M if guessed else _FARTHEST_M):
        raise DatasetError(
            f"{root}: the median depth is {median:.4g} m at {scale:g} units a metre, which no "
            "depth camera sees; say the unit: --set dataset.depth_scale=1000 for millimetres, "
            "10000 for tenths of them, 5000 as in TUM's, 1 for metres"
        )
    assumed = ", which nothing states" if guessed else ""
    said = f"depth is taken as {scale:g} units a metre{assumed}: its median is {median:.3g} m"
    return scale, (*doubt, said)


def _assumed_scale(root: Path, seen: FloatArray) -> tuple[float, tuple[str, ...]]:
    """TUM's units a metre or millimetres, whichever a depth camera can have seen; doubt in words.

    No motion tells: all that is seen is the same in a world of another size. Where both or neither
    can be, it is the layout's own.

    Args:
        root: the recording, in TUM's layout or another.
        seen: (n,) depths in units.
    """
    near, far = np.percentile(seen, _ENDS)
    of_tum = (root / "depth.txt").is_file()
    own, other = (_TUM_SCALE, _MILLIMETRES) if of_tum else (_MILLIMETRES, _TUM_SCALE)
    possible = {
        _TUM_SCALE: near > _NEAREST_OF_TUM_M * _TUM_SCALE
        and far < _FARTHEST_GUESSED_M * _TUM_SCALE,
        _MILLIMETRES: near > _NEAREST_M * _MILLIMETRES and far < _FARTHEST_GUESSED_M * _MILLIMETRES,
    }
    refused = float(np.median(seen)) >= _FARTHEST_GUESSED_M * own  # it may be a third unit
    scale, left = own, other
    if possible[other] and not possible[own] and not refused:
        scale, left = other, own
    if scale == own and possible[own] and not possible[other]:
        return scale, ()
    return scale, (
        f"nothing states the unit of depth, and the size of the map depends on it: at {scale:g} "
        f"units a metre it is {near / scale:.2g} to {far / scale:.2g} m, at {left:g} "
        f"{near / left:.2g} to {far / left:.2g} m; say which: --set dataset.depth_scale={left:g} "
        f"or {scale:g}",
    )


def _stated_scale(root: Path, settings: RgbdSettings) -> float | None:
    """Units a metre by the calibration's file; RealSense's tools state metres a unit there."""
    named = settings.camera_file
    files = _own_files(root) if named is None else [Path(named)]
    tree = read_tree(files[0]) if len(files) == 1 and files[0].is_file() else None
    for key in _SCALES:
        inner = rgbd_part(tree or {}).get(key)
        given = (tree or {}).get(key) if inner is None and key != "scale" else inner
        value = float(given) if is_finite_number(given) else 0.0  # type: ignore[arg-type]
        if value > 0.0:
            return 1.0 / value if value < 1.0 else value
    return None


def _some_depths(
    root: Path, pairs: tuple[tuple[Path, Path], ...], size: tuple[int, int]
) -> tuple[FloatArray, bool]:
    """Known depths (n,) of some images, in their own units, and whether these are integers."""
    images = []
    for row in np.unique(np.linspace(0, len(pairs) - 1, _SAMPLES).astype(int)).tolist():
        try:
            images.append(read_depth_image(pairs[row][1]))
        except FrameError:
            continue
    if not images:
        raise DatasetError(f"{root}: not one depth image can be read; restore them")
    if all(depth.shape != size[::-1] for depth in images):  # a few may be damaged
        own = f"{images[0].shape[1]}x{images[0].shape[0]}"
        raise DatasetError(
            f"{root}: depth images are {own} pixels, colour images {size[0]}x{size[1]}; depth must "
            f"be registered to colour. Where it is, as in ScanNet, resize the colour images to "
            f"{own}, and say --set dataset.resized=true"
        )
    known = [depth[np.isfinite(depth) & (depth > 0)] for depth in images]
    seen = np.concatenate(known).astype(np.float64)
    if len(seen) == 0:
        raise DatasetError(f"{pairs[0][1]} holds no depth at all; check the depth images")
    return seen, bool(images[0].dtype == np.uint16)


# --------------------------------------------------------------------------------------------
# The colour camera


def _camera(
    root: Path, settings: RgbdSettings, size: tuple[int, int]
) -> tuple[RawCamera, tuple[str, ...]]:
    """The colour camera by the given file, the folder's own, or as TUM publishes it."""
    if settings.camera_file is not None:
        return _of_file(Path(settings.camera_file), size, settings.resized), ()
    own = _own_files(root)
    if len(own) == 1:
        return _of_file(own[0], size, settings.resized), ()
    known = re.search(r"(?:freiburg|fr)([123])(?!\d)", root.resolve().name)
    if known is None or size != (640, 480):
        raise CalibrationError(
            f"{root}: nothing says the colour camera's focal length; give its calibration by "
            "--camera FILE"
        )
    fx, fy, cx, cy = _TUM_CAMERAS[known[1]]
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    camera = RawCamera(*size, matrix, np.zeros(4), np.eye(4), f"freiburg{known[1]}")
    return camera, (f"the camera is taken as TUM's freiburg{known[1]}, without distortion",)


def _own_files(root: Path) -> list[Path]:
    """The folder's files that may be a camera; of several those that are one."""
    suffixes = (".json", ".yaml", ".yml", ".xml")
    found = [p for p in shown_in(root) if p.suffix in suffixes or p.name == "camera_info.txt"]
    return found if len(found) < 2 else [path for path in found if _is_camera(path)]


def _is_camera(path: Path) -> bool:
    try:
        return bool(read_calibration_file(path).cameras)
    except CalibrationError:
        return False


def _of_file(path: Path, size: tuple[int, int], resized: bool) -> RawCamera:
    found = read_calibration_file(path, size=size)
    alone = replace(found, cameras=found.cameras[:1], view=None)
    return at_size(alone, size, resized).cameras[0]


def _rig(
    camera: RawCamera, settings: RgbdSettings, odometry_file: Path | None
) -> tuple[CameraRig, tuple[str, ...]]:
    """The colour camera and the made one, on the body that odometry moves; what was assumed."""
    fx, fy, cx, cy = (float(camera.matrix[k]) for k in ((0, 0), (1, 1), (0, 2), (1, 2)))
    rig = CameraRig(camera.width, camera.height, fx, fy, cx, cy, BASELINE_M, None, np.eye(4))
    return on_wheels(mounted(rig, settings), settings, odometry_file)


@dataclass(frozen=True, eq=False)
class _Files:
    """Images of the files, and depths in metres by their unit."""

    pairs: tuple[tuple[Path, Path], ...]
    size: tuple[int, int]
    scale: float

    def read(self, index: int) -> tuple[Image, Depth, str]:
        """Of a frame the colours, depths in metres, and the depth's file. Raises FrameError."""
        colour_file, depth_file = self.pairs[index]
        colour = sized(read_colour_image(colour_file), f"image {colour_file}", *self.size)
        depth = read_depth_image(depth_file)
        return colour, depth.astype(np.float32) / np.float32(self.scale), str(depth_file)
