"""Tracked points held to what they looked like when their tracking began.

Tracking from image to image adds up errors: under perspective a window is scaled and sheared, and
what moves it is where its contrast happens to lie, not its centre. On the rendered house that is
three to five percent of the way a point has moved. So every point keeps the patch it began with,
and each track ends with one step that aligns this patch under an affine map (Shi and Tomasi 1994),
gain and offset of the light taken out. The step is the inverse compositional one (Baker and
Matthews 2004): all derivatives are those of the first patch and computed once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TypeAlias

import numpy as np

from fgslam.core.arrays import Float32, FloatArray, Image, Rows
from fgslam.frontend.features.alignment import align_patches
from fgslam.frontend.features.anchoring import FLAT, TERMS, add_up, cut_patches, offsets
from fgslam.frontend.features.matching import pairs_within
from fgslam.frontend.features.sift import PER_PIXEL, FineImage

View: TypeAlias = Image | FineImage
"""What patches are sampled in: grey values (h, w), between them on straight lines; or finely."""

_SPREAD = 4.3  # sides of the patch over the sigma of its Gaussian weight
_FARTHEST_REACH = 6.1  # beyond, a correlation is less than the rounding of one


@dataclass(frozen=True, slots=True, eq=False)
class ReferencePatches(Rows):
    """Patches of n points, as they looked when tracking began.

    Attributes:
        size: side, pixels; odd.
        cut: (n, (size + 2)^2) their grey values, with a rim of a pixel.
        gram: (n, 8, 8) of :mod:`fgslam.frontend.features.anchoring`.
        inverse: (n, 8, 8) of that with its prior.
        maps: (n, 2, 2) from the first patch to the present one.
    """

    SHARED = frozenset({"size"})

    size: int
    cut: Float32
    gram: FloatArray
    inverse: FloatArray
    maps: FloatArray

    @staticmethod
    def none(size: int) -> ReferencePatches:
        """Of no point."""
        sums = np.empty((0, TERMS, TERMS))
        cut = np.empty((0, (size + 2) ** 2), np.float32)
        return ReferencePatches(size, cut, sums, sums, np.empty((0, 2, 2)))

    def deformation(self) -> FloatArray:
        """(n,) Frobenius norm of how far each map is from none."""
        change = self.maps - np.eye(2)
        return np.asarray(np.sqrt(np.einsum("nij,nij->n", change, change)))


def cut_out(view: View, places: FloatArray, size: int) -> Float32:
    """(n, (size + 2)^2) grey values of a view around places (n, 2): column, row.

    What :func:`anchor_at` makes patches of; the rim is for their slopes.
    """
    cut = np.empty((len(places), (size + 2) ** 2), np.float32)
    cut_patches(*_values(view), places, np.eye(2), size + 2, cut)
    return cut


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
    prior = np.repeat([FLAT, (noise / deformation) ** 2], [4, 4])
    gram, inverse = np.empty((2, len(cut), TERMS, TERMS))
    add_up(cut, size, _weight(size), prior, gram, inverse, np.empty((size**2, TERMS)))
    maps = np.tile(np.eye(2), (len(cut), 1, 1))
    return ReferencePatches(size, cut, gram, inverse, maps)


def align(
    patches: ReferencePatches, view: View, places: FloatArray, times: int = 1
) -> tuple[ReferencePatches, FloatArray, FloatArray]:
    """Moves places so that the patches fit the view.

    Args:
        patches: of the points.
        view: the present one.
        places: (n, 2) where the points are thought to be, within a few pixels.
        times: steps.

    Returns:
        The patches with their maps brought up to date, the places (n, 2), and the correlation (n,)
        of each patch with what was found *before* the last move; -1 for what cannot be the same
        thing.
    """
    maps, places, correlation = patches.maps.copy(), places.copy(), np.empty(len(places))
    room = np.empty((patches.size**2 + 2, TERMS))
    align_patches(
        *_values(view), patches.cut, _weight(patches.size), patches.gram, patches.inverse, times,
        maps, places, correlation, room, np.empty(patches.size**2),
    )  # fmt: skip
    return replace(patches, maps=maps), places, correlation


def _values(view: View) -> tuple[Float32, int]:
    """Grey values, and how many of them lie along a pixel."""
    if isinstance(view, FineImage):
        return view.grey, PER_PIXEL
    return view.astype(np.float32), 1


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


@lru_cache(maxsize=8)
def _weight(size: int) -> FloatArray:
    """(m,) Gaussian weight of a patch's pixels."""
    x, y = offsets(size)
    return np.exp(-0.5 * (x**2 + y**2) * (_SPREAD / size) ** 2)
