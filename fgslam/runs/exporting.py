"""Hands a run's results to other tools, from the files of its run folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fgslam.core.errors import ConfigError, DatasetError
from fgslam.core.saved_map import SavedMap, load_map
from fgslam.core.trajectories import read_tum, write_trajectory
from fgslam.report.metrics import read_metrics
from fgslam.report.point_cloud import read_ply, write_map
from fgslam.runs.config import is_homing, load_config
from fgslam.runs.files import LOG_FILE
from fgslam.runs.folder import RUN_MARKER, is_run_folder
from fgslam.runs.graph_export import export_graph
from fgslam.runs.maps import drives_of, points_of, remark_of_map, valid_of


def export_run(
    run: Path,
    map_file: Path | None,
    trajectory_file: Path | None,
    estimator: str | None,
    valid_only: bool,
    graph_file: Path | None = None,
) -> list[str]:
    """Writes what was asked for; returns a line about each file.

    Of a saved map in place of a run, it says what is in it where nothing is asked for.

    Raises:
        FgslamError: nothing asked for, no run there, or an ending that is not known.
    """
    if run.is_file():
        if estimator is not None or graph_file is not None:
            raise ConfigError(
                f"{run}: a saved map has landmarks and a trajectory, no other estimators and no "
                "graph; give --map or --trajectory, or a run folder"
            )
        return export_map(run, map_file, trajectory_file, valid_only)
    targets = (map_file, trajectory_file, graph_file)
    folder = run / _estimator_of(run, estimator)
    if targets == (None, None, None):
        raise ConfigError(
            "nothing to export; give --map FILE.ply, --trajectory FILE.tum or --graph FILE.g2o"
        )
    _require_elsewhere(run, targets)
    remark = read_metrics(run / "metrics.json").get("remark") or ""
    lines = [f"note: {remark}"] if remark else []
    if map_file is not None:
        points = read_ply(folder / "map.ply")
        if valid_only:
            points = points.select(points.valid)
        write_map(map_file, points, remark)
        lines.append(f"{map_file}: {len(points)} landmarks")
    if trajectory_file is not None:
        trajectory = read_tum(folder / "final.tum")
        write_trajectory(trajectory_file, trajectory, remark)
        lines.append(f"{trajectory_file}: {len(trajectory)} poses")
    if graph_file is not None:
        lines.append(export_graph(graph_file, _log_of(run), folder, remark))
    return lines


def _log_of(run: Path) -> Path:
    """The measurements: of a comparison, which has none of its own, those of the run above it."""
    own, above = run / LOG_FILE, run.resolve().parent / LOG_FILE
    return above if above.is_file() and not own.is_file() else own


def _require_elsewhere(run: Path, targets: tuple[Path | None, ...]) -> None:
    """The run's own files are what a run is judged by: an export may not replace them."""
    own = {file.resolve() for file in run.rglob("*") if file.is_file()}
    for target in targets:
        if target is not None and target.resolve() in own:
            raise ConfigError(f"{target}: is one of the run's own files; export to another name")


def _estimator_of(run: Path, wanted: str | None) -> str:
    if not is_run_folder(run):
        raise DatasetError(f"{run}: not a run folder (no config.yaml); give what fgslam run wrote")
    if is_homing(run / RUN_MARKER):
        raise DatasetError(
            f"{run}: is a homing run, and has no graph of SLAM to export; its tables are "
            "trajectory.csv and logs/*.npz"
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


def export_map(
    path: Path, map_file: Path | None, trajectory_file: Path | None, valid_only: bool
) -> list[str]:
    """Writes what was asked for, or says what is in the map; a line about each.

    Raises:
        MapError: it is not one.
        ConfigError: a target is the map's own file.
        OutputError: a file cannot be written, or its ending is not known.
    """
    saved = load_map(path)
    for target in (map_file, trajectory_file):
        if target is not None and target.resolve() == path.resolve():
            raise ConfigError(f"{target}: is the map itself; export to another name")
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
        write_trajectory(trajectory_file, saved.trajectory, remark)
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
    goes_on = "kept: map.start continue can go on" if saved.session else "not kept"
    return [*lines, f"session     {goes_on}"]


def _about_drive(drive: dict[str, Any]) -> str:
    recording = drive.get("recording") or {}
    return (
        f"drive       {drive.get('name')}: {drive.get('frames')} frames of "
        f"{recording.get('name')}, {drive.get('estimator')}, fgslam {drive.get('fgslam')}"
    )
