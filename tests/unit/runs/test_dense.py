"""A wall before three cameras as a dense map, and what cannot become one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from bags import PERIOD_NS, START_NS, camera_info, raw_image, write_bag
from dataset_builders import CALIBRATION, HEIGHT, WIDTH, save, write_calibration
from scipy.spatial import cKDTree
from textured_wall import RIG, WALL_M, pictures

import fgslam as fg
from fgslam.core.arrays import Float32, Image
from fgslam.core.errors import ConfigError, DatasetError, FrameError
from fgslam.core.geometry import pose
from fgslam.core.log import ImageSequence, MeasurementLog
from fgslam.core.sensors import Increment, Observations
from fgslam.core.types import NO_LANDMARKS, Estimate, Trajectory
from fgslam.runs.bare import bare_experiment
from fgslam.runs.dense import DenseMap, DenseSettings, fuse
from fgslam.runs.export import frames_of
from fgslam.runs.opening import open_sequence

PLACES = [np.array([0.1 * k, 0.0, 0.05 * k]) for k in range(4)]
POSE_SIGMA_M = 0.003


def log_of(rig: object = RIG) -> MeasurementLog:
    log = MeasurementLog(rig, {"kind": "constant_velocity"})  # type: ignore[arg-type]
    none, ids = np.zeros(0, np.bool_), np.empty(0, np.int64)
    seen = Observations(ids, *(np.empty(n) for n in ((0, 3), (0, 3, 3), (0, 3, 2))), none)
    for k in range(len(PLACES)):
        log.append(Increment(k, 0.1 * k, None, seen, none, ids, ids))
    return log


def estimate() -> Estimate:
    poses = np.array([pose(np.eye(3), place) for place in PLACES])
    covariance = np.diag(np.repeat([0.0, POSE_SIGMA_M**2], 3))
    covariances = np.tile(covariance, (len(PLACES), 1, 1))
    return Estimate(Trajectory(0.1 * np.arange(4), poses, "right"), covariances, NO_LANDMARKS)


def seen(row: int) -> tuple[Image, ...]:
    if row == 2:
        raise FrameError("image 2 cannot be read")
    return pictures(PLACES[row])


def fused(settings: DenseSettings, rig: object = RIG, depths: object = None) -> DenseMap:
    return fuse(log_of(rig), estimate(), range(4), seen, depths, settings)  # type: ignore[arg-type]


@pytest.mark.usefixtures("open3d")
def test_a_wall_becomes_a_plane_with_pose_and_calibration_in_its_deviations() -> None:
    shown: list[int] = []
    found = fuse(
        log_of(replace(RIG, exact=True)),
        estimate(),
        range(4),
        seen,
        settings=DenseSettings(every=1, voxel_m=0.05, cameras=2),
        progress=lambda what, done, total: shown.append(done),
    )
    assert shown == [0, 1, 2, 3, 4]
    assert found.frames == 3  # one cannot be read
    distance = np.abs(found.surface.positions[:, 2] - WALL_M)
    assert np.median(distance) < 0.01
    np.testing.assert_allclose(found.surface.shared_sigmas, POSE_SIGMA_M, rtol=0, atol=1e-6)


@pytest.mark.usefixtures("open3d")
def test_every_second_frame_of_a_rig_that_is_not_exact() -> None:
    stated = fused(DenseSettings(every=2, voxel_m=0.05, cameras=2))
    assert (stated.surface.shared_sigmas > 2.0 * POSE_SIGMA_M).all()
    assert stated.frames == 1


@pytest.mark.usefixtures("open3d")
def test_a_depth_camera_is_taken_at_its_word_and_the_voxels_fit_its_depth() -> None:
    def depths(row: int) -> np.ndarray:
        depth = np.full((RIG.height, RIG.width), WALL_M - PLACES[row][2], np.float32)
        depth[:20] = np.nan
        return depth

    found = fused(DenseSettings(every=1), depths=depths)
    assert found.voxel_m == pytest.approx(3.0 * WALL_M / RIG.fx, rel=0.1)
    assert np.abs(found.surface.positions[:, 2] - WALL_M).max() < 0.002


COLOUR = np.full((HEIGHT, WIDTH, 3), (200, 100, 50), np.uint8)  # red, green, blue
MILLIMETRES = np.full((HEIGHT, WIDTH), 1500, np.uint16)


def depth_folder(root: Path) -> Path:
    for name, image in (("rgb", COLOUR[..., ::-1]), ("depth", MILLIMETRES)):
        (root / name).mkdir(parents=True)
        for k in range(3):
            cv2.imwrite(str(root / name / f"{k:06d}.png"), image)
    write_calibration(root, depth_scale=1000.0)
    return root


def depth_bag(path: Path) -> Path:
    written = []
    for k in range(3):
        for topic, kind, fields in (
            ("/camera/color/image_raw", "Image", raw_image(COLOUR, "rgb8")),
            ("/camera/color/camera_info", "CameraInfo", camera_info(0.0)),
            ("/camera/aligned_depth_to_color/image_raw", "Image", raw_image(MILLIMETRES, "16UC1")),
        ):
            written.append((topic, START_NS + k * PERIOD_NS, f"sensor_msgs/msg/{kind}", fields))
    return write_bag(path, written)


@pytest.mark.usefixtures("open3d")
@pytest.mark.parametrize("name", ["folder", "walk.bag", "walk.mcap"])
def test_depth_of_folders_and_bags_is_fused_in_its_colours(tmp_path: Path, name: str) -> None:
    path = (depth_folder if name == "folder" else depth_bag)(tmp_path / name)
    config = bare_experiment(path, None, []).config
    recording = open_sequence(config)
    poses = np.tile(np.eye(4), (3, 1, 1))
    found = Trajectory(recording.timestamps, poses, "right")
    log = log_of(recording.rig)
    settled = Estimate(found, np.zeros((3, 6, 6)), NO_LANDMARKS)
    made = fuse(log, settled, *frames_of(config, found), DenseSettings(every=1))
    assert made.frames == 3
    assert np.abs(made.surface.positions[:, 2] - 1.5).max() < 0.002
    assert np.abs(made.surface.colours.astype(int) - COLOUR[0, 0]).max() <= 1
    assert np.ptp(made.surface.positions[:, 0]) > 0.7 * WIDTH / CALIBRATION["fx"] * 1.5


@pytest.mark.usefixtures("open3d")
def test_the_dense_map_of_a_session_from_its_frames_or_from_the_recording(tmp_path: Path) -> None:
    frames = []
    for k, place in enumerate(PLACES[::2]):
        right, left, top = pictures(place)
        for name, image in (("left", left), ("right", right), ("top", top)):
            save(tmp_path / "walk" / name / f"{k:06d}.png", image)
        frames.append((0.1 * k, (left, right, top)))
    matrix = {"width": RIG.width, "height": RIG.height, "fx": RIG.fx, "fy": RIG.fy}
    centre = {"cx": RIG.cx, "cy": RIG.cy, "baseline_m": 0.1, "vertical_baseline_m": 0.1}
    write_calibration(tmp_path / "walk", **matrix, **centre)
    (tmp_path / "walk" / "times.txt").write_text("0 0.0\n1 0.1\n")
    with fg.Slam(RIG, "landmark_kalman") as slam:
        for t, images in frames:
            slam.track(t, images)
    result = slam.result()
    for name, given in (("a", frames), ("b", fg.open_recording(tmp_path / "walk"))):
        found = result.dense_map(given, every=1, voxel_m=0.05)
        found.surface.save(tmp_path / f"{name}.ply")
        assert np.median(np.abs(found.surface.positions[:, 2] - WALL_M)) < 0.01
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    lost = [frames[0], (0.1, None)]
    assert result.dense_map(lost, every=1, voxel_m=0.05).frames == 1
    with pytest.raises(DatasetError, match="this recording has other times than the run"):
        result.dense_map(frames[1:])


@pytest.mark.slow
@pytest.mark.usefixtures("open3d")
def test_a_person_who_walks_through_the_lab_leaves_no_trail() -> None:
    lab, empty = (fg.open_recording(name).sequence for name in ("lab_person", "lab_loop"))
    rig, poses, walked = lab.rig, lab.ground_truth.poses, list(range(20, 32, 2))
    rows, columns = np.indices((rig.height, rig.width))
    rays = np.stack([(columns - rig.cx) / rig.fx, (rows - rig.cy) / rig.fy, 0 * rows + 1.0], -1)
    seen_of = []
    for i in walked:
        depth = lab.depth(i)
        points = (rays * depth[..., None])[depth < empty.depth(i) - 0.3]
        seen_of.append(points @ poses[i, :3, :3].T + poses[i, :3, 3])
    person = cKDTree(np.concatenate(seen_of))

    def surface(shown: ImageSequence, used: list[int]) -> Float32:
        path = Trajectory(lab.timestamps[used], poses[used], "right")
        settled = Estimate(path, np.zeros((len(used), 6, 6)), NO_LANDMARKS)
        how = DenseSettings(0.04, every=1)
        return fuse(
            log_of(rig), settled, used, lambda i: shown.frame(i).images, settings=how
        ).surface.positions

    room = cKDTree(surface(empty, list(range(0, 120, 4))))

    def trail(used: list[int]) -> int:
        found = surface(lab, used)
        return int(((person.query(found)[0] < 0.05) & (room.query(found)[0] > 0.15)).sum())

    during, after = trail(walked), trail([*walked, *range(32, len(lab), 2)])
    assert during > 100
    assert after < 0.15 * during


def test_settings_that_mean_nothing_are_refused() -> None:
    for key, value, said in (
        ("voxel_m", 0.0, "--voxel is 0; give metres above 0"),
        ("range_m", -1.0, "--range is -1; give metres above 0"),
        ("range_m", float("nan"), "--range is nan; give metres above 0"),
        ("every", 0, "--every is 0; give 1 for all frames"),
    ):
        with pytest.raises(ConfigError, match=said):
            DenseSettings(**{key: value})
    for cameras in (1, 3):
        with pytest.raises(ConfigError, match=f"--cameras {cameras}: the rig has 2; leave it out"):
            fused(DenseSettings(cameras=cameras), replace(RIG, vertical_baseline=None))


def test_images_that_show_no_depth_are_named() -> None:
    flat = np.full((RIG.height, RIG.width), 90, np.uint8)
    with pytest.raises(DatasetError, match="show no depth"):
        fuse(log_of(), estimate(), range(4), lambda row: (flat,) * 3)


@pytest.mark.usefixtures("open3d")
def test_voxels_too_small_for_the_cameras_say_which_would_do() -> None:
    with pytest.raises(ConfigError, match=r"0.77 cm wide .* use --voxel 0.0077"):
        fused(DenseSettings(voxel_m=0.001))
    with pytest.raises(DatasetError, match="within 1 m; use a larger --sigma"):
        fused(DenseSettings(voxel_m=0.05, range_m=1.0))


@pytest.mark.usefixtures("open3d")
def test_a_sigma_that_nothing_has_says_which_would_do() -> None:
    with pytest.raises(DatasetError, match=r"as 1e-05 cm .* use a larger --sigma \(0.02\)"):
        fused(DenseSettings(voxel_m=0.01, sigma_m=1e-7))
    assert len(fused(DenseSettings(voxel_m=0.01, sigma_m=0.02)).surface.positions)
