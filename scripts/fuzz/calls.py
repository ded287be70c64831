"""Calls of the library."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import fgslam as fg
from scripts.fuzz.damage import Rng


def call(rng: Rng, _: Path) -> tuple[str, Any]:
    """A call of the library with an odd argument."""
    odd: tuple[Any, ...] = (
        None, "x", -1, 0, 1.5, np.nan, np.inf, 10**30, [], {}, np.zeros(3), np.full((4, 4), np.nan),
        np.zeros((240, 320), np.uint8), np.zeros((0, 0), np.uint8), np.zeros((240, 320, 7)), b"x",
        object(), True, (1, 2, 3), "x" * 5000,
    )  # fmt: skip
    return ("t", "images", "odometry", "fx", "estimator")[rng.integers(5)], odd[
        rng.integers(len(odd))
    ]


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
