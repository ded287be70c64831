"""The public functions of homing: what they accept, and how they refuse wrong use."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fgslam as fg
from fgslam.core.arrays import Image
from fgslam.core.bearings import RefusalReason
from fgslam.core.errors import (
    CalibrationError,
    ConfigError,
    EstimatorError,
    FgslamError,
    FrameError,
    SessionError,
    StoredMapError,
)
from fgslam.homing.steering import HomingState

CAMERA = fg.load_camera("equirectangular", size=(256, 128))


def picture(seed: int) -> Image:
    """(128, 256, 3) blocks of random colours."""
    small = np.random.default_rng(seed).integers(0, 255, (16, 32, 3)).astype(np.uint8)
    return np.kron(small, np.ones((8, 8, 1), np.uint8))


@pytest.fixture(scope="module")
def path() -> fg.PathMemory:
    return fg.teach([picture(0), picture(1)], CAMERA)


def test_two_images_from_one_place_are_refused_with_their_rotation() -> None:
    image = picture(0)
    turned = np.concatenate([image[:, 64:-1], image[:, :64], image[:, 64:65]], axis=1)
    answer = fg.HomingVector(CAMERA).between(image, turned)
    assert not answer
    assert isinstance(answer, fg.Refusal)
    assert answer.reason is RefusalReason.AT_TARGET
    assert answer.rotation == pytest.approx(-np.pi / 2, abs=0.03)


def test_unrelated_images_are_refused() -> None:
    answer = fg.HomingVector(CAMERA).between(picture(0), picture(1))
    assert isinstance(answer, fg.Refusal)
    assert answer.details


@pytest.mark.parametrize("dark", [0, 1])
def test_a_dark_image_is_refused_whichever_it_is(dark: int) -> None:
    images = [picture(0), picture(0)]
    images[dark] = np.zeros_like(images[dark])
    answer = fg.HomingVector(CAMERA).between(*images)
    assert isinstance(answer, fg.Refusal)
    assert answer.reason is RefusalReason.TOO_DARK


def test_views_and_grey_images_are_accepted_and_left_alone() -> None:
    wide = np.zeros((256, 512, 3), np.uint8)
    wide[::2, ::2] = picture(0)
    view, before = wide[::2, ::2], wide.copy()
    homing = fg.HomingVector(CAMERA)
    assert homing.between(view, view) == homing.between(picture(0), picture(0))
    grey = picture(0)[..., 0]
    assert homing.between(grey, grey) == homing.between(
        np.repeat(grey[..., None], 3, 2), np.repeat(grey[..., None], 3, 2)
    )
    np.testing.assert_array_equal(wide, before)


def _follower(**settings: Any) -> fg.PathFollower:
    return fg.PathFollower(CAMERA, fg.teach([picture(0)], CAMERA), **settings)


WRONG: dict[str, tuple[Callable[[], object], type[FgslamError], str]] = {
    "camera": (lambda: fg.HomingVector("x.txt"), CalibrationError, "load_camera"),  # type: ignore[arg-type]
    "setting": (lambda: fg.HomingVector(CAMERA, sample=3), ConfigError, "did you mean samples"),
    "bound": (lambda: fg.HomingVector(CAMERA, samples=0), ConfigError, "samples is 0"),
    "seed": (lambda: fg.HomingVector(CAMERA, seed=-1), ConfigError, "seed is -1"),
    "rows": (
        lambda: fg.HomingVector(CAMERA).between([[1, 2], [3]], picture(0)),  # type: ignore[list-item]
        FrameError,
        "image_a has rows of different lengths",
    ),
    "size": (
        lambda: fg.HomingVector(CAMERA).between(picture(0), picture(0)[:64]),
        FrameError,
        "image_b has shape (64, 256, 3)",
    ),
    "type": (
        lambda: fg.HomingVector(CAMERA).between(picture(0) / 255.0, picture(0)),
        FrameError,
        "image_a is of type float64",
    ),
    "no image": (
        lambda: fg.HomingVector(CAMERA).between(picture(0), None),  # type: ignore[arg-type]
        FrameError,
        "image_b is missing (None); could its file be read?",
    ),
    "nothing taught": (lambda: fg.teach([], CAMERA), StoredMapError, "at least one"),
    "names": (lambda: fg.teach([picture(0)], CAMERA, names=["a", "b"]), StoredMapError, "2 names"),
    "image for time": (
        lambda: _follower().step(0.0, picture(0)),  # type: ignore[arg-type]
        EstimatorError,
        "the time stamp of type ndarray is not a number",
    ),
    "names of a drive": (
        lambda: fg.teach([picture(0)], CAMERA, names=["a", "b"], select=True),
        StoredMapError,
        "2 names for 1 images",
    ),
    "dark target": (
        lambda: fg.teach([picture(0), 0 * picture(0)], CAMERA), StoredMapError, "image 1 cannot"
    ),
    "features": (
        lambda: fg.teach([picture(0)], CAMERA, features="sift"),  # type: ignore[arg-type]
        ConfigError,
        "settings are a str; give a fgslam.frontend.settings.OmniFeatureSettings",
    ),
    "front-end": (
        lambda: _follower(front_end={}),
        ConfigError,
        "settings are a dict",
    ),
    "path": (
        lambda: fg.PathFollower(CAMERA, [picture(0)]),  # type: ignore[arg-type]
        StoredMapError,
        "fgslam.teach",
    ),
    "no camera file": (lambda: fg.load_camera("absent.txt"), CalibrationError, "absent.txt"),
    "no size": (lambda: fg.load_camera("mirror"), CalibrationError, "size=(width, height)"),
    "size of words": (
        lambda: fg.load_camera("mirror", ("wide", 3)),  # type: ignore[arg-type]
        CalibrationError,
        "give (width, height)",
    ),
    "no kind": (lambda: fg.load_camera({"xi": 1.0}), CalibrationError, "equirectangular"),
    "camera's key": (
        lambda: fg.load_camera({"kind": "mirror", "x": 1.0}, (320, 240)), ConfigError, "setting x"
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_wrong_use_is_answered_in_one_line_that_says_what_to_do(case: str) -> None:
    use, error, words = WRONG[case]
    with pytest.raises(error) as caught:
        use()
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    assert ";" in str(caught.value)


def test_an_unknown_estimator_is_refused_with_the_nearest_name(path: fg.PathMemory) -> None:
    with pytest.raises(ConfigError, match="did you mean homing_graph"):
        fg.PathFollower(CAMERA, path, "homing_grap")


@pytest.mark.parametrize("time", [float("nan"), float("inf"), 0.5, 0.4, "1.0", None, 17e17])
def test_wrong_times_are_refused_and_change_nothing(path: fg.PathMemory, time: float) -> None:
    tried, fresh = fg.PathFollower(CAMERA, path), fg.PathFollower(CAMERA, path)
    for follower in (tried, fresh):
        follower.step(picture(2), 0.5)
    with pytest.raises(EstimatorError, match="time"):
        tried.step(picture(2), time)
    with pytest.raises(FrameError, match="shape"):
        tried.step(picture(2)[:7], 0.6)
    assert tried.step(picture(2), 0.6).reason == fresh.step(picture(2), 0.6).reason


def test_a_closed_follower_refuses_images(path: fg.PathMemory) -> None:
    with fg.PathFollower(CAMERA, path) as follower:
        assert follower.step(picture(2), 0.0).state is HomingState.INITIALISE
    with pytest.raises(SessionError, match="closed"):
        follower.step(picture(2), 1.0)
    with pytest.raises(SessionError, match="closed"):
        follower.driven(0.0, 0.0, 0.1)
    assert [leg.result for leg in follower.legs] == ["unfinished"]


def test_what_the_robot_drove_must_be_finite(path: fg.PathMemory) -> None:
    with pytest.raises(EstimatorError, match="finite"):
        fg.PathFollower(CAMERA, path).driven(0.1, float("nan"), 0.1)
    with pytest.raises(EstimatorError, match="not negative"):
        fg.PathFollower(CAMERA, path).driven(0.1, 0.0, -0.1)


def test_cameras_come_from_files_keys_and_kinds(tmp_path: Path) -> None:
    keys = {"kind": "mirror", "xi": 0.9, "size": [320, 240]}
    (tmp_path / "camera.yaml").write_text("kind: mirror\nxi: 0.9\nsize: [320, 240]\n")
    assert fg.load_camera(tmp_path / "camera.yaml") == fg.load_camera(keys)
    cylinder = fg.load_camera({"kind": "cylinder", "top_elevation_deg": 30.0}, size=(361, 101))
    rays = cylinder.rays(np.array([[180.0, 0.0], [90.0, 100.0]]))
    elevation = np.degrees(np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1])))
    np.testing.assert_allclose(elevation, [30.0, -45.0], rtol=0, atol=1e-9)
    bearing = np.degrees(np.arctan2(rays[:, 1], rays[:, 0]))
    np.testing.assert_allclose(bearing, [0.0, 90.0], rtol=0, atol=1e-9)
