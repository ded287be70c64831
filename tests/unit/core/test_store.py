"""Archives of arrays from elsewhere: what they hold beside arrays, and how much, is looked at."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path

import numpy as np
import pytest

from fgslam.core.errors import DatasetError, MeasurementLogError
from fgslam.core.files import read_text
from fgslam.core.store import load_arrays, write_arrays


def archive(tmp_path: Path) -> Path:
    path = tmp_path / "log.npz"
    write_arrays(path, {"a": np.arange(5)})
    return path


def test_a_foreign_member_is_named(tmp_path: Path) -> None:
    path = archive(tmp_path)
    with zipfile.ZipFile(path, "a") as file:
        file.writestr("../../evil.sh", "rm")
    with pytest.raises(MeasurementLogError, match=r"holds \.\./\.\./evil\.sh, which is no array"):
        load_arrays(path)


def test_an_encrypted_array_is_told(tmp_path: Path) -> None:
    path = archive(tmp_path)
    data = bytearray(path.read_bytes())
    data[data.rindex(b"PK\x01\x02") + 8] |= 1  # the flag in the directory of the archive
    path.write_bytes(data)
    with pytest.raises(MeasurementLogError, match="is encrypted"):
        load_arrays(path)


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_an_array_that_is_there_twice_is_not_chosen_from(tmp_path: Path) -> None:
    path = archive(tmp_path)
    with zipfile.ZipFile(path, "a") as file:
        file.writestr("a.npy", b"another")
    with pytest.raises(MeasurementLogError, match="holds an array twice"):
        load_arrays(path)


def test_what_would_fill_the_memory_is_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file, file.open("a.npy", "w") as inner:
        np.lib.format.write_array_header_1_0(
            inner, {"descr": "<f8", "fortran_order": False, "shape": (25_000_000,)}
        )
        for _ in range(200):
            inner.write(bytes(1_000_000))
    with pytest.raises(MeasurementLogError, match="would unpack to 200 MB from 0"):
        load_arrays(path)


@pytest.mark.parametrize("header", ["{'descr': '<f8', 'shape': (3,", "{'a': 1}\n  b\n c"])
def test_an_array_s_header_that_breaks_off_is_one_line(header: str, tmp_path: Path) -> None:
    path = tmp_path / "log.npz"
    text = header.encode() + b"\n"
    with zipfile.ZipFile(path, "w") as file:
        length = len(text).to_bytes(2, "little")
        file.writestr("a.npy", b"\x93NUMPY\x01\x00" + length + text)
    with pytest.raises(MeasurementLogError, match=r"log\.npz"):
        load_arrays(path)


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    with pytest.raises(MeasurementLogError, match="it is a pipe"):
        load_arrays(path)
    with pytest.raises(DatasetError, match="it is a pipe"):
        read_text(path)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("/dev/zero", "it is a device"),
        ("a\0b", "null byte"),
        ("p" * 5000, "File name too long"),
        ("loop", "symbolic link"),
        ("dangling", "No such file"),
        (".", "it is a folder"),
    ],
)
def test_paths_that_are_no_file_are_said_to_be_none(name: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    with pytest.raises(DatasetError, match=words) as caught:
        read_text(tmp_path / name)
    assert len(str(caught.value)) < 400
