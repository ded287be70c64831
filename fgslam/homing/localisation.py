"""Localisation in a topological map: a Bayes filter over its nodes (I).

Images are compared as nodes are: by how many of their features agree on one homing. The belief is
a distribution over nodes; between two images it stays, moves along an edge, or, rarely, leaps
anywhere, so that a robot that was carried off finds itself again.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import diags

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.homing import OmniFeatures, Refusal, RefusalReason
from fgslam.homing.links import Linker
from fgslam.homing.retrieval import VisualWords
from fgslam.homing.settings import LocalisationSettings
from fgslam.homing.topological_map import TopologicalMap

_BACKGROUND = 4.0  # inliers that a wrong place may get, on average

_STAY = 0.5  # chance to be still at the node of the last image


class Localiser:
    """Probability of each node to be where the robot is, or nearest to it.

    Attributes:
        belief: (n,) probabilities; uniform before the first image.
    """

    def __init__(
        self,
        topology: TopologicalMap,
        words: VisualWords,
        linker: Linker,
        settings: LocalisationSettings,
    ) -> None:
        """Begins with a uniform belief.

        Args:
            topology: the map.
            words: of the map's images, in their order.
            linker: homing vector from the robot's image to a node's.
            settings: chances and the number of nodes to match with.
        """
        self._map = topology
        self._words = words
        self._linker = linker
        self._settings = settings
        self._transition = _transition(topology)
        self.belief: FloatArray = np.full(len(topology), 1.0 / max(len(topology), 1))
        self._fresh = True

    def update(self, image: OmniFeatures) -> FloatArray:
        """The belief after one more image.

        Returns:
            (n,) the belief, a copy.
        """
        expected = self.belief if self._fresh else self._moved()
        self._fresh = False
        supports = self._supports(image, expected)
        posterior = expected * likelihoods(supports, _BACKGROUND)
        self.belief = posterior / posterior.sum()
        return self.belief.copy()

    def best(self) -> tuple[int, float]:
        """The most probable node and its probability."""
        node = int(np.argmax(self.belief))
        return node, float(self.belief[node])

    def _moved(self) -> FloatArray:
        leap = self._settings.leap
        return (1.0 - leap) * (self.belief @ self._transition) + leap / len(self.belief)

    def _supports(self, image: OmniFeatures, expected: FloatArray) -> IntArray:
        """(n,) inliers of the nodes that are worth a match; 0 for the others."""
        out = np.zeros(len(self._map), dtype=np.int64)
        for node in self._candidates(image, expected):
            answer = self._linker(image, self._map.images[node])
            if not isinstance(answer, Refusal):
                out[node] = answer.support
            elif answer.reason is RefusalReason.AT_TARGET:
                # There is no better match than the place itself; its answer bears no count.
                out[node] = max(len(image.sift), 1)
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


def likelihoods(supports: IntArray, background: float) -> FloatArray:
    """(n,) of an image at each node, up to a factor: its inliers and those of a wrong place.

    Linear, not exponential as independent inliers would have it: features of one image stand and
    fall together (a poster that hangs in two rooms brings all of its own), and a single image must
    not decide.
    """
    return np.asarray(supports, dtype=np.float64) + background


def _transition(topology: TopologicalMap) -> FloatArray:
    """(n, n) chances to go from row to column between two images, without leaps."""
    graph = topology.graph()
    graph.data = 1.0 / graph.data
    out = np.asarray(graph.sum(axis=1)).ravel()
    alone = out == 0.0
    moves = diags(np.where(alone, 0.0, (1.0 - _STAY) / np.where(alone, 1.0, out))) @ graph
    stay = np.where(alone, 1.0, _STAY)
    return np.asarray(moves.toarray() + np.diag(stay))
