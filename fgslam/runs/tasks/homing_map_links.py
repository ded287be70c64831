"""Links of a topological map for people: links.csv and the map from above."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.homing.links import Link
from fgslam.homing.topological_map import TopologicalMap
from fgslam.report.figures.plan import Links, network_figure, unfolded
from fgslam.report.figures.traces import Figure
from fgslam.report.tables import Cell, write_csv

LINKS_FILE = "links.csv"
_COLUMNS = (
    "from",
    "to",
    "direction_deg",
    "sigma_direction_deg",
    "rotation_deg",
    "sigma_rotation_deg",
    "back_deg",
    "inliers",
    "cost",
    "places_apart",
    "distance_m",
)


def write_links(folder: Path, topology: TopologicalMap, poses: FloatArray | None = None) -> None:
    """links.csv; lengths where places (n, 3) are known. Raises OutputError."""
    write_csv(folder / LINKS_FILE, _COLUMNS, _link_rows(topology, poses))


def link_lengths(topology: TopologicalMap, poses: FloatArray | None) -> FloatArray | None:
    """(m,) lengths of the links between places (n, 3), metres; None without these."""
    if poses is None:
        return None
    ends = [(poses[k.a, :2], poses[k.b, :2]) for k in topology.links]
    return np.array([float(np.hypot(*(b - a))) for a, b in ends])


def _link_rows(topology: TopologicalMap, poses: FloatArray | None) -> Iterator[list[Cell]]:
    lengths = link_lengths(topology, poses)
    for k, link in enumerate(topology.links):
        sigma = np.rad2deg(np.sqrt(np.diagonal(link.covariance)))
        angles = np.rad2deg([link.direction, link.rotation, link.back])
        yield [
            topology.names[link.a],
            topology.names[link.b],
            angles[0],
            sigma[0],
            angles[1],
            sigma[1],
            angles[2],
            link.support,
            float(topology.costs[k]),
            link.b - link.a,
            None if lengths is None else float(lengths[k]),
        ]


def map_figure(topology: TopologicalMap, poses: FloatArray | None = None) -> Figure:
    """The map from above, its nodes at their true places (n, 3) where these are known."""
    pairs = tuple((link.a, link.b) for link in topology.links)
    surveyed = poses is not None
    places = unfolded(len(topology), pairs) if poses is None else poses[: len(topology), :2]
    labels = tuple(_label(topology, link) for link in topology.links)
    rejected = tuple(sorted(topology.rejected))
    why = tuple(
        f"{topology.names[a]} to {topology.names[b]}: {topology.rejected[a, b]}"
        for a, b in rejected
    )
    kinds = (
        Links("links", 0, pairs, labels),
        Links("tried, no link", 1, rejected, why, shown=False),
    )
    where = (
        "Views at their true places."
        if surveyed
        else "There are no true places: views are drawn so that distances are as along the links."
    )
    words = ("map", "The topological map", f"{where} A line is a homing that is believed.")
    axes = ("x (m)", "y (m)") if surveyed else ("", "")
    return network_figure(words, places, topology.names, kinds, axes)


def _label(topology: TopologicalMap, link: Link) -> str:
    ends = f"{topology.names[link.a]} to {topology.names[link.b]}"
    if not link.support:
        return f"{ends}: driven, but without a homing vector"
    return f"{ends}: {link.support} inliers, rotation {np.rad2deg(link.rotation):.0f} degrees"
