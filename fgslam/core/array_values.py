"""Values of arrays from a file: finite, of one identity each, covariances that can be ones.

A file whose shapes fit may still hold what no run wrote; an estimator would make wrong answers of
it without a word.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fgslam.core.array_files import ArrayFile
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.geometry import is_rigid

_ROUNDED = 1e-9
"""Of a covariance's trace: what rounding may take from its smallest eigenvalue."""


def require_finite(
    file: ArrayFile, arrays: Mapping[str, Any], names: Sequence[str], where: str
) -> None:
    """Raises the file's error for the first array that holds NaN or infinity."""
    for name in names:
        if not np.isfinite(arrays[name]).all():
            raise _refusal(file, where, f"array {name} is not finite")


def require_covariances(
    file: ArrayFile, name: str, covariances: FloatArray, where: str, *, definite: bool = True
) -> None:
    """Raises the file's error unless matrices (n, k, k) are finite, symmetric and positive.

    ``definite`` False: some direction may be without noise, as of a motion in the plane.
    """
    if not np.isfinite(covariances).all():
        raise _refusal(file, where, f"array {name} is not finite")
    if not len(covariances):
        return
    size = np.abs(covariances).max(axis=(1, 2))
    skew = np.abs(covariances - np.swapaxes(covariances, 1, 2)).max(axis=(1, 2))
    least = np.linalg.eigvalsh(covariances)[:, 0]
    wrong = (skew > _ROUNDED * size) | (least < -_ROUNDED * size)
    if definite:
        wrong |= least <= 0.0
    if wrong.any():
        row = int(np.argmax(wrong))
        raise _refusal(file, where, f"array {name}, row {row}, is no covariance")


def require_motions(file: ArrayFile, name: str, motions: FloatArray, where: str) -> None:
    """Raises the file's error unless all of (n, 4, 4) are rigid motions."""
    wrong = [not is_rigid(motion) for motion in motions]
    if any(wrong):
        raise _refusal(file, where, f"array {name}, row {wrong.index(True)}, is no rigid motion")


def require_single(file: ArrayFile, name: str, ids: IntArray, start: IntArray, where: str) -> None:
    """Raises the file's error where one part between offsets holds an identity twice."""
    part = np.repeat(np.arange(len(start) - 1), np.diff(start))
    order = np.lexsort((ids, part))
    twice = (np.diff(ids[order]) == 0) & (np.diff(part[order]) == 0)
    if twice.any():
        at = order[int(np.argmax(twice))]
        found = f"array {name} holds {ids[at]} twice in part {part[at]}"
        raise _refusal(file, where, found)


def _refusal(file: ArrayFile, where: str, what: str) -> Exception:
    return file.error(f"{where}: {what}, so it is damaged or no run wrote it; {file.again}")
