"""Random worlds, mistakes and postures: found right, or refused, never wrong."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from known_places import RIG, error, floor, planar, room, seen

from fgslam.frontend.places import relocalisation as relocaliser
from fgslam.frontend.places.relocalisation import Relocaliser
from fgslam.frontend.settings import RelocalisationSettings

SETTINGS = RelocalisationSettings(map_sigma_m=0.001)


@pytest.fixture(autouse=True)
def _exact_features(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulated features are where their landmarks are, from wherever they are seen."""
    monkeypatch.setattr(relocaliser, "VIEW_SIGMA_PX", 0.0)


@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    count=st.integers(0, 900),
    clutter=st.integers(0, 150),
    x=st.floats(-3.0, 3.0),
    z=st.floats(-3.0, 3.0),
    yaw=st.floats(-3.14, 3.14),
)
def test_never_confident_and_wrong(
    seed: int, count: int, clutter: int, x: float, z: float, yaw: float
) -> None:
    rng = np.random.default_rng(seed)
    place, truth = room(rng, count), planar(x, z, yaw)
    made = Relocaliser(RIG, floor(3), RelocalisationSettings(map_sigma_m=0.001))
    made.learn(*place.map())
    view = seen(place, truth, rng, clutter)
    found = made.locate(view, rng)
    metres, degrees = error(found.wTc, truth)
    if found.found:
        sigma = float(np.sqrt(np.trace(found.covariance[3:, 3:])))
        assert metres < 6.0 * sigma + 1e-3
        assert degrees < 3.0
    visible = len(view) - clutter
    if visible >= 60:
        assert metres < 0.3, found.why


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10_000), dof=st.sampled_from([3, 6]), clutter=st.integers(0, 300))
def test_strange_places_are_refused(seed: int, dof: int, clutter: int) -> None:
    rng = np.random.default_rng(seed)
    made = Relocaliser(RIG, floor(dof), SETTINGS)  # type: ignore[arg-type]
    made.learn(*room(rng, 500).map())
    assert not made.locate(seen(room(rng, 500), planar(0.0, 0.0, 0.0), rng, clutter), rng).found
