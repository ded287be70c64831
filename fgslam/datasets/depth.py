"""Colour and depth as a stereo pair, as in TUM RGB-D or in two folders (docs/datasets/images.md).

Depth is measured as disparity: what a second camera next to the colour camera would see is made
from the depth image, and found again by the front-end as in any stereo pair.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from fgslam.cameras.formats import rgbd_part
from fgslam.cameras.lenses import RawCamera, View, pixel_grid
from fgslam.cameras.rectify import sampling_maps
from fgslam.cameras.rig import StereoRig, at_size, read_calibration_file
from fgslam.cameras.trees import intrinsic_matrix, read_tree
from fgslam.core.arrays import BoolArray, Float32, FloatArray, Image, thinned
from fgslam.core.checks import is_finite_number
from fgslam.core.errors import CalibrationError, DatasetError, FrameError
from fgslam.core.files import read_lines, shown_in
from fgslam.core.sensors import CameraRig
from fgslam.datasets.images import (
    Depth,
    DepthLoader,
    ImageLoader,
    first_size,
    read_colour_image,
    read_depth_image,
    readable,
    require_size,
)
from fgslam.datasets.layouts import (
    CameraFiles,
    colour_and_depth,
    colour_and_depth_files,
    counts_by_one,
    images_in,
)
from fgslam.datasets.ledger import DEPTH, LENS, PAIRING, TIMES, Entry
from fgslam.datasets.recording import Recording, folder_recording, mounted
from fgslam.datasets.settings import (
    CalibratedSettings,
    DepthSettings,
    RecordedOdometrySettings,
    RgbdSettings,
)
from fgslam.datasets.times import (
    NANOSECONDS,
    Pairs,
    Stamps,
    even_stamps,
    in_seconds,
    listed_files,
    pair_files,
    pair_stamps,
    stamps_of,
)

ReadPair: TypeAlias = Callable[[int], tuple[Image, Depth, str]]
"""Of a frame its image, the depth of each pixel in metres, and the name of the depth image."""

BASELINE_M = 0.08
"""Of the camera that is made up: about that of depth cameras, so that both see much the same."""

DEPTH_SIGMA_M = 1.425e-3
"""Noise of a depth of 1 m, growing with its square: Kinect's (Khoshelham and Elberink 2012)."""

# From the first row of a colour image to the last: root mean square between none (global shutter)
# and a frame's time at 30 Hz, which phones take nearly all of (Ringaby and Forssen 2012).
_READOUT_S = 0.019
_FOUND_AGAIN_PX = 0.15  # by which SIFT finds a point again in a view made of the same image

# --------------------------------------------------------------------------------------------
# The camera that is made up


def depth_rig(camera: RawCamera) -> StereoRig:
    """The colour camera without distortion on the right, and the one that is made up."""
    (fx, _, cx), (_, fy, cy) = camera.matrix[:2].tolist()
    size = camera.width, camera.height
    return StereoRig(*size, fx, fy, cx, cy, BASELINE_M, readout_s=_READOUT_S)


def depth_sigma_px(focal_px: float, sigma_m: float) -> float:
    """Noise of the disparity, pixels, where a depth of 1 m has ``sigma_m``, growing with Z^2."""
    return round(float(np.hypot(focal_px * BASELINE_M * sigma_m, _FOUND_AGAIN_PX)), 3)


def depth_images(
    read: ReadPair, rig: CameraRig, camera: RawCamera
) -> tuple[ImageLoader, DepthLoader]:
    """Frames as a stereo pair: the colour camera on the right, the view made by depth left.

    And the depth itself.

    Args:
        read: what gives image and depth.
        rig: of both cameras.
        camera: the colour camera, whose distortion is taken away.
    """
    maps = None
    if camera.model != "radtan" or np.any(camera.distortion):
        view = View(camera.matrix, (camera.width, camera.height))
        maps = sampling_maps(camera, np.eye(3), view, pixel_grid(view.size))

    def registered(index: int) -> tuple[Image, Depth]:
        image, metres, name = read(index)
        if metres.shape != image.shape[:2]:
            raise FrameError(
                f"image {name} is {metres.shape[1]}x{metres.shape[0]}, its colour image "
                f"{image.shape[1]}x{image.shape[0]}; depth must be registered to colour"
            )
        if maps is not None:
            image = np.asarray(cv2.remap(image, *maps, cv2.INTER_LINEAR), np.uint8)
            # Between two surfaces there is no depth: of each pixel the nearest.
            metres = np.asarray(cv2.remap(metres, *maps, cv2.INTER_NEAREST), np.float32)
        return image, metres

    def load(index: int, colour: bool) -> tuple[Image, ...]:
        image, metres = registered(index)
        known = np.isfinite(metres) & (metres > 0.0)
        shift = rig.fx * rig.baseline / np.where(known, metres, np.inf)
        pair = (image, seen_from_the_left(image, shift.astype(np.float32), known))
        if colour or image.ndim == 2:
            return pair
        return tuple(np.asarray(cv2.cvtColor(i, cv2.COLOR_RGB2GRAY), np.uint8) for i in pair)

    return load, lambda index: registered(index)[1]


_CRACK_PX = 3.0  # between two neighbours on one surface, in the original image
_LEAST_WEIGHT = 1e-3
_SMOOTH = (41, 41)  # what fills the parts that nothing is known of has no texture of this size


def seen_from_the_left(image: Image, shift: Float32, known: BoolArray) -> Image:
    """The image (h, w, ...) with each known pixel further right by its ``shift`` (h, w).

    Nearer surfaces hide farther ones. What is seen by neither is filled without texture.
    """
    height, width = shift.shape
    # The column of the original that each pixel of the view shows.
    rows, columns = np.nonzero(known)
    order = np.argsort(shift[rows, columns], kind="stable")  # the nearest last, which stays
    rows, columns = rows[order], columns[order]
    there = columns + shift[rows, columns]
    pixel = np.rint(there).astype(np.int64)
    inside = (pixel >= 0) & (pixel < width)
    source = np.full((height, width), np.nan, np.float32)
    source[rows[inside], pixel[inside]] = (columns + pixel - there)[inside]
    # A surface that is stretched leaves cracks of a pixel.
    before, after = source[:, :-2], source[:, 2:]
    crack = np.isnan(source[:, 1:-1]) & (np.abs(after - before) <= _CRACK_PX)
    source[:, 1:-1][crack] = 0.5 * (before + after)[crack]

    seen = np.isfinite(source)
    at_rows = np.repeat(np.arange(height, dtype=np.float32)[:, None], width, axis=1)
    at_columns = np.where(seen, source, -1.0).astype(np.float32)
    moved = np.asarray(cv2.remap(image, at_columns, at_rows, cv2.INTER_LINEAR))
    shown = seen if image.ndim == 2 else seen[:, :, None]
    weight = cv2.blur(seen.astype(np.float32), _SMOOTH)
    around = cv2.blur(np.where(shown, moved, 0).astype(np.float32), _SMOOTH)
    weight = np.maximum(weight, _LEAST_WEIGHT).reshape(*weight.shape, *(1,) * (image.ndim - 2))
    return np.asarray(np.where(shown, moved, around / weight), np.uint8)


# --------------------------------------------------------------------------------------------
# Files of colour and depth


def open_rgbd(settings: RgbdSettings, odometry: RecordedOdometrySettings) -> Recording:
    """Open colour and depth images; the colour camera is the reference.

    Args:
        settings: where they are, and of which camera.
        odometry: noise and limits of a file of odometry in the folder.

    Raises:
        DatasetError: images are missing or do not pair, or depths are in another unit.
        CalibrationError: nothing states the colour camera's focal length.
    """
    root = Path(settings.path)
    (pairs, unpaired, pairing), (stamps, assumed, lists, timing) = _pairs(root, settings.fps)
    faults: list[FrameError] = []
    size = first_size((colour for colour, _ in pairs), faults)
    if size is None:
        raise DatasetError(f"{root}: not one colour image can be read: {faults[-1]}")
    require_one_camera(settings)
    camera, known = _camera(root, settings, size)
    rig = mounted(depth_rig(camera), settings)
    seen, of_integers = sample_depths(
        root, len(pairs), lambda k: read_depth_image(pairs[k][1]), size
    )
    stated = settings.depth_scale or _stated_scale(root, settings)
    of_tum = (root / "depth.txt").is_file()
    scale, reported, unit = depth_unit(root, seen, of_integers, stated, of_tum)

    def read(index: int) -> tuple[Image, Depth, str]:
        colour_file, depth_file = pairs[index]
        colour = require_size(read_colour_image(colour_file), f"image {colour_file}", *size)
        depth = read_depth_image(depth_file)
        return colour, depth.astype(np.float32) / np.float32(scale), str(depth_file)

    images, depth = depth_images(read, rig, camera)
    files = lists, (path for pair in pairs for path in pair)
    notes = (*unpaired, *assumed, *known, *reported)
    lens = camera.model if camera.distortion.any() else "none"
    lens_entry = Entry(LENS, lens, settings.camera_file or str(root), "--camera")
    sigma = depth_sigma_px(settings.scale * rig.fx, DEPTH_SIGMA_M)
    return folder_recording(
        settings, odometry, root, rig, stamps, images, files, notes,
        ledger=(lens_entry, unit, timing, pairing), disparity_sigma_px=sigma,
        truth_frame="right", load_depth=depth,
    )  # fmt: skip


def require_one_camera(settings: CalibratedSettings) -> None:
    """Raises DatasetError where something is asked for that two cameras alone have."""
    for name, usual in (("fov_deg", None), ("unit_m", 1.0)):
        if getattr(settings, name) != usual:
            raise DatasetError(f"{settings.path}: dataset.{name} is for two cameras; leave it out")


def _pairs(root: Path, fps: float | None) -> tuple[Pairs, Stamps]:
    """Colour and depth of each frame, and the times of the colour images."""
    lists = (root / "rgb.txt", root / "depth.txt")
    if all(path.is_file() for path in lists):
        (colour_at, colours), (depth_at, depths) = map(listed_files, lists)
        others = [("depth", str(lists[1]), depth_at)]
        rows, notes, pairing = pair_stamps(colour_at, others, str(lists[0]), "colour")
        pairs = tuple((colours[i], depths[j]) for i, j in rows.tolist())
        timed = even_stamps(rows[:, 0], fps)
        if fps is None:
            entry = Entry(TIMES, "stamps", str(lists[0]), "--fps")
            timed = Stamps(NANOSECONDS * colour_at[rows[:, 0]].astype(np.float64), (), (), entry)
        return (pairs, notes, pairing), timed._replace(lists=lists)
    if path := next((root / n for n in _ASSOCIATIONS if (root / n).is_file()), None):
        return _associated(path, fps)
    if (folders := colour_and_depth(root)) is not None:
        mixed = images_in(folders[0]), images_in(folders[1])
        if empty := [str(f) for f, images in zip(folders, mixed, strict=True) if not images]:
            raise DatasetError(f"{empty[0]} holds no image; restore it")
    elif (found_mixed := colour_and_depth_files(root)) is not None:
        mixed = found_mixed
    else:
        raise DatasetError(f"{root} has no folders of colour and depth images (rgb/, depth/)")
    colour_files, depth_files = map(tuple, mixed)
    found = CameraFiles(depth_files, colour_files, root, False, sides=("depth", "colour"))
    paired = pair_files(found)
    used = [colour for colour, _ in paired[0]]
    return paired, stamps_of(used, (used[0].parent, root), fps, colour_files)


_ASSOCIATIONS = ("associations.txt", "association.txt", "associate.txt", "associated.txt")
"""Of TUM's associate.py: lines `seconds file seconds file`, colour or depth first."""


def _associated(path: Path, fps: float | None) -> tuple[Pairs, Stamps]:
    """Files of colour and depth, and colour's stamps; those that count the images state no times.

    So ICL-NUIM's do.
    """
    rows = [(number, text.replace(",", " ").split()) for number, text in read_lines(path)]
    for number, words in rows:
        if len(words) != 4 or not all(re.fullmatch(r"\d+(\.\d+)?", w) for w in words[::2]):
            raise DatasetError(
                f"{path}, line {number}: expected seconds, file, seconds, file; correct it"
            )
    depth_first = bool(rows) and "depth" in rows[0][1][1].lower()
    (colour_at, colour), (_, depth) = ((2, 3), (0, 1)) if depth_first else ((0, 1), (2, 3))
    pairs = tuple((path.parent / w[colour], path.parent / w[depth]) for _, w in rows)
    times = [words[colour_at] for _, words in rows]
    if fps or (all(map(str.isdecimal, times)) and counts_by_one([int(t) for t in times])):
        why = f"{path.name} counts images and states no times"
        timed = even_stamps(np.arange(len(pairs)), fps, why)
    elif not times:
        raise DatasetError(f"{path}: lists no image; restore the file")
    else:
        stamps, unit = in_seconds(times, str(path))
        timed = Stamps(stamps, unit, (), Entry(TIMES, "stamps", str(path), "--fps"))
    return (pairs, (), Entry(PAIRING, "as listed", str(path))), timed._replace(lists=(path,))


# --------------------------------------------------------------------------------------------
# The unit of depth


_TUM_SCALE, MILLIMETRES = 5000.0, 1000.0
_NEAREST_M, _FARTHEST_M = 0.05, 50.0  # of the median depth of an image
# Where 16 bits are only assumed to be millimetres: farther than RealSense, Kinect and Orbbec see.
_FARTHEST_GUESSED_M = 10.0
_NEAREST_OF_TUM_M = 0.4  # nearer than Kinect sees in its near mode, of which TUM's layout is
_ENDS = (1.0, 99.0)  # percentiles of depth that are its nearest and farthest: few pixels are wrong
_SAMPLES = 5  # depth images, over the whole recording
_SCALES = ("depth_scale", "DepthMapFactor", "RGBD.DepthMapFactor", "png_depth_scale", "scale")


def depth_unit(
    where: Path, seen: FloatArray, of_integers: bool, stated: float | None, of_tum: bool = False
) -> tuple[float, tuple[str, ...], Entry]:
    """Units a metre, the depth that follows from it in words, and where the unit is from.

    Where nothing states it, TUM's or millimetres, whichever a depth camera can have seen. Motion
    does not decide it: all that is seen is the same in a world of another size. Where both or
    neither can be, it is the layout's own.

    Raises:
        DatasetError: no depth camera sees as far.
    """
    caveat: tuple[str, ...] = ()
    if stated is None and of_integers:
        own, other = (_TUM_SCALE, MILLIMETRES) if of_tum else (MILLIMETRES, _TUM_SCALE)
        near, far = np.percentile(seen, _ENDS)
        nearest = {_TUM_SCALE: _NEAREST_OF_TUM_M, MILLIMETRES: _NEAREST_M}
        possible = {
            scale: near > nearest[scale] * scale and far < _FARTHEST_GUESSED_M * scale
            for scale in (own, other)
        }
        refused = float(np.median(seen)) >= _FARTHEST_GUESSED_M * own  # it may be a third unit
        certain = possible[own] and not possible[other]
        if possible[other] and not possible[own] and not refused:
            own, other = other, own
        if not certain:
            caveat = (
                "nothing states the unit of depth, and the size of the map depends on it: at "
                f"{own:g} units a metre it is {near / own:.2g} to {far / own:.2g} m, at {other:g} "
                f"{near / other:.2g} to {far / other:.2g} m; say which: "
                f"--set dataset.depth_scale={other:g} or {own:g}",
            )
        scale, farthest, assumed = own, _FARTHEST_GUESSED_M, ", which nothing states"
    else:
        scale, farthest, assumed = stated or 1.0, _FARTHEST_M, ""
    median = float(np.median(seen)) / scale
    if not _NEAREST_M < median < farthest:
        raise DatasetError(
            f"{where}: the median depth is {median:.4g} m at {scale:g} units a metre, which no "
            "depth camera sees; say the unit: --set dataset.depth_scale=1000 for millimetres, "
            "10000 for tenths of them, 5000 as in TUM's, 1 for metres"
        )
    taken = f"depth is taken as {scale:g} units a metre{assumed}: its median is {median:.3g} m"
    notes, guessed = (*caveat, taken), stated is None and of_integers
    source = notes[0] if guessed else "the recording, its calibration or the settings"
    value, option = f"{scale:g} units a metre", "dataset.depth_scale"
    return scale, notes, Entry(DEPTH, value, source, option, guessed)


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


def sample_depths(
    root: Path, count: int, read: Callable[[int], npt.NDArray[Any]], size: tuple[int, int]
) -> tuple[FloatArray, bool]:
    """Known depths (n,) of some images, in their own units, and whether these are integers."""
    faults: list[FrameError] = []
    images = list(readable(read, thinned(count, _SAMPLES).tolist(), faults))
    if not images:
        raise DatasetError(f"{root}: not one depth image can be read: {faults[-1]}")
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
        raise DatasetError(f"{root}: its depth images hold no depth at all; check them")
    return seen, bool(images[0].dtype == np.uint16)


# --------------------------------------------------------------------------------------------
# The colour camera


_TUM_CAMERAS = {
    "1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": ((535.4, 539.2, 320.1, 247.6), ()),
}
"""fx, fy, cx, cy and k1, k2, p1, p2, k3 of the colour cameras, as TUM publishes them; images of the
third are without distortion."""


_OF_COLOUR = re.compile(r"rgb|colou?r", re.IGNORECASE)


def camera_of_file(
    settings: DepthSettings, path: Path, size: tuple[int, int], topic: str = ""
) -> RawCamera:
    """The colour camera of a calibration file, for images of this size.

    Of several the one that the settings name, that of the images' topic, the only one of their
    size, or the only one whose name or topic states it.

    Raises:
        CalibrationError: it remains unknown which it is.
    """
    found = read_calibration_file(path, size=size).with_lens(settings.lens)
    left, number = list(found.cameras), settings.colour_camera
    if number is not None and number >= len(left):
        raise CalibrationError(
            f"{path}: dataset.colour_camera is {number}, but it has cameras 0 to {len(left) - 1}"
        )
    if number is not None:
        left = [left[number]]
    view = "/" + topic.strip("/")
    for fits in (
        lambda c: bool(topic) and "/" + c.topic.strip("/") == view,
        lambda c: (
            bool(topic) and "/" + c.topic.strip("/").rpartition("/")[0] == view.rpartition("/")[0]
        ),
        lambda c: c.size == size,
        lambda c: _OF_COLOUR.search(f"{c.name.rpartition(':')[2]} {c.topic}") is not None,
    ):
        left = list(filter(fits, left)) or left
    if len({(c.model, *c.matrix.flat, *c.distortion) for c in left}) > 1:
        raise CalibrationError(
            f"{path} holds {len(found.cameras)} cameras, and nothing states which of them took the "
            f"colour images: say it: --set dataset.colour_camera=0 for {found.cameras[0].name}, "
            f"1 for {found.cameras[1].name}, and so on"
        )
    alone = replace(found, cameras=(left[0],), view=None)
    return at_size(alone, size, settings.resized).cameras[0]


def _camera(
    root: Path, settings: RgbdSettings, size: tuple[int, int]
) -> tuple[RawCamera, tuple[str, ...]]:
    """The colour camera by the given file, the folder's own, or as TUM publishes it."""
    if settings.camera_file is not None:
        return camera_of_file(settings, Path(settings.camera_file), size), ()
    own = _own_files(root)
    if len(own) == 1:
        return camera_of_file(settings, own[0], size), ()
    known = re.search(r"(?:freiburg|fr)([123])(?!\d)", root.resolve().name)
    if known is None or size != (640, 480):
        raise CalibrationError(
            f"{root}: nothing states the colour camera's focal length; give one by --camera FILE"
        )
    intrinsics, distortion = _TUM_CAMERAS[known[1]]
    matrix, name = intrinsic_matrix(*intrinsics), f"freiburg{known[1]}"
    camera = RawCamera(*size, matrix, np.array(distortion or np.zeros(4)), np.eye(4), name)
    numbers = ", ".join(f"{value:g}" for value in distortion)
    taken = (
        f"its distortion k1, k2, p1, p2, k3 = {numbers} is taken away"
        if numbers
        else "of no distortion"
    )
    return camera, (f"the camera is taken as TUM's {name}, by the folder's name; {taken}",)


def _own_files(root: Path) -> list[Path]:
    """The folder's files that may be a camera; of several those that are one."""
    suffixes = (".json", ".yaml", ".yml", ".xml")
    found = [p for p in shown_in(root) if p.suffix in suffixes or p.name == "camera_info.txt"]
    if len(found) < 2:
        return found
    cameras = []
    for path in found:
        try:
            cameras += [path] if read_calibration_file(path).cameras else []
        except CalibrationError:
            continue
    return cameras
