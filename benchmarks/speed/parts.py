"""All measurements of speed by part, and their bounds: the flat map of `bench.json`."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from rich.console import Console
from rich.table import Table

from benchmarks.speed import (
    estimators,
    homing,
    images,
    live,
    long_drive,
    maps,
    relocalising,
    smoothers,
    soak,
    starting,
    sweeps,
)
from benchmarks.speed.drives import open_drive
from fgslam.core.threads import one_blas_thread

LIMITS: dict[str, float] = (
    images.LIMITS
    | live.LIMITS
    | estimators.LIMITS
    | long_drive.LIMITS
    | homing.LIMITS
    | maps.LIMITS
    | relocalising.LIMITS
    | smoothers.LIMITS
    | soak.LIMITS
    | starting.LIMITS
    | sweeps.LIMITS
)
"""Largest allowed value of each bounded ratio, by its name in `bench.json`."""


@one_blas_thread()
def over_measurements() -> dict[str, float]:
    """Ratios of the estimators on simulated measurements, without batch on the long drive."""
    found = estimators.ratios_of_estimators()
    return found | long_drive.without_batch(open_drive("long_drive"))


def over_maps() -> dict[str, float]:
    """Times of tracking and of relocalisation by the size of the map."""
    return maps.ratios_of_maps() | relocalising.ratios_of_relocalising()


PARTS: dict[str, Callable[[int], dict[str, float]]] = {
    "images": images.over_images,
    "live": live.over_live,
    "estimators": lambda frames: over_measurements(),
    "maps": lambda frames: over_maps(),
    "homing": lambda frames: homing.ratios_of_homing(),
    "smoothers": lambda frames: smoothers.ratios_of_smoothers(),
    "fixed_lag": lambda frames: smoothers.ratios_of_fixed_lag(),
    "starting": lambda frames: starting.ratios_of_starting(),
}
"""Each part, called with the number of frames of the drive over images."""


def measure(part: str, frames: int) -> dict[str, float]:
    """Ratios by name, of one part or of ``all``; ``frames`` is used by the part `images`."""
    names = tuple(PARTS) if part == "all" else (part,)
    ratios: dict[str, float] = {}
    for name in names:
        ratios |= PARTS[name](frames)
    return ratios


def show(ratios: Mapping[str, float]) -> None:
    """Prints the ratios beside their bounds."""
    table = Table(title="speed")
    for column in ("ratio", "measured", "at most"):
        table.add_column(column)
    for name, value in ratios.items():
        limit = LIMITS.get(name)
        shown = f"{value:.3f}" if value == 0.0 or abs(value) >= 1e-3 else f"{value:.1e}"
        table.add_row(name, shown, "" if limit is None else f"{limit:g}")
    Console().print(table)
