from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from fgslam.backend.filters.kalman import LandmarkKalman
from fgslam.backend.settings import LandmarkKalmanSettings
from fgslam.core.correction import term_names
from fgslam.core.errors import ConfigError
from fgslam.core.geometry import BODY_FORWARD_LEFT_UP_FROM_CAMERA
from fgslam.core.sensors import CameraRig, MeasurementType
from fgslam.datasets.settings import ConstantVelocitySettings
from fgslam.frontend.settings import FrontendSettings, StereoSettings
from fgslam.runs.config import make_config
from fgslam.runs.opening import open_sequence
from fgslam.slam.build import as_measured, make_estimator, make_pipeline, require_support

RIG = CameraRig(320, 240, 277.0, 277.0, 159.5, 119.5, 0.1, 0.1, BODY_FORWARD_LEFT_UP_FROM_CAMERA)


def test_the_filter_takes_stereo_and_odometry() -> None:
    require_support(make_estimator(RIG, LandmarkKalmanSettings()), measured_odometry=True)


def test_an_estimator_without_odometry_is_refused_only_where_there_is_some(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(LandmarkKalman, "supports", frozenset({MeasurementType.STEREO}))
    estimator = make_estimator(RIG, LandmarkKalmanSettings())
    require_support(estimator, measured_odometry=False)
    with pytest.raises(ConfigError, match="landmark_kalman cannot use odometry measurements"):
        require_support(estimator, measured_odometry=True)


def test_a_camera_made_up_from_depth_cannot_have_moved_but_its_scale_is_unknown() -> None:
    pair = dataclasses.replace(RIG, vertical_baseline=None)
    odometry, kalman = ConstantVelocitySettings(), LandmarkKalmanSettings()
    stereo = make_pipeline(pair, FrontendSettings(), odometry, kalman)
    assert stereo.calibration is not None
    assert stereo.watch is not None
    depth = FrontendSettings(stereo=StereoSettings(disparity_sigma_px=0.2))
    pipeline = make_pipeline(pair, depth, odometry, kalman)
    assert pipeline.calibration is None
    assert pipeline.watch is None
    # Covariances contain what a correction of this size leaves: the baseline is the scale of depth.
    np.testing.assert_array_equal(pipeline.stated, np.zeros(len(term_names(pair))))
    assert not as_measured(pair, depth).stated


def test_a_rig_that_no_drive_corrects_is_taken_as_stated() -> None:
    pair = dataclasses.replace(RIG, vertical_baseline=None)
    paper = StereoSettings(measurement="paper")
    for settings, stated in (
        (FrontendSettings(), False),
        (FrontendSettings(self_calibration=False), True),
        (FrontendSettings(stereo=paper), True),
    ):
        assert as_measured(pair, settings).stated == stated


def test_noise_of_recorded_odometry_is_not_silently_idle_in_the_lab() -> None:
    lab = {"kind": "rendered_lab"}
    noisy = {"kind": "recorded", "speed_sigma_mps": 9.0}
    with pytest.raises(ConfigError, match=r"dataset\.odometry"):
        open_sequence(make_config({"name": "x", "dataset": lab, "odometry": noisy}, "x"))
