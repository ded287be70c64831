"""A run as a film: images with matches beside the growing map, or a route that was followed."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgslam.cameras.omni import OmniCamera, unit_rays
from fgslam.core.arrays import FloatArray, Image, IntArray
from fgslam.core.errors import ConfigError, DatasetError, FrameError, StoredMapError
from fgslam.core.files import require_output
from fgslam.core.measurement_log import MeasurementLog
from fgslam.core.measurements import Increment, moved_pixels
from fgslam.core.trajectories import Trajectory
from fgslam.datasets.film_files import require_film_suffix, write_film
from fgslam.datasets.omni import OmniRecording
from fgslam.datasets.opening import open_omni
from fgslam.homing.route import PathMemory
from fgslam.report.content import level_axes
from fgslam.report.formats import MapPoints, read_ply
from fgslam.report.pictures import FilmCanvas, Moment, PathPicture, RouteCanvas, RouteMoment
from fgslam.runs.config import as_task, load_config, load_experiment
from fgslam.runs.config_models import FollowConfig, TeachConfig
from fgslam.runs.export import (
    Pictures,
    frames_of,
    log_of,
    results_folder,
    rows_of_frames,
    sources_of,
)
from fgslam.runs.folder import RUN_MARKER, is_run_folder
from fgslam.runs.report import load_report
from fgslam.runs.tasks.route_following import FOLLOW_FILE, recording_along
from fgslam.runs.tasks.route_teaching import ROUTE_FILE

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


_BEAM = np.deg2rad(np.linspace(-60.0, 60.0, 121))  # elevations of the line towards home

Row = dict[str, str]

_NUMBERS: dict[str, type[int] | type[float]] = {
    "image": int,
    "time_s": float,
    "path_image": int,
    "probability": float,
    "target": int,
    "direction_deg": float,
    "sigma_direction_deg": float,
    "v_mps": float,
    "omega_deg_s": float,
    "to_target_m": float,
}
_NEEDED = (*_NUMBERS, "name", "path_image_name", "inliers", "state", "refusal")
_ALWAYS = frozenset({"image", "time_s"})  # the other numbers are empty where they are not known


@dataclass(frozen=True, eq=False)
class Followed:
    """What a film of a follow folder is made of.

    Attributes:
        rows: of follow.csv, an image each.
        path: the route.
        recording: its images.
        taught: the recording that the route was taught from; None where it is not given.
    """

    rows: tuple[Row, ...]
    path: PathMemory
    recording: OmniRecording
    taught: OmniRecording | None

    @staticmethod
    def of(run: Path, config: FollowConfig, taught: Path | None) -> Followed:
        """Opens what ``fgslam follow`` wrote into ``run``, and used.

        Args:
            run: the folder.
            config: its configuration.
            taught: what ``fgslam teach`` wrote of the same route; None: without.

        Raises:
            FgslamError: a file is gone, no table, or the route is another one since.
        """
        path = PathMemory.load(config.route)
        rows = follow_rows(run / FOLLOW_FILE)
        _require_same_route(rows, path, config.route)
        recording = recording_along(config, path)
        driven = None if taught is None else _taught_recording(taught, path)
        return Followed(rows, path, recording, driven)

    @property
    def times(self) -> FloatArray:
        """(n,) seconds, of the rows."""
        return np.array([float(row["time_s"]) for row in self.rows])

    def frames(self, progress: Callable[[int], None]) -> Iterator[Image]:
        """The film's frames; ``progress`` is told how many are done."""
        canvas = RouteCanvas([self._path_picture(k) for k in range(len(self.path))])
        places = {int(number): i for i, number in enumerate(self.recording.ids)}
        for done, row in enumerate(self.rows):
            progress(done)
            image = _route_image(self.recording, places.get(int(row["image"])))
            yield canvas.draw(_moment(row, image, self.recording.camera))

    def _path_picture(self, k: int) -> PathPicture:
        camera = self.path.camera or self.recording.camera
        name, sift = self.path.names[k], self.path.images[k].sift
        image = None
        if self.taught is not None:
            image = _route_image(self.taught, self.taught.names.index(name))
        pixels = camera.pixels(unit_rays(sift.bearing, sift.elevation))
        return PathPicture(name, (camera.width, camera.height), pixels, image)


def follow_rows(table: Path) -> tuple[Row, ...]:
    """Raises DatasetError where it is gone, damaged, or none that `fgslam follow` wrote."""
    try:
        with table.open(encoding="utf-8", newline="") as file:
            rows = tuple(csv.DictReader(file))
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{table}: cannot be read ({error}); follow the route anew") from error
    if not rows:
        raise DatasetError(f"{table}: holds no image that was followed; follow the route anew")
    lacking = [column for column in _NEEDED if column not in rows[0]]
    if lacking:
        raise DatasetError(f"{table}: lacks column {lacking[0]}; follow the route anew")
    for line, row in enumerate(rows, 2):
        _require_whole(f"{table}, line {line}", row)
    return rows


def _require_whole(place: str, row: Row) -> None:
    """Raises DatasetError unless each needed cell is there, and a number where one belongs."""
    for column in _NEEDED:
        text: str | None = row[column]  # None where the line ends before it
        if text is None:
            raise DatasetError(f"{place}: ends before column {column}; follow the route anew")
        kind = _NUMBERS.get(column)
        if kind is None or (not text and column not in _ALWAYS):
            continue
        try:
            known = bool(np.isfinite(kind(text)))
        except ValueError:
            known = False
        if not known:
            raise DatasetError(
                f"{place}: {column} is {text[:40]!r}, not a number; follow the route anew"
            )


def _require_same_route(rows: tuple[Row, ...], path: PathMemory, route: str) -> None:
    """Raises StoredMapError unless each named path image is at its place in the route."""
    named = {(int(row["path_image"]), row["path_image_name"]) for row in rows if row["path_image"]}
    if not named <= set(enumerate(path.names)):
        raise StoredMapError(f"{route}: was taught anew since it was followed; follow it again")


def _taught_recording(taught: Path, path: PathMemory) -> OmniRecording:
    """The recording of a teach folder. Raises ConfigError, or StoredMapError of another route."""
    if not is_run_folder(taught):
        raise ConfigError(f"{taught}: not a folder that fgslam teach wrote; give its --report")
    config = as_task(TeachConfig, load_experiment(taught / RUN_MARKER), str(taught))
    recording = open_omni(config.dataset)
    same = PathMemory.load(taught / ROUTE_FILE).names == path.names
    if not same or not set(path.names) <= set(recording.names):
        raise StoredMapError(f"{taught}: taught another route than the one that was followed")
    return recording


def _route_image(recording: OmniRecording, i: int | None) -> Image | None:
    """Picture ``i``; None where it is missing or damaged."""
    try:
        return None if i is None else recording.image(i)
    except FrameError:
        return None


def _moment(row: Row, image: Image | None, camera: OmniCamera) -> RouteMoment:
    direction = np.deg2rad(_number(row, "direction_deg"))
    nearest, target = _number(row, "path_image"), _number(row, "target")
    return RouteMoment(
        image=image,
        title=f"{row['name']} at {float(row['time_s']):.1f} s",
        nearest=int(nearest) if np.isfinite(nearest) else None,
        probability=_number(row, "probability"),
        target=int(target) if np.isfinite(target) else None,
        direction=float(direction),
        sigma=float(np.deg2rad(_number(row, "sigma_direction_deg"))),
        beam=_beam(camera, float(direction)),
        ahead=_beam(camera, 0.0),
        command=command_text(row),
        refused=bool(row["refusal"]) and row["state"] != "arrived",
    )


def _beam(camera: OmniCamera, bearing: float) -> FloatArray:
    """(m, 2) pixels in which the camera sees what lies in a direction; NaN where it does not."""
    return camera.pixels(unit_rays(np.full(len(_BEAM), bearing), _BEAM))


def command_text(row: Row) -> str:
    """Lines: speed, turn and metres; or why there is no homing vector."""
    if row["refusal"]:
        return row["refusal"]
    turn = _number(row, "omega_deg_s")
    rate = f"{abs(turn):.0f}"
    side = "" if rate == "0" else ", left" if turn > 0.0 else ", right"
    metres = _number(row, "to_target_m")
    return "\n".join(
        [
            f"v {_number(row, 'v_mps'):.2f} m/s",
            f"omega {rate} degrees/s{side}",
            f"{row['inliers']} matches agree",
            *([f"{metres:.1f} m to path image {row['target']}"] if np.isfinite(metres) else []),
        ]
    )


def _number(row: Row, column: str) -> float:
    return float(row[column]) if row.get(column) else float("nan")
