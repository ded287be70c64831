"""Ground truth by rendered depth (landmarks, disparities, views), and true poses in a saved map."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.errors import FgslamError
from fgslam.core.estimates import LandmarkMap
from fgslam.core.features import WHOLE_PX, StereoFeatures
from fgslam.core.geometry import inverse, transform_to_world
from fgslam.core.measurement_log import MeasurementLog
from fgslam.core.recordings import LandmarkTruth, Sequence
from fgslam.core.saved_map import SavedMap
from fgslam.core.sensors import CameraRig
from fgslam.datasets.settings import RenderedLabSettings
from fgslam.evaluation.statistics import align, associate
from fgslam.frontend.settings import FrontendSettings
from fgslam.frontend.tracking.landmarks import LandmarkDatabase
from fgslam.runs.config import ExperimentConfig
from fgslam.runs.config_reading import parse
from fgslam.runs.opening import open_sequence

_LEAST_SIGHTINGS = 3
_SAME_SURFACE = 0.03
"""Relative spread of the four depths around a pixel, and bend of the inverse depth from pixel to
pixel, that one surface may have."""

_NORMAL_MAD = 1.4826  # median absolute deviation to standard deviation, normal distribution
_MEDIAN_TO_MEAN = 1.2533  # standard error of a median over that of the mean


@runtime_checkable
class TrueDepth(Protocol):
    """A recording whose exact depth is known."""

    def depth(self, i: int) -> FloatArray:
        """Depth (height, width) of the reference image of frame ``i``, metres."""
        ...


def rendered_landmark_truth(
    sequence: Sequence, log: MeasurementLog
) -> tuple[LandmarkTruth, FloatArray] | None:
    """Where the landmarks truly are: the median of the world points under their pixels.

    Each sighting that the run did not reject gives the point where the ray of its pixel meets the
    rendered surface. The truth has an error of its own: a feature's pixel is known to a fraction
    of a pixel only, and at a curved or slanted surface the blob that is matched is no point.
    Where patches show two surfaces, one behind the other, there is no true point at all: their
    contrast may be of either. A landmark is left out where most of its known points are such.

    Args:
        sequence: the recording; frame k is the log's.
        log: the run's measurements.

    Returns:
        Positions in the world of the ground truth, and the standard error (n,) of each in metres,
        from the scatter of its sightings; landmarks with fewer than three are left out, too. None
        where the recording knows no depth.
    """
    truth = sequence.ground_truth
    if not isinstance(sequence, TrueDepth) or truth is None:
        return None
    ids: list[IntArray] = [np.empty(0, np.int64)]
    points: list[FloatArray] = [np.empty((0, 3))]
    split: list[BoolArray] = [np.empty(0, np.bool_)]
    for k, increment in enumerate(log):
        seen = increment.kept
        if not len(seen):
            continue
        depth, pixels = sequence.depth(k), seen.measurement[:, :2]
        local, known = points_under(sequence.rig, depth, pixels)
        ids.append(seen.ids[known])
        points.append(transform_to_world(truth.poses[k], local[known]))
        split.append(at_edges(depth, pixels[known]))
    return medians_of(np.concatenate(ids), np.concatenate(points), np.concatenate(split))


def points_under(
    rig: CameraRig, depth: FloatArray, pixels: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Points (n, 3) of the camera's frame under sub-pixel places (n, 2), and which are known.

    The inverse depth is interpolated, which is exact on a plane; at an edge of depth, where the
    four pixels around do not belong to one surface, the point is not known (NaN).
    """
    low = np.floor(pixels).astype(np.int64)
    height, width = depth.shape
    inside = np.all((low >= 0) & (low < [width - 1, height - 1]), axis=1)
    column, row = np.where(inside[:, None], low, 0).T
    around = np.stack([depth[row + dr, column + dc] for dr in (0, 1) for dc in (0, 1)], axis=1)
    spread = around.max(axis=1) - around.min(axis=1)
    # False where a depth is not known.
    known = np.asarray(inside & (spread <= _SAME_SURFACE * around.min(axis=1)))
    right, below = (pixels - low).T
    weights = np.stack(
        [(1 - below) * (1 - right), (1 - below) * right, below * (1 - right), below * right], axis=1
    )
    z = np.full(len(pixels), np.nan)
    z[known] = 1.0 / (weights[known] / around[known]).sum(axis=1)
    x, y = (pixels[:, 0] - rig.cx) / rig.fx, (pixels[:, 1] - rig.cy) / rig.fy
    return np.column_stack([x * z, y * z, z]), known


def at_edges(depth: FloatArray, pixels: FloatArray) -> BoolArray:
    """Which places (n, 2) in a depth image (h, w) have an edge of depth within a patch's reach.

    On a plane the inverse depth is linear in the image; at a jump its second difference is large.
    """
    inverse = 1.0 / depth
    bend = np.zeros_like(inverse)
    bend[:, 1:-1] = np.abs(np.diff(inverse, 2, axis=1))
    bend[1:-1] = np.maximum(bend[1:-1], np.abs(np.diff(inverse, 2, axis=0)))
    jumps = ~(bend <= _SAME_SURFACE * inverse)  # an unknown depth is no surface
    count = np.zeros((depth.shape[0] + 1, depth.shape[1] + 1), np.int64)
    count[1:, 1:] = jumps.cumsum(axis=0).cumsum(axis=1)
    column, row = np.rint(pixels).astype(np.int64).T
    left, right = _within(column, depth.shape[1])
    top, bottom = _within(row, depth.shape[0])
    near = count[bottom, right] - count[top, right] - count[bottom, left] + count[top, left]
    return np.asarray(near > 0)


def _within(middle: IntArray, size: int) -> tuple[IntArray, IntArray]:
    """The first pixel that a patch reaches in an image of this size, and that after the last."""
    low = np.clip(middle - WHOLE_PX, 0, size)
    return low, np.clip(middle + WHOLE_PX + 1, 0, size)


def medians_of(
    ids: IntArray, points: FloatArray, split: BoolArray
) -> tuple[LandmarkTruth, FloatArray]:
    """Median and its standard error of each landmark's points, those seen often enough.

    ``split`` (n,) are the sightings at edges of depth.
    """
    order = np.argsort(ids, kind="stable")
    unique, start, times = np.unique(ids[order], return_index=True, return_counts=True)
    groups = np.split(points[order], start[1:])
    edges = np.add.reduceat(split[order].astype(np.int64), start) if len(start) else start
    kept = np.flatnonzero((times >= _LEAST_SIGHTINGS) & (2 * edges <= times)).tolist()
    medians = np.array([np.median(groups[k], axis=0) for k in kept]).reshape(-1, 3)
    sigma = [_standard_error(groups[k], median) for k, median in zip(kept, medians, strict=True)]
    return LandmarkTruth(unique[kept], medians), np.array(sigma)


def _standard_error(points: FloatArray, median: FloatArray) -> float:
    """Of the median of points (n, 3), as a distance, robustly from their scatter."""
    deviation = _NORMAL_MAD * np.median(np.abs(points - median), axis=0)
    return float(_MEDIAN_TO_MEAN * np.linalg.norm(deviation) / np.sqrt(len(points)))


_PRECISION_EVERY = 10  # frames between checks of stereo matches against rendered depth
_PRECISION_PX = 1.5  # disparity error of a correct match; a SIFT match's noise is a tenth of it


def stereo_precision(sequence: Sequence, i: int, stereo: StereoFeatures) -> float:
    """Fraction of stereo matches with the rendered disparity; NaN but of every tenth frame.

    The nearest of the four pixels around a feature decides: at an edge of depth either side is
    right.
    """
    if i % _PRECISION_EVERY or not isinstance(sequence, TrueDepth) or not len(stereo):
        return float("nan")
    depth = sequence.depth(i)
    height, width = depth.shape
    low = np.floor(stereo.measurement[:, :2]).astype(np.int64)
    columns = np.clip(low[:, 0, None] + [0, 1, 0, 1], 0, width - 1)
    rows = np.clip(low[:, 1, None] + [0, 0, 1, 1], 0, height - 1)
    rig = sequence.rig
    true = rig.fx * rig.baseline / depth[rows, columns]
    error = np.abs(true - stereo.measurement[:, 2:]).min(axis=1)
    return float(np.mean(error <= _PRECISION_PX))


_BEHIND = 1.05  # times the rendered depth, plus the next: what is farther off is hidden
_BEHIND_M = 0.05


@dataclass(frozen=True, slots=True)
class Sighted:
    """How many landmarks are truly in view of a pose; -1 where that is not known.

    Attributes:
        visible: in all images, not too near and not too small for the rig, and not hidden.
        familiar: of these, seen from a direction from which they were seen before.
    """

    visible: int = -1
    familiar: int = -1


class TrueSights:
    """Counts the landmarks in view of true poses, by the database's own expectation."""

    def __init__(
        self,
        saved: SavedMap,
        landmarks: LandmarkMap,
        sequence: Sequence,
        frontend: FrontendSettings,
    ) -> None:
        """Of ``landmarks``, those of the map that count; of a recording without depth nothing."""
        self._sequence = sequence if isinstance(sequence, TrueDepth) else None
        self._landmarks = landmarks
        self._rig = sequence.rig
        self._database: LandmarkDatabase | None = None
        if self._sequence is not None:
            largest = frontend.stereo.largest_disparity_px
            self._database = LandmarkDatabase(sequence.rig, frontend.database, largest)
            self._database.load(saved)

    def of(self, i: int, wTc: FloatArray) -> Sighted:
        """In the selected frame ``i``, whose true pose in the map's world is ``wTc``."""
        if self._sequence is None or self._database is None or not np.isfinite(wTc).all():
            return Sighted()
        rig, depth = self._rig, self._sequence.depth(i)
        expected = self._database.expected(self._landmarks, wTc)
        column, row, disparity = expected.measurement.T
        rise = 0.0
        if rig.vertical_baseline is not None:
            rise = disparity * (rig.fy * rig.vertical_baseline) / (rig.fx * rig.baseline)
        inside = (column >= 0.0) & (column + disparity <= rig.width - 1.0)
        inside &= (row >= 0.0) & (row + rise <= rig.height - 1.0)
        at = np.rint(np.column_stack([row, column])[inside]).astype(np.int64)
        near = depth[at[:, 0], at[:, 1]]
        shown = rig.fx * rig.baseline / disparity[inside] <= _BEHIND * near + _BEHIND_M
        familiar = shown & expected.certain[inside]
        return Sighted(int(shown.sum()), int(familiar.sum()))


_SAME_TIME_S = 1e-3
_MOST_SLACK_RAD = 0.5  # of positions whose errors are all made of it: at most, not likely


@dataclass(frozen=True, slots=True, eq=False)
class TruthInMap:
    """True poses of a recording's frames in the map's world.

    Attributes:
        poses: (n, 4, 4) of the selected frames; NaN where unknown.
        alignment: how the two worlds were brought together, in words.
    """

    poses: FloatArray
    alignment: str


def truth_in_map(saved: SavedMap, sequence: Sequence, config: ExperimentConfig) -> TruthInMap:
    """True poses in the map's world, as far as they can be known.

    Of rendered places exactly, since the map's world is where its first drive began. Of recordings
    on disk if the map's last drive was part of the same one: by the rigid motion (SE3, least
    squares over positions) that brings the truth of that drive to the map's own trajectory.

    Args:
        saved: the map.
        sequence: the recording.
        config: what it was opened with.
    """
    unknown = np.full((len(sequence), 4, 4), np.nan)
    if sequence.ground_truth is None:
        return TruthInMap(unknown, "the recording has no ground truth")
    drives = saved.about.get("drives") or [{}]
    if isinstance(config.dataset, RenderedLabSettings):
        return _of_rendered(_drive_config(drives[0]), sequence, config) or TruthInMap(
            unknown, "the map is of another place, so errors are not known"
        )
    mapped = _drive_config(drives[-1])
    aligned = None if mapped is None else _of_recorded(saved, mapped, sequence, config)
    if aligned is None:
        return TruthInMap(unknown, "the map is of another recording, so errors are not known")
    mTw, matched, slack = aligned
    if slack > _MOST_SLACK_RAD:
        words = "the map's drive is too straight to lay the truth onto it, so errors are not known"
        return TruthInMap(unknown, words)
    times, true_rows = associate(
        sequence.timestamps, sequence.ground_truth.timestamps, _SAME_TIME_S
    )
    unknown[times] = mTw @ sequence.ground_truth.poses[true_rows]
    words = f"truth aligned to the map's trajectory, SE3 over {matched} poses"
    return TruthInMap(unknown, words)


def _drive_config(drive: object) -> ExperimentConfig | None:
    """What a map's drive was opened with; None where this fgslam cannot tell."""
    if not isinstance(drive, dict) or not isinstance(drive.get("settings"), dict):
        return None
    try:
        values = {"name": "map", **drive["settings"]}
        return parse(ExperimentConfig, values, "map")
    except FgslamError:
        return None


def _of_rendered(
    mapped: ExperimentConfig | None, sequence: Sequence, config: ExperimentConfig
) -> TruthInMap | None:
    """Both worlds are camera poses in one room."""
    from fgslam.datasets.rendered import RenderedLabSequence, first_camera_pose  # scipy's, slow

    now, then = config.dataset, None if mapped is None else mapped.dataset
    if not isinstance(now, RenderedLabSettings) or not isinstance(then, RenderedLabSettings):
        return None
    if not isinstance(sequence, RenderedLabSequence) or now.place != then.place:
        return None
    own = sequence.room_from_world @ sequence.ground_truth.poses
    words = "truth in the world of the map's first frame, exactly"
    return TruthInMap(inverse(first_camera_pose(then)) @ own, words)


def _of_recorded(
    saved: SavedMap, mapped: ExperimentConfig, sequence: Sequence, config: ExperimentConfig
) -> tuple[FloatArray, int, float] | None:
    """(4, 4) from the truth's world to the map's, how many poses it was found from, its slack."""
    now, then = (getattr(one.dataset, "path", None) for one in (config, mapped))
    if now is None or then is None or Path(now).resolve() != Path(then).resolve():
        return None
    try:
        truth = open_sequence(mapped).ground_truth
    except FgslamError:
        return None
    if truth is None:
        return None
    rows, true_rows = associate(saved.trajectory.timestamps, truth.timestamps, _SAME_TIME_S)
    true, own = truth.poses[true_rows], saved.trajectory.poses[rows]
    mTw = align(true, own)
    if mTw is None:
        return None
    return mTw, len(rows), alignment_slack(transform_to_world(mTw, true[:, :3, 3]), own[:, :3, 3])


def alignment_slack(aligned: FloatArray, own: FloatArray) -> float:
    """By how much aligned positions (n, 3) may yet turn about the line that they lie along.

    Radians: what is left between them and ``own`` (n, 3), over how far they stray from that line;
    infinite where they do not. Of a straight drive's positions no alignment knows the roll.
    """
    spread = np.linalg.svd(own - own.mean(axis=0), compute_uv=False)[1]
    left = np.linalg.norm(aligned - own)
    return float(left / spread) if spread > 0.0 else np.inf
