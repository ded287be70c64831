"""How long it takes to find oneself, beside the front-end's frame, in maps of up to 100,000.

A short drive through the rendered lab makes a map of real landmarks with real descriptors. Copies
of it around it are a building: each copy's descriptors have their 16 cells permuted, so that
the rooms have textures of their own whose statistics are SIFT's. Frames of the drive are sought in
the building without any prior. Both times are the processor's, and take turns.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from fgslam.config import load_config
from fgslam.factory import make_pipeline, make_relocaliser, make_stereo_matcher, open_sequence
from fgslam.frontend.relocalisation.relocaliser import Relocaliser
from fgslam.frontend.sift import SiftExtractor
from fgslam.frontend.stream import FeatureFrame
from fgslam.map_types import LandmarkAppearances
from fgslam.runs.threads import one_blas_thread
from fgslam.types import FloatArray, LandmarkMap, StereoFeatures

SIZES = (1_000, 3_000, 10_000, 30_000, 100_000)
FRAMES, EVERY = 120, 8
LIMITS = {"locate_100k_over_frontend": 2.0}
_APART_M = 12.0
_REACH = np.arange(-4, 5)  # rooms to each side of the first one
_CELLS, _BINS = 16, 8


@dataclass(frozen=True)
class Driven:
    """A map, features of some frames with their true poses, and the front-end's times."""

    landmarks: LandmarkMap
    looks: LandmarkAppearances
    queries: list[StereoFeatures]
    poses: FloatArray
    frontend_s: list[float]


@dataclass
class Sought:
    """One size of the map."""

    relocaliser: Relocaliser
    learnt_s: float
    seconds: list[float] = field(default_factory=list)
    right: int = 0


def drive() -> Driven:
    """Features one image after the other, stereo, tracking: all of it timed together."""
    config = load_config(Path("experiments/lab_loop.yaml"), [f"dataset.stop={FRAMES}"])
    sequence, frontend = open_sequence(config), config.frontend
    extractor = SiftExtractor(frontend.sift, frontend.appearance.mode)
    stereo = make_stereo_matcher(sequence.rig, frontend)
    pipeline = make_pipeline(sequence, frontend, config.odometry, config.estimator)
    queries, frontend_s = [], []
    for i in range(len(sequence)):
        frame = sequence.frame(i)
        start = time.process_time()
        found = tuple(extractor.extract(image) for image in frame.images)
        pipeline.process(
            FeatureFrame(i, frame, found, "", 0.0, 0.0), i, float(sequence.timestamps[i])
        )
        frontend_s.append(time.process_time() - start)
        if i % EVERY == 0:
            queries.append(stereo.match(found))
    landmarks, database = pipeline.estimator.landmarks(), pipeline.tracker.database
    assert sequence.ground_truth is not None
    return Driven(
        landmarks,
        database.appearances(landmarks.ids),
        queries,
        sequence.ground_truth.poses[::EVERY],
        frontend_s,
    )


def building(driven: Driven, size: int) -> tuple[LandmarkMap, LandmarkAppearances]:
    """The drive's map amid copies of it, the nearest ones first, cut to ``size`` landmarks.

    A map smaller than the drive's keeps the landmarks that came first.
    """
    one, looks = driven.landmarks, driven.looks
    copies = -(-size // len(one))
    step = int(one.ids[-1]) + 1
    places = np.array([(x, 0, z) for x in _REACH for z in _REACH])
    places = _APART_M * places[np.argsort((places**2).sum(axis=1), kind="stable")]
    ids, positions, views = [], [], []
    for k in range(copies):
        rng = np.random.default_rng(k)
        order = rng.permutation(_CELLS) if k else np.arange(_CELLS)
        cells = looks.descriptors.reshape(-1, _CELLS, _BINS)[:, order].reshape(-1, 128)
        ids.append(one.ids + k * step)
        positions.append(one.positions + places[k])
        views.append((looks.ids + k * step, cells))
    whole = LandmarkMap(
        np.concatenate(ids)[:size],
        np.concatenate(positions)[:size],
        np.tile(one.covariances, (copies, 1, 1))[:size],
    )
    every = LandmarkAppearances(
        np.concatenate([own for own, _ in views]),
        np.concatenate([cells for _, cells in views]),
        np.tile(looks.size, copies),
        np.tile(looks.orientation, copies),
        np.tile(looks.direction, (copies, 1)),
    )
    return whole, every.of(whole.ids)


@one_blas_thread()
def ratios_of_relocalising() -> dict[str, float]:
    """Milliseconds of the processor by the size of the map, and over the front-end's median."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        driven = drive()
        config = load_config(Path("experiments/lab_loop.yaml"))
        rig = open_sequence(config).rig
        sought = {}
        for size in SIZES:
            relocaliser = make_relocaliser(rig, config.frontend)
            known = building(driven, size)
            start = time.process_time()
            relocaliser.learn(*known)
            sought[size] = Sought(relocaliser, time.process_time() - start)
        for k, features in enumerate(driven.queries):
            for one in sought.values():
                start = time.process_time()
                answer = one.relocaliser.locate(features, np.random.default_rng(k))
                one.seconds.append(time.process_time() - start)
                off = np.linalg.norm(answer.wTc[:3, 3] - driven.poses[k, :3, 3])
                one.right += int(answer.found and off < 0.2)
    finally:
        cv2.setNumThreads(threads)
    frontend = statistics.median(driven.frontend_s)
    out = {"frontend_ms": 1e3 * frontend}
    for size, one in sought.items():
        name = f"locate_{size // 1000}k"
        out[f"{name}_ms"] = 1e3 * statistics.median(one.seconds)
        out[f"{name}_over_frontend"] = statistics.median(one.seconds) / frontend
        out[f"{name}_worst_over_frontend"] = max(one.seconds) / frontend
        out[f"learn_{size // 1000}k_ms"] = 1e3 * one.learnt_s
        out[f"{name}_right"] = one.right / len(driven.queries)
    return out


if __name__ == "__main__":
    for name, value in ratios_of_relocalising().items():
        print(f"{name:40s} {value:.3f}")
