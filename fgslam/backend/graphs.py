"""Helpers on GTSAM's graphs."""

from __future__ import annotations

from typing import Any

import gtsam


def without_gaps(graph: Any) -> Any:
    """A nonlinear graph without its empty slots."""
    kept = gtsam.NonlinearFactorGraph()
    for row in range(graph.size()):
        if graph.exists(row):
            kept.add(graph.at(row))
    return kept
