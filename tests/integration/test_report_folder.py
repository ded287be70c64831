"""The report page and the viewer's file of real run folders, whole and spoilt."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
from running import KIND, Finished, main

from fgslam.core.errors import DatasetError, FgslamError, MissingDependencyError, OutputError
from fgslam.core.geometry import rotation_from_quaternion
from fgslam.core.types import Trajectory, read_covariances
from fgslam.evaluation.statistics import to_estimate_world
from fgslam.report.results import EstimatorReport
from fgslam.runs.report import draw_run, load_report, report_from_folder
from fgslam.runs.view import claimed_positions, half_axes, view_run

Capture = pytest.CaptureFixture[str]
Patch = pytest.MonkeyPatch


@pytest.fixture
def run(finished: Finished, tmp_path: Path) -> Path:
    """A copy of a finished run to spoil."""
    return Path(shutil.copytree(finished.folder, tmp_path / "run"))


def only(folder: Path) -> EstimatorReport:
    (estimator,) = load_report(folder).estimators
    return estimator


def metrics_of(folder: Path) -> dict[str, object]:
    return json.loads((folder / "metrics.json").read_text(encoding="utf-8"))


def test_page_shows_what_the_files_hold(finished: Finished) -> None:
    data = load_report(finished.folder)
    (estimator,) = data.estimators
    metrics = metrics_of(finished.folder)["estimators"][KIND]  # type: ignore[index]
    final = Trajectory.load(finished.folder / KIND / "final.tum")
    np.testing.assert_array_equal(estimator.final_poses, final.poses)
    np.testing.assert_array_equal(
        estimator.covariances, read_covariances(finished.folder / KIND / "covariance.csv")[1]
    )
    assert estimator.ate_m == pytest.approx(metrics["ate_rmse_m"], rel=1e-9)
    assert estimator.nees_per_dof == pytest.approx(metrics["nees_pose_per_dof"], rel=1e-6)
    assert estimator.verdict == metrics["nees_pose"]["verdict"]
    assert estimator.final_error_m[0] == pytest.approx(0.0, abs=1e-9)
    assert estimator.final_error_m[-1] == pytest.approx(metrics["end_error_m"], rel=1e-6)
    assert np.median(estimator.update_ms) == pytest.approx(metrics["update_ms"]["median"], abs=0.01)
    assert np.isnan(estimator.nees[0])  # the first pose is exactly known
    assert np.isfinite(estimator.nees[1:]).all()
    assert "kind: landmark_kalman" in data.config_yaml
    assert data.versions["gtsam"]
    np.testing.assert_allclose(np.linalg.norm(data.up), 1.0)


def test_the_truth_is_in_the_estimate_s_world(finished: Finished) -> None:
    data = load_report(finished.folder)
    assert data.truth is not None
    final = Trajectory.load(finished.folder / KIND / "final.tum")
    truth = Trajectory.load(finished.folder / "ground_truth.tum")
    found = to_estimate_world(final, truth)
    assert found is not None
    np.testing.assert_array_equal(data.truth.poses, found[1])
    np.testing.assert_allclose(data.truth.poses[0], final.poses[0], atol=1e-9)


def test_the_page_is_written_into_the_folder(run: Path) -> None:
    page = report_from_folder(run)
    assert page == run / "report.html"
    text = page.read_text(encoding="utf-8")
    assert f"{KIND} is off by" in text
    assert "rms median" not in text  # no landmark truth


def test_errors_over_time_are_those_of_displaced_poses(run: Path) -> None:
    """The second half moved up by 0.3 m: the error says so, and the NEES explodes."""
    truth = Trajectory.load(run / "ground_truth.tum")
    poses = truth.poses.copy()
    poses[6:, 1, 3] += 0.3
    Trajectory(truth.timestamps, poses).save(run / KIND / "final.tum")
    truth.save(run / KIND / "online.tum")
    estimator = only(run)
    np.testing.assert_allclose(estimator.final_error_m, [0.0] * 6 + [0.3] * 6, atol=1e-9)
    np.testing.assert_allclose(estimator.online_error_m, 0.0, atol=1e-9)
    assert estimator.nees[6:].min() > 100.0
    assert estimator.verdict == "overconfident"


@pytest.mark.parametrize(
    "absent",
    ["ground_truth.tum", "measurements.npz", "config.yaml"]
    + [
        f"{KIND}/{name}"
        for name in (
            "online.tum",
            "covariance.csv",
            "map.ply",
            "final.tum",
            "noise.csv",
            "frames.csv",
        )
    ],
)
def test_a_run_that_lacks_a_file_has_a_page(run: Path, absent: str) -> None:
    (run / absent).unlink()
    text = report_from_folder(run).read_text(encoding="utf-8")
    estimator = only(run)
    if absent == "ground_truth.tum":
        assert "there is no ground truth" in text
        assert np.isnan(estimator.final_error_m).all()
    elif absent.endswith("final.tum"):
        assert f"{KIND} failed: it left no trajectory" in text
    elif absent.endswith("map.ply"):
        assert len(estimator.landmarks) == 0
    elif absent.endswith("online.tum"):
        assert np.isnan(estimator.online_error_m).all()
    elif absent.endswith("covariance.csv"):
        assert "can be believed is not known" in text
    elif absent.endswith("noise.csv"):
        assert "Noise estimated" not in text
    elif absent.endswith("frames.csv"):
        assert np.isnan(estimator.update_ms).all()
        assert not estimator.counts


def test_times_and_counts_come_from_the_estimator_s_own_file(run: Path) -> None:
    stamps = Trajectory.load(run / KIND / "final.tum").timestamps.tolist()
    rows = [f"{t:.9f},{k}.5,ok,{2 * k},{k},9" for k, t in enumerate(stamps)]
    rows[3] = f"{stamps[3]:.9f},,ok,,,"
    text = "\n".join(["timestamp,update_ms,status,matched,inliers,landmarks", *rows]) + "\n"
    (run / KIND / "frames.csv").write_text(text, encoding="utf-8")
    estimator = only(run)
    times, matched = estimator.update_ms, estimator.counts["matched"]
    assert times[[0, 1, 11]].tolist() == [0.5, 1.5, 11.5]
    assert matched[[0, 1, 11]].tolist() == [0, 2, 22]
    assert np.isnan(times[3])
    assert np.isnan(matched[3])


def test_pictures_of_a_run_are_drawn_from_its_files(run: Path) -> None:
    found = draw_run(run)
    assert [path.stem for path in found] == [
        "map_from_above", "map_views", "matches", "position_error"
    ]  # fmt: skip
    assert all(path.read_bytes()[:4] == b"\x89PNG" for path in found)
    (run / "ground_truth.tum").unlink()
    (run / "pictures" / "position_error.png").unlink()
    assert "position_error" not in {path.stem for path in draw_run(run)}


def test_a_comparison_s_folder_borrows_from_the_run_above(run: Path) -> None:
    inside = run / "compare"
    shutil.copytree(run / KIND, inside / KIND)
    shutil.copy(run / "metrics.json", inside)
    data = load_report(inside)
    assert data.truth is not None
    assert "landmark_kalman" in data.config_yaml
    elsewhere = Path(shutil.copytree(inside, run.parent / "elsewhere"))
    assert load_report(elsewhere).truth is None
    assert load_report(elsewhere, run).truth is not None


def test_an_estimator_that_ended_early_shows_what_it_had(run: Path) -> None:
    metrics = metrics_of(run)
    values = metrics["estimators"][KIND]  # type: ignore[index]
    values |= {"failure": "frame 9: diverged", "remarks": ["left out a landmark"]}
    (run / "metrics.json").write_text(json.dumps(metrics), encoding="utf-8")
    text = report_from_folder(run).read_text(encoding="utf-8")
    assert f"{KIND} (failed)" in text
    assert f"{KIND} failed: frame 9: diverged" in text
    assert f"{KIND}: left out a landmark" in text
    assert len(only(run)) == 12


def test_what_is_no_result_is_refused_in_words(run: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"cannot read .*metrics\.json"):
        report_from_folder(tmp_path)
    (run / KIND / "final.tum").write_text("1 2 3\n", encoding="utf-8")
    with pytest.raises(FgslamError, match=r"final\.tum, line 1: 3 numbers instead of 8"):
        report_from_folder(run)


# --------------------------------------------------------------------------------------------
# The viewer


def test_a_run_is_saved_for_the_viewer(run: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="the extra `viewer` is not installed")
    (run / "pictures").mkdir(exist_ok=True)
    assert cv2.imwrite(str(run / "pictures/view_000003.jpg"), np.zeros((24, 32), np.uint8))
    target = tmp_path / "saved" / "run.rrd"
    target.parent.mkdir()
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # what rerun cannot log it only warns about
        said = view_run(run, target)
    assert said.startswith(f"{target}: written")
    assert [path.name for path in target.parent.iterdir()] == ["run.rrd"]
    listed = subprocess.run(  # noqa: S603 - our own interpreter
        [sys.executable, "-m", "rerun_cli", "rrd", "print", str(target)],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    for entity in (
        "/world/first_camera/truth",
        f"/world/first_camera/{KIND}/final",
        f"/world/first_camera/{KIND}/landmarks",
        f"/world/first_camera/{KIND}/three_sigma",
        f"/error_m/{KIND}",
        f"/nees_per_dof/{KIND}",
        f"/update_ms/{KIND}",
        "/view",
        "/about",
    ):
        assert f" - {entity} - " in listed, entity


def test_without_a_screen_it_is_saved_beside_the_results(run: Path, monkeypatch: Patch) -> None:
    pytest.importorskip("rerun", reason="the extra `viewer` is not installed")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    assert view_run(run, None).startswith(f"{run / 'view.rrd'}: written")
    assert (run / "view.rrd").stat().st_size > 10_000


def test_ellipsoids_are_the_covariances_in_the_world(finished: Finished) -> None:
    estimator = only(finished.folder)
    centres, covariances = claimed_positions(estimator)
    half, quaternions = half_axes(covariances)
    assert len(centres) == len(estimator) == 12
    row = 7
    axes = rotation_from_quaternion(quaternions[row])
    rebuilt = axes @ np.diag((half[row] / 3.0) ** 2) @ axes.T
    turn = estimator.final_poses[row, :3, :3]
    expected = turn @ estimator.covariances[row, 3:, 3:] @ turn.T
    np.testing.assert_allclose(rebuilt, expected, atol=2e-9)
    np.testing.assert_array_equal(centres, estimator.final_poses[:, :3, 3])


def test_without_the_extra_one_line_says_how_to_get_it(
    finished: Finished, monkeypatch: Patch, capfd: Capture
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'fgslam\[viewer\]'"):
        view_run(finished.folder, None)
    assert main(monkeypatch, "view", finished.folder) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("fgslam: the viewer needs the package rerun-sdk")


def test_the_viewer_s_file_has_its_ending(finished: Finished, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="the extra `viewer` is not installed")
    with pytest.raises(OutputError, match=r"the viewer opens \.rrd files"):
        view_run(finished.folder, tmp_path / "run.txt")
