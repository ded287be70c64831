"""What drives have shown of a rig, as what the next one begins with."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fgslam.backend.self_calibration import RigUnknowns, SelfCalibration
from fgslam.cameras.rectify import rectifier_of
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.correction import FIELD_PX, RigCorrection, displacements, term_names
from fgslam.core.errors import CalibrationError
from fgslam.core.sensors import CameraRig, Increment, Observations, pixel_model, rig_map
from fgslam.core.store import restore, state_of
from fgslam.slam.rig_memory import DriveEvidence, RigMemory

RIG = CameraRig(620, 190, 360.0, 360.0, 310.0, 92.0, 0.54, None, np.eye(4))
SIGMA_PX = 0.3
OF = RigUnknowns(RIG)
NONE = np.empty(0, np.int64)


def middle(correction: RigCorrection) -> tuple[float, float]:
    """Disparity offset of a point in the middle of both images, pixels, and its sigma."""
    moved, sigma = correction.at(np.broadcast_to([RIG.cx, RIG.cy], (1, RIG.cameras, 2)))
    return float(moved[0, 2]), float(sigma[0, 2])


def drives(count: int, spread: float, seed: int) -> tuple[FloatArray, tuple[DriveEvidence, ...]]:
    """What all drives share of their rigs, and evidence of rigs off from it by a share."""
    rng, prior = np.random.default_rng(seed), OF.prior(FIELD_PX)
    root = np.linalg.cholesky(np.linalg.inv(prior))
    shared = root @ rng.standard_normal(OF.size)
    found = []
    for frame in range(count):
        own = shared + np.sqrt(spread) * root @ rng.standard_normal(OF.size)
        rows = rng.standard_normal((OF.size // 2, OF.size)) @ np.linalg.inv(root) * 3.0
        pull = rows.T @ (rows @ own + rng.standard_normal(len(rows)))
        found.append(DriveEvidence(np.array([frame]), rows.T @ rows, pull))
    return shared, tuple(found)


@pytest.mark.parametrize(
    ("count", "spread"), [(1, 1e-3), (1, 1e-2), (5, 1e-3), (5, 1e-2), (5, 0.1)]
)
def test_what_a_drive_begins_with_is_as_sure_as_it_may_be(count: int, spread: float) -> None:
    """Though each drive's evidence is of its own rig, and shows half of all directions.

    One drive cannot show how far drives differ: a hundredth of the prior's variance is expected.
    """
    nees, widths, prior = [], [], OF.prior(FIELD_PX)
    own = np.sqrt(spread) * np.linalg.cholesky(np.linalg.inv(prior))
    for seed in range(12):
        shared, found = drives(count, spread, seed)
        known = RigMemory("", found).known(OF)
        covariance = np.linalg.inv(known.precision(OF))
        rig = shared + own @ np.random.default_rng([seed, 1]).standard_normal(OF.size)
        off = known.values(OF) - rig
        nees.append(off @ np.linalg.solve(covariance, off) / OF.size)
        widths.append(np.trace(covariance @ prior) / OF.size)
    assert 0.3 < np.mean(nees) < 1.5
    assert np.mean(widths) < (0.7 if count == 1 else 0.5)


def test_a_rig_that_never_drove_begins_as_calibrated() -> None:
    known, plain = (SelfCalibration(RIG, SIGMA_PX, begun) for begun in (RigMemory("").known, None))
    np.testing.assert_array_equal(known.found.estimated.values, plain.found.estimated.values)
    np.testing.assert_array_equal(known.found.applied.values, plain.found.applied.values)


def seen(wrong: FloatArray, first: int = 0, frames: int = 12) -> list[tuple[Increment, FloatArray]]:
    """Frames along a road, as a rig off by ``wrong`` (p,) measures, and their poses."""
    rng, model, fuse = np.random.default_rng(first), pixel_model(2, 1.0), rig_map(RIG)
    points = rng.uniform([-12.0, -4.0, 0.0], [12.0, 1.6, 72.0], (500, 3))
    size, out = np.array([RIG.width, RIG.height]), []
    for k in range(frames):
        wTc = g.se3_exp(np.array([0.0, 0.01 * k, 0.0, 0.0, 0.0, 1.0 * k]))
        local = g.transform_to_camera(wTc, points)
        ids = np.flatnonzero((local[:, 2] > 4.0) & (local[:, 2] < 60.0))
        at = (RIG.predict(local[ids]) @ model.T).reshape(-1, 2, 2)
        inside = ((at >= 0.0) & (at < size)).all(axis=(1, 2))
        ids, at = ids[inside], at[inside]
        off = (displacements(RIG, at) @ wrong).reshape(at.shape)
        pixels = np.full((len(ids), 3, 2), np.nan)
        pixels[:, :2] = at + off + SIGMA_PX * rng.standard_normal(at.shape)
        measured, unit = pixels[:, :2].reshape(-1, 4) @ fuse.T, np.tile(np.eye(3), (len(ids), 1, 1))
        observed = Observations(ids, measured, unit, pixels, np.ones(len(ids), np.bool_))
        rejected = np.zeros(len(ids), np.bool_)
        out.append((Increment(k, 0.1 * k, None, observed, rejected, NONE, NONE), wTc))
    return out


def yaw(degrees: float) -> FloatArray:
    return np.deg2rad(degrees) * np.array([name == "left.yaw" for name in term_names(RIG)])


def driven(memory: RigMemory | None, wrong: FloatArray, first: int) -> SelfCalibration:
    found = SelfCalibration(RIG, SIGMA_PX, memory and memory.known)
    for increment, wTc in seen(wrong, first):
        found.observe(increment, wTc)
    return found


@pytest.fixture(scope="module")
def memory() -> RigMemory:
    """After a drive of a rig that is turned by a tenth of a degree."""
    empty = RigMemory.of(RIG)
    return empty.after(driven(empty, yaw(0.1), 0), np.array([7, 5]))


def test_a_drive_begins_with_the_correction_that_others_found(memory: RigMemory) -> None:
    begun = SelfCalibration(RIG, SIGMA_PX, memory.known).found
    value, sigma = middle(begun.applied)
    assert value == pytest.approx(np.deg2rad(0.1) * RIG.fx, abs=0.25)
    assert sigma < 0.5 * middle(SelfCalibration(RIG, SIGMA_PX).found.applied)[1]
    later = driven(memory, yaw(0.1), 1)
    assert middle(later.found.estimated)[1] < sigma
    assert not later.moved_before
    assert not later.knocks


def test_what_a_drive_shows_is_kept_once(memory: RigMemory) -> None:
    """Without what it began with, and in place of what the same frames showed before."""
    alone, after = (driven(given, yaw(0.1), 1) for given in (None, memory))
    both = memory.after(after, np.array([9]))
    assert [one.frames.tolist() for one in both.drives] == [[5, 7], [9]]
    np.testing.assert_allclose(
        *(np.diagonal(it.shown()[0]) for it in (alone, after)), rtol=0.5, atol=1.0
    )
    again = both.after(after, np.array([7, 8]))
    assert [one.frames.tolist() for one in again.drives] == [[9], [7, 8]]
    assert [one.frames.tolist() for one in both.without(np.array([5])).drives] == [[9]]


def test_a_rig_that_was_moved_between_drives_is_found_within_twelve_frames(
    memory: RigMemory,
) -> None:
    moved = driven(memory, yaw(0.35), 1)
    assert moved.moved_before
    assert moved.knocks == 0
    value, sigma = middle(moved.found.applied)
    assert value == pytest.approx(np.deg2rad(0.35) * RIG.fx, abs=3.0 * sigma)
    assert len(memory.after(moved, np.array([9]))) == 1  # the other drives had another rig


def test_a_drive_that_is_continued_goes_on_with_what_it_remembers(memory: RigMemory) -> None:
    whole, first = driven(memory, yaw(0.1), 1), SelfCalibration(RIG, SIGMA_PX, memory.known)
    frames = seen(yaw(0.1), 1)
    for increment, wTc in frames[:7]:
        first.observe(increment, wTc)
    second = SelfCalibration(RIG, SIGMA_PX, memory.known)
    restore(second, state_of(first))
    for increment, wTc in frames[7:]:
        second.observe(increment, wTc)
    for ours, theirs in zip(whole.shown(), second.shown(), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_a_file_gives_the_memory_back_to_the_same_calibration_alone(
    memory: RigMemory, tmp_path: Path
) -> None:
    path = tmp_path / "memory.npz"
    assert len(RigMemory.open(path, RIG)) == 0
    memory.save(path)
    first = path.read_bytes()
    again = RigMemory.open(path, RIG)
    again.save(path)
    assert path.read_bytes() == first
    np.testing.assert_array_equal(again.drives[0].pull, memory.drives[0].pull)
    with pytest.raises(CalibrationError, match="another calibration; name another file"):
        RigMemory.open(path, replace(RIG, baseline=0.53))
    with pytest.raises(CalibrationError, match="another calibration"):
        RigMemory.open(path, RIG, rectifier_of(RIG, yaw(0.1)))  # it has the correction already
    path.write_bytes(first[:-40])
    with pytest.raises(CalibrationError, match="move it away"):
        RigMemory.open(path, RIG)


def test_the_memory_of_other_cameras_is_refused(memory: RigMemory) -> None:
    three = CameraRig(320, 240, 277.0, 277.0, 159.5, 119.5, 0.1, 0.1, np.eye(4))
    with pytest.raises(CalibrationError, match=r"RigMemory\.of"):
        SelfCalibration(three, SIGMA_PX, memory.known)
