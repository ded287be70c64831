"""Poses on a level floor by votes: the Hough transform over X, Z and heading.

A match fixes two of the three numbers: for each heading there is one position from which the
feature would be the landmark. So it votes along a one-parameter family of poses; where many
families cross is the robot.
"""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.floor import Floor
from fgslam.frontend.places.relocalisation.alignment import align_planar, floor_axes
from fgslam.frontend.places.relocalisation.least_squares import refine
from fgslam.frontend.places.relocalisation.proposals import Evidence, Proposals

_BIN_M = 0.3  # side of a bin
_BIN_DEG = 5.0  # width of a bin of heading
_BINS = 16  # fullest ones whose matches are solved for a pose
_POLISH = 6  # Newton steps from a bin's mean to the least squares of its matches
_KERNEL_WIDTH = 3.0
_MOST_BINS = 16_000_000  # the accumulator's; larger maps get wider bins


def propose(evidence: Evidence, floor: Floor) -> Proposals:
    """Poses of the fullest bins after least squares over their matches, best first."""
    if len(evidence.pairs) < 2:
        return Proposals.none()
    grid = _Grid(evidence, floor)
    peaks = grid.peaks(_BINS)
    members = [grid.members(peak) for peak in peaks]
    members = [group for group in members if len(group) >= 2]
    if not members:
        return Proposals.none()
    starts = np.concatenate([_aligned(evidence, group, floor) for group in members])
    rows = np.repeat(np.arange(len(members)), [len(group) for group in members])
    pairs = evidence.pairs.select(np.concatenate(members))
    poses, covariances = refine(evidence.rig, floor, starts, pairs, rows, _POLISH, _KERNEL_WIDTH)
    good = np.isfinite(covariances).all(axis=(1, 2)) & np.isfinite(poses).all(axis=(1, 2))
    poses, covariances = poses[good], covariances[good]
    scores = evidence.scores(poses, covariances)
    order = np.argsort(-scores, kind="stable")
    return Proposals(poses[order], covariances[order], scores[order])


def _aligned(evidence: Evidence, group: IntArray, floor: Floor) -> FloatArray:
    """(1, 4, 4) closed-form pose of a bin's matches."""
    pairs = evidence.pairs
    return align_planar(pairs.seen.position[group][None], pairs.points[group][None], floor)


class _Grid:
    """The accumulator: every feature has one vote a bin, however many landmarks it resembles."""

    def __init__(self, evidence: Evidence, floor: Floor) -> None:
        axes = floor_axes(floor)
        self._features = evidence.tentative.features
        self._headings = max(4, round(360.0 / _BIN_DEG))
        angles = np.arange(self._headings) * (2.0 * np.pi / self._headings)
        here, there = evidence.pairs.seen.position @ axes, evidence.pairs.points @ axes
        turn = np.stack([np.cos(angles), np.sin(angles)])
        turned = np.stack(
            [
                here[:, :1] * turn[0] - here[:, 1:] * turn[1],
                here[:, :1] * turn[1] + here[:, 1:] * turn[0],
            ],
            axis=2,
        )
        positions = there[:, None, :] - turned  # (k, headings, 2)
        low = positions.min(axis=(0, 1))
        extent = positions.max(axis=(0, 1)) - low
        area = float(np.prod(extent + 4.0 * _BIN_M))
        self._side = max(_BIN_M, float(np.sqrt(area * self._headings / _MOST_BINS)))
        # Each vote goes to the two nearest bins of either coordinate (Lowe 1999).
        self._corner = np.floor((positions - low) / self._side - 0.5).astype(np.int64) + 1
        self._shape = (*(np.floor(extent / self._side).astype(np.int64) + 4), self._headings)
        self._counts = self._vote()

    def _vote(self) -> IntArray:
        counts = np.zeros(int(np.prod(self._shape)), np.int64)
        bounds = np.flatnonzero(np.diff(self._features, prepend=-1))
        for group in np.split(np.arange(len(self._features)), bounds[1:]):
            counts[np.unique(self._bins(group))] += 1
        return counts

    def _bins(self, rows: IntArray) -> IntArray:
        """Flat bins of matches (m,), four a heading: (m, headings, 4)."""
        corner = self._corner[rows]
        steps = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
        at = corner[:, :, None, :] + steps
        heading = np.arange(self._headings)[None, :, None]
        return np.asarray((at[..., 0] * self._shape[1] + at[..., 1]) * self._headings + heading)

    def peaks(self, count: int) -> IntArray:
        """The fullest bins, one of each neighbourhood (3 x 3 bins, three headings)."""
        fullest = np.argsort(-self._counts, kind="stable")[: 40 * count]
        fullest = fullest[self._counts[fullest] >= 2]
        at = np.stack(np.unravel_index(fullest, self._shape), axis=1)
        chosen: list[int] = []
        for k in range(len(fullest)):
            gap = np.abs(at[chosen] - at[k])
            gap[:, 2] = np.minimum(gap[:, 2], self._headings - gap[:, 2])
            if not (gap <= 1).all(axis=1).any():
                chosen.append(k)
            if len(chosen) == count:
                break
        return np.asarray(fullest[np.array(chosen, np.int64)])

    def members(self, peak: int) -> IntArray:
        """Matches that voted for a bin."""
        x, z, heading = np.unravel_index(peak, self._shape)
        gap = np.array([x, z]) - self._corner[:, heading]
        return np.flatnonzero(((gap == 0) | (gap == 1)).all(axis=1))
