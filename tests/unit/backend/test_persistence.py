"""How large errors of measurements are, and how long they persist, from a drive's residuals."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from simulated import RIG
from smoothing import answer, drawn

from fgslam.backend.persistence import Persistence, StatedNoise, inverses_of_blocks
from fgslam.backend.settings import (
    BatchSettings,
    FixedLagSettings,
    GraphSettings,
    Isam2Settings,
)
from fgslam.backend.smoothers.graph import GraphBuilder, TrackedFrame
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.sensors import Observations, Odometry, compose_odometry
from fgslam.core.store import restore, state_of
from fgslam.core.types import Floor, LandmarkMap, Prediction
from fgslam.factors.noise import plain

SIGMA = np.array([0.2, 0.2, 0.15])  # of (column, row, disparity), pixels, as stated
FRAMES, IN_VIEW = 120, 60
STEP = g.se3_exp(np.array([0.0, 0.01, 0.0, 0.02, 0.0, 0.05]))


def observed(ids: FloatArray, measurement: FloatArray) -> Observations:
    count = len(ids)
    covariance = np.tile(np.diag(SIGMA**2), (count, 1, 1))
    pixels, new = np.full((count, 3, 2), np.nan), np.zeros(count, np.bool_)
    return Observations(ids, measurement, covariance, pixels, new)


def driven(
    scale: float,
    kept: float = 0.0,
    wrong: float = 0.0,
    frames: int = FRAMES,
    lost: FloatArray | None = STEP,
    smoothed: bool = False,
    resumed: int = -1,
) -> Persistence:
    """Learned on a drive whose errors are ``scale`` of those stated, ``kept`` from frame to frame.

    Each landmark is seen for 12 frames; ``wrong`` of the sightings are of something else. Every
    tenth step is marked ``lost``. Where the path is ``smoothed`` every fifth frame, it is true.
    At the frame ``resumed`` another continues from the state.
    """
    rng = np.random.default_rng(5)
    noise, wTc, path = Persistence(RIG), np.eye(4), list[FloatArray]()
    points: dict[int, FloatArray] = {}
    errors: dict[int, FloatArray] = {}
    for k in range(frames):
        if k == resumed:
            state, noise = state_of(noise), Persistence(RIG)
            restore(noise, state)
        wTc = wTc @ STEP
        for i in range(5 * k, 5 * k + 5):
            at = np.array([*rng.uniform(-0.8, 0.8, 2), rng.uniform(2.0, 5.0)])
            points[i] = g.transform_to_world(wTc, at[None])[0]
            errors[i] = rng.standard_normal(3)
        ids = np.arange(max(0, 5 * k - IN_VIEW + 5), 5 * k + 5)
        fresh = rng.standard_normal((len(ids), 3))
        drawn = kept * np.array([errors[i] for i in ids]) + np.sqrt(1.0 - kept**2) * fresh
        errors.update(zip(ids.tolist(), drawn, strict=True))
        local = g.transform_to_camera(wTc, np.array([points[i] for i in ids]))
        measurement = RIG.predict(local) + scale * SIGMA * drawn
        elsewhere = rng.uniform(size=len(ids)) < wrong
        measurement[elsewhere, 0] += 15.0
        noise.learn(k, STEP if k % 10 else lost, observed(ids, measurement))
        path.append(wTc)
        if smoothed and k % 5 == 1:
            noise.smoothed(list(range(k + 1))[-8:], np.array(path[-8:]))
    return noise


@pytest.mark.parametrize("scale", [0.5, 1.0, 4.0])
def test_independent_errors_are_found_as_large_as_they_are(scale: float) -> None:
    """2,000 residuals and more tell a variance to 3 %, a hundred tracks of 12 to 10 %."""
    noise = driven(scale)
    assert noise.spread == pytest.approx(scale**2, rel=0.1)
    assert noise.power == pytest.approx(scale**2, rel=0.3)


def test_errors_that_persist_weigh_less() -> None:
    """Kept to 0.7 a frame, twelve sightings lean as (1 + 0.7) / (1 - 0.7) = 5.7 independent ones.

    Of a track that long the leaning holds two thirds of that power.
    """
    noise = driven(1.0, kept=0.7)
    assert 2.5 < noise.power < 5.7
    assert noise.spread < 1.0  # what a landmark's place has taken on is no spread


def test_tracks_end_where_no_landmark_has_measured_the_step() -> None:
    aside = STEP @ g.se3_exp(np.array([0.0, 0.02, 0.0, 0.02, 0.0, 0.0]))
    assert driven(1.0, frames=60, lost=aside).spread > 2.0
    ended = driven(1.0, frames=60, lost=None)
    assert ended.spread == pytest.approx(1.0, rel=0.1)
    assert ended.power == pytest.approx(1.0, rel=0.3)


def test_steps_that_a_moved_map_has_leaned_are_put_right_by_the_smoothed_path() -> None:
    """Else a track across such a step takes the uncertainty for noise."""
    aside = STEP @ g.se3_exp(np.array([0.0, 0.02, 0.0, 0.02, 0.0, 0.0]))
    assert driven(1.0, frames=60, lost=aside).power > 4.0
    found = driven(1.0, frames=60, lost=aside, smoothed=True)
    assert found.spread == pytest.approx(1.0, rel=0.1)
    assert found.power == pytest.approx(1.0, rel=0.3)


@pytest.mark.parametrize("scale", [1.0, 4.0])
def test_a_smoother_finds_the_noise_though_most_matches_lie_beyond_the_stated(scale: float) -> None:
    increments = []
    for each in drawn(3, frames=24, points=90).increments:
        seen = each.observations
        stated = dataclasses.replace(seen, covariance=seen.covariance / scale**2)
        increments.append(dataclasses.replace(each, observations=stated))
    found = answer(FixedLagSettings(lag_frames=4), increments).noise_factor
    assert found == pytest.approx(scale, rel=0.25)


@pytest.mark.parametrize(("settings", "seed"), [(BatchSettings(), 3), (Isam2Settings(), 4)])
def test_poses_of_few_matches_do_not_count_as_noise_of_the_measurements(
    settings: GraphSettings, seed: int
) -> None:
    """Along the poses as tracked it is found to be 4.8 and 6.3 times the stated noise."""
    increments = []
    for each in drawn(seed, frames=24, points=90).increments:
        seen = each.observations
        stated = dataclasses.replace(seen, covariance=seen.covariance / 16.0)
        increments.append(dataclasses.replace(each, observations=stated))
    assert answer(settings, increments).noise_factor == pytest.approx(4.0, rel=0.08)


def test_until_tracks_have_ended_noise_is_as_stated() -> None:
    noise = driven(4.0, frames=10)
    assert noise.spread == noise.power == 1.0


def test_a_factor_of_the_settings_is_learned_by_nothing() -> None:
    noise = StatedNoise(3.0)
    noise.learn(0, STEP, observed(np.arange(1), np.zeros((1, 3))))
    assert (noise.spread, noise.power) == (1.0, 9.0)


@dataclasses.dataclass(slots=True)
class Known:
    """Noise that a test sets."""

    spread: float = 1.0
    power: float = 1.0

    def learn(self, frame: int, step: FloatArray, accepted: Observations) -> None:
        """Nothing."""

    def smoothed(self, frames: list[int], poses: FloatArray) -> None:
        """Nothing."""


@pytest.mark.parametrize("measured", [True, False])
def test_a_graph_is_weighed_again_by_what_is_known_at_its_end(measured: bool) -> None:
    """Observations by their power; a step that only goes on as before by what persists of it."""
    origin = Prediction(np.eye(4), 1e-8 * np.eye(6))
    builder = GraphBuilder(RIG, GraphSettings(), Floor.under(RIG, 6), origin)
    noise = builder.noise = Known()
    point = np.array([[0.1, 0.1, 2.0]])
    known = LandmarkMap(np.arange(1), point, 1e-6 * np.eye(3)[None])
    step = g.se3_exp(np.array([0.0, 0.0, 0.0, 0.05, 0.0, 0.0]))
    for k in range(3):
        noise.spread, noise.power = (1.0, 1.0) if k < 2 else (2.0, 18.0)
        wTc = np.linalg.matrix_power(step, k)
        seen = observed(np.arange(1), RIG.predict(g.transform_to_camera(wTc, point)))
        motion = Odometry(step, 1e-4 * np.eye(6), measured) if k else None
        builder.add(TrackedFrame(k, wTc, motion, seen), known)
    graph = builder.kept_factors()
    models = [plain(graph.at(row)).noiseModel().covariance() for row in range(graph.size())]
    # The middle one of a stereo factor's numbers is the right column, whose variance is stated.
    columns = [float(found[1, 1]) for found in models if found.shape == (3, 3)]
    steps = [found for found in models if found.shape == (6, 6)][1:]
    np.testing.assert_allclose(columns, 18.0 * SIGMA[0] ** 2, rtol=1e-9, atol=0.0)
    np.testing.assert_allclose(
        steps, [(1.0 if measured else 9.0) * 1e-4 * np.eye(6)] * 2, rtol=1e-9
    )
    assert builder.kernel.width == pytest.approx(3.0 / 3.0)


def test_steps_together_are_measured_if_each_is() -> None:
    wheels, guess = Odometry(STEP, np.eye(6)), Odometry(STEP, np.eye(6), measured=False)
    turn = Odometry.turn(STEP[:3, :3], np.eye(3))
    assert compose_odometry([wheels, wheels]).measured
    assert not compose_odometry([wheels, guess, wheels]).measured
    turned = [compose_odometry([wheels, other]).turned for other in (wheels, guess, turn)]
    assert turned == [False, False, True]


def test_what_no_sighting_determines_of_a_place_is_left_as_it_is(rng: np.random.Generator) -> None:
    """Beside places that are determined, whatever their distance."""
    root = rng.standard_normal((9, 3, 3)) * np.array([1.0, 1e-2, 1e-4])
    root[3, :, 2] = 0.0
    root[7] = 0.0
    normal = np.swapaxes(root, 1, 2) @ root
    found = inverses_of_blocks(normal)
    expected = np.linalg.pinv(normal)
    np.testing.assert_array_equal(found[[3, 7]], expected[[3, 7]])
    size = np.sqrt(np.einsum("mii->mi", expected))
    size[[3, 7]] = 1.0
    off = (found - expected) / (size[:, :, None] * size[:, None, :])
    np.testing.assert_allclose(off, 0.0, atol=1e-6, rtol=0.0)
