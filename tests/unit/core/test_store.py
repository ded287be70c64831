"""Files of arrays: damaged, foreign and oversized ones are refused in one clear line."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from simulated import assert_same_value

from fgslam.core.arrays import FloatArray, IntArray, StateArrays
from fgslam.core.errors import DatasetError, MapError, MeasurementLogError
from fgslam.core.files import read_text
from fgslam.core.store import FileKind, load_arrays, write_arrays


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


# --------------------------------------------------------------------------------------------
# Files of values: logs, maps and paths have one check


@dataclass
class Pair:
    numbers: FloatArray
    counts: IntArray
    name: str


@dataclass
class OtherPair:
    numbers: FloatArray


def require_few(pair: Pair) -> None:
    if len(pair.counts) > 9:
        raise ValueError("too many counts")


KIND = FileKind(
    Pair, "fgslam pair", 2, MapError, "give a pair", "make it again", require_few, packed="i"
)
PAIR = Pair(np.linspace(0.0, 1.0, 12).reshape(6, 2), np.arange(7), "both")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    KIND.save(tmp_path / "pair.npz", PAIR)
    return tmp_path / "pair.npz"


def rewritten(file: Path, change: Callable[[StateArrays], object]) -> Path:
    arrays = load_arrays(file)
    change(arrays)
    write_arrays(file, arrays)
    return file


def test_the_same_value_gives_the_same_bytes(file: Path, tmp_path: Path) -> None:
    loaded = KIND.load(file)
    assert_same_value(loaded, PAIR)
    size = KIND.save(tmp_path / "again.npz", loaded)
    assert (tmp_path / "again.npz").read_bytes() == file.read_bytes()
    assert size == file.stat().st_size


@pytest.mark.parametrize("kept", [0.0, 0.01, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_refused(file: Path, kept: float) -> None:
    data = file.read_bytes()
    file.write_bytes(data[: int(kept * len(data))])
    with pytest.raises(
        MapError, match=r"pair\.npz: not a readable pair .*truncated, make it again"
    ):
        KIND.load(file)


def test_a_flipped_byte_is_refused_or_harmless(file: Path) -> None:
    """Some bytes of a zip carry nothing (times, attributes): there the value must be the same."""
    data, refused = file.read_bytes(), 0
    for at in range(0, len(data), 5):
        file.write_bytes(data[:at] + bytes([data[at] ^ 0x10]) + data[at + 1 :])
        message = ""
        try:
            loaded = KIND.load(file)
        except MapError as error:
            message = str(error)
        if message:
            refused += 1
            assert message.startswith(str(file))
            assert "\n" not in message
        else:
            assert_same_value(loaded, PAIR)
    assert refused > len(data) / 10


@pytest.mark.parametrize("name", ["numbers", "counts", "tree"])
def test_a_changed_array_in_a_valid_archive_is_noticed(file: Path, name: str) -> None:
    changes: list[Callable[[StateArrays], object]] = [
        lambda arrays: arrays.pop(name),
        lambda arrays: arrays.update({name: arrays[name][..., None]}),
        lambda arrays: arrays.update({name: arrays[name].astype("U")[..., None]}),
        lambda arrays: arrays.update(other=np.zeros(3)),
    ]
    data = file.read_bytes()
    for change in changes:
        file.write_bytes(data)
        with pytest.raises(MapError, match="do not have the checksum that they were saved with"):
            KIND.load(rewritten(file, change))


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        (replace(KIND, version=3), "pair made by another version; make it again"),
        (replace(KIND, kind=OtherPair), "pair made by another version; make it again"),
        (replace(KIND, name="fgslam map"), "not an fgslam map; give a pair"),
    ],
)
def test_files_of_other_values_are_refused(file: Path, kind: FileKind[Any], words: str) -> None:
    with pytest.raises(MapError, match=words):
        kind.load(file)


def test_foreign_files_folders_and_none_are_refused(tmp_path: Path) -> None:
    other = tmp_path / "other.npz"
    with pytest.raises(MapError, match="no such file; give a pair"):
        KIND.load(other)
    with pytest.raises(MapError, match="is a folder"):
        KIND.load(tmp_path)
    other.write_text("ply\nformat ascii 1.0\n")
    with pytest.raises(MapError, match="neither arrays nor an archive of them"):
        KIND.load(other)
    with other.open("wb") as stream:
        np.save(stream, np.eye(3))
    with pytest.raises(MapError, match="not a readable pair"):
        KIND.load(other)
    write_arrays(other, {"a": np.eye(3)})
    with pytest.raises(MapError, match="not an fgslam pair; give a pair"):
        KIND.load(other)


def test_pickled_objects_are_never_loaded(tmp_path: Path) -> None:
    class Bomb:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return Path.touch, (tmp_path / "exploded",)  # type: ignore[return-value]

    evil = tmp_path / "evil.npz"
    np.savez(evil, header=np.array([Bomb()], dtype=object))
    with pytest.raises(MapError, match="not a readable pair"):
        KIND.load(evil)
    assert not (tmp_path / "exploded").exists()


def test_a_value_that_no_run_makes_is_refused(tmp_path: Path) -> None:
    KIND.save(tmp_path / "many.npz", replace(PAIR, counts=np.arange(10)))
    with pytest.raises(MapError, match=r"many\.npz: too many counts; make it again"):
        KIND.load(tmp_path / "many.npz")
