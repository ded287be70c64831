"""OCamCalib's polynomial camera and its result file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.polynomial import polynomial

from fgslam.cameras.omni import OCamCalibration, angles_of, read_ocamcalib
from fgslam.core.errors import CalibrationError

DIRECT = (-266.588, 0.0, 1.220001e-3, -5.78173e-7, 2.003631e-9)
RING = (235.0, 530.0)


def inverse_polynomial(degree: int = 12) -> np.ndarray:
    """Radius over the angle atan(f / rho), as OCamCalib fits it."""
    radius = np.linspace(*RING, 400)
    angle = np.arctan2(polynomial.polyval(radius, DIRECT), radius)
    return polynomial.polyfit(angle, radius, degree)


def text(**changes: str) -> str:
    inverse = inverse_polynomial()
    entries = {
        "direct": f"{len(DIRECT)} " + " ".join(f"{a:.9e}" for a in DIRECT),
        "inverse": f"{len(inverse)} " + " ".join(f"{a:.9f}" for a in inverse),
        "centre": "545.872616 674.318875",
        "affine": "0.999 0.003 0.002",
        "size": "1080 1300",
        "ring": "530 235",
        "crop": "300 320",
    } | changes
    comments = {"ring": "#ROI max min radius", "crop": "#left right cropped pixel"}
    return "\n\n".join(f"{comments.get(k, '#' + k)}\n\n{v}" for k, v in entries.items() if v)


@pytest.fixture
def calibration(tmp_path: Path) -> OCamCalibration:
    return read(tmp_path, text())


def read(folder: Path, content: str) -> OCamCalibration:
    path = folder / "calib_results.txt"
    path.write_text(content, encoding="utf-8")
    return read_ocamcalib(path)


def test_calibration_file_is_read_in_full(calibration: OCamCalibration) -> None:
    assert calibration.direct == DIRECT
    assert calibration.centre == (545.872616, 674.318875)
    assert calibration.affine == (0.999, 0.003, 0.002)
    assert (calibration.width, calibration.height) == (1300, 1080)
    assert calibration.ring == RING
    assert calibration.cropped == (300, 320)
    assert calibration.disagreement(RING) < 0.05


def test_comments_stand_beside_values_too(calibration: OCamCalibration, tmp_path: Path) -> None:
    noted = text(centre="545.872616, 674.318875  # row, column", affine="0.999 0.003 0.002 % c d e")
    assert read(tmp_path, noted.replace("#ROI", "% ROI")) == calibration
    assert read(tmp_path, noted.replace("#", "#\n#")) == calibration  # an empty one is none


def test_pixels_are_exact_where_the_inverse_polynomial_is_not(calibration: OCamCalibration) -> None:
    camera = calibration.camera()
    rng = np.random.default_rng(6)
    pixels = rng.uniform(0.0, 1.0, (20_000, 2)) * [1299, 1079]
    rays = camera.rays(pixels)
    seen = np.isfinite(rays[:, 0])
    assert 0.4 < seen.mean() < 0.7
    np.testing.assert_allclose(camera.pixels(2.0 * rays[seen]), pixels[seen], atol=1e-9)


def test_rays_follow_the_toolboxs_definition(calibration: OCamCalibration) -> None:
    """(x, y) by the inverse of [[c, d], [e, 1]] on rows and columns, then (x, y, f(rho))."""
    pixels = np.array([[900.0, 300.0], [300.0, 800.0], [674.0, 100.0]])
    c, d, e = calibration.affine
    offset = pixels[:, ::-1] - calibration.centre
    x, y = np.linalg.solve(np.array([[c, d], [e, 1.0]]), offset.T)
    rho = np.hypot(x, y)
    f = polynomial.polyval(rho, DIRECT)
    bearing, elevation = angles_of(calibration.camera(ahead=0.0, clockwise=True).rays(pixels))
    np.testing.assert_allclose(elevation, np.arctan2(f, rho), atol=1e-12)
    np.testing.assert_allclose(bearing, np.arctan2(x, y), atol=1e-12)


def test_an_uncropped_picture_has_its_centre_further_right(calibration: OCamCalibration) -> None:
    cropped, whole = calibration.camera(), calibration.camera((1920, 1080))
    pixels = np.array([[900.0, 300.0], [300.0, 800.0]])
    np.testing.assert_array_equal(cropped.rays(pixels), whole.rays(pixels + np.array([300.0, 0.0])))
    with pytest.raises(CalibrationError, match=r"1300x1080 \(or 1920x1080 uncropped\).*640x480"):
        calibration.camera((640, 480))


def test_without_a_ring_the_largest_circle_is_taken(tmp_path: Path) -> None:
    plain = read(tmp_path, text(ring="", crop=""))
    assert plain.ring is None
    assert plain.camera().outer_radius == pytest.approx(1079 - 545.872616)
    assert plain.camera(ring=(240.0, 300.0)).inner_radius == 240.0
    with pytest.raises(CalibrationError, match="pictures of 1300x1080, but"):
        plain.camera((1920, 1080))


@pytest.mark.parametrize(
    ("content", "reported"),
    [
        (text(direct="5 -266 0 1e-3 -5e-7"), "line 3: direct.*states 5 .* has 4"),
        (text(direct="5 -266 0 1e-3 -5e-7 x"), "line 3: direct.*'x' is no finite number"),
        (text(inverse="2 nan 3"), "line 7: inverse.*'nan'"),
        (text(centre="545.9"), "line 11: centre.*1 numbers, expected 2"),
        (text(affine="1 0"), "line 15: affine.*2 numbers, expected 3"),
        (text(affine="0 1 1"), "c - d e > 0"),
        (text(size="1080.5 1300"), "line 19: size.*whole numbers"),
        (text(size="0 0"), "at least 2x2"),
        (text(centre="5450 674"), "lies outside the 1300x1080 picture"),
        (text(ring="235 530"), "line 23: ring: largest radius 235"),
        (text(crop="300"), "line 27: cropped"),
        (text(extra="1 2 3"), "line 31: an entry that is not known"),
        (text(direct="5 266 0 -1e-3 5e-7 -2e-9"), "turns back|inverse polynomial is"),
        (text(inverse="2 400.0 300.0"), "inverse polynomial is .* px off"),
        ("#only a comment\n", "has 0 entries"),
        ("5 1 2 3 4 5\n", "has 1 entries"),
    ],
)
def test_malformed_files_name_the_line(tmp_path: Path, content: str, reported: str) -> None:
    with pytest.raises(CalibrationError, match=reported) as caught:
        read(tmp_path, content)
    assert "calib_results.txt" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unreadable_files(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"cannot read .*No such file"):
        read_ocamcalib(tmp_path / "absent.txt")
    (tmp_path / "binary.txt").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(CalibrationError, match="it is not text"):
        read_ocamcalib(tmp_path / "binary.txt")
