"""The readers on real recordings (`shared/data`); the recordings are never copied."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from evo.core import metrics, sync
from evo.tools import file_interface

import fgslam as fg
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import DatasetError
from fgslam.core.geometry import body_to_camera_motion, inverse, se3_log
from fgslam.datasets.opening import open_recording
from fgslam.datasets.recording import Recording
from fgslam.datasets.settings import (
    BagSettings,
    EurocSettings,
    ImageFolderSettings,
    LooseImagesSettings,
    RecordedOdometrySettings,
    RgbdSettings,
)
from fgslam.frontend.settings import FrontendSettings
from fgslam.frontend.stereo import StereoMatcher
from fgslam.runs.export import export_run
from fgslam.runs.findings import Level
from fgslam.runs.inspect import check_sequence
from fgslam.runs.wanted import Wanted
from fgslam.slam.build import make_extractor
from scripts.convert.light_field import convert

pytestmark = pytest.mark.data

# Where KITTI's sensor set-up puts the right grey camera, seen from its GPS/IMU unit.
KITTI_LEVER_ARM = (1.08, -0.86, 0.72)


def folder(root: Path, name: str, **settings: object) -> ImageFolderSettings:
    if not (root / name).is_dir():
        pytest.skip(f"no recording {name} in {root}: this test needs it")
    return ImageFolderSettings(path=str(root / name), **settings)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "frames", "size", "baseline", "length"),
    [
        ("euroc_v101_kf100", 100, (376, 240), 0.110, 49.5),
        ("kitti06", 51, (613, 185), 0.537, 59.9),
        ("kitti_raw_0926_5hz", 200, (621, 188), 0.537, 299.7),
    ],
)
def test_stereo_recordings(
    shared_data: Path, name: str, frames: int, size: tuple[int, int], baseline: float, length: float
) -> None:
    recording = open_recording(folder(shared_data, name))
    assert len(recording) == frames
    assert (recording.rig.width, recording.rig.height) == size
    assert recording.rig.baseline == pytest.approx(baseline, abs=1e-3)
    truth = recording.ground_truth
    assert truth is not None
    assert len(truth) == frames
    steps = np.linalg.norm(np.diff(truth.poses[:, :3, 3], axis=0), axis=1)
    assert steps.sum() == pytest.approx(length, abs=0.1)
    assert recording.notes == ()
    for i in (0, frames - 1):
        frame = recording.frame(i)
        assert [image.shape for image in frame.images] == [size[::-1]] * 2
    problems = [f for f in check_sequence(recording, 8) if f.level is Level.PROBLEM]
    assert problems == []


def step_errors(recording: Recording) -> FloatArray:
    """Errors (n, 6) of the odometry's steps against the truth's, in the body's frame."""
    truth = recording.ground_truth
    assert truth is not None
    body = truth.poses @ inverse(recording.rig.bTc)
    errors = []
    for i in range(1, len(recording)):
        step = recording.odometry(i)
        assert step is not None
        errors.append(se3_log(inverse(step.motion) @ inverse(body[i - 1]) @ body[i]))
    return np.array(errors)


def test_dead_reckoning_of_real_odometry(shared_data: Path) -> None:
    """Measured: ATE 0.31 m after SE3 alignment over 300 m; truth itself is good to 0.27 m."""
    settings = folder(shared_data, "kitti_raw_0926_5hz", lever_arm_m=KITTI_LEVER_ARM)
    recording = open_recording(settings, RecordedOdometrySettings(time_offset_s=-0.06))
    truth = recording.ground_truth
    assert truth is not None
    pose, positions = np.eye(4), [np.zeros(3)]
    for i in range(1, len(recording)):
        step = recording.odometry(i)
        assert step is not None
        pose = pose @ body_to_camera_motion(step.motion, recording.rig.bTc)
        positions.append(pose[:3, 3])
    ours, true = np.array(positions), truth.poses[:, :3, 3]
    ours, true = ours - ours.mean(axis=0), true - true.mean(axis=0)
    u, _, vt = np.linalg.svd(true.T @ ours)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    error = np.sqrt(((ours @ rotation.T - true) ** 2).sum(axis=1).mean())
    assert error < 0.34


def test_default_noise_covers_the_real_errors(shared_data: Path) -> None:
    """Per axis the errors are within the stated noise, and not far below it (roll to vertical)."""
    settings = folder(shared_data, "kitti_raw_0926_5hz", lever_arm_m=KITTI_LEVER_ARM)
    recording = open_recording(settings, RecordedOdometrySettings(time_offset_s=-0.06))
    sigmas = []
    for i in range(1, len(recording)):
        step = recording.odometry(i)
        assert step is not None
        sigmas.append(np.sqrt(np.diag(step.covariance)))
    # The first two steps are where the truth itself settles.
    white = (step_errors(recording) / np.array(sigmas))[2:]
    inside = (np.abs(white) < 2.0).mean(axis=0)
    assert np.all(inside > 0.9)
    assert np.all(np.median(np.abs(white), axis=0) > 0.1)


# --------------------------------------------------------------------------------------------
# Matches of SIFT features, found with OpenCV alone


def matched(a: np.ndarray, b: np.ndarray) -> tuple[FloatArray, FloatArray, list[int]]:
    """Positions in both images of mutually nearest features, and their rows in ``a``."""
    sift = cv2.SIFT_create(1500)
    (ka, da), (kb, db) = sift.detectAndCompute(a, None), sift.detectAndCompute(b, None)
    pairs = [m for m in cv2.BFMatcher(crossCheck=True).match(da, db) if m.distance < 200]
    left = np.array([ka[m.queryIdx].pt for m in pairs])
    right = np.array([kb[m.trainIdx].pt for m in pairs])
    return left, right, [m.queryIdx for m in pairs]


def test_light_field_is_a_trinocular_rig(shared_data: Path, tmp_path: Path) -> None:
    """Measured at spacing 4: 430 to 490 features agree in three views, all disparities positive."""
    path = shared_data / "stanford_chess_grid"
    if not path.is_dir():
        pytest.skip(f"no light field in {shared_data}: this test needs it")
    convert(path, tmp_path)
    recording = open_recording(ImageFolderSettings(path=str(tmp_path)))
    assert len(recording) == 13
    assert recording.rig.baseline == pytest.approx(0.0208, abs=2e-4)
    right, left, top = recording.frame(6).images
    a, b, first = matched(right, left)
    c, d, second = matched(right, top)
    rows = {k: i for i, k in enumerate(second)}
    common = [(i, rows[k]) for i, k in enumerate(first) if k in rows]
    i, j = np.array(common).T
    horizontal, vertical = b[i, 0] - a[i, 0], d[j, 1] - c[j, 1]
    aligned = (np.abs(b[i, 1] - a[i, 1]) < 1.0) & (np.abs(d[j, 0] - c[j, 0]) < 1.0)
    assert recording.rig.vertical_baseline is not None
    ratio = recording.rig.vertical_baseline / recording.rig.baseline
    agree = aligned & (np.abs(ratio * horizontal - vertical) < 1.5)
    assert agree.sum() >= 400
    assert horizontal[agree].min() > 1.0
    assert vertical[agree].min() > 1.0
    assert horizontal[agree].max() < 16.0
    assert np.corrcoef(horizontal[agree], vertical[agree])[0, 1] > 0.95


# --------------------------------------------------------------------------------------------
# ROS bags


BAGS = {
    "ROS 1": "euroc_ros1.bag",
    "SQLite": "euroc_ros2_sqlite3",
    "MCAP": "euroc_ros2_mcap/euroc_ros2_mcap.mcap",
}


@pytest.fixture(scope="module")
def bagged(shared_data: Path) -> Recording:
    """What the bags were made from."""
    return open_recording(EurocSettings(path=str(shared_data / "stereo_raw" / "euroc_V1_01_cut")))


@pytest.mark.parametrize(
    "name", ["SQLite", *(pytest.param(n, marks=pytest.mark.slow) for n in BAGS if n != "SQLite")]
)
def test_bags_hold_the_pictures_and_stamps_of_their_source(
    shared_data: Path, bagged: Recording, name: str
) -> None:
    """SOURCE.md: the first pairs of the EuRoC cut, its stamps in the headers, its rig in R, P."""
    path = shared_data / "bags" / "converted_from_euroc" / BAGS[name]
    native = shared_data / "stereo_raw" / "euroc_V1_01_cut"
    source = bagged
    assert open_recording(BagSettings(path=str(path))).rig.baseline == pytest.approx(
        source.rig.baseline, abs=1e-6
    )
    # By its own calibration the bag is seen in another view than that which fgslam chooses.
    bag = open_recording(BagSettings(path=str(path), camera_file=str(native)))
    assert (len(bag), bag.rig.width, bag.rig.height) == (6, 752, 480)
    for i in (4, 0):
        same = int(np.argmin(np.abs(source.timestamps - bag.timestamps[i])))
        assert source.timestamps[same] == pytest.approx(bag.timestamps[i], abs=1e-6)
        for a, b in zip(source.frame(same).images, bag.frame(i).images, strict=True):
            assert np.array_equal(a, b)


def test_bags_without_a_stereo_pair_say_so(shared_data: Path) -> None:
    for name, message in (
        ("ubiquity_aruco_images.bag", "images of one camera only, /raspicam_node/image/compressed"),
        ("yihe_odom_only.bag", r"no topic of camera images .*it has /odom \(Odometry\)"),
    ):
        with pytest.raises(DatasetError, match=message):
            open_recording(BagSettings(path=str(shared_data / "bags" / name)))


def test_pairs_in_one_folder_with_the_side_in_their_names(shared_data: Path) -> None:
    pairs = open_recording(LooseImagesSettings(path=str(shared_data / "bumblebee2_pairs")))
    assert (len(pairs), pairs.rig.width) == (8, 320)
    assert all(np.std(image) > 10.0 for image in pairs.frame(7).images)


def test_depth_is_found_again_as_the_disparity_that_it_says(shared_data: Path) -> None:
    """By SIFT in the colour image and in the view made from it; 1.43 mm at 1 m and 0.15 px."""
    recording = open_recording(RgbdSettings(path=str(shared_data / "rgbd_fr1")))
    assert len(recording) == 15
    assert recording.ground_truth is not None
    settings = FrontendSettings()
    matcher = StereoMatcher(recording.rig, settings.stereo, settings.appearance)
    extract = make_extractor(settings)
    right, left = recording.frame(0).images
    found = matcher.match((extract(right), extract(left)))
    assert len(found) > 200
    file = sorted((shared_data / "rgbd_fr1" / "depth").iterdir())[0]
    depth = cv2.imread(str(file), cv2.IMREAD_UNCHANGED) / 5000.0
    rig, lens = recording.rig, np.array([0.2624, -0.9531, -0.0054, 0.0026, 1.1633])
    matrix = np.array([[rig.fx, 0.0, rig.cx], [0.0, rig.fy, rig.cy], [0.0, 0.0, 1.0]])
    pixels = np.column_stack([found.measurement[:, :2], np.ones(len(found))])
    rays, none = pixels @ np.linalg.inv(matrix).T, np.zeros(3)
    places = cv2.projectPoints(rays, none, none, matrix, lens)[0].reshape(-1, 2)
    columns, rows = np.rint(places).astype(int).clip(0, [639, 479]).T  # of the stored images
    stored = depth[rows, columns]
    known = stored > 0.0
    expected = recording.rig.fx * recording.rig.baseline / stored[known]
    error = found.measurement[known, 2] - expected
    assert abs(np.median(error)) < 0.05
    assert np.median(np.abs(error)) < 0.2


# ------------------------------------------------------------------------------------------
# Results, held against the data sets' own files by evo


def own_truth(file: Path) -> Any:
    if file.suffix == ".csv":
        return file_interface.read_euroc_csv_trajectory(str(file))
    return file_interface.read_tum_trajectory_file(str(file))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "file", "frame"),
    [
        ("kitti06", "gt_left_cam.txt", "left camera"),
        ("euroc_v101_raw", "mav0/state_groundtruth_estimate0/data.csv", "body"),
        ("rgbd_fr1", "groundtruth.txt", "right camera"),
    ],
)
def test_evo_finds_the_runs_own_error(
    shared_data: Path, tmp_path: Path, name: str, file: str, frame: str
) -> None:
    """On final.tum and on what is exported, with the truth file as it is published."""
    root, run = shared_data / name, tmp_path / "run"
    if not root.is_dir():
        pytest.skip(f"no recording {name} in {shared_data}: this test needs it")
    result = fg.run(root, {"dataset.stop": 15, "output.report": False}, run)
    (kind, numbers), *_ = result.metrics["estimators"].items()
    export_run(run, Wanted(trajectory=tmp_path / "exported.tum"))
    for path in (run / kind / "final.tum", tmp_path / "exported.tum"):
        assert f": pose of the {frame}" in path.read_text()
        read = file_interface.read_tum_trajectory_file(str(path))
        # Frames between poses of the truth have it interpolated; evo takes the nearest one.
        truth, found = sync.associate_trajectories(own_truth(root / file), read)
        assert found.num_poses == numbers["matched_poses"] == 15
        found.align(truth)
        ape = metrics.APE(metrics.PoseRelation.translation_part)
        ape.process_data((truth, found))
        rmse = ape.get_statistic(metrics.StatisticsType.rmse)
        assert rmse == pytest.approx(numbers["ate_rmse_m"], abs=2e-3 if "rgbd" in name else 1e-6)
