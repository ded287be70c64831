"""Topological map: images as nodes, homings that succeed as edges (I)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra

from fgslam.cameras.omni import OmniCamera
from fgslam.core.array_files import ArrayFile, Items, of_rows, rows_of
from fgslam.core.array_values import require_covariances
from fgslam.core.arrays import FloatArray, IntArray, StateArrays
from fgslam.core.errors import StoredMapError
from fgslam.core.homing import OmniFeatures
from fgslam.homing.feature_files import VERSIONS
from fgslam.homing.link_consistency import (
    UNORDERED,
    InlierRows,
    LinkConsistency,
    ThirdViewConsistency,
    Walks,
)
from fgslam.homing.links import Answer, Link, Pair, link_pairs
from fgslam.homing.path_memory import PathMemory, load_images, save_images
from fgslam.homing.retrieval import VisualWords, candidate_pairs
from fgslam.homing.settings import TopologicalMapSettings

FILE = ArrayFile(
    name="fgslam topological map",
    versions=VERSIONS,
    error=StoredMapError,
    give="give a file that holds one, as fgslam join writes it",
    again="build it again",
)
_PER_LINK: Items = {
    "link_support": ("i", ()),
    "link_ends": ("i", (2,)),
    "link_angles": ("f", (3,)),
    "link_covariances": ("f", (2, 2, 2)),
    "link_cost": ("f", ()),
}
_DOUBLING_SUPPORT = 25.0  # inliers at which an edge costs twice what many inliers cost
_SIGMA_OF_ONE = np.deg2rad(5.0)  # direction's deviation that costs as much as a leg by itself


@dataclass(frozen=True, slots=True, eq=False)
class TopologicalMap:
    """Nodes and edges.

    Attributes:
        images: features of the nodes.
        names: of the nodes, for people.
        links: accepted, ascending by their pair (a < b).
        costs: (m,) of the links: 1 for a leg of many inliers and a sure direction, more otherwise.
        rejected: pairs that were answered, but not accepted, and why; not saved.
        camera: that took the images; None where it is not known.
    """

    images: tuple[OmniFeatures, ...]
    names: tuple[str, ...]
    links: tuple[Link, ...]
    costs: FloatArray
    rejected: Mapping[Pair, str]
    camera: OmniCamera | None = None

    def __len__(self) -> int:
        return len(self.images)

    def graph(self) -> csr_matrix:
        """(n, n) symmetric matrix of costs."""
        return _graph(len(self), self.links, self.costs)

    def components(self) -> tuple[IntArray, ...]:
        """Node numbers of the connected parts, the largest first."""
        _, label = connected_components(self.graph(), directed=False)
        parts = [np.flatnonzero(label == k) for k in range(int(label.max(initial=-1)) + 1)]
        return tuple(sorted(parts, key=lambda part: (-len(part), int(part[0]))))

    def neighbours(self, node: int) -> IntArray:
        """Nodes that are linked with one, ascending."""
        ends = [link.b if link.a == node else link.a for link in self.links]
        mine = [node in (link.a, link.b) for link in self.links]
        return np.sort(np.array(ends, dtype=np.int64)[np.array(mine, dtype=np.bool_)])

    def route(self, start: int, goal: int) -> tuple[int, ...]:
        """The cheapest way's nodes, both ends included.

        Raises:
            StoredMapError: there is no such node, or no way.
        """
        for node in (start, goal):
            if not 0 <= node < len(self):
                raise StoredMapError(
                    f"map: no node {node}; its {len(self)} nodes are numbered from 0"
                )
        cost, before = dijkstra(self.graph(), False, start, return_predecessors=True)
        if not np.isfinite(cost[goal]):
            raise StoredMapError(
                f"map: no way from {self.names[start]} to {self.names[goal]}; they lie in "
                "different parts of the map, take more images in between"
            )
        way = [goal]
        while way[-1] != start:
            way.append(int(before[way[-1]]))
        return tuple(reversed(way))

    def path(self, nodes: Sequence[int]) -> PathMemory:
        """The target images of a route, ready to be followed."""
        images, names = [self.images[k] for k in nodes], [self.names[k] for k in nodes]
        return PathMemory.of(images, names, self.camera)

    @property
    def memory(self) -> PathMemory:
        """The nodes' images alone."""
        return PathMemory(self.images, self.names, self.camera)

    def save(self, path: str | Path) -> float:
        """Writes the map atomically.

        Returns:
            Kilobytes (of 1000 bytes) an image.

        Raises:
            OutputError: it cannot be written.
        """
        links = _link_arrays(self.links, self.costs)
        return save_images(FILE, path, self.memory, links)

    @staticmethod
    def load(path: str | Path) -> TopologicalMap:
        """Reads a map; pixel positions of features are NaN, and nothing is known as rejected.

        Raises:
            StoredMapError: the file is missing, truncated, damaged, foreign or of another version.
        """
        memory, arrays = load_images(FILE, path)
        if len(set(memory.names)) < len(memory):
            raise StoredMapError(f"{path}: two places have one name; {FILE.again}")
        links, costs = _read_links(arrays, len(memory), str(path))
        return TopologicalMap(memory.images, memory.names, links, costs, {}, memory.camera)


# --------------------------------------------------------------------------------------------
# Building


def map_candidates(
    images: Sequence[OmniFeatures],
    settings: TopologicalMapSettings,
    rng: np.random.Generator,
    walks: Walks = UNORDERED,
) -> list[Pair]:
    """Pairs a < b that are worth a homing; neighbours on a walk always."""
    n = len(images)
    if settings.candidates == 0 or settings.candidates >= n - 1:
        likenesses = np.zeros((n, n))
    else:
        likenesses = VisualWords(images, rng).likenesses()
    pairs = {(int(a), int(b)) for a, b in candidate_pairs(likenesses, settings.candidates)}
    return sorted(pairs | walks.steps())


def map_of_answers(
    images: Sequence[OmniFeatures],
    answers: Mapping[Pair, Answer],
    *,
    walks: Walks = UNORDERED,
    names: Sequence[str] | None = None,
    rows: InlierRows | None = None,
) -> TopologicalMap:
    """The map of homings that were searched elsewhere, in processes say.

    Args:
        images: features of the nodes.
        answers: of pairs (from, to), both ways; pairs with one way only are passed over.
        walks: images that follow each other on a way.
        names: of the images; numbered if absent.
        rows: inliers of the answers; with them, links of walks far apart need third views.
    """
    memory = PathMemory.of(images, names)
    links, refused = link_pairs(answers)
    seen: set[Pair] = set()
    if walks.lengths and rows is not None:
        links, seen, unseen = ThirdViewConsistency(images, links, rows, walks).confirmed()
        refused |= unseen
    accepted, rejected = LinkConsistency(len(images), links, walks).accepted(seen)
    costs = np.array([link_cost(link) for link in accepted])
    return TopologicalMap(memory.images, memory.names, tuple(accepted), costs, refused | rejected)


def link_cost(link: Link) -> float:
    """One for a leg, more where few inliers or an unsure direction make it risky.

    So a route prefers a few safe legs to many, and two safe ones to one that is not.
    """
    variance = np.nan_to_num(max(link.covariance[0, 0], link.back_covariance[0, 0]))
    weak = _DOUBLING_SUPPORT / max(link.support, 1)
    return float(1.0 + weak + variance / _SIGMA_OF_ONE**2)


def _graph(count: int, links: Sequence[Link], costs: FloatArray) -> csr_matrix:
    ends = np.array([(link.a, link.b) for link in links], dtype=np.int64).reshape(-1, 2)
    both = np.vstack([ends, ends[:, ::-1]])
    weights = np.concatenate([costs, costs])
    return coo_matrix((weights, (both[:, 0], both[:, 1])), shape=(count, count)).tocsr()


# --------------------------------------------------------------------------------------------
# Links in files


def _link_arrays(links: Sequence[Link], costs: FloatArray) -> StateArrays:
    m = len(links)
    angles = [(link.direction, link.rotation, link.back) for link in links]
    covariances = [(link.covariance, link.back_covariance) for link in links]
    return {
        "link_ends": np.array([(k.a, k.b) for k in links], dtype=np.int64).reshape(m, 2),
        "link_angles": np.array(angles, dtype=np.float64).reshape(m, 3),
        "link_covariances": np.array(covariances, dtype=np.float64).reshape(m, 2, 2, 2),
        "link_support": np.array([k.support for k in links], dtype=np.int64),
        "link_cost": np.asarray(costs, dtype=np.float64).reshape(m),
    }


def _read_links(
    arrays: Mapping[str, Any], count: int, where: str
) -> tuple[tuple[Link, ...], FloatArray]:
    FILE.require(arrays, of_rows(rows_of(arrays, "link_support"), _PER_LINK), where)
    support, ends, angles, covariances, costs = (arrays[name] for name in _PER_LINK)
    _require_links(arrays, count, where)
    links = tuple(
        Link(
            a=int(ends[k, 0]),
            b=int(ends[k, 1]),
            direction=float(angles[k, 0]),
            rotation=float(angles[k, 1]),
            back=float(angles[k, 2]),
            covariance=covariances[k, 0],
            back_covariance=covariances[k, 1],
            support=int(support[k]),
        )
        for k in range(len(support))
    )
    return links, np.array(costs)


def _require_links(arrays: Mapping[str, Any], count: int, where: str) -> None:
    """Raises StoredMapError for links that no map has, of arrays of the right shapes.

    A driven step without a homing vector has no inliers and knows no angle; images of one place
    have a rotation alone.
    """
    support, ends, angles, covariances, costs = (arrays[name] for name in _PER_LINK)
    step, turn = support == 0, np.isnan(angles[:, [0, 2]]).all(axis=1)
    known = np.isfinite(angles)
    wrong = {
        "link_support": support < 0,
        "link_ends": (ends < 0).any(axis=1)
        | (ends >= count).any(axis=1)
        | (ends[:, 0] >= ends[:, 1]),
        "link_cost": ~((costs > 0.0) & np.isfinite(costs)),
        "link_angles": ~(known.all(axis=1) | (turn & (known[:, 1] | step))),
    }
    for name, rows in wrong.items():
        if rows.any():
            raise FILE.damaged(name, where)
    if len(np.unique(ends, axis=0)) < len(ends):
        raise FILE.damaged("link_ends", where)
    require_covariances(FILE, "link_covariances", covariances[~turn].reshape(-1, 2, 2), where)
