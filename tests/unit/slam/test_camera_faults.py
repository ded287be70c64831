"""A session leaves out the frames of a faulty camera, and is as uncertain as that makes it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from passing import PASSING_RIG, SCENE, pair_of

import fgslam as fg
from fgslam.core.arrays import Image
from fgslam.core.types import Features
from fgslam.frontend.settings import FrontendSettings
from fgslam.frontend.stereo import StereoMatcher
from fgslam.slam.build import make_extractor

BEGINS, FRAMES = 14, 22


def stale_left(k: int, recording: fg.Recording) -> tuple[object, ...]:
    """The images of frame k, the left one of the frame before."""
    images, before = recording[k][1], recording[k - 1][1]
    assert images is not None
    assert before is not None
    return (before[0], *images[1:])


@pytest.fixture(scope="module")
def recording() -> fg.Recording:
    return fg.rendered_recording("lab", frames=FRAMES)


def driven(recording: fg.Recording, frontend: dict[str, object]) -> fg.Slam:
    slam = fg.Slam(recording.rig, "landmark_kalman", frontend=frontend)
    for k, (t, images, odometry) in enumerate(recording):
        slam.track(t, stale_left(k, recording) if k >= BEGINS else images, odometry)
    slam.close()
    return slam


@pytest.mark.slow
def test_frames_of_a_late_camera_are_located_by_the_other_images_and_the_covariance_holds(
    recording: fg.Recording,
) -> None:
    slam = driven(recording, {})
    result = slam.result()
    status = result.column("status")
    assert (status[BEGINS:] == "one_image").all()
    assert not (status[:BEGINS] == "one_image").any()
    late = [increment.observations for increment in slam.log.increments[BEGINS:]]
    assert all(np.isfinite(seen.pixels[:, 0]).all() for seen in late)
    assert all(np.isnan(seen.pixels[:, 1:]).all() for seen in late)
    assert not any(seen.is_new.any() for seen in late)
    assert any("the left camera delivers old images (the right" in r for r in result.remarks)
    sigma = np.sqrt(np.trace(result.covariances[:, 3:, 3:], axis1=1, axis2=2))
    truth = recording.ground_truth
    assert truth is not None
    first = np.linalg.inv(truth.poses[0])
    away = [(first @ pose)[:3, 3] for pose in truth.poses[:FRAMES]]
    error = np.linalg.norm(result.trajectory.poses[:, :3, 3] - away, axis=1)
    assert (error[BEGINS:] < 3.0 * sigma[BEGINS:]).all()
    assert sigma[-1] < 5.0 * sigma[BEGINS - 1]
    # Nothing of the fault is taken for the rig's calibration.
    assert slam.pipeline.calibration is not None
    sound = fg.Slam(recording.rig, "landmark_kalman")
    for k in range(BEGINS):
        sound.track(*recording[k])
    sound.close()
    assert sound.pipeline.calibration is not None
    np.testing.assert_array_equal(
        slam.pipeline.calibration.found.applied.values,
        sound.pipeline.calibration.found.applied.values,
    )


def test_the_world_does_not_begin_with_images_that_are_not_used(recording: fg.Recording) -> None:
    times, images, _ = zip(*(recording[k] for k in range(3)), strict=True)
    dark = np.zeros_like(images[1][0])
    slam = fg.Slam(recording.rig)
    slam.track(times[0], (dark, images[1][1], dark))
    assert slam.track(times[1], images[1]).status.value == "camera_fault"  # the right image again
    assert len(slam) == 2
    assert slam.track(times[2], images[2]).status.value == "first"
    assert len(slam) == 1
    slam.close()


def test_an_extractor_that_fails_where_the_world_begins_takes_no_frame_away(
    recording: fg.Recording,
) -> None:
    extract, calls = make_extractor(FrontendSettings()), []

    def failing(image: Image) -> Features:
        calls.append(image.any())
        if sum(calls) == 1:
            raise ZeroDivisionError
        return extract(image)

    slam = fg.Slam(recording.rig, frontend={"tracking": "hybrid"}, features=failing)
    t, images, _ = recording[1]
    slam.track(recording[0][0], tuple(np.zeros_like(image) for image in images))
    with pytest.raises(ZeroDivisionError):
        slam.track(t, images)
    assert len(slam.result().trajectory) == 1
    assert slam.track(t, images).status.value == "first"
    assert len(slam) == 1
    assert sum(calls) == 2  # once for each time that the frame came
    slam.close()


@pytest.mark.parametrize("tracking", ["sift", "hybrid"])
def test_frames_before_the_world_begins_are_worked_on_once(
    recording: fg.Recording, tracking: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    extract, calls, matched = make_extractor(FrontendSettings()), [], []
    match = StereoMatcher.match_all

    def counted(image: Image) -> Features:
        calls.append(image)
        return extract(image)

    def match_counted(*given: Any) -> Any:
        matched.append(given)
        return match(*given)

    monkeypatch.setattr(StereoMatcher, "match_all", match_counted)
    slam = fg.Slam(recording.rig, frontend={"tracking": tracking}, features=counted)
    images = recording[0][1]
    assert images is not None
    for k in range(1, 5):
        slam.track(0.1 * k, tuple(np.full_like(image, k) for image in images))
    slam.close()
    assert slam.recorder.most_stereo == 0
    first = 1 if tracking == "hybrid" else len(images)
    assert len(calls) == first + 3 * len(images)
    assert len(matched) == (3 if tracking == "hybrid" else 4)


def displaced(by_px: int, moved: Callable[[int], float], frames: int = 20) -> fg.Result:
    """A drive to the right past planes, the left image of which is displaced from frame 6 on."""
    with fg.Slam(PASSING_RIG, "landmark_kalman") as session:
        for k in range(frames):
            left, right = pair_of(list(SCENE), moved(k), 0.0)
            step = np.eye(4)
            step[0, 3] = moved(k) - moved(k - 1)
            session.track(0.1 * k, (np.roll(left, by_px * (k >= 6), 1), right), step)
        return session.result()


@pytest.mark.parametrize("by_px", [6, -6])
def test_a_camera_moved_beyond_any_calibration_leaves_the_other_image(by_px: int) -> None:
    """No landmark fits the pair, and those that it would begin were at other distances."""
    result = displaced(by_px, lambda k: 0.04 * k)
    assert set(result.column("status")[6:]) == {"one_image"}
    assert result.trajectory.poses[-1][0, 3] == pytest.approx(0.04 * 19, abs=0.01)
    assert any("is not where the calibration has it" in remark for remark in result.remarks)


def test_a_displaced_pair_begins_no_map_where_no_image_shows_the_old_one() -> None:
    """The camera jumps to where nothing is known: by odometry alone."""
    result = displaced(6, lambda k: 0.04 * k + 5.0 * (k >= 12))
    assert set(result.column("status")[12:]) == {"camera_fault"}
    assert result.trajectory.poses[-1][0, 3] == pytest.approx(0.04 * 19 + 5.0, abs=0.05)


def test_a_displaced_pair_for_one_frame_leaves_the_rest_as_it_is() -> None:
    with fg.Slam(PASSING_RIG, "landmark_kalman") as session:
        for k in range(12):
            left, right = pair_of(list(SCENE), 0.04 * k, 0.0)
            session.track(0.1 * k, (np.roll(left, 6 * (k == 6), 1), right))
        result = session.result()
    status = result.column("status").tolist()
    assert status[6] == "one_image"
    assert set(status[7:]) == {"ok"}
