"""A sweep over worlds of noise: how much faster are two workers, what does a case cost besides?

Simulated measurements, each sweep in a process of its own. The steady part are the cases without
the first and the last tenth, as they came back: without the start of the workers and the check of
all cases before, and without table and page after. Overhead is the time that the workers have had,
less what the cases took by their own clocks. Only a quiet machine shows either: where others work,
two workers get twice the share of one, and waiting for a processor counts as overhead; so the load
before stands beside the numbers.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.speed.blocks import resident_mb
from fgslam.core.errors import ConfigError
from fgslam.runs.sweep import JOURNAL_FILE, make_plan, run_sweep
from fgslam.runs.workers import Pool

CASES = 2_000
_LEAST = 20
WORKERS = (1, 2)
_EXPERIMENT = Path("lab_trials")
_FRAMES = 20
_ESTIMATORS = ("landmark_kalman",)
_LEFT_OUT = 0.1  # of the cases, at either end

LIMITS = {
    "sweep_load_before": 0.5,
    "sweep_2_workers_overhead_ms": 20.0,
    "sweep_driver_mb_late_over_early": 1.1,
}


@dataclass
class _Clock:
    """When cases came back, and the driver's memory then."""

    came_s: list[float] = field(default_factory=list)
    mb: list[float] = field(default_factory=list)

    def tell(self, what: str, done: int, total: int) -> None:
        if what == "cases" and done:
            self.came_s.append(time.monotonic())
            self.mb.append(resident_mb())


def numbers(cases: int = CASES) -> dict[str, float]:
    """All numbers by name, of so many cases on one worker and on two. Raises ConfigError."""
    if cases < _LEAST:
        raise ConfigError(f"--cases {cases}: give {_LEAST} or more")
    out = {"sweep_cases": float(cases), "sweep_load_before": os.getloadavg()[0]}
    for workers in WORKERS:
        # A process that has done a sweep before has the memory of that one.
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
            out |= process.submit(_sweep, workers, cases).result()
    one, two = (f"sweep_{workers}_workers" for workers in WORKERS)
    out["sweep_scaling"] = out[f"{two}_cases_a_second"] / out[f"{one}_cases_a_second"]
    out["sweep_scaling_in_all"] = out[f"{one}_s"] / out[f"{two}_s"]
    return out | {
        "sweep_driver_mb_early": out[f"{two}_driver_mb_early"],
        "sweep_driver_mb_late": out[f"{two}_driver_mb_late"],
        "sweep_driver_mb_late_over_early": (
            out[f"{two}_driver_mb_late"] / out[f"{two}_driver_mb_early"]
        ),
    }


def _sweep(workers: int, cases: int) -> dict[str, float]:
    """One sweep from its call to its page."""
    axes = {"seed": range(cases), "dataset.stop": _FRAMES}
    clock = _Clock()
    with tempfile.TemporaryDirectory(prefix="fgslam-bench-") as scratch:
        folder = Path(scratch) / "sweep"
        begun, cpu = time.monotonic(), time.process_time()
        plan = make_plan([_EXPERIMENT], axes, _ESTIMATORS)
        result = run_sweep(plan, folder, Pool(workers), progress=clock.tell)
        wall, driver = time.monotonic() - begun, time.process_time() - cpu
        if result.done != cases:
            raise RuntimeError(f"{cases - result.done} cases failed: {result.failures}")
        took = case_seconds(folder / JOURNAL_FILE)
    return of_sweep(f"sweep_{workers}_workers", workers, wall, took, clock.came_s) | {
        f"sweep_{workers}_workers_driver_cpu_ms": 1e3 * driver / cases,
        f"sweep_{workers}_workers_driver_mb_early": clock.mb[cases // 10],
        f"sweep_{workers}_workers_driver_mb_late": clock.mb[-1],
    }


def case_seconds(journal: Path) -> np.ndarray:
    """(n,) seconds that each case took by its worker's clock, in the order in which they came."""
    lines = journal.read_text(encoding="utf-8").splitlines()
    return np.array([json.loads(line)[1] for line in lines])


def of_sweep(
    name: str, workers: int, wall_s: float, took_s: np.ndarray, came_s: list[float]
) -> dict[str, float]:
    """Rate and overhead of the steady part, and of all.

    Args:
        name: before each number's.
        workers: of them.
        wall_s: from the call to the page.
        took_s: (n,) by the workers' clocks, in the order in which the cases came.
        came_s: (n,) when they came.
    """
    count = len(took_s)
    first, last = round(_LEFT_OUT * count), count - 1 - round(_LEFT_OUT * count)
    steady_s, steady = came_s[last] - came_s[first], last - first
    own_s = float(took_s[first + 1 : last + 1].sum())
    return {
        f"{name}_s": wall_s,
        f"{name}_case_ms": 1e3 * float(np.mean(took_s)),
        f"{name}_cases_a_second": steady / steady_s,
        f"{name}_overhead_ms": 1e3 * (workers * steady_s - own_s) / steady,
        f"{name}_overhead_ms_in_all": 1e3 * (workers * wall_s - float(took_s.sum())) / count,
    }
