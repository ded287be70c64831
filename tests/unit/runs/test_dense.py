"""A wall before three cameras as a dense map, and what cannot become one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from textured_wall import RIG, WALL_M, pictures

from fgslam.core.arrays import Image
from fgslam.core.errors import ConfigError, DatasetError, FrameError
from fgslam.core.geometry import pose
from fgslam.core.log import MeasurementLog
from fgslam.core.sensors import Increment, Observations
from fgslam.core.types import NO_LANDMARKS, Estimate, Trajectory
from fgslam.runs.dense import DenseMap, DenseSettings, fuse

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


def test_settings_that_mean_nothing_are_refused() -> None:
    for key, value, said in (
        ("voxel_m", 0.0, "--voxel is 0; give metres above 0"),
        ("range_m", -1.0, "--range is -1; give metres above 0"),
        ("range_m", float("nan"), "--range is nan; give metres above 0"),
        ("cameras", 1, "--cameras is 1; a rig has 2 or 3"),
        ("every", 0, "--every is 0; give 1 for all frames"),
    ):
        with pytest.raises(ConfigError, match=said):
            DenseSettings(**{key: value})
    with pytest.raises(ConfigError, match="--cameras 3: the rig has 2"):
        fused(DenseSettings(cameras=3), replace(RIG, vertical_baseline=None))


def test_images_that_show_no_depth_are_named() -> None:
    flat = np.full((RIG.height, RIG.width), 90, np.uint8)
    with pytest.raises(DatasetError, match="show no depth"):
        fuse(log_of(), estimate(), range(4), lambda row: (flat,) * 3)


@pytest.mark.usefixtures("open3d")
def test_voxels_too_small_for_the_cameras_say_which_would_do() -> None:
    with pytest.raises(ConfigError, match=r"0.77 cm wide .* use --voxel 0.0077"):
        fused(DenseSettings(voxel_m=0.001))
    with pytest.raises(DatasetError, match="within 1 m; use larger voxels"):
        fused(DenseSettings(voxel_m=0.05, range_m=1.0))
