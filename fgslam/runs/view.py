"""Runs in the rerun viewer: one that has ended, and one under way."""

from __future__ import annotations

import csv
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from fgslam.cameras.omni import OmniCamera, unit_rays
from fgslam.core.arrays import FloatArray, Image, IntArray
from fgslam.core.errors import (
    ConfigError,
    DatasetError,
    FrameError,
    MissingDependencyError,
    OutputError,
    StoredMapError,
)
from fgslam.core.files import remove_left_behind, replacing, require_output
from fgslam.core.log import MeasurementLog
from fgslam.core.sensors import CameraRig, Increment, moved_pixels, vertical_of
from fgslam.core.types import EgoMotionStatus, LandmarkMap, Trajectory
from fgslam.datasets.film_files import require_film_suffix, write_film
from fgslam.datasets.omni import OmniRecording
from fgslam.datasets.opening import open_omni
from fgslam.evaluation.statistics import to_estimate_world
from fgslam.homing.route import PathMemory
from fgslam.report.content import COLOURS, ON_DARK, level_axes, thinned, world_position_covariances
from fgslam.report.formats import MapPoints, read_ply
from fgslam.report.pictures import FilmCanvas, Moment, PathPicture, RouteCanvas, RouteMoment
from fgslam.report.results import EstimatorReport, ReportData
from fgslam.runs.config import (
    Experiment,
    ExperimentConfig,
    FollowConfig,
    TeachConfig,
    as_task,
    load_config,
    load_experiment,
)
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
from fgslam.runs.tasks.routes import FOLLOW_FILE, ROUTE_FILE, recording_along
from fgslam.runs.tasks.slam import Watch
from fgslam.runs.tasks.slam_results import RunOutputs
from fgslam.slam.pipeline import FrameReport

# ------------------------------------------------------------------------------------------
# A run as a film: images with matches beside the growing map, or a route that was followed

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


Colour: TypeAlias = tuple[int, int, int]

SUFFIX = ".rrd"
TIMELINE = "time"
_ELLIPSOIDS = 60
_SIGMAS = 3.0
WHITE = (235, 235, 235)
# Three standard deviations of a centimetre are a speck; the smallest that can still be seen.
_LEAST_RADIUS_M = 1e-4


def view_run(run: Path, save: Path | None, overwrite: bool = False) -> str:
    """Opens a run in the viewer, or saves it for the viewer where there is no screen.

    Args:
        run: what `fgslam run` or `fgslam compare` wrote.
        save: the .rrd file to write instead of opening a window; None for a window, or on a
            machine without a screen for ``view.rrd`` in ``run``.
        overwrite: replace the file ``save`` where it is there.

    Returns:
        A line about what was done.

    Raises:
        MissingDependencyError: the viewer's package is not installed.
        FgslamError: there are no results, a file is damaged, or writing failed.
    """
    rerun = library()
    if save is not None:
        require_ending(save)
        require_output(save, overwrite, (run,))
    data = load_report(run)
    stream = rerun.RecordingStream(f"fgslam {data.title}")
    if save is None and has_screen():
        stream.spawn()
        _log(rerun, stream, data)
        stream.flush()
        return f"{run}: opened in the viewer"
    target = save or run / f"view{SUFFIX}"
    with replacing(target) as partial:
        stream.save(partial)
        _log(rerun, stream, data)
        stream.flush()
        stream.disconnect()
    return f"{target}: written; open it with: rerun {target}"


def library() -> Any:
    """The viewer's package. Raises MissingDependencyError."""
    try:
        import rerun
    except ImportError:
        raise MissingDependencyError(
            "the viewer needs the package rerun-sdk; install it: pip install 'fgslam[viewer]'"
        ) from None
    return rerun


def require_ending(file: Path) -> None:
    """Raises OutputError where the viewer's file has another ending."""
    if file.suffix.lower() != SUFFIX:
        raise OutputError(f"cannot write {file}: the viewer opens {SUFFIX} files; use that ending")


def has_screen() -> bool:
    """Whether a window can open: always but on a Linux without a display."""
    named = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return sys.platform != "linux" or bool(named)


# --------------------------------------------------------------------------------------------
# What is logged


def _log(rerun: Any, stream: Any, data: ReportData) -> None:
    # The world's own y axis points down; the viewer turns about z.
    stream.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    level = rerun.Transform3D(mat3x3=level_axes(data.up))
    stream.log("world/first_camera", level, static=True)
    if data.truth is not None:
        positions = data.truth.poses[:, :3, 3]
        line = rerun.LineStrips3D([positions], colors=[WHITE], labels=["truth"], show_labels=False)
        stream.log("world/first_camera/truth", line, static=True)
    for i, estimator in enumerate(data.estimators):
        if len(estimator):
            colour = rgb(ON_DARK[i % COLOURS])
            _log_scene(rerun, stream, estimator, colour)
            _log_numbers(rerun, stream, estimator, colour, data.start)
    for i, picture in enumerate(data.pictures):
        image = rerun.EncodedImage(contents=picture.content, media_type=_media(picture.content))
        stream.log(f"pictures/{i:02d}", image, static=True)
    captions = "\n".join(f"{i:02d}: {picture.caption}" for i, picture in enumerate(data.pictures))
    stream.log("about", rerun.TextDocument(_about(data, captions)), static=True)


def _about(data: ReportData, captions: str) -> str:
    remarks = [f"{e.title}: {line}" for e in data.estimators for line in e.remarks]
    remarks += [f"{e.title} failed: {e.failure}" for e in data.estimators if e.failure]
    parts = [data.title, data.subtitle, *data.notes, *remarks, captions, data.config_yaml]
    return "\n\n".join(filter(None, parts))


def _log_scene(rerun: Any, stream: Any, estimator: EstimatorReport, colour: Colour) -> None:
    place = ["world", "first_camera", estimator.title]
    for name, poses in (("final", estimator.final_poses), ("online", estimator.online_poses)):
        known = poses[np.isfinite(poses).all(axis=(1, 2)), :3, 3]
        if len(known) > 1:
            line = rerun.LineStrips3D([known], colors=[colour])
            stream.log([*place, name], line, static=True)
    if len(estimator.landmarks):
        dots = rerun.Points3D(estimator.landmarks.positions, colors=[colour], radii=[0.01])
        stream.log([*place, "landmarks"], dots, static=True)
    centres, half_sizes, quaternions = ellipsoids(estimator)
    if len(centres):
        shapes = ellipsoid_shapes(rerun, centres, half_sizes, quaternions, colour)
        stream.log([*place, "three_sigma"], shapes, static=True)


def ellipsoids(estimator: EstimatorReport) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Centres (k, 3), half axes (k, 3) of three sigma, and turns (k, 4) x y z w, evenly spread."""
    covariances = estimator.covariances
    known = np.flatnonzero(np.isfinite(covariances).all(axis=(1, 2)))
    rows = known[thinned(len(known), _ELLIPSOIDS)]
    poses = estimator.final_poses[rows]
    half, turns = half_axes(world_position_covariances(poses, covariances[rows]))
    return poses[:, :3, 3], half, turns


def ellipsoid_shapes(
    rerun: Any, centres: FloatArray, half: FloatArray, turns: FloatArray, colour: Colour
) -> Any:
    """Ellipsoids (k) as the viewer draws them."""
    return rerun.Ellipsoids3D(centers=centres, half_sizes=half, quaternions=turns, colors=[colour])


def half_axes(covariances: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Half axes (k, 3) of three sigma, and turns (k, 4) x y z w, of covariances (k, 3, 3)."""
    variances, axes = np.linalg.eigh(covariances)
    # Of the two handednesses that the axes may have, turns know one.
    axes[:, :, 0] *= np.where(np.linalg.det(axes) < 0.0, -1.0, 1.0)[:, None]
    half = _SIGMAS * np.sqrt(np.maximum(variances, (_LEAST_RADIUS_M / _SIGMAS) ** 2))
    turns = Rotation.from_matrix(axes).as_quat() if len(axes) else np.empty((0, 4))
    return half, turns


def _log_numbers(
    rerun: Any,
    stream: Any,
    estimator: EstimatorReport,
    colour: Colour,
    start: float,
) -> None:
    """Curves over time; frames whose value is not known are left out."""
    for name, values in (
        ("error_m", estimator.final_error_m),
        ("online_error_m", estimator.online_error_m),
        ("nees_per_dof", estimator.nees),
        ("update_ms", estimator.update_ms),
    ):
        known = np.isfinite(values)
        if not known.any():
            continue
        style = rerun.SeriesLines(colors=[colour], names=[estimator.title])
        place = rerun.new_entity_path([name, estimator.title])
        stream.log(place, style, static=True)
        stream.send_columns(
            place,
            [rerun.TimeColumn(TIMELINE, duration=estimator.timestamps[known] - start)],
            rerun.Scalars.columns(scalars=values[known]),
        )


def _media(picture: bytes) -> str:
    return "image/png" if picture.startswith(b"\x89PNG") else "image/jpeg"


def rgb(colour: str) -> Colour:
    """Red, green and blue of #rrggbb."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue


_CAMERAS = ("right", "left", "top")
_BLOCK = 1024
"""Landmarks of one block: so many are sent again where one has moved."""
_MOVED_M = 1e-3  # the viewer shows rooms and streets
_PATH_BLOCK = 64
_JPEG_QUALITY = 75
_ESTIMATE = rgb(ON_DARK[0])
_KEPT, _REJECTED, _NEW = (60, 220, 90), (255, 80, 80), (90, 170, 255)
_DOT = 2.0  # points of the screen


@contextmanager
def watched(config: Experiment, live: bool, file: Path | None) -> Iterator[Watch]:
    """What a run of ``config`` is to call after each frame.

    Args:
        config: what is run.
        live: open the viewer.
        file: .rrd file to write for the viewer, whole when the context ends without error; None
            for a viewer alone.

    Raises:
        ConfigError: such a run has no images and no path to watch.
        MissingDependencyError: the viewer's package is not installed.
        OutputError: there is no screen to watch on, or the file cannot be written.
    """
    rerun = _usable(config, live, file)
    stream = rerun.RecordingStream(f"fgslam {config.name}")
    if file is not None:
        remove_left_behind(file)
    with nullcontext() if file is None else replacing(file) as partial:
        _connect(rerun, stream, live, partial)
        try:
            yield Watcher(rerun, stream)
            _flush(stream, live, file)
        finally:
            stream.disconnect()


def _connect(rerun: Any, stream: Any, live: bool, file: Path | None) -> None:
    """To the viewer, which it starts, to a file, or both."""
    if live:
        stream.spawn(connect=False)
    sinks = [rerun.GrpcSink()] if live else []
    stream.set_sinks(*sinks, *([] if file is None else [rerun.FileSink(file)]))


def _flush(stream: Any, live: bool, file: Path | None) -> None:
    """Sends what is left. Raises OutputError."""
    try:
        stream.flush()
    except RuntimeError as error:
        if not live:
            why = f"{error}; free some space or choose another folder"
            raise OutputError(f"cannot write {file}: {why}") from error
        # Somebody has closed the viewer before the end of the run, as he may.


def _usable(config: Experiment, live: bool, file: Path | None) -> Any:
    """The viewer's package; refuses before anything is run what cannot be shown."""
    if not isinstance(config, ExperimentConfig) or config.on_measurements:
        raise ConfigError(
            f"{config.name}: --live and --save-rrd show SLAM on images, and this is another task; "
            "leave them out"
        )
    rerun = library()
    if file is not None:
        require_ending(file)
    if live and not has_screen():
        raise OutputError("--live needs a screen, and there is none; use --save-rrd FILE.rrd")
    return rerun


class Watcher:
    """Sends frames to the viewer."""

    def __init__(self, rerun: Any, stream: Any) -> None:
        """``rerun`` is the package, ``stream`` one of its recording streams."""
        self._rerun, self._stream = rerun, stream
        self._map = ChangedBlocks()
        self._path: list[FloatArray] = []
        self._start: float | None = None
        self._truth_sent = False

    def __call__(self, outputs: RunOutputs, report: FrameReport) -> None:
        """Sends the frame that ``outputs`` has just taken in."""
        stream, increment = self._stream, report.increment
        if self._start is None:
            self._begin(outputs)
            self._start = increment.timestamp
        stream.set_time(TIMELINE, duration=increment.timestamp - self._start)
        stream.set_time("frame", sequence=increment.index)
        if not self._truth_sent:
            self._send_truth(outputs)
        self._send_images(outputs, report)
        self._send_pose(report)
        self._send_map(outputs.pipeline.estimator.landmarks(), increment)
        self._send_numbers(report)

    def _begin(self, outputs: RunOutputs) -> None:
        """What does not change: the world's axes, the cameras, how the parts are laid out."""
        rerun, stream, rig = self._rerun, self._stream, outputs.sequence.rig
        stream.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        level = rerun.Transform3D(mat3x3=level_axes(vertical_of(rig.bTc)))
        stream.log("world/first_camera", level, static=True)
        lens = rerun.Pinhole(focal_length=[rig.fx, rig.fy], width=rig.width, height=rig.height)
        stream.log("world/first_camera/camera", lens, static=True)
        for name, colour in (("matched", _KEPT), ("landmarks", _ESTIMATE), ("sigma_m", _REJECTED)):
            style = rerun.SeriesLines(colors=[colour], names=[name])
            stream.log(f"numbers/{name}", style, static=True)
        stream.send_blueprint(_layout(rerun, rig))
        self._path = [pose[:3, 3] for pose in outputs.recorder.online_poses[:-1]]

    def _send_truth(self, outputs: RunOutputs) -> None:
        """The true path, once a frame has told where it lies in the run's world."""
        truth = outputs.sequence.ground_truth
        if truth is None:
            return
        recorder = outputs.recorder
        stamps = recorder.log.timestamps
        placed = to_estimate_world(Trajectory(stamps, np.array(recorder.online_poses)), truth)
        if placed is None:
            return
        rows, poses = placed
        known = truth.poses
        eTt = poses[0] @ np.linalg.inv(known[np.searchsorted(truth.timestamps, stamps[rows[0]])])
        line = self._rerun.LineStrips3D([(eTt @ known)[:, :3, 3]], colors=[WHITE])
        self._stream.log("world/first_camera/truth", line, static=True)
        self._truth_sent = True

    def _send_images(self, outputs: RunOutputs, report: FrameReport) -> None:
        """Each camera's image with what was seen in it; in the first the ways of the landmarks."""
        rerun, stream = self._rerun, self._stream
        images = () if report.found.frame is None else report.found.frame.images
        for k, image in enumerate(images):
            stream.log(f"cameras/{_CAMERAS[k]}", _compressed(rerun, image))
        for k, name in enumerate(_CAMERAS[: outputs.sequence.rig.cameras]):
            pixels, colours = seen_pixels(report.increment, k)
            dots = rerun.Points2D(pixels, colors=colours, radii=[rerun.Radius.ui_points(_DOT)])
            stream.log(f"cameras/{name}/seen", dots)
        increments = outputs.recorder.log.increments
        earlier = increments[-2] if len(increments) > 1 else None
        ways = np.stack(moved_pixels(earlier, report.increment), axis=1)
        stream.log("cameras/right/ways", rerun.LineStrips2D(ways, colors=[_KEPT]))

    def _send_pose(self, report: FrameReport) -> None:
        rerun, stream, stats = self._rerun, self._stream, report.stats
        self._path.append(stats.wTc[:3, 3])
        pose = rerun.Transform3D(translation=stats.wTc[:3, 3], mat3x3=stats.wTc[:3, :3])
        stream.log("world/first_camera/camera", pose)
        block = (len(self._path) - 1) // _PATH_BLOCK
        # From the last point of the block before, so that the line has no gaps.
        strip = np.array(self._path[max(0, block * _PATH_BLOCK - 1) :])
        line = rerun.LineStrips3D([strip], colors=[_ESTIMATE])
        stream.log(f"world/first_camera/path/{block:04d}", line)
        covariance = world_position_covariances(stats.wTc[None], stats.covariance[None])
        if np.isfinite(covariance).all():
            shape = (stats.wTc[None, :3, 3], *half_axes(covariance), _ESTIMATE)
            stream.log("world/first_camera/three_sigma", ellipsoid_shapes(rerun, *shape))

    def _send_map(self, landmarks: LandmarkMap, increment: Increment) -> None:
        rerun, stream = self._rerun, self._stream
        radii = [rerun.Radius.ui_points(_DOT)]
        for block, positions in self._map.of(landmarks):
            dots = rerun.Points3D(positions, colors=[_ESTIMATE], radii=radii)
            stream.log(f"world/first_camera/landmarks/{block:04d}", dots)
        seen = landmarks.select(np.isin(landmarks.ids, increment.kept.ids))
        seen = seen.select(np.flatnonzero(np.isfinite(seen.covariances).all(axis=(1, 2))))
        shape = (seen.positions, *half_axes(seen.covariances), _KEPT)
        stream.log("world/first_camera/landmarks_three_sigma", ellipsoid_shapes(rerun, *shape))

    def _send_numbers(self, report: FrameReport) -> None:
        rerun, stream, stats = self._rerun, self._stream, report.stats
        values = {
            "matched": int(report.tracking.inliers.sum()),
            "landmarks": stats.landmarks,
            "sigma_m": float(np.sqrt(np.trace(stats.covariance[3:, 3:]))),
        }
        for name, value in values.items():
            stream.log(f"numbers/{name}", rerun.Scalars([value]))
        level = "INFO" if is_sound(report) else "WARN"
        stream.log("status", rerun.TextLog(status_line(report), level=level))


def _layout(rerun: Any, rig: CameraRig) -> Any:
    """The map on the left; images, numbers and status on the right."""
    views = rerun.blueprint
    images = [
        views.Spatial2DView(origin=f"cameras/{name}", name=name) for name in _CAMERAS[: rig.cameras]
    ]
    return views.Blueprint(
        views.Horizontal(
            views.Spatial3DView(origin="world", name="map"),
            views.Vertical(
                views.Horizontal(*images),
                views.TimeSeriesView(origin="numbers", name="numbers"),
                views.TextLogView(origin="status", name="status"),
            ),
        ),
        collapse_panels=True,
    )


def _compressed(rerun: Any, image: Image) -> Any:
    return rerun.Image(image).compress(jpeg_quality=_JPEG_QUALITY)


# --------------------------------------------------------------------------------------------
# What is sent, as plain arrays


@dataclass(slots=True)
class ChangedBlocks:
    """Which blocks of a map, of neighbouring identities, have changed since they were shown."""

    _shown: dict[int, tuple[IntArray, FloatArray]] = field(default_factory=dict)

    def of(self, landmarks: LandmarkMap) -> Iterator[tuple[int, FloatArray]]:
        """Number and positions (k, 3) of each block with a landmark more, less or moved."""
        numbers, begins = np.unique(landmarks.ids // _BLOCK, return_index=True)
        parts = zip(
            numbers.tolist(),
            np.split(landmarks.ids, begins[1:]),
            np.split(landmarks.positions, begins[1:]),
            strict=False,  # of no landmarks NumPy makes one part
        )
        now = {number: (ids, positions) for number, ids, positions in parts}
        gone = {
            number: (np.empty(0, np.int64), np.empty((0, 3))) for number in self._shown.keys() - now
        }
        for number, (ids, positions) in sorted((now | gone).items()):
            if not self._is_shown(number, ids, positions):
                self._shown[number] = ids, positions.copy()
                yield number, positions

    def _is_shown(self, number: int, ids: IntArray, positions: FloatArray) -> bool:
        if number not in self._shown:
            return False
        shown, places = self._shown[number]
        return np.array_equal(shown, ids) and bool((np.abs(places - positions) < _MOVED_M).all())


def seen_pixels(increment: Increment, camera: int) -> tuple[FloatArray, IntArray]:
    """Raw pixels (k, 2) of the observations in one camera's image, and colours (k, 3) by fate."""
    seen = increment.observations
    colours = np.where(seen.is_new[:, None], _NEW, _KEPT)
    colours = np.where(increment.rejected[:, None], _REJECTED, colours)
    pixels = seen.pixels[:, camera]
    there = np.isfinite(pixels).all(axis=1)
    return pixels[there], colours[there]


def is_sound(report: FrameReport) -> bool:
    """Whether the frame's pose was measured, or is the first."""
    status = report.tracking.status
    return status.measured or status is EgoMotionStatus.FIRST


def status_line(report: FrameReport) -> str:
    """How the frame was placed, in words."""
    increment, inliers = report.increment, report.tracking.inliers
    parts = [
        f"frame {increment.index} {report.tracking.status.value}",
        f"{int(inliers.sum())} of {len(inliers)} matches agree",
        f"{int(increment.observations.is_new.sum())} new",
        f"{report.stats.landmarks} landmarks",
    ]
    loops = sum(report.stats.closed)
    parts += [f"{loops} loop closed"] if loops else []
    parts += [report.found.problem] if report.found.problem else []
    return ": ".join((parts[0], ", ".join(parts[1:])))
