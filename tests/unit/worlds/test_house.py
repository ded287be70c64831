"""The house's camera: tilt, calibration, exposure, noise, mirror."""

import numpy as np
import pytest

from fgslam.cameras.omni import HyperbolicMirror
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.worlds import house as house_world
from fgslam.worlds.house import (
    camera_pose,
    camera_tilt,
    make_house_camera,
    miscalibrated,
)
from fgslam.worlds.renderer import noisy
from fgslam.worlds.settings import (
    HouseCalibrationSettings,
    HouseCameraSettings,
    OmniHouseSettings,
)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_tilt_is_bounded_and_leans_the_camera() -> None:
    assert np.linalg.norm(np.rad2deg(camera_tilt(2.0, rng(1)))) == pytest.approx(2.0)
    pitched = camera_pose(np.array([1.0, 2.0, 0.5]), 1.2, np.array([0.0, 0.1]))
    # Pitch about the left axis is nose down.
    np.testing.assert_allclose(pitched[2, 0], -np.sin(0.1))
    np.testing.assert_allclose(pitched[:3, 3], [1.0, 2.0, 1.2])
    rolled: FloatArray = camera_pose(np.zeros(3), 1.2, np.array([0.1, 0.0]))
    np.testing.assert_allclose(rolled[2, 1], np.sin(0.1))


def test_a_wrong_calibration_is_off_by_what_is_asked_for() -> None:
    true = make_house_camera(HouseCameraSettings())
    assert isinstance(true, HyperbolicMirror)
    assert miscalibrated(true, HouseCalibrationSettings(), rng()) is true
    errors = HouseCalibrationSettings(mirror=0.05, centre_px=4.0)
    for seed in range(8):
        wrong = miscalibrated(true, errors, rng(seed))
        assert isinstance(wrong, HyperbolicMirror)
        assert abs(wrong.xi / true.xi - 1.0) == pytest.approx(0.05)
        assert abs(wrong.focal_px / true.focal_px - 1.0) == pytest.approx(0.05)
        moved = np.subtract(wrong.frame.centre, true.frame.centre)
        assert np.hypot(*moved) == pytest.approx(4.0)
        assert (wrong.inner_radius, wrong.outer_radius) == (true.inner_radius, true.outer_radius)


def test_a_panorama_has_no_mirror_to_be_wrong_about() -> None:
    panorama, errors = HouseCameraSettings("equirectangular"), HouseCalibrationSettings(mirror=0.01)
    with pytest.raises(ValueError, match=r"dataset\.calibration has .* take mirror"):
        OmniHouseSettings(camera=panorama, calibration=errors)


def test_noise_is_that_of_its_name() -> None:
    levels = np.full((3, 20_000), 100.0, np.float32)
    seen = noisy(levels, 2.0, (1, 2, 3))
    assert seen.std() == pytest.approx(2.0, rel=0.03)
    np.testing.assert_array_equal(seen, noisy(levels, 2.0, (1, 2, 3)))
    assert not np.array_equal(seen, noisy(levels, 2.0, (1, 2, 4)))
    np.testing.assert_array_equal(levels, np.full((3, 20_000), 100.0, np.float32))


def test_mirror_shows_its_elevations(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = make_house_camera(HouseCameraSettings())
    rays = camera.rays(
        np.indices((camera.height, camera.width)).reshape(2, -1)[::-1].T.astype(float)
    )
    elevation = np.rad2deg(np.arcsin(rays[np.isfinite(rays[:, 0]), 2]))
    assert elevation.max() == pytest.approx(15.0, abs=0.5)
    assert elevation.min() == pytest.approx(-65.0, abs=3.0)
    monkeypatch.setattr(house_world, "MIRROR_XI", 0.5)
    monkeypatch.setattr(house_world, "MIRROR_ELEVATIONS_DEG", (-65.0, 40.0))
    with pytest.raises(CalibrationError, match="below arcsin"):
        make_house_camera(HouseCameraSettings())
