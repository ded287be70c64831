"""The lab at other sizes of the image: what detection costs, and what it gives."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from benchmarks.runs import (
    FoundFeatures,
    ate_m,
    described,
    experiment,
    make_system,
    process,
    say,
)
from benchmarks.tables import Cell, Table
from fgslam.core.log import ImageSequence
from fgslam.core.threads import one_blas_thread
from fgslam.core.types import Features
from fgslam.runs.config import ExperimentConfig
from fgslam.runs.opening import open_sequence
from fgslam.slam.build import make_extractor
from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.pipeline import FrameReport

WIDTHS = (320, 640, 1280, 1920)
FRAMES = 4


@dataclass(frozen=True, eq=False)
class Detected:
    """The features of a recording and the processor's seconds for them."""

    found: FoundFeatures
    seconds: float


def tables() -> list[Table]:
    """One row a width, images of 4 to 3."""
    return [sizes_table()]


@one_blas_thread()
def sizes_table(widths: Iterable[int] = WIDTHS, frames: int = FRAMES) -> Table:
    """Features, cost of a frame's detection and of all the rest, frames located and ATE."""
    rows = [_row(width, frames) for width in widths]
    columns = (
        "width", "located", "features an image", "stereo matches", "inliers",
        "SIFT ms a megapixel", "rest over SIFT", "ATE cm",
    )  # fmt: skip
    return Table(f"Sizes of the image, {frames} frames", columns, rows)


def _row(width: int, frames: int) -> tuple[Cell, ...]:
    say(f"driving with images {width} wide")
    size = (f"dataset.rig.width={width}", f"dataset.rig.height={width * 3 // 4}")
    config = experiment("lab_loop", [*size, f"dataset.stop={frames}"])
    sequence = open_sequence(config)
    detected = _detect(config, sequence)
    system = make_system(config, sequence)
    start = time.process_time()
    reports = list(process(detected.found, system))
    rest = time.process_time() - start
    pixels = sequence.rig.width * sequence.rig.height * sequence.rig.cameras * len(reports)
    ate = ate_m(system, sequence)
    counts = [len(image) for frame in detected.found.frames for image in frame.features]
    return (
        width,
        f"{1 + sum(report.tracking.status.measured for report in reports)} of {len(reports)}",
        float(np.median(counts)),
        float(np.median([len(report.stereo) for report in reports])),
        float(np.median([_inliers(report) for report in reports[1:]])),
        1e9 * detected.seconds / pixels,
        rest / detected.seconds,
        100.0 * ate,
    )


def _detect(config: ExperimentConfig, sequence: ImageSequence) -> Detected:
    """One image after the other, so that the thread's time is that of detection."""
    extract, frames, seconds = make_extractor(config.frontend), [], 0.0
    for i in range(len(sequence)):
        frame = sequence.frame(i)
        start = time.thread_time()
        found: list[Features] = [extract(image) for image in described(config, frame)]
        seconds += time.thread_time() - start
        frames.append(FeatureFrame(i, frame, tuple(found), "", 0.0, 0.0))
    return Detected(FoundFeatures(sequence, frames), seconds)


def _inliers(report: FrameReport) -> int:
    return int(report.tracking.inliers.sum())
