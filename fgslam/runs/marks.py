"""What titles say of results that are not all there, or not all measured."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from fgslam.evaluation.metrics import value_at

SYNTHETIC = "synthetic odometry"
"""Said of all results whose odometry was made from the ground truth."""


def with_marks(title: str, marks: Iterable[str]) -> str:
    """The title with its marks in brackets; without any, as it is."""
    said = ", ".join(filter(None, marks))
    return f"{title} ({said})" if said else title


def predicted_mark(count: int | None) -> str:
    """Says that so many poses no landmark measured; empty for none."""
    if not count:
        return ""
    return "1 pose predicted" if count == 1 else f"{count:,} poses predicted"


def measured_marks(predicted: int | None, synthetic: bool) -> tuple[str, str]:
    """What is not measured of results: poses, odometry."""
    return predicted_mark(predicted), SYNTHETIC if synthetic else ""


def picture_title(what: str, predicted: int, synthetic: bool) -> str:
    """What a picture shows, and what of it is not measured: poses, odometry."""
    return ", ".join(filter(None, (what, *measured_marks(predicted, synthetic))))


def marked(values: Mapping[str, Any], remark: str = "", say_failed: bool = True) -> dict[str, Any]:
    """The metrics of estimators under titles that say what is not all there.

    That it failed (but for a page, which says so itself), how many of the frames it saw, how many
    of its poses no landmark measured, and ``remark``, what all of a run's are marked with.
    """
    frames = max((value_at(m, "frames") or 0 for m in values.values()), default=0)
    out = {}
    for title, metrics in values.items():
        own = value_at(metrics or {}, "frames")
        marks = (
            "failed" if say_failed and value_at(metrics or {}, "failure") else "",
            f"{own} of {frames} frames" if own is not None and own < frames else "",
            predicted_mark(value_at(metrics or {}, "predicted_frames")),
            remark,
        )
        out[with_marks(title, marks)] = metrics or {}
    return out
