"""Hands a run's results to other tools, from the files of its run folder."""

from __future__ import annotations

from pathlib import Path

from fgslam.core.errors import ConfigError, DatasetError
from fgslam.core.trajectories import read_tum, write_trajectory
from fgslam.report.metrics import read_metrics
from fgslam.report.point_cloud import read_ply, write_map
from fgslam.runs.config import is_homing, load_config
from fgslam.runs.files import LOG_FILE
from fgslam.runs.folder import RUN_MARKER, is_run_folder
from fgslam.runs.graph_export import export_graph
from fgslam.runs.map_export import export_map


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
