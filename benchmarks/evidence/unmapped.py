"""The kidnapped robot where the map does not help: what its cameras see is not in it, or hardly."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.runs import EXPERIMENTS, say
from benchmarks.tables import Cell, Table
from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.estimates import LandmarkMap
from fgslam.core.features import LandmarkAppearances, StereoFeatures
from fgslam.core.geometry import inverse, project, transform_to_camera
from fgslam.core.recordings import Sequence
from fgslam.core.sensors import CameraRig
from fgslam.evaluation.trajectory import rotation_angles
from fgslam.frontend.places.relocalisation.relocaliser import Relocaliser
from fgslam.runs.config import load_experiment
from fgslam.runs.config_models import LocalisationConfig
from fgslam.runs.engine import run_task
from fgslam.runs.opening import open_sequence
from fgslam.runs.tasks.localisation import open_localisation
from fgslam.runs.tasks.localisation_submap import Window, submap_features
from fgslam.runs.tasks.localisation_truth import truth_in_map
from fgslam.runs.tasks.slam_map_entry import FIRST_FOLDER, MAP_FILE, GivenMap, open_map, trusted
from fgslam.slam.factory import make_relocaliser, make_stereo_matcher, make_stream
from fgslam.slam.feature_stream import FeatureFrame

SEEDS = (0, 1, 2, 3)
KEPT = {"all": 1.0, "three in ten": 0.3, "none": 0.0}
"""Share of the landmarks in view of a query that its map keeps."""
FRAMES = (1, 3)
RIGHT_M, RIGHT_DEG = 0.05, 1.0
FALSE_M, FALSE_DEG = 0.10, 2.0
_BORDER_PX = 60.0  # around the image: what the frames before saw goes, too
_NEAREST_M = 0.05
_STREAM = 15  # of random numbers


@dataclass(frozen=True, eq=False)
class Query:
    """A random pose: what was seen from there, as one frame and as a submap."""

    number: int
    truth: FloatArray
    features: dict[int, StereoFeatures]


@dataclass
class Counts:
    """Answers of one kind of map."""

    queries: int = 0
    found: int = 0
    right: int = 0
    false: int = 0

    def add(self, found: bool, wTc: FloatArray, truth: FloatArray) -> None:
        """Counts an answer; one between right and false is less exact."""
        between = inverse(truth) @ wTc
        metres = float(np.linalg.norm(between[:3, 3]))
        degrees = float(np.rad2deg(rotation_angles(between[None, :3, :3])[0]))
        self.queries += 1
        self.found += int(found)
        self.right += int(found and metres <= RIGHT_M and degrees <= RIGHT_DEG)
        self.false += int(found and (metres > FALSE_M or degrees > FALSE_DEG))


def tables(seeds: Iterable[int] = SEEDS, poses: int | None = None) -> list[Table]:
    """The map is made by `kidnapped.yaml`; every query is asked of three versions of it.

    Args:
        seeds: of the random poses.
        poses: so many of each seed; None for all.
    """
    with tempfile.TemporaryDirectory() as folder:
        given = _make_map(Path(folder) / "run")
    counts: dict[tuple[str, int, int], Counts] = {}
    for seed in seeds:
        say(f"random poses of seed {seed}")
        config = _config(f"dataset.drive.random_poses.seed={seed}")
        known = trusted(given.saved, config.frontend.database.valid_hits)
        for query, rig in _queries(config, given, poses):
            for kept, share in KEPT.items():
                made = _learnt(config, known, rig, query, share)
                for frames, features in query.features.items():
                    rng = np.random.default_rng([config.seed, _STREAM, query.number, frames])
                    answer = made.locate(features, rng)
                    one = counts.setdefault((kept, frames, seed), Counts())
                    one.add(answer.found, answer.wTc, query.truth)
    rows: list[tuple[Cell, ...]] = [
        (kept, frames, seed, one.queries, one.found, one.right, one.false)
        for (kept, frames, seed), one in sorted(
            counts.items(), key=lambda item: ([*KEPT].index(item[0][0]), *item[0][1:])
        )
    ]
    columns = ("in view kept", "frames", "seed of the poses", "poses", "found", "right", "false")
    notes = (
        f"Right: within {RIGHT_M:g} m and {RIGHT_DEG:g} degree; false: beyond {FALSE_M:g} m or "
        f"{FALSE_DEG:g} degrees. Poses with fewer than 20 landmarks in view count, too.",
    )
    return [Table("A map that lacks what is seen", columns, rows, notes)]


def _config(*overrides: str) -> LocalisationConfig:
    path = EXPERIMENTS / "kidnapped.yaml"
    config = load_experiment(path, ["output.pictures=false", "output.report=false", *overrides])
    if not isinstance(config, LocalisationConfig):
        raise ValueError(f"{path}: no localisation experiment")
    return config


def _make_map(folder: Path) -> GivenMap:
    say("making the map of kidnapped")
    run_task(open_localisation, _config("dataset.drive.frames=3"), folder)
    return open_map(folder / FIRST_FOLDER / MAP_FILE)


def _queries(
    config: LocalisationConfig, given: GivenMap, poses: int | None
) -> Iterator[tuple[Query, CameraRig]]:
    experiment = config.as_experiment()
    sequence = open_sequence(experiment)
    truth = truth_in_map(given.saved, sequence, experiment).poses
    stereo = make_stereo_matcher(sequence.rig, config.frontend)
    longest = max(FRAMES)
    held: list[FeatureFrame] = []
    stream = make_stream(sequence, config.frontend)()
    try:
        for found in stream:
            held.append(found)
            if len(held) < longest:
                continue
            features = {1: stereo.match(held[-1].features)}
            features[longest] = _submap(config, sequence, held)
            yield Query(held[-1].i, truth[held[-1].i], features), sequence.rig
            held = []
            if poses is not None and found.i + 1 >= longest * poses:
                return
    finally:
        stream.close()


def _submap(
    config: LocalisationConfig, sequence: Sequence, held: list[FeatureFrame]
) -> StereoFeatures:
    window = Window(sequence, held[0].i, len(held))
    return submap_features(window, held, config.frontend, config.odometry)[0]


def _learnt(
    config: LocalisationConfig,
    known: tuple[LandmarkMap, LandmarkAppearances],
    rig: CameraRig,
    query: Query,
    share: float,
) -> Relocaliser:
    landmarks, looks = known
    if share < 1.0:
        rng = np.random.default_rng([config.seed, _STREAM, query.number])
        keep = ~_before(rig, query.truth, landmarks) | (rng.random(len(landmarks)) < share)
        landmarks = landmarks.select(keep)
        looks = looks.of(landmarks.ids)
    made = make_relocaliser(rig, config.frontend)
    made.learn(landmarks, looks)
    return made


def _before(rig: CameraRig, wTc: FloatArray, landmarks: LandmarkMap) -> BoolArray:
    """Which landmarks lie in the image and its border, hidden ones too."""
    points = transform_to_camera(wTc, landmarks.positions)
    ahead = points[:, 2] > _NEAREST_M
    column, row, _ = project(rig, np.where(ahead[:, None], points, [0.0, 0.0, 1.0])).T
    inside = (column > -_BORDER_PX) & (column < rig.width + _BORDER_PX)
    inside &= (row > -_BORDER_PX) & (row < rig.height + _BORDER_PX)
    return np.asarray(ahead & inside)
