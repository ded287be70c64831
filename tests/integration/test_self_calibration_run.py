"""A recording whose left images are turned: the run says so, and its calibration undoes it."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from recordings import BASELINE, FOCAL, HEIGHT, WIDTH, experiment, write_recording
from running import bytes_of, main, metrics_of, run_values, stop_after

import fgslam
from fgslam.cameras.rectify import rectifier_of
from fgslam.core.correction import term_names
from fgslam.core.log import MeasurementLog
from fgslam.core.sensors import CameraRig

ROLL_DEG = 0.4
RIG = CameraRig(
    WIDTH, HEIGHT, FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, BASELINE, None, np.eye(4)
)


@pytest.fixture(scope="module")
def turned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording whose left camera is turned about its axis."""
    root = write_recording(tmp_path_factory.mktemp("turned") / "recording", frames=20, top=False)
    values = np.zeros(len(term_names(RIG)))
    values[term_names(RIG).index("left.roll")] = -np.deg2rad(ROLL_DEG)
    turn = rectifier_of(RIG, values)  # undoes the opposite turn: it turns
    for path in sorted((root / "left").glob("*.png")):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        assert cv2.imwrite(str(path), turn.rectify(1, image))
    return root


@pytest.mark.slow
def test_the_turn_is_found_told_and_written(
    turned: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    better = tmp_path / "better.json"
    run = ("run", turned, "--out")
    assert main(monkeypatch, *run, tmp_path / "a", "--camera-out", better) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "the left camera is turned by" in said
    assert "in roll" in said
    found = metrics_of(tmp_path / "a")["rig"]
    roll = found["changes"]["left_roll_deg"]
    assert roll["value"] == pytest.approx(ROLL_DEG, abs=0.08)
    assert abs(roll["value"]) > 5.0 * roll["sigma"]
    assert better.read_bytes() == (tmp_path / "a" / "camera.json").read_bytes()
    assert main(monkeypatch, *run, tmp_path / "b", "--camera", better) == 0
    again = metrics_of(tmp_path / "b")["rig"]
    assert abs(again["changes"]["left_roll_deg"]["value"]) < 0.1


def test_an_interrupted_run_goes_on_with_the_same_corrections(turned: Path, tmp_path: Path) -> None:
    values = experiment(turned)
    whole = run_values(values, tmp_path / "whole")
    assert (
        MeasurementLog.load(whole.folder / "measurements.npz").increments[-1].rig_correction.any()
    )
    partial = run_values(values, tmp_path / "run", stopped=stop_after(9))
    resumed = run_values(values, partial.folder, "resume")
    assert resumed.result.status == "finished"
    assert bytes_of(partial.folder) == bytes_of(whole.folder)
    name = "calibration.csv"
    assert (partial.folder / name).read_bytes() == (whole.folder / name).read_bytes()


def test_a_replay_gives_the_bits_of_the_live_run(turned: Path) -> None:
    recording = fgslam.open_recording(turned)
    with fgslam.Slam(recording.rig, "landmark_kalman") as slam:
        for t, images, odometry in recording:
            slam.track(t, images, odometry)
        live, found = slam.result(), slam.result().rig
    assert found is not None
    assert found.applied.values.any()
    again = fgslam.replay(slam.log, "landmark_kalman")
    np.testing.assert_array_equal(again.online.poses, live.online.poses)


def test_paper_pipelines_write_no_calibration(
    turned: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    arguments = ("run", turned, "--out", tmp_path / "a", "--camera-out", tmp_path / "b.json")
    assert main(monkeypatch, *arguments, "--set", "frontend.stereo.measurement=paper") == 2
    assert "takes its cameras as calibrated" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "a").exists()


@pytest.mark.slow
def test_a_drive_begins_as_the_one_before_it_found_the_rig(
    turned: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    root = Path(shutil.copytree(turned, tmp_path / "drives"))
    quiet = ("--set", "output.pictures=false", "--overwrite", "--estimator", "landmark_kalman")

    def run(name: str, *options: str) -> tuple[float, str]:
        assert main(monkeypatch, "run", root, "--out", tmp_path / name, *quiet, *options) == 0
        log = MeasurementLog.load(tmp_path / name / "measurements.npz")
        roll = log.increments[0].rig_correction[term_names(log.rig).index("left.roll")]
        return np.rad2deg(roll), " ".join(capsys.readouterr().out.split())

    first, second = ("--stop", "12"), ("--start", "12")
    assert run("a", *first)[0] == 0.0
    (kept,) = root.glob("rig_memory_*.npz")
    roll, said = run("b", *second)
    assert roll == pytest.approx(ROLL_DEG, abs=0.1)
    assert f"the calibration begins as 1 earlier drive found it ({kept})" in said
    assert str(kept) in (tmp_path / "b" / "report.html").read_text(encoding="utf-8")
    assert str(kept) in (tmp_path / "b" / "config.yaml").read_text(encoding="utf-8")
    before = kept.read_bytes()
    run("again", *second)  # without what it has shown itself
    assert bytes_of(tmp_path / "again") == bytes_of(tmp_path / "b")
    assert kept.read_bytes() == before
    assert run("off", *second, "--rig-memory", "off")[0] == 0.0
    assert kept.read_bytes() == before
    named = tmp_path / "b" / "rig_memory.npz"  # what it began with repeats it
    shutil.copy(named, tmp_path / "named.npz")
    run("named", *second, "--rig-memory", str(tmp_path / "named.npz"))
    assert bytes_of(tmp_path / "named") == bytes_of(tmp_path / "b")
