"""Intrinsics of one camera as RealSense, Open3D and people write them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fgslam.cameras.lenses import RawCamera
from fgslam.cameras.rig import read_calibration_file
from fgslam.core.errors import CalibrationError

K = [[600.0, 0.0, 320.0], [0.0, 601.0, 240.0], [0.0, 0.0, 1.0]]
RS2 = {"fx": 600.0, "fy": 601.0, "ppx": 320.0, "ppy": 240.0}
PLAIN = {"fx": 600.0, "fy": 601.0, "cx": 320.0, "cy": 240.0}
LENS = [0.1, -0.2, 0.001, 0.002, 0.05]


def read(folder: Path, **values: Any) -> RawCamera:
    path = folder / "intrinsics.json"
    path.write_text(json.dumps({"width": 640, "height": 480, **values}), encoding="utf-8")
    return read_calibration_file(path).cameras[0]


@pytest.mark.parametrize("matrix", [K, np.ravel(K).tolist(), np.transpose(K).ravel().tolist()])
def test_a_matrix_by_rows_or_by_columns(tmp_path: Path, matrix: list[Any]) -> None:
    assert np.array_equal(read(tmp_path, intrinsic_matrix=matrix).matrix, K)


def test_a_matrix_that_is_none_of_a_camera(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="must end with the row 0 0 1"):
        read(tmp_path, intrinsic_matrix=[*np.ravel(K)[:8].tolist(), 2.0])


@pytest.mark.parametrize(
    ("model", "lens"),
    [
        ("Brown Conrady", "radtan"),
        ("RS2_DISTORTION_MODIFIED_BROWN_CONRADY", "radtan"),
        ("distortion.brown_conrady", "radtan"),
        (4, "radtan"),
        ("Kannala Brandt4", "equidistant"),
        (5, "equidistant"),
    ],
)
def test_lenses_by_the_model_that_is_stated(tmp_path: Path, model: object, lens: str) -> None:
    camera = read(tmp_path, **RS2, model=model, coeffs=LENS)
    assert camera.model == lens
    assert camera.distortion.tolist() == LENS[: 4 if lens == "equidistant" else 5]


@pytest.mark.parametrize("model", ["F-Theta", "Inverse Brown Conrady", 2, 3, "none"])
def test_lenses_that_are_not_known(tmp_path: Path, model: object) -> None:
    assert not read(tmp_path, **RS2, model=model, coeffs=[0.0] * 5).distortion.any()
    with pytest.raises(CalibrationError, match="is not known with coefficients other than 0"):
        read(tmp_path, **RS2, model=model, coeffs=LENS)


@pytest.mark.parametrize(
    "lens", [dict(zip(("k1", "k2", "p1", "p2", "k3"), LENS, strict=True)), {"distortion": LENS}]
)
def test_the_lens_beside_plain_numbers_is_read(tmp_path: Path, lens: dict[str, Any]) -> None:
    assert read(tmp_path, **PLAIN, **lens).distortion.tolist() == LENS


def test_a_fisheye_by_single_numbers_must_say_so(tmp_path: Path) -> None:
    four = {f"k{k}": 0.01 * k for k in (1, 2, 3, 4)}
    with pytest.raises(CalibrationError, match="without p1, p2 need"):
        read(tmp_path, **PLAIN, **four)
    camera = read(tmp_path, **PLAIN, **four, model="fisheye")
    assert (camera.model, camera.distortion.tolist()) == ("equidistant", list(four.values()))
