"""Textures are the same for a seed, and photographs are there."""

import sys

import numpy as np
import pytest

from fgslam.worlds.textures import PHOTOGRAPHS, book_row, build_library, photograph


@pytest.mark.slow
def test_textures_repeat_exactly_from_their_seed() -> None:
    once, again = (build_library(np.random.default_rng(5)) for _ in range(2))
    assert list(once) == list(again)
    for name, texture in once.items():
        np.testing.assert_array_equal(texture, again[name])
        assert texture.dtype == np.float32
        assert all(side & (side - 1) == 0 for side in texture.shape), name
        assert 0.0 < texture.min() <= texture.max() < 255.0, name
    rows = [book_row(np.random.default_rng(seed), 64, 256) for seed in (5, 6)]
    assert not np.array_equal(*rows)


@pytest.mark.parametrize("name", PHOTOGRAPHS)
def test_photographs_are_in_the_wheel(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pooch", None)
    image = photograph(name, 64)
    assert image.shape == (64, 64)
    assert image.std() > 5.0
