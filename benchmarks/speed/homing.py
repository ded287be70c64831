"""Speed of visual homing as ratios to raw OpenCV calls on the same images (docs/results).

Processor times of this process, one thread each for OpenCV and BLAS; medians are quoted. The images
are those of a homing in the rendered house: the paper's camera, 320x240 pixels.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.speed.drives import cpu_seconds, interleaved
from fgslam.backend.homing.estimators import make_homing_estimator
from fgslam.backend.settings import HomingEkfSettings, HomingEstimatorSettings, HomingGraphSettings
from fgslam.core.arrays import Image
from fgslam.core.bearings import OmniFeatures, TrackedBearings
from fgslam.core.threads import one_blas_thread
from fgslam.frontend.features.omni import OmniFeatureExtractor
from fgslam.frontend.settings import OmniFeatureSettings
from fgslam.homing.controller import HomingController
from fgslam.homing.front_end import ImageFrontEnd
from fgslam.homing.settings import FrontEndSettings
from fgslam.worlds.house import OmniWorld
from fgslam.worlds.settings import HousePathSettings, OmniHouseSettings

LIMITS = {
    "homing_track_over_raw_klt": 2.0,
    "homing_update_graph_over_raw_klt": 2.0,
    "homing_update_ekf_over_raw_klt": 2.0,
    "homing_initialisation_over_raw_sift": 1.5,
    "columns_over_sift": 0.5,
}
ESTIMATORS: dict[str, HomingEstimatorSettings] = {
    "graph": HomingGraphSettings(),
    "ekf": HomingEkfSettings(),
}
SEEDS = (0, 1, 2)
IMAGES = 26  # at 10 a second and 0.4 m/s: the first half of a leg
REPEATS = 7


Step: TypeAlias = Callable[[Image, float], object]


@dataclass(frozen=True)
class Leg:
    """What is seen on the way to one target."""

    world: OmniWorld
    images: tuple[Image, ...]


def open_leg(seed: int) -> Leg:
    """Images on the straight way from a path's start towards its first target."""
    world = OmniWorld(OmniHouseSettings(path=HousePathSettings(legs=1, spacing_m=2.0)), seed)
    start, target = world.reference_poses[:2]
    way = target[:2] - start[:2]
    heading = float(np.arctan2(way[1], way[0]))
    images = []
    for k in range(IMAGES):
        place = start[:2] + way * (0.04 * k / np.hypot(*way))
        world.put(np.array([*place, heading + 0.2 * np.sin(0.3 * k)]))
        images.append(world.image(0.1 * k))
    return Leg(world, tuple(images))


class NotedFrontEnd:
    """FrontEnd that keep where the tracked points were seen in the camera's own images."""

    def __init__(self, world: OmniWorld) -> None:
        self._camera = world.camera
        self.inner = ImageFrontEnd(world.camera, FrontEndSettings(), np.random.default_rng(1))
        self.seen: list[TrackedBearings] = []

    def describe(self, image: Image) -> OmniFeatures:
        """Features of a target."""
        return self.inner.describe(image)

    def begin(self, image: Image, target: OmniFeatures, time: float) -> object:
        """First measurement of a leg."""
        return self.inner.begin(image, target, time)

    def look(self, image: Image, target: OmniFeatures) -> object:
        """Homing vector to a target."""
        return self.inner.look(image, target)

    def track(self, image: Image, time: float) -> TrackedBearings:
        """Bearings tracked into the image, kept for :meth:`pixels`."""
        self.seen.append(self.inner.track(image, time))
        return self.seen[-1]

    def pixels(self, k: int) -> NDArray[np.float32]:
        """(n, 1, 2) float32, where update ``k`` found its points."""
        b = self.seen[k]
        rays = np.column_stack([np.cos(b.bearing), np.sin(b.bearing), np.tan(b.elevation)])
        found = self._camera.pixels(rays)
        return np.asarray(found[np.isfinite(found[:, 0])].astype(np.float32)[:, None])


def track_ratios(leg: Leg) -> list[float]:
    """Each image's tracking over raw KLT."""

    def begin(noted: NotedFrontEnd, target: OmniFeatures) -> Step:
        noted.begin(leg.images[0], target, 0.0)
        return noted.track

    return [ratio for ratio, _ in timed_against_klt(leg, begin)]


def update_ratios(leg: Leg, settings: HomingEstimatorSettings) -> list[tuple[float, int]]:
    """Each update's time over that of raw KLT from its image before; and the points' number."""

    def begin(noted: NotedFrontEnd, target: OmniFeatures) -> Step:
        front_end: ImageFrontEnd = noted  # type: ignore[assignment]
        controller = HomingController(
            front_end, target, lambda start: make_homing_estimator(start, settings)
        )
        controller.step(leg.images[0], 0.0)
        return controller.step

    return timed_against_klt(leg, begin)


def timed_against_klt(
    leg: Leg, begin: Callable[[NotedFrontEnd, OmniFeatures], Step]
) -> list[tuple[float, int]]:
    """All later images, step by step: the least time of several drives, own and raw alike.

    Each image is new to both, once a drive; what other processes take away differs from drive to
    drive, and drives are alike to the bit.
    """
    greys = [np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8) for image in leg.images]
    target = NotedFrontEnd(leg.world).describe(leg.world.targets[0])
    own, raw = np.full((2, REPEATS, len(greys)), np.nan)
    points = np.zeros(len(greys), np.int64)
    for drive in range(REPEATS):
        noted = NotedFrontEnd(leg.world)
        step = begin(noted, target)
        for k in range(1, len(greys)):
            before = len(noted.seen)
            seconds = cpu_seconds(partial(step, leg.images[k], 0.1 * k))
            if len(noted.seen) == before or before < 1:
                continue  # an initialisation, or no points of an image before to start raw KLT from
            places = noted.pixels(before - 1)
            own[drive, k], points[k] = seconds, len(places)
            raw[drive, k] = raw_klt(greys[k - 1], greys[k], places)
    timed = np.flatnonzero(points)
    ratios = own[:, timed].min(axis=0) / raw[:, timed].min(axis=0)
    return list(zip(ratios.tolist(), points[timed].tolist(), strict=True))


def raw_klt(before: Image, now: Image, points: NDArray[np.float32]) -> float:
    """Seconds of OpenCV's tracker with its own window, levels and criteria."""
    return cpu_seconds(
        lambda: cv2.calcOpticalFlowPyrLK(before, now, points, None)  # type: ignore[call-overload]
    )


def front_end_ratios(leg: Leg) -> dict[str, float]:
    """Initialisation, and columns, beside raw SIFT."""
    camera, image, other = leg.world.camera, leg.images[0], leg.world.targets[0]
    settings = OmniFeatureSettings()
    extractor = OmniFeatureExtractor(camera, settings)
    front_end = NotedFrontEnd(leg.world)
    memory = front_end.describe(other)  # a target's features are remembered, never found anew
    times = interleaved(
        {
            "raw": lambda: cpu_seconds(lambda: raw_sift_matching(image, other)),
            "own": lambda: cpu_seconds(lambda: initialise(front_end, leg, memory)),
            "both": lambda: cpu_seconds(
                lambda: initialise(front_end, leg, front_end.describe(other))
            ),
            "columns": lambda: cpu_seconds(lambda: extractor.extract_columns(image)),
            "sift": lambda: cpu_seconds(lambda: extractor.extract_sift(image)),
        },
        REPEATS,
    )
    return {
        "homing_initialisation_over_raw_sift": times["own"] / times["raw"],
        "homing_initialisation_both_images_over_raw_sift": times["both"] / times["raw"],
        "columns_over_sift": times["columns"] / times["sift"],
        "homing_initialisation_ms": 1e3 * times["own"],
        "raw_sift_matching_ms": 1e3 * times["raw"],
    }


def initialise(front_end: NotedFrontEnd, leg: Leg, target: OmniFeatures) -> None:
    """The present image's features, matches, homing vector, local map, and start of tracking."""
    front_end.begin(leg.images[0], target, 0.0)


def raw_sift_matching(image: Image, other: Image) -> None:
    """OpenCV's own: SIFT of both images, and brute force with two neighbours."""
    detector = cv2.SIFT.create()
    greys = (cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in (image, other))
    one, two = (detector.detectAndCompute(grey, None)[1] for grey in greys)
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    matcher.knnMatch(one, two, k=2)


@one_blas_thread()
def ratios_of_homing() -> dict[str, float]:
    """All of it: a flat map of names to numbers."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        legs = [open_leg(seed) for seed in SEEDS]
        found = medians_of(legs)
    finally:
        cv2.setNumThreads(threads)
    return found


def medians_of(legs: list[Leg]) -> dict[str, float]:
    """Medians over updates and legs."""
    found: dict[str, float] = {}
    for name, settings in ESTIMATORS.items():
        every = [pair for leg in legs for pair in update_ratios(leg, settings)]
        found[f"homing_update_{name}_over_raw_klt"] = statistics.median(r for r, _ in every)
        found["homing_points"] = statistics.median(n for _, n in every)
    tracked = [ratio for leg in legs for ratio in track_ratios(leg)]
    found["homing_track_over_raw_klt"] = statistics.median(tracked)
    each = [front_end_ratios(leg) for leg in legs]
    return found | {name: statistics.median(e[name] for e in each) for name in each[0]}
