"""Time of the whole system over images as ratios to raw SIFT on the same images.

The drive goes round and round the rendered lab, so that the map saturates. It is cut into blocks.
On each block raw SIFT is timed on the block's images in the best threading found, then the block
goes through the system: whole (features found ahead, in threads, beside the loop) and with its
features found beforehand (all that is not SIFT), in turn. Neighbours in time are compared, so
that what else a shared machine does cancels; medians over the blocks are quoted.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, cast

import cv2

from benchmarks.runs import EXPERIMENTS, plain_sift
from benchmarks.speed.blocks import Memory
from fgslam.cli.console import progress_bar
from fgslam.core.arrays import Image
from fgslam.core.errors import ConfigError
from fgslam.core.log import Frame, ImageSequence, MeasurementLog
from fgslam.runs.config import ExperimentConfig, load_config
from fgslam.runs.opening import open_sequence
from fgslam.slam.build import make_pipeline, make_stream
from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.motion import body_motion, description_of
from fgslam.slam.results import RunRecorder

BLOCK = 40
LEAST = 3 * BLOCK + 1
"""Frames that fill four blocks: two of either kind, the first of which warms up."""

LIMITS = {
    "whole_loop_over_sift": 1.3,
    "all_but_sift_over_sift": 0.2,
    "time_last_fifth_over_first": 1.2,
    "memory_without_log_end_over_middle": 1.1,
}


class Preloaded:
    """A block of a recording with its images in memory, so that no reading is timed."""

    def __init__(self, whole: ImageSequence, frames: dict[int, Frame]) -> None:
        self.whole, self.frames = whole, frames

    def __len__(self) -> int:
        return max(self.frames) + 1

    def frame(self, i: int) -> Frame:
        """Frame ``i``, from memory."""
        return self.frames[i]

    def __getattr__(self, name: str) -> Any:
        return getattr(self.whole, name)


@dataclass
class Series:
    """Milliseconds a frame of blocks of one kind, and their ratios to the raw SIFT around them."""

    ms: list[float] = field(default_factory=list)
    ratio: list[float] = field(default_factory=list)

    def settled(self) -> float:
        """Median ratio of the second half."""
        return statistics.median(self.ratio[len(self.ratio) // 2 :])


def timed(work: Callable[..., object], *arguments: object) -> float:
    """Seconds that the work takes."""
    start = time.perf_counter()
    work(*arguments)
    return time.perf_counter() - start


def raw_sift(config: ExperimentConfig) -> list[Callable[[Iterable[Frame]], None]]:
    """Ways to run `cv2.SIFT` over frames: OpenCV's threads, a pool an image, a pool over all."""
    sift = plain_sift(config.frontend.sift)

    def one(image: Image) -> None:
        sift.detectAndCompute(image, None)

    def own_threads(frames: Iterable[Frame]) -> None:
        cv2.setNumThreads(-1)
        for frame in frames:
            for image in frame.images:
                one(image)
        cv2.setNumThreads(1)

    def pool(workers: int) -> Callable[[Iterable[Frame]], None]:
        def work(frames: Iterable[Frame]) -> None:
            cv2.setNumThreads(1)
            with ThreadPoolExecutor(workers) as executor:
                list(executor.map(one, [image for f in frames for image in f.images]))

        return work

    return [own_threads, pool(2), pool(3), pool(4)]


@dataclass
class Measured:
    """The whole drive, block by block: whole and rest in turns, raw SIFT around each."""

    whole: Series = field(default_factory=Series)
    rest: Series = field(default_factory=Series)
    sift_ms: list[float] = field(default_factory=list)
    memory: Memory = field(default_factory=Memory)
    landmarks: int = 0

    def ratios(self) -> dict[str, float]:
        """The flat map of bench.json."""
        ratio = self.rest.ratio
        fifth = max(1, len(ratio) // 5)
        # The first block finds an empty map and loads libraries; it would flatter the growth.
        first = statistics.median(ratio[1 : 1 + fifth])
        process, log = self.memory.process_mb, self.memory.log_mb
        half = len(process) // 2
        flat = [total - part for total, part in zip(process, log, strict=True)]
        return {
            "whole_loop_over_sift": self.whole.settled(),
            "all_but_sift_over_sift": self.rest.settled(),
            "time_last_fifth_over_first": statistics.median(ratio[-fifth:]) / first,
            "memory_end_over_middle": process[-1] / process[half],
            "memory_without_log_end_over_middle": flat[-1] / flat[half],
            "log_mb_per_1000_frames": 1e3 * log[-1] / (len(log) * BLOCK),
            "frames_per_second": 1e3 / statistics.median(self.whole.ms),
            "sift_ms_per_frame": statistics.median(self.sift_ms),
            "all_but_sift_ms_per_frame": statistics.median(self.rest.ms),
            "whole_loop_ms_per_frame": statistics.median(self.whole.ms),
            "landmarks_at_the_end": float(self.landmarks),
        }


def run_blocks(
    config: ExperimentConfig, sequence: ImageSequence, tell: Callable[[int], None]
) -> Measured:
    """Times every block of the drive."""
    pipeline = make_pipeline(sequence.rig, config.frontend, config.odometry, config.estimator)
    recorder = RunRecorder(MeasurementLog(sequence.rig, description_of(pipeline.motion)))
    ways, out = raw_sift(config), Measured()
    for number, start in enumerate(range(0, len(sequence), BLOCK)):
        stop, whole = min(start + BLOCK, len(sequence)), number % 2 == 0
        frames = {i: sequence.frame(i) for i in range(start, stop)}
        images = list(frames.values())
        if number == 0:  # the fastest way to run SIFT, twice measured
            ways = sorted(ways, key=lambda way: min(timed(way, images) for _ in range(2)))
        before = timed(ways[0], images)
        block = cast(ImageSequence, Preloaded(sequence, frames))
        stream = make_stream(block, config.frontend)(start=start)
        found: Iterable[FeatureFrame] = stream if whole else list(stream)

        def work(found: Iterable[FeatureFrame] = found) -> None:
            for frame in found:
                body = body_motion(sequence, frame.i, pipeline.motion)
                stamp = float(sequence.timestamps[frame.i])
                report = pipeline.process(frame, frame.i, stamp, body)
                recorder.add(report, 0.0, float("nan"))

        series, ms = out.whole if whole else out.rest, 1e3 * timed(work) / len(frames)
        out.sift_ms.append(1e3 * 0.5 * (before + timed(ways[0], images)) / len(frames))
        series.ms.append(ms)
        series.ratio.append(ms / out.sift_ms[-1])
        out.memory.book(recorder.log)
        tell(stop)
    out.landmarks = len(pipeline.tracker.database)
    return out


def over_images(frames: int) -> dict[str, float]:
    """The whole system over images, beside raw SIFT.

    Raises:
        ConfigError: there are too few frames to compare early blocks with late ones.
    """
    if frames < LEAST:
        raise ConfigError(
            f"{frames} frames over images are too few to compare; give {LEAST} or more"
        )
    config = load_config(EXPERIMENTS / "lab_laps.yaml", [f"dataset.stop={frames}"])
    with progress_bar() as tell:
        sequence = open_sequence(config, tell)
        found = run_blocks(config, sequence, lambda done: tell("timing", done, len(sequence)))
    return found.ratios()
