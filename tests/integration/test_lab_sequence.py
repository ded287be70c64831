"""The rendered lab as a recording: truth, cache, effects, and what SIFT finds in it."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy import ndimage

from fgslam.core import geometry
from fgslam.core.errors import ConfigError, DatasetError, FrameError, MissingDependencyError
from fgslam.core.log import ImageSequence
from fgslam.datasets import rendered
from fgslam.datasets.rendered import RenderedLabSequence
from fgslam.worlds.settings import (
    LabDriveSettings,
    LabEffectsSettings,
    LabRigSettings,
    LabSettings,
)

SMALL = LabRigSettings(width=80, height=60)
CLEAN = LabEffectsSettings(noise_grey=0.0)
QUICK = LabSettings(rig=SMALL, effects=CLEAN)


@pytest.fixture(scope="module", autouse=True)
def cache_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("lab")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FGSLAM_CACHE", str(folder))
        yield folder


def opened(settings: LabSettings, frames: tuple[int, int], seed: int = 0) -> RenderedLabSequence:
    return RenderedLabSequence(settings, seed, start=frames[0], stop=frames[1])


def pixel_rays(sequence: RenderedLabSequence) -> np.ndarray:
    rig = sequence.rig
    rows, columns = np.mgrid[0 : rig.height, 0 : rig.width]
    return np.stack(
        [(columns - rig.cx) / rig.fx, (rows - rig.cy) / rig.fy, np.ones(rows.shape)], axis=-1
    )


# ---------------------------------------------------------------- the recording


def test_papers_drive_as_a_sequence() -> None:
    """249 frames; the last pose is the first; only the frames asked for are rendered."""
    sequence = RenderedLabSequence(QUICK, seed=0, stride=124)
    assert isinstance(sequence, ImageSequence)
    assert len(sequence) == 3
    assert sequence.timestamps.tolist() == [0.0, 62.0, 124.0]
    truth = sequence.ground_truth
    np.testing.assert_allclose(truth.poses[[0, 2]], np.stack([np.eye(4)] * 2), atol=1e-12)
    assert truth.poses[1, 2, 3] > 3.0
    frames = [sequence.frame(i) for i in range(3)]
    assert [f.index for f in frames] == [0, 124, 248]
    assert all(len(f.images) == 3 and f.images[0].shape == (60, 80) for f in frames)
    for first, last in zip(frames[0].images, frames[2].images, strict=True):
        np.testing.assert_array_equal(first, last)


def test_truth_is_that_of_the_rigs_camera_not_of_the_robots_centre() -> None:
    sequence = opened(QUICK, (60, 62))
    body = geometry.inverse(sequence.rig.bTc)
    camera = sequence.room_from_camera(sequence.timestamps)
    robot = camera @ body
    np.testing.assert_allclose(robot[:, 2, 3], 0.0, atol=1e-12)
    np.testing.assert_allclose(robot[:, :3, 2], [[0, 0, 1]] * 2, atol=1e-12)
    ahead = camera[:, :3, 3] - robot[:, :3, 3]
    np.testing.assert_allclose(
        np.einsum("nji,nj->ni", robot[:, :3, :3], ahead), [[0.25, 0.0, 1.0]] * 2, atol=1e-12
    )


def test_odometry_follows_the_truth_through_the_lever_arm() -> None:
    sequence = opened(QUICK, (0, 3))
    truth = sequence.ground_truth.poses
    assert sequence.odometry(0) is None
    for i in (1, 2):
        step = sequence.odometry(i)
        assert step is not None
        camera = geometry.body_to_camera_motion(step.motion, sequence.rig.bTc)
        error = geometry.se3_log(
            geometry.inverse(geometry.inverse(truth[i - 1]) @ truth[i]) @ camera
        )
        at_camera = geometry.change_tangent_frame(
            geometry.inverse(sequence.rig.bTc), step.covariance
        )
        assert error @ np.linalg.solve(at_camera, error) < 30.0


def test_stride_composes_increments_and_covariances() -> None:
    every = opened(QUICK, (40, 43), seed=2)
    second = RenderedLabSequence(QUICK, 2, start=40, stop=43, stride=2)
    a, b, both = every.odometry(1), every.odometry(2), second.odometry(1)
    assert a is not None
    assert b is not None
    assert both is not None
    np.testing.assert_allclose(both.motion, a.motion @ b.motion, atol=1e-14)
    expected = geometry.compose_covariance(b.motion, a.covariance, b.covariance)
    np.testing.assert_allclose(both.covariance, expected, rtol=1e-10)


def test_what_is_brighter_than_white_is_white(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rendered.World, "image", lambda *_: np.full((30, 40), 256.0))
    small = replace(QUICK, rig=LabRigSettings(width=40, height=30))
    assert (opened(small, (0, 1)).frame(0).images[0] == 255).all()


def test_two_cameras_and_another_size() -> None:
    rig = LabRigSettings(width=100, height=50, vertical_baseline_m=None, baseline_m=0.2)
    frame = opened(replace(QUICK, rig=rig), (0, 1)).frame(0)
    assert [image.shape for image in frame.images] == [(50, 100)] * 2


@pytest.mark.parametrize("bad", [{"start": 249}, {"stop": 0}, {"stride": 0}, {"start": -1}])
def test_selection_that_leaves_nothing_is_refused(bad: dict[str, int]) -> None:
    with pytest.raises((DatasetError, ValueError)):
        RenderedLabSequence(QUICK, 0, **bad)


def test_frames_outside_are_refused() -> None:
    sequence = opened(QUICK, (0, 1))
    for i in (-1, 1):
        with pytest.raises(FrameError):
            sequence.frame(i)


def test_drive_through_furniture_is_refused() -> None:
    drive = LabDriveSettings(path="waypoints", waypoints_m=((0.0, -1.0), (0.0, 4.9)), frames=None)
    with pytest.raises(ConfigError, match="wall or furniture"):
        RenderedLabSequence(replace(QUICK, drive=drive), 0, stop=1)


# ---------------------------------------------------------------- exact truth


def test_walls_floor_and_ceiling_are_where_they_should_be() -> None:
    """The room is 10 m x 10 m x 3 m: every pixel's ray ends on its plane to a nanometre."""
    sequence = RenderedLabSequence(QUICK, seed=0, stride=31)
    planes = {"floor": (2, 0.0), "ceiling": (2, 3.0), "wall_east": (0, 5.0), "wall_west": (0, -5.0),
              "wall_north": (1, 5.0), "wall_south": (1, -5.0)}  # fmt: skip
    seen = set()
    for i in range(len(sequence)):
        pose = sequence.room_from_camera(sequence.timestamps[i])[0]
        points = pixel_rays(sequence) * sequence.depth(i)[..., None]
        points = points @ pose[:3, :3].T + pose[:3, 3]
        ids = sequence.object_ids(i)
        for name, (axis, value) in planes.items():
            here = ids == sequence.object_names.index(name)
            if here.any():
                seen.add(name)
                np.testing.assert_allclose(points[here][:, axis], value, atol=1e-9)
    assert {"floor", "ceiling", "wall_east", "wall_north"} <= seen


@pytest.mark.parametrize(("camera", "axis"), [(1, 1), (2, 0)], ids=["left", "top"])
def test_true_depth_predicts_the_other_images_to_a_twentieth_of_a_pixel(
    camera: int, axis: int
) -> None:
    """Warped by disparity f b / Z the left and the top image fall upon the right one."""
    sequence = RenderedLabSequence(
        replace(QUICK, rig=LabRigSettings(width=160, height=120)), 0, start=20, stop=221, stride=50
    )
    shifts, weights, errors = [], [], []
    for i in range(len(sequence)):
        images = [image.astype(float) for image in sequence.frame(i).images]
        disparity = sequence.rig.fx * 0.1 / sequence.depth(i)
        place = np.indices(disparity.shape).astype(float)
        place[axis] += disparity
        warped = ndimage.map_coordinates(images[camera], place, order=3, mode="nearest")
        gradient = np.gradient(images[0], axis=axis)
        inside = place[axis] < disparity.shape[axis] - 3
        residual = warped - images[0]
        # Occluded pixels differ by whole objects: leave them out.
        good = inside & (np.abs(residual) < 12.0)
        assert good[inside].mean() > 0.85
        errors.append(np.median(np.abs(residual[inside])))
        shifts.append(-np.sum(residual[good] * gradient[good]))
        weights.append(np.sum(gradient[good] ** 2))
    assert abs(sum(shifts) / sum(weights)) < 0.05
    assert np.median(errors) < 1.0


# ---------------------------------------------------------------- the cache


def test_cached_frames_are_the_same_bytes_and_need_no_open3d(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    settings = replace(QUICK, effects=LabEffectsSettings())
    first = [opened(settings, (10, 12), seed=4).frame(i).images for i in range(2)]

    def absent(*_: object) -> None:
        raise MissingDependencyError("Open3D was asked for")

    monkeypatch.setattr(rendered, "open_room", absent)
    again = opened(settings, (10, 12), seed=4)
    for i in range(2):
        for a, b in zip(first[i], again.frame(i).images, strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_rendering_is_deterministic(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    once = opened(QUICK, (30, 33))
    monkeypatch.setenv("FGSLAM_CACHE", str(tmp_path))
    rendered.open_room.cache_clear()
    again = opened(QUICK, (30, 33))
    for i in range(3):
        for a, b in zip(once.frame(i).images, again.frame(i).images, strict=True):
            np.testing.assert_array_equal(a, b)


def test_seeds_share_one_render_but_not_their_noise() -> None:
    settings = replace(QUICK, effects=LabEffectsSettings(noise_grey=2.0))
    reported: list[tuple[int, int]] = []
    a = opened(settings, (50, 51), seed=1)
    b = RenderedLabSequence(
        settings, 2, start=50, stop=51, progress=lambda d, n: reported.append((d, n))
    )
    assert reported == []
    assert a.identity != b.identity
    difference = a.frame(0).images[0].astype(float) - b.frame(0).images[0]
    assert difference.std() == pytest.approx(2.0 * np.sqrt(2.0), rel=0.1)
    assert abs(difference.mean()) < 0.25


def test_half_written_cache_is_continued_and_damage_repaired(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FGSLAM_CACHE", str(tmp_path))
    sequence = opened(QUICK, (70, 74))
    before = [sequence.frame(i).images[0] for i in range(4)]
    files = sorted(tmp_path.rglob("frame_00007[0-3].raw"))
    files[0].unlink()
    files[1].write_bytes(files[1].read_bytes()[:100])
    damaged = bytearray(files[2].read_bytes())
    damaged[-5] ^= 0x40
    files[2].write_bytes(damaged)
    reported: list[tuple[int, int]] = []
    again = RenderedLabSequence(
        QUICK, 0, start=70, stop=74, progress=lambda d, n: reported.append((d, n))
    )
    assert reported == [(1, 2), (2, 2)]
    for i in range(4):
        np.testing.assert_array_equal(again.frame(i).images[0], before[i])
    assert files[2].read_bytes() != bytes(damaged)


# ---------------------------------------------------------------- effects


def test_person_crosses_the_view_and_is_gone() -> None:
    settings = replace(QUICK, effects=replace(CLEAN, person=20))
    sequence = opened(settings, (18, 34))
    person = len(sequence.object_names) - 1
    assert sequence.object_names[person] == "person"
    columns = []
    for i in range(len(sequence)):
        seen = sequence.object_ids(i) == person
        if seen.sum() > 20:
            columns.append(np.nonzero(seen)[1].mean())
            assert 1.0 < np.median(sequence.depth(i)[seen]) < 2.6
    assert len(columns) >= 6
    assert columns[0] > 60
    assert columns[-1] < 30
    without = opened(QUICK, (18, 34))
    for i in (0, 15):
        assert not (sequence.object_ids(i) == person).any()
        np.testing.assert_array_equal(sequence.frame(i).images[0], without.frame(i).images[0])
    middle = sequence.object_ids(8) == person
    difference = np.abs(
        sequence.frame(8).images[0].astype(int) - without.frame(8).images[0].astype(int)
    )
    assert difference[middle].mean() > 10.0
    assert np.median(difference[~ndimage.binary_dilation(middle, iterations=2)]) == 0.0


def test_person_after_the_drive_is_refused() -> None:
    settings = replace(QUICK, effects=replace(CLEAN, person=400))
    with pytest.raises(ConfigError, match="person is 400"):
        opened(settings, (0, 1))


def test_blocked_view_is_dark_and_has_no_truth() -> None:
    settings = replace(QUICK, effects=LabEffectsSettings(blocked_frames=(11, 12)))
    sequence = opened(settings, (10, 13))
    levels = [np.mean(sequence.frame(i).images) for i in range(3)]
    assert levels[1] < 20.0 < min(levels[0], levels[2])
    assert np.isnan(sequence.depth(1)).all()
    assert (sequence.object_ids(1) == -1).all()
    assert np.isfinite(sequence.depth(0)).all()


@pytest.mark.slow
def test_second_visit_finds_some_furniture_moved_and_the_rest_as_it_was() -> None:
    now = RenderedLabSequence(QUICK, 0, stride=31)
    then = RenderedLabSequence(replace(QUICK, visit=2), 0, stride=31)
    assert now.object_names == then.object_names
    same = []
    for i in range(len(now)):
        kept = np.abs(now.depth(i) - then.depth(i)) < 1e-9
        same.append(kept.mean())
    assert min(same) < 0.99
    assert np.mean(same) > 0.8


# ---------------------------------------------------------------- what SIFT sees


@pytest.mark.slow
def test_sift_finds_what_the_paper_found() -> None:
    """100 to 300 features in a typical image; the three images within 15 % of each other."""
    sequence = RenderedLabSequence(LabSettings(), seed=3, stride=20)
    sift = cv2.SIFT_create(nOctaveLayers=2, contrastThreshold=0.04, enable_precise_upscale=True)
    counts = np.array(
        [
            [len(sift.detect(image, None)) for image in sequence.frame(i).images]
            for i in range(len(sequence))
        ]
    )
    median = np.median(counts, axis=0)
    assert ((median > 150) & (median < 330)).all()
    assert np.ptp(median) < 0.15 * median.mean()
    assert counts.min() > 100
