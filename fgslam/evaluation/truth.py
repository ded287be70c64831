"""Which true poses cannot be true: the first ones, or single ones, that contradict the path.

What is compared are motions, which no alignment changes. Errors of an estimate accumulate from
step to step, all of a size; a truth that settles in its first seconds, or jumps for one pose, errs
in these steps alone, and far more. Steps are wide that exceed :data:`_FAR` medians of all.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.geometry import inverse
from fgslam.core.types import Trajectory
from fgslam.evaluation.statistics import associate, rotation_angles

_FEWEST = 10  # poses: the median of fewer steps is no measure
_FAR = 4.0  # the median length of three normal numbers is 1.54 sigma: six sigma
_LONGEST_START = 0.25  # of the poses: more is no start that contradicts a rest
_ALONE = 2.0  # times the largest error over as many steps elsewhere; of jerks, times the path's
_STILL = 1e-6  # radians and metres: no error at all


@dataclass(frozen=True, slots=True, eq=False)
class SoundTruth:
    """True poses without those that contradict a path.

    Attributes:
        trajectory: the sound ones.
        left_out: (k,) rows of the path whose truth is not among them.
        why: in a sentence; empty where none is left out.
    """

    trajectory: Trajectory | None
    left_out: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    why: str = ""


def sound_truth(path: Trajectory, truth: Trajectory | None) -> SoundTruth:
    """The truth of a path, of the same frame of the rig, without poses that cannot be true."""
    if truth is None:
        return SoundTruth(None)
    rows, true_rows = associate(path.timestamps, truth.timestamps)
    estimated, true = path.poses[rows], truth.poses[true_rows]
    if len(rows) < _FEWEST or not (np.isfinite(estimated).all() and np.isfinite(true).all()):
        return SoundTruth(truth)
    start, single = unsound_start(estimated, true), unsound_singles(estimated, true)
    single = single[single > start]
    if not start and not len(single):
        return SoundTruth(truth)
    words = []
    if start:
        off = _largest(estimated, true, [(k, start) for k in range(start)])
        first, last = rows[[0, start - 1]].tolist()
        frames = f"frame {first}" if first == last else f"frames {first} to {last}"
        words.append(f"truth of {frames} is off by {_size(off)}")
    if len(single):
        off = _largest(estimated, true, [(k - 1, k) for k in single.tolist()])
        numbers = ", ".join(str(row) for row in rows[single].tolist())
        words.append(f"truth of single frames ({numbers}) is off by up to {_size(off)}")
    bad = np.concatenate([np.arange(start), single])
    kept = np.delete(np.arange(len(truth)), true_rows[bad])
    sound = replace(truth, timestamps=truth.timestamps[kept], poses=truth.poses[kept])
    return SoundTruth(sound, rows[bad], "; ".join(words) + ": left out where it is judged")


def unsound_start(estimate: FloatArray, truth: FloatArray) -> int:
    """How many of the first poses contradict the rest; (n, 4, 4) of the same instants."""
    wide: BoolArray = np.asarray(_wide(_differences(estimate, truth, 1)).any(axis=1))
    settled = ~wide[:-1] & ~wide[1:]
    count = int(np.argmax(settled)) if settled.any() else len(wide)
    if not 0 < count <= _LONGEST_START * len(estimate):
        return 0
    over = _differences(estimate, truth, count)
    elsewhere = over[count:].max(axis=0, initial=_STILL)
    return count if (over[0] > _ALONE * elsewhere).any() else 0


def unsound_singles(estimate: FloatArray, truth: FloatArray) -> IntArray:
    """Poses (k,) from which both steps err, the step over them does not, and the truth jerks.

    By far more than it does elsewhere, and than the path does there: a rough drive jerks, too, and
    an error of the path makes its own jerk now larger, now smaller than the truth's.
    """
    wide = _wide(_differences(estimate, truth, 1))
    over = ~_wide(_differences(estimate, truth, 2)).any(axis=1)
    jerks = _bends(truth)
    jerky = _wide(jerks) & (jerks > _ALONE * _bends(estimate))
    alone = np.any(wide[:-1] & wide[1:] & jerky, axis=1) & over
    return np.flatnonzero(alone) + 1


def _differences(estimate: FloatArray, truth: FloatArray, lag: int) -> FloatArray:
    """(n - lag, 2) angle in radians and distance in metres between motions over so many poses."""
    off = inverse(inverse(truth[:-lag]) @ truth[lag:]) @ inverse(estimate[:-lag]) @ estimate[lag:]
    return _sizes(off)


def _largest(
    estimate: FloatArray, truth: FloatArray, pairs: Iterable[tuple[int, int]]
) -> FloatArray:
    """(2,) of the same between pairs of poses."""
    found = [_differences(estimate[list(two)], truth[list(two)], 1)[0] for two in pairs]
    return np.asarray(np.max(found, axis=0))


def _bends(poses: FloatArray) -> FloatArray:
    """(n - 2, 2) by which each motion differs from the one before, angle and distance."""
    steps = inverse(poses[:-1]) @ poses[1:]
    return _sizes(inverse(steps[:-1]) @ steps[1:])


def _sizes(motions: FloatArray) -> FloatArray:
    """(n, 2) angle and distance of motions (n, 4, 4)."""
    angles = rotation_angles(motions[:, :3, :3])
    return np.column_stack([angles, np.linalg.norm(motions[:, :3, 3], axis=1)])


def _wide(differences: FloatArray) -> BoolArray:
    """(n, 2) which are far larger than most, in angle and in distance."""
    return np.asarray(differences > _FAR * np.maximum(np.median(differences, axis=0), _STILL))


def _size(off: FloatArray) -> str:
    """An angle and a distance in words."""
    return f"{np.degrees(off[0]):.1f} degrees and {100.0 * off[1]:.1f} cm"
