"""Recognising the return on real images: which pairs of EuRoC's frames are linked, and truly so."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgslam.evaluation.trajectory import rotation_angles
from fgslam.factory import make_relocaliser, make_stereo_matcher
from fgslam.geometry import inverse
from fgslam.map_types import LandmarkAppearances
from fgslam.types import BoolArray, FloatArray, LandmarkMap, StereoFeatures
from scripts.results.report import Table
from scripts.results.runs import DATA, experiment, find_features, say

NEIGHBOURS = 1  # frames this near in the recording are no revisit
SAME_M, SAME_DEG = 2.0, 30.0
RIGHT_M, RIGHT_DEG = 0.30, 5.0
# A place is recognised however vaguely the pose is known from one frame's landmarks.
_VAGUE = ("frontend.relocalisation.max_sigma_m=0.3", "frontend.relocalisation.max_sigma_deg=5.0")
_STREAM = 14  # of random numbers


@dataclass(frozen=True, eq=False)
class Links:
    """All pairs of frames that are not neighbours, the earlier one first.

    Attributes:
        same: (p,) whether the pair sees the same place by the truth.
        linked: (p,) whether the later frame was found among the landmarks of the earlier one.
        right: (p,) whether it was found where it truly is.
        error_m, error_deg: (p,) of those linked; NaN otherwise.
    """

    same: BoolArray
    linked: BoolArray
    right: BoolArray
    error_m: FloatArray
    error_deg: FloatArray

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
            rows.append((answer.found, *_size(between), *_size(inverse(between) @ answer.wTc)))
        if i % 10 == 0:
            say(f"frame {i} of {len(seen)} is sought in by all later ones")
    linked, apart_m, apart_deg, error_m, error_deg = np.array(rows).T
    found_too = linked > 0.0
    return Links(
        same=(apart_m <= SAME_M) & (apart_deg <= SAME_DEG),
        linked=found_too,
        right=found_too & (error_m <= RIGHT_M) & (error_deg <= RIGHT_DEG),
        error_m=np.where(found_too, error_m, np.nan),
        error_deg=np.where(found_too, error_deg, np.nan),
    )


def tables(data: Path = DATA, every: int = 1) -> list[Table]:
    """The counts as a table; ``every`` as in :func:`link_frames`."""
    links = link_frames(data, every=every)
    known = np.isfinite(links.error_m)
    counts = (links.same, links.linked, links.linked & links.same, links.right & links.same)
    return [
        Table(
            "Recognising the return: EuRoC V1_01, pairs of frames that are no neighbours",
            (
                *("pairs", "true revisits", "linked", "of them true revisits", "rightly posed"),
                *("linked elsewhere, rightly", "false", "precision", "recall"),
                *("error cm, median", "95 %", "deg, median", "95 %"),
            ),
            [
                (
                    len(links.same),
                    *(int(count.sum()) for count in counts),
                    int((links.right & ~links.same).sum()),
                    int((links.linked & ~links.right).sum()),
                    links.precision,
                    links.recall,
                    *(100.0 * np.percentile(links.error_m[known], [50, 95])).tolist(),
                    *np.percentile(links.error_deg[known], [50, 95]).tolist(),
                )
            ],
            (
                f"A true revisit: poses within {SAME_M:g} m and {SAME_DEG:g} degrees.",
                f"Right: relative pose within {RIGHT_M:g} m and {RIGHT_DEG:g} degrees.",
            ),
        )
    ]


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
