from pathlib import Path

import numpy as np
import pytest

from fgslam.core.errors import DatasetError
from fgslam.worlds.rendering.cache import RenderCache, content_hash

SHAPE = (3, 12, 16)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RenderCache:
    monkeypatch.setenv("FGSLAM_CACHE", str(tmp_path))
    return RenderCache("ab" * 32, {"a": 1}, SHAPE)


def images(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, SHAPE, dtype=np.uint8)


def test_cached_frame_is_read_as_it_was_written(cache: RenderCache) -> None:
    assert not cache.present(7)
    assert cache.read(7) is None
    cache.write(7, images(7))
    assert cache.present(7)
    np.testing.assert_array_equal(cache.read(7), images(7))
    assert [p.name for p in cache.folder.iterdir() if p.name.startswith(".")] == []


def test_every_kind_of_damage_is_seen(cache: RenderCache) -> None:
    cache.write(0, images(0))
    whole = cache.path(0).read_bytes()
    flipped = bytearray(whole)
    flipped[100] ^= 1
    for content in (b"", whole[:-1], whole + b"x", bytes(flipped), b"X" + whole[1:]):
        cache.path(0).write_bytes(content)
        assert cache.read(0) is None
    cache.path(0).write_bytes(whole)
    np.testing.assert_array_equal(cache.read(0), images(0))


def test_a_cached_frame_of_the_wrong_length_counts_as_absent(cache: RenderCache) -> None:
    cache.write(1, images(1))
    cache.path(1).write_bytes(cache.path(1).read_bytes()[:50])
    assert not cache.present(1)


def test_cache_folder_that_cannot_be_made_gives_a_one_line_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("FGSLAM_CACHE", str(tmp_path / "file"))
    with pytest.raises(DatasetError, match="set FGSLAM_CACHE to a folder"):
        RenderCache("cd" * 32, {}, SHAPE)


def test_hash_depends_on_content_not_on_order() -> None:
    assert content_hash({"a": 1, "b": [1, 2]}) == content_hash({"b": [1, 2], "a": 1})
    assert content_hash({"a": 1}) != content_hash({"a": 2})
