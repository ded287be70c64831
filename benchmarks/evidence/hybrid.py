"""SIFT on every frame beside SIFT on key frames: CPU time over that of SIFT alone, and error."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np

from benchmarks.runs import LOCATED, described, experiment, make_system, plain_sift, say
from benchmarks.tables import Cell, Table
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.log import ImageSequence
from fgslam.core.threads import one_blas_thread
from fgslam.evaluation.statistics import Alignment, evaluate_trajectory
from fgslam.runs.config import ExperimentConfig
from fgslam.runs.opening import open_sequence
from fgslam.slam.build import make_extractor
from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.motion import body_motion
from fgslam.slam.pipeline import FrameReport

T = TypeVar("T")
RECORDINGS = ("lab_loop", "kitti06", "kitti_raw_0926", "euroc_v101")
ESTIMATORS = ("landmark_kalman", "isam2")
KINDS: tuple[Literal["sift", "hybrid"], ...] = ("sift", "hybrid")
_RAW_EVERY = 4  # frames between those on which SIFT alone is timed, right beside the extractor


def tables(data: Path, names: tuple[str, ...] = RECORDINGS) -> list[Table]:
    """One row a recording, front-end and estimator."""
    rows: list[tuple[Cell, ...]] = []
    for name in names:
        config = experiment(name, data=data)
        found = find(config)
        for estimator in ESTIMATORS:
            for kind in KINDS:
                say(f"{name}: {kind}, {estimator}")
                rows.append((name, estimator, kind, *_row(config, found, estimator, kind)))
    columns = (
        "recording", "estimator", "front-end", "key frames", "located", "ATE cm", "CPU",
        "CPU with the final estimate",
    )  # fmt: skip
    return [Table("CPU time of a frame over that of SIFT alone", columns, rows)]


@dataclass(frozen=True, eq=False)
class Found:
    """A recording's features and what they cost.

    Attributes:
        sequence: the recording.
        frames: with features of all images that are asked for them.
        seconds: (n, cameras) of CPU that the extractor took for each image.
        raw: seconds of CPU a frame that OpenCV's SIFT takes for all its images.
    """

    sequence: ImageSequence
    frames: list[FeatureFrame]
    seconds: FloatArray
    raw: float


def find(config: ExperimentConfig) -> Found:
    """Features of all frames, and CPU times of finding them, of SIFT alone among them."""
    say(f"finding the features of {config.name}")
    sequence, extract = open_sequence(config), make_extractor(config.frontend)
    alone = plain_sift(config.frontend.sift)
    frames, seconds, raw = [], [], []
    for i in range(len(sequence)):
        frame = sequence.frame(i)
        each = [_timed(extract, (image,)) for image in described(config, frame)]
        features = tuple(found[0] for found, _ in each)
        frames.append(FeatureFrame(i, frame, features, "", 0.0, 0.0))
        seconds.append([spent for _, spent in each])
        if i % _RAW_EVERY == 0:
            raw.append(_timed(lambda image: alone.detectAndCompute(image, None), frame.images)[1])
    return Found(sequence, frames, np.array(seconds), float(np.mean(raw)))


def _timed(work: Callable[[Image], T], images: tuple[Image, ...]) -> tuple[tuple[T, ...], float]:
    """What comes of each image, and seconds of CPU for all."""
    start = time.process_time()
    results = tuple(map(work, images))
    return results, time.process_time() - start


@one_blas_thread()
def _row(
    config: ExperimentConfig, found: Found, estimator: str, kind: Literal["sift", "hybrid"]
) -> tuple[Cell, ...]:
    """Share of key frames, share located, ATE, CPU a frame and with the final estimate."""
    frontend = replace(config.frontend, tracking=kind)
    kind_of = {"kind": estimator}
    config = type(config).model_validate(config.as_values() | {"estimator": kind_of})
    config = config.model_copy(update={"frontend": frontend})
    pipeline = make_system(config, found.sequence)
    reports: list[FrameReport] = []
    start = time.process_time()
    for frame in found.frames:
        t = float(found.sequence.timestamps[frame.i])
        pipeline.describe = lambda _, seen=frame: seen
        pipeline.describe_reference = lambda _, seen=frame: replace(
            seen, features=seen.features[:1]
        )
        images_only = frame if kind == "sift" else replace(frame, features=())
        body = body_motion(found.sequence, frame.i, pipeline.motion)
        reports.append(pipeline.process(images_only, frame.i, t, body))
    loop = time.process_time() - start
    estimate = pipeline.estimator.estimate().trajectory
    final = time.process_time() - start - loop
    described = [len(r.found.features) for r in reports]
    keys = np.array(described) > 0
    spent = loop + sum(
        float(own[:images].sum()) for own, images in zip(found.seconds, described, strict=True)
    )
    located = np.mean([r.tracking.status in LOCATED for r in reports])
    error = evaluate_trajectory(estimate, found.sequence.ground_truth, Alignment.SE3)
    ate_cm = 100.0 * (error.ate_rmse_m or np.nan)
    every = found.raw * len(reports)
    return (
        round(float(keys.mean()), 2), round(float(located), 2), round(ate_cm, 2),
        round(spent / every, 2), round((spent + final) / every, 2),
    )  # fmt: skip
