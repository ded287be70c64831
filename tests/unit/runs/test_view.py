"""What is sent to the viewer."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_array_equal

from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import rotation_from_quaternion
from fgslam.core.sensors import Increment, Observations, moved_pixels
from fgslam.core.types import LandmarkMap
from fgslam.runs.view import ChangedBlocks, half_axes, seen_pixels


def landmarks(ids: list[int], positions: FloatArray) -> LandmarkMap:
    return LandmarkMap(np.array(ids, np.int64), positions, np.tile(np.eye(3), (len(ids), 1, 1)))


def increment(ids: list[int], new: list[bool], rejected: list[bool]) -> Increment:
    """Landmark k is seen by the right camera at (10 k, k), and at (10 k + 5, k) by the left one."""
    column, row = 10.0 * np.array(ids), 1.0 * np.array(ids)
    nothing = np.full(len(ids), np.nan)
    pixels = np.stack([[column, row], [column + 5.0, row], [nothing, nothing]]).transpose(2, 0, 1)
    measured = np.column_stack([column, row, np.full(len(ids), 5.0)])
    covariances = np.tile(np.eye(3), (len(ids), 1, 1))
    seen = Observations(np.array(ids), measured, covariances, pixels, np.array(new))
    none = np.empty(0, np.int64)
    return Increment(0, 0.0, None, seen, np.array(rejected), none, none)


def test_only_blocks_that_changed_are_sent_again() -> None:
    """Identities 5 and 9 share a block, 2000 and 2001 another, 5000 is alone."""
    blocks, positions = ChangedBlocks(), np.arange(15.0).reshape(5, 3)
    first = landmarks([5, 9, 2000, 2001, 5000], positions)
    sent = dict(blocks.of(first))
    assert list(sent) == [0, 1, 4]
    assert_array_equal(np.concatenate(list(sent.values())), positions)
    assert not list(blocks.of(first))
    assert not list(blocks.of(landmarks([5, 9, 2000, 2001, 5000], positions + 1e-6)))
    moved = positions.copy()
    moved[3, 1] += 0.01
    ((number, places),) = blocks.of(landmarks([5, 9, 2000, 2001, 5000], moved))
    assert number == 1
    assert_array_equal(places, moved[2:4])
    ((number, places),) = blocks.of(landmarks([5, 9, 2000, 2001], moved[:4]))
    assert (number, len(places)) == (4, 0)


def test_small_motions_add_up_to_one_that_is_sent() -> None:
    blocks, position = ChangedBlocks(), np.zeros((1, 3))
    sent = [len(list(blocks.of(landmarks([1], position + 4e-4 * k)))) for k in range(7)]
    assert sent == [1, 0, 0, 1, 0, 0, 1]


def test_a_map_without_landmarks_sends_nothing() -> None:
    assert not list(ChangedBlocks().of(landmarks([], np.empty((0, 3)))))


def test_colours_tell_matched_new_and_rejected_apart() -> None:
    frame = increment([1, 2, 3], [False, True, False], [False, False, True])
    pixels, colours = seen_pixels(frame, 1)
    assert_array_equal(pixels, [[15.0, 1.0], [25.0, 2.0], [35.0, 3.0]])
    assert len({tuple(colour) for colour in colours.tolist()}) == 3
    top, none = seen_pixels(frame, 2)  # a camera that is not there
    assert (top.shape, none.shape) == ((0, 2), (0, 3))


def test_ways_are_those_of_landmarks_that_both_frames_kept() -> None:
    earlier = increment([1, 2, 3], [True, True, True], [False, False, False])
    now = increment([2, 3, 4], [False, False, True], [False, True, False])
    before, after = moved_pixels(earlier, now)
    assert_array_equal(before, [[20.0, 2.0]])
    assert_array_equal(after, [[20.0, 2.0]])
    assert moved_pixels(None, now)[0].shape == (0, 2)


def test_half_axes_rebuild_the_covariance() -> None:
    rng = np.random.default_rng(1)
    roots = rng.normal(size=(20, 3, 3))
    covariances = roots @ roots.transpose(0, 2, 1)
    half, turns = half_axes(covariances)
    for k in range(20):
        axes = rotation_from_quaternion(turns[k])
        rebuilt = axes @ np.diag((half[k] / 3.0) ** 2) @ axes.T
        np.testing.assert_allclose(rebuilt, covariances[k], rtol=0, atol=1e-9)
    assert [part.shape for part in half_axes(np.empty((0, 3, 3)))] == [(0, 3), (0, 4)]
