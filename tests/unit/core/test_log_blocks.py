"""A log of which only the last frames are in memory is the log that it would be in memory."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_measurement_log import RIG, assert_same, increment, loop

from fgslam.core import log_blocks
from fgslam.core.array_files import Pieces, write_arrays, write_pieces
from fgslam.core.errors import MeasurementLogError, OutputError
from fgslam.core.log_blocks import LogBlocks
from fgslam.core.measurement_log import MeasurementLog
from fgslam.core.measurements import BiasEffect, Increment, Odometry
from fgslam.core.rig_correction import term_names

FRAMES, BLOCK = 23, 4
PLAIN, LOOPS, CORRECTED, TURNED, BIASED = "plain", "loops", "corrected", "turned", "biased"


@pytest.fixture(autouse=True)
def short_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log_blocks, "BLOCK", BLOCK)


def frames(kind: str, rng: np.random.Generator) -> list[Increment]:
    """Of each version of the log; what makes it that one is in the middle of them alone."""
    out = [increment(k, rng, (7, 0, 12)[k % 3], k > 0 and k != 3) for k in range(FRAMES)]
    if kind != PLAIN:
        closures = (loop(2, rng, 5, 2), loop(9, rng, 0, 0))
        out[10] = replace(out[10], loops=closures, relocalised=True)
        out[21] = replace(out[21], loops=(loop(17, rng, 3, 1),))
    if kind in (CORRECTED, TURNED, BIASED):
        for k in range(6, 14):
            out[k] = replace(out[k], rig_correction=rng.standard_normal(len(term_names(RIG))))
    if kind == TURNED:
        out[12] = replace(out[12], odometry=Odometry.turn(np.eye(3), 0.01 * np.eye(3)))
    if kind == BIASED:
        effect = BiasEffect(-0.1 * np.eye(3), 1e-3, 1e-9, rng.standard_normal(3), 1e-4 * np.eye(3))
        out[12] = replace(out[12], odometry=Odometry.turn(np.eye(3), 0.01 * np.eye(3), effect))
    return out


def logs(kind: str, rng: np.random.Generator, folder: Path) -> tuple[MeasurementLog, ...]:
    """In memory, and on disk."""
    memory, disk = (
        MeasurementLog(RIG, {"kind": "recorded"}),
        MeasurementLog(RIG, {"kind": "recorded"}),
    )
    disk.keep_in(folder)
    for frame in frames(kind, rng):
        memory.append(frame)
        disk.append(frame)
    return memory, disk


@pytest.mark.parametrize("kind", [PLAIN, LOOPS, CORRECTED, TURNED, BIASED])
def test_the_file_of_the_whole_log_has_the_same_bytes(
    kind: str, rng: np.random.Generator, tmp_path: Path
) -> None:
    memory, disk = logs(kind, rng, tmp_path / "blocks")
    assert len(list((tmp_path / "blocks").iterdir())) == 4, "the last two are in memory"
    memory.save(tmp_path / "a.npz")
    disk.save(tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    again = MeasurementLog(RIG, {"kind": "recorded"})
    again.keep_in(tmp_path / "blocks")
    again.continue_with(MeasurementLog.load(tmp_path / "a.npz").increments[:])
    again.save(tmp_path / "c.npz")
    assert (tmp_path / "c.npz").read_bytes() == (tmp_path / "a.npz").read_bytes(), "as resumed"


@pytest.mark.parametrize("kind", [LOOPS, TURNED])
def test_every_frame_is_read_back_as_from_the_file_of_the_whole_log(
    kind: str, rng: np.random.Generator, tmp_path: Path
) -> None:
    memory, disk = logs(kind, rng, tmp_path / "blocks")
    memory.save(tmp_path / "a.npz")
    loaded = MeasurementLog.load(tmp_path / "a.npz")
    for before, after in zip(loaded, disk, strict=True):
        assert_same(replace(after, rig_correction=before.rig_correction), before)
    assert_same(disk.increments[-1], memory.increments[-1])
    assert_same(tuple(disk.increments[9:3:-2]), tuple(loaded.increments[9:3:-2]))
    with pytest.raises(IndexError):
        disk.increments[FRAMES]
    np.testing.assert_array_equal(disk.timestamps, memory.timestamps)
    np.testing.assert_array_equal(disk.numbers, memory.numbers)
    assert disk.relocalised == memory.relocalised == 1
    assert [k for k, _ in disk.closures] == [k for k, _ in memory.closures] == [10, 10, 21]


def test_no_more_than_two_blocks_and_one_that_was_read_are_in_memory(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    _, disk = logs(LOOPS, rng, tmp_path / "blocks")
    assert isinstance(disk.increments, LogBlocks)
    assert sum(1 for _ in disk) == FRAMES
    held = len(disk.increments._last) + len(disk.increments._read[1])
    assert held <= 3 * BLOCK


def test_a_finished_log_is_read_from_its_file_and_leaves_no_block(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    _, disk = logs(LOOPS, rng, tmp_path / "blocks")
    disk.save(tmp_path / "a.npz")
    disk.rest_in(tmp_path / "a.npz")
    assert not (tmp_path / "blocks").exists()
    for before, after in zip(MeasurementLog.load(tmp_path / "a.npz"), disk, strict=True):
        assert_same(after, before)
    disk.save(tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_blocks_of_a_log_that_was_killed_go(rng: np.random.Generator, tmp_path: Path) -> None:
    logs(PLAIN, rng, tmp_path / "blocks")
    (tmp_path / "blocks" / "notes.txt").write_text("the user's")
    anew = MeasurementLog(RIG, {})
    anew.keep_in(tmp_path / "blocks")
    assert [path.name for path in (tmp_path / "blocks").iterdir()] == ["notes.txt"]


def test_a_block_that_is_damaged_or_missing_is_named(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    _, disk = logs(PLAIN, rng, tmp_path / "blocks")
    first, second = sorted((tmp_path / "blocks").iterdir())[:2]
    second.unlink()
    with pytest.raises(MeasurementLogError, match=r"000001\.npz: no such file"):
        disk.increments[BLOCK]
    first.write_bytes(first.read_bytes()[:400])
    with pytest.raises(MeasurementLogError, match=r"000000\.npz: not a readable"):
        disk.save(tmp_path / "a.npz")
    assert not (tmp_path / "a.npz").exists()


def test_a_block_that_cannot_be_written_costs_no_frame(
    rng: np.random.Generator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = MeasurementLog(RIG, {})
    log.keep_in(tmp_path / "no" / "such")
    given = frames(PLAIN, rng)
    for frame in given[: 2 * BLOCK]:
        log.append(frame)
    with pytest.raises(OutputError, match="cannot write"):
        log.append(given[2 * BLOCK])
    assert len(log) == 2 * BLOCK
    (tmp_path / "no").mkdir()
    log.append(given[2 * BLOCK])
    assert len(log) == 2 * BLOCK + 1


@pytest.mark.parametrize(
    "array",
    [
        np.arange(10).reshape(5, 2),
        np.zeros((0, 3)),
        np.array([True, False]),
        np.array("a text"),
        np.linspace(0.0, 1.0, 7, dtype=np.float32),
    ],
)
def test_pieces_are_written_to_the_bytes_of_the_whole(
    array: np.ndarray,
    tmp_path: Path,  # type: ignore[type-arg]
) -> None:
    def parts() -> list[np.ndarray]:  # type: ignore[type-arg]
        return [array] if not array.ndim else [array[:1], array[1:1], array[1:]]

    write_arrays(tmp_path / "whole.npz", {"one": array, "two": array})
    pieces = Pieces(array.dtype, array.shape, parts)
    write_pieces(tmp_path / "pieces.npz", {"one": pieces, "two": Pieces.of(array)})
    assert (tmp_path / "whole.npz").read_bytes() == (tmp_path / "pieces.npz").read_bytes()
