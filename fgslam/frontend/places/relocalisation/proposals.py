"""Poses proposed with what speaks for them, and the choice of the best that lie apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, Rows
from fgslam.core.sensors import CameraRig
from fgslam.frontend.places.relocalisation.residuals import Pairs, log_likelihoods, residuals
from fgslam.frontend.places.relocalisation.tentative import Tentative

_AT_ONCE = 40_000  # residuals computed together; a few megabytes


@dataclass(frozen=True, slots=True, eq=False)
class Proposals(Rows):
    """Poses (h, 4, 4), covariances (h, 6, 6) and scores (h,), best first."""

    poses: FloatArray
    covariances: FloatArray
    scores: FloatArray

    def join(self, other: Proposals) -> Proposals:
        """Both, best first."""
        joined = Rows.join(self, other)
        return joined.select(np.argsort(-joined.scores, kind="stable"))

    @staticmethod
    def none() -> Proposals:
        """No pose at all."""
        return Proposals(np.empty((0, 4, 4)), np.empty((0, 6, 6)), np.empty(0))


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """The matches that poses are judged by.

    Attributes:
        rig: the cameras.
        tentative: k matches, in the order of features.
        pairs: their geometry.
        log_chance: (k,) log density of a match that is a mistake.
    """

    rig: CameraRig
    tentative: Tentative
    pairs: Pairs
    log_chance: FloatArray

    def scores(self, poses: FloatArray, covariances: FloatArray) -> FloatArray:
        """Log-likelihood ratios (h,): each feature's best candidate against chance, if better.

        The poses' own uncertainty widens the expected residuals and thereby thins their density:
        a vague pose gains little from many matches.
        """
        out = np.empty(len(poses))
        step = max(1, _AT_ONCE // max(1, len(self.pairs)))
        for start in range(0, len(poses), step):
            part = slice(start, start + step)
            out[part] = self._scores(poses[part], covariances[part])
        return out

    def _scores(self, poses: FloatArray, covariances: FloatArray) -> FloatArray:
        h, k = len(poses), len(self.pairs)
        rows, match = np.repeat(np.arange(h), k), np.tile(np.arange(k), h)
        found = residuals(self.rig, poses, self.pairs.select(match), rows)
        gain = log_likelihoods(found, covariances[rows]).reshape(h, k) - self.log_chance
        starts = np.flatnonzero(np.diff(self.tentative.features, prepend=-1))
        best = np.maximum.reduceat(gain, starts, axis=1)
        return np.asarray(np.maximum(best, 0.0).sum(axis=1))

    def agreeing(self, wTc: FloatArray, covariance: FloatArray) -> BoolArray:
        """Matches (k,) that are likelier right than chance at a pose with its covariance."""
        found = residuals(self.rig, wTc, self.pairs)
        return np.asarray(log_likelihoods(found, covariance) > self.log_chance)


def apart(poses: FloatArray, wTc: FloatArray, metres: float, radians: float) -> BoolArray:
    """Which poses (h, 4, 4) are elsewhere: farther than ``metres`` or turned by ``radians``."""
    way = np.linalg.norm(poses[:, :3, 3] - wTc[:3, 3], axis=1)
    cosine = 0.5 * (np.einsum("hij,ij->h", poses[:, :3, :3], wTc[:3, :3]) - 1.0)
    return np.asarray((way > metres) | (cosine < np.cos(radians)))


def distinct(found: Proposals, count: int, metres: float, radians: float) -> Proposals:
    """The best of each neighbourhood, at most ``count``."""
    chosen: list[int] = []
    free = np.ones(len(found), np.bool_)
    while free.any() and len(chosen) < count:
        best = int(np.argmax(free))
        chosen.append(best)
        free &= apart(found.poses, found.poses[best], metres, radians)
        free[best] = False
    return found.select(np.array(chosen, np.int64))
