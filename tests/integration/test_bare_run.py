"""A recording that is run as it is: from its folder to run folder, page and comparison."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from recordings import BASELINE, FOCAL, write_recording
from running import KIND, SAME_BYTES, bytes_of, main, metrics_of

import fgslam as fg
from fgslam.backend.settings import DEFAULT_ESTIMATOR
from fgslam.core.log import MeasurementLog
from fgslam.core.types import Trajectory

pytestmark = pytest.mark.usefixtures("in_this_process")

EVERYTHING = tuple(name.replace(KIND, DEFAULT_ESTIMATOR) for name in SAME_BYTES)
MEASURED = tuple(name for name in EVERYTHING if name != "ground_truth.tum")
QUIET = ("--set", "output.pictures=false", "--set", "output.report=false")
UNSEEN = {"output.pictures": False, "output.report": False}


@pytest.fixture(scope="module")
def bare(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of the recording alone, without pictures and page; read only."""
    return fg.run(recording, UNSEEN, tmp_path_factory.mktemp("runs") / "bare").folder


@pytest.mark.usefixtures("in_this_process")
def test_a_recording_alone_gives_a_run_folder_that_compares(
    recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "run"
    assert main(monkeypatch, "run", recording, "--out", out, *QUIET[:2]) == 0
    first = capfd.readouterr().out.splitlines()[0]
    assert first.startswith("boards: image folder, 3 cameras 160x120; 12 frames at 4 Hz; odometry;")
    assert (out / "report.html").is_file()
    assert metrics_of(out)["estimators"][DEFAULT_ESTIMATOR]["ate_rmse_m"] < 0.01
    assert main(monkeypatch, "compare", out, "--estimators", "odometry") == 0
    assert (out / "compare" / "comparison.csv").is_file()


def test_the_printed_configuration_gives_the_same_bytes_as_the_recording(
    recording: Path,
    bare: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    assert main(monkeypatch, "init", recording) == 0
    (tmp_path / "mine.yaml").write_text(capfd.readouterr().out, encoding="utf-8")
    written = tmp_path / "written"
    assert main(monkeypatch, "run", tmp_path / "mine.yaml", "--out", written, *QUIET) == 0
    assert bytes_of(bare, EVERYTHING) == bytes_of(written, EVERYTHING)


def test_truth_in_the_folder_changes_nothing_but_the_evaluation(
    recording: Path, bare: Path, tmp_path: Path
) -> None:
    blind = Path(shutil.copytree(recording, tmp_path / "boards"))
    (blind / "gt_right_cam.txt").unlink()
    unseen = fg.run(blind, UNSEEN, tmp_path / "unseen")
    paths = [name for name in MEASURED if name.endswith((".tum", "covariance.csv"))]
    same = tuple(name for name in MEASURED if name not in paths)
    assert bytes_of(bare, same) == bytes_of(unseen.folder, same)
    rig = MeasurementLog.load(bare / "measurements.npz").rig
    for name in paths[:-1]:  # without truth they are of the left camera
        left, right = (Trajectory.load(folder / name) for folder in (unseen.folder, bare))
        assert (left.frame, right.frame) == ("left", "right")
        np.testing.assert_allclose(left.of("right", rig).poses, right.poses, rtol=0, atol=1e-11)
    assert unseen.metrics["estimators"][DEFAULT_ESTIMATOR]["ate_rmse_m"] is None


def test_frames_pushed_into_the_session_of_a_recording_give_the_run_s_poses(
    recording: Path, bare: Path, tmp_path: Path
) -> None:
    slam = fg.Slam.from_config(recording)
    for t, images, odometry in fg.open_recording(recording):
        slam.track(t, images, odometry)
    slam.result().trajectory.save(tmp_path / "pushed.tum")
    expected = (bare / DEFAULT_ESTIMATOR / "final.tum").read_bytes()
    assert (tmp_path / "pushed.tum").read_bytes() == expected


@pytest.mark.slow
@pytest.mark.data
def test_a_drone_that_turns_by_tens_of_degrees_a_frame_is_located(
    shared_data: Path, tmp_path: Path
) -> None:
    """No odometry, and steps of 20 degrees and 0.3 m in the mean: no velocity foretells them.

    By the default estimator: one Kalman filter a landmark reports 5 cm there, and errs by as much.
    """
    path = shared_data / "euroc_v101_kf100"
    run = fg.run(path, {**UNSEEN, "dataset.stop": 18}, tmp_path / "run")
    numbers = run.metrics["estimators"][DEFAULT_ESTIMATOR]
    assert sum(run.metrics["status_counts"].values()) == 18
    assert set(run.metrics["status_counts"]) == {"first", "ok", "relocalised"}
    assert numbers["ate_rmse_m"] < 0.02


@pytest.mark.slow
def test_a_run_s_figures_in_metres_have_a_mark_where_the_unit_is_a_guess(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    root = write_recording(tmp_path / "boards", frames=4, top=False)
    (root / "calib.json").unlink()
    matrix = [[FOCAL, 0.0, 79.5], [0.0, FOCAL, 59.5], [0.0, 0.0, 1.0]]
    values = {"image_size": [160, 120], "R": np.eye(3).tolist(), "T": [-BASELINE, 0.0, 0.0]}
    values |= {f"M{k}": matrix for k in (1, 2)} | {f"D{k}": [0.0] * 5 for k in (1, 2)}
    (root / "rig.json").write_text(json.dumps(values), encoding="utf-8")
    arguments = ("run", root, "--camera", root / "rig.json", "--out", tmp_path / "out")
    main(monkeypatch, *arguments)
    said = capfd.readouterr().out
    assert "ATE rms, SE3 aligned *" in said
    assert "* rests on a guess" in said
    assert "unit of length: 1 m (--unit)" in said
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "figures with * on a guess" in page
