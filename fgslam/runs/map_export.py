"""A saved map for other tools, and for people: point cloud, trajectory, and what is in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fgslam.core.arrays import BoolArray
from fgslam.core.errors import ConfigError
from fgslam.core.saved_map import SavedMap, load_map
from fgslam.core.trajectories import write_trajectory
from fgslam.report.point_cloud import MapPoints, write_map

_VALID_HITS = 3  # where the map does not say how many its run asked for (Se et al. 6.1)


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
    remark = _remark(saved)
    lines = [f"note: {remark}"] if remark else []
    if map_file is not None:
        points = _points(saved)
        points = points.select(points.valid) if valid_only else points
        write_map(map_file, points, remark)
        lines.append(f"{map_file}: {len(points)} landmarks")
    if trajectory_file is not None:
        write_trajectory(trajectory_file, saved.trajectory, remark)
        lines.append(f"{trajectory_file}: {len(saved.trajectory)} poses")
    return lines


def describe_map(saved: SavedMap, path: Path) -> list[str]:
    """What is in a map, and where it comes from."""
    rig, size, valid = saved.rig, path.stat().st_size, _valid(saved)
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
    lines += [_about_drive(drive) for drive in _drives(saved)]
    lines.append(f"trajectory  {len(saved.trajectory)} poses")
    goes_on = "kept: map.start continue can go on" if saved.session else "not kept"
    return [*lines, f"session     {goes_on}"]


def _about_drive(drive: dict[str, Any]) -> str:
    recording = drive.get("recording") or {}
    return (
        f"drive       {drive.get('name')}: {drive.get('frames')} frames of "
        f"{recording.get('name')}, {drive.get('estimator')}, fgslam {drive.get('fgslam')}"
    )


def _drives(saved: SavedMap) -> list[dict[str, Any]]:
    found = saved.about.get("drives")
    return [drive for drive in found if isinstance(drive, dict)] if isinstance(found, list) else []


def _remark(saved: SavedMap) -> str:
    """Marks maps whose odometry was made from ground truth; empty otherwise."""
    return next((str(drive["remark"]) for drive in _drives(saved) if drive.get("remark")), "")


def _valid(saved: SavedMap) -> BoolArray:
    least = max((int(d.get("valid_hits") or 0) for d in _drives(saved)), default=_VALID_HITS)
    return np.asarray(saved.hits >= least)


def _points(saved: SavedMap) -> MapPoints:
    return MapPoints(
        ids=saved.landmarks.ids,
        positions=saved.landmarks.positions,
        covariances=saved.landmarks.covariances,
        colours=np.repeat(saved.colour[:, None], 3, axis=1),
        hits=saved.hits,
        misses=saved.misses,
        valid=_valid(saved),
        permanent=saved.permanent,
    )
