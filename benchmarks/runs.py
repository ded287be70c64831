"""Runs of the committed experiments, whole or with their features found only once."""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2

from fgslam.core.arrays import Image
from fgslam.core.log import Frame, ImageSequence
from fgslam.core.types import EgoMotionStatus, Trajectory
from fgslam.evaluation.statistics import evaluate_trajectory
from fgslam.frontend.features.sift import EDGE_THRESHOLD, OCTAVE_LAYERS
from fgslam.frontend.settings import FrontendSettings, SiftSettings
from fgslam.runs.config import ExperimentConfig, load_config
from fgslam.runs.engine import run_task
from fgslam.runs.opening import open_sequence
from fgslam.runs.slam_comparison import GROUND_TRUTH_FILE
from fgslam.runs.tasks.slam import SlamResult, open_slam
from fgslam.slam.build import make_pipeline, make_stream
from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.motion import body_motion
from fgslam.slam.pipeline import FrameReport, SlamPipeline
from scripts.convert import light_field

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
DATA = Path(__file__).parents[2] / "shared" / "data"
"""Where the real recordings are looked for, one folder beside the checkout."""

EVERY_FRAME = ("frontend.tracking=sift",)
"""Evidence on SIFT itself, and on landmarks that a miss in each frame judges."""

LOCATED = {EgoMotionStatus.FIRST, *(status for status in EgoMotionStatus if status.measured)}
"""How the pose of a frame is found where the map before it tells it."""

_FOLDERS = {
    "euroc_v101": "euroc_v101_kf100",
    "kitti_raw_0926": "kitti_raw_0926_5hz",
    "kitti06": "kitti06",
}
CHESS = "stanford_chess_grid"
_CONVERTED = EXPERIMENTS.parent / "build" / "recordings" / "chess_trinocular"
# Evidence needs neither pictures nor checkpoints.
_QUIET = ("output.pictures=false", "output.checkpoint_seconds=3600")


def experiment(name: str, overrides: Iterable[str] = (), data: Path = DATA) -> ExperimentConfig:
    """The committed experiment ``name`` with ``a.b=value`` overrides.

    Raises:
        ConfigError: there is no such experiment or key.
        DatasetError: its recording cannot be converted.
    """
    where = [f"dataset.path={data / _FOLDERS[name]}"] if name in _FOLDERS else []
    if name == "chess_trinocular":
        if not _CONVERTED.is_dir():
            light_field.convert(data / CHESS, _CONVERTED)
        where = [f"dataset.path={_CONVERTED}"]
    return load_config(EXPERIMENTS / f"{name}.yaml", [*where, *_QUIET, *overrides])


@dataclass(frozen=True, eq=False)
class Run:
    """A finished run: what it computed, and its metrics.json."""

    result: SlamResult
    metrics: dict[str, Any]

    @property
    def estimator(self) -> dict[str, Any]:
        """Metrics of the live estimator."""
        found: dict[str, Any] = self.metrics["estimators"][self.result.outputs.title]
        return found

    @property
    def tracked(self) -> int:
        """Frames whose pose the landmarks determined, the first (the origin) among them."""
        counts = self.metrics["status_counts"]
        return sum(counts.get(status, 0) for status in ("first", "ok", "capped"))


def run_whole(config: ExperimentConfig) -> Run:
    """Exactly what `fgslam run` does, into a folder that is thrown away afterwards."""
    say(f"running {config.name} (seed {config.seed})")
    with tempfile.TemporaryDirectory() as folder:
        result = run_task(open_slam, config, Path(folder) / "run")
        text = (result.folder / "metrics.json").read_text(encoding="utf-8")
    return Run(result, json.loads(text))


@dataclass(frozen=True, eq=False)
class FoundFeatures:
    """A recording with the features of all its frames, to be used by many variants."""

    sequence: ImageSequence
    frames: list[FeatureFrame]

    def whole(self, frame: FeatureFrame) -> FeatureFrame:
        """A frame with the features of all its images that are asked for them."""
        return frame if frame.frame is None else self.frames[frame.i]

    def reference(self, frame: FeatureFrame) -> FeatureFrame:
        """A frame with the features of its reference image alone."""
        known = self.whole(frame)
        return replace(known, features=known.features[:1])


def find_features(config: ExperimentConfig) -> FoundFeatures:
    """Opens the recording and finds the features of all frames."""
    say(f"finding the features of {config.name} (seed {config.seed})")
    return found_features(open_sequence(config), config.frontend)


def found_features(sequence: ImageSequence, settings: FrontendSettings) -> FoundFeatures:
    """Features of all frames of a recording."""
    stream = make_stream(sequence, settings)()
    try:
        return FoundFeatures(sequence, list(stream))
    finally:
        stream.close()


def plain_sift(settings: SiftSettings) -> cv2.Feature2D:
    """OpenCV's own SIFT with the front-end's settings: what costs are compared with."""
    return cv2.SIFT.create(
        settings.max_features, OCTAVE_LAYERS, settings.contrast_threshold, EDGE_THRESHOLD,
        settings.base_sigma_px, cv2.CV_8U, True,
    )  # fmt: skip


def described(config: ExperimentConfig, frame: Frame) -> tuple[Image, ...]:
    """The images of a frame that the run finds features in."""
    images = frame.images
    return images[:1] if config.frontend.stereo.by_patches(len(images)) else images


def make_system(config: ExperimentConfig, sequence: ImageSequence) -> SlamPipeline:
    """A fresh system for the sequence."""
    return make_pipeline(sequence.rig, config.frontend, config.odometry, config.estimator)


def process(found: FoundFeatures, pipeline: SlamPipeline) -> Iterator[FrameReport]:
    """The SLAM loop over features found before; it is given those that a run would find."""
    pipeline.describe, pipeline.describe_reference = found.whole, found.reference
    for whole in found.frames:
        frame = replace(whole, features=())
        timestamp = float(found.sequence.timestamps[frame.i])
        body = body_motion(found.sequence, frame.i, pipeline.motion)
        yield pipeline.process(frame, frame.i, timestamp, body)


def ate_m(pipeline: SlamPipeline, sequence: ImageSequence) -> float:
    """ATE of the system's trajectory so far, as a run of it would state it; NaN without a truth."""
    if sequence.ground_truth is None:
        return float("nan")
    with tempfile.TemporaryDirectory() as folder:  # a run's truth has the digits of its file
        path = Path(folder) / GROUND_TRUTH_FILE
        frame, rig = sequence.truth_frame, sequence.rig
        sequence.ground_truth.of(frame, rig).save(path)
        estimate = pipeline.estimate().trajectory.of(frame, rig)
        found = evaluate_trajectory(estimate, Trajectory.load(path))
    return float("nan") if found.ate_rmse_m is None else found.ate_rmse_m


def say(text: str) -> None:
    """Progress, on standard error, so that tables alone go to standard output."""
    sys.stderr.write(text + "\n")
    sys.stderr.flush()
