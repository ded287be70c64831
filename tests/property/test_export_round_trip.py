"""Laws of files and alignments, over poses at both ends of the rotation group."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as nps

from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import pose, so3_exp
from fgslam.core.types import Trajectory
from fgslam.evaluation.statistics import Alignment, evaluate_trajectory, umeyama

UNIT = st.floats(-1.0, 1.0, allow_subnormal=False)
ANGLES = st.one_of(
    st.floats(0.0, np.pi),
    st.floats(0.0, 1e-8),
    st.floats(0.0, 1e-8).map(lambda small: np.pi - small),
)


@st.composite
def poses(draw: st.DrawFn, reach: float = 1e4) -> FloatArray:
    axis = draw(nps.arrays(np.float64, 3, elements=UNIT).filter(lambda v: v @ v > 1e-4))
    rotation = so3_exp(draw(ANGLES) * axis / np.linalg.norm(axis))
    return pose(rotation, reach * draw(nps.arrays(np.float64, 3, elements=UNIT)))


@given(st.lists(poses(), max_size=6), st.floats(0.0, 2e9))
@settings(max_examples=60, deadline=None)
def test_tum_file_keeps_every_pose(tmp_path_factory, many: list[FloatArray], start: float) -> None:
    path: Path = tmp_path_factory.getbasetemp() / "law.tum"
    written = Trajectory(start + 0.1 * np.arange(len(many)), np.array(many).reshape(-1, 4, 4))
    written.save(path)
    read = Trajectory.load(path)
    np.testing.assert_allclose(read.timestamps, written.timestamps, atol=5e-10)
    np.testing.assert_allclose(read.poses, written.poses, atol=5e-12)


@given(poses(reach=100.0), st.integers(0, 2**31))
@settings(max_examples=60, deadline=None)
def test_alignment_undoes_any_rigid_motion(world: FloatArray, seed: int) -> None:
    source = np.random.default_rng(seed).normal(size=(12, 3))
    found = umeyama(source, source @ world[:3, :3].T + world[:3, 3])
    assert found is not None
    np.testing.assert_allclose(found, world, rtol=0, atol=1e-9)


@given(poses(reach=100.0), st.integers(0, 2**31))
@settings(max_examples=40, deadline=None)
def test_errors_do_not_depend_on_the_estimates_world(world: FloatArray, seed: int) -> None:
    rng = np.random.default_rng(seed)
    path = np.cumsum(rng.normal(size=(2, 15, 3)), axis=1)
    turns = [so3_exp(v) for v in rng.normal(size=(15, 3))]
    truth = Trajectory(np.arange(15.0), np.array([*map(pose, turns, path[0])]))
    estimate = Trajectory(truth.timestamps, np.array([*map(pose, turns, path[1])]))
    moved = Trajectory(truth.timestamps, world @ estimate.poses)
    here = evaluate_trajectory(estimate, truth, Alignment.SE3)
    there = evaluate_trajectory(moved, truth, Alignment.SE3)
    for name in ("ate_rmse_m", "rpe_trans_m", "rpe_rot_deg", "end_error_m", "drift_percent"):
        np.testing.assert_allclose(getattr(there, name), getattr(here, name), rtol=1e-8, atol=1e-8)
