"""A log that is read from its file by blocks is the log that is loaded whole, faults included."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_log_blocks import BIASED, BLOCK, CORRECTED, FRAMES, LOOPS, PLAIN, RIG, TURNED, frames
from test_measurement_log import assert_same

from fgslam.core import log_file
from fgslam.core.array_files import write_arrays
from fgslam.core.arrays import StateArrays
from fgslam.core.errors import MeasurementLogError
from fgslam.core.log_file import LogFile
from fgslam.core.measurement_log import MeasurementLog


@pytest.fixture(autouse=True)
def short_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log_file, "BLOCK", BLOCK)


def saved(kind: str, rng: np.random.Generator, path: Path) -> Path:
    log = MeasurementLog(RIG, {"kind": "recorded"})
    for frame in frames(kind, rng):
        log.append(frame)
    log.save(path)
    return path


@pytest.mark.parametrize("kind", [PLAIN, LOOPS, CORRECTED, TURNED, BIASED])
def test_every_frame_is_that_of_the_log_loaded_whole(
    kind: str, rng: np.random.Generator, tmp_path: Path
) -> None:
    path = saved(kind, rng, tmp_path / "a.npz")
    whole, by_blocks = MeasurementLog.load(path), MeasurementLog.read_from(path)
    assert isinstance(by_blocks.increments, LogFile)
    assert by_blocks.motion_model == whole.motion_model
    assert_same(by_blocks.rig, whole.rig)
    assert_same(tuple(by_blocks), tuple(whole))
    assert len(by_blocks.increments._read[1]) <= BLOCK
    assert_same(tuple(by_blocks.increments[9:3:-2]), tuple(whole.increments[9:3:-2]))
    assert_same(by_blocks.increments[-1], whole.increments[-1])
    with pytest.raises(IndexError):
        by_blocks.increments[FRAMES]
    np.testing.assert_array_equal(by_blocks.timestamps, whole.timestamps)
    np.testing.assert_array_equal(by_blocks.numbers, whole.numbers)
    assert by_blocks.relocalised == whole.relocalised
    assert_same(tuple(by_blocks.closures), tuple(whole.closures))
    by_blocks.save(tmp_path / "b.npz")
    assert (tmp_path / "b.npz").read_bytes() == path.read_bytes()


def test_a_frame_may_be_added_to_it(rng: np.random.Generator, tmp_path: Path) -> None:
    log = MeasurementLog.read_from(saved(LOOPS, rng, tmp_path / "a.npz"))
    more = replace(log.increments[-1], index=99, timestamp=1e3)
    log.append(more)
    assert len(log) == FRAMES + 1
    assert log.numbers[-1] == 99


def test_another_file_of_its_name_changes_nothing(rng: np.random.Generator, tmp_path: Path) -> None:
    path = saved(LOOPS, rng, tmp_path / "a.npz")
    log, whole = MeasurementLog.read_from(path), MeasurementLog.load(path)
    saved(PLAIN, rng, path)
    assert_same(tuple(log), tuple(whole))


def test_a_compressed_log_and_a_short_one_are_read_whole(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    whole = MeasurementLog.load(saved(LOOPS, rng, tmp_path / "a.npz"))
    write_arrays(tmp_path / "b.npz", whole.to_arrays(), compressed=True)
    packed = MeasurementLog.read_from(tmp_path / "b.npz")
    assert_same(tuple(packed), tuple(whole))
    MeasurementLog(whole.rig, {}, whole.increments[:BLOCK]).save(tmp_path / "c.npz")
    assert isinstance(MeasurementLog.read_from(tmp_path / "c.npz").increments, list)


def _not_finite(arrays: StateArrays) -> None:
    arrays["measurement"][-1, 1] = np.nan


def _no_covariance(arrays: StateArrays) -> None:
    arrays["measurement_covariance"][70] *= -1.0


def _twice(arrays: StateArrays) -> None:
    start = arrays["observation_start"][14]
    arrays["observation_id"][start + 1] = arrays["observation_id"][start]


def _longer(arrays: StateArrays) -> None:
    arrays["missed_id"] = np.append(arrays["missed_id"], 3)


def _back(arrays: StateArrays) -> None:
    arrays["timestamp"][12] = 0.0


def _step_back(arrays: StateArrays) -> None:
    arrays["observation_start"][13] = 0


def _loop_ahead(arrays: StateArrays) -> None:
    arrays["loop_frame"][-1] = 22


def _loops_lost(arrays: StateArrays) -> None:
    arrays["loop_start"] = arrays["loop_start"][:0]


def _newer(arrays: StateArrays) -> None:
    arrays["header"] = np.array(str(arrays["header"]).replace('"version": 3', '"version": 99'))


DAMAGES = (
    _not_finite, _no_covariance, _twice, _longer, _back, _step_back, _loop_ahead, _loops_lost,
    _newer,
)  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGES)
def test_what_no_run_wrote_is_refused_at_once_with_the_line_of_the_whole_log(
    damage: Callable[[StateArrays], None], rng: np.random.Generator, tmp_path: Path
) -> None:
    arrays = MeasurementLog.load(saved(LOOPS, rng, tmp_path / "a.npz")).to_arrays()
    damage(arrays)
    write_arrays(tmp_path / "b.npz", arrays)
    assert refusal(MeasurementLog.read_from, tmp_path) == refusal(MeasurementLog.load, tmp_path)


def test_a_file_that_is_truncated_or_altered_is_refused_at_once(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    content = bytearray(saved(LOOPS, rng, tmp_path / "a.npz").read_bytes())
    altered = bytearray(content)
    altered[len(content) // 2] ^= 1
    for spoilt in (content[: len(content) // 2], altered, b"", b"text"):
        (tmp_path / "b.npz").write_bytes(spoilt)
        assert refusal(MeasurementLog.read_from, tmp_path) == refusal(MeasurementLog.load, tmp_path)


def refusal(read: Callable[[Path], MeasurementLog], folder: Path) -> str:
    with pytest.raises(MeasurementLogError) as refused:
        read(folder / "b.npz")
    return str(refused.value)
