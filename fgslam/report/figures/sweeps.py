"""Figures of sweeps: a metric over a setting."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.report.figures.traces import Figure, Owner, packed, trace


def effect_figure(
    curves: Mapping[str, FloatArray], axis: str, metric: str, *, several: bool
) -> Figure:
    """Means of a metric over the values of a setting, with their intervals.

    Args:
        curves: by name of the series, in its order: (n, 4) value, mean, lower and upper end of the
            interval (NaN where there is none).
        axis: title of the setting.
        metric: title of the metric.
        several: other settings were varied as well, and the means are over these.
    """
    traces = []
    for i, (name, rows) in enumerate(curves.items()):
        value, mean, lower, upper = rows.T
        errors = {
            "type": "data",
            "symmetric": False,
            "array": packed(np.nan_to_num(upper - mean)),
            "arrayminus": packed(np.nan_to_num(mean - lower)),
            "thickness": 1,
        }
        traces.append(
            trace(
                Owner(name, i),
                {"x": value, "y": mean},
                mode="lines+markers",
                line={"width": 1.8},
                marker={"size": 6},
                error_y=errors,
                hovertemplate="%{y:.4g}",
            )
        )
    layout = {
        "xaxis": {"title": {"text": axis}},
        "yaxis": {"title": {"text": metric}},
        "hovermode": "x unified",
    }
    over = " and all other settings" if several else ""
    description = f"Mean of {metric} over the repetitions{over}, with its 95 % interval."
    key = f"effect_{metric}_{axis}".replace(".", "_")
    drawn = tuple(traces) if any(map(len, curves.values())) else ()
    return Figure(key, f"{metric} over {axis}", description, drawn, layout)
