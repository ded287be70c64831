"""Hands a run's results to other tools, from the files of its run folder."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from scipy.spatial import cKDTree

from fgslam.core.arrays import BoolArray, ByteArray, FloatArray, Image, IntArray
from fgslam.core.errors import ConfigError, DatasetError, FrameError
from fgslam.core.files import clear_output_errors, require_output, write_bytes
from fgslam.core.geometry import pose, triangulate, triangulation_covariance
from fgslam.core.log import MeasurementLog
from fgslam.core.saved_map import SavedMap, load_map
from fgslam.core.sensors import (
    CAMERA_NAMES,
    CameraRig,
    Increment,
    Observations,
    pixel_model,
    vertical_to_horizontal,
)
from fgslam.core.types import Trajectory, read_covariances
from fgslam.datasets.images import encoded_png
from fgslam.datasets.opening import open_recording
from fgslam.datasets.settings import MeasurementDatasetSettings, RenderedLabSettings
from fgslam.report.content import read_metrics
from fgslam.report.formats import (
    MCAP_SUFFIX,
    ImageModel,
    MapPoints,
    PoseLandmarkGraph,
    read_ply,
    require_graph_suffix,
    write_colmap,
    write_g2o,
    write_map,
    write_mcap,
)
from fgslam.runs.config import ExperimentConfig, load_config, load_experiment, read_mapping
from fgslam.runs.folder import LOG_FILE, RUN_MARKER, is_run_folder
from fgslam.runs.opening import open_sequence
from fgslam.runs.session import drives_of, points_of, remark_of_map, valid_of


@dataclass(frozen=True, slots=True)
class Wanted:
    """What to export: files and folders to write, None where not asked for.

    Attributes:
        map: landmarks, `.ply` or `.pcd`.
        trajectory: poses, `.tum`, `.kitti`, `.csv` (EuRoC) or `.mcap` (ROS 2).
        graph: measurements, poses and landmarks, `.g2o`.
        images: folder for images with poses and points, for COLMAP.
        estimator: whose; None for the one that steered.
        valid_only: only landmarks that were seen often enough to be trusted.
        colour: the map in the images' colours, with normals.
        overwrite: replace files that are there.
    """

    map: Path | None = None
    trajectory: Path | None = None
    graph: Path | None = None
    images: Path | None = None
    estimator: str | None = None
    valid_only: bool = False
    colour: bool = False
    overwrite: bool = False

    @property
    def targets(self) -> tuple[Path | None, ...]:
        """All that may be written."""
        return self.map, self.trajectory, self.graph, self.images

    @property
    def needs_run(self) -> bool:
        """Whether something is asked for that a saved map does not hold."""
        return self.colour or (self.graph, self.images, self.estimator) != (None, None, None)


def export_run(run: Path, wanted: Wanted) -> list[str]:
    """Writes what was asked for; returns a line about each file.

    Of a saved map in place of a run, it says what is in it where nothing is asked for.

    Raises:
        FgslamError: nothing asked for, no run there, or an ending that is not known.
    """
    _require_outputs(run, wanted)
    if run.is_file():
        if wanted.needs_run:
            raise ConfigError(
                f"{run}: a saved map has landmarks and a trajectory, no other estimators, graph or "
                "images; give --map or --trajectory, or a run folder"
            )
        return export_map(run, wanted.map, wanted.trajectory, wanted.valid_only)
    folder = run / results_folder(run, wanted.estimator)
    if not any(wanted.targets):
        raise ConfigError(
            "nothing to export; give --map FILE.ply, --trajectory FILE.tum, --graph FILE.g2o or "
            "--images FOLDER"
        )
    if wanted.graph is not None:
        require_graph_suffix(wanted.graph)  # now, not after seconds of reading
    remark = read_metrics(run / "metrics.json").get("remark") or ""
    lines = [f"note: {remark}"] if remark else []
    return [*lines, *_export(run, folder, wanted, remark)]


def _require_outputs(run: Path, wanted: Wanted) -> None:
    """Nothing of the run is replaced, nor of what it was made from. Raises OutputError."""
    inputs = sources_of(run)
    for path in filter(None, (wanted.map, wanted.trajectory, wanted.graph)):
        require_output(path, wanted.overwrite, inputs)
    if wanted.images is not None:
        require_output(wanted.images, wanted.overwrite, inputs, folder=True)


def sources_of(run: Path) -> tuple[Path, ...]:
    """A run or a saved map, and what that was made from as far as it says so."""
    if not is_run_folder(run):
        return (run,)
    return (run, *load_experiment(run / RUN_MARKER).inputs)


def _export(run: Path, folder: Path, wanted: Wanted, remark: str) -> Iterator[str]:
    trajectory = Trajectory.load(folder / "final.tum")
    if (path := wanted.trajectory) is not None:
        covariances = None
        if path.suffix.lower() == MCAP_SUFFIX:
            covariances = read_covariances(folder / "covariance.csv")[1]
        _save(path, trajectory, covariances, remark)
        yield f"{path}: {len(trajectory)} poses"
    if not (wanted.graph or wanted.colour or wanted.images or wanted.map):
        return
    points, log = read_ply(folder / "map.ply"), cache(lambda: MeasurementLog.load(log_of(run)))
    if wanted.graph is not None:
        yield export_graph(wanted.graph, log(), trajectory, points, remark)
    points = points.select(points.valid) if wanted.valid_only else points
    if wanted.colour or wanted.images:
        config = load_config(run / RUN_MARKER)
        points, line = export_images(wanted.images, config, log(), trajectory, points)
        yield from filter(None, [line])
    if wanted.map is not None:
        write_map(wanted.map, points, remark)
        yield f"{wanted.map}: {len(points)} landmarks"


def _save(path: Path, trajectory: Trajectory, covariances: FloatArray | None, remark: str) -> None:
    if path.suffix.lower() == MCAP_SUFFIX:
        write_mcap(path, trajectory, covariances)
    else:
        trajectory.save(path, remark)


def log_of(run: Path) -> Path:
    """The measurements: of a comparison, which has none of its own, those of the run above it."""
    own, above = run / LOG_FILE, run.resolve().parent / LOG_FILE
    return above if above.is_file() and not own.is_file() else own


def results_folder(run: Path, wanted: str | None) -> str:
    """Name of the folder with an estimator's results in a run; None is the one that steered.

    Raises:
        FgslamError: no run of SLAM there, no results yet, or another estimator.
    """
    if not is_run_folder(run):
        raise DatasetError(f"{run}: not a run folder (no config.yaml); give what fgslam run wrote")
    if (task := read_mapping(run / RUN_MARKER).get("task")) is not None:
        raise DatasetError(
            f"{run}: is a run of task {task}, not of SLAM: it has no map, trajectory or graph to "
            f"export; take its tables and arrays as they are: {', '.join(_plain_files(run))}"
        )
    found = sorted(path.parent.name for path in run.glob("*/final.tum"))
    if not found:
        raise DatasetError(f"{run}: holds no results yet; resume the run first")
    if wanted is None and len(found) == 1:
        return found[0]
    chosen = wanted or load_config(run / RUN_MARKER).estimator.title  # the one that steered
    if chosen not in found:
        raise ConfigError(
            f"{run}: no estimator {chosen!r}; give --estimator with one of {', '.join(found)}"
        )
    return chosen


def _plain_files(run: Path) -> list[str]:
    """The files of a run that other programs read without an export, as one would name them."""
    found = [path.name for pattern in ("*.csv", "*.npz", "*.json") for path in run.glob(pattern)]
    return sorted(found) + (["logs/*.npz"] if any(run.glob("logs/*.npz")) else [])


def export_map(
    path: Path, map_file: Path | None, trajectory_file: Path | None, valid_only: bool
) -> list[str]:
    """Writes what was asked for, or says what is in the map; a line about each.

    Raises:
        MapError: it is not one.
        OutputError: a file cannot be written, or its ending is not known.
    """
    saved = load_map(path)
    if map_file is None and trajectory_file is None:
        return describe_map(saved, path)
    remark = remark_of_map(saved)
    lines = [f"note: {remark}"] if remark else []
    if map_file is not None:
        points = points_of(saved)
        points = points.select(points.valid) if valid_only else points
        write_map(map_file, points, remark)
        lines.append(f"{map_file}: {len(points)} landmarks")
    if trajectory_file is not None:
        _save(trajectory_file, saved.trajectory, None, remark)
        lines.append(f"{trajectory_file}: {len(saved.trajectory)} poses")
    return lines


def describe_map(saved: SavedMap, path: Path) -> list[str]:
    """What is in a map, and where it comes from."""
    rig, size, valid = saved.rig, path.stat().st_size, valid_of(saved)
    lines = [
        f"{path}: {len(saved)} landmarks ({int(valid.sum())} valid, {int(saved.permanent.sum())} "
        f"permanent), {len(saved.appearances)} views, {size / 1e6:.2f} MB",
        f"cameras     {rig.cameras} of {rig.width} x {rig.height} pixels, baseline "
        f"{rig.baseline:g} m",
    ]
    if len(saved):
        trusted = saved.landmarks.positions[valid] if valid.any() else saved.landmarks.positions
        low, high = trusted.min(axis=0), trusted.max(axis=0)
        spans = (f"{a} {x:.2f} to {y:.2f}" for a, x, y in zip("xyz", low, high, strict=True))
        lines.append(f"bounds      {', '.join(spans)} m (x right, y down, z forward)")
    lines += [_about_drive(drive) for drive in drives_of(saved)]
    lines.append(f"trajectory  {len(saved.trajectory)} poses")
    return lines


def _about_drive(drive: dict[str, Any]) -> str:
    recording = drive.get("recording") or {}
    return (
        f"drive       {drive.get('name')}: {drive.get('frames')} frames of "
        f"{recording.get('name')}, {drive.get('estimator')}, fgslam {drive.get('fgslam')}"
    )


# --------------------------------------------------------------------------------------------
# A run as a graph for other solvers: its log's measurements around an estimator's final answer

_HEADER = (
    "poses wTc of the reference camera; x right, y down, z forward; metres",
    "information: g2o's error (translation, vector part of the quaternion), metres and half angles",
    "left out: observations that the run rejected, constraints of a floor, closures of loops, "
    "odometry to frames located anew",
    "vertices: the estimator's final answer, first pose held",
)


def export_graph(
    path: Path, log: MeasurementLog, trajectory: Trajectory, points: MapPoints, remark: str = ""
) -> str:
    """Writes a log's measurements around an estimator's final answer, as .g2o.

    Observations become points with their first-order covariance.

    Args:
        path: the file.
        log: the run's measurements.
        trajectory: an estimator's final poses.
        points: its landmarks.
        remark: put into a comment.

    Returns:
        A line about what was written.

    Raises:
        OutputError: another ending, or it cannot be written.
    """
    graph = build_graph(log, trajectory, points.ids, points.positions)
    write_g2o(path, graph, [*([remark] if remark else []), *_HEADER])
    left_out = sum(len(increment.observations) for increment in log) - len(graph.points)
    return (
        f"{path}: {len(graph.poses)} poses, {len(graph.landmarks)} landmarks, "
        f"{len(graph.motions)} odometry edges, {len(graph.points)} observations "
        f"({left_out} rejected ones left out)"
    )


def build_graph(
    log: MeasurementLog, trajectory: Trajectory, ids: IntArray, positions: FloatArray
) -> PoseLandmarkGraph:
    """The graph of a log: all that was measured and not rejected.

    Args:
        log: the measurements.
        trajectory: poses to start from; frames of the log that have none are left out.
        ids: (m,) landmarks of the map, ascending. Those never seen are left out; those seen and
            not in the map start where their first observation puts them.
        positions: (m, 3) world, metres.
    """
    rows = rows_of_frames(log, trajectory)
    kept = [_usable(increment) & (row >= 0) for increment, row in zip(log, rows, strict=True)]
    seen = [s.observations.select(keep) for s, keep in zip(log, kept, strict=True)]
    measurement = np.concatenate([np.empty((0, 3)), *(o.measurement for o in seen)])
    covariance = np.concatenate([np.empty((0, 3, 3)), *(o.covariance for o in seen)])
    seen_ids = np.concatenate([np.empty(0, np.int64), *(o.ids for o in seen)])
    used, first, landmark = np.unique(seen_ids, return_index=True, return_inverse=True)
    seen_from = np.repeat(rows, [len(o) for o in seen])
    points = triangulate(log.rig, measurement)
    start = _in_world(trajectory.poses[seen_from[first]], points[first])
    mapped = np.isin(used, ids)
    start[mapped] = positions[np.searchsorted(ids, used[mapped])]
    moved = [
        (rows[k - 1], rows[k], increment.odometry)
        for k, increment in enumerate(log)
        # A frame found anew after being carried off: its odometry does not know of that.
        if k
        and increment.odometry is not None
        and not increment.relocalised
        and min(rows[k - 1], rows[k]) >= 0
    ]
    return PoseLandmarkGraph(
        poses=trajectory.poses,
        landmarks=start,
        motion_from=np.array([a for a, _, _ in moved], np.int64),
        motion_to=np.array([b for _, b, _ in moved], np.int64),
        motions=np.array([o.motion for _, _, o in moved]).reshape(-1, 4, 4),
        motion_covariances=np.array([o.covariance for _, _, o in moved]).reshape(-1, 6, 6),
        seen_from=seen_from,
        seen=landmark.reshape(-1),
        points=points,
        point_covariances=triangulation_covariance(log.rig, measurement, covariance),
    )


def _usable(increment: Increment) -> BoolArray:
    """Observations (k,) that were not rejected and have a place."""
    # The third number is disparity or range: only a positive one is that of a point.
    return ~increment.rejected & (increment.observations.measurement[:, 2] > 0.0)


def _in_world(wTc: FloatArray, points: FloatArray) -> FloatArray:
    """Points (n, 3), each of its own camera (n, 4, 4)."""
    return np.asarray(np.einsum("nij,nj->ni", wTc[:, :3, :3], points) + wTc[:, :3, 3])


Pictures: TypeAlias = Callable[[int], tuple[Image, ...]]
"""Images (right, left[, top]) of a selected frame, grey or in red, green, blue."""


_NEIGHBOURS = 12  # through which a plane is laid: three would fit any plane, many round off edges


def export_images(
    folder: Path | None,
    config: ExperimentConfig,
    log: MeasurementLog,
    trajectory: Trajectory,
    points: MapPoints,
) -> tuple[MapPoints, str]:
    """Writes rectified images, `sparse/0` for COLMAP.

    The recording's images are read again, once. A frame whose images cannot be read stays in the
    model, without files.

    Returns:
        The map in the images' colours, with normals; and a line about the folder, empty where
        there is none.

    Raises:
        FgslamError: the run has no images, its recording is gone, or a file cannot be written.
    """
    rows, pictures = frames_of(config, trajectory)
    model = build_model(log, trajectory, points)
    tints = Tints(len(model.ids))
    missing = sum(
        not _take(model, k, shown, folder, tints) for k, shown in enumerate(_read(rows, pictures))
    )
    points = with_normals(tints.on(points, model), model)
    if folder is None:
        return points, ""
    model = replace(model, colours=points.colours[np.searchsorted(points.ids, model.ids)])
    write_colmap(_made(folder / "sparse" / "0"), model)
    return points, _about(folder, model, missing)


def _about(folder: Path, model: ImageModel, missing: int) -> str:
    error = float(model.point_errors().mean()) if len(model.ids) else 0.0
    lacking = f", {missing} frames without readable images" if missing else ""
    return (
        f"{folder}: {len(model.names)} images, {len(model.ids)} points, mean reprojection error "
        f"{error:.3f} px{lacking}"
    )


def _made(folder: Path) -> Path:
    with clear_output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    return folder


# --------------------------------------------------------------------------------------------
# The model


def build_model(log: MeasurementLog, trajectory: Trajectory, points: MapPoints) -> ImageModel:
    """Every camera's image of every located frame, and where the map's points were seen in it.

    Args:
        log: the measurements; rejected ones and those not in the map are left out.
        trajectory: poses of the reference camera.
        points: the map, ascending by identity.
    """
    rig, parts = log.rig, []
    for increment, row in zip(log, rows_of_frames(log, trajectory).tolist(), strict=True):
        if row >= 0:
            kept = increment.observations.select(~increment.rejected)
            parts.append(_seen_in(row, kept.select(np.isin(kept.ids, points.ids)), rig))
    empty = np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2))
    image, ids, pixels = (np.concatenate(column) for column in zip(empty, *parts, strict=True))
    used, point = np.unique(ids, return_inverse=True)
    of_map, order = np.searchsorted(points.ids, used), np.lexsort((point, image))
    return ImageModel(
        rig=rig,
        names=tuple(
            f"{camera}/{row:06d}.png"
            for row in range(len(trajectory))
            for camera in CAMERA_NAMES[: rig.cameras]
        ),
        poses=_camera_poses(rig, trajectory.poses),
        ids=used,
        positions=points.positions[of_map],
        colours=points.colours[of_map],
        image=image[order],
        point=point[order],
        pixels=pixels[order],
    )


def rows_of_frames(log: MeasurementLog, trajectory: Trajectory) -> IntArray:
    """(n,) row of the trajectory for each frame of a log, -1 where it has no pose."""
    row_of = {round(t, 9): row for row, t in enumerate(trajectory.timestamps.tolist())}
    return np.array([row_of.get(round(s.timestamp, 9), -1) for s in log], np.int64)


def _seen_in(row: int, seen: Observations, rig: CameraRig) -> tuple[IntArray, IntArray, FloatArray]:
    """Images (k,), identities (k,) and pixels (k, 2) of one frame's observations, all cameras.

    Pixels are what measurement and rig say together, where the camera saw the landmark at all.
    """
    model = pixel_model(rig.cameras, vertical_to_horizontal(rig))
    pixels = (seen.measurement @ model.T).reshape(len(seen), rig.cameras, 2)
    observation, camera = np.nonzero(np.isfinite(seen.pixels[:, : rig.cameras, 0]))
    return row * rig.cameras + camera, seen.ids[observation], pixels[observation, camera]


def _camera_poses(rig: CameraRig, wTc: FloatArray) -> FloatArray:
    """(n * cameras, 4, 4), camera after camera of each pose (n, 4, 4) of the reference camera."""
    steps = [
        (0.0, 0.0, 0.0),
        (-rig.baseline, 0.0, 0.0),
        (0.0, -(rig.vertical_baseline or 0.0), 0.0),
    ]
    cameras = [pose(np.eye(3), np.array(step)) for step in steps[: rig.cameras]]
    return (wTc[:, None] @ np.array(cameras)).reshape(-1, 4, 4)


# --------------------------------------------------------------------------------------------
# Images


def frames_of(config: ExperimentConfig, trajectory: Trajectory) -> tuple[IntArray, Pictures]:
    """Frame of the recording for each pose, and its images.

    Raises:
        FgslamError: the run has no images, or its recording is gone or another one.
    """
    dataset = config.dataset
    if isinstance(dataset, MeasurementDatasetSettings):
        raise DatasetError(f"a recording of kind {dataset.kind} has no images to export")
    if isinstance(dataset, RenderedLabSettings):
        sequence = open_sequence(config)
        stamps, pictures = sequence.timestamps, lambda i: sequence.frame(i).images
    else:
        recording = open_recording(dataset)
        stamps, pictures = recording.timestamps, recording.colour
    rows = np.searchsorted(stamps, trajectory.timestamps - 1e-9)
    if (rows >= len(stamps)).any() or np.abs(stamps[rows] - trajectory.timestamps).max() > 1e-6:
        raise DatasetError(
            f"the recording {dataset.path if hasattr(dataset, 'path') else dataset.kind} has other "
            "times than the run; give the run's own recording"
        )
    return rows, pictures


def _read(rows: IntArray, pictures: Pictures) -> Iterator[tuple[Image, ...] | None]:
    for row in rows.tolist():
        try:
            yield pictures(row)
        except FrameError:
            yield None


def _take(
    model: ImageModel,
    k: int,
    shown: tuple[Image, ...] | None,
    folder: Path | None,
    tints: Tints,
) -> bool:
    """Whether the images of pose ``k`` could be read; if so, they are written and sampled."""
    if shown is None:
        return False
    first = k * model.rig.cameras
    if folder is not None:
        for name, image in zip(model.names[first:], shown, strict=False):
            path = folder / "images" / name
            write_bytes(_made(path.parent) / path.name, encoded_png(image))
    tints.sample(model, first, shown[0])
    return True


class Tints:
    """Sums of what the reference camera's images show at the points (m) of a model."""

    def __init__(self, m: int) -> None:
        self._total, self._count = np.zeros((m, 3)), np.zeros(m)

    def sample(self, model: ImageModel, row: int, image: Image) -> None:
        """Adds the colours of one image of the model, where its points are seen."""
        own = slice(*np.searchsorted(model.image, [row, row + 1]))
        column, line = np.rint(model.pixels[own]).astype(np.int64).T
        inside = np.flatnonzero(
            (column >= 0) & (line >= 0) & (column < image.shape[1]) & (line < image.shape[0])
        )
        tints = image[line[inside], column[inside]].astype(np.float64)
        tints = tints.reshape(len(inside), image[0, 0].size)
        np.add.at(self._total, model.point[own][inside], tints)  # one channel serves all three
        np.add.at(self._count, model.point[own][inside], 1.0)

    def on(self, points: MapPoints, model: ImageModel) -> MapPoints:
        """The map in mean colours; landmarks that no readable image shows keep their grey."""
        seen = self._count > 0.0
        colours: ByteArray = points.colours.copy()
        of_map = np.searchsorted(points.ids, model.ids[seen])
        colours[of_map] = np.rint(self._total[seen] / self._count[seen, None])
        return replace(points, colours=colours)


def with_normals(points: MapPoints, model: ImageModel) -> MapPoints:
    """The map with normals: of the plane through each landmark's neighbours, towards the camera.

    The camera is the first that saw the landmark; of a landmark that none saw, the first of all.
    """
    if len(points) <= _NEIGHBOURS:
        return points
    near = cKDTree(points.positions).query(points.positions, _NEIGHBOURS)[1]
    around = points.positions[near]
    around = around - around.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][:, :, 0]
    seen, first = np.unique(model.point, return_index=True)
    cameras = np.tile(model.poses[0, :3, 3], (len(points), 1))
    of_map = np.searchsorted(points.ids, model.ids[seen])
    cameras[of_map] = model.poses[model.image[first], :3, 3]
    towards = np.einsum("ni,ni->n", normals, cameras - points.positions)
    return replace(points, normals=np.where(towards[:, None] < 0.0, -normals, normals))
