"""The same configuration and seed give the same bytes, whatever the process and its cores."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from recordings import experiment
from running import (
    HANGS_AFTER_S,
    Finished,
    bytes_of,
    run_values,
    start,
    stop_after,
    write_config,
)


def test_two_runs_in_one_process(finished: Finished, tmp_path: Path) -> None:
    again = run_values(finished.values, tmp_path / "run")
    assert bytes_of(again.folder) == bytes_of(finished.folder)


@pytest.mark.parametrize(
    ("hash_seed", "threads", "cores"),
    [pytest.param("0", "1", 1, marks=pytest.mark.slow), ("4242", "4", os.cpu_count() or 1)],
)
def test_another_process(
    hash_seed: str, threads: str, cores: int, finished: Finished, tmp_path: Path
) -> None:
    """Other hash seeds (order of sets), numbers of threads, and cores to run on."""
    folder = tmp_path / "run"
    config = write_config(tmp_path / "c.yaml", finished.values)
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
    process = start(
        *("run", config, "--out", folder),
        PYTHONHASHSEED=hash_seed,
        **dict.fromkeys(names, threads),
    )
    os.sched_setaffinity(process.pid, sorted(os.sched_getaffinity(0))[:cores])
    _, error = process.communicate(timeout=HANGS_AFTER_S)
    assert process.returncode == 0, error
    assert bytes_of(folder) == bytes_of(finished.folder)


def test_another_seed_matters_where_it_should(recording: Path, tmp_path: Path) -> None:
    """Otherwise equal bytes would say nothing."""
    dataset = {"kind": "image_folder", "path": str(recording), "stop": 5}
    values = experiment(recording, dataset=dataset, odometry={"kind": "synthetic"})
    one, two = (run_values(values | {"seed": k}, tmp_path / str(k)) for k in (1, 2))
    assert bytes_of(one.folder) != bytes_of(two.folder)


@pytest.mark.slow
def test_pictures(recording: Path, tmp_path: Path) -> None:
    """Drawn twice, the second time by a run that was interrupted and resumed."""
    values = experiment(
        recording,
        dataset={"kind": "image_folder", "path": str(recording), "stop": 2},
        output={"pictures": True, "report": False, "checkpoint_seconds": 0.0},
    )
    straight = run_values(values, tmp_path / "straight")
    run_values(values, tmp_path / "resumed", stopped=stop_after(1))
    resumed = run_values(values, tmp_path / "resumed", "resume")
    names = sorted(path.name for path in straight.result.pictures)
    assert len(names) >= 8
    assert names == sorted(path.name for path in resumed.result.pictures)
    for name in names:
        first = (straight.folder / "pictures" / name).read_bytes()
        assert first.startswith(b"\x89PNG")
        assert first == (resumed.folder / "pictures" / name).read_bytes(), name
