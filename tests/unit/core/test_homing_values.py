"""What the stages of homing share."""

from __future__ import annotations

import numpy as np
import pytest

from fgslam.core.bearings import among


@pytest.mark.parametrize("seed", range(20))
def test_identities_are_looked_up(seed: int) -> None:
    """Beyond either end, none, all, and with none to look up or to be found."""
    rng = np.random.default_rng(seed)
    ids = rng.integers(0, 30, seed)
    others = np.unique(rng.integers(5, 25, (3 * seed) % 25))
    np.testing.assert_array_equal(among(ids, others), np.isin(ids, others))
