"""The rendered street, whose rig is known."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[3]))

from benchmarks.evidence.street_world import RIG, Street
from fgslam.core.correction import term_names


@pytest.mark.slow
def test_a_displaced_camera_sees_the_same_street_displaced() -> None:
    """A principal point two pixels farther right moves the left image by two pixels."""
    street, exact = Street(0), np.zeros(len(term_names(RIG)))
    moved = exact.copy()
    moved[term_names(RIG).index("left.column")] = 2.0 / RIG.fx
    right, left = street.images(exact, frames=1)[0]
    other_right, other_left = street.images(moved, frames=1)[0]
    np.testing.assert_array_equal(other_right, right)
    np.testing.assert_allclose(other_left[:, 2:], left[:, :-2], atol=0.5)
    assert left.std() > 20.0
