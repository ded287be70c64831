"""The files of one estimator in a run folder, and what they are made from."""

from __future__ import annotations

import csv
import io
import typing
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import DatasetError
from fgslam.core.estimates import Estimate, LandmarkMap, Trajectory
from fgslam.core.files import make_subfolder, write_text
from fgslam.core.measurement_log import MeasurementLog
from fgslam.core.trajectories import write_covariances
from fgslam.report.content import write_csv
from fgslam.report.formats import MapPoints, write_ply
from fgslam.slam.noise_in_use import FrameNoise
from fgslam.slam.replay import Replay, ReplayRow

FRAMES_FILE = "frames.csv"
NOISE_TABLE = "noise.csv"
_VALUE: dict[str, Callable[[str], Any]] = typing.get_type_hints(ReplayRow)
"""What makes a cell's text a value again."""

_GREY = 128
_VALID_HITS = 3  # Se et al. 6.1, where no front-end's own number is known


def write_estimate(
    folder: Path, online: Trajectory, estimate: Estimate, points: MapPoints, remark: str
) -> None:
    """Trajectories, covariances and map into an estimator's folder. Raises OutputError."""
    online.save(folder / "online.tum", remark)
    estimate.trajectory.save(folder / "final.tum", remark)
    stamps = estimate.trajectory.timestamps
    write_covariances(folder / "covariance.csv", stamps, estimate.covariances, remark)
    write_ply(folder / "map.ply", points, remark)


def write_replay(
    run: Path, replay: Replay, log: MeasurementLog, remark: str, look: MapPoints | None
) -> None:
    """All files of a replay into ``run/<title>/``.

    Args:
        run: the folder above the estimator's.
        replay: what the estimator made of ``log``.
        log: where hits and misses of the landmarks are counted.
        remark: put into the files' comments.
        look: landmarks with the colours that the front-end saw, e.g. the live run's map; None
            where nothing was seen in colour.
    """
    folder = make_subfolder(run, replay.title)
    points = points_from_log(replay.estimate.landmarks, log, look)
    write_estimate(folder, replay.online, replay.estimate, points, remark)
    write_frames(folder / FRAMES_FILE, replay)
    write_noise(folder / NOISE_TABLE, replay.online.timestamps, replay.noise)


def write_noise(path: Path, timestamps: FloatArray, noise: Sequence[FrameNoise]) -> None:
    """Write noise.csv: time stamp, then a column for each name of :class:`FrameNoise`."""
    stamped = zip(timestamps.tolist(), noise, strict=True)
    rows = [(f"{stamp:.9f}", *values) for stamp, values in stamped]
    write_csv(path, ("timestamp", *FrameNoise._fields), rows)


def write_frames(path: Path, replay: Replay) -> None:
    """Write frames.csv: time stamp, then a column for each name of :class:`ReplayRow`."""
    lines = [",".join(("timestamp", *ReplayRow._fields))]
    for stamp, row in zip(replay.online.timestamps, replay.rows, strict=True):
        cells = [_cell(value) for value in row]
        lines.append(",".join((f"{stamp:.9f}", *cells)))
    write_text(path, "\n".join(lines) + "\n")


def read_frames(path: Path) -> list[ReplayRow]:
    """The rows of a frames.csv. Raises DatasetError where it is none."""
    try:
        rows = list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8"))))
        return [ReplayRow(**{name: _VALUE[name](row[name]) for name in _VALUE}) for row in rows]
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise DatasetError(
            f"{path}: not a frames.csv ({error}); run the experiment again"
        ) from error


def points_from_log(
    landmarks: LandmarkMap, log: MeasurementLog, look: MapPoints | None
) -> MapPoints:
    """The map with hits and misses as the log has them; colour and permanence as ``look`` has them.

    What is not in ``look`` is grey.
    """
    seen = [increment.observations.ids[~increment.rejected] for increment in log]
    hits = _counts(seen, landmarks.ids)
    colours = np.full((len(landmarks), 3), _GREY, np.uint8)
    permanent = np.zeros(len(landmarks), np.bool_)
    if look is not None:
        _, rows, of = np.intersect1d(landmarks.ids, look.ids, return_indices=True)
        colours[rows], permanent[rows] = look.colours[of], look.permanent[of]
    return MapPoints(
        ids=landmarks.ids,
        positions=landmarks.positions,
        covariances=landmarks.covariances,
        colours=colours,
        hits=hits,
        misses=_counts([increment.missed_ids for increment in log], landmarks.ids),
        valid=hits >= _VALID_HITS,
        permanent=permanent,
    )


def _counts(parts: list[IntArray], ids: IntArray) -> IntArray:
    """How often each of ``ids`` (ascending) occurs in all parts together."""
    found, counts = np.unique(np.concatenate([np.empty(0, np.int64), *parts]), return_counts=True)
    out = np.zeros(len(ids), np.int64)
    _, rows, of = np.intersect1d(ids, found, return_indices=True)
    out[rows] = counts[of]
    return out


def _cell(value: str | float) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
