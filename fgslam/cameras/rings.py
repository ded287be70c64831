"""Calibration from pictures: the mirror's circle, and elevations from known rings.

Both look along rays from the mirror's centre and find edges to a fraction of a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from fgslam.cameras.omni import MirrorFrame, RadialPolynomial, fit_radial_polynomial
from fgslam.core.arrays import Float32, FloatArray, Image
from fgslam.core.errors import CalibrationError

_DIRECTIONS = 360
_STEP_PX = 0.25
_BLUR_PX = 1.0
_CIRCLE_TRIALS = 500
_CIRCLE_TOLERANCE = 0.01  # of the radius: what counts as on the circle while searching
_LEAST_CONTRAST = 4.0  # grey levels a pixel; 2 grey levels of noise leave 0.35 after smoothing
_REFINEMENTS = 5
_MARGIN_PX = 3.0
_NEAR = 0.05  # of the radius: the Bloggie's holder ends 13 % further out than its mirror
_MIN_SUPPORT = 0.35


@dataclass(frozen=True, slots=True)
class MirrorCircle:
    """The outer circle of a mirror in a picture.

    Attributes:
        centre: column and row, pixels.
        radius: pixels.
        support: part of the directions around the centre in which its edge was found.
    """

    centre: tuple[float, float]
    radius: float
    support: float


def find_mirror_circle(
    image: Image, rng: np.random.Generator, near: tuple[tuple[float, float], float] | None = None
) -> MirrorCircle:
    """Finds the circle on which the mirror's bright picture ends toward the dark around it.

    Args:
        image: (height, width) or (height, width, 3).
        rng: of the search among the edges.
        near: centre and radius that it should have, to choose between the concentric edges of a
            mirror and its holder: edges more than a twentieth of the radius off are left out. None:
            the circle with the most support, around a centre within the middle half of the picture.

    Raises:
        CalibrationError: there is no such circle, seen in at least a third of all directions.
    """
    grey = _grey(image)
    height, width = grey.shape
    centre, limits = ((width - 1) / 2.0, (height - 1) / 2.0), (0.2 * min(grey.shape), 0.75 * width)
    if near is not None:
        centre, limits = near[0], ((1.0 - _NEAR) * near[1], (1.0 + _NEAR) * near[1])
    edges = _falling_edges(grey, centre, limits)
    seed = _search_circle(edges, np.array(centre), limits, 0.25 * min(grey.shape), rng)
    circle = None if seed is None else _refined(grey, seed)
    if circle is None or not limits[0] < circle.radius < limits[1] or circle.support < _MIN_SUPPORT:
        raise CalibrationError(
            "no mirror's circle is found in the picture: it must be brighter inside than outside, "
            f"on at least {_MIN_SUPPORT:.0%} of its circumference"
        )
    return circle


def _grey(image: Image) -> Float32:
    flat = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return np.asarray(cv2.GaussianBlur(flat.astype(np.float32), (0, 0), _BLUR_PX), np.float32)


def _radial_profiles(
    grey: Float32, centre: tuple[float, float], limits: tuple[float, float]
) -> tuple[FloatArray, FloatArray, Float32]:
    """Radii (m,), directions (k,), grey levels (k, m) along rays; NaN outside the picture."""
    radii = np.arange(limits[0], limits[1], _STEP_PX)
    angles = np.linspace(-np.pi, np.pi, _DIRECTIONS, endpoint=False)
    columns = centre[0] + np.cos(angles)[:, None] * radii
    rows = centre[1] + np.sin(angles)[:, None] * radii
    profile = cv2.remap(grey, columns.astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR)
    outside = (
        (columns < 0) | (rows < 0) | (columns > grey.shape[1] - 1) | (rows > grey.shape[0] - 1)
    )
    return radii, angles, np.where(outside, np.float32(np.nan), profile).astype(np.float32)


def _slopes(profiles: Float32) -> Float32:
    """(k, m) derivative along the rays, grey levels a pixel; 0 outside the picture.

    Taken over a pixel each way: a quarter pixel would amplify the interpolation's facets.
    """
    reach = round(1.0 / _STEP_PX)
    out = np.zeros_like(profiles)
    out[:, reach:-reach] = (profiles[:, 2 * reach :] - profiles[:, : -2 * reach]) / 2.0
    return np.nan_to_num(out, copy=False)


def _peaks(slopes: FloatArray | Float32, least: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Row, place along it (fractional, by a parabola) and height of all local maxima."""
    middle = slopes[:, 1:-1]
    peak = (middle > slopes[:, :-2]) & (middle >= slopes[:, 2:]) & (middle >= least)
    ray, place = np.nonzero(peak)
    before, top, after = (slopes[ray, place + k].astype(np.float64) for k in range(3))
    shift = 0.5 * (before - after) / (before - 2.0 * top + after)
    return ray.astype(np.float64), place + 1.0 + shift, top


# --------------------------------------------------------------------------------------------
# The mirror's circle


def _falling_edges(
    grey: Float32, centre: tuple[float, float], limits: tuple[float, float], outermost: bool = True
) -> FloatArray:
    """(n, 2) points at which the picture gets darker outward.

    In each direction the strongest and, where it is asked for, the outermost one: within the mirror
    there are many more.
    """
    radii, angles, profiles = _radial_profiles(grey, centre, limits)
    ray, place, height = _peaks(-_slopes(profiles), _LEAST_CONTRAST)
    order = np.lexsort((-height, ray))
    chosen = order[np.unique(ray[order], return_index=True)[1]]
    if outermost:
        last = np.flatnonzero(np.append(np.diff(ray) > 0, True)[: len(ray)])
        chosen = np.union1d(chosen, last)
    radius = radii[0] + place[chosen] * _STEP_PX
    angle = angles[ray[chosen].astype(np.int64)]
    return np.column_stack([centre[0] + radius * np.cos(angle), centre[1] + radius * np.sin(angle)])


def _search_circle(
    points: FloatArray,
    around: FloatArray,
    limits: tuple[float, float],
    reach: float,
    rng: np.random.Generator,
) -> tuple[FloatArray, float] | None:
    """Circle through three points with the most others on it, seen all around (RANSAC).

    Its centre lies within ``reach`` of ``around``.
    """
    if len(points) < 30:
        return None
    triples = points[rng.integers(0, len(points), (_CIRCLE_TRIALS, 3))]
    centres, radii = _circles(triples)
    good = (radii > limits[0]) & (radii < limits[1])
    good &= np.hypot(*(centres - around).T) < reach
    best, most = None, _MIN_SUPPORT
    for centre, radius in zip(centres[good], radii[good], strict=True):
        away = points - centre
        on = np.abs(np.hypot(*away.T) - radius) < _CIRCLE_TOLERANCE * radius
        sectors = ((np.arctan2(away[on, 1], away[on, 0]) / (2.0 * np.pi)) % 1.0) * _DIRECTIONS
        part = len(np.unique(sectors.astype(np.int64))) / _DIRECTIONS  # of all directions
        if part > most:
            best, most = (centre, float(radius)), part
    return best


def _circles(triples: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Centres (n, 2) and radii (n,) through point triples (n, 3, 2); NaN where in line."""
    a, b, c = triples[:, 0], triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0]
    twice = 2.0 * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])
    bb, cc = (b**2).sum(axis=1), (c**2).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        x = (c[:, 1] * bb - b[:, 1] * cc) / twice
        y = (b[:, 0] * cc - c[:, 0] * bb) / twice
    return a + np.column_stack([x, y]), np.hypot(x, y)


def _refined(grey: Float32, circle: tuple[FloatArray, float]) -> MirrorCircle:
    """Edges found again from the circle's own centre, and a least-squares circle through them."""
    centre, radius = circle
    found = 0
    for step in range(_REFINEMENTS):
        width = max(2.0 * _CIRCLE_TOLERANCE * radius / (1 + step), 3.0)
        limits = (max(radius - width - 2.0, 1.0), radius + width + 2.0)
        around = (float(centre[0]), float(centre[1]))
        edges = _falling_edges(grey, around, limits, outermost=False)
        if len(edges) < 3:
            break
        centre, radius, found = _fit_circle(edges)
    return MirrorCircle((float(centre[0]), float(centre[1])), radius, found / _DIRECTIONS)


def _fit_circle(points: FloatArray) -> tuple[FloatArray, float, int]:
    """Centre, radius, and how many points (n, 2) agree: least squares, trimmed."""
    kept = points
    for _ in range(_REFINEMENTS):
        # x^2 + y^2 = 2 a x + 2 b y + c, linear in a, b, c.
        design = np.column_stack([2.0 * kept, np.ones(len(kept))])
        a, b, c = np.linalg.lstsq(design, (kept**2).sum(axis=1), rcond=None)[0]
        radius = float(np.sqrt(c + a * a + b * b))
        away = np.hypot(points[:, 0] - a, points[:, 1] - b) - radius
        limit = max(3.0 * 1.4826 * float(np.median(np.abs(away))), 0.2)
        kept = points[np.abs(away) <= limit]
        if len(kept) < 3:
            break
    return np.array([a, b]), radius, len(kept)


# --------------------------------------------------------------------------------------------
# Rings at known elevations


@dataclass(frozen=True, slots=True, eq=False)
class RingCalibration:
    """The camera that a picture of rings at known elevations gives.

    Attributes:
        camera: the polynomial camera.
        worst: largest residual of a ring, radians.
        radii: (n,) of the rings, pixels, as their elevations were given.
        directions: part of the directions in which all rings were found.
    """

    camera: RadialPolynomial
    worst: float
    radii: FloatArray
    directions: float


def calibrate_from_rings(
    image: Image,
    elevations: FloatArray,
    frame: MirrorFrame,
    radii: tuple[float, float],
) -> RingCalibration:
    """Fits the paper's polynomial to a picture of black and white rings around the camera.

    The calibration object is an upright cylinder around the camera with black and white bands; each
    border of two bands is a ring at one elevation, and a circle in the picture.

    Args:
        image: (height, width) or (height, width, 3).
        elevations: (n,) of the rings in radians, from the inner to the outer one.
        frame: where the mirror lies; :func:`find_mirror_circle` finds its centre.
        radii: inner and outer, pixels: the rings lie between.

    Raises:
        CalibrationError: fewer than half of the directions show all rings, or the fit fails.
    """
    count = len(elevations)
    # A margin, so that an edge near the limits is still a peak.
    limits = (max(radii[0] - _MARGIN_PX, 0.0), radii[1] + _MARGIN_PX)
    along, angles, profiles = _radial_profiles(_grey(image), frame.centre, limits)
    ray, place, height = _peaks(np.abs(_slopes(profiles)), _LEAST_CONTRAST)
    radius = along[0] + place * _STEP_PX
    within = (radius >= radii[0]) & (radius <= radii[1])
    each = _rings_in_each_direction(ray[within], radius[within], height[within], count)
    directions = len(each) / len(angles)
    if directions < 0.5:
        raise CalibrationError(
            f"only {directions:.0%} of the directions around the mirror's centre show {count} "
            "rings; check the number of elevations, the centre and the radii"
        )
    ring_radii = np.median(each, axis=0)
    camera, worst = fit_radial_polynomial(frame, radii, (ring_radii, np.asarray(elevations)))
    return RingCalibration(camera, worst, ring_radii, directions)


def _rings_in_each_direction(
    ray: FloatArray, radius: FloatArray, height: FloatArray, count: int
) -> FloatArray:
    """(k, count) radii of the ``count`` strongest edges in directions that have a clear set.

    Clear is a set whose weakest edge is twice as strong as the next one: noise or glare.
    """
    order = np.lexsort((-height, ray))
    ray, radius, height = ray[order], radius[order], height[order]
    _, start, number = np.unique(ray, return_index=True, return_counts=True)
    found = []
    for first, n in zip(start, number, strict=True):
        end = first + count
        if n < count or (n > count and height[end] * 2.0 > height[end - 1]):
            continue
        found.append(np.sort(radius[first:end]))
    return np.array(found).reshape(-1, count)
