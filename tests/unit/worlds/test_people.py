"""People walk, wait for the robot and turn back."""

import numpy as np
import pytest

from fgslam.worlds.people import Walker


def test_walker_goes_to_and_fro_and_waits_for_the_robot() -> None:
    route = np.array([[0.0, 0.0], [4.0, 0.0]])
    walker = Walker(route, 0.0)
    far = np.array([50.0, 50.0])
    places = []
    for _ in range(140):
        walker.advance(0.1, far)
        places.append(walker.stance().x)
    assert max(places) == pytest.approx(4.0, abs=0.1)
    assert min(places[60:]) == pytest.approx(0.0, abs=0.1)
    assert np.abs(np.diff(places)).max() <= 0.08 + 1e-9
    meeting = Walker(route, 1.0)
    for _ in range(10):
        meeting.advance(0.1, np.array([2.0, 0.0]))
    assert meeting.stance().x == pytest.approx(1.0, abs=0.05)
    for _ in range(20):
        meeting.advance(0.1, np.array([2.0, 0.0]))
    assert meeting.stance().x < 0.6
