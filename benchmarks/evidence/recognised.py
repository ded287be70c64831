"""Recognising the return on real images: which pairs of EuRoC's frames are linked, and truly so."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.runs import DATA, experiment, find_features, say
from benchmarks.tables import Cell, Table
from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.estimates import LandmarkMap
from fgslam.core.features import LandmarkAppearances, StereoFeatures
from fgslam.core.geometry import inverse
from fgslam.evaluation.trajectory import rotation_angles
from fgslam.frontend.places.relocalisation.settings import RelocalisationSettings
from fgslam.slam.factory import make_relocaliser, make_stereo_matcher

NEIGHBOURS = 1  # frames this near in the recording are no revisit
SAME_M, SAME_DEG = 2.0, 30.0
RIGHT_M, RIGHT_DEG = 0.30, 5.0
# One frame's landmarks seldom fix a pose as well as a map's: how vague is a link allowed to be?
VAGUE_M, VAGUE_DEG = 0.3, 5.0
_VAGUE = (
    f"frontend.relocalisation.max_sigma_m={VAGUE_M}",
    f"frontend.relocalisation.max_sigma_deg={VAGUE_DEG}",
)
_STREAM = 14  # of random numbers


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
    stereo = make_stereo_matcher(sequence.rig, frontend)
    seen = [stereo.match(frame.features) for frame in found.frames]
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
            rng = np.random.default_rng([config.seed, _STREAM, i, j])
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
        right=found_too & (error_m <= RIGHT_M) & (error_deg <= RIGHT_DEG),
        error_m=np.where(found_too, error_m, np.nan),
        error_deg=np.where(found_too, error_deg, np.nan),
        sigma_m=sigma_m,
        sigma_deg=sigma_deg,
    )


def tables(data: Path = DATA, every: int = 1) -> list[Table]:
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
                f"Rightly: relative pose within {RIGHT_M:g} m and {RIGHT_DEG:g} degrees.",
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
