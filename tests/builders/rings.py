"""A drive round a ring on ideal features, with wheels that turn too far; places are recognised."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator

import numpy as np
from simulated import RIG, FeatureWorld, assert_same_bits

from fgslam.backend.settings import EstimatorSettings, LandmarkKalmanSettings
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray, StateArrays
from fgslam.core.log import Frame
from fgslam.core.sensors import Increment, Odometry
from fgslam.core.types import Features, Prediction
from fgslam.frontend.places.recognition import (
    LoopGates,
    LostRules,
    PlaceRecognition,
    difference,
)
from fgslam.frontend.settings import EgoMotionSettings, FrontendSettings
from fgslam.frontend.tracking.tracker import LandmarkTracker
from fgslam.slam.build import (
    Arrival,
    make_estimator,
    make_relocaliser,
    make_stereo,
    make_tracker,
    take_over,
)
from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.motion import OdometryMotion
from fgslam.slam.pipeline import FrameReport, SlamPipeline

IMAGES = (np.zeros((240, 320), np.uint8),) * 3
RADIUS = 3.0
ROUND = 72  # frames
NOISE = np.diag(np.concatenate([[1e-6, 0.02, 1e-6], [0.03, 1e-6, 0.03]]) ** 2)
SETTINGS = FrontendSettings(ego_motion=EgoMotionSettings(dof=3))
LOOPS = LoopGates(every=2, forgotten_after=25, confirm=2, rest=6)
LOST = LostRules(after=2, give_up_after=20)


def on_ring(k: float) -> FloatArray:
    """Camera ``k`` of a drive round a circle, looking along it."""
    a = 2.0 * np.pi * k / ROUND
    at = np.array([RADIUS * (1.0 - np.cos(a)), 0.0, RADIUS * np.sin(a)])
    return g.pose(g.so3_exp(np.array([0.0, a, 0.0])), at)


def walls(rng: np.random.Generator) -> FloatArray:
    """Points on a wall around the ring."""
    angle = rng.uniform(0.0, 2.0 * np.pi, 1500)
    distance = RADIUS + rng.uniform(1.0, 2.0, 1500)
    return np.column_stack(
        [RADIUS - distance * np.cos(angle), rng.uniform(-0.9, 0.9, 1500), distance * np.sin(angle)]
    )


class RingMotion(OdometryMotion):
    """Odometry of a drive along given poses whose wheels turn too far in every frame."""

    def __init__(self, poses: list[FloatArray], drift_deg: float) -> None:
        self._poses = poses
        self._wrong = g.so3_exp(np.array([0.0, np.deg2rad(drift_deg), 0.0]))

    def between(self, timestamp: float, body: Odometry | None) -> Odometry | None:
        i = round(timestamp)  # a frame a second
        if i == 0:
            return None
        step = g.inverse(self._poses[i - 1]) @ self._poses[i]
        if np.linalg.norm(step[:3, 3]) > 1.0:  # carried: the wheels know nothing of it
            step = np.eye(4)
        return Odometry(step @ g.pose(self._wrong, np.zeros(3)), NOISE)

    def observe(self, timestamp: float, pose: Prediction, measured: bool) -> None:
        pass

    def displaced(self, timestamp: float, wTc: FloatArray, carried: bool) -> None:
        pass

    def regained(self, timestamp: float, wTc: FloatArray) -> None:
        pass

    def state(self) -> StateArrays:
        return {}

    def restore(self, state: StateArrays) -> None:
        pass


def pipeline_of(
    poses: list[FloatArray],
    drift_deg: float,
    settings: FrontendSettings = SETTINGS,
    estimator: EstimatorSettings = LandmarkKalmanSettings(),  # noqa: B008 (frozen)
    arrival: Arrival | None = None,
    loops: LoopGates | None = LOOPS,
    lost: LostRules | None = LOST,
) -> SlamPipeline:
    """The loop on a ring's odometry, in an empty map or a given one."""
    settings = dataclasses.replace(settings, loops=loops is not None, lost=lost is not None)
    tracker = make_tracker(RIG, settings)
    prior = None if arrival is None else arrival.prior
    solving = make_estimator(RIG, estimator, settings.ego_motion, prior)
    if arrival is not None:
        take_over(solving, arrival)
        tracker.database.load(arrival.saved)
        tracker.keeps_map = not arrival.extends
    return SlamPipeline(
        stereo=make_stereo(RIG, settings),
        tracker=tracker,
        motion=RingMotion(poses, drift_deg),
        estimator=solving,
        places=places_of(settings, tracker, loops, lost),
        located=prior if arrival is not None and arrival.relocalised else None,
    )


def places_of(
    settings: FrontendSettings,
    tracker: LandmarkTracker,
    loops: LoopGates | None,
    lost: LostRules | None,
) -> PlaceRecognition | None:
    """Place recognition by these rules; None where neither is given."""
    if loops is None and lost is None:
        return None
    relocaliser = make_relocaliser(RIG, settings)
    return PlaceRecognition(tracker, relocaliser, settings.appearance, 0, loops, lost)


def seen(
    poses: list[FloatArray], dark: range = range(0), sigma_px: float = 0.1
) -> Iterator[FeatureFrame]:
    """Frames with the features that the poses see; none in the dark."""
    rng = np.random.default_rng(8)
    world = FeatureWorld(walls(rng), rng)
    for i, wTc in enumerate(poses):
        features = world.features(wTc, sigma_px)
        if i in dark:
            features = tuple(_none_of(f) for f in features)
        yield FeatureFrame(i, Frame(i, float(i), IMAGES), features, "", 0.0, 0.0)


def _none_of(features: Features) -> Features:
    return dataclasses.replace(
        features,
        xy=features.xy[:0],
        scale=features.scale[:0],
        orientation=features.orientation[:0],
        descriptors=features.descriptors[:0],
    )


def drive(pipeline: SlamPipeline, frames: Iterable[FeatureFrame]) -> list[FrameReport]:
    """All frames, one after the other."""
    return [pipeline.process(found, found.i, float(found.i)) for found in frames]


def error_m(report: FrameReport, true: FloatArray) -> float:
    """Of the position as given with the frame."""
    return difference(true, report.stats.wTc)[0]


def closings(reports: list[FrameReport]) -> list[int]:
    """Frames with a closure, taken or not."""
    return [k for k, report in enumerate(reports) if report.increment.loops]


def assert_same_increments(a: Increment, b: Increment) -> None:
    """Observations, what ended, and loops."""
    assert_same_bits(a.observations, b.observations)
    np.testing.assert_array_equal(a.pruned_ids, b.pruned_ids)
    assert len(a.loops) == len(b.loops)
    for one, other in zip(a.loops, b.loops, strict=True):
        assert one.frame == other.frame
        np.testing.assert_array_equal(one.oTc, other.oTc)
