"""A run in the rerun viewer: paths, truth, maps, ellipsoids, pictures and numbers over time.

The viewer is an optional package (``pip install fgslam[viewer]``), imported only here. A run under
way is shown by :mod:`fgslam.runs.watching`.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import MissingDependencyError, OutputError
from fgslam.core.files import replacing, require_output
from fgslam.report.content import COLOURS, ON_DARK, level_axes, thinned, world_position_covariances
from fgslam.report.results import EstimatorReport, ReportData
from fgslam.runs.report import load_report

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
