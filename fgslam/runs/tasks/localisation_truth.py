"""The truth in a saved map's own world."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import FgslamError
from fgslam.core.geometry import inverse, pose, transform_to_world
from fgslam.core.recordings import Sequence
from fgslam.core.saved_map import SavedMap
from fgslam.datasets.rendered_lab import RenderedLabSequence, first_camera_pose
from fgslam.datasets.settings import RenderedLabSettings
from fgslam.evaluation.trajectory import align, associate
from fgslam.runs.config import ExperimentConfig
from fgslam.runs.config_reading import Reader
from fgslam.runs.opening import open_sequence

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
    if isinstance(sequence, RenderedLabSequence):
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
        return Reader(ExperimentConfig, ()).parse(values, "map")
    except FgslamError:
        return None


def _of_rendered(
    mapped: ExperimentConfig | None, sequence: RenderedLabSequence, config: ExperimentConfig
) -> TruthInMap | None:
    """Both worlds are camera poses in one room."""
    now = config.dataset
    if mapped is None or not isinstance(then := mapped.dataset, RenderedLabSettings):
        return None
    if not isinstance(now, RenderedLabSettings) or now.place != then.place:
        return None
    poses = (
        inverse(first_camera_pose(then)) @ sequence.room_from_world @ sequence.ground_truth.poses
    )
    return TruthInMap(poses, "truth in the world of the map's first frame, exactly")


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
    found = align(true, own)
    if found is None:
        return None
    mTw = pose(found.rotation, found.translation)
    return mTw, len(rows), alignment_slack(transform_to_world(mTw, true[:, :3, 3]), own[:, :3, 3])


def alignment_slack(aligned: FloatArray, own: FloatArray) -> float:
    """By how much aligned positions (n, 3) may yet turn about the line that they lie along.

    Radians: what is left between them and ``own`` (n, 3), over how far they stray from that line;
    infinite where they do not. Of a straight drive's positions no alignment knows the roll.
    """
    spread = np.linalg.svd(own - own.mean(axis=0), compute_uv=False)[1]
    left = np.linalg.norm(aligned - own)
    return float(left / spread) if spread > 0.0 else np.inf
