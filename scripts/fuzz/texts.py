"""Configurations, calibrations and tables."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.polynomial import polynomial

from fgslam.datasets.odometry import file_odometry
from fgslam.datasets.settings import RecordedOdometrySettings
from fgslam.runs.calibrating import convert_calibration, read_calibration
from fgslam.runs.named_experiments import experiment_names, experiments_folder
from scripts.fuzz.damage import ODD, Rng, damaged_bytes, damaged_text, written


def configuration(rng: Rng, folder: Path) -> Path:
    """An experiment of the package, damaged."""
    names = experiment_names()
    text = (experiments_folder() / f"{names[rng.integers(len(names))]}.yaml").read_text("utf-8")
    if rng.random() < 0.1:
        return written(folder / "c.yaml", damaged_bytes(rng, text.encode()))
    return written(folder / "c.yaml", damaged_text(rng, text))


def override(rng: Rng, _: Path) -> tuple[Path, list[str]]:
    """An experiment of the package and an odd override of one of its keys."""
    keys = ("seed", "name", "dataset.stop", "dataset", "odometry.kind", "frontend.sift", "x.y", "")
    texts = [f"{keys[rng.integers(len(keys))]}={ODD[rng.integers(len(ODD))]}" for _ in range(2)]
    names = experiment_names()
    return experiments_folder() / f"{names[rng.integers(len(names))]}.yaml", texts


CALIBRATION = json.dumps(
    {
        "width": 320,
        "height": 240,
        "fx": 200.0,
        "fy": 200.0,
        "cx": 159.5,
        "cy": 119.5,
        "baseline_m": 0.1,
    },
    indent=1,
)
"""Of two rectified cameras, in fgslam's own format."""

_CHAIN = """cam0:
  camera_model: pinhole
  intrinsics: [200.0, 200.0, 160.0, 120.0]
  distortion_model: radtan
  distortion_coeffs: [0.1, 0.0, 0.0, 0.0]
  resolution: [320, 240]
cam1:
  camera_model: pinhole
  intrinsics: [200.0, 200.0, 160.0, 120.0]
  distortion_model: radtan
  distortion_coeffs: [0.1, 0.0, 0.0, 0.0]
  resolution: [320, 240]
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.1]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
"""


@cache
def _calibrations() -> tuple[dict[str, str], ...]:
    """One calibration in each format that fgslam writes: texts by file name."""
    with TemporaryDirectory(prefix="fgslam-fuzz-") as scratch:
        folder = Path(scratch)
        chain = written(folder / "chain.yaml", _CHAIN)
        for name in ("raw.json", "opencv.yml", "opencv.xml", "ros"):
            convert_calibration(read_calibration(chain), folder / name)
        ros = {path.name: path.read_text("utf-8") for path in sorted((folder / "ros").iterdir())}
        files = sorted(path for path in folder.iterdir() if path.is_file())
        return ({"calib.json": CALIBRATION}, ros, *({p.name: p.read_text("utf-8")} for p in files))


def calibration(rng: Rng, folder: Path) -> Path:
    """A rig's file or files of one of several tools, one of them damaged."""
    texts = _calibrations()[rng.integers(len(_calibrations()))]
    spoilt = list(texts)[int(rng.integers(len(texts)))]
    for name, text in texts.items():
        path = written(folder / name, damaged_text(rng, text) if name == spoilt else text)
    return folder if len(texts) > 1 else path


def trajectory(rng: Rng, folder: Path) -> Path:
    """A TUM file, damaged."""
    text = "".join(f"{k}.0 {k} 0 0 0 0 0 1\n" for k in range(5))
    return written(folder / "a.tum", damaged_text(rng, text))


_TABLES = (
    "time,speed,yaw_rate\n1.0,0.1,0.2\n1.1,0.1,0.2\n1.2,0.1,0.2\n",
    "stamp_ns;v_mps;gyro_z\n1000000000;0.1;0.2\n1100000000;0.1;0.2\n",
    "time x y yaw_deg\n1.0 0.1 0.2 3.0\n1.1 0.11 0.2 3.1\n1.2 0.12 0.2 3.2\n",
    "time,x,y,z,qx,qy,qz,qw\n1.0,0.1,0,0,0,0,0,1\n1.1,0.11,0,0,0,0,0,1\n1.2,0.12,0,0,0,0,0,1\n",
)


def odometry_table(rng: Rng, folder: Path) -> Path:
    """A table of odometry with named columns, damaged."""
    text = _TABLES[rng.integers(len(_TABLES))]
    return written(folder / "odometry.csv", damaged_text(rng, text))


def read_odometry(path: Path) -> None:
    """Motions of the table's body at three times."""
    motions = file_odometry(path, RecordedOdometrySettings())
    if motions is not None:
        motions(np.array([1.0, 1.05, 1.1]))


@cache
def _ocamcalib() -> str:
    """A result file of OCamCalib whose two polynomials agree."""
    direct = [-200.0, 0.0, 1e-3, 0.0, 0.0]
    radius = np.linspace(0.0, 240.0, 200)
    angle = np.arctan2(polynomial.polyval(radius, direct), radius)
    inverse = polynomial.polyfit(angle, radius, 9)
    entries = (
        "5 " + " ".join(map(str, direct)),
        "10 " + " ".join(map(str, inverse)),
        "240.0 320.0",
        "1.0 0.0 0.0",
        "480 640",
    )
    return "".join(f"# entry {k}\n\n{line}\n\n" for k, line in enumerate(entries))


def omni_camera(rng: Rng, folder: Path) -> Path:
    """A file of OCamCalib or of keys of an omnidirectional camera, damaged."""
    if rng.random() < 0.5:
        return written(folder / "calib_results.txt", damaged_text(rng, _ocamcalib()))
    keys = "kind: mirror\nxi: 0.92\nfocal_px: 150.0\ncentre: [320.0, 240.0]\n"
    return written(folder / "camera.yaml", damaged_text(rng, keys))
