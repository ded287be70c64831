"""Films, written and read back by the libraries that others use."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image as Pillow

from fgslam.core.arrays import Image
from fgslam.core.errors import OutputError
from fgslam.datasets.video import write_film


def greys(n: int, width: int = 64) -> list[Image]:
    return [np.full((48, width, 3), 8 * k, np.uint8) for k in range(n)]


def test_mp4_has_every_frame_in_order(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    assert write_film(path, greys(30), 25.0) == 30
    film = cv2.VideoCapture(str(path))
    assert film.get(cv2.CAP_PROP_FPS) == pytest.approx(25.0)
    levels = [frame.mean() for ok, frame in iter(film.read, (False, None)) if ok]
    np.testing.assert_allclose(levels, 8.0 * np.arange(30), rtol=0, atol=4.0)


def test_gif_is_thinned_to_ten_frames_a_second_and_narrowed(tmp_path: Path) -> None:
    path = tmp_path / "a.gif"
    assert write_film(path, greys(30, width=1440), 20.0) == 15
    with Pillow.open(path) as film:
        assert (film.n_frames, film.size) == (15, (720, 24))  # type: ignore[attr-defined]
        assert film.info["duration"] == 100


def test_frames_are_brought_to_a_width_and_an_even_height(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    write_film(path, greys(3), 10.0, width=101)
    film = cv2.VideoCapture(str(path))
    assert film.get(cv2.CAP_PROP_FRAME_WIDTH) == 100
    assert film.get(cv2.CAP_PROP_FRAME_HEIGHT) == 76


def test_a_gif_of_noise_is_narrowed_until_it_is_small(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fgslam.datasets.video.GIF_BYTES", 70_000)
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 256, (48, 720, 3), dtype=np.uint8) for _ in range(4)]
    write_film(tmp_path / "a.gif", noise, 10.0)
    with Pillow.open(tmp_path / "a.gif") as film:
        assert film.width == 440
        assert film.n_frames == 4  # type: ignore[attr-defined]
    assert (tmp_path / "a.gif").stat().st_size < 70_000


@pytest.mark.parametrize(("name", "frames"), [("a.avi", 3), ("a.mp4", 0), ("a.gif", 0)])
def test_what_cannot_be_written_leaves_no_file(tmp_path: Path, name: str, frames: int) -> None:
    with pytest.raises(OutputError, match="cannot write"):
        write_film(tmp_path / name, greys(frames), 10.0)
    assert not list(tmp_path.iterdir())


def test_a_film_that_was_killed_leaves_nothing_once_it_is_written_again(tmp_path: Path) -> None:
    killed, alive = subprocess.Popen([sys.executable, "-c", ""]), os.getppid()
    killed.wait()
    left = tmp_path / f".a.mp4.{killed.pid}-0.partial.mp4"
    others = [
        tmp_path / f".a.mp4.{alive}-0.partial.mp4",
        tmp_path / f".b.mp4.{killed.pid}-0.partial.mp4",
        tmp_path / f".a.mp4.{os.getpid()}-0.partial.mp4",
    ]
    for path in (left, *others):
        path.write_bytes(b"\0")
    write_film(tmp_path / "a.mp4", greys(3), 10.0)
    assert set(tmp_path.iterdir()) == {tmp_path / "a.mp4", *others}


def test_a_film_for_which_there_is_no_room_is_no_film(tmp_path: Path) -> None:
    frames = np.random.default_rng(1).integers(0, 256, (9, 96, 96, 3), dtype=np.uint8)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        with pytest.raises(OutputError, match=r"a\.mp4: the disk is full; free some space"):
            write_film(tmp_path / "a.mp4", frames, 10.0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not list(tmp_path.iterdir())
