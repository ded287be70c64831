"""Features of frames: none is found near a black border or what a mask hides."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest

from fgslam.core.arrays import Image
from fgslam.core.log import Frame
from fgslam.core.types import Features
from fgslam.slam.feature_stream import FeatureStream, FrameDescriber

PLACES = np.array([[10.0, 10.0], [20.0, 10.0], [30.4, 10.0]])
SCALES = np.array([2.0, 2.0, 4.0])


def three(_: Image) -> Features:
    return Features(PLACES, SCALES, np.zeros(3), np.zeros((3, 128), np.uint8))


@pytest.mark.parametrize(("hidden", "kept"), [(3, [0, 1, 2]), (5, [1, 2]), (17, [2]), (19, [])])
def test_features_reach_three_scales_around(hidden: int, kept: list[int]) -> None:
    """The first columns are hidden: at 10 a feature of scale 2 wants 6 px, at 30 one of 4 12 px."""
    image = np.zeros((20, 40), np.uint8)
    margin = np.tile(np.maximum(np.arange(40.0) - hidden, 0.0), (20, 1)).astype(np.float32)
    full = np.full((20, 40), np.inf, np.float32)
    describer = FrameDescriber(three)
    right, left = describer.describe(0, Frame(0, 0.0, (image, image), (margin, full))).features
    np.testing.assert_array_equal(right.xy, PLACES[kept])
    np.testing.assert_array_equal(left.xy, PLACES)
    whole = describer.describe(0, Frame(0, 0.0, (image, image))).features
    assert [len(found) for found in whole] == [3, 3]
    describer.close()


def test_features_that_were_begun_are_found_once_and_in_a_thread() -> None:
    threads: list[int] = []

    def noted(image: Image) -> Features:
        threads.append(threading.get_ident())
        return three(image)

    frame = Frame(0, 0.0, (np.zeros((20, 40), np.uint8),) * 2)
    describer = FrameDescriber(noted, reference_only=True)
    describer.begin(None)
    describer.begin(frame)
    (found,) = describer.describe(0, frame).features
    np.testing.assert_array_equal(found.xy, PLACES)
    (thread,) = threads
    assert thread != threading.get_ident()
    describer.describe(1, Frame(1, 0.1, frame.images))
    assert threads[1:] == [threading.get_ident()]
    describer.close()


class Frames(list[Frame]):
    """A sequence of them."""

    frame = list.__getitem__


def test_the_upcoming_frame_is_the_one_that_comes_next() -> None:
    images = (np.zeros((20, 40), np.uint8),) * 2
    frames = [Frame(k, 0.1 * k, images) for k in range(6)]
    sequence: Any = Frames(frames)
    stream = FeatureStream(sequence, None)
    assert stream.upcoming() is None
    expected: Frame | None = frames[2]
    for found in stream(start=2):
        assert found.frame is expected
        expected = stream.upcoming()
    assert found.i == 5
    assert expected is None
