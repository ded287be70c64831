"""Recordings without images: GTSAM's stereo tracks, folders with a log."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fgslam.backend.filters.kalman import LandmarkKalman
from fgslam.backend.settings import LandmarkKalmanSettings
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError, ConfigError, DatasetError, MeasurementLogError
from fgslam.core.log import MeasurementLog, MeasurementRecording
from fgslam.core.sensors import CameraRig
from fgslam.core.types import Prediction
from fgslam.datasets.opening import open_measurements
from fgslam.datasets.settings import (
    ConstantVelocitySettings,
    MeasurementFilesSettings,
    StereoTracksSettings,
    SyntheticOdometrySettings,
)
from fgslam.evaluation.statistics import evaluate_trajectory
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver
from fgslam.runs.tasks.slam_measurements import write_log_and_truth
from fgslam.slam.motion import ConstantVelocityMotion
from fgslam.slam.replay import replay_frame
from fgslam.worlds.settings import SimulatedMeasurementsSettings

# --------------------------------------------------------------------------------------------
# Stereo tracks


FX, FY, CX, CY, B = 700.0, 710.0, 600.0, 180.0, 0.5


POINTS = np.array([[1.0, 0.5, 10.0], [-2.0, -1.0, 8.0], [0.3, 0.2, 25.0], [3.0, -0.4, 14.0]])


IDS = (7, 15, 3, 40)


FRAMES = (0, 1, 4)  # keyframes: the files skip some


SEEN = {0: (7, 15, 3), 1: (7, 3), 4: (15, 3, 40)}


def left_poses() -> FloatArray:
    """``wTl`` (3, 4, 4): forward, and a turn."""
    return np.array([g.se3_exp(n * np.array([0, 0.02, 0, 0, 0, 0.8])) for n in (0.0, 1.0, 4.0)])


@pytest.fixture
def tracks(tmp_path: Path) -> Path:
    """Three frames of four landmarks, sorted by landmark as GTSAM's files are."""
    rows = []
    for number, pose in zip(FRAMES, left_poses(), strict=True):
        for which, point in zip(IDS, g.transform_to_camera(pose, POINTS), strict=True):
            if which in SEEN[number]:
                x, y, z = point
                left, right = FX * x / z + CX, FX * (x - B) / z + CX
                rows.append([number, which, left, right, FY * y / z + CY, x, y, z])
    rows.sort(key=lambda row: (row[1], row[0]))
    path = tmp_path / "VO_stereo_factors_try.txt"
    path.write_text("\n".join(" ".join(f"{v:.12g}" for v in row) for row in rows), "utf-8")
    (tmp_path / "VO_calibration_try.txt").write_text(f"{FX} {FY} 0.0 {CX} {CY} {B}", "utf-8")
    lines = [
        " ".join([str(number), *(f"{v:.9g}" for v in pose.ravel())])
        for number, pose in zip(FRAMES, left_poses(), strict=True)
    ]
    (tmp_path / "VO_camera_poses_try.txt").write_text("\n".join(lines), "utf-8")
    return path


def opened(path: Path, **values: object) -> MeasurementRecording:
    return open_measurements(StereoTracksSettings(file=str(path), **values), 0)  # type: ignore[arg-type]


def test_measurements_are_the_right_camera_s(tracks: Path) -> None:
    recording = opened(tracks)
    rig, truth = recording.log.rig, recording.ground_truth
    assert isinstance(rig, CameraRig)
    assert (rig.fx, rig.fy, rig.cx, rig.cy, rig.baseline) == (FX, FY, CX, CY, B)
    assert rig.vertical_baseline is None
    assert truth is not None
    np.testing.assert_allclose(truth.poses[0, :3, 3], [B, 0.0, 0.0], atol=1e-9)
    for increment, wTr in zip(recording.log, truth.poses, strict=True):
        seen = increment.observations
        points = POINTS[[IDS.index(i) for i in seen.ids.tolist()]]
        expected = rig.predict(g.transform_to_camera(wTr, points))
        np.testing.assert_allclose(seen.measurement, expected, atol=1e-5)
        np.testing.assert_allclose(seen.pixels[:, 0], seen.measurement[:, :2])
        np.testing.assert_allclose(
            seen.pixels[:, 1, 0] - seen.pixels[:, 0, 0], seen.measurement[:, 2]
        )
        assert np.isnan(seen.pixels[:, 2]).all()


def test_frames_identities_and_times(tracks: Path) -> None:
    log = opened(tracks).log
    assert [increment.index for increment in log] == [0, 1, 4]
    assert [increment.timestamp for increment in log] == pytest.approx([0.0, 0.1, 0.4])
    assert [i.observations.ids.tolist() for i in log] == [[3, 7, 15], [3, 7], [3, 15, 40]]
    assert [i.observations.is_new.tolist() for i in log] == [
        [True] * 3,
        [False] * 2,
        [False, False, True],
    ]
    assert all(len(i.missed_ids) == len(i.pruned_ids) == 0 for i in log)
    assert all(i.odometry is None for i in log)
    assert log.motion_model["kind"] == "constant_velocity"


def test_the_covariance_is_that_of_independent_pixels(tracks: Path) -> None:
    covariance = opened(tracks, pixel_sigma=0.5).log.increments[0].observations.covariance[0]
    np.testing.assert_allclose(covariance, 0.25 * np.array([[1, 0, -1], [0, 1, 0], [-1, 0, 2]]))


def test_selected_frames_start_their_landmarks_anew(tracks: Path) -> None:
    recording = opened(tracks, start=1)
    assert [increment.index for increment in recording.log] == [1, 4]
    assert recording.log.increments[0].observations.is_new.all()
    assert recording.ground_truth is not None
    assert recording.ground_truth.timestamps == pytest.approx([0.1, 0.4])
    assert [i.index for i in opened(tracks, stride=2).log] == [0, 4]
    with pytest.raises(DatasetError, match="choose less"):
        opened(tracks, start=3)


def test_the_identity_is_of_the_content(tracks: Path) -> None:
    first = opened(tracks).identity
    assert opened(tracks).identity == first
    assert opened(tracks, pixel_sigma=0.3).identity != first
    text = tracks.read_text("utf-8")
    tracks.write_text(text.replace("7 ", "8 ", 1), "utf-8")
    assert opened(tracks).identity != first


def test_reference_poses_are_called_estimates_and_may_be_absent(tracks: Path) -> None:
    assert any("estimates" in note for note in opened(tracks).notes)
    tracks.with_name("VO_camera_poses_try.txt").unlink()
    recording = opened(tracks)
    assert recording.ground_truth is None
    assert recording.notes == ()


def test_observations_without_disparity_are_left_out_and_reported(tracks: Path) -> None:
    lines = tracks.read_text("utf-8").splitlines()
    words = lines[0].split()
    words[3] = words[2]
    tracks.write_text("\n".join([" ".join(words), *lines[1:]]), "utf-8")
    recording = opened(tracks)
    assert recording.notes[0] == "1 observations without disparity left out"
    assert sum(len(i.observations) for i in recording.log) == 7


# --------------------------------------------------------------------------------------------
# Bad files


def broken_line(change: Callable[[list[str]], list[str]]) -> Callable[[Path], None]:
    """Changes the words of the third line of the tracks."""

    def apply(tracks: Path) -> None:
        lines = tracks.read_text("utf-8").splitlines()
        lines[2] = " ".join(change(lines[2].split()))
        tracks.write_text("\n".join(lines), "utf-8")

    return apply


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda words: words[:5], "line 3: 5 columns, expected 8"),
        (lambda words: [*words[:3], "x", *words[4:]], "line 3: uR is 'x', not a number"),
        (lambda words: ["0.5", *words[1:]], "line 3: pose and landmark must be whole numbers"),
        (lambda words: ["0", *words[1:]], "line 3: the landmark is measured twice in one frame"),
    ],
)
def test_a_wrong_line_is_named(
    tracks: Path, change: Callable[[list[str]], list[str]], message: str
) -> None:
    broken_line(change)(tracks)
    with pytest.raises(DatasetError, match=message) as caught:
        opened(tracks)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("VO_calibration_try.txt", "700 700 0.3 600 180 0.5", "skew 0"),
        ("VO_calibration_try.txt", "700 700 0.0 600 180 -0.5", "baseline must be positive"),
        ("VO_camera_poses_try.txt", "0 " + 16 * "1 ", "line 1: not a rigid pose"),
    ],
)
def test_wrong_calibration_and_poses_are_named(
    tracks: Path, name: str, text: str, message: str
) -> None:
    tracks.with_name(name).write_text(text, "utf-8")
    with pytest.raises(DatasetError, match=message) as caught:
        opened(tracks)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_files_are_named(tracks: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"no such file; dataset\.file is 00s, 00, large or"):
        opened(tmp_path / "VO_stereo_factors_none.txt")
    tracks.with_name("VO_calibration_try.txt").unlink()
    with pytest.raises(CalibrationError, match=r"VO_calibration\.txt"):
        opened(tracks)
    tracks.write_text("", "utf-8")
    tracks.with_name("VO_calibration.txt").write_text(f"{FX} {FY} 0 {CX} {CY} {B}", "utf-8")
    with pytest.raises(DatasetError, match="has no frame at all"):
        opened(tracks)


@pytest.mark.parametrize("bits", [31, 40, 53, 62])
def test_landmarks_may_have_any_numbers_of_64_bits(tracks: Path, bits: int) -> None:
    """Keys of GTSAM and hashes: beyond 53 bits floats would make one of several."""
    usual = opened(tracks)
    rows = [line.split() for line in tracks.read_text("utf-8").splitlines()]
    moved = [[row[0], str(int(row[1]) + 2**bits), *row[2:]] for row in rows]
    tracks.write_text("\n".join(map(" ".join, moved)), "utf-8")
    found = opened(tracks)
    assert f"landmarks have numbers up to {max(IDS) + 2**bits}: they" in found.notes[0]
    for ours, theirs in zip(found.log, usual.log, strict=True):
        np.testing.assert_array_equal(np.sort(IDS)[ours.observations.ids], theirs.observations.ids)
        np.testing.assert_array_equal(
            ours.observations.measurement, theirs.observations.measurement
        )


# --------------------------------------------------------------------------------------------
# The files inside the gtsam package


@pytest.mark.parametrize(
    ("name", "frames", "observations", "landmarks"),
    [
        ("large", 26, 8189, 2634),
        ("00s", 77, 52544, 15638),
    ],
)
def test_gtsam_s_own_files(name: str, frames: int, observations: int, landmarks: int) -> None:
    recording = open_measurements(StereoTracksSettings(file=name), 0)
    assert len(recording.log) == frames
    assert sum(len(i.observations) for i in recording.log) == observations
    assert sum(int(i.observations.is_new.sum()) for i in recording.log) == landmarks
    assert recording.ground_truth is not None
    assert len(recording.ground_truth) == frames


def test_gtsam_is_found_and_not_loaded() -> None:
    script = (
        "import sys\n"
        "from fgslam.datasets.opening import open_measurements\n"
        "from fgslam.datasets.settings import StereoTracksSettings\n"
        "open_measurements(StereoTracksSettings(file='large'), 0)\n"
        "print('gtsam' in sys.modules)"
    )
    done = subprocess.run(  # noqa: S603 - our own interpreter and our own script
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "False"


def test_the_filter_follows_the_reference(rng: np.random.Generator) -> None:
    """23 m from constant velocity alone; the reference is as good as its own estimate."""
    recording = open_measurements(StereoTracksSettings(file="large"), 0)
    log = recording.log
    estimator = LandmarkKalman(
        log.rig, LandmarkKalmanSettings(), Prediction(np.eye(4), np.zeros((6, 6)))
    )
    limits = EgoMotionSettings(max_correction_m=3.0, max_correction_deg=10.0)
    solver = EgoMotionSolver(log.rig, limits)
    motion = ConstantVelocityMotion()
    stats = [replay_frame(step, estimator, solver, motion, k).stats for k, step in enumerate(log)]
    error = evaluate_trajectory(estimator.estimate().trajectory, recording.ground_truth)
    assert error.ate_rmse_m is not None
    assert error.ate_rmse_m < 0.03
    nis = sum(s.nis for s in stats if s.nis_dof) / sum(s.nis_dof for s in stats)
    assert 0.7 < nis < 1.3  # the default pixel_sigma is what it claims to be


# --------------------------------------------------------------------------------------------
# Measurement files


@pytest.fixture
def simulated() -> MeasurementRecording:
    return open_measurements(SimulatedMeasurementsSettings(stop=12), 0)


@pytest.fixture
def folder(simulated: MeasurementRecording, tmp_path: Path) -> Path:
    write_log_and_truth(tmp_path, simulated)
    return tmp_path


def settings(folder: Path, stop: int | None = None) -> MeasurementFilesSettings:
    return MeasurementFilesSettings(path=str(folder), stop=stop)


@pytest.mark.parametrize("stop", [None, 5, 100])
def test_a_run_s_measurements_are_a_recording(
    simulated: MeasurementRecording, folder: Path, stop: int | None
) -> None:
    found = open_measurements(settings(folder, stop), 0)
    expected = simulated.log.increments[:stop]
    assert len(found.log) == len(expected)
    for a, b in zip(found.log, expected, strict=True):
        np.testing.assert_array_equal(a.observations.ids, b.observations.ids)
        np.testing.assert_array_equal(a.observations.measurement, b.observations.measurement)
    assert found.log.motion_model == simulated.log.motion_model
    assert found.ground_truth is not None
    assert simulated.ground_truth is not None
    true = simulated.ground_truth.poses[: len(expected)]
    np.testing.assert_allclose(found.ground_truth.poses, true, atol=1e-11)
    assert found.landmark_truth is not None
    assert simulated.landmark_truth is not None
    np.testing.assert_array_equal(found.landmark_truth.ids, simulated.landmark_truth.ids)


def test_truth_is_optional_and_its_content_is_part_of_the_identity(folder: Path) -> None:
    whole = open_measurements(settings(folder), 0)
    for path in folder.glob("ground_truth*"):
        path.unlink()
    bare = open_measurements(settings(folder), 0)
    assert bare.ground_truth is None
    assert bare.landmark_truth is None
    assert bare.identity != whole.identity


def test_odometry_may_be_left_out_but_not_made(folder: Path) -> None:
    velocity = open_measurements(settings(folder), 0, ConstantVelocitySettings())
    assert all(increment.odometry is None for increment in velocity.log)
    with pytest.raises(ConfigError, match="needs a recording of images"):
        open_measurements(settings(folder), 0, SyntheticOdometrySettings())


@pytest.mark.parametrize("selection", [{"start": 1}, {"stride": 2}])
def test_frames_without_those_before_them_are_refused(
    folder: Path, selection: dict[str, int]
) -> None:
    part = MeasurementFilesSettings(path=str(folder), **selection)
    with pytest.raises(ConfigError, match=r"set dataset\.stop alone"):
        open_measurements(part, 0)


def test_an_absent_folder_a_damaged_and_an_empty_log_are_refused(folder: Path) -> None:
    with pytest.raises(DatasetError, match=r"does not exist; say where it is"):
        open_measurements(settings(folder / "absent"), 0)
    log = MeasurementLog.load(folder / "measurements.npz")
    (folder / "measurements.npz").write_bytes(b"no log")
    with pytest.raises(MeasurementLogError):
        open_measurements(settings(folder), 0)
    MeasurementLog(log.rig, log.motion_model).save(folder / "measurements.npz")
    with pytest.raises(DatasetError, match="has no frame at all"):
        open_measurements(settings(folder), 0)
