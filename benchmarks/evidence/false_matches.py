"""False matches injected into the matcher of the lab's drive: what trajectory and map lose.

Every frame's features are matched with the map, as in the paper: by default key frames' alone are.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from benchmarks.runs import (
    FoundFeatures,
    ate_m,
    experiment,
    find_features,
    make_system,
    process,
    say,
)
from benchmarks.tables import Cell, Table
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.geometry import inverse, transform_to_camera
from fgslam.core.sensors import CameraRig
from fgslam.core.types import StereoFeatures
from fgslam.datasets.rendered import RenderedLabSequence
from fgslam.frontend.tracking.map_matching import ExpectedLandmarks, MapMatcher, MapMatches
from fgslam.runs.config import ExperimentConfig
from fgslam.runs.tasks.slam_results import points_under
from fgslam.slam.pipeline import FrameReport, SlamPipeline

Kind: TypeAlias = Literal["anywhere", "nearest"]
KINDS: tuple[Kind, ...] = ("anywhere", "nearest")
SHARES = (0.0, 0.05, 0.1, 0.2, 0.3)
SEEDS = range(3)
EVERY_FRAME = "frontend.tracking=sift"
_RIGHT_PX = 3.0
"""A landmark is right that lies within the paper's outlier limit (3.3) of the true point."""

_NEAREST_M = 0.1


class FalseMatches(MapMatcher):
    """The matcher, with a share of its matches replaced by features that nothing matched."""

    def __init__(self, config: ExperimentConfig, share: float, kind: Kind, seed: int) -> None:
        """Takes the nearest free feature of the image, or any; ``seed`` draws which matches."""
        super().__init__(config.frontend.matching, config.frontend.appearance)
        self._share, self._kind = share, kind
        self._rng = np.random.default_rng([seed, 100])

    def match(
        self,
        expected: ExpectedLandmarks,
        features: StereoFeatures,
        uncertainty: FloatArray | None = None,
    ) -> MapMatches:
        """As the matcher's, then spoiled."""
        found = super().match(expected, features, uncertainty)
        return self.spoiled(found, features)

    def spoiled(self, found: MapMatches, features: StereoFeatures) -> MapMatches:
        """The matches with false ones among them, one feature each as before."""
        wrong = np.flatnonzero(self._rng.uniform(size=len(found.features)) < self._share)
        free = np.setdiff1d(np.arange(len(features)), found.features)
        matched = found.features.copy()
        for k in wrong[: len(free)].tolist():
            chosen = self._other(features.measurement, int(matched[k]), free)
            matched[k] = free[chosen]
            free = np.delete(free, chosen)
        return MapMatches(found.landmarks, matched, found.had_candidates)

    def _other(self, measured: FloatArray, instead_of: int, free: IntArray) -> int:
        if self._kind == "anywhere":
            return int(self._rng.integers(len(free)))
        away = measured[free, :2] - measured[instead_of, :2]
        return int(np.argmin(np.hypot(*away.T)))


@dataclass(frozen=True)
class Outcome:
    """What one drive came to.

    Attributes:
        located: frames whose pose the landmarks determined.
        ate_cm: error of the trajectory.
        right: share of the valid landmarks within 3 px of the true point, seen from where they
            began.
        median_px, p95_px: median and 95 % quantile of that distance.
    """

    located: int
    ate_cm: float
    right: float
    median_px: float
    p95_px: float


def tables() -> list[Table]:
    """One row a kind and share of false matches: means over the seeds, and the worst ATE."""
    config = experiment("lab_loop", [EVERY_FRAME])
    return [curves(find_features(config), config)]


def curves(
    found: FoundFeatures,
    config: ExperimentConfig,
    shares: Iterable[float] = SHARES,
    seeds: Iterable[int] = SEEDS,
) -> Table:
    """ATE and precision of the landmarks over the share of false matches."""
    rows: list[tuple[Cell, ...]] = []
    for kind in KINDS:
        for share in shares:
            say(f"driving with {share:.0%} false matches, {kind}")
            drawn = seeds if share else [0]
            all_of = [drive(found, config, (share, kind, seed)) for seed in drawn]
            ate = [each.ate_cm for each in all_of]
            rows.append(
                (
                    kind,
                    100.0 * share,
                    min(each.located for each in all_of),
                    float(np.mean(ate)),
                    max(ate),
                    100.0 * float(np.mean([each.right for each in all_of])),
                    float(np.mean([each.median_px for each in all_of])),
                    float(np.mean([each.p95_px for each in all_of])),
                )
            )
    columns = (
        "false feature", "false %", "located, least", "ATE cm, mean", "worst",
        "landmarks right %", "median px", "95 % px",
    )  # fmt: skip
    return Table("False matches in the matcher", columns, rows)


def drive(
    found: FoundFeatures, config: ExperimentConfig, spoil: tuple[float, Kind, int]
) -> Outcome:
    """One drive with ``spoil``: share of false matches, kind and seed."""
    system = make_system(config, found.sequence)
    system.tracker.matcher = FalseMatches(config, *spoil)  # what shares the tracker meets it, too
    reports = list(process(found, system))
    if not isinstance(found.sequence, RenderedLabSequence):
        raise ValueError(f"{config.name}: only of the rendered lab every true point is known")
    away = _landmark_errors(found.sequence, reports, system)
    return Outcome(
        located=1 + sum(report.tracking.status.measured for report in reports),
        ate_cm=100.0 * ate_m(system, found.sequence),
        right=float(np.mean(away <= _RIGHT_PX)),
        median_px=float(np.median(away)),
        p95_px=float(np.quantile(away, 0.95)),
    )


def _landmark_errors(
    sequence: RenderedLabSequence, reports: list[FrameReport], system: SlamPipeline
) -> FloatArray:
    """Distances (n,) of the valid landmarks from the true points, px in (column, row, disparity).

    The true point is where the ray of a landmark's first sighting, which is never a false match,
    meets the rendered surface. The map begins at the first true pose.
    """
    estimate, database = system.estimator.estimate(), system.tracker.database
    true = sequence.ground_truth.poses
    to_truth = true[0] @ inverse(estimate.trajectory.poses[0])
    away: list[FloatArray] = []
    for k, report in enumerate(reports):
        seen = report.increment.observations
        kept = database.ids[database.valid]
        new = seen.select(seen.is_new & np.isin(seen.ids, kept))
        points, known = points_under(sequence.rig, sequence.depth(k), new.measurement[:, :2])
        found = estimate.landmarks.positions[estimate.landmarks.rows(new.ids[known])]
        local = transform_to_camera(inverse(to_truth) @ true[k], found)
        away.append(_apart(sequence.rig, local, points[known]))
    return np.concatenate(away)


def _apart(rig: CameraRig, a: FloatArray, b: FloatArray) -> FloatArray:
    """Distances (n,) of points (n, 3) in (column, row, disparity); infinite behind the camera."""
    away = np.full(len(a), np.inf)
    seen = a[:, 2] > _NEAREST_M
    away[seen] = np.linalg.norm(rig.predict(a[seen]) - rig.predict(b[seen]), axis=1)
    return away
