"""A run as a film: the camera's images with the matches, beside the map as it grows.

Of a route that was followed: :mod:`fgslam.runs.route_film`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from fgslam.core.arrays import FloatArray, Image, IntArray
from fgslam.core.errors import ConfigError, DatasetError, FrameError
from fgslam.core.files import require_output
from fgslam.core.measurement_log import MeasurementLog
from fgslam.core.measurements import Increment, moved_pixels
from fgslam.core.trajectories import Trajectory
from fgslam.datasets.film_files import require_film_suffix, write_film
from fgslam.report.content import level_axes
from fgslam.report.pictures.film import FilmCanvas, Moment
from fgslam.report.point_cloud import MapPoints, read_ply
from fgslam.runs.config import load_config, load_experiment
from fgslam.runs.config_models import FollowConfig
from fgslam.runs.exporting import log_of, results_folder, sources_of
from fgslam.runs.exporting_images import Pictures, frames_of, rows_of_frames
from fgslam.runs.folder import RUN_MARKER, is_run_folder
from fgslam.runs.report import load_report
from fgslam.runs.route_film import Followed

_MOST_FPS = 30.0
Progress = Callable[[str, int, int], None]


def film_of_run(
    run: Path,
    out: Path,
    estimator: str | None,
    taught: Path | None,
    progress: Progress,
    overwrite: bool = False,
) -> str:
    """Writes the film of a run, of SLAM or of a route that was followed; a line about it.

    The film runs as fast as the recording, at most 30 frames a second.

    Args:
        run: what ``fgslam run`` or ``fgslam follow`` wrote.
        out: the file, .mp4 or .gif.
        estimator: whose path and map; None for the one that steered.
        taught: what ``fgslam teach`` wrote, for the pictures of path images; None: their features.
        progress: called with what is done, how far, of how much.
        overwrite: replace a file that is there.

    Raises:
        FgslamError: no run of cameras there, its recording is gone, or the film cannot be written.
    """
    require_film_suffix(out)
    require_output(out, overwrite, (*sources_of(run), *([] if taught is None else [taught])))
    if is_run_folder(run) and isinstance(config := load_experiment(run / RUN_MARKER), FollowConfig):
        if estimator is not None:
            raise ConfigError(
                f"{run}: a route was followed, without estimators; leave out --estimator"
            )
        return _film_of_following(run, Followed.of(run, config, taught), out, progress)
    if taught is not None:
        raise ConfigError(f"{run}: no route was followed there; leave out --taught")
    return _film_of_slam(run, out, estimator, progress)


def _film_of_following(run: Path, followed: Followed, out: Path, progress: Progress) -> str:
    total = len(followed.rows)
    fps = frame_rate(followed.times, "images", run)
    count = write_film(out, followed.frames(lambda done: progress("film", done, total)), fps)
    progress("film", total, total)
    return f"{out}: {count} frames"


def frame_rate(times: FloatArray, what: str, where: Path) -> float:
    """Frames a second of a film of these times.

    Raises:
        ConfigError: fewer than two times.
        DatasetError: most of them do not increase.
    """
    if len(times) < 2:
        raise ConfigError(f"{where}: has {len(times)} {what}; a film needs two at least")
    step = float(np.median(np.diff(times)))
    if not step > 0.0:
        raise DatasetError(
            f"{where}: the times of its {what} do not increase (median step {step:g} s), which "
            "gives no frame rate; run the recording again"
        )
    return min(_MOST_FPS, 1.0 / step)


def _film_of_slam(run: Path, out: Path, estimator: str | None, progress: Progress) -> str:
    """Path and landmarks are those known at the end; a landmark appears when first seen."""
    folder = run / results_folder(run, estimator)
    trajectory, points = Trajectory.load(folder / "final.tum"), read_ply(folder / "map.ply")
    log = MeasurementLog.load(log_of(run))
    fps = frame_rate(trajectory.timestamps, "poses", run)
    rows, pictures = frames_of(load_config(run / RUN_MARKER), trajectory)
    moments = _moments(log, rows_of_frames(log, trajectory), points, rows, pictures)
    data = load_report(run)
    plane = level_axes(data.up)[:2]
    truth = None if data.truth is None else data.truth.poses[:, :3, 3] @ plane.T
    above = points.positions @ plane.T
    canvas = FilmCanvas(trajectory.poses[:, :3, 3] @ plane.T, above, truth, data.title)
    total = len(trajectory)

    def frames() -> Iterator[Image]:
        for done, (row, moment, known) in enumerate(moments):
            progress("film", done, total)
            yield canvas.draw(moment, above[known], row)

    count = write_film(out, frames(), fps)
    progress("film", total, total)
    return f"{out}: {count} frames"


def _moments(
    log: MeasurementLog,
    pose_of: IntArray,
    points: MapPoints,
    rows: IntArray,
    pictures: Pictures,
) -> Iterator[tuple[int, Moment, IntArray]]:
    """Pose, what is seen there, and the rows of the map that are known by then."""
    seen = np.zeros(len(points), np.bool_)
    last: Increment | None = None
    began = log.timestamps[0] if len(log) else 0.0
    for increment, row in zip(log, pose_of.tolist(), strict=True):
        if row < 0:
            continue
        now = increment.kept
        seen |= np.isin(points.ids, now.ids)
        before, after = moved_pixels(last, increment)
        title = f"{increment.timestamp - began:.1f} s: {len(after)} matched"
        new = now.measurement[now.is_new, :2]
        yield (
            row,
            Moment(_image(pictures, int(rows[row])), before, after, new, title),
            np.flatnonzero(seen),
        )
        last = increment


def _image(pictures: Pictures, frame: int) -> Image | None:
    try:
        return pictures(frame)[0]
    except FrameError:
        return None
