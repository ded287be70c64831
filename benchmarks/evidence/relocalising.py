"""The kidnapped robot: surroundings that its map lacks, and frames linked one by one."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.runs import DATA, EXPERIMENTS, experiment, find_features, say
from benchmarks.tables import Cell, Table
from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.geometry import inverse, transform_to_camera
from fgslam.core.log import ImageSequence
from fgslam.core.sensors import CameraRig
from fgslam.core.types import LandmarkAppearances, LandmarkMap, StereoFeatures
from fgslam.evaluation.statistics import rotation_angles
from fgslam.frontend.places.relocalisation import Relocaliser
from fgslam.frontend.settings import RelocalisationSettings
from fgslam.runs.config import LocalisationConfig, load_experiment
from fgslam.runs.engine import run_task
from fgslam.runs.opening import open_sequence
from fgslam.runs.tasks.localisation import open_localisation, submap_features
from fgslam.runs.tasks.slam_map_entry import FIRST_FOLDER, MAP_FILE, GivenMap, open_map
from fgslam.runs.tasks.slam_results import truth_in_map
from fgslam.slam.build import make_relocaliser, make_stereo, make_stream, trusted
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


def unmapped_tables(seeds: Iterable[int] = SEEDS, poses: int | None = None) -> list[Table]:
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
    truth = truth_in_map(given.saved, sequence, experiment)[0]
    stereo = make_stereo(sequence.rig, config.frontend)
    longest = max(FRAMES)
    held: list[FeatureFrame] = []
    stream = make_stream(sequence, config.frontend)()
    try:
        for found in stream:
            held.append(found)
            if len(held) < longest:
                continue
            features = {1: stereo.match(held[-1].frame, held[-1].features).whole}
            features[longest] = _submap(config, sequence, held)
            yield Query(held[-1].i, truth[held[-1].i], features), sequence.rig
            held = []
            if poses is not None and found.i + 1 >= longest * poses:
                return
    finally:
        stream.close()


def _submap(
    config: LocalisationConfig, sequence: ImageSequence, held: list[FeatureFrame]
) -> StereoFeatures:
    return submap_features(sequence, held, config.frontend, config.odometry)[0]


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
    column, row, _ = rig.predict(np.where(ahead[:, None], points, [0.0, 0.0, 1.0])).T
    inside = (column > -_BORDER_PX) & (column < rig.width + _BORDER_PX)
    inside &= (row > -_BORDER_PX) & (row < rig.height + _BORDER_PX)
    return np.asarray(ahead & inside)


NEIGHBOURS = 1  # frames this near in the recording are no revisit
SAME_M, SAME_DEG = 2.0, 30.0
LINKED_M, LINKED_DEG = 0.30, 5.0
# One frame's landmarks seldom fix a pose as well as a map's: how vague is a link allowed to be?
VAGUE_M, VAGUE_DEG = 0.3, 5.0
_VAGUE = (
    f"frontend.relocalisation.max_sigma_m={VAGUE_M}",
    f"frontend.relocalisation.max_sigma_deg={VAGUE_DEG}",
)
_LINK_STREAM = 14  # of random numbers


@dataclass(frozen=True, eq=False)
class Links:
    """All pairs of frames that are not neighbours, the earlier one first.

    Attributes:
        same: (p,) whether the pair sees the same place by the truth.
        linked: (p,) whether the later frame was found among the landmarks of the earlier one.
        right: (p,) whether it was found where it truly is.
        error_m, error_deg: (p,) of those linked; NaN otherwise.
        sigma_m, sigma_deg: (p,) as the answer states them, roots of traces; NaN without a pose.
    """

    same: BoolArray
    linked: BoolArray
    right: BoolArray
    error_m: FloatArray
    error_deg: FloatArray
    sigma_m: FloatArray
    sigma_deg: FloatArray

    def surer(self, sigma_m: float, sigma_deg: float) -> Links:
        """Only those links are believed whose pose is known as well as that."""
        sure = self.linked & (self.sigma_m <= sigma_m) & (self.sigma_deg <= sigma_deg)
        return replace(
            self,
            linked=sure,
            right=self.right & sure,
            error_m=np.where(sure, self.error_m, np.nan),
            error_deg=np.where(sure, self.error_deg, np.nan),
        )

    @property
    def precision(self) -> float:
        """Links whose relative pose is right, of all links."""
        return float(self.right.sum() / max(int(self.linked.sum()), 1))

    @property
    def recall(self) -> float:
        """True revisits that are linked, rightly, of all true ones."""
        return float((self.right & self.same).sum() / max(int(self.same.sum()), 1))


def link_frames(data: Path = DATA, overrides: Iterable[str] = (), every: int = 1) -> Links:
    """Seeks each frame in each earlier one that is not its neighbour, without any prior.

    A pair sees the same place where both poses lie within 2 m and 30 degrees of one another.

    Args:
        data: folder of the real recordings.
        overrides: ``a.b=value`` of `experiments/euroc_v101.yaml`.
        every: only pairs whose later frame is a multiple of it.
    """
    config = experiment("euroc_v101", [*_VAGUE, *overrides], data)
    found = find_features(config)
    sequence, frontend = found.sequence, config.frontend
    stereo = make_stereo(sequence.rig, frontend)
    seen = [stereo.match(frame.frame, frame.features).whole for frame in found.frames]
    if sequence.ground_truth is None:
        raise ValueError("a recording without truth has no true pairs")
    truth = sequence.ground_truth.poses
    rows = []
    for i in range(len(seen)):
        relocaliser = make_relocaliser(sequence.rig, frontend)
        relocaliser.learn(*_as_map(seen[i]))
        for j in range(i + 1 + NEIGHBOURS, len(seen)):
            if j % every:
                continue
            rng = np.random.default_rng([config.seed, _LINK_STREAM, i, j])
            answer = relocaliser.locate(seen[j], rng)
            between = inverse(truth[i]) @ truth[j]
            error = _size(inverse(between) @ answer.wTc)
            rows.append((answer.found, *_size(between), *error, *_sigmas(answer.covariance)))
        if i % 10 == 0:
            say(f"frame {i} of {len(seen)} is sought in by all later ones")
    linked, apart_m, apart_deg, error_m, error_deg, sigma_m, sigma_deg = np.array(rows).T
    found_too = linked > 0.0
    return Links(
        same=(apart_m <= SAME_M) & (apart_deg <= SAME_DEG),
        linked=found_too,
        right=found_too & (error_m <= LINKED_M) & (error_deg <= LINKED_DEG),
        error_m=np.where(found_too, error_m, np.nan),
        error_deg=np.where(found_too, error_deg, np.nan),
        sigma_m=sigma_m,
        sigma_deg=sigma_deg,
    )


def recognised_tables(data: Path = DATA, every: int = 1) -> list[Table]:
    """The counts as a table; ``every`` as in :func:`link_frames`."""
    vague = link_frames(data, every=every)
    sure = RelocalisationSettings()
    limits = {
        f"{VAGUE_M:g} m, {VAGUE_DEG:g} deg": vague,
        **{
            f"{m:g} m, {deg:g} deg": vague.surer(m, deg)
            for m, deg in ((0.1, 2.0), (sure.max_sigma_m, sure.max_sigma_deg))
        },
    }
    return [
        Table(
            "Recognising the return: EuRoC V1_01, pairs of frames that are no neighbours",
            (
                *("largest sigma", "pairs", "true revisits", "linked", "of them true revisits"),
                *("linked elsewhere, rightly", "not rightly", "precision", "recall"),
                *("error cm: median", "95 %", "largest", "deg: median", "95 %", "largest"),
            ),
            [_row(title, links) for title, links in limits.items()],
            (
                f"A true revisit: poses within {SAME_M:g} m and {SAME_DEG:g} degrees.",
                f"Rightly: relative pose within {LINKED_M:g} m and {LINKED_DEG:g} degrees.",
            ),
        )
    ]


def _row(title: str, links: Links) -> tuple[Cell, ...]:
    known = np.isfinite(links.error_m)
    return (
        title,
        len(links.same),
        int(links.same.sum()),
        int(links.linked.sum()),
        int((links.linked & links.same).sum()),
        int((links.right & ~links.same).sum()),
        int((links.linked & ~links.right).sum()),
        links.precision,
        links.recall,
        *(100.0 * np.percentile(links.error_m[known], [50, 95, 100])).tolist(),
        *np.percentile(links.error_deg[known], [50, 95, 100]).tolist(),
    )


def _sigmas(covariance: FloatArray) -> tuple[float, float]:
    """Metres and degrees: roots of the traces."""
    variances = np.diagonal(covariance)
    turned, moved = np.sqrt(variances[:3].sum()), np.sqrt(variances[3:].sum())
    return float(moved), float(np.rad2deg(turned))


def _as_map(seen: StereoFeatures) -> tuple[LandmarkMap, LandmarkAppearances]:
    """What one frame sees as a map, in its own camera's frame."""
    ids = np.arange(len(seen))
    directions = seen.position / np.linalg.norm(seen.position, axis=1, keepdims=True)
    size = seen.scale * seen.position[:, 2]
    looks = LandmarkAppearances(ids, seen.descriptors, size, seen.orientation, directions)
    return LandmarkMap(ids, seen.position, seen.position_covariance), looks


def _size(motion: FloatArray) -> tuple[float, float]:
    """Metres and degrees of a motion (4, 4)."""
    turn = rotation_angles(motion[None, :3, :3])[0]
    return float(np.linalg.norm(motion[:3, 3])), float(np.rad2deg(turn))
