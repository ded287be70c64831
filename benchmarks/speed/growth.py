"""How memory grows with the number of factors: 2,500 frames, each estimator in its own process.

The exponent p of `memory = c * factors^p`, by least squares over the logarithms: 1 is what keeping
all measurements takes. Memory is what the process has grown by since the first frame; the log, the
same for all, is in memory before it.
"""

from __future__ import annotations

import multiprocessing
from concurrent.futures import ProcessPoolExecutor

import numpy as np

from benchmarks.speed.blocks import resident_mb
from benchmarks.speed.drives import MeasuredDrive, Player, open_drive
from benchmarks.speed.long_drive import KEYFRAMES
from fgslam.backend.settings import EstimatorSettings, SlidingWindowSettings
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.threads import one_blas_thread

ESTIMATORS: dict[str, EstimatorSettings] = {
    "sliding_window": SlidingWindowSettings(),
    "isam2_keyframes": KEYFRAMES,
}
LIMITS = {f"growth_{name}_exponent": 1.1 for name in ESTIMATORS}
BLOCK = 250
_FIRST = 2
"""Blocks before the first that counts: until then the process fills room that it has."""


def exponents(frames: int = 2500) -> dict[str, float]:
    """Of each estimator the exponent, and the memory at the end, mebibytes over the start."""
    found: dict[str, float] = {}
    for name in ESTIMATORS:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
            found |= process.submit(_traced, name, frames).result()
    return found


@one_blas_thread()
def _traced(name: str, frames: int) -> dict[str, float]:
    drive = open_drive("long_drive", (f"dataset.stop={frames}",))
    stops = np.arange(BLOCK, frames + 1, BLOCK, dtype=np.int64)
    player = Player(drive, ESTIMATORS[name])
    player.on_to(1)
    before, grown = resident_mb(), []
    for stop in stops.tolist():
        player.on_to(stop)
        grown.append(resident_mb() - before)
    memory = np.array(grown)
    later = slice(_FIRST - 1, None)
    return {
        f"growth_{name}_exponent": exponent(_factors(drive, stops)[later], memory[later]),
        f"growth_{name}_mb": float(memory[-1]),
    }


def exponent(factors: FloatArray, memory: FloatArray) -> float:
    """The slope of the logarithms of (n,) memory over (n,) factors."""
    return float(np.polyfit(np.log(factors), np.log(memory), 1)[0])


def _factors(drive: MeasuredDrive, stops: IntArray) -> FloatArray:
    """(n,) observations that fit, and steps, up to each stop."""
    kept = [len(increment.kept) + 1 for increment in drive.log]
    return np.asarray(np.cumsum(kept)[stops - 1], np.float64)
