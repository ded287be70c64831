"""Pictures: the geometry that they draw, the same bytes twice, and inputs with nothing in them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib.image import imread

from fgslam.core.arrays import Image
from fgslam.core.errors import OutputError
from fgslam.core.features import Features
from fgslam.core.geometry import pose, se3_exp, so3_exp
from fgslam.report.pictures import (
    MapDrawing,
    draw_birds_eye,
    draw_disparities,
    draw_errors,
    draw_features,
    draw_flow,
    draw_map_views,
    draw_matches,
    style,
)
from fgslam.report.pictures.birds_eye import exaggeration, view_limits, world_position_covariances
from fgslam.report.pictures.image_overlays import oriented_squares
from fgslam.report.pictures.map_views import Viewer

YELLOW = np.array([0xF0, 0xE4, 0x42]) / 255.0


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few dots an inch: the same drawing, several times faster."""
    monkeypatch.setattr(style, "DPI", 50)


def features(n: int, seed: int = 1) -> Features:
    rng = np.random.default_rng(seed)
    return Features(
        xy=rng.uniform([0, 0], [160, 120], (n, 2)),
        scale=rng.uniform(1, 6, n),
        orientation=rng.uniform(0, 2 * np.pi, n),
        descriptors=np.zeros((n, 128), np.uint8),
    )


def grey(seed: int = 2) -> Image:
    return np.random.default_rng(seed).integers(0, 255, (120, 160), dtype=np.uint8)


def pixels(n: int, cameras: int) -> np.ndarray:
    right = np.random.default_rng(3).uniform(20, 100, (n, 2))
    disparity = np.linspace(1, 30, n)
    left, top = right.copy(), right.copy()
    left[:, 0] += disparity
    top[:, 1] += disparity if cameras == 3 else np.nan
    return np.stack([right, left, top], axis=1)


def drawing(n: int, frames: int, *, full: bool) -> MapDrawing:
    rng = np.random.default_rng(4)
    steps = [np.array([0, 0.03 * i, 0, 0, 0, 0.1 * i]) for i in range(frames)]
    poses = np.array([se3_exp(xi) for xi in steps]).reshape(-1, 4, 4)
    return MapDrawing(
        rng.normal(scale=3.0, size=(n, 3)),
        poses,
        np.tile(0.01 * np.eye(3), (n, 1, 1)) if full else None,
        np.tile(1e-4 * np.eye(6), (frames, 1, 1)) if full else None,
        poses if full else None,
    )


def all_pictures(n: int, *, full: bool) -> dict[str, Callable[[Path], None]]:
    images = (grey(), grey(), grey()) if full else (grey(), grey())
    counts = np.arange(n)
    sigmas = np.full((n, 3), 0.02) if full else None
    return {
        "features": lambda p: draw_features(p, images, (features(n),) * len(images), "Frame 1"),
        "disparities": lambda p: draw_disparities(p, grey(), pixels(n, len(images))),
        "flow": lambda p: draw_flow(p, grey(), features(n).xy, features(n, 9).xy),
        "birds_eye": lambda p: draw_birds_eye(p, drawing(n, n, full=full)),
        "views": lambda p: draw_map_views(p, drawing(n, n, full=full)),
        "errors": lambda p: draw_errors(p, 0.5 * counts, np.full((n, 3), 0.01), sigmas),
        "matches": lambda p: draw_matches(p, counts, counts + 5, counts, 10 * counts),
    }


@pytest.mark.usefixtures("coarse")
@pytest.mark.parametrize("name", list(all_pictures(0, full=False)))
@pytest.mark.parametrize(("n", "full"), [(0, False), (0, True), (1, False), (40, True)])
def test_every_picture_is_drawn_from_much_little_and_nothing(
    tmp_path: Path, name: str, n: int, full: bool
) -> None:
    all_pictures(n, full=full)[name](tmp_path / "a.png")
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
    picture = imread(tmp_path / "a.png")
    assert min(picture.shape[:2]) > 100
    assert picture[..., :3].std() > 0.02


@pytest.mark.usefixtures("coarse")
@pytest.mark.parametrize("name", list(all_pictures(0, full=False)))
def test_same_input_same_bytes_whatever_the_users_style(tmp_path: Path, name: str) -> None:
    draw = all_pictures(25, full=True)[name]
    draw(tmp_path / "a.png")
    with matplotlib.rc_context({"font.size": 30, "lines.linewidth": 9, "axes.grid": True}):
        before = dict(matplotlib.rcParams)
        draw(tmp_path / "b.png")
        assert dict(matplotlib.rcParams) == before
    content = (tmp_path / "a.png").read_bytes()
    assert content == (tmp_path / "b.png").read_bytes()
    assert b"tEXtSoftware" not in content
    assert b"tEXtCreation" not in content


def test_pictures_need_no_display_and_no_pyplot() -> None:
    code = "import sys, fgslam.report.pictures; print('matplotlib.pyplot' in sys.modules)"
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "False"


def test_unwritable_path_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="does not exist"):
        draw_flow(tmp_path / "absent" / "a.png", grey(), np.zeros((0, 2)), np.zeros((0, 2)))


# --------------------------------------------------------------------------------------------
# What is drawn


def test_squares_have_side_and_orientation_of_the_feature() -> None:
    shown = oriented_squares(features(30))
    given = features(30)
    corners = shown[:, 1:5]
    sides = np.linalg.norm(np.diff(corners, axis=1), axis=2)
    np.testing.assert_allclose(sides, np.tile(4.0 * given.scale[:, None], (1, 3)))
    np.testing.assert_allclose(corners.mean(axis=1), given.xy)
    stroke = shown[:, -2] - shown[:, -1]
    np.testing.assert_allclose(shown[:, -1], given.xy)
    angles = np.arctan2(stroke[:, 1], stroke[:, 0]) % (2 * np.pi)
    np.testing.assert_allclose(angles, given.orientation)
    np.testing.assert_allclose(np.linalg.norm(stroke, axis=1), 2.0 * given.scale)


def test_feature_appears_where_it_was_found(tmp_path: Path) -> None:
    one = Features(
        xy=np.array([[120.0, 90.0]]),
        scale=np.array([5.0]),
        orientation=np.zeros(1),
        descriptors=np.zeros((1, 128), np.uint8),
    )
    black = np.zeros((120, 160), np.uint8)
    none = features(0)
    draw_features(tmp_path / "a.png", (black, black), (one, none))
    picture = imread(tmp_path / "a.png")[..., :3]
    columns = np.flatnonzero((np.abs(picture - YELLOW).max(axis=2) < 0.1).any(axis=0))
    # The left image is on the left half; the right one has the feature at 3/4 of its width.
    dark = np.flatnonzero((picture.max(axis=2) < 0.05).any(axis=0))
    gap = dark[np.argmax(np.diff(dark)) + 1]
    width = dark[-1] - gap
    assert columns.min() > gap
    assert 0.5 * (columns.min() + columns.max()) - gap == pytest.approx(0.75 * width, abs=4)
    assert columns.max() - columns.min() == pytest.approx(20 / 160 * width, abs=6)


def test_far_landmarks_do_not_shrink_the_map() -> None:
    rng = np.random.default_rng(5)
    near = rng.uniform(-5, 5, (500, 3))
    far = np.array([[900.0, 0.0, 4000.0]])
    path = np.array([pose(np.eye(3), [0, 0, z]) for z in (0.0, 7.5)])
    (left, right), (bottom, top) = view_limits(MapDrawing(np.concatenate([near, far]), path))
    assert -6 < left < -4 < 4 < right < 6
    assert -6 < bottom < -4
    assert 7.5 < top < 9


@pytest.mark.parametrize("sigma", [1e-5, 1e-3, 0.02, 1.0])
def test_pose_ellipses_are_enlarged_just_enough(sigma: float) -> None:
    factor = exaggeration(np.tile(sigma**2 * np.eye(2), (10, 1, 1)), span=10.0)
    width = 2 * 2.4477 * sigma
    assert factor == 1000 or factor * width >= 0.2
    assert factor == 1 or (factor / 2.5) * width < 0.2
    assert exaggeration(np.zeros((3, 2, 2)), span=10.0) == 1


def test_position_covariance_is_turned_into_the_world() -> None:
    rng = np.random.default_rng(6)
    wTc = pose(so3_exp(np.array([0.2, 1.0, -0.3])), [1.0, 2.0, 3.0])
    root = 0.01 * rng.normal(size=(6, 6))
    covariance = root @ root.T
    samples = rng.multivariate_normal(np.zeros(6), covariance, 20000)
    positions = np.array([(wTc @ se3_exp(xi))[:3, 3] for xi in samples])
    expected = np.cov(positions.T)
    found = world_position_covariances(wTc[None], covariance[None])[0]
    np.testing.assert_allclose(found, expected, atol=0.05 * np.trace(expected))


def test_viewer_is_a_pinhole() -> None:
    target = np.array([1.0, -2.0, 3.0])
    up = np.array([0.0, -1.0, 0.0])
    viewer = Viewer.looking_at(target, np.array([1.0, 0.0, 0.0]), up, distance=10.0)
    np.testing.assert_allclose(viewer.eye, target + np.array([10.0, 0.0, 0.0]))
    # Seen from the right of the map: ahead (z) lies to the viewer's right, height is up.
    points = target + np.array([[0, 0, 0], [0, -1, 0], [0, 0, 2], [5, 0, 2], [11, 0, 0.0]])
    page, nearness, ahead = viewer.project(points)
    np.testing.assert_allclose(page[:4], [[0, 0], [0, 1], [2, 0], [4, 0]], atol=1e-12)
    np.testing.assert_allclose(nearness[:4], [1, 1, 1, 2])
    np.testing.assert_array_equal(ahead, [True, True, True, True, False])
