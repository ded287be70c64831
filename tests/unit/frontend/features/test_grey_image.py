"""Grey images from what cameras give."""

from __future__ import annotations

import numpy as np
import pytest

from fgslam.core.errors import FrameError
from fgslam.frontend.features.sift import grey_image

GREY = np.random.default_rng(1).integers(0, 256, (12, 17), np.uint8)


def test_grey_bytes_are_handed_on_without_a_copy() -> None:
    assert np.shares_memory(grey_image(GREY), GREY)


@pytest.mark.parametrize(
    "image",
    [
        np.asfortranarray(GREY),
        np.repeat(GREY, 2, axis=1)[:, ::2],
        GREY[::-1][::-1],
        GREY[:, :, None],
        GREY.astype(np.uint16) << 8,
        (GREY.astype(np.uint16) << 8) + 255,
        np.dstack([GREY] * 3),
        np.dstack([GREY] * 4),
        np.dstack([GREY.astype(np.uint16) << 8] * 3),
        GREY.tolist() and np.array(GREY.tolist(), np.uint8),
    ],
    ids=["columns", "view", "flipped", "channel", "16", "16 up", "rgb", "rgba", "rgb 16", "list"],
)
def test_the_same_picture_in_another_form_gives_the_same_bytes(image: np.ndarray) -> None:
    before = image.copy()
    found = grey_image(image)
    np.testing.assert_array_equal(found, GREY)
    assert found.dtype == np.uint8
    assert found.flags.c_contiguous
    np.testing.assert_array_equal(image, before)


def test_colours_are_weighted_as_the_eye_does() -> None:
    """ITU-R BT.601: red 0.299, green 0.587, blue 0.114, in this order of channels."""
    pure = np.zeros((1, 3, 3), np.uint8)
    pure[0, range(3), range(3)] = 200
    np.testing.assert_allclose(grey_image(pure)[0], [59.8, 117.4, 22.8], rtol=0, atol=0.6)


@pytest.mark.parametrize(
    "image",
    [GREY / 255.0, GREY > 3, GREY[0], np.dstack([GREY] * 2), np.zeros((0, 5), np.uint8), "image"],
    ids=["float", "bool", "row", "two channels", "empty", "text"],
)
def test_other_forms_are_refused_with_what_to_give(image: object) -> None:
    with pytest.raises(FrameError, match=r"left image .*give"):
        grey_image(image, "left image")  # type: ignore[arg-type]
