"""What a lens model leaves of each image's displacement that is in no term of a rig's correction.

A random field over each image: smooth, as large in columns as in rows, and without what the terms
of :data:`fgslam.core.correction.TERMS` follow. Its modes are those of Karhunen and Loeve, on a
grid. docs/derivations/measurements.md.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, TypeAlias

import numpy as np

from fgslam.core.arrays import BoolArray, Brief, FloatArray, IntArray
from fgslam.core.sensors import CameraRig
from fgslam.core.store import Kept
from fgslam.core.types import Features

# ------------------------------------------------------------------------------------------
# What a stated calibration leaves uncorrected, as displacements of a rig's pixels

IMAGE_TERMS = (
    "column",  # principal point
    "row",
    "yaw",  # rotation, radians
    "pitch",
    "roll",
    "focal",  # relative
    "decentring_x",  # of the lens
    "decentring_y",
    "radial",
    "decentring_x_outer",  # the same times r^2: Brown's third decentring value, along each axis
    "decentring_y_outer",
)
"""Of each camera but the reference, in units of the focal length."""

BASELINE_TERMS = ("baseline_across", "baseline_ahead")
"""Direction in which the camera lies, radians from its baseline: in the image plane (left: down,
top: right), and along the optical axis. What they displace a pixel by grows with its parallax."""

TERMS = (*IMAGE_TERMS, *BASELINE_TERMS)
"""Of each camera but the reference."""

COMMON = ("radial",)
"""What is estimated of all cameras alike, the reference among them."""

SHARED = ("column", "row", "focal", "decentring_x", "decentring_y", "radial", "baseline")
"""What all cameras may share, and covariances take as unknown: the same terms, in all images alike,
and the baseline's length, relative. A turn that they share is one of the robot. COMMON is among
them, as many drives show it less well than they seem to."""

EXPECTED_PX = 1.0
"""Displacement that a calibration is taken to leave, root mean square over the image: what the
matcher's epipolar gate (``StereoSettings.epipolar_px``) admits; a worse rig matches nothing."""

BASELINE_SIGMA = 7e-3
"""Radians that a stated baseline's direction is off by: 0.2 to 0.4 degrees on KITTI's roads."""

IMPLAUSIBLE_PX = 3.0 * EXPECTED_PX
"""Displacement that no calibration is taken to leave: three deviations of what is expected."""

_CAMERAS = ("left", "top")
_CHANGES = ("yaw_deg", "pitch_deg", "roll_deg", "focal_percent")
_CHANGE_UNITS = np.array([180.0 / np.pi] * 3 + [100.0])
_COMMON = [TERMS.index(name) for name in COMMON]
_Shift: TypeAlias = tuple[FloatArray | float, FloatArray | float]
_GRID = 7  # points along each axis of the image at which the prior is stated


def term_names(rig: CameraRig) -> tuple[str, ...]:
    """Names of the values: ``left.yaw`` and so on of each camera in turn, then ``all.radial``."""
    of_each = [f"{camera}.{term}" for camera in _CAMERAS[: rig.cameras - 1] for term in TERMS]
    return (*of_each, *(f"all.{term}" for term in COMMON))


def image_terms(rig: CameraRig) -> BoolArray:
    """Which values (p,) displace an image whatever it shows: all but the baselines' directions."""
    return np.array([not name.endswith(BASELINE_TERMS) for name in term_names(rig)], np.bool_)


def displacements(rig: CameraRig, pixels: FloatArray) -> FloatArray:
    """Displacements (k, 2 * cameras, p) of pixels by a unit of each term, pixels.

    Args:
        rig: as calibrated.
        pixels: (k, cameras, 2) raw (column, row) in right, left[, top].
    """
    out = np.zeros((2 * rig.cameras, _count(rig), len(pixels)))
    for camera in range(rig.cameras):
        _fill(out[2 * camera : 2 * camera + 2], rig, camera, pixels[:, camera])
    for camera in range(1, rig.cameras):
        own = out[2 * camera : 2 * camera + 2, len(TERMS) * camera - 2 : len(TERMS) * camera]
        own[:] = _by_direction(rig, camera, pixels[:, 0], pixels[:, camera])
    return np.ascontiguousarray(out.transpose(2, 0, 1))


def _by_direction(
    rig: CameraRig, camera: int, reference: FloatArray, own: FloatArray
) -> FloatArray:
    """Displacements (2, 2, k) of a camera's pixels (k, 2) by a unit of each of BASELINE_TERMS."""
    along = camera - 1
    parallax = (own - reference)[:, along]
    across = np.zeros((2, len(own)))
    across[1 - along] = -parallax
    return np.stack([across, parallax * np.stack(_rays(rig, own))], axis=1)


def camera_displacements(rig: CameraRig, camera: int, pixels: FloatArray) -> FloatArray:
    """Displacements (k, 2, p) of pixels (k, 2) of one camera (0: right) by a unit of each term.

    Zero for BASELINE_TERMS: what these do depends on where the reference camera sees the point.
    """
    out = np.zeros((2, _count(rig), len(pixels)))
    _fill(out, rig, camera, pixels)
    return np.ascontiguousarray(out.transpose(2, 0, 1))


def _count(rig: CameraRig) -> int:
    return len(TERMS) * (rig.cameras - 1) + len(COMMON)


def _fill(out: FloatArray, rig: CameraRig, camera: int, pixels: FloatArray) -> None:
    """Writes one camera's displacements (2, p, k) by its own IMAGE_TERMS and the common ones.

    Term by term over all pixels, for speed.
    """
    rays = _rays(rig, pixels)
    if camera:
        own = slice(len(TERMS) * (camera - 1), len(TERMS) * camera - len(BASELINE_TERMS))
        _scale(out[:, own], rig, _terms(*rays))
        out[:, -len(COMMON) :] = out[:, own][:, _COMMON]
    else:
        _scale(out[:, -len(COMMON) :], rig, [_radial(*rays)])


def _rays(rig: CameraRig, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Normalised image points (k,), (k,)."""
    return (pixels[:, 0] - rig.cx) / rig.fx, (pixels[:, 1] - rig.cy) / rig.fy


def _scale(out: FloatArray, rig: CameraRig, terms: Iterable[_Shift]) -> None:
    """Writes displacements of normalised points, term by term, as such of pixels (2, n, k)."""
    for at, (column, row) in enumerate(terms):
        np.multiply(rig.fx, column, out=out[0, at])
        np.multiply(rig.fy, row, out=out[1, at])


def _radial(x: FloatArray, y: FloatArray) -> _Shift:
    r2 = x * x + y * y
    return x * r2, y * r2


def _terms(x: FloatArray, y: FloatArray) -> list[_Shift]:
    """Displacements in column and row of normalised image points (k,), by IMAGE_TERMS in turn."""
    xx, xy, yy = x * x, x * y, y * y
    r2, across = xx + yy, 2.0 * xy
    along_x, along_y, outer = r2 + 2.0 * xx, r2 + 2.0 * yy, across * r2
    return [
        (1.0, 0.0),
        (0.0, 1.0),
        (1.0 + xx, xy),
        (xy, 1.0 + yy),
        (-y, x),
        (x, y),
        (along_x, across),
        (across, along_y),
        (x * r2, y * r2),
        (along_x * r2, outer),
        (outer, along_y * r2),
    ]


def prior_information(rig: CameraRig) -> FloatArray:
    """Information (p, p) of a calibration taken to leave EXPECTED_PX over the image.

    As if a grid of displacements in every image had been measured as zero, with a noise for which
    the displacements predicted by the terms of images have this standard deviation in the mean.
    """
    unit = displacements(rig, _grid(rig))
    out = np.eye(unit.shape[2]) / BASELINE_SIGMA**2
    for k in range(rig.cameras):  # the reference camera's own are those of all
        own = len(TERMS) * (k - 1) + np.arange(len(IMAGE_TERMS))
        at = own if k else len(out) - 1 - np.arange(len(COMMON))
        out[np.ix_(at, at)] = _stated(unit[:, 2 * k : 2 * k + 2][..., at], EXPECTED_PX)
    return out


def _stated(unit: FloatArray, expected_px: float) -> FloatArray:
    """Information (n, n) of terms that displace an image's grid (k, 2, n) by so much, in the mean.

    ``expected_px`` is the root mean square of one coordinate.
    """
    jacobian = unit.reshape(-1, unit.shape[2])
    scale = unit.shape[2] / (len(jacobian) * expected_px**2)
    return np.asarray(scale * (jacobian.T @ jacobian))


# What else windows of a drive show, and is not corrected: nuisances

FIELD_PX = 0.1
"""Displacement of one coordinate in each image that a lens model leaves, before a drive shows it:
0.06 px on EuRoC's rectified images and KITTI's, 0.12 on EuRoC's raw ones."""

_ALIKE = [SHARED.index(n) for n in SHARED if n not in (*COMMON, "baseline")]


def nuisance_displacements(rig: CameraRig, pixels: FloatArray) -> FloatArray:
    """Displacements (k, 2 * cameras, q) of pixels (k, cameras, 2) by a unit of each nuisance.

    The terms that all cameras share, but those in COMMON; then the modes of a field, pixels.
    """
    shared = shared_displacements(rig, pixels)[..., _ALIKE]
    return np.concatenate([shared, field_displacements(rig, pixels)], axis=2)


def nuisance_information(rig: CameraRig, field_px: float = FIELD_PX) -> FloatArray:
    """Information (q, q) about the nuisances before a drive."""
    from scipy.linalg import block_diag  # light modules do not load SciPy

    shared = _stated(shared_displacements(rig, _grid(rig))[:, :2][..., _ALIKE], EXPECTED_PX)
    return np.asarray(block_diag(shared, np.eye(field_modes(rig)) / field_px**2))


def shared_displacements(rig: CameraRig, pixels: FloatArray) -> FloatArray:
    """Displacements (k, 2 * cameras, 7) of pixels by a unit of each term of SHARED, pixels.

    Arguments as for :func:`displacements`. A longer baseline is one with larger disparities.
    """
    terms = _terms(*_rays(rig, pixels.reshape(-1, 2)))
    of_lens = np.zeros((2, len(SHARED), rig.cameras * len(pixels)))
    _scale(of_lens, rig, [terms[IMAGE_TERMS.index(name)] for name in SHARED[:-1]])
    out = np.ascontiguousarray(of_lens.transpose(2, 0, 1))
    out = out.reshape(len(pixels), 2 * rig.cameras, len(SHARED))
    out[:, 2, -1] = pixels[:, 1, 0] - pixels[:, 0, 0]
    if rig.cameras == 3:
        out[:, 5, -1] = pixels[:, 2, 1] - pixels[:, 0, 1]
    return out


def shared_information(rig: CameraRig, expected_px: float) -> FloatArray:
    """Information (7, 7) about SHARED of images that are off by ``expected_px``, rms over them.

    The baseline is known as well as the focal length, relative: both come from the size of a board.
    """
    out = np.zeros((len(SHARED), len(SHARED)))
    out[:-1, :-1] = _stated(
        shared_displacements(rig, _grid(rig))[:, :2, :-1], expected_px / np.sqrt(2.0)
    )
    focal = SHARED.index("focal")
    out[-1, -1] = 1.0 / np.linalg.inv(out[:-1, :-1])[focal, focal]
    return out


def _grid(rig: CameraRig) -> FloatArray:
    """(k, cameras, 2) pixels spread over the image, the same in all cameras."""
    column, row = np.meshgrid(*(np.linspace(0, n - 1, _GRID) for n in (rig.width, rig.height)))
    grid = np.stack([column.ravel(), row.ravel()], axis=1)
    return np.repeat(grid[:, None], rig.cameras, axis=1)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class RigCorrection(Brief):
    """Corrections of a rig against its calibration, with their uncertainty.

    Attributes:
        rig: as calibrated.
        values: (p,) in the order of :func:`term_names`; zero for an exact calibration.
        covariance: (p, p) of the above.
        field_px: what no term follows: standard deviation of one coordinate in each image
            (:mod:`fgslam.core.correction`), pixels.
    """

    rig: CameraRig
    values: Kept[FloatArray]
    covariance: Kept[FloatArray]
    field_px: float = 0.0

    @staticmethod
    def none(rig: CameraRig) -> RigCorrection:
        """The calibration as stated, with the prior's covariance."""
        information = prior_information(rig)
        covariance = np.asarray(np.linalg.inv(information), np.float64)
        return RigCorrection(rig, np.zeros(len(information)), covariance)

    def at(self, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Displacements (k, 2 * cameras) that are taken off pixels, and sigmas of each."""
        unit = displacements(self.rig, pixels[:, : self.rig.cameras])
        variance = np.einsum("kap,pq,kaq->ka", unit, self.covariance, unit)
        return unit @ self.values, np.sqrt(variance)

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviations (p,) of the values."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance)))

    def rms_px(self) -> float:
        """Displacement of the other cameras against the right one, rms over the image, pixels."""
        own = slice(-len(COMMON))
        moved = displacements(self.rig, _grid(self.rig))[..., own] @ self.values[own]
        pixels = moved.reshape(-1, self.rig.cameras, 2)[:, 1:]
        return float(np.sqrt((pixels**2).sum(axis=2).mean()))

    def changes(self) -> dict[str, tuple[float, float]]:
        """The turn and zoom of each other camera that fits its displacements best, with sigmas.

        The terms of a camera nearly cancel each other (its yaw and its principal point, say); over
        the image as a whole they amount to these. Positive where the camera is turned to the left
        (yaw), upwards (pitch) or counter-clockwise as seen from behind it (roll), so that its image
        moves right, down or clockwise; and where its focal length is longer.
        """
        unit = displacements(self.rig, _grid(self.rig))
        which = [TERMS.index(name) for name in ("yaw", "pitch", "roll", "focal")]
        out: dict[str, tuple[float, float]] = {}
        for k, camera in enumerate(_CAMERAS[: self.rig.cameras - 1]):
            at = slice(len(TERMS) * k, len(TERMS) * (k + 1))
            own = unit[:, 2 * k + 2 : 2 * k + 4, at].reshape(-1, len(TERMS))
            fit = np.linalg.pinv(own[:, which]) @ own
            values = fit @ self.values[at] * _CHANGE_UNITS
            variances = np.diagonal(fit @ self.covariance[at, at] @ fit.T)
            sigmas = np.sqrt(variances) * _CHANGE_UNITS
            pairs = zip(_CHANGES, values.tolist(), sigmas.tolist(), strict=True)
            out |= {f"{camera}_{name}": (value, sigma) for name, value, sigma in pairs}
        return out

    def significance(self) -> float:
        """Chi-square, of ``len(values)`` degrees of freedom, that the calibration is exact."""
        return float(self.values @ np.linalg.solve(self.covariance, self.values))

    def straightened(self, features: tuple[Features, ...]) -> tuple[Features, ...]:
        """Features of right, left[, top] where an exact rig had found them.

        But for the baselines' directions: for these :meth:`by_direction`, when they are matched.
        """
        if not self.values.any():
            return features
        moved = [
            camera_displacements(self.rig, camera, found.xy) @ self.values
            for camera, found in enumerate(features)
        ]
        pairs = zip(features, moved, strict=True)
        return tuple(dataclasses.replace(found, xy=found.xy - off) for found, off in pairs)

    def by_direction(self, camera: int, reference: FloatArray, own: FloatArray) -> FloatArray:
        """Displacements (k, 2) of a camera's pixels (k, 2) whose partners are ``reference``."""
        if not camera:
            return np.zeros_like(own)
        last = len(TERMS) * camera
        unit = _by_direction(self.rig, camera, reference, own)
        values = self.values[last - len(BASELINE_TERMS) : last]
        return np.asarray(np.einsum("ank,n->ka", unit, values))


_LENGTH = 0.25  # of the image's width: deviation of the Gaussian kernel by which places are alike
_ACROSS = 13  # nodes along the longer side: three within a length
_HELD = 0.95  # share of the variance that the modes kept have


class _Modes(NamedTuple):
    """A field whose coordinates have variance one before the terms are taken out.

    Attributes:
        across, down: columns and rows of the nodes.
        values: (nodes, 2, modes) displacements, row by row of the grid.
    """

    across: FloatArray
    down: FloatArray
    values: FloatArray


def field_modes(rig: CameraRig) -> int:
    """Number of modes of all images."""
    return int(rig.cameras * _modes(rig).values.shape[2])


def field_displacements(rig: CameraRig, pixels: FloatArray) -> FloatArray:
    """Displacements (k, 2 * cameras, modes) of pixels (k, cameras, 2) by a unit of each mode.

    Independent units, each of variance one, are a field of one pixel a coordinate (root mean
    square), less what the terms follow. Images have fields of their own.
    """
    out = np.zeros((len(pixels), 2 * rig.cameras, field_modes(rig)))
    modes = _modes(rig)
    count = modes.values.shape[2]
    for camera in range(rig.cameras):
        rows = slice(2 * camera, 2 * camera + 2)
        out[:, rows, camera * count : (camera + 1) * count] = _between(modes, pixels[:, camera])
    return out


def _between(modes: _Modes, pixels: FloatArray) -> FloatArray:
    """(k, 2, modes) at pixels (k, 2), bilinear between nodes; outside as at the border."""
    column, right = _steps(modes.across, pixels[:, 0])
    row, low = _steps(modes.down, pixels[:, 1])
    out = np.zeros((len(pixels), *modes.values.shape[1:]))
    for below, share_row in ((0, 1.0 - low), (1, low)):
        for next_column, share_column in ((0, 1.0 - right), (1, right)):
            node = (row + below) * len(modes.across) + column + next_column
            out += (share_row * share_column)[:, None, None] * modes.values[node]
    return out


def _steps(nodes: FloatArray, where: FloatArray) -> tuple[IntArray, FloatArray]:
    """Nodes (k,) before places (k,), and the share of the way to the next."""
    steps = np.clip((where - nodes[0]) / (nodes[1] - nodes[0]), 0.0, len(nodes) - 1.0)
    first = np.minimum(steps.astype(np.int64), len(nodes) - 2)
    return first, steps - first


@lru_cache(maxsize=8)
def _modes(rig: CameraRig) -> _Modes:
    across, down = (_nodes(rig, size) for size in (rig.width, rig.height))
    places = np.stack([axis.ravel() for axis in np.meshgrid(across, down)], axis=1)
    apart = ((places[:, None] - places) ** 2).sum(axis=2)
    alike = np.kron(np.exp(-0.5 * apart / (_LENGTH * rig.width) ** 2), np.eye(2))
    unit = camera_displacements(rig, 1, places)[..., : len(IMAGE_TERMS)]
    terms = np.linalg.qr(unit.reshape(len(alike), -1))[0]
    rest = np.eye(len(alike)) - terms @ terms.T
    variances, axes = np.linalg.eigh(rest @ alike @ rest)
    shares = np.cumsum(variances[::-1]) / variances.sum()
    kept = slice(-1 - int(np.searchsorted(shares, _HELD)), None)
    values = axes[:, kept] * np.sqrt(variances[kept])
    return _Modes(across, down, values.reshape(len(places), 2, -1))


def _nodes(rig: CameraRig, size: int) -> FloatArray:
    """Along an axis of the image, about as far apart along both."""
    share = (size - 1) / (max(rig.width, rig.height) - 1)
    return np.linspace(0.0, size - 1.0, max(2, 1 + round((_ACROSS - 1) * share)))
