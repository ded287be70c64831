"""What a user may pass as estimator and as settings of the front-end."""

from __future__ import annotations

from typing import Any

import pytest

from fgslam.core.errors import CalibrationError, ConfigError, MeasurementLogError
from fgslam.core.sensors import MeasurementType
from fgslam.frontend.settings import FrontendSettings
from fgslam.runs.library import replay
from fgslam.slam.build import chosen_estimator, chosen_frontend
from fgslam.slam.session import Session


class Lookalike:
    """Has the members of an estimator."""

    kind = "lookalike"
    supports: Any = frozenset(MeasurementType)
    predict = landmarks = update = estimate = lambda self: None


def test_a_class_instead_of_an_object_is_refused() -> None:
    given: Any = Lookalike
    with pytest.raises(ConfigError, match="Lookalike is a class; give an object"):
        chosen_estimator(given)


def test_measurement_types_are_checked() -> None:
    given: Any = Lookalike()
    given.supports = 1
    with pytest.raises(ConfigError, match="supports of Lookalike is 1"):
        chosen_estimator(given)


def test_a_mapping_of_the_front_end_names_what_differs() -> None:
    chosen = chosen_frontend({"stereo": {"max_disparity_px": 80}})
    assert chosen.stereo.max_disparity_px == 80.0
    assert chosen.matching == FrontendSettings().matching


@pytest.mark.parametrize("given", [{"stereo": {"max_disparity": 80}}, {"stereo": 3}, 7])
def test_an_unusable_front_end_is_refused(given: Any) -> None:
    with pytest.raises(ConfigError, match=r"frontend: .*give settings by group"):
        chosen_frontend(given)


def test_a_rig_of_another_type_is_refused() -> None:
    rig: Any = {"fx": 500.0}
    with pytest.raises(CalibrationError, match=r"it is a dict; give fgslam\.StereoRig"):
        Session(rig)


def test_a_replay_wants_a_log() -> None:
    log: Any = None
    with pytest.raises(MeasurementLogError, match="the log is a NoneType"):
        replay(log, "ekf")
