"""Speed as ratios within one run: `make bench` prints a table and writes bench.json.

Four parts: the whole system over images, here; the estimators over simulated measurements, in
`estimators.py` and `long_drive.py`; growth with the map, in `maps.py` and `relocalising.py`; visual
homing, in `homing.py`. `--part` runs one of them.

The drive goes round and round the rendered lab, so that the map saturates. It is cut into blocks.
On each block raw SIFT is timed on the block's images in the best threading found, then the block
goes through the system: whole (features found ahead, in threads, beside the loop) and with its
features found beforehand (all that is not SIFT), in turn. Neighbours in time are compared, so
that a shared machine's moods cancel; medians over the blocks are quoted.
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from fgslam.cli.console import progress_bar
from fgslam.core.arrays import FloatArray
from fgslam.core.estimates import Trajectory
from fgslam.core.measurement_log import MeasurementLog
from fgslam.core.measurements import Odometry
from fgslam.core.recordings import Frame, Sequence
from fgslam.core.sensors import CameraRig
from fgslam.core.threads import one_blas_thread
from fgslam.runs.config import ExperimentConfig, load_config
from fgslam.runs.opening import open_sequence
from fgslam.runs.recorder import RunRecorder
from fgslam.slam.factory import make_pipeline, make_stream
from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.pipeline import SlamPipeline
from tests.benchmark import estimators, homing, long_drive, maps, relocalising
from tests.benchmark.drives import open_drive

BLOCK = 40
LIMITS = {
    "whole_loop_over_sift": 1.3,
    "all_but_sift_over_sift": 0.2,
    "time_last_fifth_over_first": 1.2,
    "memory_without_log_end_over_middle": 1.1,
}
EVERY_LIMIT = (
    LIMITS
    | estimators.LIMITS
    | long_drive.LIMITS
    | homing.LIMITS
    | maps.LIMITS
    | relocalising.LIMITS
)


@dataclass(frozen=True)
class Preloaded:
    """A block of a sequence with its images in memory, so that no reading is timed."""

    whole: Sequence
    frames: dict[int, Frame]

    @property
    def name(self) -> str:
        return self.whole.name

    @property
    def rig(self) -> CameraRig:
        return self.whole.rig

    @property
    def timestamps(self) -> FloatArray:
        return self.whole.timestamps

    @property
    def identity(self) -> str:
        return self.whole.identity

    @property
    def ground_truth(self) -> Trajectory | None:
        return self.whole.ground_truth

    @property
    def notes(self) -> tuple[str, ...]:
        return self.whole.notes

    def __len__(self) -> int:
        return max(self.frames) + 1

    def frame(self, i: int) -> Frame:
        return self.frames[i]

    def odometry(self, i: int) -> Odometry | None:
        return self.whole.odometry(i)


@dataclass
class Series:
    """Milliseconds a frame, block by block."""

    sift: list[float] = field(default_factory=list)
    whole: list[float] = field(default_factory=list)
    rest: list[float] = field(default_factory=list)
    whole_ratio: list[float] = field(default_factory=list)
    rest_ratio: list[float] = field(default_factory=list)
    memory_mb: list[float] = field(default_factory=list)
    log_mb: list[float] = field(default_factory=list)


def timed(work: Callable[..., object], *arguments: object) -> float:
    """Seconds that the work takes."""
    start = time.perf_counter()
    work(*arguments)
    return time.perf_counter() - start


def raw_sift(config: ExperimentConfig) -> list[Callable[[Iterable[Frame]], None]]:
    """Ways to run `cv2.SIFT` over frames: OpenCV's threads, a pool an image, a pool over all."""
    s = config.frontend.sift
    sift = cv2.SIFT.create(
        s.max_features,
        s.octave_layers,
        s.contrast_threshold,
        s.edge_threshold,
        s.base_sigma_px,
        cv2.CV_8U,
        True,
    )

    def one(image: object) -> None:
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
    config: ExperimentConfig, sequence: Sequence, tell: Callable[[int], None]
) -> tuple[Series, int]:
    """The whole drive, block by block; and how many landmarks the map had at its end."""
    pipeline = make_pipeline(sequence, config.frontend, config.odometry, config.estimator)
    recorder = RunRecorder(MeasurementLog(sequence.rig, pipeline.motion.description()))
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
        series.memory_mb.append(resident_mb())
        series.log_mb.append(log_mb(recorder.log))
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
            report = pipeline.process(frame, frame.i, float(block.timestamps[frame.i]))
            recorder.add(report, 0.0, float("nan"))

    (series.whole if whole else series.rest).append(1e3 * timed(work) / len(block.frames))


def book(series: Series, sift_ms: float, whole: bool) -> None:
    """Ratio of the block just timed to the raw SIFT around it."""
    series.sift.append(sift_ms)
    last, ratios = (
        (series.whole[-1], series.whole_ratio) if whole else (series.rest[-1], series.rest_ratio)
    )
    ratios.append(last / sift_ms)


def resident_mb() -> float:
    """Resident memory now, mebibytes."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def log_mb(log: MeasurementLog) -> float:
    """Size of the measurement log, which grows with the drive by design, mebibytes."""
    arrays = [
        value
        for increment in log
        for part in (increment, increment.observations, increment.odometry)
        if part is not None
        for name in part.__dataclass_fields__
        if isinstance(value := getattr(part, name), np.ndarray)
    ]
    return sum(array.nbytes for array in arrays) / 2**20


def ratios_of(series: Series) -> dict[str, float]:
    """The flat map of bench.json."""
    fifth = max(1, len(series.rest_ratio) // 5)
    # The first block finds an empty map and loads libraries; it would flatter the growth.
    first = statistics.median(series.rest_ratio[1 : 1 + fifth])
    last = statistics.median(series.rest_ratio[-fifth:])
    half = len(series.memory_mb) // 2
    flat = [total - log for total, log in zip(series.memory_mb, series.log_mb, strict=True)]
    tail = series.whole_ratio[len(series.whole_ratio) // 2 :]
    return {
        "whole_loop_over_sift": statistics.median(tail),
        "all_but_sift_over_sift": statistics.median(
            series.rest_ratio[len(series.rest_ratio) // 2 :]
        ),
        "time_last_fifth_over_first": last / first,
        "memory_end_over_middle": series.memory_mb[-1] / series.memory_mb[half],
        "memory_without_log_end_over_middle": flat[-1] / flat[half],
        "log_mb_per_1000_frames": 1e3 * series.log_mb[-1] / (len(series.log_mb) * BLOCK),
        "frames_per_second": 1e3 / statistics.median(series.whole),
        "sift_ms_per_frame": statistics.median(series.sift),
        "all_but_sift_ms_per_frame": statistics.median(series.rest),
        "whole_loop_ms_per_frame": statistics.median(series.whole),
    }


def over_images(frames: int) -> dict[str, float]:
    """The whole system over images, beside raw SIFT."""
    config = load_config(Path("experiments/lab_laps.yaml"), [f"dataset.stop={frames}"])
    with progress_bar() as tell:
        sequence = open_sequence(config, lambda done, total: tell("rendering", done, total))
        series, landmarks = run_blocks(
            config, sequence, lambda done: tell("timing", done, len(sequence))
        )
    return ratios_of(series) | {"landmarks_at_the_end": float(landmarks)}


@one_blas_thread()
def over_measurements() -> dict[str, float]:
    """The estimators on simulated measurements."""
    found = estimators.ratios_of_estimators()
    return found | long_drive.without_batch(open_drive("long_drive"))


def show(ratios: dict[str, float]) -> None:
    """The table."""
    table = Table(title="speed")
    for column in ("ratio", "measured", "at most"):
        table.add_column(column)
    for name, value in ratios.items():
        limit = EVERY_LIMIT.get(name)
        shown = f"{value:.3f}" if value == 0.0 or abs(value) >= 1e-3 else f"{value:.1e}"
        table.add_row(name, shown, "" if limit is None else f"{limit:g}")
    Console().print(table)


def main() -> None:
    """Runs what is asked for and writes bench.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=2000, help="length of the drive over images")
    parts = ("all", "images", "estimators", "maps", "homing")
    parser.add_argument("--part", choices=parts, default="all")
    parser.add_argument("--out", type=Path, default=Path("bench.json"))
    arguments = parser.parse_args()
    ratios: dict[str, float] = {}
    if arguments.part in ("all", "images"):
        ratios |= over_images(arguments.frames)
    if arguments.part in ("all", "estimators"):
        ratios |= over_measurements()
    if arguments.part in ("all", "maps"):
        ratios |= maps.ratios_of_maps() | relocalising.ratios_of_relocalising()
    if arguments.part in ("all", "homing"):
        ratios |= homing.ratios_of_homing()
    arguments.out.write_text(json.dumps(ratios, indent=2) + "\n")
    show(ratios)


if __name__ == "__main__":
    main()
