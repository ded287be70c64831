"""Cameras as calibrated, before rectification, and what a calibration file says of several."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from fgslam.cameras.lenses import LENSES, Lens
from fgslam.core.arrays import Brief, FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import inverse, is_rigid

_ZERO = 1e-6
_MOST_OBLONG = 10.0  # a pixel's sides; interlaced and anamorphic images have two
_LARGEST_SIDE = 100_000  # pixels; as images
_FARTHEST_M = 1e6
_PLACES = 8  # across the image, at which a lens is tried
_NARROWEST = 1e-4  # radians: a telescope's
_LEAST_SHARE = 0.2
"""Of the angle that a pixel is off the axis without distortion, what any lens leaves of it."""
_WALK = 400  # places between the centre and the border at which a ray is asked for


@dataclass(frozen=True, slots=True, eq=False)
class RawCamera:
    """A camera as calibrated: pixels of rays and rays of pixels.

    Attributes:
        width, height: pixels.
        matrix: (3, 3), from the plane of the model to pixels.
        distortion: (k,) parameters of the model, in the order of :mod:`fgslam.cameras.lenses`.
        bTc: (4, 4) pose of the camera in the body.
        name: in messages.
        model: name of a model in :data:`fgslam.cameras.lenses.LENSES`.
        topic: of its images in ROS; empty where the file states none.
    """

    width: int
    height: int
    matrix: FloatArray
    distortion: FloatArray
    bTc: FloatArray
    name: str = "camera"
    model: str = "radtan"
    topic: str = ""

    @property
    def lens(self) -> Lens:
        """The model's functions."""
        return LENSES[self.model]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.width, self.height

    @property
    def intrinsics(self) -> FloatArray:
        """(4,) fx, fy, cx, cy, pixels."""
        return self.matrix[[0, 1, 0, 1], [0, 1, 2, 2]]

    def project(self, points: FloatArray) -> FloatArray:
        """Pixels (n, 2) of points (n, 3) in the camera's axes; NaN where the model sees none.

        Pixels may lie outside the image.
        """
        points = np.asarray(points, np.float64)
        length = np.linalg.norm(points, axis=1)
        rays = points / np.where(length > 0.0, length, np.nan)[:, None]
        plane = self.lens.project(self.distortion, rays)
        return np.asarray(plane @ self.matrix[:2, :2].T + self.matrix[:2, 2])

    def unproject(self, pixels: FloatArray) -> FloatArray:
        """Rays (n, 3) of length 1 along which pixels (n, 2) look; NaN where the model sees none."""
        centred = np.asarray(pixels, np.float64) - self.matrix[:2, 2]
        plane = centred @ np.linalg.inv(self.matrix[:2, :2]).T
        rays = self.lens.unproject(self.distortion, plane)
        with np.errstate(over="ignore"):  # of absurd values in a file; where they lead is no ray
            length = np.linalg.norm(rays, axis=1, keepdims=True)
        return np.asarray(rays / np.where(np.isfinite(length), length, np.nan))

    def scaled(self, size: tuple[int, int]) -> RawCamera:
        """The same camera for its images resized to ``size`` (width, height).

        Raises:
            CalibrationError: the two sizes have not one shape, so the image was cropped.
        """
        x, y = size[0] / self.width, size[1] / self.height
        if abs(x / y - 1.0) > 0.01:  # a size rounded to whole pixels; cropping changes more
            raise CalibrationError(
                f"{self.name}: {self.width}x{self.height} pixels cannot be scaled to "
                f"{size[0]}x{size[1]}, which has another shape; the images were cropped, calibrate "
                "them"
            )
        # Whole pixels are at their centres: the image reaches from -0.5.
        to_new = np.array([[x, 0.0, 0.5 * x - 0.5], [0.0, y, 0.5 * y - 0.5], [0.0, 0.0, 1.0]])
        return replace(self, width=size[0], height=size[1], matrix=to_new @ self.matrix)

    @property
    def focal_px(self) -> float:
        """Pixels for a radian around the middle of the view."""
        centre = self.matrix[:2, 2]
        rays = self.unproject(centre + np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]]))
        across = [_between(rays[a], rays[a + 1]) for a in (0, 2)]
        return float(2.0 / np.mean(across))

    def field_of_view(self) -> FloatArray:
        """Horizontal, vertical and diagonal angle of view (3,) in radians."""
        right, down = self.width - 0.5, self.height - 0.5
        column, row = self.matrix[:2, 2]
        lines = (
            ((-0.5, row), (right, row)),
            ((column, -0.5), (column, down)),
            ((-0.5, -0.5), (right, down)),
        )
        return np.array([self._angle(line) for line in lines])

    def _angle(self, ends: tuple[tuple[float, float], tuple[float, float]]) -> float:
        """Angle seen from one pixel over the principal point to another."""
        total, centre = 0.0, self.matrix[:2, 2]
        share = np.linspace(0.0, 1.0, _WALK)[:, None]
        for end in ends:
            rays = self.unproject(centre + share * (np.array(end) - centre))
            known = np.isfinite(rays).all(axis=1)
            last = int(np.argmin(known)) - 1 if not known.all() else len(rays) - 1
            if last > 0:
                total += float(_between(rays[0], rays[last]))
        return total


def _between(a: FloatArray, b: FloatArray) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def checked_camera(camera: RawCamera) -> RawCamera:
    """The camera itself.

    Raises:
        CalibrationError: a number is impossible, the message names it.
    """
    fx, fy = camera.matrix[0, 0], camera.matrix[1, 1]
    known = camera.width == 0 or min(camera.size) > 0
    if not known or not min(fx, fy) > 0.0:
        raise CalibrationError(
            f"{camera.name}: size {camera.width}x{camera.height} and focal lengths {fx:g}, {fy:g} "
            "must be positive; correct the file"
        )
    if len(camera.distortion) not in camera.lens.sizes:
        raise CalibrationError(
            f"{camera.name}: {camera.model} takes {_either(camera.lens.sizes)} parameters, not "
            f"{len(camera.distortion)}; correct the file"
        )
    if not is_rigid(camera.bTc):
        raise CalibrationError(f"{camera.name}: its pose is not a rigid motion; correct the file")
    if np.abs(camera.bTc[:3, 3]).max() > _FARTHEST_M:
        raise CalibrationError(
            f"{camera.name}: it is {np.abs(camera.bTc[:3, 3]).max():g} m from its body or the "
            "other camera; correct the file"
        )
    fault = _matrix_fault(camera.matrix) or _size_fault(camera) or _view_fault(camera)
    if fault:
        raise CalibrationError(f"{camera.name}: {fault}; correct the file")
    return camera


def checked_view(view: StatedView, source: str) -> StatedView:
    """The stated rectification itself.

    Raises:
        CalibrationError: its matrix is none of a camera's, the message names ``source``.
    """
    fault = _matrix_fault(view.matrix)
    if fault:
        raise CalibrationError(f"{source}: of the rectified images: {fault}; correct the file")
    return view


def _matrix_fault(matrix: FloatArray) -> str | None:
    """What no camera's intrinsics are, in words; None where they may be one's."""
    (fx, skew, _), (other, fy, _), last = matrix
    if not min(fx, fy) > 0.0:
        return f"focal lengths {fx:g}, {fy:g} must be positive"
    if np.abs(last - (0.0, 0.0, 1.0)).max() > _ZERO:
        return f"its matrix must be fx s cx, 0 fy cy, 0 0 1 by rows; it is {_rows(matrix)}"
    if not max(fx / fy, fy / fx) < _MOST_OBLONG:
        return f"focal lengths {fx:g} and {fy:g} are no camera's, pixels are nearly square"
    if not (abs(skew) < fx and abs(other) < fy):  # OCamCalib has both
        return f"its matrix is no camera's, pixels have nearly right angles: {_rows(matrix)}"
    return None


def _size_fault(camera: RawCamera) -> str | None:
    if max(camera.size) > _LARGEST_SIDE:
        return f"no image is {camera.width}x{camera.height} pixels large"
    size, centre = np.array(camera.size), camera.matrix[:2, 2]
    # Cropped images may have it outside, but hardly by more than their own size.
    if camera.width and not ((centre >= -size) & (centre <= 2 * size)).all():
        column, row = centre
        return (
            f"its principal point ({column:g}, {row:g}) is far from the image of "
            f"{camera.width}x{camera.height} pixels"
        )
    return None


def _view_fault(camera: RawCamera) -> str | None:
    """What such images cannot show, in words; None where they may, or the size is not known."""
    if camera.width == 0:
        return None
    half = np.array(camera.size) / 2.0
    steps = np.linspace(-1.0, 1.0, _PLACES)
    offset = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) * half
    centre = camera.matrix[:2, 2]
    with np.errstate(all="ignore"):  # what overflows has no ray
        rays = camera.unproject(np.vstack([centre, centre + offset]))
        straight = np.hypot(*(offset / np.diag(camera.matrix)[:2]).T)
    angle = np.arctan2(np.linalg.norm(np.cross(rays[0], rays[1:]), axis=1), rays[1:] @ rays[0])
    seen = np.isfinite(angle)
    if not seen.any():
        return f"its lens model has no ray for any of {camera.width}x{camera.height} pixels"
    if np.median(angle[seen]) < _NARROWEST or (
        camera.model != "ocam" and np.median((angle / np.arctan(straight))[seen]) < _LEAST_SHARE
    ):
        shown = np.rad2deg(2.0 * angle[seen].max())
        return (
            f"focal lengths and lens model show {shown:.2g} degrees in {camera.width}x"
            f"{camera.height} pixels"
        )
    return None


def _rows(matrix: FloatArray) -> str:
    return ", ".join(" ".join(f"{value:g}" for value in row) for row in matrix)


def _either(sizes: tuple[int, ...]) -> str:
    if len(sizes) > 5:
        return f"{sizes[0]} to {sizes[-1]}"
    return " or ".join(map(str, sizes))


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class StatedView(Brief):
    """The rectification that a file states.

    Attributes:
        rotations: (3, 3) each, from raw to rectified axes, in the order of the file's cameras.
        matrix: (3, 3) intrinsics of all rectified images, pixels.
        size: width and height of the rectified images, pixels.
    """

    rotations: tuple[FloatArray, ...]
    matrix: FloatArray
    size: tuple[int, int]


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Brief):
    """What a calibration file says.

    Attributes:
        source: the file.
        format: in words.
        cameras: in the file's order.
        sided: whether the file calls its first camera the left one and the second the right one.
        view: the rectification that it states; None where there is none.
        corrections: of images rectified like that, what a drive found, by the names of its terms
            (:func:`fgslam.core.rig_correction.term_names`); None where there are none.
        notes: what a user should know, a line each.
    """

    source: str
    format: str
    cameras: tuple[RawCamera, ...]
    sided: bool = False
    view: StatedView | None = None
    notes: tuple[str, ...] = field(default=())
    corrections: Mapping[str, float] | None = None

    def require_uncorrected(self, what: str) -> None:
        """Raises CalibrationError where it has corrections, which ``what`` would lose."""
        if self.corrections is not None:
            raise CalibrationError(
                f"{self.source} has corrections, which hold for its own images and view: {what}; "
                "leave that out, or use the calibration without corrections"
            )

    def offset(self, camera: int, other: int) -> FloatArray:
        """Pose (4, 4) of one camera in another's axes."""
        return inverse(self.cameras[other].bTc) @ self.cameras[camera].bTc
