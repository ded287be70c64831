"""Frames of two or more cameras by time: which images belong together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import DatasetError
from fgslam.datasets.tables import nearest_rows

NANOSECONDS = 1e-9
_NAMED_SKEW_S = 1e-3  # what synchronised cameras differ by at most


def pair_stamps(
    right: IntArray, left: IntArray, tolerance: float, names: tuple[str, str], side: str = "left"
) -> tuple[tuple[IntArray, IntArray], tuple[str, ...]]:
    """Rows of the right and the left images that are each other's nearest in time.

    Args:
        right: (n,) stamps of the right camera in nanoseconds, increasing.
        left: (m,) stamps of the left one.
        tolerance: largest difference in seconds.
        names: of the right and the left camera, in messages.
        side: of the camera in place of the left one, in notes.

    Returns:
        The paired rows, and notes on images left without a partner and on how far pairs differ.

    Raises:
        DatasetError: no pair is left.
    """
    partner = nearest_rows(left, right)
    rows = np.arange(len(right))
    mutual = nearest_rows(right, left)[partner] == rows
    skew = NANOSECONDS * np.abs(left[partner] - right).astype(np.float64)
    close = skew <= tolerance + 0.5 * NANOSECONDS
    kept = rows[mutual & close]
    if len(kept) == 0:
        raise DatasetError(
            f"no image of {names[0]} ({_span(right)}) has a partner in {names[1]} ({_span(left)}) "
            f"within {1e3 * tolerance:g} ms, the nearest differ by {1e3 * skew.min():.4g} ms; "
            "raise dataset.pairing_tolerance_ms or restore the stamps"
        )
    alone = (("right", len(rows) - len(kept)), (side, len(left) - len(kept)))
    notes = tuple(
        f"{n} {camera} images have no partner within {1e3 * tolerance:g} ms and are left out"
        for camera, n in alone
        if n
    )
    return (kept, partner[kept]), (*notes, *_skew_note(skew[kept]))


def pair_all(
    reference: IntArray,
    others: Sequence[tuple[str, str, IntArray]],
    tolerance: float,
    name: str,
) -> tuple[IntArray, tuple[str, ...]]:
    """Rows (n, 1 + others) of images of one time, those of the reference first, and notes.

    Args:
        reference: (n,) stamps of the right camera in nanoseconds, increasing.
        others: side, name and stamps of each other camera.
        tolerance: largest difference in seconds from the reference.
        name: of the right camera, in messages.

    Raises:
        DatasetError: no image is left that has a partner of each camera.
    """
    rows = np.arange(len(reference))[:, None]
    notes: tuple[str, ...] = ()
    for side, other, stamps in others:
        (kept, partners), said = pair_stamps(
            reference[rows[:, 0]], stamps, tolerance, (name, other), side
        )
        rows, notes = np.column_stack([rows[kept], partners]), (*notes, *said)
    return rows, notes


def _span(stamps: IntArray) -> str:
    first, last = NANOSECONDS * float(stamps[0]), NANOSECONDS * float(stamps[-1])
    return f"{first:.3f} to {last:.3f} s"


def _skew_note(skew: FloatArray) -> tuple[str, ...]:
    if skew.max() <= _NAMED_SKEW_S:
        return ()
    return (
        f"the images of a pair differ in time by {1e3 * float(np.median(skew)):.3g} ms in the "
        f"median and {1e3 * float(skew.max()):.3g} ms at most: cameras that are not synchronised "
        "measure wrong depths while they turn",
    )
