"""What docs/results claims of landmarks that last, as regression tests with their bounds."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.evidence import lasting
from benchmarks.runs import experiment


@pytest.mark.parametrize("name", list(lasting.VARIANTS))
def test_every_variant_is_a_valid_experiment(name: str) -> None:
    config = experiment("blocked_view", lasting.VARIANTS[name])
    assert config.dataset.effects.blocked_frames == lasting.COVER
    permanence = config.frontend.database.permanence
    assert (permanence is None) == (name == "without permanence")


@pytest.mark.slow
def test_blocked_cameras_cost_nothing_of_a_lasting_map() -> None:
    """The map survives 30 blocked frames, and the robot finds itself again."""
    found = lasting.blocked_features()
    lasts = lasting.run_blocked(found, lasting.VARIANTS["as committed"])
    ordinary = lasting.run_blocked(found, lasting.VARIANTS["without permanence"])
    assert lasts.kept == lasts.before > 1500
    assert ordinary.before - ordinary.kept > 50
    # Dead reckoning has drifted by the same centimetres in both.
    assert lasts.drift_m == pytest.approx(ordinary.drift_m, abs=0.01)
    assert lasts.drift_m > 0.04
    assert lasts.found_at <= lasting.COVER[1] + 1
    assert lasts.error_m < 0.6 * lasts.drift_m
    assert lasts.end_m < 0.02
    # Both come back in the end; the lasting map at once.
    assert lasts.error_m < 0.25 * ordinary.error_m
    assert ordinary.end_m < 0.02
    assert lasts.ate_m < 0.75 * ordinary.ate_m


@pytest.mark.slow
def test_static_landmarks_stay_permanent_and_moved_ones_are_demoted() -> None:
    """The defaults' reasons: docs/results, thresholds."""
    visits = lasting.visit_twice()
    demotion = lasting.demotion_table(visits)
    share = dict(zip(demotion.column("landmarks that last"), demotion.rows, strict=True))
    at = demotion.columns.index("contradicted 20 times")
    assert float(share["same room"][at] or 0.0) <= 0.01
    assert float(share["rearranged room, found again"][at] or 0.0) <= 0.01
    # A map keeps from how far landmarks were seen: few are expected 20 times in one drive.
    gone = share["rearranged room, never found again"]
    assert float(gone[at] or 0.0) >= 0.05
    assert float(gone[demotion.columns.index("contradicted 10 times")] or 0.0) >= 0.35
    permanence = lasting.permanence_table(visits)
    row = next(r for r in permanence.rows if (r[0], r[1]) == (5, 0.3))
    for chosen, never in ((row[2], row[3]), (row[5], row[6])):
        assert int(chosen or 0) > 1000
        assert float(never or 0.0) <= 0.01
