"""Images with what was found in them: the geometry, the same bytes twice, nothing in them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from fgslam.core.arrays import Image
from fgslam.core.errors import OutputError
from fgslam.core.types import Estimate, Features, LandmarkMap, Trajectory
from fgslam.report.overlays import (
    draw_disparities,
    draw_features,
    draw_flow,
    draw_plan,
    oriented_squares,
)
from fgslam.report.results import ReportData, judged_report

YELLOW = np.array([0xF0, 0xE4, 0x42]) / 255.0


def imread(path: Path) -> np.ndarray:
    """Red, green, blue from 0 to 1."""
    picture = cv2.imread(str(path))
    assert picture is not None
    return picture[..., ::-1] / 255.0


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


def drive(n: int, *, full: bool) -> ReportData:
    """n poses to the right, one a metre; truth is half a metre ahead of them."""
    poses = np.tile(np.eye(4), (max(n, 1), 1, 1))
    poses[:, 0, 3] = np.arange(len(poses))
    path = Trajectory(np.arange(float(len(poses))), poses)
    points = np.random.default_rng(4).uniform(-3.0, n + 3.0, (n, 3))
    landmarks = LandmarkMap(np.arange(n), points, np.zeros((n, 3, 3)))
    estimate = Estimate(path, np.full((len(poses), 6, 6), np.nan), landmarks)
    report = judged_report("a", "a", estimate, None, path if full else None)
    return ReportData("drive", "", estimators=(report,), truth=path if full else None)


def all_overlays(n: int, *, full: bool) -> dict[str, Callable[[Path], None]]:
    images = (grey(), grey(), grey()) if full else (grey(), grey())
    return {
        "features": lambda p: draw_features(p, images, (features(n),) * len(images), "Frame 1"),
        "disparities": lambda p: draw_disparities(p, grey(), pixels(n, len(images))),
        "flow": lambda p: draw_flow(p, grey(), features(n).xy, features(n, 9).xy),
        "plan": lambda p: draw_plan(p, drive(n, full=full)),
    }


@pytest.mark.parametrize("name", list(all_overlays(0, full=False)))
def test_every_overlay_is_drawn_of_nothing_and_twice_alike(tmp_path: Path, name: str) -> None:
    for count, full in ((0, False), (25, True)):
        draw = all_overlays(count, full=full)[name]
        draw(tmp_path / "a.png")
        draw(tmp_path / "b.png")
        picture = imread(tmp_path / "a.png")
        assert min(picture.shape[:2]) > 100
        assert picture.std() > 0.02
        assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


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


def test_only_images_with_features_are_drawn(tmp_path: Path) -> None:
    """On key frames of carried landmarks SIFT sees the reference image alone."""
    white = np.full((120, 160), 255, np.uint8)
    aspects = []
    for seen in (1, 2, 3):
        draw_features(tmp_path / f"{seen}.png", (white,) * 3, (features(4),) * seen)
        height, width = imread(tmp_path / f"{seen}.png").shape[:2]
        aspects.append(width / height)
    assert aspects[1] > 1.5 * aspects[0]
    assert aspects[2] > 1.3 * aspects[1]


def test_disparities_have_their_length_and_the_colours_their_bar(tmp_path: Path) -> None:
    black = np.zeros((120, 160), np.uint8)
    one = np.array([[[20.0, 60.0], [100.0, 60.0], [np.nan, np.nan]]])
    draw_disparities(tmp_path / "a.png", black, one)
    picture = imread(tmp_path / "a.png")
    # The only line is of the lowest colour, violet: 80 of 160 columns long.
    row = picture[44 + round(60.5 / 120 * (len(picture) - 44))]
    scale = (len(picture) - 44) / 120
    coloured = np.flatnonzero(row.max(axis=1)[: round(160 * scale)] > 0.3)
    assert coloured.max() - coloured.min() == pytest.approx(80 * scale, abs=1.5 * scale)


def test_the_plan_keeps_shape_and_scale(tmp_path: Path) -> None:
    draw_plan(tmp_path / "a.png", drive(11, full=False))
    picture = imread(tmp_path / "a.png")
    sky = np.array([0x56, 0xB4, 0xE9]) / 255.0
    columns = np.flatnonzero((np.abs(picture - sky).max(axis=2) < 0.1).any(axis=0))
    # Ten metres to the right; the scale below them is 5 m long.
    ink = np.flatnonzero((picture[-16:-14] < 0.3).all(axis=(0, 2)))
    assert np.ptp(columns) == pytest.approx(2.0 * np.ptp(ink), rel=0.05)
