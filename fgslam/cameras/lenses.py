"""Cameras as calibrated: rays to pixels and back, one function of each for every lens model.

A model takes a ray to its *plane*, (n, 2) without unit; the camera's matrix takes the plane to
pixels. Axes are a camera's: x right, y down, z forward. What a model cannot see is NaN, also where
its distortion turns back, so that no place of the world is seen twice.

========== ============================ ====================================================
model      parameters                   source
========== ============================ ====================================================
radtan     k1 k2 p1 p2 [k3 [k4 k5 k6    Brown; OpenCV's order, of 4, 5, 8 (rational), 12 or
           [s1 s2 s3 s4 [tx ty]]]]      14 numbers
equidistant k1 k2 k3 k4                 Kannala and Brandt (2006); cv2.fisheye
fov        w                            Devernay and Faugeras (2001)
ds         xi alpha                     Usenko, Demmel and Cremers (2018), double sphere
eucm       alpha beta                   Khomutenko, Garcia and Martinet (2016)
omni       xi k1 k2 p1 p2               Mei and Rives (2007); cv2.omnidir, camodocal's MEI
ocam       a0 a1 a2 ...                 Scaramuzza, Martinelli and Siegwart (2006), OCamCalib
========== ============================ ====================================================
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.polynomial import polynomial

from fgslam.core.arrays import BoolArray, Brief, FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import inverse, is_rigid

_NEWTON_STEPS = 20
_STEP = 1e-6  # of the numerical derivative of a distortion, which is of order 1
_CONVERGED = 1e-10  # of the plane: a millionth of a pixel at any focal length
# Radii whose slope is looked at for where a distortion turns back: every 0.05 degrees to 89.5.
_RADII = np.tan(np.radians(np.linspace(0.0, 89.5, 1791)))
_ANGLES = np.linspace(0.0, np.pi, 3601)
_AHEAD = 1e-9  # least z of a ray of length 1 that a perspective model takes


class Lens(NamedTuple):
    """A camera model.

    Attributes:
        sizes: how many parameters it may have.
        project: parameters (k,) and unit rays (n, 3) to the plane (n, 2).
        unproject: parameters (k,) and the plane (n, 2) to rays (n, 3) of any length.
    """

    sizes: tuple[int, ...]
    project: Callable[[FloatArray, FloatArray], FloatArray]
    unproject: Callable[[FloatArray, FloatArray], FloatArray]


def _seen(values: FloatArray, seen: BoolArray) -> FloatArray:
    return np.where(np.asarray(seen)[:, None], values, np.nan)


# --------------------------------------------------------------------------------------------
# Radial-tangential


def _radtan_project(parameters: FloatArray, rays: FloatArray) -> FloatArray:
    z = rays[:, 2]
    ahead = z > _AHEAD
    plane = rays[:, :2] / np.where(ahead, z, 1.0)[:, None]
    return _seen(_distorted(parameters, plane), ahead)


def _radtan_unproject(parameters: FloatArray, plane: FloatArray) -> FloatArray:
    flat = _undistorted(parameters, plane)
    return np.column_stack([flat, np.ones(len(flat))])


def _distorted(parameters: FloatArray, plane: FloatArray) -> FloatArray:
    """Points of the plane (n, 2) as the lens shows them; NaN beyond where it turns back."""
    if not len(plane) or not parameters.any():
        return plane
    within = np.hypot(*plane.T) <= _RADII[_rising(_radial(parameters)) - 1]
    points = np.column_stack([np.where(within[:, None], plane, 0.0), np.ones(len(plane))])
    seen = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), parameters)[0]
    return _seen(np.asarray(seen, np.float64).reshape(-1, 2), within)


def _radial(parameters: FloatArray) -> FloatArray:
    """Radii as the lens shows the radii ``_RADII``."""
    k1, k2, k3, k4, k5, k6 = np.concatenate([parameters, np.zeros(8)])[[0, 1, 4, 5, 6, 7]]
    r2 = _RADII**2
    below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
    with np.errstate(divide="ignore", invalid="ignore"):
        shown = _RADII * (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / below
    return np.where(below > 0.0, shown, np.nan)


def _rising(values: FloatArray) -> int:
    """How many of the values (n,) rise before the first that does not."""
    stops = np.flatnonzero(~(np.diff(values) > 0.0))
    return int(stops[0]) + 1 if len(stops) else len(values)


def _undistorted(parameters: FloatArray, plane: FloatArray) -> FloatArray:
    """Inverse of :func:`_distorted`: started by the radius alone, ended by Newton's method."""
    if not len(plane) or not parameters.any():
        return plane
    shown = _radial(parameters)
    rising = _rising(shown)
    radius = np.hypot(*plane.T)
    start = np.interp(radius, shown[:rising], _RADII[:rising])
    found = plane * (start / np.maximum(radius, 1e-12))[:, None]
    left = np.full_like(found, np.nan)
    for _ in range(_NEWTON_STEPS):
        left = _distorted(parameters, found) - plane
        if not np.abs(left).max(initial=0.0, where=np.isfinite(left)) > 0.01 * _CONVERGED:
            break
        found = found - _solved(parameters, found, left)
    good = np.abs(left).max(axis=1) < _CONVERGED
    return _seen(found, good)


def _solved(parameters: FloatArray, at: FloatArray, left: FloatArray) -> FloatArray:
    """Newton steps (n, 2) at points (n, 2) that are ``left`` off."""
    columns = [
        (_distorted(parameters, at + _STEP * e) - _distorted(parameters, at - _STEP * e))
        / (2.0 * _STEP)
        for e in np.eye(2)
    ]
    (a, c), (b, d) = (column.T for column in columns)
    determinant = a * d - b * c
    determinant = np.where(np.abs(determinant) < 1e-12, np.nan, determinant)
    step = np.column_stack([d * left[:, 0] - b * left[:, 1], a * left[:, 1] - c * left[:, 0]])
    return step / determinant[:, None]


# --------------------------------------------------------------------------------------------
# Fisheyes: the radius is a function of the angle to the axis


def _on_radius(rays: FloatArray, radius: FloatArray) -> FloatArray:
    across = np.hypot(rays[:, 0], rays[:, 1])
    factor = np.where(across > 0.0, radius / np.maximum(across, 1e-300), 0.0)
    return rays[:, :2] * factor[:, None]


def _at_angle(plane: FloatArray, angle: FloatArray) -> FloatArray:
    radius = np.hypot(*plane.T)
    factor = np.where(radius > 0.0, np.sin(angle) / np.maximum(radius, 1e-300), 1.0)
    return np.column_stack([plane * factor[:, None], np.cos(angle)])


def _angle(rays: FloatArray) -> FloatArray:
    return np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])


def _kannala(parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Coefficients of the radius as a polynomial of the angle, and of its derivative."""
    coefficients = np.zeros(10)
    coefficients[1::2] = 1.0, *parameters
    return coefficients, np.asarray(polynomial.polyder(coefficients))


def _polynomial(x: FloatArray, coefficients: FloatArray) -> FloatArray:
    return np.asarray(polynomial.polyval(x, coefficients), np.float64)


def _equidistant_project(parameters: FloatArray, rays: FloatArray) -> FloatArray:
    coefficients, _ = _kannala(parameters)
    shown = _polynomial(_ANGLES, coefficients)
    angle = _angle(rays)
    radius = _polynomial(angle, coefficients)
    return _seen(_on_radius(rays, radius), angle <= _ANGLES[_rising(shown) - 1])


def _equidistant_unproject(parameters: FloatArray, plane: FloatArray) -> FloatArray:
    coefficients, slopes = _kannala(parameters)
    shown = _polynomial(_ANGLES, coefficients)
    rising = _rising(shown)
    radius = np.hypot(*plane.T)
    angle: FloatArray = np.asarray(
        np.interp(radius, shown[:rising], _ANGLES[:rising], right=np.nan), np.float64
    )
    for _ in range(4):  # the table is within 1e-7 already
        slope = np.maximum(_polynomial(angle, slopes), 1e-6)
        angle = angle - (_polynomial(angle, coefficients) - radius) / slope
    return _at_angle(plane, angle)


def _fov_project(parameters: FloatArray, rays: FloatArray) -> FloatArray:
    (w,) = parameters
    ahead = rays[:, 2] > _AHEAD
    tangent = np.hypot(rays[:, 0], rays[:, 1]) / np.where(ahead, rays[:, 2], 1.0)
    radius = np.arctan(2.0 * tangent * np.tan(0.5 * w)) / w
    return _seen(_on_radius(rays, radius), ahead)


def _fov_unproject(parameters: FloatArray, plane: FloatArray) -> FloatArray:
    (w,) = parameters
    turned = np.hypot(*plane.T) * w
    angle = np.arctan(np.tan(turned) / (2.0 * np.tan(0.5 * w)))
    return _seen(_at_angle(plane, angle), turned < 0.5 * np.pi)


# --------------------------------------------------------------------------------------------
# Spheres: double sphere, extended unified, unified with radial-tangential distortion


def _ds_project(parameters: FloatArray, rays: FloatArray) -> FloatArray:
    xi, alpha = parameters
    z = rays[:, 2]
    shifted = xi + z
    below = alpha * np.hypot(np.hypot(rays[:, 0], rays[:, 1]), shifted) + (1.0 - alpha) * shifted
    w1 = _edge(alpha)
    w2 = (w1 + xi) / np.sqrt(2.0 * w1 * xi + xi**2 + 1.0)
    return _over(rays, below, z > -w2)


def _edge(alpha: float) -> float:
    return alpha / (1.0 - alpha) if alpha <= 0.5 else (1.0 - alpha) / alpha


def _over(rays: FloatArray, below: FloatArray, seen: BoolArray) -> FloatArray:
    seen = seen & (below > _AHEAD)
    return _seen(rays[:, :2] / np.where(seen, below, 1.0)[:, None], seen)


def _ds_unproject(parameters: FloatArray, plane: FloatArray) -> FloatArray:
    xi, alpha = parameters
    r2 = (plane**2).sum(axis=1)
    root = 1.0 - (2.0 * alpha - 1.0) * r2
    mz = (1.0 - alpha**2 * r2) / (alpha * np.sqrt(np.maximum(root, 0.0)) + 1.0 - alpha)
    inner = mz**2 + (1.0 - xi**2) * r2
    scale = (mz * xi + np.sqrt(np.maximum(inner, 0.0))) / (mz**2 + r2)
    rays = np.column_stack([plane * scale[:, None], scale * mz - xi])
    return _seen(rays, (root >= 0.0) & (inner >= 0.0))


def _eucm_project(parameters: FloatArray, rays: FloatArray) -> FloatArray:
    alpha, beta = parameters
    z = rays[:, 2]
    distance = np.sqrt(beta * (rays[:, 0] ** 2 + rays[:, 1] ** 2) + z**2)
    return _over(rays, alpha * distance + (1.0 - alpha) * z, z > -_edge(alpha) * distance)


def _eucm_unproject(parameters: FloatArray, plane: FloatArray) -> FloatArray:
    alpha, beta = parameters
    r2 = beta * (plane**2).sum(axis=1)
    root = 1.0 - (2.0 * alpha - 1.0) * r2
    below = alpha * np.sqrt(np.maximum(root, 0.0)) + 1.0 - alpha
    rays = np.column_stack([plane, (1.0 - alpha**2 * r2) / below])
    return _seen(rays, root >= 0.0)


def _omni_project(parameters: FloatArray, rays: FloatArray) -> FloatArray:
    xi = parameters[0]
    z = rays[:, 2]
    # Of a sphere that is looked at from outside only the near side is seen.
    seen = z > -(1.0 / xi if xi > 1.0 else xi)
    return _distorted(parameters[1:], _over(rays, z + xi, seen))


def _omni_unproject(parameters: FloatArray, plane: FloatArray) -> FloatArray:
    xi = parameters[0]
    flat = _undistorted(parameters[1:], plane)
    r2 = (flat**2).sum(axis=1)
    root = 1.0 + (1.0 - xi**2) * r2
    scale = (xi + np.sqrt(np.maximum(root, 0.0))) / (1.0 + r2)
    return _seen(np.column_stack([flat * scale[:, None], scale - xi]), root >= 0.0)


# --------------------------------------------------------------------------------------------
# OCamCalib: the ray's depth is a polynomial of the radius in pixels


def _ocam_unproject(parameters: FloatArray, plane: FloatArray) -> FloatArray:
    # OCamCalib's axes are rows, columns and backward.
    return np.column_stack([plane, -polynomial.polyval(np.hypot(*plane.T), parameters)])


def _ocam_project(parameters: FloatArray, rays: FloatArray) -> FloatArray:
    # No picture is wider than 20 times the polynomial's first coefficient, a focal length.
    radii = np.linspace(0.0, 20.0 * abs(float(parameters[0])), 20001)
    angles = np.arctan2(radii, -polynomial.polyval(radii, parameters))
    rising = _rising(angles)
    angle = _angle(rays)
    radius = np.interp(angle, angles[:rising], radii[:rising], right=np.nan)
    slope_of = polynomial.polyder(parameters)
    for _ in range(3):  # Newton on radius cos(angle) + depth(radius) sin(angle)
        left = radius * np.cos(angle) + polynomial.polyval(radius, parameters) * np.sin(angle)
        slope = np.cos(angle) + polynomial.polyval(radius, slope_of) * np.sin(angle)
        radius = radius - np.where(np.abs(slope) > 1e-9, left / slope, 0.0)
    return _on_radius(rays, radius)


LENSES = {
    "radtan": Lens((4, 5, 8, 12, 14), _radtan_project, _radtan_unproject),
    "equidistant": Lens((4,), _equidistant_project, _equidistant_unproject),
    "fov": Lens((1,), _fov_project, _fov_unproject),
    "ds": Lens((2,), _ds_project, _ds_unproject),
    "eucm": Lens((2,), _eucm_project, _eucm_unproject),
    "omni": Lens((5,), _omni_project, _omni_unproject),
    "ocam": Lens(tuple(range(2, 65)), _ocam_project, _ocam_unproject),
}
"""Every model by the name that files and messages use."""


# --------------------------------------------------------------------------------------------
# A camera as calibrated, before rectification

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
        distortion: (k,) parameters of the model, in the order of this module.
        bTc: (4, 4) pose of the camera in the body.
        name: in messages.
        model: name of a model in :data:`LENSES`.
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
                f"{size[0]}x{size[1]}, another shape; they were cropped, calibrate them"
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
    """The camera itself, with as many parameters as its model takes.

    Zeros behind those that a model has carry nothing: drivers pad their lists. So do a rational
    model's terms that are left out, and a list without any number.

    Raises:
        CalibrationError: a number is impossible, the message names it.
    """
    given, sizes = camera.distortion, camera.lens.sizes
    used = int(np.flatnonzero(given)[-1]) + 1 if given.any() else 0
    whole = next((size for size in sizes if size >= used), 0)
    if len(given) not in sizes and whole and (len(given) > sizes[0] or not len(given)):
        camera = replace(camera, distortion=np.append(given[:used], np.zeros(whole - used)))
    for fault in _camera_faults(camera):
        raise CalibrationError(f"{camera.name}: {fault}; correct the file")
    return camera


def checked_view(view: View, source: str) -> View:
    """The stated rectification itself.

    Raises:
        CalibrationError: its matrix is none of a camera's, the message names ``source``.
    """
    for fault in _matrix_faults(view.matrix):
        raise CalibrationError(f"{source}: of the rectified images: {fault}; correct the file")
    return view


def _matrix_faults(matrix: FloatArray) -> Iterator[str]:
    """What no camera's intrinsics are, in words."""
    (fx, skew, _), (other, fy, _), last = matrix
    rows = ", ".join(" ".join(f"{value:g}" for value in row) for row in matrix)
    if not min(fx, fy) > 0.0:
        yield f"focal lengths {fx:g}, {fy:g} must be positive"
    if np.abs(last - (0.0, 0.0, 1.0)).max() > _ZERO:
        yield f"its matrix must be fx s cx, 0 fy cy, 0 0 1 by rows; it is {rows}"
    if not max(fx / fy, fy / fx) < _MOST_OBLONG:
        yield f"focal lengths {fx:g} and {fy:g} are no camera's, pixels are nearly square"
    if not (abs(skew) < fx and abs(other) < fy):  # OCamCalib has both
        yield f"its matrix is no camera's, pixels have nearly right angles: {rows}"


def _camera_faults(camera: RawCamera) -> Iterator[str]:
    """What no camera is, in words; fewer where its size is not known."""
    sizes, count = camera.lens.sizes, len(camera.distortion)
    size, centre, place = np.array(camera.size), camera.matrix[:2, 2], camera.bTc[:3, 3]
    shown = f"{camera.width}x{camera.height} pixels"
    if camera.width and min(camera.size) <= 0:
        yield f"size {camera.width}x{camera.height} must be positive"
    if count not in sizes:
        some = " or ".join(map(str, sizes)) if len(sizes) < 6 else f"{sizes[0]} to {sizes[-1]}"
        yield f"{camera.model} takes {some} parameters, not {count}"
    if not is_rigid(camera.bTc):
        yield "its pose is not a rigid motion"
    if np.abs(place).max() > _FARTHEST_M:
        yield f"it is {np.abs(place).max():g} m from its body or the other camera"
    yield from _matrix_faults(camera.matrix)
    if max(camera.size) > _LARGEST_SIDE:
        yield f"no image is {shown} large"
    if camera.width == 0:
        return
    # Cropped images may have it outside, but hardly by more than their own size.
    if not ((centre >= -size) & (centre <= 2 * size)).all():
        yield f"its principal point ({centre[0]:g}, {centre[1]:g}) is far from the image of {shown}"
    steps = np.linspace(-1.0, 1.0, _PLACES)
    offset = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) * (size / 2.0)
    with np.errstate(all="ignore"):  # what overflows has no ray
        rays = camera.unproject(np.vstack([centre, centre + offset]))
        straight = np.hypot(*(offset / np.diag(camera.matrix)[:2]).T)
    angle = np.arctan2(np.linalg.norm(np.cross(rays[0], rays[1:]), axis=1), rays[1:] @ rays[0])
    seen = np.isfinite(angle)
    if not seen.any():
        yield f"its lens model has no ray for any of {shown}"
    elif np.median(angle[seen]) < _NARROWEST or (
        camera.model != "ocam" and np.median((angle / np.arctan(straight))[seen]) < _LEAST_SHARE
    ):
        degrees = np.rad2deg(2.0 * angle[seen].max())
        yield f"focal lengths and lens model show {degrees:.2g} degrees in {shown}"


def pixel_grid(size: tuple[int, int]) -> FloatArray:
    """(width * height, 2) column and row of every pixel, row by row."""
    columns, rows = np.meshgrid(*(np.arange(length, dtype=float) for length in size))
    return np.column_stack([columns.ravel(), rows.ravel()])


# --------------------------------------------------------------------------------------------
# What a calibration file states of several


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class View(Brief):
    """The image plane of rectified images, and how cameras are turned into it.

    Attributes:
        matrix: (3, 3) intrinsics of all rectified images, pixels.
        size: width and height of the rectified images, pixels.
        rotations: (3, 3) each, from raw to rectified axes, in the order of the cameras.
    """

    matrix: FloatArray
    size: tuple[int, int]
    rotations: tuple[FloatArray, ...] = ()

    @property
    def angles(self) -> FloatArray:
        """Horizontal and vertical angle of view (2,) in radians."""
        ends = np.array([[-0.5, -0.5], [self.size[0] - 0.5, self.size[1] - 0.5]])
        low, high = (ends - self.matrix[:2, 2]) / np.diag(self.matrix)[:2]
        return np.asarray(np.arctan(high) - np.arctan(low))

    def rays(self, pixels: FloatArray) -> FloatArray:
        """Rays (n, 3), of any length, along which pixels (n, 2) look."""
        homogeneous = np.column_stack([pixels, np.ones(len(pixels))])
        return np.asarray(homogeneous @ np.linalg.inv(self.matrix).T)


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Brief):
    """The contents of a calibration file.

    Attributes:
        source: the file.
        format: in words.
        cameras: in the file's order.
        sided: whether the file calls its first camera the left one and the second the right one.
        view: the rectification that it states; None where there is none.
        corrections: of images rectified like that, what a drive found, by the names of its terms
            (:func:`fgslam.core.correction.term_names`); None where there are none.
        guessed_lens: model that four coefficients are taken for where nothing states it: they are
            Brown's k1 k2 p1 p2 or those of a fisheye; else empty.
        notes: what a user should know, a line each.
    """

    source: str
    format: str
    cameras: tuple[RawCamera, ...]
    sided: bool = False
    view: View | None = None
    notes: tuple[str, ...] = field(default=())
    corrections: Mapping[str, float] | None = None
    guessed_lens: str = ""

    def with_lens(self, model: str | None) -> Calibration:
        """The calibration with its coefficients as those of ``model``, where nothing states it."""
        if not model or not self.guessed_lens:
            return self
        cameras = tuple(checked_camera(replace(c, model=model)) for c in self.cameras)
        return replace(self, cameras=cameras, guessed_lens="")

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
