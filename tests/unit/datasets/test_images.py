"""Images of every kind that files hold: read as they are, or refused in one line."""

from __future__ import annotations

import io
import os
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as PictureFile

import fgslam as fg
from fgslam.core.errors import DatasetError, FrameError
from fgslam.datasets.images import (
    decode_grey,
    mosaic_note,
    open_frames,
    read_grey_image,
)

GREY = np.add.outer(np.arange(60), 2 * np.arange(80)).astype(np.uint8)


def encoded(picture: PictureFile.Image, kind: str = "PNG", **more: object) -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, kind, **more)
    return buffer.getvalue()


def png_that_claims(width: int, height: int) -> bytes:
    """A whole PNG of some hundred bytes with such a size in its header."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    content = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(10_000)))
    return b"\x89PNG\r\n\x1a\n" + content + chunk(b"IEND", b"")


def of_16_bits() -> PictureFile.Image:
    return PictureFile.fromarray(GREY.astype(np.uint16) * 256 + 77)


@pytest.mark.parametrize("mode", ["RGBA", "LA", "P", "RGB"])
def test_alpha_and_palettes_change_no_grey(mode: str) -> None:
    data = encoded(PictureFile.fromarray(GREY).convert(mode))
    np.testing.assert_array_equal(decode_grey(data, "a.png"), GREY)


def test_of_sixteen_bits_the_upper_eight_are_kept() -> None:
    np.testing.assert_array_equal(decode_grey(encoded(of_16_bits()), "a.png"), GREY)


def test_a_jpeg_of_four_colours_is_as_bright_as_its_grey() -> None:
    data = encoded(PictureFile.fromarray(GREY).convert("CMYK"), "JPEG", quality=95)
    assert np.abs(decode_grey(data, "a.jpg").astype(int) - GREY).max() < 12


@pytest.mark.parametrize(("blue", "told"), [(1.0, False), (0.6, True)])
def test_a_mosaic_of_colours_is_told(blue: float, told: bool) -> None:
    """Brighter in the rows and columns of one colour; of grey things, or in noise, it is none."""
    generator = np.random.default_rng(3)
    mosaic = 2.0 * GREY.clip(0, 100) + generator.normal(0.0, 2.0, GREY.shape)
    mosaic[1::2, ::2] *= blue
    image = mosaic.clip(0, 255).astype(np.uint8)
    assert bool(mosaic_note(5, lambda _: image)) == told
    noise = generator.integers(0, 255, GREY.shape).astype(np.uint8)
    assert mosaic_note(1, lambda _: noise) == ()


@pytest.mark.parametrize("size", [(30_000, 30_000), (0, 10)])
def test_a_header_that_claims_gigabytes_is_not_believed(size: tuple[int, int]) -> None:
    words = rf"a\.png claims to be {size[0]}x{size[1]}, at most 100 megapixels"
    with pytest.raises(FrameError, match=words):
        decode_grey(png_that_claims(*size), "a.png")


def test_pixels_of_other_types_are_not_cut_to_eight_bits() -> None:
    data = encoded(PictureFile.fromarray(GREY.astype(np.float32) * 7.0), "TIFF")
    with pytest.raises(FrameError, match="pixels of type float32; convert it to 8 or 16 bits"):
        decode_grey(data, "a.tif")


def test_an_animated_image_is_not_taken_for_one() -> None:
    second = PictureFile.fromarray(255 - GREY)
    data = encoded(PictureFile.fromarray(GREY), save_all=True, append_images=[second])
    with pytest.raises(FrameError, match="is animated; give one file an image"):
        decode_grey(data, "a.png")


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "BMP", "PPM", "TIFF"])
def test_half_a_file_is_no_image(kind: str) -> None:
    data = encoded(PictureFile.fromarray(GREY), kind)
    np.testing.assert_allclose(decode_grey(data, "a").astype(int), GREY, rtol=0, atol=12)
    with pytest.raises(FrameError):
        decode_grey(data[: len(data) // 2], "a")


LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a2146\nsize 12345\n"


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (LFS, "is a pointer of Git LFS; get the image itself: git lfs pull"),
        (b"", "is empty; copy the file again from its source"),
    ],
)
def test_a_file_in_the_place_of_an_image_is_said_to_be_what_it_is(data: bytes, words: str) -> None:
    with pytest.raises(FrameError, match=words):
        decode_grey(data, "a.png")


def test_a_recording_without_a_readable_image_says_what_the_first_one_is(tmp_path: Path) -> None:
    rig = fg.StereoRig(80, 60, 50.0, 50.0, 40.0, 30.0, baseline=0.1)
    paths = tuple((tmp_path / f"right_{k}.png", tmp_path / f"left_{k}.png") for k in range(2))
    with pytest.raises(DatasetError, match="check that the file names fit the list of times"):
        open_frames(paths, rig, tmp_path)
    for right, left in paths:
        right.write_bytes(encoded(PictureFile.fromarray(GREY)))
        left.write_bytes(LFS)
    with pytest.raises(DatasetError, match=r"of the first: image .*left_0.png is a pointer of Git"):
        open_frames(paths, rig, tmp_path)


@pytest.mark.parametrize("kind", ["a pipe", "a device", "a folder", "a loop", "nothing"])
def test_paths_that_are_no_image_are_not_waited_for(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "000000.png"
    if kind == "a pipe":
        os.mkfifo(path)
    elif kind == "a device":
        path.symlink_to("/dev/zero")
    elif kind == "a folder":
        path.mkdir()
    elif kind == "a loop":
        path.symlink_to(path)
    with pytest.raises(FrameError, match=r"000000\.png") as caught:
        read_grey_image(path)
    assert "\n" not in str(caught.value)
