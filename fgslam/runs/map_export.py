"""A saved map for other tools, and for people: point cloud, trajectory, and what is in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fgslam.core.errors import ConfigError
from fgslam.core.saved_map import SavedMap, load_map
from fgslam.core.trajectories import write_trajectory
from fgslam.report.point_cloud import write_map
from fgslam.runs.maps import drives_of, points_of, remark_of_map, valid_of


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
