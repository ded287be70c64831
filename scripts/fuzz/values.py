"""Faults that change a digit and nothing else: what is read is what the file says, or refused.

What a file says is known without fgslam: from the text itself, by PyYAML or json.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml

import fgslam as fg
from fgslam.cameras.lenses import Calibration
from fgslam.runs import calibrating
from fgslam.runs.config import load_experiment
from fgslam.runs.named_experiments import experiment_names, experiments_folder
from scripts.fuzz.damage import Rng, written

_NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?![\w.])")
_WRITTEN = ("raw.json", "opencv.yml", "opencv.xml", "ros")
_NAMES = ("routes",)  # keys below which numbers are names
_CLOSE = 1e-6  # ROS and OpenCV state a rotation and a product, not the pose itself

Pair = tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]
"""What the file says, and what was read; NaN where it is not there."""


def digit_changed(rng: Rng, text: str) -> str:
    """The text with another digit in one of its numbers."""
    number = list(_NUMBER.finditer(text))[int(rng.integers(len(_NUMBER.findall(text))))]
    digits = [k for k in range(*number.span()) if text[k].isdigit()]
    at = digits[int(rng.integers(len(digits)))]
    other = (int(text[at]) + int(rng.integers(1, 10))) % 10
    return f"{text[:at]}{other}{text[at + 1 :]}"


def is_as_written(pair: Pair) -> bool:
    """Whether what was read is what the file says."""
    said, found = pair
    return said.shape == found.shape and np.allclose(said, found, rtol=_CLOSE, atol=_CLOSE)


# --------------------------------------------------------------------------------------------
# Calibrations


def calibration(rng: Rng, folder: Path) -> tuple[Path, Path | None]:
    """A calibration with a digit changed; the file of another format to write it to, or none."""
    if rng.random() < 0.3:
        values = dict(zip(("fx", "fy", "cx", "cy"), _intrinsics(rng), strict=True))
        own = {"width": 640, "height": 480, **values, "baseline_m": round(rng.uniform(0.1, 0.3), 4)}
        return written(folder / "calib.json", digit_changed(rng, json.dumps(own, indent=1))), None
    chain = {
        f"cam{k}": {
            "camera_model": "pinhole",
            "intrinsics": _intrinsics(rng),
            "distortion_model": "radtan",
            "distortion_coeffs": np.round(rng.uniform(-0.02, 0.02, 4), 5).tolist(),
            "resolution": [640, 480],
        }
        for k in range(2)
    }
    beside = np.eye(4)
    beside[:3, 3] = np.round([rng.uniform(-0.3, -0.1), *rng.uniform(-0.01, 0.01, 2)], 4)
    chain["cam1"]["T_cn_cnm1"] = beside.tolist()
    path = written(folder / "chain.yaml", digit_changed(rng, yaml.safe_dump(chain)))
    other = (None, *_WRITTEN)[rng.integers(1 + len(_WRITTEN))]
    return path, None if other is None else folder / other


def _intrinsics(rng: Rng) -> list[float]:
    values = rng.uniform([450.0, 450.0, 310.0, 230.0], [470.0, 470.0, 330.0, 250.0])
    return [float(value) for value in np.round(values, 3)]


def read_calibration(given: tuple[Path, Path | None]) -> Pair:
    """Numbers of both cameras as the text has them, and as they were read, or written and read."""
    path, other = given
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".json":
        rig, values = fg.load_rig(path), json.loads(text)
        found = [rig.width, rig.height, rig.fx, rig.fy, rig.cx, rig.cy, rig.baseline]
        return np.array(list(values.values()), np.float64), np.array(found, np.float64)
    fg.load_rig(path)
    if other is not None:
        calibrating.convert_calibration(calibrating.read_calibration(path), other)
    return _said(yaml.safe_load(text)), _found(calibrating.read_calibration(other or path))


def _said(chain: dict[str, dict[str, Any]]) -> np.ndarray[Any, Any]:
    cameras = (chain["cam0"], chain["cam1"])
    each = [[*c["intrinsics"], *c["distortion_coeffs"], *c["resolution"]] for c in cameras]
    motion = np.array(chain["cam1"]["T_cn_cnm1"], np.float64)
    if not motion[3].any():  # of tools that never look at it: means the same
        motion[3, 3] = 1.0
    return np.concatenate([*each, motion.ravel()])


def _found(calibration: Calibration) -> np.ndarray[Any, Any]:
    first, second = calibration.cameras
    each = [np.r_[c.intrinsics, c.distortion[:4], c.size] for c in (first, second)]
    motion = np.linalg.inv(second.bTc) @ first.bTc
    return np.concatenate([*each, motion.ravel()])


# --------------------------------------------------------------------------------------------
# Configurations


def configuration(rng: Rng, folder: Path) -> Path:
    """An experiment of the package with a digit changed."""
    names = experiment_names()
    text = (experiments_folder() / f"{names[rng.integers(len(names))]}.yaml").read_text("utf-8")
    plain = yaml.safe_dump(yaml.safe_load(text), sort_keys=False)  # without comments
    return written(folder / "c.yaml", digit_changed(rng, plain))


def read_configuration(path: Path) -> Pair:
    """Numbers of an experiment as the text has them, and as they were read, written, and read."""
    said = dict(_numbers(yaml.safe_load(path.read_text(encoding="utf-8"))))
    once = load_experiment(path).as_values()
    again = path.with_name("again.yaml")
    again.write_text(yaml.safe_dump(once), encoding="utf-8")
    found = dict(_numbers(once))
    twice = dict(_numbers(load_experiment(again).as_values()))
    texts = np.array([*said.values(), *found.values()], np.float64)
    read = [*(found.get(key, np.nan) for key in said), *(twice.get(key, np.nan) for key in found)]
    return texts, np.array(read, np.float64)


def _numbers(values: Any, at: tuple[str | int, ...] = ()) -> Iterator[tuple[Any, float]]:
    """Numbers by the keys and places that lead to them."""
    if isinstance(values, dict):
        for key, value in values.items():
            if key not in _NAMES:
                yield from _numbers(value, (*at, key))
    elif isinstance(values, list):
        for k, value in enumerate(values):
            yield from _numbers(value, (*at, k))
    elif isinstance(values, (int, float)):
        yield at, float(values)
