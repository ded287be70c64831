"""Poses from random minimal samples of tentative matches (RANSAC; Fischler and Bolles 1981)."""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.floor import Floor
from fgslam.frontend.places.relocalisation.alignment import align, rigid, sample_size
from fgslam.frontend.places.relocalisation.least_squares import refine
from fgslam.frontend.places.relocalisation.proposals import Evidence, Proposals
from fgslam.frontend.places.relocalisation.residuals import Pairs
from fgslam.frontend.places.relocalisation.settings import RelocalisationSettings

_HYPOTHESES = 64  # poses scored at a time, from the rigid samples
_ROUNDS = 6  # times that samples are drawn at most
_CONFIDENCE = 0.999  # that one sample was free of mistakes, at which the search ends
_POLISH = 3  # Newton steps of a sample: from the closed form to the image's metric


def propose(
    evidence: Evidence, floor: Floor, settings: RelocalisationSettings, rng: np.random.Generator
) -> Proposals:
    """Poses, best first; none where too few matches make a sample.

    Rounds of samples are drawn until one of them was free of mistakes with the wanted confidence,
    judged by the matches that agree with the best pose so far.
    """
    size, found, drawn = sample_size(floor), Proposals.none(), 0
    if len(np.unique(evidence.tentative.features)) < size:
        return found
    odds = _odds(evidence)
    for _ in range(_ROUNDS):
        samples = _draw(evidence, odds, size, settings.samples, rng)
        rigid_ones = samples[_rigid(evidence, samples, floor)]
        used = rigid_ones[:_HYPOTHESES]
        share = 1.0 if len(rigid_ones) <= len(used) else len(used) / len(rigid_ones)
        drawn += int(len(samples) * share)
        if len(used):
            found = found.join(_poses(evidence, used, floor))
        if len(found) and drawn >= _needed(evidence, found, odds, size, _CONFIDENCE):
            break
    return found


def _odds(evidence: Evidence) -> FloatArray:
    """Probability of drawing each match: a feature's say is shared by its places."""
    weight = 1.0 / evidence.tentative.places
    return np.asarray(weight / weight.sum())


def _draw(
    evidence: Evidence, odds: FloatArray, size: int, count: int, rng: np.random.Generator
) -> IntArray:
    """Samples (c, size) of matches without a feature or landmark twice."""
    edges = np.cumsum(odds)
    drawn = np.searchsorted(edges, rng.random((count, size)) * edges[-1], side="right")
    drawn = np.minimum(drawn, len(odds) - 1)
    keep = np.ones(count, np.bool_)
    for a in range(size):
        for b in range(a):
            for column in (evidence.tentative.features, evidence.tentative.landmarks):
                keep &= column[drawn[:, a]] != column[drawn[:, b]]
    return np.asarray(drawn[keep])


def _rigid(evidence: Evidence, samples: IntArray, floor: Floor) -> BoolArray:
    pairs = evidence.pairs
    here, there = pairs.seen.position[samples], pairs.points[samples]
    # The map's ellipsoids are rounded to balls: their axes in the camera's frame are not known yet.
    balls = np.trace(pairs.point_covariances, axis1=1, axis2=2) / 3.0
    noise = pairs.seen.position_covariance + balls[:, None, None] * np.eye(3)
    return np.asarray(rigid(here, there, noise[samples], floor))


def _poses(evidence: Evidence, samples: IntArray, floor: Floor) -> Proposals:
    pairs = evidence.pairs
    poses = align(pairs.seen.position[samples], pairs.points[samples], floor)
    rows = np.repeat(np.arange(len(samples)), samples.shape[1])
    sampled: Pairs = pairs.select(samples.ravel())
    poses, covariances = refine(evidence.rig, floor, poses, sampled, rows, _POLISH)
    good = np.isfinite(covariances).all(axis=(1, 2)) & np.isfinite(poses).all(axis=(1, 2))
    poses, covariances = poses[good], covariances[good]
    scores = evidence.scores(poses, covariances)
    order = np.argsort(-scores, kind="stable")
    return Proposals(poses[order], covariances[order], scores[order])


def _needed(
    evidence: Evidence, found: Proposals, odds: FloatArray, size: int, confidence: float
) -> float:
    """Samples after which one was clean, if the best pose's matches are all that are right."""
    agreeing = evidence.agreeing(found.poses[0], found.covariances[0])
    chance = float(odds[agreeing].sum()) ** size
    if chance <= 0.0:
        return np.inf
    if chance >= 1.0:
        return 1.0
    return float(np.log(1.0 - confidence) / np.log1p(-chance))
