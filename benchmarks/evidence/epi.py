"""A judge of right-left matches that no match has seen: a row of the light field's other views.

A point seen at column ``c`` in a view moves by ``slope * (x - x_ref)`` in the others of its row,
``x`` being their true positions: a line in the epipolar-plane image. The judge sweeps all slopes
and takes the one along which the patch around the point looks alike. It sees neither the left nor
the top image of the match that it judges, and no SIFT.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.datasets.opening import open_recording
from fgslam.datasets.settings import LightFieldSettings

HALF_PATCH = 3
_KEEP = 0.6  # share of the views that must see the point: the best ones count
_PENALTY = 30.0  # grey levels at which a difference counts as an occlusion
_AMBIGUOUS = 1.25  # a second minimum this near to the first leaves the judge undecided
_DISTINCT_PX = 0.75  # apart from the first by more than this, at the matches' baseline


@dataclass(frozen=True, eq=False)
class Row:
    """Unshifted views of one grid row.

    Attributes:
        images: (n, height, width) grey levels.
        places: (n, 2) true (x, y) in metres, x with the image's columns, y down.
    """

    images: FloatArray
    places: FloatArray


def open_row(settings: LightFieldSettings) -> Row:
    """All views of ``settings.row`` but the first, which has no left neighbour."""
    single = replace(settings, spacing=1, use_top=False, shift_px_per_step=0.0, start=0, stop=None)
    recording = open_recording(single)
    truth = recording.ground_truth
    if truth is None:
        raise ValueError("a light field has ground truth")
    images = [recording.frame(i).images[0] for i in range(len(recording))]
    return Row(np.array(images, np.float64), truth.poses[:, :2, 3])


@dataclass(frozen=True, eq=False)
class SlopeFound:
    """What the judge says of points.

    Attributes:
        slope: (n,) of the best line, pixels a metre.
        decided: (n,) whether no other line is nearly as good.
    """

    slope: FloatArray
    decided: BoolArray


def judge(
    row: Row, reference: int, hidden: IntArray, xy: FloatArray, slopes: FloatArray
) -> SlopeFound:
    """Finds the slope of points by the views that the matches did not use.

    Args:
        row: the views.
        reference: index of the view in which the points were found.
        hidden: indices of the views that the judge must not see.
        xy: (n, 2) points in the unshifted reference view.
        slopes: (m,) to try, pixels a metre, ascending and evenly spaced.
    """
    seen = np.setdiff1d(np.arange(len(row.images)), np.append(hidden, reference))
    patch = _sample(row.images[reference], xy)
    cost = np.empty((len(slopes), len(xy)))
    for k, slope in enumerate(slopes):
        difference = np.array(
            [
                np.abs(_sample(row.images[v], xy - slope * _step(row, reference, v)) - patch)
                for v in seen
            ]
        )
        each = np.minimum(difference, _PENALTY).mean(axis=2)
        keep = int(np.ceil(_KEEP * len(seen)))
        cost[k] = np.partition(each, keep - 1, axis=0)[:keep].mean(axis=0)
    best = cost.argmin(axis=0)
    step = row.places[reference, 0] - row.places[hidden[0], 0] if len(hidden) else 1.0
    apart = np.abs(slopes[:, None] - slopes[best]) * abs(step) > _DISTINCT_PX
    second = np.where(apart, cost, np.inf).min(axis=0)
    return SlopeFound(slopes[best], second > _AMBIGUOUS * cost.min(axis=0))


def _step(row: Row, reference: int, view: int) -> FloatArray:
    """(2,) camera motion in metres from the reference to a view."""
    return np.asarray(row.places[view] - row.places[reference])


def _sample(image: FloatArray, centres: FloatArray) -> FloatArray:
    """Patches (n, k) around sub-pixel centres (n, 2), bilinear, clipped at the border."""
    offset = np.arange(-HALF_PATCH, HALF_PATCH + 1)
    columns = centres[:, 0, None, None] + offset[None, None, :]
    rows = centres[:, 1, None, None] + offset[None, :, None]
    columns, rows = np.broadcast_arrays(columns, rows)
    height, width = image.shape
    columns = np.clip(columns, 0.0, width - 1.001)
    rows = np.clip(rows, 0.0, height - 1.001)
    c, r = columns.astype(np.int64), rows.astype(np.int64)
    fc, fr = columns - c, rows - r
    upper = image[r, c] * (1.0 - fc) + image[r, c + 1] * fc
    lower = image[r + 1, c] * (1.0 - fc) + image[r + 1, c + 1] * fc
    return np.asarray((upper * (1.0 - fr) + lower * fr).reshape(len(centres), -1))
