"""Both front-ends on recordings without a setting, as they are and made worse: error and cost."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeAlias

import cv2
import numpy as np

import fgslam as fg
from benchmarks.evidence.hybrid import KINDS
from benchmarks.evidence.street_world import RIG, Float32, Street
from benchmarks.runs import LOCATED, plain_sift, say
from benchmarks.tables import Cell, Table
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.correction import term_names
from fgslam.core.sensors import CameraRig
from fgslam.core.threads import one_blas_thread
from fgslam.core.types import Trajectory
from fgslam.evaluation.statistics import Alignment, evaluate_trajectory
from fgslam.frontend.settings import SiftSettings

_RAW_EVERY = 5  # frames between those on which SIFT alone is timed
_NOISE_LEVELS = 8.0
_DARK = 1.0 / 12.0
_DARK_LEVELS = 0.5  # sigma of the noise of dark images
_BLUR_PX = 2.0
_PERIOD_S = 0.1  # of the street's frames
_STREET_SEEDS = (0, 1)
LIGHTS = {
    "full": (1.0, 0.0),
    "noise of 8 grey levels": (1.0, 8.0),
    "a twelfth as bright": (1.0 / 12.0, 0.0),
}
"""Factor of the grey levels, and sigma of the noise."""
REAL_RIG = np.array(
    [
        0.02626304, 0.00086563, -0.0265722, -0.00072247, 0.00026369, -0.00073674, 0.00910446,
        0.00058046, 0.00123244, -0.00202068, -0.0003995, 0.0, 0.0, 0.00967301,
    ]
)  # fmt: skip
"""What self-calibration found on `kitti06`, its baseline as stated: off as real rigs are."""
RIGS = {"exact": np.zeros(len(term_names(RIG))), "off as kitti06's": REAL_RIG}

Change: TypeAlias = Callable[[Image, np.random.Generator], Image]
Shots: TypeAlias = list[tuple[float, tuple[Image, ...]]]
"""Time and images (left, right) of each frame."""


@dataclass(frozen=True)
class Course:
    """A recording, which of its frames, and what is done to their images."""

    name: str
    folder: str
    frames: slice = field(default_factory=lambda: slice(None))
    change: Change | None = None


def noisy(levels: float) -> Change:
    """Adds noise of that deviation."""
    return lambda image, rng: _grey_levels(image + levels * rng.normal(size=image.shape))


def _dark(image: Image, rng: np.random.Generator) -> Image:
    return _grey_levels(_DARK * image + _DARK_LEVELS * rng.normal(size=image.shape))


def blurred(image: Image, rng: np.random.Generator) -> Image:
    """By two pixels."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), _BLUR_PX), np.uint8)


def _grey_levels(values: FloatArray) -> Image:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


COURSES = (
    Course("`kitti06`", "kitti06"),
    Course("every second frame", "kitti06", slice(None, None, 2)),
    Course("every third", "kitti06", slice(None, None, 3)),
    Course("blurred (2 px)", "kitti06", change=blurred),
    Course("noise of 8 grey levels", "kitti06", change=noisy(_NOISE_LEVELS)),
    Course("a twelfth as bright", "kitti06", change=_dark),
    Course("`kitti_raw_0926`", "kitti_raw_0926_5hz"),
    Course("its frames 0-100", "kitti_raw_0926_5hz", slice(0, 100)),
    Course("25-125", "kitti_raw_0926_5hz", slice(25, 125)),
    Course("100-200", "kitti_raw_0926_5hz", slice(100, 200)),
    Course("`euroc_v101`", "euroc_v101_kf100"),
    Course("`euroc_v101_raw`", "euroc_v101_raw"),
    Course("`freiburg1`", "rgbd_fr1"),
)


def tables(data: Path) -> list[Table]:
    """ATE on the way and at the end, and CPU time, of both front-ends, without any setting."""
    rows = [_row(course.name, *_opened(course, data)) for course in COURSES]
    streets = [Street(seed) for seed in _STREET_SEEDS]
    for rig, correction in RIGS.items():
        for light in LIGHTS:
            for seed, street in zip(_STREET_SEEDS, streets, strict=True):
                frames = list(_taken(street.images(correction), seed, light))
                shots: Shots = [(k * _PERIOD_S, images) for k, images in enumerate(frames)]
                times = _PERIOD_S * np.arange(len(street.poses))
                truth = Trajectory(np.asarray(times, np.float64), street.poses)
                rows.append(_row(f"street {seed}, rig {rig}, {light}", RIG, shots, truth))
    columns = ("recording", *(f"{what}, {kind}" for what in _COLUMNS for kind in KINDS))
    return [Table("Without a setting", columns, rows)]


def _taken(clean: Float32, seed: int, light: str) -> Iterator[tuple[Image, Image]]:
    """Left and right image of each frame."""
    gain, sigma = LIGHTS[light]
    rng = np.random.default_rng([seed, 5])
    for pair in clean:
        levels = [gain * image + sigma * rng.normal(size=image.shape) for image in pair]
        right, left = (np.clip(np.round(one), 0, 255).astype(np.uint8) for one in levels)
        yield left, right


_COLUMNS = ("on the way", "at the end", "CPU", "not located")


def _opened(course: Course, data: Path) -> tuple[CameraRig, Shots, Trajectory]:
    recording = fg.open_recording(str(data / course.folder))
    shots: Shots = []
    every = list(enumerate(recording))[course.frames]
    for number, (t, images, _) in every:
        rng = np.random.default_rng([number, 7])
        change = course.change
        assert images is not None  # every frame of these recordings has its images
        shots.append((t, images if change is None else tuple(change(one, rng) for one in images)))
    assert recording.ground_truth is not None
    return recording.rig, shots, recording.ground_truth


def _row(name: str, rig: CameraRig, shots: Shots, truth: Trajectory) -> tuple[Cell, ...]:
    """Columns of :data:`_COLUMNS`, each for both kinds."""
    raw = _raw_seconds(shots)
    found = []
    for kind in KINDS:
        say(f"{name}: {kind}")
        found.append(_driven(kind, rig, shots, truth, raw))
    return (name, *(value for pair in zip(*found, strict=True) for value in pair))


@one_blas_thread()
def _driven(
    kind: Literal["sift", "hybrid"], rig: CameraRig, shots: Shots, truth: Trajectory, raw: float
) -> tuple[Cell, ...]:
    slam = fg.Slam(rig, frontend={"tracking": kind})
    start = time.process_time()
    steps = [slam.track(t, images) for t, images in shots]
    spent = time.process_time() - start
    result = slam.result()
    slam.close()
    live = Trajectory(np.array([t for t, _ in shots]), np.array([step.wTc for step in steps]))
    lost = len(shots) - sum(step.status in LOCATED for step in steps)
    cpu = spent / (raw * len(shots))
    return _ate_cm(live, truth), _ate_cm(result.trajectory, truth), round(cpu, 2), lost


def _ate_cm(found: Trajectory, truth: Trajectory) -> float:
    error = evaluate_trajectory(found, truth, Alignment.SE3).ate_rmse_m
    return round(100.0 * (np.nan if error is None else error), 2)


def _raw_seconds(shots: Shots) -> float:
    """CPU seconds a frame that OpenCV's SIFT takes for all its images."""
    alone = plain_sift(SiftSettings())
    start = time.process_time()
    some = shots[::_RAW_EVERY]
    for _, images in some:
        for image in images:
            alone.detectAndCompute(grey_of(image), None)
    return (time.process_time() - start) / len(some)


def grey_of(image: Image) -> Image:
    """An image without colour."""
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
