"""A long drive in blocks of frames: time of a frame, memory of the process and of its log."""

from __future__ import annotations

import resource
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fgslam.core.log import MeasurementLog


@dataclass
class Memory:
    """Mebibytes at the end of each block."""

    process_mb: list[float] = field(default_factory=list)
    log_mb: list[float] = field(default_factory=list)

    def book(self, log: MeasurementLog | None = None) -> None:
        """Ends a block; of a ``log`` that is in memory its size, too."""
        self.process_mb.append(resident_mb())
        if log is not None:
            self.log_mb.append(log_mb(log))


def of_blocks(
    name: str,
    cpu_s: np.ndarray,
    process_mb: list[float],
    block: int,
) -> dict[str, float]:
    """Of each block of frames the median time and the 99th percentile, and the memory after it."""
    out: dict[str, float] = {}
    for k, memory in enumerate(process_mb):
        at, ms = f"{name}_{(k + 1) * block}", 1e3 * cpu_s[k * block : (k + 1) * block]
        out |= {
            f"{at}_ms": float(np.median(ms)),
            f"{at}_ms_99": float(np.percentile(ms, 99)),
            f"{at}_mb": memory,
        }
    return out


def resident_mb() -> float:
    """Resident memory now, mebibytes."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def log_mb(log: MeasurementLog) -> float:
    """Size of a measurement log in memory, which grows with the drive, mebibytes."""
    arrays = [
        value
        for increment in log
        for part in (increment, increment.observations, increment.odometry)
        if part is not None
        for name in part.__dataclass_fields__
        if isinstance(value := getattr(part, name), np.ndarray)
    ]
    return sum(array.nbytes for array in arrays) / 2**20
