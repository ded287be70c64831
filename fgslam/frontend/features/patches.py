"""Tracked points held to what they looked like when their tracking began.

Tracking from image to image adds up errors: under perspective a window is scaled and sheared, and
what moves it is where its contrast happens to lie, not its centre. On the rendered house that is
three to five percent of the way a point has moved. So every point keeps the patch it began with,
and each track ends with one step that aligns this patch under an affine map (Shi and Tomasi 1994),
gain and offset of the light taken out. The step is the inverse compositional one (Baker and
Matthews 2004): all derivatives are those of the first patch and computed once.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import cv2
import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, Image, IntArray, Rows
from fgslam.frontend.features.matching import pairs_within
from fgslam.frontend.features.sift import PER_PIXEL, FineImage, Float32

View: TypeAlias = Image | FineImage
"""What patches are sampled in: grey values (h, w), between them on straight lines; or finely."""

_SPREAD = 4.3  # sides of the patch over the sigma of its Gaussian weight
_FLAT = 1e-3  # keeps patches without any contrast solvable
_GAIN = (0.2, 5.0)  # of light against the first patch; beyond, it is another thing
_FARTHEST_REACH = 6.1  # beyond, a correlation is less than the rounding of one
_FARTHEST_PX = 4.0  # of one alignment; the tracker was closer than this, or elsewhere


@dataclass(frozen=True, slots=True, eq=False)
class ReferencePatches(Rows):
    """Patches of n points, m pixels each.

    Attributes:
        size: side, pixels; odd.
        first: (n, m) grey values when tracking began.
        light: (n, 2, m) projects grey values on offset and gain against the first patch.
        step: (n, 6, m) projects what remains on a move (2) and a deformation (2 x 2).
        contrast: (n,) weighted standard deviation of the first patch, grey values.
        maps: (n, 2, 2) from the first patch to the present one.
    """

    SHARED = frozenset({"size"})

    size: int
    first: Float32
    light: Float32
    step: Float32
    contrast: FloatArray
    maps: FloatArray

    @staticmethod
    def none(size: int) -> ReferencePatches:
        """Of no point."""
        pixels = size * size
        return ReferencePatches(
            size,
            np.empty((0, pixels), np.float32),
            np.empty((0, 2, pixels), np.float32),
            np.empty((0, 6, pixels), np.float32),
            np.empty(0),
            np.empty((0, 2, 2)),
        )

    def select(self, keep: BoolArray | IntArray) -> ReferencePatches:
        """The chosen patches; none are copied where all are wanted."""
        if keep.dtype == np.bool_ and keep.all():
            return self
        return Rows.select(self, keep)

    def deformation(self) -> FloatArray:
        """(n,) Frobenius norm of how far each map is from none."""
        change = self.maps - np.eye(2)
        return np.asarray(np.sqrt(np.einsum("nij,nij->n", change, change)))


def cut_out(view: View, places: FloatArray, size: int) -> Float32:
    """(n, (size + 2)^2) grey values of a view around places (n, 2): column, row.

    What :func:`anchor_at` makes patches of; the rim is for their slopes.
    """
    return _sampled(view, places, _undeformed(len(places)), size + 2)


def anchor(
    view: View, places: FloatArray, size: int, noise: float, deformation: float
) -> ReferencePatches:
    """Patches around places (n, 2), column and row, of a view; else :func:`anchor_at`."""
    return anchor_at(cut_out(view, places, size), size, noise, deformation)


def anchor_at(cut: Float32, size: int, noise: float, deformation: float) -> ReferencePatches:
    """Patches of what was cut out of a view.

    Args:
        cut: (n, (size + 2)^2) by :func:`cut_out`.
        size: side of a patch, pixels; odd.
        noise: sigma of a grey value, including what no affine map explains.
        deformation: sigma of each entry of the map from one image to the next; it keeps patches
            with little contrast from being deformed arbitrarily.
    """
    first, across, down = _with_slopes(cut, size)
    x, y = _offsets(size)
    slopes = np.stack([across, down, across * x, across * y, down * x, down * y], axis=1)
    weight = _weight(size)
    light, slopes_only = _without_light(first, slopes, weight)
    prior = np.diag([_FLAT, _FLAT] + 4 * [(noise / deformation) ** 2])
    weighted = slopes_only * weight
    curvature = (weighted @ slopes_only.transpose(0, 2, 1)).astype(np.float64) + prior
    step = np.linalg.inv(curvature).astype(np.float32) @ weighted
    spread = _spread(first - _mean(first, weight).astype(np.float32)[:, None], weight)
    return ReferencePatches(size, first, light, step, spread, _undeformed(len(cut)))


def align(
    patches: ReferencePatches, view: View, places: FloatArray
) -> tuple[ReferencePatches, FloatArray, FloatArray]:
    """Moves places so that the patches fit the view.

    Args:
        patches: of the points.
        view: the present one.
        places: (n, 2) where the points are thought to be, within a few pixels.

    Returns:
        The patches with their maps brought up to date, the places (n, 2), and the correlation (n,)
        of each patch with what was found *before* the move; -1 for what cannot be the same thing.
    """
    if not len(patches):
        return patches, places, np.empty(0)
    seen = _sampled(view, places, patches.maps, patches.size)
    level = (patches.light @ seen[:, :, None])[:, :, 0]
    gain = np.clip(level[:, 1:], *_GAIN)
    rest = (seen - level[:, :1]) / gain - patches.first
    change = (patches.step @ rest[:, :, None])[:, :, 0].astype(np.float64)
    maps = patches.maps @ _inverse(np.eye(2) + change[:, 2:].reshape(-1, 2, 2))
    move = -(maps @ change[:, :2, None])[:, :, 0]
    unlike = _spread(rest, _weight(patches.size)) / np.maximum(patches.contrast, _FLAT)
    correlation = 1.0 / np.hypot(1.0, unlike)
    good = (level[:, 1] > _GAIN[0]) & (level[:, 1] < _GAIN[1])
    good &= np.hypot(move[:, 0], move[:, 1]) < _FARTHEST_PX
    fitted = ReferencePatches(
        patches.size,
        patches.first,
        patches.light,
        patches.step,
        patches.contrast,
        np.where(good[:, None, None], maps, patches.maps),
    )
    moved = np.where(good[:, None], places + move, places)
    return fitted, moved, np.where(good, correlation, -1.0)


def crowding(places: FloatArray, size: int) -> FloatArray:
    """Factors (n,) of variance of patches at places (n, 2) that overlap: their errors are alike.

    Errors of two patches by the same pixels' noise correlate by the overlap of their weights,
    exp(-d^2 / 4 s^2) at a distance d. A sum over n measurements that all correlate by r has
    1 + (n - 1) r times the variance of independent ones; each is given its share of that, so that
    all together tell no more than the image does.
    """
    if not len(places):
        return np.empty(0)
    reach = 2.0 * size / _SPREAD
    i, j = pairs_within(places[:, 0], _FARTHEST_REACH * reach, places[:, 0])
    alike = np.exp(-((places[i] - places[j]) ** 2).sum(axis=1) / reach**2)
    return np.asarray(np.bincount(i, alike, len(places)), np.float64)


def _inverse(maps: FloatArray) -> FloatArray:
    """(n, 2, 2) inverses of matrices (n, 2, 2), whatever they are: not finite where there is none.

    A patch may be crushed to nothing by one step; it is lost then, no error.
    """
    (a, b), (c, d) = maps[:, 0].T, maps[:, 1].T
    out = np.empty_like(maps)
    out[:, 0, 0], out[:, 0, 1], out[:, 1, 0], out[:, 1, 1] = d, -b, -c, a
    with np.errstate(divide="ignore", invalid="ignore"):
        out /= (a * d - b * c)[:, None, None]
    return out


def _undeformed(count: int) -> FloatArray:
    """(n, 2, 2) identities."""
    return np.broadcast_to(np.eye(2), (count, 2, 2)).copy()


def _with_slopes(cut: Float32, size: int) -> tuple[Float32, Float32, Float32]:
    """Grey values (n, m) of patches, and their derivatives along columns and rows."""
    wide = cut.reshape(len(cut), size + 2, size + 2)
    middle = slice(1, -1)
    across = 0.5 * (wide[:, middle, 2:] - wide[:, middle, :-2])
    down = 0.5 * (wide[:, 2:, middle] - wide[:, :-2, middle])
    parts = (wide[:, middle, middle], across, down)
    first, across, down = (
        np.ascontiguousarray(one).reshape(len(wide), size * size) for one in parts
    )
    return first, across, down


def _without_light(first: Float32, slopes: Float32, weight: Float32) -> tuple[Float32, Float32]:
    """The projection on offset and gain (n, 2, m), and the slopes (n, 6, m) without these two.

    Products of pixels are about the patch's mean, where single precision does.
    """
    mean = first @ weight / weight.sum()
    centred = first - mean[:, None]
    total, level = float(weight.sum()), mean.astype(np.float64)
    square = (centred * centred) @ weight + total * level**2
    normal = np.array([[np.full_like(level, total), total * level], [total * level, square]])
    inverse = np.linalg.inv(normal.transpose(2, 0, 1) + _FLAT * np.eye(2))
    at_mean = (inverse[:, :, 0] + inverse[:, :, 1] * level[:, None]).astype(np.float32)
    slope = inverse[:, :, 1].astype(np.float32)
    light = weight * (at_mean[:, :, None] + slope[:, :, None] * centred[:, None])
    shares = slopes @ light.transpose(0, 2, 1)
    offset = shares[:, :, :1] + shares[:, :, 1:] * mean[:, None, None]
    rest = slopes - offset
    rest -= shares[:, :, 1:] * centred[:, None]
    return light, rest


@lru_cache(maxsize=8)
def _offsets(size: int) -> tuple[Float32, Float32]:
    """(m,) columns and rows of a patch's pixels from its centre."""
    reach = np.arange(size, dtype=np.float32) - (size - 1) / 2.0
    x, y = np.meshgrid(reach, reach)
    return x.ravel().astype(np.float32), y.ravel().astype(np.float32)


@lru_cache(maxsize=8)
def _weight(size: int) -> Float32:
    """(m,) Gaussian weight of a patch's pixels; sums to m."""
    x, y = _offsets(size)
    weight = np.exp(-0.5 * (x**2 + y**2) * (_SPREAD / size) ** 2)
    return np.asarray(weight, dtype=np.float32)


def _sampled(view: View, places: FloatArray, maps: FloatArray, size: int) -> Float32:
    """(n, m) grey values of patches around places (n, 2), deformed by maps (n, 2, 2)."""
    if not len(places):
        return np.empty((0, size * size), np.float32)  # OpenCV refuses empty maps
    x, y = _offsets(size)
    at, turned = places.astype(np.float32), maps.astype(np.float32)
    columns = at[:, :1] + turned[:, 0, :1] * x + turned[:, 0, 1:] * y
    rows = at[:, 1:] + turned[:, 1, :1] * x + turned[:, 1, 1:] * y
    grey, scale = (view.grey, PER_PIXEL) if isinstance(view, FineImage) else (view, 1)
    seen = cv2.remap(
        grey, scale * columns, scale * rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(seen, dtype=np.float32)


def _mean(values: Float32, weight: Float32) -> FloatArray:
    """(n,) weighted means of (n, m)."""
    return np.asarray(values @ weight / weight.sum(), dtype=np.float64)


def _spread(values: Float32 | FloatArray, weight: Float32) -> FloatArray:
    """(n,) weighted root mean square of (n, m)."""
    return np.asarray(np.sqrt((values * values) @ weight / weight.sum()), dtype=np.float64)
