"""Calls of the library."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import fgslam as fg
from scripts.fuzz.archives import MEASUREMENTS
from scripts.fuzz.damage import Rng, written
from scripts.fuzz.texts import CALIBRATION

_ODD: tuple[Any, ...] = (
    None, "x", -1, 0, 1.5, np.nan, np.inf, 10**30, [], {}, np.zeros(3), np.full((4, 4), np.nan),
    np.zeros((240, 320), np.uint8), np.zeros((0, 0), np.uint8), np.zeros((240, 320, 7)), b"x",
    object(), True, (1, 2, 3), "x" * 5000,
)  # fmt: skip
_ODDER: tuple[Any, ...] = (
    *_ODD, "", "/dev/zero", Path("."), "\0", [None, None], {"x": 1}, {1: 2}, {"a.b": [1]}, [[1], 2],
    np.array(["x"]), np.zeros((240, 320), np.uint16), 1j, -0.0, np.float32(2.0), range(3), {1, 2},
)  # fmt: skip

Call = tuple[Callable[..., Any], dict[str, Any]]
"""A function of the library and its arguments, one of them odd."""


def call(rng: Rng, _: Path) -> tuple[str, Any]:
    """A call of the library with an odd argument."""
    name = ("t", "images", "odometry", "fx", "estimator")[rng.integers(5)]
    return name, _ODD[rng.integers(len(_ODD))]


def read_call(given: tuple[str, Any]) -> None:
    """One frame of a session with the odd argument in place of the right one."""
    name, value = given
    values: dict[str, Any] = {
        "t": 0.0, "images": [np.zeros((240, 320), np.uint8)] * 2, "odometry": None, "fx": 200.0,
        "estimator": "landmark_kalman",
    } | {name: value}  # fmt: skip
    rig = fg.StereoRig(
        width=320, height=240, fx=values["fx"], fy=200.0, cx=159.5, cy=119.5, baseline=0.1
    )
    slam = fg.Slam(rig, estimator=values["estimator"])
    slam.track(values["t"], values["images"], values["odometry"])


# --------------------------------------------------------------------------------------------
# Any function


def library_call(rng: Rng, folder: Path) -> Call:
    """One of the library's functions with an odd value in place of a right argument."""
    functions = _functions(folder)
    function, right = functions[int(rng.integers(len(functions)))]
    name = list(right)[int(rng.integers(len(right)))]
    return function, right | {name: _ODDER[rng.integers(len(_ODDER))]}


def read_library_call(given: Call) -> None:
    """What the function does with it; a closed session of what is one."""
    function, arguments = given
    found = function(**arguments)
    if isinstance(found, fg.Slam):
        found.close()


def _rig() -> fg.StereoRig:
    return fg.StereoRig(width=320, height=240, fx=200.0, fy=200.0, cx=159.5, cy=119.5, baseline=0.1)


def _track(**arguments: Any) -> None:
    with fg.Slam(_rig()) as slam:
        slam.track(**arguments)


@cache
def _log() -> fg.MeasurementLog:
    """Of a session over two grey frames, which shows nothing."""
    with fg.Slam(_rig()) as slam:
        for k in range(2):
            slam.track(0.1 * k, [np.full((240, 320), 99, np.uint8)] * 2)
        return slam.log


def _compared(answers: Any, truth: Any, landmark_truth: Any, full: Any) -> None:
    fg.compare(answers, truth, landmark_truth, full)


def _functions(folder: Path) -> list[Call]:
    """Functions with right arguments."""
    camera = fg.load_camera("equirectangular", (256, 128))
    views = [np.zeros((128, 256, 3), np.uint8)] * 2
    grey, eye = [np.zeros((240, 320), np.uint8)] * 2, np.eye(4)
    calib = written(folder / "calib.json", CALIBRATION)
    written(folder / "log.npz", MEASUREMENTS.whole)
    log = _log()
    path = fg.Trajectory(np.arange(4.0), np.tile(eye, (4, 1, 1)))
    replayed = fg.replay(log, "odometry")
    return [
        (fg.Slam, {"rig": _rig(), "estimator": "ekf", "frontend": None, "odometry": None,
                   "features": None, "seed": 0, "start_map": None, "extend_map": True}),
        (_track, {"t": 0.0, "images": grey, "odometry": eye}),
        (fg.Odometry, {"motion": eye, "covariance": np.eye(6)}),
        (fg.open_recording, {"path": "lab_trials", "overrides": ()}),
        (fg.replay, {"log": log, "estimator": "odometry", "ego_motion": None}),
        (_compared, {"answers": {"a": replayed}, "truth": path, "landmark_truth": None,
                     "full": False}),
        (fg.load_rig, {"path": calib, "path2": None, "size": None, "scale": False, "unit_m": 1.0,
                       "fov_deg": None, "cameras": None}),
        (fg.load_camera, {"source": "equirectangular", "size": (256, 128)}),
        (fg.Map.load, {"path": calib}),
        (fg.MeasurementLog.load, {"path": folder / "log.npz"}),
        (fg.Trajectory.load, {"path": calib}),
        (fg.PathMemory.load, {"path": calib}),
        (fg.RouteMap.load, {"path": calib}),
        (fg.teach, {"images": views, "camera": camera, "names": None, "features": None,
                    "select": False}),
        (fg.rendered_recording, {"world": "x", "frames": 1}),
    ]  # fmt: skip
