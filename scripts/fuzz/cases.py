"""Kinds of input, and what becomes of a case."""

from __future__ import annotations

import signal
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import cv2
import numpy as np

import fgslam as fg
from fgslam.core.errors import FgslamError
from fgslam.core.threads import one_blas_thread
from fgslam.datasets.images import read_grey_image
from fgslam.runs.config import load_experiment
from scripts.fuzz import calls, pictures, texts, values
from scripts.fuzz.archives import (
    BEARINGS,
    MAP,
    MEASUREMENTS,
    ROUTE,
    ROUTE_MAP,
)
from scripts.fuzz.damage import Rng, require_one_line

HANGS_AFTER_S = 10
_WAITS_AFTER_S = 30  # by the clock: longer, since the machine may have other work


@dataclass(frozen=True)
class Kind:
    """A sort of input.

    Attributes:
        name: as for --kind.
        make: writes one case into a folder; where it is.
        read: what reads it.
        same: whether what was read equals the undamaged original; None where it need not.
    """

    name: str
    make: Callable[[Rng, Path], Any]
    read: Callable[[Any], Any]
    same: Callable[[Any], bool] | None = None


class Hang(BaseException):
    """A case took too long."""


KINDS = (
    Kind("configuration", texts.configuration, load_experiment),
    Kind("override", texts.override, lambda given: load_experiment(*given)),
    Kind("calibration", texts.calibration, lambda path: fg.load_rig(path)),
    Kind("log_bytes", MEASUREMENTS.of_damaged_bytes, MEASUREMENTS.load, MEASUREMENTS.is_same),
    Kind("log_values", MEASUREMENTS.of_odd_values, MEASUREMENTS.load),
    Kind("trajectory", texts.trajectory, fg.Trajectory.load),
    Kind("image", pictures.image, read_grey_image),
    Kind("png", pictures.png, read_grey_image, pictures.is_picture),
    Kind("recording", pictures.recording, pictures.read_recording),
    Kind("call", calls.call, calls.read_call),
    Kind("map_bytes", MAP.of_damaged_bytes, MAP.load, MAP.is_same),
    Kind("map_values", MAP.of_odd_values, MAP.load),
    Kind("bearing_bytes", BEARINGS.of_damaged_bytes, BEARINGS.load, BEARINGS.is_same),
    Kind("bearing_values", BEARINGS.of_odd_values, BEARINGS.load),
    Kind("odometry", texts.odometry_table, texts.read_odometry),
    Kind("omni_camera", texts.omni_camera, lambda path: fg.load_camera(path, (640, 480))),
    Kind("bag", pictures.bag, pictures.read_recording),
    Kind("film", pictures.film, pictures.read_recording),
    Kind("route_bytes", ROUTE.of_damaged_bytes, ROUTE.load, ROUTE.is_same),
    Kind("route_values", ROUTE.of_odd_values, ROUTE.load),
    Kind("joined_bytes", ROUTE_MAP.of_damaged_bytes, ROUTE_MAP.load, ROUTE_MAP.is_same),
    Kind("joined_values", ROUTE_MAP.of_odd_values, ROUTE_MAP.load),
    Kind("calibration_digit", values.calibration, values.read_calibration, values.is_as_written),
    Kind(
        "configuration_digit",
        values.configuration,
        values.read_configuration,
        values.is_as_written,
    ),
    Kind("library_call", calls.library_call, calls.read_library_call),
)


@contextmanager
def _time_limit() -> Iterator[None]:
    """Raises Hang after 10 s of processor time, of all threads together, or 30 s by the clock."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise Hang

    before = {n: signal.signal(n, stop) for n in (signal.SIGPROF, signal.SIGALRM)}
    signal.setitimer(signal.ITIMER_PROF, HANGS_AFTER_S)
    signal.alarm(_WAITS_AFTER_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.alarm(0)
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Linear algebra and OpenCV on one thread: the time limit counts the time of all threads."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with one_blas_thread():
            yield
    finally:
        cv2.setNumThreads(before)


def outcome(kind: Kind, seed: int) -> str:
    """What became of one case: `read`, `refused`, or a fault in words."""
    rng = np.random.default_rng([KINDS.index(kind), seed])
    with tempfile.TemporaryDirectory(prefix="fgslam-fuzz-") as scratch:
        given = kind.make(rng, Path(scratch))
        try:
            with _time_limit(), warnings.catch_warnings():
                warnings.simplefilter("error", RuntimeWarning)  # NumPy's, of what was let through
                found = kind.read(given)
        except FgslamError as error:
            try:
                require_one_line(error)
            except AssertionError as wrong:
                return str(wrong)
            return "refused"
        except Hang:
            return f"more than {HANGS_AFTER_S} s"
        except Exception as error:
            return f"{type(error).__name__}: {str(error)[:150]}"
        if kind.same is not None and not kind.same(found):
            return "other values without a word"
    return "read"


@_one_thread()
def faults(kind: Kind, seeds: range) -> tuple[Counter[str], list[str]]:
    """How many cases were read and refused, and a line for each fault."""
    counts: Counter[str] = Counter()
    lines = []
    for seed in seeds:
        how = outcome(kind, seed)
        counts[how if how in ("read", "refused") else "fault"] += 1
        if how not in ("read", "refused"):
            lines.append(f"{kind.name} {seed}: {how}")
    return counts, lines
