"""The rectified stereo rig as users describe it: checked, with defaults, or from a file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from fgslam.cameras.assembly import (
    assembled,
    at_size,
    implausible,
    in_metres,
)
from fgslam.cameras.calibration import read_json_object
from fgslam.cameras.calibration_files import read_calibration_file
from fgslam.cameras.corrected import read_own_format
from fgslam.cameras.formats.own import calibration_of, is_rectified
from fgslam.cameras.raw_cameras import Calibration
from fgslam.cameras.rectification import Rectifier
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.checks import is_finite_number
from fgslam.core.errors import CalibrationError
from fgslam.core.files import as_path
from fgslam.core.geometry import pose
from fgslam.core.rig_checks import rig_fault
from fgslam.core.sensors import CAMERA_NAMES, CameraRig


def _identity() -> FloatArray:
    return np.eye(4)


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

    Raises:
        CalibrationError: a size, focal length or baseline is not positive and finite, the
            principal point is far from the image, or ``bTc`` is no rigid motion.
    """

    baseline: float = math.nan
    vertical_baseline: float | None = None
    bTc: FloatArray = field(default_factory=_identity)
    rectifier: Rectifier | None = None
    sources: tuple[int, ...] = (1, 0, 2)
    remarks: tuple[str, ...] = ()

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
    def margins(self) -> tuple[npt.NDArray[np.float32], ...]:
        """Per camera, how far each rectified pixel is from what shows nothing; empty: all do."""
        return () if self.rectifier is None else self.rectifier.margins

    def plain(self) -> CameraRig:
        """The rectified rig alone, without what makes images its own."""
        return CameraRig(**{name: getattr(self, name) for name in CameraRig.__dataclass_fields__})

    def rectified(self, images: tuple[Image, ...]) -> tuple[Image, ...]:
        """Rectified (right, left[, top]) of grey images (height, width) uint8 as the camera gives.

        The images themselves where the rig has nothing to rectify.
        """
        if self.rectifier is None:
            return images
        return self.rectifier.images(images)


def require_rig(rig: CameraRig) -> None:
    """Raises CalibrationError where ``rig`` is none, or its numbers cannot be those of one."""
    if not isinstance(rig, CameraRig):
        raise CalibrationError(
            f"rig: it is a {type(rig).__name__}; give a fgslam.StereoRig, or load one by "
            "fgslam.StereoRig.load(file)"
        )
    if fault := rig_fault(rig):
        raise CalibrationError(f"rig: {fault}")


# --------------------------------------------------------------------------------------------
# Calibration files


def load_rig(
    path: str | Path,
    path2: str | Path | None = None,
    *,
    size: tuple[int, int] | None = None,
    scale: bool = False,
    unit_m: float = 1.0,
    fov_deg: float | None = None,
    cameras: Sequence[int] | None = None,
) -> StereoRig:
    """The rig of calibration files; the format is recognised by the content.

    Where the cameras are not rectified, the rig holds the maps that rectify them, and a session
    applies them to the raw images that it is given. ``remarks`` of the rig say what was noticed.
    docs/howto/your_camera.md lists the formats. Pictures ``mask_left.png``, ``mask_right.png`` and
    ``mask_top.png`` beside the file (of EuRoC ``mask.png`` in a camera's folder) hide what is black
    in them: one's own robot, the rim of a lens.

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

    Raises:
        CalibrationError: the format or a camera model is not known, a value is missing or
            impossible, the size is another one, or the cameras are no stereo rig.
    """
    require_options(size, unit_m, fov_deg)
    _require_cameras(cameras)
    file = as_path(path, CalibrationError)
    file2 = None if path2 is None else as_path(path2, CalibrationError, "path2")
    own = _own_rectified(file, cameras, unit_m) if file2 is None else None
    same_size = own is not None and size in (None, (own.width, own.height))
    if own is not None and same_size and fov_deg is None:
        return with_masks(own, file)
    found = read_calibration_file(file, file2, size)
    found = at_size(in_metres(chosen_cameras(found, cameras), unit_m), size, scale)
    return with_masks(rig_of(found, fov_deg), file)


def rig_of(calibration: Calibration, fov_deg: float | None = None) -> StereoRig:
    """The rig of a calibration that is read; see :func:`load_rig`."""
    made = assembled(calibration, fov_deg)
    return _stereo_rig(made.rig, made.rectifier, made.sources, made.remarks)


def with_masks(rig: StereoRig, path: Path) -> StereoRig:
    """The rig with the masks that lie beside a calibration, of the raw images' size.

    Raises:
        CalibrationError: a mask is no picture, or has another size.
    """
    folder = path if path.is_dir() else path.parent
    order = range(rig.cameras) if rig.rectifier is None else rig.rectifier.order[: rig.cameras]
    shown = []
    for given, source in zip(order, rig.sources, strict=False):
        beside = folder / f"mask_{('right', 'left', 'top')[given]}.png"
        of_euroc = folder.parent / f"cam{source}" / "mask.png"
        if path.is_dir():
            of_euroc = folder / f"cam{source}" / "mask.png"
        shown.append(_mask(beside, rig) if beside.is_file() else _mask(of_euroc, rig))
    if all(one is None for one in shown):
        return rig
    plain = Rectifier(rig.plain(), ())
    raw = replace(rig.rectifier or plain, shown=tuple(shown))
    return replace(rig, rectifier=raw, remarks=(*rig.remarks, _hidden(raw)))


def _mask(path: Path, rig: StereoRig) -> Image | None:
    if not path.is_file():
        return None
    mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    width, height = rig.image_size
    if mask is None or mask.shape != (height, width):
        found = "no picture" if mask is None else f"{mask.shape[1]}x{mask.shape[0]}"
        raise CalibrationError(
            f"{path}: is {found}, but a mask has the size of the images, {width}x{height}; black "
            "is hidden"
        )
    return np.where(mask > _WHITE, 255, 0).astype(np.uint8)


_WHITE = 127


def _hidden(rectifier: Rectifier) -> str:
    parts = [
        f"{100.0 * float(np.mean(one == 0)):.0f} % of the {CAMERA_NAMES[k]} images"
        for k, one in enumerate(rectifier.shown)
        if one is not None
    ]
    return f"masks hide {', '.join(parts)}"


def _own_rectified(path: Path, cameras: Sequence[int] | None, unit_m: float) -> StereoRig | None:
    """The rig of a ``calib.json`` of rectified cameras, number by number; None for other files."""
    path = path / "calib.json" if path.is_dir() else path
    if not path.is_file() or path.suffix.lower() != ".json":
        return None
    values = read_json_object(path)
    # A file of that name is ours, if it is nobody else's: what it lacks is then named.
    if not is_rectified(values) and not (path.name == "calib.json" and "width" in values):
        return None
    three = "vertical_baseline_m" in values if cameras is None else len(cameras) == 3
    found = read_own_format(path, three)
    rig = _rig_in_metres(found.rig if isinstance(found, Rectifier) else found, unit_m)
    raw = replace(found, rig=rig) if isinstance(found, Rectifier) else None
    if unit_m != 1.0:
        assembled(calibration_of(rig, path))  # refuses a unit that makes one camera of two
    return _stereo_rig(rig, raw, (1, 0, 2)[: rig.cameras], implausible(str(path), rig))


def _rig_in_metres(rig: CameraRig, unit_m: float) -> CameraRig:
    """The rig with its lengths in metres; what corrects its images is in pixels and stays."""
    up = rig.vertical_baseline
    bTc = pose(rig.bTc[:3, :3], unit_m * rig.bTc[:3, 3])
    vertical = None if up is None else unit_m * up
    return replace(rig, baseline=unit_m * rig.baseline, vertical_baseline=vertical, bTc=bTc)


def _stereo_rig(
    rig: CameraRig, raw: Rectifier | None, sources: tuple[int, ...], remarks: tuple[str, ...]
) -> StereoRig:
    values = {name: getattr(rig, name) for name in CameraRig.__dataclass_fields__}
    return StereoRig(**values, rectifier=raw, sources=sources, remarks=remarks)


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


def _require_cameras(cameras: object) -> None:
    if cameras is not None and not isinstance(cameras, list | tuple | range):
        raise CalibrationError(
            f"cameras is a {type(cameras).__name__}; give a list of two or three numbers, or None"
        )


def require_options(size: object, unit_m: object, fov_deg: object) -> None:
    """Raises CalibrationError where what is said beside a file cannot be meant."""
    pair = size if isinstance(size, list | tuple) and len(size) == 2 else ()
    whole = pair and all(isinstance(n, int | np.integer) and n > 0 for n in pair)
    if size is not None and not whole:
        raise CalibrationError(f"size is {size!r}; give (width, height) of the images in pixels")
    if not is_finite_number(unit_m) or not float(unit_m) > 0.0:  # type: ignore[arg-type]
        raise CalibrationError(f"unit_m is {unit_m!r}; give metres, 0.001 for millimetres")
    within = is_finite_number(fov_deg) and 0.0 < float(fov_deg) < _WIDEST_DEG  # type: ignore[arg-type]
    if fov_deg is not None and not within:
        raise CalibrationError(
            f"fov_deg is {fov_deg!r}; a perspective view takes 0 to {_WIDEST_DEG:.0f} degrees"
        )


_WIDEST_DEG = 170.0  # not included
