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

import cv2

from benchmarks.runs import EXPERIMENTS, plain_sift
from benchmarks.speed.blocks import Memory
from fgslam.cli.console import progress_bar
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import ConfigError
from fgslam.core.log import Frame, ImageSequence, MeasurementLog
from fgslam.core.sensors import CameraRig, Odometry
from fgslam.core.types import Trajectory
from fgslam.runs.config import ExperimentConfig, load_config
from fgslam.runs.opening import open_sequence
from fgslam.slam.build import make_pipeline, make_stream
from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.motion import body_motion, description_of
from fgslam.slam.pipeline import SlamPipeline
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


@dataclass(frozen=True)
class Preloaded:
    """A block of a sequence with its images in memory, so that no reading is timed."""

    whole: ImageSequence
    frames: dict[int, Frame]

    @property
    def name(self) -> str:
        """Name of the whole recording."""
        return self.whole.name

    @property
    def rig(self) -> CameraRig:
        """Rig of the whole recording."""
        return self.whole.rig

    @property
    def timestamps(self) -> FloatArray:
        """Times (n,) of the whole recording, seconds."""
        return self.whole.timestamps

    @property
    def identity(self) -> str:
        """Identity of the whole recording."""
        return self.whole.identity

    @property
    def ground_truth(self) -> Trajectory | None:
        """Truth of the whole recording."""
        return self.whole.ground_truth

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks of the whole recording."""
        return self.whole.notes

    def __len__(self) -> int:
        return max(self.frames) + 1

    def frame(self, i: int) -> Frame:
        """Frame ``i``, from memory."""
        return self.frames[i]

    def odometry(self, i: int) -> Odometry | None:
        """Odometry of frame ``i``."""
        return self.whole.odometry(i)


@dataclass
class Series:
    """Milliseconds a frame, block by block."""

    sift: list[float] = field(default_factory=list)
    whole: list[float] = field(default_factory=list)
    rest: list[float] = field(default_factory=list)
    whole_ratio: list[float] = field(default_factory=list)
    rest_ratio: list[float] = field(default_factory=list)
    memory: Memory = field(default_factory=Memory)


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


def best_of(ways: list[Callable[[Iterable[Frame]], None]], frames: list[Frame]) -> int:
    """Index of the fastest way on these frames, twice measured."""
    times = [min(timed(way, frames) for _ in range(2)) for way in ways]
    return times.index(min(times))


def run_blocks(
    config: ExperimentConfig, sequence: ImageSequence, tell: Callable[[int], None]
) -> tuple[Series, int]:
    """The whole drive, block by block; and how many landmarks the map had at its end."""
    pipeline = make_pipeline(sequence.rig, config.frontend, config.odometry, config.estimator)
    recorder = RunRecorder(MeasurementLog(sequence.rig, description_of(pipeline.motion)))
    ways = raw_sift(config)
    way, series = None, Series()
    for number, start in enumerate(range(0, len(sequence), BLOCK)):
        stop = min(start + BLOCK, len(sequence))
        frames = {i: sequence.frame(i) for i in range(start, stop)}
        images = list(frames.values())
        way = ways[best_of(ways, images)] if way is None else way
        before = timed(way, images)
        block = Preloaded(sequence, frames)
        through_system(config, pipeline, recorder, (block, start, number % 2 == 0), series)
        sift = 0.5 * (before + timed(way, images))
        book(series, 1e3 * sift / len(frames), whole=number % 2 == 0)
        series.memory.book(recorder.log)
        tell(stop)
    return series, len(pipeline.tracker.database)


def through_system(
    config: ExperimentConfig,
    pipeline: SlamPipeline,
    recorder: RunRecorder,
    what: tuple[Preloaded, int, bool],
    series: Series,
) -> None:
    """One block: whole, or with its features found before the clock starts."""
    block, start, whole = what
    stream = make_stream(block, config.frontend)(start=start)
    found: Iterable[FeatureFrame] = stream if whole else list(stream)

    def work() -> None:
        for frame in found:
            body = body_motion(block, frame.i, pipeline.motion)
            report = pipeline.process(frame, frame.i, float(block.timestamps[frame.i]), body)
            recorder.add(report, 0.0, float("nan"))

    (series.whole if whole else series.rest).append(1e3 * timed(work) / len(block.frames))


def book(series: Series, sift_ms: float, whole: bool) -> None:
    """Ratio of the block just timed to the raw SIFT around it."""
    series.sift.append(sift_ms)
    last, ratios = (
        (series.whole[-1], series.whole_ratio) if whole else (series.rest[-1], series.rest_ratio)
    )
    ratios.append(last / sift_ms)


def ratios_of(series: Series) -> dict[str, float]:
    """The flat map of bench.json."""
    fifth = max(1, len(series.rest_ratio) // 5)
    # The first block finds an empty map and loads libraries; it would flatter the growth.
    first = statistics.median(series.rest_ratio[1 : 1 + fifth])
    last = statistics.median(series.rest_ratio[-fifth:])
    process, log = series.memory.process_mb, series.memory.log_mb
    half = len(process) // 2
    flat = [total - part for total, part in zip(process, log, strict=True)]
    tail = series.whole_ratio[len(series.whole_ratio) // 2 :]
    return {
        "whole_loop_over_sift": statistics.median(tail),
        "all_but_sift_over_sift": statistics.median(
            series.rest_ratio[len(series.rest_ratio) // 2 :]
        ),
        "time_last_fifth_over_first": last / first,
        "memory_end_over_middle": process[-1] / process[half],
        "memory_without_log_end_over_middle": flat[-1] / flat[half],
        "log_mb_per_1000_frames": 1e3 * log[-1] / (len(log) * BLOCK),
        "frames_per_second": 1e3 / statistics.median(series.whole),
        "sift_ms_per_frame": statistics.median(series.sift),
        "all_but_sift_ms_per_frame": statistics.median(series.rest),
        "whole_loop_ms_per_frame": statistics.median(series.whole),
    }


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
        sequence = open_sequence(config, lambda done, total: tell("rendering", done, total))
        series, landmarks = run_blocks(
            config, sequence, lambda done: tell("timing", done, len(sequence))
        )
    return ratios_of(series) | {"landmarks_at_the_end": float(landmarks)}
