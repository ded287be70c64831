"""People walk across the view, and about in the house, where they wait and turn back."""

import numpy as np
import pytest
from simulated import plan_drive

from fgslam.worlds.lab import make_rig
from fgslam.worlds.patches import stack
from fgslam.worlds.people import Walk, Walker, make_walk, person
from fgslam.worlds.settings import LabEffectsSettings, LabRigSettings, LabSettings

RIG = make_rig(LabRigSettings())
DRIVE = plan_drive(LabSettings().drive)


@pytest.fixture
def walk() -> Walk:
    """From second 10 to 15.5, at two frames a second."""
    found = make_walk(LabSettings(effects=LabEffectsSettings(person=20)), DRIVE, RIG)
    assert found is not None
    return found


def test_person_walks_through_the_middle_of_the_view(walk: Walk) -> None:
    assert walk.stance(9.99) is None
    assert walk.stance(15.51) is None
    camera = (DRIVE.body_poses(np.array([12.75])) @ RIG.bTc)[0]
    stance = walk.stance(12.75)
    assert stance is not None
    point = (np.array([stance.x, stance.y, camera[2, 3]]) - camera[:3, 3]) @ camera[:3, :3]
    np.testing.assert_allclose(point, [0.0, 0.0, 1.8], atol=1e-9)
    first, last = walk.stance(10.0), walk.stance(15.5)
    assert first is not None
    assert last is not None
    for end, sign in ((first, 1.0), (last, -1.0)):
        x = (np.array([end.x, end.y, 0.0]) - camera[:3, 3]) @ camera[:3, 0]
        assert sign * x > 2.0 * np.tan(np.deg2rad(30.0)) + 0.3


def test_person_stands_on_the_floor_with_a_head_of_human_height(walk: Walk) -> None:
    spread = []
    for seconds in np.linspace(walk.begins, walk.ends, 9):
        stance = walk.stance(float(seconds))
        assert stance is not None
        body = stack([person(stance)])
        c, u, v = body.corner, body.edge_u, body.edge_v
        points = np.concatenate([c, c + u, c + v, c + u + v])
        assert points[:, 2].max() == pytest.approx(1.78)
        assert -0.05 < points[:, 2].min() < 0.2
        legs = points[points[:, 2] < 0.3]
        spread.append(np.ptp(legs[:, :2], axis=0).max())
    assert max(spread) > min(spread) + 0.2


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
