"""What the doubt about a rig adds to a graph's covariances, against a graph that estimates it."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any

import numpy as np
from simulated import RIG
from smoothing import drawn, run

from fgslam.backend.settings import BatchSettings, KernelSettings
from fgslam.backend.smoothers.refinement import Refined
from fgslam.backend.smoothers.rig_doubt import DoubtedMarginals, shifts
from fgslam.core import geometry as g
from fgslam.core.rig_correction import prior_information


@cache
def solved(shift: int | None = None, by: float = 0.0) -> Refined:
    """A drive's graph at its minimum, its measurements displaced by one term of the correction."""
    settings = BatchSettings(kernel=KernelSettings("none"), trim=False, noise_factor=1.0)
    increments: list[Any] = drawn(3, frames=12).increments
    if shift is not None:
        increments = [displaced(increment, shift, by) for increment in increments]
    estimator: Any = run(settings, increments)[0]
    found: Refined = estimator._solver._refined()
    return found


def displaced(increment: Any, term: int, by: float) -> Any:
    seen = increment.observations
    moved = seen.measurement + by * shifts(RIG, seen.measurement)[:, :, term]
    observations = dataclasses.replace(seen, measurement=moved)
    return dataclasses.replace(increment, observations=observations)


def test_covariances_are_those_of_a_graph_with_the_correction_as_a_variable() -> None:
    refined = solved()
    found = DoubtedMarginals.of(refined.graph, refined.state, RIG)
    system = refined.graph.linear(refined.state)
    information = system.information.toarray()
    pull, own = refined.graph.pulled(refined.state, lambda measured: shifts(RIG, measured))
    whole = np.block([[information, pull], [pull.T, own + prior_information(RIG)]])
    covariance = np.linalg.inv(whole)
    columns, k = system.columns, len(found.correction)
    scale = np.abs(covariance).max()
    last = columns + 6 * 11 + np.arange(6)
    np.testing.assert_allclose(
        found.poses()[11], covariance[np.ix_(last, last)], rtol=1e-5, atol=1e-9 * scale
    )
    np.testing.assert_allclose(
        found.landmarks()[0], covariance[:3, :3], rtol=1e-5, atol=1e-9 * scale
    )
    rows = np.concatenate([last, [0, 1, 2]])
    np.testing.assert_allclose(
        found.joint(11, np.array([0])), covariance[np.ix_(rows, rows)], rtol=1e-5, atol=1e-9 * scale
    )
    np.testing.assert_allclose(found.correction, covariance[-k:, -k:], rtol=1e-5, atol=1e-12)


def test_poses_move_with_a_wrong_rig_as_their_gains_say() -> None:
    """By a yaw of the left camera of a tenth of a pixel; to first order."""
    refined, by = solved(), 0.1 / RIG.fx
    found = DoubtedMarginals.of(refined.graph, refined.state, RIG)
    moved = solved(2, by)
    before, after = refined.state.poses, moved.state.poses
    steps = np.array([g.se3_log(step) for step in g.inverse(before) @ after])
    gain = found.gain[found.held.system.columns :, 2].reshape(-1, 6)
    size = np.abs(steps).max()
    assert size > 1e-4
    np.testing.assert_allclose(by * gain, steps, rtol=0.0, atol=0.05 * size)
