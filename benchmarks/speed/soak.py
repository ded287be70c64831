"""20,000 frames round and round the lab: do memory and time of a frame stay where they are?

Simulated measurements, whose identities are given up after 20 misses as the front-end does it; each
estimator in a process of its own. Over images, the part `images` drives 2,000 frames. Whole traces
stand in the file: every 2,000 frames the median and the 99th percentile of a frame's processor
time, and what the process has grown by since the first frame.
"""

from __future__ import annotations

import multiprocessing
from concurrent.futures import ProcessPoolExecutor

from benchmarks.speed.blocks import Memory, of_blocks, resident_mb
from benchmarks.speed.drives import Player, open_drive
from fgslam.backend.settings import EstimatorSettings, FixedLagSettings, LandmarkKalmanSettings
from fgslam.core.threads import one_blas_thread

FRAMES, BLOCK = 20_000, 2_000
_LAP = 250  # frames; the speed of the paper's drive
_DETECTED = 40

ESTIMATORS: dict[str, EstimatorSettings] = {
    "landmark_kalman": LandmarkKalmanSettings(),
    "fixed_lag": FixedLagSettings(),
}
LIMITS = {f"soak_{name}_ms_last_over_second_block": 1.1 for name in ESTIMATORS}


def traces(frames: int = FRAMES) -> dict[str, float]:
    """All numbers by name, of all estimators at once."""
    with ProcessPoolExecutor(len(ESTIMATORS), multiprocessing.get_context("spawn")) as processes:
        given = [(name, frames, max(frames * BLOCK // FRAMES, 1)) for name in ESTIMATORS]
        found = list(processes.map(_trace, given))
    return {name: value for numbers in found for name, value in numbers.items()}


@one_blas_thread()
def _trace(given: tuple[str, int, int]) -> dict[str, float]:
    """Of one estimator, over so many frames in blocks of so many."""
    name, frames, block = given
    drive = open_drive("lab_trials", _endless(frames))
    player = Player(drive, ESTIMATORS[name])
    player.on_to(1)
    before, memory = resident_mb(), Memory()
    for stop in range(block, frames + 1, block):
        player.on_to(stop)
        memory.book()
    mb = [process - before for process in memory.process_mb]
    out = of_blocks(f"soak_{name}", player.played().cpu_s, mb, block)
    last, second = (out[f"soak_{name}_{stop}_ms"] for stop in (block * len(mb), 2 * block))
    half = len(mb) // 2
    grown = (mb[-1] - mb[half - 1]) / (block * (len(mb) - half))
    return out | {
        f"soak_{name}_ms_last_over_second_block": last / second,
        f"soak_{name}_kb_a_frame_second_half": 1e3 * grown,
    }


def _endless(frames: int) -> tuple[str, ...]:
    """The paper's room, lap after lap at the paper's speed."""
    return (
        "dataset.drive.path=laps",
        f"dataset.drive.laps={max(frames // _LAP, 1)}",
        f"dataset.drive.frames={frames}",
        f"dataset.detection.features={_DETECTED}",
    )
