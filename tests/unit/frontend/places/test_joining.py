"""After a gap that nothing bridges the map is founded anew; recognised, its parts become one."""

from __future__ import annotations

import numpy as np
import pytest
from rings import drive, error_m, on_ring, pipeline_of, seen
from simulated import RIG, assert_same_bits

from fgslam.backend.settings import EstimatorSettings, Isam2Settings, LandmarkKalmanSettings
from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import inverse
from fgslam.datasets.settings import ConstantVelocitySettings
from fgslam.frontend.places.recognition import PlaceRecognition
from fgslam.frontend.settings import FrontendSettings
from fgslam.slam.build import make_motion, make_places
from fgslam.slam.pipeline import FrameReport, SlamPipeline

GAP = 8
RETURN = [*range(0, 2 * GAP, 2), *range(40, 84, 2)]  # on the ring; beyond 72 it is known again
WAY = [on_ring(k) for k in RETURN]
SETTINGS = FrontendSettings()


def driven(
    estimator: EstimatorSettings, way: list[FloatArray]
) -> tuple[SlamPipeline, list[FrameReport]]:
    pipeline = pipeline_of(way, 0.0, SETTINGS, estimator)
    pipeline.motion = make_motion(RIG, ConstantVelocitySettings())
    pipeline.places = make_places(RIG, SETTINGS, pipeline.tracker, seed=0, joins=True)
    return pipeline, drive(pipeline, seen(way))


@pytest.mark.parametrize("estimator", [LandmarkKalmanSettings(), Isam2Settings()])
def test_parts_are_joined_where_the_first_is_recognised(estimator: EstimatorSettings) -> None:
    pipeline, reports = driven(estimator, WAY)
    assert pipeline.places is not None
    joined = [k for k, report in enumerate(reports) if report.increment.loops]
    assert joined
    assert joined[0] > GAP
    assert pipeline.places.taken[0]
    assert pipeline.tracker.parts.connected.all()
    assert max(error_m(report, WAY[k]) for k, report in enumerate(reports) if k > joined[-1]) < 0.1
    found = pipeline.estimator.estimate().trajectory.poses
    off = [np.linalg.norm((inverse(a) @ b)[:3, 3]) for a, b in zip(WAY, found, strict=True)]
    assert max(off) < 0.15


def test_without_a_join_they_stay_apart_and_that_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(PlaceRecognition, "find_join", lambda *_: None)
    pipeline, reports = driven(Isam2Settings(), WAY[: GAP + 6])
    assert pipeline.tracker.parts.connected.tolist() == [True] * GAP + [False] * 6
    later = reports[-1]
    assert error_m(later, WAY[GAP + 5]) > 1.0
    covariance = pipeline.estimator.estimate().covariances[-1]
    assert np.sqrt(covariance[3:, 3:].trace()) > 1.0


def test_the_same_drive_is_joined_to_the_bit() -> None:
    (_, one), (_, other) = (driven(LandmarkKalmanSettings(), WAY[: GAP + 13]) for _ in range(2))
    assert [k for k, report in enumerate(one) if report.increment.loops]
    np.testing.assert_array_equal(one[-1].stats.wTc, other[-1].stats.wTc)
    assert_same_bits(one[-1].increment.observations, other[-1].increment.observations)
