"""What the doubt about a rig adds to a graph's covariances, against a graph that estimates it."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any

import numpy as np
import pytest
from simulated import RIG, play
from smoothing import FREE, drawn, run

from fgslam.backend.settings import BatchSettings, Isam2Settings, KernelSettings
from fgslam.backend.smoothers.online_doubt import OnlineDoubt
from fgslam.backend.smoothers.refinement import Refined
from fgslam.backend.smoothers.rig_doubt import DoubtedMarginals, shifts
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.measurements import Increment
from fgslam.core.rig_correction import (
    SHARED,
    RigCorrection,
    prior_information,
    shared_displacements,
    shared_information,
    term_names,
)
from fgslam.core.sensors import CameraRig
from fgslam.evaluation.consistency import pose_nees
from fgslam.slam.factory import make_estimator

EXACT = RigCorrection.none(dataclasses.replace(RIG, exact=True))
CALIBRATED = RigCorrection.none(dataclasses.replace(RIG, exact=False))

ALL = (*term_names(RIG), *SHARED)


@cache
def solved(seed: int = 3, shift: tuple[float, ...] = (0.0,) * len(ALL)) -> Refined:
    """A drive's graph at its minimum, its measurements displaced by terms of the correction."""
    settings = BatchSettings(kernel=KernelSettings("none"), trim=False, noise_factor=1.0)
    increments = [displaced(each, np.array(shift)) for each in drawn(seed, frames=12).increments]
    estimator: Any = run(settings, increments)[0]
    found: Refined = estimator._solver._refined()
    return found


def displaced(increment: Any, by: FloatArray) -> Any:
    seen = increment.observations
    moved = seen.measurement + shifts(RIG, seen.measurement) @ by
    observations = dataclasses.replace(seen, measurement=moved)
    return dataclasses.replace(increment, observations=observations)


def test_covariances_are_those_of_a_graph_with_the_correction_as_a_variable() -> None:
    refined = solved()
    found = DoubtedMarginals.of(refined.graph, refined.state, EXACT)
    system = refined.graph.linear(refined.state)
    information = system.information.toarray()
    p = len(EXACT.values)
    pull, own = refined.graph.pulled(refined.state, lambda measured: shifts(RIG, measured)[..., :p])
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


@pytest.mark.parametrize("term", ["left.yaw", "row", "focal", "radial", "baseline"])
def test_poses_move_with_a_wrong_rig_as_their_gains_say(term: str) -> None:
    """By some tenth of a pixel; to first order."""
    by = 0.1 / RIG.fx * (np.array(ALL) == term)
    refined, moved = solved(), solved(3, tuple(by))
    found = DoubtedMarginals.of(refined.graph, refined.state, CALIBRATED)
    before, after = refined.state.poses, moved.state.poses
    steps = np.array([g.se3_log(step) for step in g.inverse(before) @ after])
    gain = (found.gain[found.held.system.columns :] @ by).reshape(-1, 6)
    size = np.abs(steps).max()
    assert size > 5e-5
    np.testing.assert_allclose(gain, steps, rtol=0.0, atol=0.05 * size)


def test_images_far_off_against_each_other_are_taken_to_be_off_as_far() -> None:
    refined, shared = solved(), slice(len(EXACT.values), None)
    column = np.eye(len(EXACT.values))[0]

    def of(left_px: float) -> FloatArray:
        """Covariance of what is shared, the left image so far to the right."""
        moved = dataclasses.replace(CALIBRATED, values=left_px / RIG.fx * column)
        found = DoubtedMarginals.of(refined.graph, refined.state, moved)
        return found.correction[shared, shared]

    np.testing.assert_allclose(of(0.3), of(0.0))
    # 2 pixels in each of three images
    np.testing.assert_allclose(of(4.0), 4.0 * of(0.0), rtol=1e-6)


def test_what_is_shared_is_as_large_as_stated() -> None:
    information = shared_information(RIG, 0.2)
    rng = np.random.default_rng(4)
    drawn_terms = rng.multivariate_normal(np.zeros(len(SHARED)), np.linalg.inv(information), 4000)
    grid = np.stack(
        np.meshgrid(np.linspace(0, RIG.width - 1, 9), np.linspace(0, RIG.height - 1, 9))
    )
    pixels = np.repeat(grid.reshape(2, -1).T[:, None], RIG.cameras, axis=1)
    moved = shared_displacements(RIG, pixels)[:, :2, :-1] @ drawn_terms[:, :-1].T
    assert np.sqrt((moved**2).sum(axis=1).mean()) == pytest.approx(0.2, rel=0.1)
    focal = drawn_terms[:, SHARED.index("focal")].std()
    assert drawn_terms[:, -1].std() == pytest.approx(focal, rel=0.05)


def per_dof(poses: FloatArray, covariances: FloatArray, truth: FloatArray) -> float:
    nees = pose_nees(poses, covariances, truth)
    return float(nees.values.sum() / nees.dof.sum())


def test_rigs_that_are_off_as_assumed_leave_consistent_poses() -> None:
    """Calibrations drawn as off as they are taken to be; NEES of 12 drives."""
    rng = np.random.default_rng(5)
    found, held = [], []
    for seed in range(12):
        exact, truth = solved(seed), drawn(seed, frames=12).poses[1:]
        assumed = DoubtedMarginals.of(exact.graph, exact.state, CALIBRATED).correction
        refined = solved(seed, tuple(rng.multivariate_normal(np.zeros(len(ALL)), assumed)))
        poses = refined.poses()[1:]
        doubted = DoubtedMarginals.of(refined.graph, refined.state, CALIBRATED)
        found.append(per_dof(poses, doubted.poses()[1:], truth))
        held.append(per_dof(poses, doubted.held.poses()[1:], truth))
    assert np.mean(held) > 2.0
    assert 0.75 < np.mean(found) < 1.25


def driven(frames: int) -> OnlineDoubt:
    """After the first frames of a drive, at its true poses."""
    drive = drawn(3, frames=12)
    online = OnlineDoubt(CALIBRATED.rig)
    for increment, wTc in zip(drive.increments[:frames], drive.poses, strict=False):
        online.observe(increment, wTc)
    return online


@pytest.mark.parametrize("term", ["column", "focal", "radial", "baseline"])
def test_a_landmark_seen_once_lies_where_a_wrong_rig_has_it(term: str) -> None:
    by = 1e-3 / RIG.fx * (np.array(ALL) == term)
    first = drawn(3, frames=12).increments[0].observations
    moved = first.measurement + shifts(RIG, first.measurement) @ by
    before, after = g.triangulate(RIG, first.measurement), g.triangulate(RIG, moved)
    turned = (after - before) @ drawn(3, frames=12).poses[0][:3, :3].T
    gain = driven(1)._map["gain"] @ by[-len(SHARED) :]
    np.testing.assert_allclose(gain, turned, rtol=1e-3, atol=1e-4 * np.abs(turned).max())


def test_the_newest_pose_is_as_uncertain_as_the_whole_graph_has_it() -> None:
    """Within a factor of two: a filter does not go back to earlier poses."""
    refined, shared = solved(), slice(len(EXACT.values), None)
    whole = DoubtedMarginals.of(refined.graph, refined.state, CALIBRATED)
    gain = whole.gain[-6:, shared]
    known = np.diagonal(gain @ whole.correction[shared, shared] @ gain.T)
    ratio = np.sqrt(np.diagonal(driven(12).added(CALIBRATED)) / known)
    assert (ratio > 0.5).all()
    assert (ratio < 2.0).all(), ratio


def test_online_covariances_of_a_calibrated_rig_hold_its_error_and_of_an_exact_one_none() -> None:
    settings, zero = Isam2Settings(noise_factor=1.0), np.zeros(len(EXACT.values))
    increments = drawn(3, frames=12).increments
    applied = [dataclasses.replace(each, rig_correction=zero) for each in increments]

    def last(rig: CameraRig, of: list[Increment]) -> FloatArray:
        return np.asarray(play(make_estimator(rig, settings, FREE), of, FREE)[-1].covariance)

    exact, calibrated = last(EXACT.rig, applied), last(CALIBRATED.rig, applied)
    np.testing.assert_array_equal(exact, last(CALIBRATED.rig, increments))
    np.testing.assert_allclose(
        calibrated - exact, driven(12).added(CALIBRATED), rtol=0.5, atol=1e-4
    )
    assert np.trace(calibrated) > 1.2 * np.trace(exact)
