"""Hands a run's results to other tools, from the files of its run folder."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from fgslam.backend.settings import EstimatorSettings
from fgslam.backend.smoothers.graph import FactorGraph
from fgslam.core.arrays import ByteArray, FloatArray, Image, IntArray
from fgslam.core.errors import (
    ConfigError,
    DatasetError,
    EstimatorError,
    FrameError,
    OutputError,
)
from fgslam.core.files import clear_output_errors, require_output, write_bytes
from fgslam.core.log import ImageSequence, MeasurementLog
from fgslam.core.saved_map import SavedMap, load_map
from fgslam.core.sensors import (
    CAMERA_NAMES,
    CameraRig,
    body_is_camera,
    pixel_model,
    vertical_to_horizontal,
)
from fgslam.core.types import NO_LANDMARKS, Estimate, Trajectory, read_covariances
from fgslam.datasets.images import Depth, encoded_png
from fgslam.datasets.opening import open_recording
from fgslam.datasets.settings import MeasurementDatasetSettings, RenderedLabSettings
from fgslam.report.content import read_metrics
from fgslam.report.formats import (
    GRAPH,
    ImageModel,
    MapPoints,
    PoseLandmarkGraph,
    read_ply,
    require_suffix,
    write_colmap,
    write_g2o,
    write_map,
    write_trajectory,
)
from fgslam.report.surface import CLOUD, FREE, MESH, OCCUPIED
from fgslam.runs.config import ExperimentConfig, load_config, load_experiment, read_mapping
from fgslam.runs.dense import DenseMap, DenseSettings, Pictures, fuse, readers_of, rows_along
from fgslam.runs.folder import LOG_FILE, RUN_MARKER, is_run_folder
from fgslam.runs.opening import open_sequence
from fgslam.runs.session import drives_of, points_of, remark_of_map, valid_of
from fgslam.runs.tasks.slam_map_entry import arrival_of
from fgslam.runs.units import Progress
from fgslam.runs.wanted import Wanted
from fgslam.slam.build import chosen_estimator
from fgslam.slam.replay import replay


def export_run(
    run: Path, wanted: Wanted, progress: Progress = lambda what, done, total: None
) -> list[str]:
    """Writes what was asked for; returns a line about each file.

    Of a saved map in place of a run, it describes the map where nothing is asked for.

    Raises:
        FgslamError: nothing asked for, no run there, or an ending that is not known.
    """
    how = wanted.how
    _require_outputs(run, wanted)
    asked = bool(wanted.files or wanted.images)
    folder: Path | None = None  # of an estimator
    log = cache(lambda: MeasurementLog.load(log_of(run)))
    rig: Callable[[], CameraRig]
    if run.is_file():
        others = wanted.graph, wanted.images, wanted.estimator, wanted.recording
        if wanted.colour or wanted.is_dense or any(others):
            raise ConfigError(
                f"{run}: a saved map has landmarks and a trajectory, no other estimators, graph or "
                "images; give --map or --trajectory, or a run folder"
            )
        saved = load_map(run)
        if not asked:
            return describe_map(saved, run)
        remark, read, rig = remark_of_map(saved), partial(points_of, saved), lambda: saved.rig
        known = [drive.get("truth_frame") for drive in drives_of(saved)]
        trajectory = saved.trajectory.of((known and known[-1]) or "left", saved.rig)
    else:
        folder = run / results_folder(run, wanted.estimator)
        if not asked:
            raise ConfigError(
                "nothing to export; give --map FILE.ply, --trajectory FILE.tum, --graph FILE.g2o, "
                "--images FOLDER, --dense FILE.ply, --mesh FILE.ply or --grid FILE.yaml"
            )
        remark = read_metrics(run / "metrics.json").get("remark") or ""
        trajectory = Trajectory.load(folder / "final.tum")
        read, rig = partial(read_ply, folder / "map.ply"), lambda: log().rig
    lines = [f"note: {remark}"] if remark else []
    if wanted.trajectory is not None:
        covariances = np.full((len(trajectory), 6, 6), np.nan)
        if folder is not None and wanted.is_bag:
            covariances = read_covariances(folder / "covariance.csv")[1]
        found = Estimate(trajectory, covariances, NO_LANDMARKS)
        if wanted.frame not in (None, trajectory.frame):
            if wanted.frame == "body" and body_is_camera(rig().bTc):
                raise ConfigError(
                    "--frame body: nothing states where the cameras sit on a body; give --frame "
                    "left, or run with dataset.camera_yaw_deg and dataset.lever_arm_m"
                )
            found = found.of(wanted.frame, rig())
        path, axes = wanted.trajectory, wanted.chosen_axes
        write_trajectory(path, found.trajectory, found.covariances, remark, axes)
        bare = folder is not None and path.suffix.lower() == ".kitti"
        about = line_numbers(trajectory, log()) if bare else ""
        named = found.trajectory.named
        lines.append(f"{path}: {len(found.trajectory)} poses, {named}{about}")
    if wanted.is_dense:
        dense = dense_map(run, wanted.estimator, how, wanted.recording, progress, log())
        lines += save_dense(dense, wanted, remark)
    if not (wanted.graph or wanted.colour or wanted.images or wanted.map):
        return lines
    points = read()
    if wanted.graph or wanted.colour or wanted.images:
        trajectory = trajectory.of("right", rig())
    if wanted.graph is not None:
        # Observations become points with their first-order covariance.
        graph = build_graph(log(), trajectory, points.ids, points.positions)
        write_g2o(wanted.graph, graph, [*([remark] if remark else []), *_HEADER])
        left_out = sum(len(increment.observations) for increment in log()) - len(graph.points)
        lines.append(
            f"{wanted.graph}: {len(graph.poses)} poses, {len(graph.landmarks)} landmarks, "
            f"{len(graph.motions)} odometry edges, {len(graph.points)} observations "
            f"({left_out} rejected ones left out)"
        )
    points = points.select(points.valid) if wanted.valid_only else points
    if wanted.colour or wanted.images:
        config = config_of(run, wanted.recording)
        points, line = export_images(wanted.images, config, log(), trajectory, points)
        lines += [line] if line else []
    if wanted.map is not None:
        write_map(wanted.map, points, remark, wanted.chosen_axes)
        lines.append(f"{wanted.map}: {len(points)} landmarks")
    return lines


def config_of(run: Path, recording: Path | None) -> ExperimentConfig:
    """A run's configuration, its recording where it is now. Raises FgslamError."""
    return load_config(run / RUN_MARKER, moved_to(recording))


def moved_to(recording: Path | None) -> list[str]:
    """The override that states where a run's recording is now; none where it was."""
    return [] if recording is None else [f"dataset.path={json.dumps(str(recording.resolve()))}"]


def dense_map(
    run: Path,
    estimator: str | None = None,
    how: DenseSettings | None = None,
    recording: Path | None = None,
    progress: Progress = lambda what, done, total: None,
    log: MeasurementLog | None = None,
) -> DenseMap:
    """The dense map of a run, from its recording's images; ``log`` is its own, if at hand.

    Raises:
        FgslamError: no run of SLAM, its recording is gone or has no images, or they show no depth.
    """
    folder = run / results_folder(run, estimator)
    log = MeasurementLog.load(log_of(run)) if log is None else log
    trajectory = Trajectory.load(folder / "final.tum")
    covariances = read_covariances(folder / "covariance.csv")[1]
    estimate = Estimate(trajectory, covariances, NO_LANDMARKS).of("right", log.rig)
    rows, pictures, depths = frames_of(config_of(run, recording), estimate.trajectory)
    return fuse(log, estimate, rows, pictures, depths, how, progress)


def graph_of_run(run: Path, estimator: str | EstimatorSettings | None = None) -> FactorGraph:
    """The log of a run as GTSAM's graph at the solution of an estimator, the run's own for None.

    Raises:
        FgslamError: no run of SLAM, or the estimator fails on its log or keeps no whole graph.
    """
    config, path = load_config(run / RUN_MARKER), log_of(run)
    chosen, arrival = chosen_estimator(estimator or config.estimator), arrival_of(path.parent)
    log = MeasurementLog.load(path)
    found = replay(log, chosen, config.frontend.ego_motion, arrival=arrival)
    if found.failure:
        raise EstimatorError(f"{found.kind}: {found.failure}")
    return found.graph()


def _require_outputs(run: Path, wanted: Wanted) -> None:
    """Refuses now, not after seconds of reading, what cannot be written. Raises FgslamError."""
    if wanted.is_bag and wanted.axes == "camera":
        raise ConfigError(
            f"--axes camera: {wanted.trajectory} is for ROS, whose axes are those of REP 103; "
            "leave --axes out, or give a .tum"
        )
    inputs = (*sources_of(run), *([wanted.recording] if wanted.recording else []))
    if wanted.graph is not None and not run.is_file():
        require_suffix(wanted.graph, *GRAPH)
    if wanted.dense is not None:
        require_suffix(wanted.dense, *CLOUD)
    if wanted.mesh is not None:
        require_suffix(wanted.mesh, *MESH)
    if wanted.grid is not None and wanted.grid.suffix.lower() not in (".yaml", ".yml"):
        raise OutputError(
            f"cannot write {wanted.grid}: a grid is a .yaml with a .pgm next to it; give "
            "a name.yaml"
        )
    for path in wanted.files:
        require_output(path, wanted.overwrite, inputs)
    if wanted.images is not None:
        require_output(wanted.images, wanted.overwrite, inputs, folder=True)


def save_dense(found: DenseMap, wanted: Wanted, remark: str) -> list[str]:
    """Writes a dense map's files; a line about each. Raises OutputError."""
    surface, lines = found.surface, []
    median = 100.0 * float(np.median(surface.sigmas))
    about = (
        f"of {found.frames} frames, voxels of {100.0 * found.voxel_m:.3g} cm, seen within "
        f"{found.range_m:.3g} m, median deviation {median:.2g} cm"
    )
    for path, triangles in ((wanted.dense, False), (wanted.mesh, True)):
        if path is not None:
            surface.save(path, triangles, wanted.chosen_axes, remark)
            faces = f" in {len(surface.triangles)} triangles" if triangles else ""
            lines.append(f"{path}: {len(surface.positions)} points{faces}, {about}")
    if wanted.grid is not None:
        grid = found.grid
        grid.save(wanted.grid)
        shares = [100.0 * float((grid.cells == value).mean()) for value in (FREE, OCCUPIED)]
        tilt = f"; tilted by {grid.tilt_deg:.0f} deg against the map" if grid.tilt_deg > 1 else ""
        lines.append(
            f"{wanted.grid}: {grid.cells.shape[1]} x {grid.cells.shape[0]} cells of "
            f"{100.0 * grid.resolution_m:.3g} cm, {shares[0]:.0f} % free, {shares[1]:.0f} % "
            f"occupied{tilt}"
        )
    return lines


def line_numbers(trajectory: Trajectory, log: MeasurementLog) -> str:
    """Which frame each line of KITTI's format is, which has no times; empty where line k is k."""
    rows = np.searchsorted(log.timestamps, trajectory.timestamps - _ROUNDING_S)
    numbers = np.array([increment.index for increment in log.increments])[rows]
    if np.array_equal(numbers, np.arange(len(numbers))):
        return ""
    some = ", ".join(map(str, numbers[:4])) + (", ..." if len(numbers) > 4 else "")
    return (
        f"; the format has no times: lines 0, 1, ... are frames {some} to {numbers[-1]} of the "
        "recording (a .tum has times)"
    )


_ROUNDING_S = 5e-7  # of stamps in trajectories


def sources_of(run: Path) -> tuple[Path, ...]:
    """A run or a saved map, and the inputs that it names."""
    if not is_run_folder(run):
        return (run,)
    return (run, *load_experiment(run / RUN_MARKER).inputs)


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
        plain = ("*.csv", "*.npz", "*.json", "logs/*.npz")
        found = sorted(
            {
                f"{p.parent.name}/*{p.suffix}" if p.parent != run else p.name
                for pattern in plain
                for p in run.glob(pattern)
            }
        )
        raise DatasetError(
            f"{run}: is a run of task {task}, not of SLAM: it has no map, trajectory or graph to "
            f"export; take its tables and arrays as they are: {', '.join(found)}"
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
    lines += [
        f"drive       {drive.get('name')}: {drive.get('frames')} frames of "
        f"{(drive.get('recording') or {}).get('name')}, {drive.get('estimator')}, fgslam "
        f"{drive.get('fgslam')}"
        for drive in drives_of(saved)
    ]
    return [*lines, f"trajectory  {len(saved.trajectory)} poses"]


# --------------------------------------------------------------------------------------------
# A run as a graph for other solvers: its log's measurements around an estimator's final answer

_HEADER = (
    "poses wTc of the reference camera; x right, y down, z forward; metres",
    "information: g2o's error (translation, vector part of the quaternion), metres and half angles",
    "left out: observations that the run rejected, constraints of a floor, closures of loops, "
    "odometry to relocalised frames",
    "vertices: the estimator's final answer, first pose held",
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
    # The third number is disparity or range: only a positive one is that of a point.
    kept = [~s.rejected & (s.observations.measurement[:, 2] > 0.0) for s in log]
    seen = [
        s.observations.select(keep & (row >= 0))
        for s, keep, row in zip(log, kept, rows, strict=True)
    ]
    measurement = np.concatenate([np.empty((0, 3)), *(o.measurement for o in seen)])
    covariance = np.concatenate([np.empty((0, 3, 3)), *(o.covariance for o in seen)])
    seen_ids = np.concatenate([np.empty(0, np.int64), *(o.ids for o in seen)])
    used, first, landmark = np.unique(seen_ids, return_index=True, return_inverse=True)
    seen_from = np.repeat(rows, [len(o) for o in seen])
    points = log.rig.triangulate(measurement)
    wTc = trajectory.poses[seen_from[first]]
    start = np.asarray(np.einsum("nij,nj->ni", wTc[:, :3, :3], points[first]) + wTc[:, :3, 3])
    mapped = np.isin(used, ids)
    start[mapped] = positions[np.searchsorted(ids, used[mapped])]
    moved = [
        (rows[k - 1], rows[k], increment.odometry)
        for k, increment in enumerate(log)
        # A relocalised frame was carried there: its odometry does not know of that.
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
        point_covariances=log.rig.triangulation_covariance(measurement, covariance),
    )


# --------------------------------------------------------------------------------------------
# A run as images with poses and points, and its map in their colours

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
    rows, pictures, _ = frames_of(config, trajectory)
    model = build_model(log, trajectory, points)
    tints, missing = Tints(len(model.ids)), 0
    for k, row in enumerate(rows):
        try:
            shown = pictures(row)
        except FrameError:
            missing += 1
            continue
        first = k * model.rig.cameras
        if folder is not None:
            for name, image in zip(model.names[first:], shown, strict=False):
                write_bytes(_with_parents(folder / "images" / name), encoded_png(image))
        tints.sample(model, first, shown[0])
    points = with_normals(tints.on(points, model), model)
    if folder is None:
        return points, ""
    model = replace(model, colours=points.colours[np.searchsorted(points.ids, model.ids)])
    write_colmap(_with_parents(folder / "sparse" / "0" / "cameras.txt").parent, model)
    error = float(model.point_errors().mean()) if len(model.ids) else 0.0
    lacking = f", {missing} frames without readable images" if missing else ""
    return points, (
        f"{folder}: {len(model.names)} images, {len(model.ids)} points, mean reprojection error "
        f"{error:.3f} px{lacking}"
    )


def _with_parents(path: Path) -> Path:
    """A file's path, its folder made. Raises OutputError."""
    with clear_output_errors(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
    return path


def build_model(log: MeasurementLog, trajectory: Trajectory, points: MapPoints) -> ImageModel:
    """Every camera's image of every located frame, and where the map's points were seen in it.

    Args:
        log: the measurements; rejected ones and those not in the map are left out.
        trajectory: poses of the reference camera.
        points: the map, ascending by identity.
    """
    rig, parts = log.rig, []
    model = pixel_model(rig.cameras, vertical_to_horizontal(rig))
    for increment, row in zip(log, rows_of_frames(log, trajectory).tolist(), strict=True):
        if row < 0:
            continue
        seen = increment.observations.select(~increment.rejected)
        seen = seen.select(np.isin(seen.ids, points.ids))
        # What measurement and rig state together, where the camera saw the landmark at all.
        pixels = (seen.measurement @ model.T).reshape(len(seen), rig.cameras, 2)
        at, camera = np.nonzero(np.isfinite(seen.pixels[:, : rig.cameras, 0]))
        parts.append((row * rig.cameras + camera, seen.ids[at], pixels[at, camera]))
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
        poses=(trajectory.poses[:, None] @ rig.camera_poses).reshape(-1, 4, 4),
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


def frames_of(
    config: ExperimentConfig, trajectory: Trajectory
) -> tuple[list[int], Pictures, Callable[[int], Depth] | None]:
    """Frame of the recording for each pose, its images, and its depth where a camera gives it.

    Raises:
        FgslamError: the run has no images, or its recording is gone or another one.
    """
    dataset = config.dataset
    if isinstance(dataset, MeasurementDatasetSettings):
        raise DatasetError(f"a recording of kind {dataset.kind} has no images to export")
    if isinstance(dataset, RenderedLabSettings):
        sequence: ImageSequence = open_sequence(config)
    else:
        sequence = open_recording(dataset)
    name = dataset.path if hasattr(dataset, "path") else dataset.kind
    rows = rows_along(trajectory, sequence.timestamps, f"the recording {name}")
    return rows, *readers_of(sequence)


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
