"""The rig's calibration over a drive, as it became known."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.report.figures.over_time import panels
from fgslam.report.figures.traces import SIGMAS, Figure, Owner, Trace, trace

_CHANGES = {
    "yaw_deg": "yaw (deg)",
    "pitch_deg": "pitch (deg)",
    "roll_deg": "roll (deg)",
    "focal_percent": "focal length (%)",
}
_CAMERAS = ("left", "top")


def calibration_over_time(found: Mapping[str, FloatArray], start: float) -> Figure:
    """Turn and zoom of each camera against the rig's calibration, with 3 sigma.

    Args:
        found: the columns of calibration.csv, (n,) each.
        start: of the drive, seconds.
    """
    cameras = [name for name in _CAMERAS if f"{name}_yaw_deg" in found]
    seconds = found["timestamp"] - start
    traces: list[Trace] = []
    for panel, change in enumerate(_CHANGES):
        for colour, camera in enumerate(cameras):
            values = found[f"{camera}_{change}"]
            bound = SIGMAS * found[f"{camera}_{change}_sigma"]
            owner = Owner(f"{camera} camera", colour=colour)
            traces += _with_band(owner, seconds, values, bound, panel)
    layout = panels(list(_CHANGES.values()))
    for name in layout.keys() - {"xaxis", "hovermode"}:
        layout[name]["rangemode"] = "tozero"
    knocks = int(found["knocks"][-1]) if len(seconds) else 0
    return Figure(
        "calibration",
        "The rig's calibration",
        "How far the other cameras are turned and zoomed against the rig's calibration, as the "
        "drive showed it. Band: three standard deviations; where it holds zero, the calibration "
        "may be exact.",
        tuple(traces),
        layout,
        note=f"The rig was found to have moved {knocks} times." if knocks else "",
    )


def _with_band(
    owner: Owner, seconds: FloatArray, values: FloatArray, bound: FloatArray, panel: int
) -> Iterator[Trace]:
    axis = {"yaxis": f"y{panel + 1 if panel else ''}"}
    corners = {
        "x": np.concatenate([seconds, seconds[::-1]]),
        "y": np.concatenate([values + bound, (values - bound)[::-1]]),
    }
    band = Owner(f"{owner.name}, 3 sigma", paint="band")
    yield trace(
        band, corners, mode="lines", fill="toself", line={"width": 0}, hoverinfo="skip", **axis
    )
    axes = {"x": seconds, "y": values}
    hover = "%{y:.4f}"
    yield trace(owner, axes, mode="lines", line={"width": 1.8}, hovertemplate=hover, **axis)
