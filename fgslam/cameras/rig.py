"""The rectified stereo rig: as users describe it, or from a calibration file.

From a file to a rig (:func:`load_rig`): what the file states (:func:`read_calibration_file`), which
of its cameras is which, and their common view (:func:`rig_of`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from fgslam.cameras import formats
from fgslam.cameras.calib_json import (
    OF_RECTIFIED,
    as_calibrated,
    correction_values,
    is_rectified,
    read_json_object,
    read_rectified,
    stated_corrections,
)
from fgslam.cameras.formats import KNOWN
from fgslam.cameras.lenses import Calibration, RawCamera, View, checked_camera
from fgslam.cameras.rectify import (
    Rectifier,
    chosen_view,
    orientation,
    rectifier,
    rectifier_of,
)
from fgslam.cameras.trees import Size, Tree, is_camera_text, read_tree
from fgslam.core.arrays import Float32, FloatArray, Image
from fgslam.core.checks import is_finite_number
from fgslam.core.errors import CalibrationError
from fgslam.core.files import as_path, read_text, shown_in
from fgslam.core.geometry import pose
from fgslam.core.log import rig_fault
from fgslam.core.sensors import CAMERA_NAMES, CameraRig
from fgslam.core.sides import camera_pairs

_WHITE = 127  # of a mask: darker is hidden
_WIDEST_DEG = 170.0  # not included


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class StereoRig(CameraRig):
    """Two or three rectified cameras, checked; it goes wherever a :class:`CameraRig` is asked for.

    The right camera is the reference. The left one sits ``baseline`` metres along its -x axis, the
    top one, if any, ``vertical_baseline`` metres along its -y axis. Camera axes: x right, y down,
    z forward; pixel (0, 0) is the centre of the top-left pixel.

    Attributes:
        width, height: image size, pixels.
        fx, fy: focal lengths, pixels; equal in all cameras.
        cx, cy: principal point (column, row), pixels.
        baseline: distance of left and right camera, metres.
        vertical_baseline: distance of top and right camera, metres; None without a top camera.
        bTc: (4, 4) pose of the right camera in the robot's body, where its odometry is measured.
            The identity where odometry is the camera's own motion, or there is none.
        exact: the calibration has no error, as that of a rendered rig; else covariances contain
            what one leaves.
        rectifier: how raw images become rectified ones; None where they are rectified already.
        sources: which of a calibration file's cameras are right, left[, top].
        remarks: what the calibration gives rise to say, a line each.
        format: of the calibration's file, in words; empty where there is none.
        file: the calibration's; empty where there is none.

    Raises:
        CalibrationError: a size, focal length or baseline is not positive and finite, the
            principal point is far from the image, or ``bTc`` is no rigid motion.
    """

    baseline: float = math.nan
    vertical_baseline: float | None = None
    bTc: FloatArray = field(default_factory=lambda: np.eye(4))
    rectifier: Rectifier | None = None
    sources: tuple[int, ...] = (1, 0, 2)
    remarks: tuple[str, ...] = ()
    format: str = ""
    file: str = ""

    def __post_init__(self) -> None:
        require_rig(self)

    @staticmethod
    def load(path: str | Path, size: tuple[int, int] | None = None) -> StereoRig:
        """The rig of a calibration file or folder: :func:`fgslam.load_rig`."""
        return load_rig(path, size=size)

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height in pixels of the images that the cameras give."""
        return (self.width, self.height) if self.rectifier is None else self.rectifier.raw_size

    @property
    def overlap(self) -> float:
        """Share of the rectified image that all cameras show something of, at infinity; 0 to 1."""
        return 1.0 if self.rectifier is None else self.rectifier.overlap

    @property
    def margins(self) -> tuple[Float32, ...]:
        """Per camera, how far each rectified pixel is from what shows nothing; empty: all do."""
        return () if self.rectifier is None else self.rectifier.margins

    def rectified(self, images: tuple[Image, ...]) -> tuple[Image, ...]:
        """Rectified (right, left[, top]) of grey images (height, width) uint8 as the camera gives.

        The images themselves where the rig has nothing to rectify.
        """
        return images if self.rectifier is None else self.rectifier.images(images)


def require_rig(rig: CameraRig) -> None:
    """Raises CalibrationError where ``rig`` is none, or its numbers cannot be those of one."""
    if not isinstance(rig, CameraRig):
        raise CalibrationError(
            f"rig: it is a {type(rig).__name__}; give fgslam.StereoRig.load(file)"
        )
    if fault := rig_fault(rig):
        raise CalibrationError(f"rig: {fault}")


def load_rig(
    path: str | Path,
    path2: str | Path | None = None,
    *,
    size: tuple[int, int] | None = None,
    scale: bool = False,
    unit_m: float = 1.0,
    fov_deg: float | None = None,
    cameras: Sequence[int] | None = None,
    lens: str | None = None,
) -> StereoRig:
    """The rig of calibration files; the format is recognised by the content.

    Where the cameras are not rectified, the rig holds the maps that rectify them, and a session
    applies them to the raw images that it is given. ``remarks`` of the rig say what was noticed.
    docs/howto/your_camera.md lists the formats. Pictures ``mask_left.png``, ``mask_right.png`` and
    ``mask_top.png`` next to the file (of EuRoC ``mask.png`` in a camera's folder) hide what is
    black in them: one's own robot, the rim of a lens.

    Args:
        path: the file, or a folder that holds one.
        path2: the second of two files: the right camera's, or OpenCV's extrinsics.
        size: width and height of the images in pixels, where the file does not state them, or the
            images were resized.
        scale: the images were resized as a whole: scale the calibration to ``size``.
        unit_m: metres of one unit of length of the file: 0.001 for millimetres, the side of a
            square for a calibration in squares.
        fov_deg: wanted horizontal angle of the rectified view in degrees, below 170; None: as much
            as all cameras fill, at most 120.
        cameras: which of the file's cameras form the rig, two or three; None: all.
        lens: "radtan" or "equidistant", what four coefficients are where the file does not state
            it; None: by its names.

    Raises:
        CalibrationError: the format or a camera model is not known, a value is missing or
            impossible, the size is another one, or the cameras are no stereo rig.
    """
    require_options(size, unit_m, fov_deg, cameras)
    file = as_path(path, CalibrationError)
    file2 = None if path2 is None else as_path(path2, CalibrationError, "path2")
    own = _own_rectified(file, cameras, unit_m) if file2 is None else None
    if own is not None and size in (None, (own.width, own.height)) and fov_deg is None:
        return with_masks(own, file)
    found = read_calibration_file(file, file2, size).with_lens(lens)
    found = at_size(in_metres(chosen_cameras(found, cameras), unit_m), size, scale)
    return with_masks(rig_of(found, fov_deg), file)


def require_options(size: object, unit_m: object, fov_deg: object, cameras: object = None) -> None:
    """Raises CalibrationError where an option of a file cannot be meant."""
    pair = size if isinstance(size, list | tuple) and len(size) == 2 else ()
    whole = pair and all(isinstance(n, int | np.integer) and n > 0 for n in pair)
    positive = is_finite_number(unit_m) and float(unit_m) > 0.0  # type: ignore[arg-type]
    within = is_finite_number(fov_deg) and 0.0 < float(fov_deg) < _WIDEST_DEG  # type: ignore[arg-type]
    of, widest = type(cameras).__name__, f"a perspective view takes 0 to {_WIDEST_DEG:.0f} degrees"
    for good, text in (
        (size is None or whole, f"size is {size!r}; give (width, height) of the images in pixels"),
        (positive, f"unit_m is {unit_m!r}; give metres, 0.001 for millimetres"),
        (fov_deg is None or within, f"fov_deg is {fov_deg!r}; {widest}"),
        (cameras is None or isinstance(cameras, list | tuple | range),
         f"cameras is a {of}; give a list of two or three numbers, or None"),
    ):  # fmt: skip
        if not good:
            raise CalibrationError(text)


def _own_rectified(path: Path, cameras: Sequence[int] | None, unit_m: float) -> StereoRig | None:
    """The rig of a ``calib.json`` of rectified cameras, number by number; None for other files."""
    path = path / "calib.json" if path.is_dir() else path
    if not path.is_file() or path.suffix.lower() != ".json":
        return None
    values = read_json_object(path)
    # A file of that name that is in no other format is ours: what it lacks is then named.
    if not is_rectified(values) and not (path.name == "calib.json" and "width" in values):
        return None
    three = "vertical_baseline_m" in values if cameras is None else len(cameras) == 3
    stated = read_rectified(path, three)
    up = stated.vertical_baseline
    rig = replace(  # what corrects its images is in pixels and stays
        stated,
        baseline=unit_m * stated.baseline,
        vertical_baseline=None if up is None else unit_m * up,
        bTc=pose(stated.bTc[:3, :3], unit_m * stated.bTc[:3, 3]),
    )
    raw = None
    if (corrections := stated_corrections(path, values)) is not None:
        found = correction_values(str(path), corrections, stated)
        raw = replace(rectifier_of(stated, found), rig=rig)
    if unit_m != 1.0:
        rig_of(as_calibrated(rig, path))  # refuses a unit that makes one camera of two
    remarks = implausible(str(path), rig)
    return replace(_stereo_rig(rig, raw, (1, 0, 2)[: rig.cameras], remarks), file=str(path))


def _stereo_rig(
    rig: CameraRig, raw: Rectifier | None, sources: tuple[int, ...], remarks: tuple[str, ...]
) -> StereoRig:
    values = {name: getattr(rig, name) for name in CameraRig.__dataclass_fields__}
    return StereoRig(**values, rectifier=raw, sources=sources, remarks=remarks)


def with_masks(rig: StereoRig, path: Path) -> StereoRig:
    """The rig with the masks that lie next to a calibration, of the raw images' size.

    Raises:
        CalibrationError: a mask is no picture, or has another size.
    """
    folder = path if path.is_dir() else path.parent
    of_euroc = path if path.is_dir() else folder.parent
    order = range(rig.cameras) if rig.rectifier is None else rig.rectifier.order[: rig.cameras]
    width, height = rig.image_size
    shown: list[Image | None] = []
    for given, source in zip(order, rig.sources, strict=False):
        names = folder / f"mask_{('right', 'left', 'top')[given]}.png", of_euroc / f"cam{source}"
        file = names[0] if names[0].is_file() else names[1] / "mask.png"
        if not file.is_file():
            shown.append(None)
            continue
        mask = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        if mask is None or mask.shape != (height, width):
            found = "no picture" if mask is None else f"{mask.shape[1]}x{mask.shape[0]}"
            raise CalibrationError(
                f"{file}: is {found}, but a mask has the size of the images, {width}x{height}"
            )
        shown.append(np.where(mask > _WHITE, 255, 0).astype(np.uint8))
    if all(one is None for one in shown):
        return rig
    hidden = [
        f"{100.0 * float(np.mean(one == 0)):.0f} % of the {CAMERA_NAMES[k]} images"
        for k, one in enumerate(shown)
        if one is not None
    ]
    raw = replace(rig.rectifier or Rectifier(rig.plain(), ()), shown=tuple(shown))
    return replace(rig, rectifier=raw, remarks=(*rig.remarks, f"masks hide {', '.join(hidden)}"))


# --------------------------------------------------------------------------------------------
# What calibration files say


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
    text = read_text(path, CalibrationError, f"restore the file; {KNOWN}")
    if found := formats.calibration_of_text(path, text, size):
        return found
    tree = _tree_of(path)
    partner = _partner(path, tree)
    return _of_tree(path, tree, size) if partner is None else _of_two(*partner, size)


_AS_JSON = "a .json of M1, D1, M2, D2, R, T and image_size"
_REMEDIES = {
    ".mat": "in MATLAB, [K1,D1,K2,D2,R,T] = stereoParametersToOpenCV(stereoParams), then write by "
    f"jsonencode {_AS_JSON} (--unit 0.001 where the squares were in millimetres)",
    ".pkl": f"a pickle may run programs; write {_AS_JSON}",
    ".bin": "write COLMAP's as text: colmap model_converter --output_type TXT",
    ".npz": f"write its arrays to {_AS_JSON}",
}
"""What to do with files that hold calibrations in a form of one program."""
_ONE_OF_MANY = "the calibration of one camera alone; a stereo pair needs K, D of both, R and T"
_FOREIGN = (
    (r"map[LRlr12_]|Map[LRlr12_]|_(map|rect)[xy]\b|rmap|undistort_?map", "rectification maps of "
     "OpenCV, no camera: rectify the images by them, and give K, D, R, T or fx and baseline"),
    (r"^\s*([-+.\deE]+\s+){4,8}[-+.\deE]+\s*\n\s*\d+\s+\d+\s*\n|^(Pinhole|FOV|RadTan|EquiDistant|"
     r"KannalaBrandt)\s[\d.]", f"a camera.txt of DSO or LSD-SLAM, {_ONE_OF_MANY}"),
    (r"Calibration results|reprojection errors?:", "results of Kalibr as text; give the camchain"
     ".yaml that Kalibr wrote next to it"),
    (r'"transform_matrix"|"camera_angle_x"', "transforms.json of nerfstudio or instant-ngp, "
     f"{_ONE_OF_MANY}"),
    (r'"sfm_data_version"|"openMVG|"intrinsicId"|"ptr_wrapper"', "a scene of OpenMVG or "
     f"AliceVision, {_ONE_OF_MANY}"),
    (r'"cameras"\s*:\s*\[.*"(intrinsics|transform)"', "a rig of cuVSLAM (.edex); write its cameras "
     "to a calib.json: docs/howto/your_camera.md has the keys"),
    (r"<calibration>|<sensor\b|<projection>", f"a calibration of Metashape, {_ONE_OF_MANY}"),
    (r'"projection_type"', f"cameras of OpenSfM, {_ONE_OF_MANY}"),
    (r"^NVM_V3|^# Bundle file", f"a scene of VisualSFM or Bundler, {_ONE_OF_MANY}"),
)  # fmt: skip
"""What recognises files of tools that hold no calibration of a stereo pair, and what to do."""


def _unknown_text(path: Path) -> str:
    """What a file of no known format is, where that is known, and what to give instead."""
    text = read_text(path, CalibrationError)[:20_000]
    for pattern, what in _FOREIGN:
        if re.search(pattern, text, re.MULTILINE | re.DOTALL):
            return f"{path} seems to be {what}"
    return f"{path}: not a calibration that is known; {KNOWN}"


_PARTNERS = (
    ("left.yaml", "right.yaml"),
    ("intrinsics.yml", "extrinsics.yml"),
    ("LeftCameraParams.yaml", "RightCameraParams.yaml"),
)
"""Names of files that belong together, as the tools that write them give."""
_TREES = (".yaml", ".yml", ".json", ".xml")
_SUFFIXES = (*_TREES, ".txt", ".conf")


def _tree_of(path: Path) -> Tree:
    tree = read_tree(path)
    if tree is None:
        raise CalibrationError(_unknown_text(path))
    return tree


def _of_tree(path: Path, tree: Tree, size: Size | None) -> Calibration:
    if formats.is_realsense(tree) or not is_rectified(tree):
        if (found := formats.calibration_of_tree(path, tree, size)) is None:
            raise CalibrationError(_unknown_text(path))
        return found
    if path.suffix.lower() != ".json":
        raise CalibrationError(
            f"{path}: {', '.join(sorted(OF_RECTIFIED & tree.keys()))} are keys of fgslam's "
            "calib.json; write it so (docs/datasets/images.md has its keys)"
        )
    rig = read_rectified(path, "vertical_baseline_m" in tree)
    return as_calibrated(rig, path, stated_corrections(path, tree))


def _of_two(first: Path, second: Path, size: Size | None) -> Calibration:
    files, trees = (first, second), (_tree_of(first), _tree_of(second))
    if all(map(formats.is_camera_info, trees)):
        return formats.read_camera_info_pair(files, trees)
    if all(map(formats.is_asl, trees)):
        cameras = tuple(map(formats.read_asl_camera, files, trees))
        return Calibration(f"{first} and {second}", "ASL sensor.yaml, a pair", cameras)
    if any(map(formats.is_opencv_pair, trees)):
        inner = second if formats.has_intrinsics(trees[1]) else first
        return formats.read_opencv_pair(inner, {**trees[1], **trees[0]}, size)
    one = [_of_tree(path, tree, size) for path, tree in zip(files, trees, strict=True)]
    raise CalibrationError(
        f"{first} ({one[0].format}) and {second} ({one[1].format}) do not say how the cameras "
        "stand to each other; give a calibration of the pair"
    )


def _is_half(tree: Tree) -> bool:
    """Whether it is one file of two that belong together."""
    return formats.is_asl(tree) or formats.is_camera_info(tree) or formats.is_opencv_half(tree)


def _partner(path: Path, tree: Tree) -> tuple[Path, Path] | None:
    """The two files of a pair, where this is one of them and the other lies next to it.

    By the names of a tool, by the side in their names, or as OpenCV's halves.
    """
    if not _is_half(tree):
        return None
    for names in _PARTNERS:
        first, second = (path.with_name(name) for name in names)
        if path.name in names and first.is_file() and second.is_file():
            return first, second
    trees = {}
    for file in shown_in(path.parent):
        try:
            if file.suffix.lower() in _TREES or (
                file.suffix.lower() == ".txt" and is_camera_text(read_text(file, CalibrationError))
            ):
                trees[file] = read_tree(file) or {}
        except CalibrationError:
            continue
    halves = [file for file, one in trees.items() if formats.is_opencv_half(one)]
    inner = [file for file in halves if formats.has_intrinsics(trees[file])]
    if len(halves) == 2 and len(inner) == 1:
        pairs = [(inner[0], next(file for file in halves if file != inner[0]))]
    else:
        alone = [file for file, one in trees.items() if _is_half(one) and file not in halves]
        sided = {file.name: file for file in alone}
        pairs = [(sided[left], sided[right]) for left, right in camera_pairs(sided)]
    pairs = [pair for pair in pairs if path in pair]
    return pairs[0] if len(pairs) == 1 else None


def _of_folder(folder: Path, size: Size | None) -> Calibration:
    """The only calibration of two cameras or more in a folder; two files of a pair are one."""
    root = folder / "mav0" if (folder / "mav0").is_dir() else folder
    if (root / "cam0" / "sensor.yaml").is_file():
        return _of_two(root / "cam0" / "sensor.yaml", root / "cam1" / "sensor.yaml", size)
    for name in ("calib.json", *(pair[0] for pair in _PARTNERS)):
        if (folder / name).is_file():
            return read_calibration_file(folder / name, size=size)
    found: dict[str, Calibration] = {}
    fault = None
    files = [one for one in shown_in(folder) if one.suffix.lower() in _SUFFIXES and one.is_file()]
    for path in files:
        try:
            one = read_calibration_file(path, size=size)
        except CalibrationError as error:
            fault = error
            continue
        if len(one.cameras) > 1:
            found.setdefault(one.source, one)
    chains = [one for source, one in found.items() if source.endswith("camchain.yaml")]
    if len(chains) == 1 and all(one.format == chains[0].format for one in found.values()):
        return chains[0]  # Kalibr writes its results next to it
    if len(found) > 1:
        names = ", ".join(Path(source).name for source in found)
        raise CalibrationError(f"{folder}: holds several calibrations ({names}); name one")
    if found:
        return next(iter(found.values()))
    if fault is not None and len(files) == 1 and files[0].suffix.lower() in _TREES:
        raise fault  # of the only file that may be meant
    raise CalibrationError(f"{folder}: holds no calibration of a stereo rig; {KNOWN}")


# --------------------------------------------------------------------------------------------
# Changes before that are asked for


def chosen_cameras(calibration: Calibration, cameras: Sequence[int] | None) -> Calibration:
    """The calibration of these of its cameras; None: all. Raises CalibrationError."""
    if cameras is None:
        return calibration
    count = len(calibration.cameras)
    good = len(set(cameras)) == len(cameras) in (2, 3)
    if not good or not all(isinstance(k, int) and 0 <= k < count for k in cameras):
        raise CalibrationError(
            f"{calibration.source}: cameras is {cameras!r}; give two or three of 0 to {count - 1}"
        )
    calibration.require_uncorrected("some of its cameras are chosen")
    chosen = tuple(calibration.cameras[k] for k in cameras)
    return replace(calibration, cameras=chosen, view=None)


def in_metres(calibration: Calibration, unit_m: float) -> Calibration:
    """The calibration with its lengths, given in a unit of ``unit_m`` metres, in metres."""
    if unit_m == 1.0:
        return calibration
    cameras = tuple(
        replace(c, bTc=pose(c.bTc[:3, :3], unit_m * c.bTc[:3, 3])) for c in calibration.cameras
    )
    return replace(calibration, cameras=cameras)


def at_size(calibration: Calibration, size: tuple[int, int] | None, scale: bool) -> Calibration:
    """The calibration for images of a size.

    Raises:
        CalibrationError: it is for images of another size, and scaling was not asked for.
    """
    if size is None:
        return calibration
    other = [c for c in calibration.cameras if c.size != size and c.width]
    if other:
        calibration.require_uncorrected(f"images of {size[0]}x{size[1]} pixels are given")
    if other and not scale:
        _require_one_size(calibration.cameras)
        different = (
            f"{calibration.source} is for images of {other[0].width}x{other[0].height} pixels, the "
            f"images have {size[0]}x{size[1]}"
        )
        if other[0].size == size[::-1]:
            raise CalibrationError(
                f"{different}: they lie on their side; turn them upright again (of a film: remove "
                "its rotation), or calibrate them as they are"
            )
        raise CalibrationError(
            f"{different}; if they were resized as a whole, say so: --set "
            "dataset.resized=true, --scale of fgslam camera, scale=True of load_rig"
        )
    cameras = tuple(
        c.scaled(size) if c.width else checked_camera(replace(c, width=size[0], height=size[1]))
        for c in calibration.cameras
    )
    return replace(calibration, cameras=cameras, view=None if other else calibration.view)


# --------------------------------------------------------------------------------------------
# From a calibration to a rig


_LEAST_BASELINE_M = 1e-3  # below it two cameras are one, up to rounding
# Longer than nearly any vehicle carries (cars have 0.3 to 0.6 m); webcams of 60 mm calibrated in
# squares of 20 to 30 mm have 2 to 3, in millimetres even an eye's 10 mm are more.
_LONGEST_BASELINE_M = 1.0
# Of the size, that a lens sits off the middle of its sensor; resized images differ by a third.
_OFF_MIDDLE = 0.1
# Cosine of 45 degrees: beyond, a common image plane would magnify the rims out of use.
_LEAST_COMMON_VIEW = 0.707
# A stated view with less of the raw resolution than this has collapsed.
_LEAST_STATED = 0.5
_SAME_PX = 1e-3  # cameras that differ by less are rectified already
_LEAST_OVERLAP = 0.5  # of the rectified view; less is reported
_KEPT_SHARE = 0.8  # of the angle of view; less is reported as cut off
_SKEW_DEG = 0.5  # from a right angle between the baselines of three cameras: reported beyond
_GIVEN_AS = (1, 0, 2)
"""Where the images of a sided file's left, right and third camera are among right, left, top."""


def rig_of(calibration: Calibration, fov_deg: float | None = None) -> StereoRig:
    """The rig of a calibration.

    Args:
        calibration: of two or three cameras.
        fov_deg: horizontal angle of the rectified view; None: as much as all cameras fill.

    Raises:
        CalibrationError: it is of one camera only or of more than three, their images differ in
            size, or they are no stereo pair.
    """
    cameras, source = calibration.cameras, calibration.source
    _require_rig_cameras(calibration)
    sources, turn, notes = _pair(cameras) if len(cameras) == 2 else _three(cameras)
    chosen = tuple(cameras[k] for k in sources)
    _require_side_by_side(chosen, turn)
    view, also = _view(calibration, chosen, sources, turn, fov_deg)
    values = calibration.corrections
    corrected = None if values is None else lambda rig: correction_values(source, values, rig)
    found = rectifier(chosen, view, corrected)
    if not found.overlap:
        raise CalibrationError(
            f"{source}: no place of the rectified view is seen by all of "
            f"{', '.join(camera.name for camera in chosen)}; check how they are turned to each "
            "other (R, T_BS) and their principal points"
        )
    turns = [np.eye(3)] * len(cameras)
    for k, rotation in zip(sources, view.rotations, strict=True):
        turns[k] = rotation
    stated = replace(view, rotations=tuple(turns))
    found = replace(found, calibration=replace(calibration, view=stated, corrections=None))
    remarks = (*calibration.notes, *notes, *also)
    if model := calibration.guessed_lens:
        text = f"{source} does not state the model of its four coefficients: taken as {model}"
        other = "equidistant" if model == "radtan" else "radtan"
        say = f"write distortion_model: {other} there, or say --set dataset.lens={other}"
        remarks = (*remarks, f"{text}; if they are {other}, {say} of a recording")
    if found.overlap < _LEAST_OVERLAP:
        remarks = (*remarks, f"{source}: cameras share {found.overlap:.0%} of the rectified view")
    if calibration.sided and len(sources) == 2:
        found = replace(found, order=tuple(_GIVEN_AS[k] for k in sources))
        if sources == (0, 1) and not notes:
            swapped = (
                f"left and right are swapped: {chosen[0].name}, the left one by its name, is "
                f"{found.rig.baseline:.3f} m to the right of the other; its images are taken as "
                "the right ones"
            )
            remarks = (*remarks, swapped)
    remarks = (*remarks, *implausible(source, found.rig))
    straight = found.order[:2] == (0, 1) and fov_deg is None and _are_rectified(chosen, turn)
    kept = None if straight and found.correction is None else found
    rig = _stereo_rig(found.rig, kept, sources, remarks)
    return replace(rig, format=calibration.format, file=source)


def implausible(source: str, rig: CameraRig) -> tuple[str, ...]:
    """Remarks where no vehicle carries cameras so far apart, and on numbers of another size."""
    remarks = []
    if rig.baseline > _LONGEST_BASELINE_M:
        remarks.append(
            f"{source}: the baseline is {rig.baseline:.4g} m; if its unit is not the metre, give "
            "it: --unit 0.001 for millimetres, or the side of a square in metres (unit_m of "
            "load_rig)"
        )
    across, down = 2.0 * rig.cx / rig.width, 2.0 * rig.cy / rig.height
    middle = math.sqrt(max(across * down, 0.0))
    if abs(across - down) < _OFF_MIDDLE and abs(middle - 1.0) > 2.0 * _OFF_MIDDLE:
        remarks.append(
            f"{source}: the principal point ({rig.cx:.1f}, {rig.cy:.1f}) is the middle of images "
            f"{middle:.2f} times as large as these, of {rig.width}x{rig.height} pixels: are fx, "
            "fy, cx and cy those of another resolution?"
        )
    return tuple(remarks)


def _require_rig_cameras(calibration: Calibration) -> None:
    """Raises CalibrationError unless there are two or three cameras of one known size."""
    cameras = calibration.cameras
    if len(cameras) == 1:
        raise CalibrationError(
            f"{calibration.source}: one camera alone ({calibration.format}) knows no baseline; "
            "give the calibration of the pair, or both cameras' files"
        )
    if len(cameras) > 3:
        raise CalibrationError(
            f"{calibration.source}: {len(cameras)} cameras; say which form the rig: cameras=(0, 1)"
        )
    if any(camera.width == 0 for camera in cameras):
        raise CalibrationError(
            f"{calibration.source} does not state the images' size; give size=(width, "
            "height), on the command line --size WxH"
        )
    _require_one_size(cameras)


def _require_one_size(cameras: Sequence[RawCamera]) -> None:
    first = cameras[0]
    for camera in cameras:
        if camera.size != first.size:
            raise CalibrationError(
                f"{first.name} is {first.width}x{first.height} but {camera.name} is "
                f"{camera.width}x{camera.height}; both must have one resolution"
            )


# --------------------------------------------------------------------------------------------
# Which camera is which


Placed = tuple[tuple[int, ...], FloatArray, tuple[str, ...]]
"""The cameras that are right, left[, top], how the view is turned, and remarks."""


def _offset(camera: RawCamera, reference: RawCamera) -> FloatArray:
    """Position (3,) of a camera in another's axes."""
    turned = reference.bTc[:3, :3]
    return np.asarray((camera.bTc[:3, 3] - reference.bTc[:3, 3]) @ turned)


def _pair(cameras: Sequence[RawCamera]) -> Placed:
    """Right and left: the left one sees the other at +x. Of two above each other, the upper one."""
    x, y, _ = _offset(cameras[1], cameras[0])
    if abs(x) >= abs(y):
        return ((1, 0) if x > 0.0 else (0, 1)), np.eye(3), ()
    lower, upper = (1, 0) if y > 0.0 else (0, 1)
    text = (
        f"{cameras[upper].name} is above {cameras[lower].name}: the view is turned by a quarter "
        "turn, in which the upper camera is the left one"
    )
    return (lower, upper), _quarter_turn(upper_side=True), (text,)


def is_stereo_pair(cameras: Sequence[RawCamera]) -> bool:
    """Whether two cameras see the same from next to each other, or above."""
    sources, turn, _ = _pair(cameras)
    try:
        _require_side_by_side([cameras[k] for k in sources], turn)
    except CalibrationError:
        return False
    return True


def _quarter_turn(upper_side: bool) -> FloatArray:
    """Turn (3, 3) of the view after which the camera above, or the one below, is the left one."""
    sign = 1.0 if upper_side else -1.0
    return np.array([[0.0, sign, 0.0], [-sign, 0.0, 0.0], [0.0, 0.0, 1.0]])


def _three(cameras: Sequence[RawCamera]) -> Placed:
    """Right, left[, top], how the view is turned about its axis, and remarks.

    Of cameras in a line the outer two are used. The corner of an L becomes the right one; the view
    is turned by a multiple of 90 degrees where its neighbours are not to the left and above.
    """
    cosines = []  # of the angle at each of the three cameras
    for k in range(3):
        a, b = (c.bTc[:3, 3] - cameras[k].bTc[:3, 3] for j, c in enumerate(cameras) if j != k)
        length = float(np.linalg.norm(a) * np.linalg.norm(b))
        cosines.append(float(a @ b / max(length, 1e-12)))
    if all(abs(cosine) > np.cos(np.radians(15.0)) for cosine in cosines):
        x = [_offset(camera, cameras[0])[0] for camera in cameras]
        right, left = int(np.argmax(x)), int(np.argmin(x))
        third = 3 - right - left
        text = f"three cameras in a line: {cameras[third].name}, between the others, is not used"
        return (right, left), np.eye(3), (text,)
    corner = min(range(3), key=lambda k: abs(cosines[k]))
    away = [_offset(camera, cameras[corner])[:2] for camera in cameras]
    others = [k for k in range(3) if k != corner]
    adjacent = max(others, key=lambda k: abs(away[k][0]) - abs(away[k][1]))
    above = next(k for k in others if k != adjacent)
    left_side, upper_side = away[adjacent][0] < 0.0, away[above][1] < 0.0
    skew = 90.0 - np.degrees(np.arccos(np.clip(cosines[corner], -1.0, 1.0)))
    notes: tuple[str, ...] = ()
    if abs(skew) > _SKEW_DEG:
        notes = (
            f"the two baselines are {abs(skew):.1f} degrees off a right angle: columns of the top "
            f"image differ by {np.sin(np.radians(abs(skew))):.3f} of the vertical disparity",
        )
    if left_side == upper_side:
        turn = np.eye(3) if left_side else np.diag([-1.0, -1.0, 1.0])
        return (corner, adjacent, above), turn, notes
    return (corner, above, adjacent), _quarter_turn(upper_side), notes


def _require_side_by_side(chosen: Sequence[RawCamera], turn: FloatArray) -> None:
    """Raises CalibrationError unless the cameras form a stereo rig."""
    right, left = chosen[:2]
    offset = turn @ _offset(right, left)
    if np.linalg.norm(offset) < _LEAST_BASELINE_M:
        raise CalibrationError(
            f"{left.name} and {right.name} are {1e3 * np.linalg.norm(offset):.3g} mm apart, as one "
            "camera; check T_BS (or T) in the calibration, and the unit of its lengths (--unit)"
        )
    if np.abs(offset[0]) < 2.0 * np.hypot(offset[1], offset[2]):
        x, y, z = offset
        raise CalibrationError(
            f"{left.name} and {right.name} are not side by side (offset {x:.3f}, {y:.3f}, {z:.3f} "
            "m along x, y, z); check T_BS (or R and T) in the calibration"
        )
    for other in chosen[1:]:
        if right.bTc[:3, 2] @ other.bTc[:3, 2] < _LEAST_COMMON_VIEW:
            raise CalibrationError(
                f"{other.name} and {right.name} look more than 45 degrees apart; check T_BS (or R "
                "and T) in the calibration"
            )


# --------------------------------------------------------------------------------------------
# The view


def _view(
    calibration: Calibration,
    chosen: Sequence[RawCamera],
    sources: tuple[int, ...],
    turn: FloatArray,
    fov_deg: float | None,
) -> tuple[View, tuple[str, ...]]:
    """The view, with the rotation of each camera into it, and remarks."""
    stated = calibration.view if fov_deg is None else None
    if stated is not None:
        stated = replace(stated, rotations=tuple(stated.rotations[k] for k in sources))
        if calibration.corrections is not None:
            return stated, ()
    calibration.require_uncorrected("another view (fov_deg) is asked for")
    if fov_deg is None and _are_rectified(chosen, turn):
        return View(chosen[0].matrix, chosen[0].size, (np.eye(3),) * len(chosen)), ()
    notes: tuple[str, ...] = ()
    natural = float(np.mean([camera.focal_px for camera in chosen]))
    if stated is not None:
        if stated.matrix[0, 0] > _LEAST_STATED * natural:
            return stated, ()
        notes = (
            f"the rectified focal length that the file states, {stated.matrix[0, 0]:.0f} px, would "
            f"shrink the images ({natural:.0f} px); another view is chosen",
        )
    width, height = chosen[0].size
    upright = abs(turn[0, 0]) > 0.5 or width == height
    axes = np.array([camera.bTc[:3, 2] for camera in chosen])
    body_to_view = orientation([camera.bTc[:3, 3] for camera in chosen], axes)
    rotations = tuple(body_to_view @ camera.bTc[:3, :3] for camera in chosen)
    view = chosen_view(chosen, rotations, (width, height) if upright else (height, width), fov_deg)
    seen = np.degrees(chosen[0].field_of_view()[:2])[:: 1 if upright else -1]
    kept = np.degrees(view.angles)
    if kept[0] <= _KEPT_SHARE * seen[0]:
        notes = (
            *notes,
            f"of {seen[0]:.0f} x {seen[1]:.0f} degrees the rectified view shows {kept[0]:.0f} x "
            f"{kept[1]:.0f}; what lies beyond is cut off (dataset.fov_deg, or --fov of fgslam "
            "camera, chooses another angle)",
        )
    return view, notes


def _are_rectified(chosen: Sequence[RawCamera], turn: FloatArray) -> bool:
    """Whether the images are rectified as they are: equal cameras, to the left and above."""
    right = chosen[0]
    if not np.array_equal(turn, np.eye(3)):
        return False
    for k, camera in enumerate(chosen):
        turned = right.bTc[:3, :3].T @ camera.bTc[:3, :3]
        away = np.delete(_offset(camera, right), 0 if k == 1 else 1)
        if (
            camera.model != "radtan"
            or camera.distortion.any()
            or not np.allclose(camera.matrix, right.matrix, rtol=0.0, atol=_SAME_PX)
            or not np.allclose(turned, np.eye(3), rtol=0.0, atol=1e-6)
            or np.abs(away).max() > 1e-6
        ):
            return False
    return True
