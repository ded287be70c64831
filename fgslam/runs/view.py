"""A run shown moment by moment: as a film, or in the rerun viewer, ended or under way."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from itertools import islice
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from fgslam.cameras.omni import unit_rays
from fgslam.core.arrays import FloatArray, Image, IntArray, thinned
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
from fgslam.core.sensors import CAMERA_NAMES, Increment, moved_pixels, vertical_of
from fgslam.core.types import EgoMotionStatus, LandmarkMap, Trajectory
from fgslam.datasets.omni import OmniRecording
from fgslam.datasets.opening import open_omni
from fgslam.datasets.video import require_film_suffix, write_film
from fgslam.evaluation.statistics import to_estimate_world
from fgslam.homing.route import PathMemory
from fgslam.report.content import (
    COLOURS,
    ON_DARK,
    level_axes,
    read_table,
    records,
    world_position_covariances,
)
from fgslam.report.formats import read_ply
from fgslam.report.overlays import ROOM_PX, PathPicture, Plan, film_frame, route_frame
from fgslam.report.results import EstimatorReport, ReportData
from fgslam.runs.config import (
    Experiment,
    ExperimentConfig,
    FollowConfig,
    TeachConfig,
    as_task,
    load_experiment,
)
from fgslam.runs.export import (
    config_of,
    frames_of,
    log_of,
    moved_to,
    results_folder,
    rows_of_frames,
    sources_of,
)
from fgslam.runs.folder import RUN_MARKER, is_run_folder
from fgslam.runs.report import load_report
from fgslam.runs.tasks.routes import FOLLOW_FILE, ROUTE_FILE, recording_along
from fgslam.runs.tasks.slam import Watch
from fgslam.runs.tasks.slam_results import RunOutputs
from fgslam.runs.units import Progress
from fgslam.runs.wanted import Filmed
from fgslam.slam.pipeline import FrameReport

_MOST_FPS = 30.0


def film_of_run(
    run: Path,
    out: Path,
    shown: Filmed,
    progress: Progress,
    overwrite: bool = False,
    speed: float = 1.0,
    width: int = 1280,
) -> str:
    """Writes the film of a run, of SLAM or of a route that was followed; a line about it.

    The film runs ``speed`` times as fast as the recording, with at most 30 frames a second: of a
    faster one frames are left out.

    Args:
        run: what ``fgslam run`` or ``fgslam follow`` wrote.
        out: the file, .mp4 or .gif.
        shown: whose path and map, or which pictures.
        progress: called with what is done, how far, of how much.
        overwrite: replace a file that is there.
        speed: of the film over the recording's.
        width: of a frame, pixels.

    Raises:
        FgslamError: no run of cameras there, its recording is gone, or the film cannot be written.
    """
    require_film_suffix(out)
    taught, given = shown.taught, [path for path in (shown.taught, shown.recording) if path]
    require_output(out, overwrite, (*sources_of(run), *given))
    moved = moved_to(shown.recording)
    if is_run_folder(run) and isinstance(
        config := load_experiment(run / RUN_MARKER, moved), FollowConfig
    ):
        if shown.estimator is not None:
            raise ConfigError(
                f"{run}: a route was followed, without estimators; leave out --estimator"
            )
        what, (times, frames) = "images", _film_of_following(run, config, taught)
    else:
        if taught is not None:
            raise ConfigError(f"{run}: no route was followed there; leave out --taught")
        what, (times, frames) = "poses", _film_of_slam(run, shown)
    fps = speed / median_step(times, what, run)
    step = math.ceil(fps / _MOST_FPS)

    def counted() -> Iterator[Image]:
        for done, frame in enumerate(islice(frames, 0, None, step)):
            yield frame
            progress("film", min(step * (done + 1), len(times)), len(times))

    return f"{out}: {write_film(out, counted(), fps / step, width)} frames"


def median_step(times: FloatArray, what: str, where: Path) -> float:
    """Seconds between two frames of a film of these times.

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
    return step


def _readable(read: Callable[[int], Any], number: int) -> Any:
    """What is read of an image; None where its file is missing or damaged."""
    try:
        return read(number)
    except FrameError:
        return None


# ------------------------------------------------------------------------------------------
# SLAM as a film: images with matches next to the growing map


def _film_of_slam(run: Path, shown: Filmed) -> tuple[FloatArray, Iterator[Image]]:
    """Path and landmarks are those known at the end; a landmark appears when first seen."""
    folder = run / results_folder(run, shown.estimator)
    trajectory, points = Trajectory.load(folder / "final.tum"), read_ply(folder / "map.ply")
    log, data = MeasurementLog.load(log_of(run)), load_report(run)
    frame_at, pictures, _ = frames_of(config_of(run, shown.recording), trajectory)
    plane = level_axes(data.up)[:2]
    above = points.positions @ plane.T
    truth = None if data.truth is None else data.truth.poses[:, :3, 3] @ plane.T
    plan = Plan(trajectory.poses[:, :3, 3] @ plane.T, above, truth, ROOM_PX, data.title)

    def frames() -> Iterator[Image]:
        seen = np.zeros(len(points), np.bool_)
        last: Increment | None = None
        for increment, row in zip(log, rows_of_frames(log, trajectory).tolist(), strict=True):
            if row < 0:
                continue
            now = increment.kept
            seen |= np.isin(points.ids, now.ids)
            before, after = moved_pixels(last, increment)
            seconds = increment.timestamp - log.timestamps[0]
            title = f"{seconds:.1f} s: {len(after)} matched"
            images = _readable(pictures, int(frame_at[row]))
            image = None if images is None else images[0]
            shown = before, after, now.measurement[now.is_new, :2]
            yield film_frame(plan, image, shown, title, above[seen], row)
            last = increment

    return trajectory.timestamps, frames()


# ------------------------------------------------------------------------------------------
# A route that was followed as a film: image, path image, homing vector and place

_BEAM = np.deg2rad(np.linspace(-60.0, 60.0, 121))  # elevations of the line towards home
_WHOLE = ("image", "path_image", "target")
_NUMBERS = (
    "time_s",
    "probability",
    "direction_deg",
    "sigma_direction_deg",
    "v_mps",
    "omega_deg_s",
    "to_target_m",
)
_TEXTS = ("name", "path_image_name", "inliers", "state", "refusal")

Row: TypeAlias = dict[str, Any]
"""An image of follow.csv: numbers as floats, NaN where they are not known; texts."""


def _film_of_following(
    run: Path, config: FollowConfig, taught: Path | None
) -> tuple[FloatArray, Iterator[Image]]:
    rows, path = follow_rows(run / FOLLOW_FILE), PathMemory.load(config.route)
    named = {(row["path_image"], row["path_image_name"]) for row in rows if row["path_image"] >= 0}
    if not named <= set(enumerate(path.names)):
        raise StoredMapError(
            f"{config.route}: was taught again since it was followed; follow it again"
        )
    recording = recording_along(config, path)
    driven = None if taught is None else _taught_recording(taught, path)
    camera = path.camera or recording.camera
    shown = []
    for name, remembered in zip(path.names, path.images, strict=True):
        image = None
        if driven is not None:
            image = _readable(driven.image, driven.names.index(name))
        pixels = camera.pixels(unit_rays(remembered.sift.bearing, remembered.sift.elevation))
        shown.append(PathPicture(name, (camera.width, camera.height), pixels, image))

    def frames() -> Iterator[Image]:
        places = {int(number): i for i, number in enumerate(recording.ids)}
        for row in rows:
            image = None
            if (at := places.get(int(row["image"]))) is not None:
                image = _readable(recording.image, at)
            # What lies ahead, and towards home.
            ahead, home = (
                recording.camera.pixels(unit_rays(np.full(len(_BEAM), bearing), _BEAM))
                for bearing in (0.0, np.deg2rad(row["direction_deg"]))
            )
            yield route_frame(shown, row, image, (ahead, home), command_text(row))

    return np.array([row["time_s"] for row in rows]), frames()


def follow_rows(table: Path) -> list[Row]:
    """Raises DatasetError where it is gone, damaged, or none that `fgslam follow` wrote."""
    again = "follow the route again"
    found = read_table(
        table, (*_WHOLE, *_NUMBERS), _TEXTS, known=("image", "time_s"), whole=_WHOLE, again=again
    )
    if not (rows := records(found)):
        raise DatasetError(f"{table}: holds no image that was followed; {again}")
    return rows


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


def command_text(row: Row) -> str:
    """Lines: speed, turn and metres; or why there is no homing vector."""
    if row["refusal"]:
        return str(row["refusal"])
    turn, metres = row["omega_deg_s"], row["to_target_m"]
    rate = f"{abs(turn):.0f}"
    side = "" if rate == "0" else ", left" if turn > 0.0 else ", right"
    lines = [
        f"v {row['v_mps']:.2f} m/s",
        f"omega {rate} degrees/s{side}",
        f"{row['inliers']} matches agree",
    ]
    if np.isfinite(metres):
        lines.append(f"{metres:.1f} m to path image {row['target']:.0f}")
    return "\n".join(lines)


# ------------------------------------------------------------------------------------------
# The viewer: a stream that goes to its window, to a file, or to both

Colour: TypeAlias = tuple[int, int, int]

SUFFIX = ".rrd"
TIMELINE = "time"
_WORLD = "world/first_camera"
_ELLIPSOIDS = 60
_SIGMAS = 3.0
# Three standard deviations of a centimetre are a speck; the smallest that can still be seen.
_LEAST_RADIUS_M = 1e-4
_BLOCK = 1024
"""Landmarks of one block: so many are sent again where one has moved."""
_MOVED_M = 1e-3  # the viewer shows rooms and streets
_PATH_BLOCK = 64
_JPEG_QUALITY = 75
_DOT, _NOW = 2.0, 6.0  # points of the screen: a landmark, where a path is now
WHITE, _KEPT, _REJECTED, _NEW = (235, 235, 235), (60, 220, 90), (255, 80, 80), (90, 170, 255)


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
    rerun = _library(save)
    if save is not None:
        require_output(save, overwrite, (run,))
    data = load_report(run, whole=True)
    live = save is None and _has_screen()
    target = None if live else save or run / f"view{SUFFIX}"
    with _streaming(rerun, data.title, live, target) as stream:
        _log(rerun, stream, data)
    if live:
        return f"{run}: opened in the viewer"
    return f"{target}: written; open it with: rerun {target}"


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
    if not isinstance(config, ExperimentConfig) or config.on_measurements:
        raise ConfigError(
            f"{config.name}: --live and --save-rrd show SLAM on images, and this is another task; "
            "leave them out"
        )
    rerun = _library(file)
    if live and not _has_screen():
        raise OutputError("--live needs a screen, and there is none; use --save-rrd FILE.rrd")
    with _streaming(rerun, config.name, live, file) as stream:
        yield Watcher(rerun, stream)


def _library(file: Path | None) -> Any:
    """The viewer's package. Raises MissingDependencyError; OutputError of another ending."""
    try:
        import rerun
    except ImportError:
        raise MissingDependencyError(
            "the viewer needs the package rerun-sdk; install it: pip install 'fgslam[viewer]'"
        ) from None
    if file is not None and file.suffix.lower() != SUFFIX:
        raise OutputError(f"cannot write {file}: the viewer opens {SUFFIX} files; use that ending")
    return rerun


def _has_screen() -> bool:
    """Whether a window can open: always but on a Linux without a display."""
    named = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return sys.platform != "linux" or bool(named)


@contextmanager
def _streaming(rerun: Any, name: str, live: bool, file: Path | None) -> Iterator[Any]:
    """A stream to the viewer, which it starts, to a file, or both. Raises OutputError."""
    stream = rerun.RecordingStream(f"fgslam {name}")
    if file is not None:
        remove_left_behind(file)
    with nullcontext() if file is None else replacing(file) as partial:
        if live:
            stream.spawn(connect=False)
        sinks = [rerun.GrpcSink()] if live else []
        stream.set_sinks(*sinks, *([] if partial is None else [rerun.FileSink(partial)]))
        try:
            yield stream
            try:
                stream.flush()
            except RuntimeError as error:
                if not live:  # else the user has closed the viewer before the end of the run
                    why = f"{error}; free some space or choose another folder"
                    raise OutputError(f"cannot write {file}: {why}") from error
        finally:
            stream.disconnect()


def _log_world(rerun: Any, stream: Any, up: FloatArray) -> None:
    """The axes: the world's own y axis points down, and the viewer turns about z."""
    stream.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    stream.log(_WORLD, rerun.Transform3D(mat3x3=level_axes(up)), static=True)


def half_axes(covariances: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Half axes (k, 3) of three sigma, and turns (k, 4) x y z w, of covariances (k, 3, 3)."""
    variances, axes = np.linalg.eigh(covariances)
    # Of the two handednesses that the axes may have, turns know one.
    axes[:, :, 0] *= np.where(np.linalg.det(axes) < 0.0, -1.0, 1.0)[:, None]
    half = _SIGMAS * np.sqrt(np.maximum(variances, (_LEAST_RADIUS_M / _SIGMAS) ** 2))
    turns = Rotation.from_matrix(axes).as_quat() if len(axes) else np.empty((0, 4))
    return half, turns


def _ellipsoids(rerun: Any, centres: FloatArray, covariances: FloatArray, colour: Colour) -> Any:
    half, turns = half_axes(covariances)
    return rerun.Ellipsoids3D(centers=centres, half_sizes=half, quaternions=turns, colors=[colour])


def rgb(colour: str) -> Colour:
    """Red, green and blue of #rrggbb."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue


# ------------------------------------------------------------------------------------------
# A run that has ended, in the viewer


def _log(rerun: Any, stream: Any, data: ReportData) -> None:
    _log_world(rerun, stream, data.up)
    if data.truth is not None:
        positions = data.truth.poses[:, :3, 3]
        line = rerun.LineStrips3D([positions], colors=[WHITE], labels=["truth"], show_labels=False)
        stream.log(f"{_WORLD}/truth", line, static=True)
    for i, estimator in enumerate(data.estimators):
        if len(estimator):
            _log_estimator(rerun, stream, estimator, rgb(ON_DARK[i % COLOURS]), data.start)
    for i, picture in enumerate(data.pictures):
        kind = "image/png" if picture.content.startswith(b"\x89PNG") else "image/jpeg"
        image = rerun.EncodedImage(contents=picture.content, media_type=kind)
        stream.log(f"pictures/{i:02d}", image, static=True)
    for row, view in sorted(data.views.items()):
        stream.set_time(TIMELINE, duration=data.estimators[0].timestamps[row] - data.start)
        stream.log("view", rerun.EncodedImage(contents=view, media_type="image/jpeg"))
    captions = "\n".join(f"{i:02d}: {picture.caption}" for i, picture in enumerate(data.pictures))
    words = [data.title, data.subtitle, *data.notes, *data.remarks_of_all, captions]
    text = "\n\n".join(filter(None, (*words, data.config_yaml)))
    stream.log("about", rerun.TextDocument(text), static=True)
    # The map on the left; image, error with its band, consistency and words on the right.
    views = rerun.blueprint
    right = views.Vertical(
        views.Spatial2DView(origin="view", name="what the reference camera saw"),
        views.TimeSeriesView(origin="error_m", name="position error and three sigma (m)"),
        views.TimeSeriesView(origin="nees_per_dof", name="NEES per degree of freedom"),
        views.TextDocumentView(origin="about", name="about"),
    )
    layout = views.Horizontal(
        views.Spatial3DView(origin="world", name="map"), right, column_shares=[3, 2]
    )
    stream.send_blueprint(views.Blueprint(layout, collapse_panels=True))


def _log_estimator(
    rerun: Any, stream: Any, estimator: EstimatorReport, colour: Colour, start: float
) -> None:
    """Paths, landmarks and ellipsoids in space; curves over time where they are known."""
    place = ["world", "first_camera", estimator.title]
    for name, poses in (("final", estimator.final_poses), ("online", estimator.online_poses)):
        known = poses[np.isfinite(poses).all(axis=(1, 2)), :3, 3]
        if len(known) > 1:
            line = rerun.LineStrips3D([known], colors=[colour])
            stream.log([*place, name], line, static=True)
    if len(estimator.landmarks):
        radii = [rerun.Radius.ui_points(_DOT)]
        dots = rerun.Points3D(estimator.landmarks.positions, colors=[colour], radii=radii)
        stream.log([*place, "landmarks"], dots, static=True)
    centres, covariances = claimed_positions(estimator)
    if len(centres):
        shapes = _ellipsoids(rerun, centres, covariances, colour)
        stream.log([*place, "three_sigma"], shapes, static=True)
    seconds = estimator.timestamps - start
    now = rerun.new_entity_path([*place, "now"])
    style = rerun.Points3D.from_fields(colors=[colour], radii=[rerun.Radius.ui_points(_NOW)])
    stream.log(now, style, static=True)
    places = rerun.Points3D.columns(positions=estimator.final_poses[:, :3, 3])
    stream.send_columns(now, [rerun.TimeColumn(TIMELINE, duration=seconds)], places)
    claimed = _SIGMAS * estimator.position_sigma_m
    for name, part, values, width in (
        ("error_m", "", estimator.final_error_m, 2.0),
        ("error_m", ", three sigma", claimed, 0.7),
        ("online_error_m", "", estimator.online_error_m, 2.0),
        ("nees_per_dof", "", estimator.nees, 2.0),
        ("update_ms", "", estimator.update_ms, 2.0),
    ):
        if (there := np.isfinite(values)).any():
            title = f"{estimator.title}{part}"
            entity = rerun.new_entity_path([name, title])
            style = rerun.SeriesLines(colors=[colour], names=[title], widths=[width])
            stream.log(entity, style, static=True)
            times = rerun.TimeColumn(TIMELINE, duration=seconds[there])
            columns = rerun.Scalars.columns(scalars=values[there])
            stream.send_columns(entity, [times], columns)


def claimed_positions(estimator: EstimatorReport) -> tuple[FloatArray, FloatArray]:
    """Positions (k, 3) and their covariances (k, 3, 3) in the world, of poses evenly spread."""
    known = np.flatnonzero(np.isfinite(estimator.covariances).all(axis=(1, 2)))
    rows = known[thinned(len(known), _ELLIPSOIDS)]
    poses = estimator.final_poses[rows]
    return poses[:, :3, 3], world_position_covariances(poses, estimator.covariances[rows])


# ------------------------------------------------------------------------------------------
# A run under way, in the viewer

_ESTIMATE = rgb(ON_DARK[0])


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
        rerun, stream, increment, stats = self._rerun, self._stream, report.increment, report.stats
        if self._start is None:
            self._begin(outputs)
            self._start = increment.timestamp
        stream.set_time(TIMELINE, duration=increment.timestamp - self._start)
        stream.set_time("frame", sequence=increment.index)
        if not self._truth_sent:
            self._send_truth(outputs)
        self._send_images(outputs, report)
        self._send_pose(stats.wTc, stats.covariance)
        self._send_map(outputs.pipeline.estimator.landmarks(), increment)
        for name, value in (
            ("numbers/matched", int(report.tracking.inliers.sum())),
            ("numbers/landmarks", stats.landmarks),
            ("sigma_m", float(np.sqrt(np.trace(stats.covariance[3:, 3:])))),
        ):
            stream.log(name, rerun.Scalars([value]))
        status = report.tracking.status
        sound = status.measured or status is EgoMotionStatus.FIRST
        text = rerun.TextLog(status_line(report), level="INFO" if sound else "WARN")
        stream.log("status", text)

    def _begin(self, outputs: RunOutputs) -> None:
        """What does not change: the world's axes, the cameras, how the parts are laid out."""
        rerun, stream, rig = self._rerun, self._stream, outputs.sequence.rig
        _log_world(rerun, stream, vertical_of(rig.bTc))
        lens = rerun.Pinhole(focal_length=[rig.fx, rig.fy], width=rig.width, height=rig.height)
        stream.log(f"{_WORLD}/camera", lens, static=True)
        of = {"numbers/matched": _KEPT, "numbers/landmarks": _ESTIMATE, "sigma_m": _REJECTED}
        for name, colour in of.items():
            style = rerun.SeriesLines(colors=[colour], names=[name.removeprefix("numbers/")])
            stream.log(name, style, static=True)
        views = rerun.blueprint
        images = [
            views.Spatial2DView(origin=f"cameras/{name}", name=name)
            for name in CAMERA_NAMES[: rig.cameras]
        ]
        # The map on the left; images, numbers and status on the right.
        layout = views.Horizontal(
            views.Spatial3DView(origin="world", name="map"),
            views.Vertical(
                views.Horizontal(*images),
                views.TimeSeriesView(origin="numbers", name="landmarks matched, and in the map"),
                views.TimeSeriesView(origin="sigma_m", name="sigma of the position (m)"),
                views.TextLogView(origin="status", name="status"),
            ),
        )
        stream.send_blueprint(views.Blueprint(layout, collapse_panels=True))
        self._path = [pose[:3, 3] for pose in outputs.recorder.online_poses[:-1]]

    def _send_truth(self, outputs: RunOutputs) -> None:
        """The true path, once a frame has shown where it lies in the run's world."""
        truth, stamps = outputs.sequence.ground_truth, outputs.recorder.log.timestamps
        if truth is None:
            return
        online = Trajectory(stamps, np.array(outputs.recorder.online_poses))
        if (placed := to_estimate_world(online, truth)) is None:
            return
        rows, poses = placed
        first = np.searchsorted(truth.timestamps, stamps[rows[0]])
        eTt = poses[0] @ np.linalg.inv(truth.poses[first])
        line = self._rerun.LineStrips3D([(eTt @ truth.poses)[:, :3, 3]], colors=[WHITE])
        self._stream.log(f"{_WORLD}/truth", line, static=True)
        self._truth_sent = True

    def _send_images(self, outputs: RunOutputs, report: FrameReport) -> None:
        """Each camera's image with what was seen in it; in the first the paths of the landmarks."""
        rerun, stream = self._rerun, self._stream
        images = () if report.found.frame is None else report.found.frame.images
        for name, image in zip(CAMERA_NAMES, images, strict=False):
            stream.log(f"cameras/{name}", rerun.Image(image).compress(jpeg_quality=_JPEG_QUALITY))
        radii = [rerun.Radius.ui_points(_DOT)]
        for k, name in enumerate(CAMERA_NAMES[: outputs.sequence.rig.cameras]):
            pixels, colours = seen_pixels(report.increment, k)
            dots = rerun.Points2D(pixels, colors=colours, radii=radii)
            stream.log(f"cameras/{name}/seen", dots)
        increments = outputs.recorder.log.increments
        earlier = increments[-2] if len(increments) > 1 else None
        ways = np.stack(moved_pixels(earlier, report.increment), axis=1)
        stream.log("cameras/right/ways", rerun.LineStrips2D(ways, colors=[_KEPT]))

    def _send_pose(self, wTc: FloatArray, covariance: FloatArray) -> None:
        rerun, stream = self._rerun, self._stream
        self._path.append(wTc[:3, 3])
        camera = rerun.Transform3D(translation=wTc[:3, 3], mat3x3=wTc[:3, :3])
        stream.log(f"{_WORLD}/camera", camera)
        block = (len(self._path) - 1) // _PATH_BLOCK
        # From the last point of the block before, so that the line has no gaps.
        strip = np.array(self._path[max(0, block * _PATH_BLOCK - 1) :])
        line = rerun.LineStrips3D([strip], colors=[_ESTIMATE])
        stream.log(f"{_WORLD}/path/{block:04d}", line)
        claimed = world_position_covariances(wTc[None], covariance[None])
        if np.isfinite(claimed).all():
            shape = _ellipsoids(rerun, wTc[None, :3, 3], claimed, _ESTIMATE)
            stream.log(f"{_WORLD}/three_sigma", shape)

    def _send_map(self, landmarks: LandmarkMap, increment: Increment) -> None:
        rerun, stream = self._rerun, self._stream
        radii = [rerun.Radius.ui_points(_DOT)]
        for block, positions in self._map.of(landmarks):
            dots = rerun.Points3D(positions, colors=[_ESTIMATE], radii=radii)
            stream.log(f"{_WORLD}/landmarks/{block:04d}", dots)
        seen = landmarks.select(np.isin(landmarks.ids, increment.kept.ids))
        seen = seen.select(np.flatnonzero(np.isfinite(seen.covariances).all(axis=(1, 2))))
        shapes = _ellipsoids(rerun, seen.positions, seen.covariances, _KEPT)
        stream.log(f"{_WORLD}/landmarks_three_sigma", shapes)


class ChangedBlocks:
    """Which blocks of a map, of neighbouring identities, have changed since they were shown."""

    def __init__(self) -> None:
        self._shown: dict[int, tuple[IntArray, FloatArray]] = {}

    def of(self, landmarks: LandmarkMap) -> Iterator[tuple[int, FloatArray]]:
        """Number and positions (k, 3) of each block with a landmark more, less or moved."""
        numbers = landmarks.ids // _BLOCK
        for number in sorted({*np.unique(numbers).tolist(), *self._shown}):
            rows = np.flatnonzero(numbers == number)
            ids, positions = landmarks.ids[rows], landmarks.positions[rows]
            shown = self._shown.get(number)
            same = shown is not None and np.array_equal(shown[0], ids)
            if shown is None or not same or not (np.abs(shown[1] - positions) < _MOVED_M).all():
                self._shown[number] = ids, positions
                yield number, positions


def seen_pixels(increment: Increment, camera: int) -> tuple[FloatArray, IntArray]:
    """Raw pixels (k, 2) of the observations in one camera's image, and colours (k, 3) by fate."""
    seen = increment.observations
    colours = np.where(seen.is_new[:, None], _NEW, _KEPT)
    colours = np.where(increment.rejected[:, None], _REJECTED, colours)
    pixels = seen.pixels[:, camera]
    there = np.isfinite(pixels).all(axis=1)
    return pixels[there], colours[there]


def status_line(report: FrameReport) -> str:
    """How the frame was placed, in words."""
    increment, inliers = report.increment, report.tracking.inliers
    loops = sum(report.stats.closed)
    parts = [
        f"{int(inliers.sum())} of {len(inliers)} matches agree",
        f"{int(increment.observations.is_new.sum())} new",
        f"{report.stats.landmarks} landmarks",
        f"{loops} loop closed" if loops else "",
        report.found.problem,
    ]
    place = f"frame {increment.index} {report.tracking.status.value}"
    return f"{place}: {', '.join(filter(None, parts))}"
