"""A session: frames pushed in, results at any time, wrong use refused without a trace."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import pytest
from rings import on_ring, walls
from simulated import RIG, FeatureWorld, assert_same_bits, assert_same_value

from fgslam.backend.filters.kalman import LandmarkKalman
from fgslam.backend.settings import EstimatorSettings, Isam2Settings, LandmarkKalmanSettings
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import (
    CalibrationError,
    ConfigError,
    DatasetError,
    EstimatorError,
    FgslamError,
    FrameError,
    OdometryError,
    SessionError,
)
from fgslam.core.log import Frame
from fgslam.core.sensors import Odometry
from fgslam.core.types import EgoMotionStatus, Features, Prediction, Remark
from fgslam.datasets.settings import ConstantVelocitySettings
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.frontend.tracking.tracker import Tracked
from fgslam.slam.pipeline import FrameReport
from fgslam.slam.replay import replay
from fgslam.slam.results import SessionResult
from fgslam.slam.session import Session, checked_images

FRAMES = 5
RIGHT, LEFT, TOP = range(3)


class Views:
    """Images that only say which frame and camera they are, and the features seen in each.

    So a session is driven by images, and finding features costs nothing.
    """

    def __init__(self) -> None:
        rng = np.random.default_rng(5)
        world = FeatureWorld(walls(rng), rng)
        self.poses = [on_ring(0.4 * k) for k in range(FRAMES)]
        self.seen = [world.features(wTc, 0.2) for wTc in self.poses]
        self.blank = len(self.seen)
        self.seen.append([few.select(np.arange(3)) for few in self.seen[0]])

    def images(self, k: int) -> tuple[Image, ...]:
        """Left, right, top."""
        return tuple(self._image(k, camera) for camera in (LEFT, RIGHT, TOP))

    def odometry(self, k: int) -> FloatArray:
        step = g.inverse(self.poses[k - 1]) @ self.poses[k]
        return np.asarray(RIG.bTc @ step @ g.inverse(RIG.bTc))

    def find(self, image: Image) -> Features:
        return self.seen[int(image[0, 0])][int(image[0, 1])]

    @staticmethod
    def _image(k: int, camera: int) -> Image:
        image = np.zeros((RIG.height, RIG.width), np.uint8)
        image[0, :2] = k, camera
        return image


@pytest.fixture(scope="module")
def views() -> Views:
    return Views()


def session(views: Views, estimator: Any = "landmark_kalman", **more: Any) -> Session:
    """These images show nothing that could be carried: features of every frame."""
    more.setdefault("frontend", {"tracking": "sift"})
    return Session(RIG, estimator, features=views.find, **more)


def push(slam: Session, views: Views, frames: Iterator[int] | range) -> None:
    for k in frames:
        slam.track(0.5 * k, views.images(k), views.odometry(k) if k else None)


def driven(views: Views, estimator: Any = "landmark_kalman") -> Session:
    slam = session(views, estimator)
    push(slam, views, range(FRAMES))
    return slam


@cache
def straight(views: Views, estimator: str = "landmark_kalman") -> Session:
    """A session of all frames and nothing else, made once; read only."""
    return driven(views, estimator)


@pytest.mark.parametrize("estimator", [LandmarkKalmanSettings(), Isam2Settings()])
def test_the_world_begins_with_the_first_frame_that_shows_enough(
    views: Views, estimator: EstimatorSettings
) -> None:
    late, straight = session(views, estimator), session(views, estimator)
    straight.numbering = (2, 1)
    for k, images in enumerate((None, views.images(views.blank))):
        assert not late.track(0.1 * k, images).status.measured
    assert len(late.result().trajectory) == 2
    for k in range(3):
        step, expected = (slam.track(0.5 * k + 1, views.images(k)) for slam in (late, straight))
        assert (step.index, step.status) == (k, expected.status)
    assert_same_result(late, straight)
    assert [increment.index for increment in late.log] == [2, 3, 4]
    assert Remark("left_out", values={"count": 2}) in late.result().remarks
    replayed = replay(late.log, estimator, EgoMotionSettings())
    assert_same_bits(replayed.estimate.trajectory, late.result().trajectory)


def test_a_start_that_sees_nothing_stays_where_odometry_measured_it(views: Views) -> None:
    slam = session(views)
    slam.track(-0.5, None)
    push(slam, views, range(1))
    assert len(slam) == 1  # no odometry was measured to the frame that sees
    slam = session(views)
    slam.track(0.0, None)
    push(slam, views, range(1, 3))
    assert len(slam) == 3
    assert slam.result().column("connected").all()


def assert_same_result(first: Session, second: Session) -> None:
    assert_same_bits(first.result().estimate, second.result().estimate)
    assert_same_value(first.log, second.log)


# --------------------------------------------------------------------------------------------
# Frames and results


def test_a_step_reports_what_was_matched(views: Views) -> None:
    slam = session(views)
    first = slam.track(0.0, views.images(0))
    second = slam.track(0.5, views.images(1), views.odometry(1))
    assert first.status is EgoMotionStatus.FIRST
    assert (len(first.matches), len(first.inliers)) == (0, 0)
    assert len(first.new) == first.landmarks > 0
    assert (second.index, second.timestamp) == (1, 0.5)
    assert len(second.matches) == len(second.inliers) > 20
    assert second.covariance.shape == (6, 6)
    assert np.isin(second.matches.ids, first.new.ids).all()


def test_path_and_landmarks_are_live(views: Views) -> None:
    """After each frame, without a solution: poses as they came, the map that steps report."""
    slam = session(views, "sliding_window")
    steps = []
    for i in range(FRAMES):
        push(slam, views, range(i, i + 1))
        assert len(slam.path) == i + 1
        steps.append((slam.path.poses[-1], len(slam.landmarks)))
    online = slam.result().online
    np.testing.assert_array_equal(online.poses, [pose for pose, _ in steps])
    assert steps[-1][1] == len(slam.result().estimate.landmarks) > 0
    assert steps[0][1] > 0


@pytest.mark.parametrize("estimator", ["landmark_kalman", "isam2", "fixed_lag"])
def test_results_asked_for_between_frames_change_nothing(views: Views, estimator: str) -> None:
    asked = session(views, estimator)
    for k in range(FRAMES):
        push(asked, views, range(k, k + 1))
        assert len(asked.result().trajectory) == k + 1
    assert_same_result(asked, straight(views, estimator))


def test_sessions_in_threads_do_not_disturb_each_other(views: Views) -> None:
    slams = [session(views, "ekf") for _ in range(2)]
    threads = [threading.Thread(target=push, args=(s, views, range(FRAMES))) for s in slams]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    alone = driven(views, "ekf")
    for slam in slams:
        assert_same_result(slam, alone)


def test_a_session_of_constant_velocity_ignores_odometry(views: Views) -> None:
    settings = ConstantVelocitySettings()
    without, given = (session(views, odometry=settings) for _ in range(2))
    push(given, views, range(FRAMES))
    for k in range(FRAMES):
        without.track(0.5 * k, views.images(k))
    assert_same_result(given, without)


def test_a_bare_motion_gets_the_noise_of_the_settings(views: Views) -> None:
    slam = session(views)
    push(slam, views, range(2))
    measured = slam.log.increments[1].odometry
    assert measured is not None
    sigma = np.sqrt(np.diag(measured.covariance))
    assert sigma[:3] == pytest.approx(sigma[0])
    assert 0.002 <= sigma[5] < 0.02  # at least the floor, at most 2 % of the step


def test_odometry_with_its_own_covariance_is_used_as_it_is(views: Views) -> None:
    slam = session(views)
    slam.track(0.0, views.images(0))
    stated = Odometry(views.odometry(1), np.diag([1e-4] * 3 + [4e-4] * 3))
    slam.track(0.5, views.images(1), stated)
    measured = slam.log.increments[1].odometry
    assert measured is not None
    assert np.trace(measured.covariance) == pytest.approx(3e-4 + 12e-4)


def test_a_frame_without_images_is_placed_by_odometry(views: Views) -> None:
    slam = session(views)
    push(slam, views, range(3))
    step = slam.track(1.5, None, views.odometry(3))
    assert step.status is EgoMotionStatus.NO_IMAGE
    expected = g.inverse(views.poses[0]) @ views.poses[3]
    np.testing.assert_allclose(step.wTc[:3, 3], expected[:3, 3], rtol=0, atol=0.05)
    assert slam.track(2.0, views.images(4), views.odometry(4)).status is EgoMotionStatus.OK


@pytest.mark.parametrize("there", [(0,), (1, 2), (0, 2)])
def test_a_frame_that_lacks_an_image_is_located_by_another(
    views: Views, there: tuple[int, ...]
) -> None:
    slam = session(views)
    push(slam, views, range(3))
    images = [image if k in there else None for k, image in enumerate(views.images(3))]
    step = slam.track(1.5, images, views.odometry(3))
    assert step.status is EgoMotionStatus.ONE_IMAGE
    expected = g.inverse(views.poses[0]) @ views.poses[3]
    np.testing.assert_allclose(step.wTc[:3, 3], expected[:3, 3], rtol=0, atol=0.05)
    none = slam.track(2.0, [None, None, None], views.odometry(4))
    assert none.status is EgoMotionStatus.NO_IMAGE


def test_a_camera_loop_may_fill_the_same_images_again(views: Views) -> None:
    """Tracking compares with the last images: they are not those that were given."""
    buffers = views.images(0)
    taken = checked_images(buffers, RIG)
    before = [image.copy() for image in taken]
    for buffer in buffers:
        buffer[:] = 77
    for image, then in zip(taken, before, strict=True):
        np.testing.assert_array_equal(image, then)


@pytest.mark.parametrize("relocalised", [False, True])
def test_the_pose_that_is_used_shows_whether_it_was_found_again(
    views: Views, monkeypatch: pytest.MonkeyPatch, relocalised: bool
) -> None:
    """Recent landmarks may place a frame again: with them the prediction, or without it."""
    slam = session(views, frontend={"tracking": "sift", "loops": True})
    push(slam, views, range(3))
    status = EgoMotionStatus.RELOCALISED if relocalised else EgoMotionStatus.OK

    def by_recent(self: object, tracked: Tracked, *_: object) -> Tracked:
        found = dataclasses.replace(tracked.ego_motion, status=status)
        return dataclasses.replace(tracked, ego_motion=found)

    monkeypatch.setattr(type(slam.pipeline.places), "placed_by_recent", by_recent)
    slam.track(1.5, views.images(3), views.odometry(3))
    assert slam.log.increments[-1].relocalised is relocalised


def test_the_log_counts_frames_as_their_recording_does(views: Views) -> None:
    slam = session(views)
    slam.numbering = (10, 3)
    push(slam, views, range(3))
    assert [increment.index for increment in slam.log] == [10, 13, 16]


# --------------------------------------------------------------------------------------------
# Wrong use


def turned(motion: FloatArray) -> FloatArray:
    out = motion.copy()
    out[:3, :3] *= 1.1
    return out


WRONG: dict[str, tuple[type[FgslamError], str, dict[str, Any]]] = {
    "time stands still": (FrameError, "does not come after", {"t": 1.0}),
    "time runs back": (FrameError, "order of their times", {"t": 0.4}),
    "time is NaN": (FrameError, "not finite", {"t": float("nan")}),
    "time is no number": (FrameError, "not a number", {"t": "now"}),
    "time is huge": (FrameError, "not a number", {"t": 10**400}),
    "images are a number": (FrameError, "images are a int; give a tuple", {"images": lambda v: 5}),
    "images are a generator": (FrameError, "generator", {"images": lambda v: (x for x in v)}),
    "rows differ": (FrameError, "different lengths", {"images": lambda v: ([[1, 2], [3]], *v[1:])}),
    "one image": (FrameError, "1 images given", {"images": lambda v: v[:1]}),
    "one missing": (FrameError, "1 images given", {"images": lambda v: [None]}),
    "two images": (FrameError, "without vertical_baseline", {"images": lambda v: v[:2]}),
    "half size": (FrameError, "160x120", {"images": lambda v: tuple(x[::2, ::2] for x in v)}),
    "float images": (FrameError, "float64", {"images": lambda v: tuple(x / 255.0 for x in v)}),
    "flat image": (FrameError, r"shape \(240,\)", {"images": lambda v: (v[0][:, 0], *v[1:])}),
    "two channels": (FrameError, "red, green", {"images": lambda v: (np.dstack(v[:2]), *v[1:])}),
    "odometry is NaN": (OdometryError, "not finite", {"odometry": np.full((4, 4), np.nan)}),
    "odometry is flat": (OdometryError, r"shape \(3,\)", {"odometry": np.zeros(3)}),
    "odometry is text": (OdometryError, "no array", {"odometry": "fast"}),
    "odometry is scaled": (OdometryError, "rigid", {"odometry": turned(np.eye(4))}),
    "covariance is negative": (
        OdometryError,
        "symmetric and positive",
        {"odometry": Odometry(np.eye(4), -np.eye(6))},
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_refused_frame_leaves_the_session_as_it_was(views: Views, name: str) -> None:
    error, words, given = WRONG[name]
    slam = session(views)
    push(slam, views, range(3))
    spoil = given.get("images", lambda images: images)
    with pytest.raises(error, match=words) as caught:
        slam.track(
            given.get("t", 1.5), spoil(views.images(3)), given.get("odometry", views.odometry(3))
        )
    assert "\n" not in str(caught.value)
    push(slam, views, range(3, FRAMES))
    assert_same_result(slam, straight(views))


def test_a_closed_session_takes_no_frame_and_keeps_its_results(views: Views) -> None:
    with session(views) as slam:
        push(slam, views, range(3))
    with pytest.raises(SessionError, match="closed; make a new one"):
        push(slam, views, range(3, 4))
    assert len(slam.result().trajectory) == 3
    slam.close()


def test_a_session_without_frames_has_no_result(views: Views) -> None:
    with pytest.raises(SessionError, match="call track first"):
        session(views).result()


class Failing(LandmarkKalman):
    """Fails in the fourth frame."""

    def update(self, increment, tracking):  # type: ignore[no-untyped-def]
        if increment.index == 3:
            raise EstimatorError("no solution")
        return super().update(increment, tracking)


def test_after_a_failure_of_the_estimator_the_results_before_it_remain(views: Views) -> None:
    start = Prediction(np.eye(4), np.zeros((6, 6)))
    slam = session(views, Failing(RIG, LandmarkKalmanSettings(), start))
    push(slam, views, range(3))
    with pytest.raises(EstimatorError, match="no solution"):
        push(slam, views, range(3, 4))
    with pytest.raises(SessionError, match=r"failed at t = 1\.5.* s \(no solution\)"):
        push(slam, views, range(4, 5))
    result = slam.result()
    assert isinstance(result, SessionResult)
    assert len(result.trajectory) == len(slam.log) == 3


def test_a_failure_in_the_first_frame_is_why_there_is_no_result(views: Views) -> None:
    def unreadable(report: FrameReport) -> float:
        raise DatasetError("the depth image is missing")

    slam = session(views)
    found = slam.describer.describe(0, Frame(0, 0.0, views.images(0)))
    with pytest.raises(DatasetError):
        slam.advance(found, 0.0, precision_of=unreadable)
    with pytest.raises(SessionError, match=r"no result: it failed .*depth image is missing"):
        slam.result()


def test_what_are_no_odometry_settings_is_refused(views: Views) -> None:
    with pytest.raises(ConfigError, match=r"odometry: str lacks uses_odometry, .*; give settings"):
        session(views, odometry="constant_velocity")


class Standing:
    """A motion model of one's own: the camera stays, to 20 cm and 3 degrees a frame."""

    uses_odometry = False

    def __init__(self) -> None:
        self.seen: list[tuple[float, bool]] = []

    def between(self, timestamp: float, body: Odometry | None) -> Odometry | None:
        assert body is None
        sigma = np.repeat([0.05, 0.2], 3)
        return Odometry(np.eye(4), np.diag(sigma**2)) if self.seen else None

    def observe(self, timestamp: float, pose: Any, measured: bool) -> None:
        self.seen.append((timestamp, measured))

    def displaced(self, timestamp: float, wTc: Any, carried: bool) -> None:
        raise AssertionError("nothing moved it")

    regained = displaced


def test_a_motion_model_of_ones_own_predicts_and_is_in_the_log(views: Views) -> None:
    motion = Standing()
    slam = session(views, odometry=motion)
    push(slam, views, range(FRAMES))
    assert motion.seen == [(0.5 * k, True) for k in range(FRAMES)]
    steps = [increment.odometry for increment in slam.log]
    assert steps[0] is None
    assert all(step is not None and np.array_equal(step.motion, np.eye(4)) for step in steps[1:])
    again = replay(slam.log, LandmarkKalmanSettings(), EgoMotionSettings())
    expected = slam.result().trajectory.poses
    np.testing.assert_allclose(again.estimate.trajectory.poses, expected, rtol=0, atol=0.02)


def test_a_motion_model_that_is_none_is_refused(views: Views) -> None:
    with pytest.raises(ConfigError, match=r"odometry: Standing is a class; give an object"):
        session(views, odometry=Standing)


class FailingAfterUpdate(LandmarkKalman):
    """Takes the fourth frame in, and fails when asked what came of it."""

    answers = True

    def update(self, increment, tracking):  # type: ignore[no-untyped-def]
        stats = super().update(increment, tracking)
        if increment.index == 3:
            raise RuntimeError("the marginals are\nindeterminate")
        return stats

    def estimate(self):  # type: ignore[no-untyped-def]
        if not self.answers:
            raise RuntimeError("indeterminate")
        return super().estimate()


@pytest.mark.parametrize("answers", [True, False])
def test_a_frame_that_fails_after_the_update_is_in_no_result(views: Views, answers: bool) -> None:
    start = Prediction(np.eye(4), np.zeros((6, 6)))
    estimator = FailingAfterUpdate(RIG, LandmarkKalmanSettings(), start)
    slam = session(views, estimator)
    push(slam, views, range(3))
    before = slam.result()
    with pytest.raises(RuntimeError, match="marginals"):
        push(slam, views, range(3, 4))
    estimator.answers = answers
    assert len(LandmarkKalman.estimate(estimator).trajectory) == 4
    result = slam.result()
    assert len(result.trajectory) == len(result.covariances) == len(result.online) == 3
    assert len(slam.log) == len(result.column("status")) == 3
    np.testing.assert_array_equal(result.trajectory.poses, before.trajectory.poses)
    assert np.isin(result.estimate.landmarks.ids, slam.pipeline.tracker.database.ids).all()
    assert bool(result.remarks) is not answers
    with pytest.raises(SessionError, match=r"failed at t = 1\.5.* \(the marginals are indeterm"):
        push(slam, views, range(4, 5))


def test_a_frame_whose_record_fails_is_in_no_result(views: Views) -> None:
    slam = session(views)
    push(slam, views, range(3))
    found = slam.describer.describe(3, Frame(3, 1.5, views.images(3)))

    def unreadable(report: FrameReport) -> float:
        raise DatasetError("the depth image is missing")

    with pytest.raises(DatasetError):
        slam.advance(found, 1.5, precision_of=unreadable)
    assert len(slam.result().trajectory) == len(slam.log) == len(slam) == 3
    with pytest.raises(SessionError, match="depth image is missing"):
        push(slam, views, range(4, 5))


@pytest.mark.parametrize(
    ("estimator", "words"),
    [
        ("isam", r"no kind 'isam'; did you mean isam2\?"),
        ("gauss", "known: odometry, landmark_kalman"),
        (LandmarkKalman, "LandmarkKalman is a class; give an object"),
        (object(), "object lacks kind, supports, predict"),
    ],
)
def test_an_unknown_estimator_is_refused_with_what_is_known(estimator: Any, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        Session(RIG, estimator)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"baseline": 0.0}, "distance between the cameras"),
        ({"baseline": -0.1}, "left and right are swapped"),
        ({"fx": float("nan")}, "focal length in pixels"),
        ({"width": 320.5}, "size in pixels"),
        ({"cx": 1e6}, "principal point"),
        ({"bTc": np.zeros((4, 4))}, "rigid motion"),
    ],
)
def test_an_impossible_rig_is_refused(change: dict[str, Any], words: str) -> None:
    with pytest.raises(CalibrationError, match=words):
        Session(dataclasses.replace(RIG, **change))


def test_a_negative_seed_is_refused() -> None:
    with pytest.raises(ConfigError, match="seed is -1; give a whole number"):
        Session(RIG, seed=-1)


def test_what_is_no_extractor_is_refused() -> None:
    given: Any = 5
    with pytest.raises(ConfigError, match="features: int cannot be called; give a function"):
        Session(RIG, features=given)


def test_what_is_no_rig_is_refused() -> None:
    no_rig: Any = "camchain.yaml"
    with pytest.raises(CalibrationError, match=r"it is a str; give fgslam\.StereoRig"):
        Session(no_rig)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: "features", "returned str"),
        (
            lambda f: dataclasses.replace(f, descriptors=f.descriptors[:, 0]),
            r"descriptors has shape \(\d+,\); give a row for each feature",
        ),
        (
            lambda f: dataclasses.replace(f, descriptors=f.descriptors.astype(complex)),
            "descriptors are complex128; give numbers or bits",
        ),
        (
            lambda f: dataclasses.replace(f, descriptors=f.descriptors + np.nan),
            "descriptors are not finite",
        ),
        (
            lambda f: dataclasses.replace(f, descriptors=f.descriptors[1:]),
            r"\d+ descriptors of \d+ features",
        ),
        (lambda f: dataclasses.replace(f, xy=f.xy[:-1]), "xy has shape"),
        (lambda f: dataclasses.replace(f, scale=None), "scale is a NoneType"),
        (lambda f: dataclasses.replace(f, xy=f.xy.tolist()), "xy is a list; give an array"),
    ],
)
def test_features_of_another_form_are_refused_and_the_session_goes_on(
    views: Views, change: Any, words: str
) -> None:
    broken = False

    def find(image: Image) -> Any:
        found = views.find(image)
        return change(found) if broken else found

    slam = Session(RIG, "landmark_kalman", features=find, frontend={"tracking": "sift"})
    push(slam, views, range(3))
    broken = True
    with pytest.raises(ConfigError, match=words):
        push(slam, views, range(3, 4))
    broken = False
    push(slam, views, range(3, FRAMES))
    assert_same_result(slam, straight(views))
