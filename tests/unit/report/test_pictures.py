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
from fgslam.core.geometry import se3_exp
from fgslam.core.types import Estimate, Features, LandmarkMap, Trajectory
from fgslam.report.figures import (
    LANDMARK_ELLIPSES,
    drive_from_above,
    error_by_axis,
    map_to_turn,
    matches_over_time,
)
from fgslam.report.homing_figures import Located, located_figure
from fgslam.report.pictures import (
    draw_disparities,
    draw_features,
    draw_figure,
    draw_flow,
    draw_views,
    oriented_squares,
)
from fgslam.report.results import ReportData, judged_report
from fgslam.runs.tables import picture_title

YELLOW = np.array([0xF0, 0xE4, 0x42]) / 255.0


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few dots an inch: the same drawing, several times faster."""
    monkeypatch.setattr("fgslam.report.pictures.DPI", 50)


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


def results(n: int, frames: int, *, full: bool) -> ReportData:
    """One estimator with n landmarks; its truth and covariances where ``full``."""
    rng = np.random.default_rng(4)
    steps = [np.array([0, 0.03 * i, 0, 0, 0, 0.1 * i]) for i in range(frames)]
    poses = np.array([se3_exp(xi) for xi in steps]).reshape(-1, 4, 4)
    path = Trajectory(0.5 * np.arange(frames), poses)
    covariances = np.tile(1e-4 * np.eye(6) if full else np.full((6, 6), np.nan), (frames, 1, 1))
    unknown = 0.01 * np.eye(3) if full else np.full((3, 3), np.nan)
    positions = rng.normal(scale=3.0, size=(n, 3))
    landmarks = LandmarkMap(np.arange(n), positions, np.tile(unknown, (n, 1, 1)))
    truth = path if full and frames else None
    report = judged_report("a", "a", Estimate(path, covariances, landmarks), None, truth)
    return ReportData("", "", (report,), truth)


def located(n: int) -> Located:
    """Every second query is found, the last of them somewhere else."""
    poses = results(n, n, full=True).estimators[0].final_poses
    found = np.arange(n) % 2 == 0
    false = found & (np.arange(n) == 2)
    covariances = np.tile(1e-4 * np.eye(6), (n, 1, 1))
    drive = np.tile(np.eye(4), (2, 1, 1))
    drive[1, 2, 3] = 5.0
    return Located(np.zeros((n, 3)), drive, found, poses, covariances, poses, false)


def all_pictures(n: int, *, full: bool) -> dict[str, Callable[[Path], None]]:
    images = (grey(), grey(), grey()) if full else (grey(), grey())
    counts = np.arange(n)
    return {
        "features": lambda p: draw_features(p, images, (features(n),) * len(images), "Frame 1"),
        "disparities": lambda p: draw_disparities(p, grey(), pixels(n, len(images))),
        "flow": lambda p: draw_flow(p, grey(), features(n).xy, features(n, 9).xy),
        "above": lambda p: draw_figure(p, drive_from_above(results(n, n, full=full)), "Above"),
        "views": lambda p: draw_views(p, map_to_turn(results(n, n, full=full)), "Map"),
        "errors": lambda p: draw_figure(p, error_by_axis(results(n, n, full=full)), "Errors"),
        "matches": lambda p: draw_figure(
            p, matches_over_time(counts, counts + 5, counts, 10 * counts), "Matches"
        ),
        "located": lambda p: draw_figure(p, located_figure(located(n), "k", "Found"), "Found"),
    }


@pytest.mark.usefixtures("coarse")
@pytest.mark.parametrize("name", list(all_pictures(0, full=False)))
def test_every_picture_is_drawn_from_nothing(tmp_path: Path, name: str) -> None:
    all_pictures(0, full=False)[name](tmp_path / "a.png")
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
    picture = imread(tmp_path / "a.png")
    assert min(picture.shape[:2]) > 100
    assert picture[..., :3].std() > 0.02
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


def test_poses_that_no_landmark_measured_are_counted_in_every_title() -> None:
    title = picture_title("drive: matches", 2, synthetic=True)
    assert title == "drive: matches, 2 poses predicted, synthetic odometry"
    assert picture_title("drive: matches", 0, synthetic=False) == "drive: matches"


@pytest.mark.usefixtures("coarse")
def test_what_a_page_hides_at_first_is_printed_where_it_is_named(tmp_path: Path) -> None:
    figure = drive_from_above(results(5, 5, full=True))
    seen = {trace.name for trace in figure.drawing.data if trace.visible is True}
    assert LANDMARK_ELLIPSES not in seen
    assert {"a, final", "truth", "start", "landmarks of a"} <= seen
    draw_figure(tmp_path / "without.png", figure, "Above")
    draw_figure(tmp_path / "with.png", figure, "Above", {LANDMARK_ELLIPSES})
    assert (tmp_path / "without.png").read_bytes() != (tmp_path / "with.png").read_bytes()


def test_located_poses_refusals_and_false_ones_differ() -> None:
    names = [t.name for t in located_figure(located(8), "k", "Found").drawing.data]
    assert {"found", "found, but false", "refused", "to the true pose"} <= set(names)
