"""Poses proposed from tentative matches by random samples (RANSAC, Fischler and Bolles 1981)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray, Rows
from fgslam.core.floor import Floor
from fgslam.core.sensors import CameraRig
from fgslam.frontend.places.relocalisation.known_map import Tentative
from fgslam.frontend.places.relocalisation.residuals import (
    Pairs,
    log_likelihoods,
    refine,
    residuals,
)
from fgslam.frontend.tracking.resection import (
    align,
    rigid,
    rounded,
    sample_size,
)

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
        of_feature = np.flatnonzero(np.diff(self.tentative.features, prepend=-1))
        step = max(1, _AT_ONCE // max(1, len(self.pairs)))
        for start in range(0, len(poses), step):
            some = poses[start : start + step]
            h, k = len(some), len(self.pairs)
            rows, match = np.repeat(np.arange(h), k), np.tile(np.arange(k), h)
            found = residuals(self.rig, some, self.pairs.select(match), rows)
            logs = log_likelihoods(found, covariances[start : start + step][rows])
            gain = logs.reshape(h, k) - self.log_chance
            best = np.maximum.reduceat(gain, of_feature, axis=1)
            out[start : start + step] = np.maximum(best, 0.0).sum(axis=1)
        return out

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


_HYPOTHESES = 64  # poses scored at a time, from the rigid samples
_SAMPLES = 4096  # minimal samples drawn at a time; most fail the rigidity test
_ROUNDS = 6  # times that samples are drawn at most
_CONFIDENCE = 0.999  # that one sample was free of mistakes, at which the search ends
_SAMPLED_STEPS = 3  # Newton steps of a sample: from the closed form to the image's metric


def propose_by_samples(evidence: Evidence, floor: Floor, rng: np.random.Generator) -> Proposals:
    """Poses, best first; none where too few matches make a sample.

    Rounds of samples are drawn until one of them was free of mistakes with the wanted confidence,
    judged by the matches that agree with the best pose so far.
    """
    size, found, drawn = sample_size(floor), Proposals.none(), 0
    if len(np.unique(evidence.tentative.features)) < size:
        return found
    weight = 1.0 / evidence.tentative.places  # a feature's say is shared by its places
    odds = weight / weight.sum()
    pairs = evidence.pairs
    noise = pairs.seen.position_covariance + rounded(pairs.point_covariances)
    for _ in range(_ROUNDS):
        samples = _draw(evidence, odds, size, rng)
        here, there = pairs.seen.position[samples], pairs.points[samples]
        rigid_ones = samples[rigid(here, there, noise[samples], floor)]
        used = rigid_ones[:_HYPOTHESES]
        share = 1.0 if len(rigid_ones) <= len(used) else len(used) / len(rigid_ones)
        drawn += int(len(samples) * share)
        if len(used):
            found = found.join(_poses(evidence, used, floor))
        if len(found) and drawn >= _needed(evidence, found, odds, size):
            break
    return found


def _draw(evidence: Evidence, odds: FloatArray, size: int, rng: np.random.Generator) -> IntArray:
    """Samples (c, size) of matches without a feature or landmark twice."""
    edges = np.cumsum(odds)
    drawn = np.searchsorted(edges, rng.random((_SAMPLES, size)) * edges[-1], side="right")
    drawn = np.minimum(drawn, len(odds) - 1)
    keep = np.ones(_SAMPLES, np.bool_)
    for a in range(size):
        for b in range(a):
            for column in (evidence.tentative.features, evidence.tentative.landmarks):
                keep &= column[drawn[:, a]] != column[drawn[:, b]]
    return np.asarray(drawn[keep])


def _poses(evidence: Evidence, samples: IntArray, floor: Floor) -> Proposals:
    pairs = evidence.pairs
    poses = align(pairs.seen.position[samples], pairs.points[samples], floor)
    rows = np.repeat(np.arange(len(samples)), samples.shape[1])
    sampled: Pairs = pairs.select(samples.ravel())
    poses, covariances = refine(evidence.rig, floor, poses, sampled, rows, _SAMPLED_STEPS)
    good = np.isfinite(covariances).all(axis=(1, 2)) & np.isfinite(poses).all(axis=(1, 2))
    poses, covariances = poses[good], covariances[good]
    scores = evidence.scores(poses, covariances)
    order = np.argsort(-scores, kind="stable")
    return Proposals(poses[order], covariances[order], scores[order])


def _needed(evidence: Evidence, found: Proposals, odds: FloatArray, size: int) -> float:
    """Samples after which one was clean, if the best pose's matches are all that are right."""
    agreeing = evidence.agreeing(found.poses[0], found.covariances[0])
    chance = float(odds[agreeing].sum()) ** size
    if chance <= 0.0:
        return np.inf
    if chance >= 1.0:
        return 1.0
    return float(np.log(1.0 - _CONFIDENCE) / np.log1p(-chance))
