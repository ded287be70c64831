"""Pictures: the geometry that they draw, the same bytes twice, and inputs with nothing in them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib.image import imread

from fgslam.core.errors import OutputError
from fgslam.core.geometry import se3_exp
from fgslam.core.types import Estimate, LandmarkMap, Trajectory
from fgslam.evaluation.localisation import Answers
from fgslam.report.content import Figure
from fgslam.report.figures import (
    LANDMARK_ELLIPSES,
    drive_from_above,
    error_by_axis,
    map_to_turn,
    matches_over_time,
)
from fgslam.report.homing_figures import located_figure
from fgslam.report.pictures import draw_figure, draw_views
from fgslam.report.results import ReportData, judged_report
from fgslam.runs.tables import picture_title


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few dots an inch: the same drawing, several times faster."""
    monkeypatch.setattr("fgslam.report.pictures.DPI", 50)


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
    return ReportData("", "", estimators=(report,), truth=truth)


def located(n: int) -> Figure:
    """Every second query is found, the last of them somewhere else."""
    poses = results(n, n, full=True).estimators[0].final_poses
    found = np.arange(n) % 2 == 0
    false = found & (np.arange(n) == 2)
    covariances = np.tile(1e-4 * np.eye(6), (n, 1, 1))
    drive = np.tile(np.eye(4), (2, 1, 1))
    drive[1, 2, 3] = 5.0
    in_view = np.full(n, -1)
    answers = Answers(found, poses, covariances, poses, in_view, in_view)
    return located_figure(("k", "Found"), np.zeros((n, 3)), drive, answers, false)


def all_pictures(n: int, *, full: bool) -> dict[str, Callable[[Path], None]]:
    one = results(n, n, full=full).estimators[0]
    counts = np.arange(float(n))
    counted = replace(
        one, counts={"matched": counts, "inliers": counts + 5, "landmarks": 10 * counts}
    )
    return {
        "above": lambda p: draw_figure(p, drive_from_above(results(n, n, full=full)), "Above"),
        "views": lambda p: draw_views(p, map_to_turn(results(n, n, full=full)), "Map"),
        "errors": lambda p: draw_figure(p, error_by_axis(results(n, n, full=full)), "Errors"),
        "matches": lambda p: draw_figure(p, matches_over_time(counted), "Matches"),
        "located": lambda p: draw_figure(p, located(n), "Found"),
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
        all_pictures(0, full=False)["above"](tmp_path / "absent" / "a.png")


# --------------------------------------------------------------------------------------------
# What is drawn


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
    names = [t.name for t in located(8).drawing.data]
    assert {"found", "found, but false", "refused", "to the true pose"} <= set(names)
