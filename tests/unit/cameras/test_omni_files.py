"""Cameras of camodocal and Kalibr that look straight up or down."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as PictureFile

from fgslam.cameras.omni import HyperbolicMirror, LensCamera, MirrorFrame, OmniCamera, angles_of
from fgslam.cameras.omni_files import KnownCamera, load_camera, storable
from fgslam.core.errors import CalibrationError
from fgslam.core.store import pack, unpack
from fgslam.datasets.opening import open_checked
from fgslam.datasets.settings import OmniPathSettings

MEI = """%YAML:1.0
---
model_type: MEI
camera_name: camera
image_width: 640
image_height: 480
mirror_parameters: {{ xi: 0.92 }}
distortion_parameters: {{ k1: {k1}, k2: 0.0, p1: {p1}, p2: 0.0 }}
projection_parameters: {{ gamma1: 120.0, gamma2: {gamma2}, u0: 321.5, v0: 236.25 }}
"""


def mei(folder: Path, k1: float = 0.0, p1: float = 0.0, gamma2: float = 120.0) -> Path:
    file = folder / "mei.yaml"
    file.write_text(MEI.format(k1=k1, p1=p1, gamma2=gamma2), encoding="utf-8")
    return file


def pixels_of(camera: OmniCamera) -> np.ndarray:
    """Pixels in the ring, of all directions."""
    angle, radius = np.meshgrid(np.linspace(-3.0, 3.0, 25), np.linspace(15.0, 220.0, 12))
    across, down = radius * np.cos(angle), radius * np.sin(angle)
    return np.column_stack([321.5 + across.ravel(), 236.25 + down.ravel()])


def test_without_distortion_it_is_the_mirror_of_that_xi(tmp_path: Path) -> None:
    camera = load_camera(mei(tmp_path), (640, 480))
    mirror = HyperbolicMirror(
        MirrorFrame(640, 480, (321.5, 236.25)), 0.0, 236.25, xi=0.92, focal_px=120.0
    )
    pixels = pixels_of(camera)
    rays = mirror.rays(pixels)
    np.testing.assert_allclose(camera.rays(pixels), rays, atol=1e-12)
    np.testing.assert_allclose(camera.pixels(3.0 * rays), pixels, atol=1e-9)
    assert np.isnan(camera.rays(np.array([[321.5 + 240.0, 236.25], [700.0, 10.0]]))).all()


@pytest.mark.parametrize("middle", ["down", "up"])
def test_distortion_that_is_not_radial_is_taken_whole(tmp_path: Path, middle: str) -> None:
    mei(tmp_path, k1=-0.02, p1=0.01, gamma2=121.0)
    (tmp_path / "keys.yaml").write_text(
        f"kind: lens\nfile: mei.yaml\nmiddle: {middle}\nahead_deg: 0\n", encoding="utf-8"
    )
    camera = load_camera(tmp_path / "keys.yaml")
    pixels = pixels_of(camera)
    rays = camera.rays(pixels)
    np.testing.assert_allclose(camera.pixels(rays), pixels, atol=1e-6)
    (bearing,), (elevation,) = angles_of(camera.rays(np.array([[321.5, 240.25]])))
    assert bearing == pytest.approx(np.pi / 2, abs=0.01)  # below: the left of what lies right
    assert np.sign(elevation) == (1.0 if middle == "up" else -1.0)
    assert unpack(pack(storable(camera)), KnownCamera) == camera
    with pytest.raises(CalibrationError, match=r"a str has no place in files; .*LensCamera"):
        storable("mine")  # type: ignore[arg-type]


def test_a_camchain_of_one_camera_is_one_too(tmp_path: Path) -> None:
    lens: dict[str, Any] = {
        "camera_model": "pinhole",
        "distortion_model": "equidistant",
        "distortion_coeffs": [0.0] * 4,
        "intrinsics": [150.0, 150.0, 321.5, 236.25],
        "resolution": [640, 480],
    }
    file = tmp_path / "camchain.yaml"
    file.write_text(json.dumps({"cam0": lens}), encoding="utf-8")
    _, (elevation,) = angles_of(load_camera(file).rays(np.array([[321.5 + 150.0, 236.25]])))
    assert elevation == pytest.approx(1.0 - np.pi / 2, abs=1e-12)
    for changed, said in (
        ({"cam0": lens, "cam1": lens | {"T_cn_cnm1": np.eye(4).tolist()}}, "is of 2 cameras"),
        ({"cam0": lens | {"distortion_model": "radtan"}}, "a radtan lens does not see all around"),
    ):
        file.write_text(json.dumps(changed), encoding="utf-8")
        with pytest.raises(CalibrationError, match=said):
            load_camera(file)


def test_where_the_middle_looks_is_said(tmp_path: Path) -> None:
    PictureFile.fromarray(np.zeros((480, 640, 3), np.uint8)).save(tmp_path / "0.png")
    mei(tmp_path)
    camera: dict[str, Any] = {"kind": "lens", "file": str(tmp_path / "mei.yaml")}
    settings = OmniPathSettings.__pydantic_validator__.validate_python(
        {"path": str(tmp_path), "camera": camera}
    )
    (note,) = open_checked(settings).notes
    assert "the picture's middle is taken to look down" in note
    with pytest.raises(CalibrationError, match=r"calibrates pictures of 640x480, but .* 320x240"):
        load_camera(tmp_path / "mei.yaml", (320, 240))
    assert isinstance(load_camera(tmp_path / "mei.yaml"), LensCamera)
