"""Confirmation of links by third views, against perceptual aliasing.

Halls with two equal sides, corridors with the same lockers: links between them have hundreds of
inliers, agree in triangles, and are false. They match things of one kind, not one thing: a baluster
with any baluster. So a feature of one image that is followed into another one, and from there into
a neighbour on the walk, seldom comes back as the same feature when the neighbour is matched
directly. Features of a true link do, in most neighbours (after the missing correspondences of Zach
et al. 2008 and the order of images in Roberts et al. 2011).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TypeAlias

import numpy as np

from fgslam.core.arrays import IntArray
from fgslam.core.homing import OmniFeatures
from fgslam.core.planar import wrap
from fgslam.homing.links import Link, Pair

InlierRows: TypeAlias = Mapping[Pair, IntArray]
"""Of pairs (from, to): (k, 2) rows of the SIFT features of both images that are inliers."""

_SAME = 0.02  # radians, in bearing and elevation: one thing has several features side by side

_ORDER_REACH = 3
"""Images farther apart than this in the order need third views, these neighbours of theirs, that
confirm their link's features."""

_THIRD_VIEWS = 1.0
"""Such confirmations an inlier, on average, that a link so far needs; `docs/concepts/homing.md` has
what true and false ones got."""


class ThirdViewConsistency:
    """Links of an ordered set, and the features that make them."""

    def __init__(
        self,
        images: Sequence[OmniFeatures],
        links: Iterable[Link],
        rows: InlierRows,
    ) -> None:
        """Takes links of images in the order of the walk, and the inliers of their answers."""
        self._images = images
        self._links = list(links)
        self._maps: dict[Pair, IntArray] = {}
        for link in self._links:
            for pair in ((link.a, link.b), (link.b, link.a)):
                self._maps[pair] = self._mapping(pair, rows)

    def confirmed(self) -> tuple[list[Link], set[Pair], dict[Pair, str]]:
        """Links that are believed so far, those of them that third views confirm, why others not.

        The walk itself vouches for links of a few steps.
        """
        kept: list[Link] = []
        seen: set[Pair] = set()
        rejected: dict[Pair, str] = {}
        for link in self._links:
            share = self.share(link)
            if share >= _THIRD_VIEWS:
                seen.add((link.a, link.b))
            elif not self._walked(link):
                rejected[link.a, link.b] = (
                    f"{share:.2f} confirmations an inlier by third views, of "
                    f"{_THIRD_VIEWS:g} needed so far apart"
                )
                continue
            kept.append(link)
        return kept, seen, rejected

    def _walked(self, link: Link) -> bool:
        """Whether the walk leads from one image to the other, in a few steps that are links.

        Where neighbours do not match, the walk may have gone on anywhere.
        """
        steps = ((k, k + 1) for k in range(link.a, link.b))
        near = link.b - link.a <= _ORDER_REACH
        return near and all(step in self._maps for step in steps)

    def share(self, link: Link) -> float:
        """Confirmations by third views, of either end's neighbours, over the link's inliers."""
        count = self._confirmations(link.a, link.b) + self._confirmations(link.b, link.a)
        return count / max(link.support, 1)

    def _confirmations(self, a: int, b: int) -> int:
        """How often a feature of a is the same one in a neighbour of b, directly and by b."""
        count = 0
        for c in range(max(0, b - _ORDER_REACH), min(len(self._images), b + _ORDER_REACH + 1)):
            if c in (a, b) or (b, c) not in self._maps or (a, c) not in self._maps:
                continue
            direct = self._maps[a, c]
            by_b = _followed(self._maps[a, b], self._maps[b, c])
            both = (direct >= 0) & (by_b >= 0)
            count += self._alike(c, direct[both], by_b[both])
        return count

    def _alike(self, image: int, one: IntArray, other: IntArray) -> int:
        sift = self._images[image].sift
        bearing = np.abs(wrap(sift.bearing[one] - sift.bearing[other]))
        elevation = np.abs(sift.elevation[one] - sift.elevation[other])
        return int(np.count_nonzero((bearing < _SAME) & (elevation < _SAME)))

    def _mapping(self, pair: Pair, rows: InlierRows) -> IntArray:
        """(n,) the second image's row of each feature of the first one, -1 where it has none."""
        out = np.full(len(self._images[pair[0]].sift), -1, dtype=np.int64)
        back, there = rows.get((pair[1], pair[0])), rows.get(pair)
        if back is not None:
            out[back[:, 1]] = back[:, 0]
        if there is not None:
            out[there[:, 0]] = there[:, 1]
        return out


def _followed(first: IntArray, second: IntArray) -> IntArray:
    """(n,) rows after two steps, -1 where one of them is missing."""
    return np.asarray(np.where(first >= 0, second[first], -1))
