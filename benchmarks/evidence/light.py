"""The lab in other light, and SIFT without its doubled first octave: what detection loses."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks.runs import (
    LOCATED,
    FoundFeatures,
    ate_m,
    experiment,
    find_features,
    make_system,
    process,
    say,
)
from benchmarks.tables import Cell, Table
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.log import Frame, ImageSequence
from fgslam.core.types import Features
from fgslam.runs.config import ExperimentConfig
from fgslam.runs.opening import open_sequence
from fgslam.slam.build import make_extractor
from fgslam.slam.feature_stream import FeatureExtractor, FrameDescriber

_READING = 0.3
_SHOT = 0.0216
"""Variance a grey level: with that of reading 1.5 at grey 100, the lab's own noise in its light."""

_FRAMES = 100
_CORNER = 0.25
"""Of the light in the middle: the fourth power of the cosine of 45 degrees."""


@dataclass(frozen=True)
class Light:
    """A gain of the rendered grey values, before the camera's noise and rounding."""

    name: str
    gain: float
    vignette: bool = False
    fog: bool = False

    def on(self, image: Image, seed: tuple[int, ...]) -> Image:
        """The image (height, width) as a camera with shot noise delivers it."""
        grey = self.gain * image.astype(np.float64)
        if self.vignette:
            grey *= _vignette(image.shape)
        if self.fog:
            grey += (1.0 - self.gain) * 128.0
        sigma = np.sqrt(_READING**2 + _SHOT * grey)
        noise = sigma * np.random.default_rng(seed).standard_normal(grey.shape)
        return np.asarray(np.clip(np.rint(grey + noise), 0, 255), np.uint8)


LIGHTS = (
    Light("1/20", 1 / 20),
    Light("1/8", 1 / 8),
    Light("1/4", 1 / 4),
    Light("1", 1.0),
    Light("2", 2.0),
    Light("4", 4.0),
    Light("1, corners 1/4", 1.0, vignette=True),
    Light("fog, contrast 1/10", 0.1, fog=True),
)


def tables(data: Path) -> list[Table]:
    """The drive in each light, detection relative and absolute; each recording without doubling."""
    return [light_table(), doubling_table(data)]


def light_table(lights: Iterable[Light] = LIGHTS, frames: int = _FRAMES) -> Table:
    """One row a light and way of detection."""
    rows: list[tuple[Cell, ...]] = []
    for light in lights:
        for contrast in ("absolute", "relative"):
            say(f"driving in light {light.name}, contrast {contrast}")
            config = experiment("lab_loop", _dark(contrast, frames))
            sequence = open_sequence(config)
            drawn = [_lit(sequence.frame(i), light, config.seed) for i in range(len(sequence))]
            found = _found(sequence, drawn, make_extractor(config.frontend))
            rows.append((light.name, contrast, *_row(config, found)))
    columns = ("light", "contrast", "located", "features", "matches", "ATE cm")
    return Table(f"Light of the lab, {frames} frames", columns, rows)


def _dark(contrast: str, frames: int) -> list[str]:
    off = ("dataset.effects.noise_grey=0.0", f"dataset.stop={frames}")
    return [*off, f"frontend.sift.contrast={contrast}"]


def doubling_table(data: Path) -> Table:
    """One row a recording, with and without the doubled first octave."""
    rows: list[tuple[Cell, ...]] = []
    for name in ("lab_loop", "kitti06", "euroc_v101", "chess_trinocular"):
        config = experiment(name, data=data)
        whole = find_features(config)
        drawn = [found.frame for found in whole.frames if found.frame is not None]
        extract = make_extractor(config.frontend)
        seconds = _seconds(extract, drawn[0].images)
        rows.append((name, "yes", *_row(config, whole), 1.0))
        half = Undoubled(extract)
        ratio = _seconds(half, drawn[0].images) / seconds
        found = _found(whole.sequence, drawn, half)
        rows.append((name, "no", *_row(config, found), ratio))
    columns = ("recording", "doubled", "located", "features", "matches", "ATE cm", "CPU")
    return Table("SIFT without the doubled first octave", columns, rows)


@dataclass(frozen=True)
class Undoubled:
    """Features that begin at the image's own size: OpenCV always doubles, so it gets a half."""

    extract: FeatureExtractor

    def __call__(self, image: Image) -> Features:
        """Features of a grey image, in its own pixels."""
        height, width = image.shape[0] // 2, image.shape[1] // 2
        even = image[: 2 * height, : 2 * width]
        small = cv2.resize(even, (width, height), interpolation=cv2.INTER_AREA)
        found = self.extract(np.asarray(small, np.uint8))
        return replace(found, xy=2.0 * found.xy + 0.5, scale=2.0 * found.scale)


def _vignette(shape: tuple[int, ...]) -> FloatArray:
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    x, y = 2.0 * columns / (shape[1] - 1) - 1.0, 2.0 * rows / (shape[0] - 1) - 1.0
    away = 0.5 * (x**2 + y**2) * (_CORNER**-0.5 - 1.0)
    return np.asarray((1.0 + away) ** -2)


def _lit(frame: Frame, light: Light, seed: int) -> Frame:
    images = [light.on(image, (seed, frame.index, k)) for k, image in enumerate(frame.images)]
    return replace(frame, images=tuple(images))


def _found(
    sequence: ImageSequence, frames: list[Frame], extract: FeatureExtractor
) -> FoundFeatures:
    describer = FrameDescriber(extract)
    try:
        return FoundFeatures(sequence, [describer.describe(i, f) for i, f in enumerate(frames)])
    finally:
        describer.close()


def _row(config: ExperimentConfig, found: FoundFeatures) -> tuple[Cell, ...]:
    """Frames located, features an image, matches a frame (medians), ATE in cm."""
    system = make_system(config, found.sequence)
    reports = list(process(found, system))
    located = sum(report.tracking.status in LOCATED for report in reports)
    features = [len(image) for frame in found.frames for image in frame.features]
    matches = [len(report.stereo) for report in reports]
    return (
        f"{located} of {len(reports)}",
        float(np.median(features)),
        float(np.median(matches)),
        100.0 * ate_m(system, found.sequence),
    )


def _seconds(extract: FeatureExtractor, images: Iterable[Image]) -> float:
    """CPU seconds of the images' features, the least of five times."""
    times = []
    for _ in range(5):
        start = time.thread_time()
        for image in images:
            extract(image)
        times.append(time.thread_time() - start)
    return min(times)
