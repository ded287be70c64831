"""Localisation in a topological map: a Bayes filter over its nodes (I).

Images are compared as nodes are: by how many of their features agree on one homing. The belief is
a distribution over nodes; between two images it stays, moves along an edge, or, rarely, leaps
anywhere, so that a robot that was carried off finds itself again.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Protocol, TypeAlias

import numpy as np
from scipy.sparse import csr_matrix, diags

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.homing import OmniFeatures, RefusalReason
from fgslam.homing.links import Answer
from fgslam.homing.retrieval import VisualWords
from fgslam.homing.settings import LocalisationSettings

Linker: TypeAlias = Callable[[OmniFeatures, int], Answer]
"""The homing vector from an image's place to that of a node, by its number."""

_BACKGROUND = 4.0  # inliers that a wrong place may get, on average

_AT_NODE = 100.0  # inliers, at least, of an image that was taken at the node itself

_STAY = 0.5  # chance to be still at the node of the last image

Weigher: TypeAlias = Callable[[Mapping[int, Answer]], Mapping[int, float]]
"""What speaks for each node, in inliers, of the answers of those that were matched."""


class Places(Protocol):
    """Images as nodes, a map's or a path's."""

    def __len__(self) -> int: ...

    def graph(self) -> csr_matrix:
        """(n, n) costs of going from one node to another."""
        ...


class Localiser:
    """Probability of each node to be where the robot is, or nearest to it.

    Attributes:
        belief: (n,) probabilities; uniform before the first image.
        likelihood: (n,) of the last image at each node, up to a factor.
        answers: homing vectors of the last image to those nodes that it was matched with.
        leap: chance to be anywhere at all by the next image; the settings' unless it is set.
    """

    def __init__(
        self,
        topology: Places,
        words: VisualWords,
        linker: Linker,
        settings: LocalisationSettings,
        weigh: Weigher | None = None,
        transition: FloatArray | None = None,
        power: float = 1.0,
    ) -> None:
        """Begins with a uniform belief.

        Args:
            topology: the map.
            words: of the map's images, in their order.
            linker: homing vector from the robot's image to a node's.
            settings: chances and the number of nodes to match with.
            weigh: evidence of answers; None: their inliers.
            transition: (n, n) chances to go from row to column between two images, without leaps;
                None: along the links, those that cost less sooner.
            power: of the likelihood of an image: how much it counts.
        """
        self._map = topology
        self._words = words
        self._linker = linker
        self._settings = settings
        self._weigh = weigh or inliers_of
        self._transition = _transition(topology) if transition is None else transition
        self._power = power
        self.leap = settings.leap
        self.belief: FloatArray = np.full(len(topology), 1.0 / max(len(topology), 1))
        self.answers: dict[int, Answer] = {}
        self.likelihood: FloatArray = np.ones(len(topology))
        self._fresh = True

    def update(self, image: OmniFeatures, also: Collection[int] = ()) -> FloatArray:
        """The belief after one more image.

        Args:
            image: its features.
            also: nodes that it is matched with in any case.

        Returns:
            (n,) the belief, a copy.
        """
        expected = self.expected()
        self._fresh = False
        self.likelihood = likelihoods(self._supports(image, expected, also), _BACKGROUND)
        posterior = expected * (self.likelihood / self.likelihood.max()) ** self._power
        self.belief = posterior / posterior.sum()
        return self.belief.copy()

    def expected(self) -> FloatArray:
        """(n,) the belief before the next image is seen."""
        return self.belief if self._fresh else self._moved()

    def best(self) -> tuple[int, float]:
        """The most probable node and its probability."""
        node = int(np.argmax(self.belief))
        return node, float(self.belief[node])

    def _moved(self) -> FloatArray:
        moved = self.belief @ self._transition
        return (1.0 - self.leap) * moved + self.leap / len(self.belief)

    def _supports(
        self, image: OmniFeatures, expected: FloatArray, also: Collection[int]
    ) -> FloatArray:
        """(n,) evidence of the nodes that are worth a match; 0 for the others."""
        nodes = np.union1d(self._candidates(image, expected), np.array([*also], dtype=np.int64))
        self.answers = {node: self._linker(image, node) for node in nodes.tolist()}
        out = np.zeros(len(self._map))
        for node, evidence in self._weigh(self.answers).items():
            out[node] = evidence
        return out

    def _candidates(self, image: OmniFeatures, expected: FloatArray) -> IntArray:
        """Nodes that look alike, and those that the belief expects, half and half."""
        most = self._settings.candidates
        if most == 0 or most >= len(self._map):
            return np.arange(len(self._map))
        alike = np.argsort(-self._words.likeness(image), kind="stable")
        likely = np.argsort(-expected, kind="stable")[: most // 2]
        rest = alike[~np.isin(alike, likely)][: most - len(likely)]
        return np.sort(np.concatenate([likely, rest]))


def inliers_of(answers: Mapping[int, Answer]) -> dict[int, float]:
    """Inliers of each node; where an image was taken at a node itself, as many as any other has."""
    out = {node: float(answer.support if answer else 0) for node, answer in answers.items()}
    best = max([*out.values(), _AT_NODE])
    at = (n for n, a in answers.items() if not a and a.reason is RefusalReason.AT_TARGET)
    return out | dict.fromkeys(at, best)


def likelihoods(supports: FloatArray, background: float) -> FloatArray:
    """(n,) of an image at each node, up to a factor: its inliers and those of a wrong place.

    Linear, not exponential as independent inliers would have it: features of one image stand and
    fall together (a poster that hangs in two rooms brings all of its own), and a single image must
    not decide.
    """
    return np.asarray(supports, dtype=np.float64) + background


def _transition(topology: Places) -> FloatArray:
    """(n, n) chances to go from row to column between two images, without leaps."""
    graph = topology.graph()
    graph.data = 1.0 / graph.data
    out = np.asarray(graph.sum(axis=1)).ravel()
    alone = out == 0.0
    moves = diags(np.where(alone, 0.0, (1.0 - _STAY) / np.where(alone, 1.0, out))) @ graph
    stay = np.where(alone, 1.0, _STAY)
    return np.asarray(moves.toarray() + np.diag(stay))
