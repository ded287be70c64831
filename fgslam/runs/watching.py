"""A run while it is under way, in the rerun viewer or in a file for it.

Each frame shows the cameras' images with what was matched, the camera with the ellipsoid of its
position, the landmarks that it sees with theirs, the map, the path and the status. What does not
change is not sent again: the map and the path go out in blocks, a block when it changes. Nothing is
asked of the run that it would not do by itself; its results are the same bytes.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.core.arrays import FloatArray, Image, IntArray
from fgslam.core.errors import ConfigError, OutputError
from fgslam.core.estimates import EgoMotionStatus, LandmarkMap, Trajectory
from fgslam.core.files import remove_left_behind, replacing
from fgslam.core.measurements import Increment, moved_pixels
from fgslam.core.sensors import CameraRig, vertical_of
from fgslam.evaluation.trajectory import to_estimate_world
from fgslam.report.content import ON_DARK, level_axes, world_position_covariances
from fgslam.runs.config_models import Experiment, ExperimentConfig
from fgslam.runs.tasks.slam import Watch
from fgslam.runs.tasks.slam_outputs import RunOutputs
from fgslam.runs.viewing import (
    TIMELINE,
    WHITE,
    ellipsoid_shapes,
    half_axes,
    has_screen,
    library,
    require_ending,
    rgb,
)
from fgslam.slam.pipeline import FrameReport

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
