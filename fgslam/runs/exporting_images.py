"""Hands a run's images with their poses to photogrammetry (COLMAP); colours of a map."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
from scipy.spatial import cKDTree

from fgslam.core.arrays import ByteArray, FloatArray, Image, IntArray
from fgslam.core.errors import DatasetError, FrameError
from fgslam.core.estimates import Trajectory
from fgslam.core.files import clear_output_errors, write_bytes
from fgslam.core.geometry import pose
from fgslam.core.measurement_log import MeasurementLog
from fgslam.core.measurements import Observations
from fgslam.core.sensors import CAMERA_NAMES, CameraRig, pixel_model, vertical_to_horizontal
from fgslam.datasets.images import encoded_png
from fgslam.datasets.opening import open_recording
from fgslam.datasets.settings import MeasurementDatasetSettings, RenderedLabSettings
from fgslam.report.image_model import ImageModel, write_colmap
from fgslam.report.point_cloud import MapPoints
from fgslam.runs.config import ExperimentConfig
from fgslam.runs.opening import open_sequence

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
