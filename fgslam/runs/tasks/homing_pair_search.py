"""Homing vectors of many pairs of views, each pair by itself; pictures of their matches."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgslam.cameras.omni.camera import OmniCamera
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.files import make_subfolder
from fgslam.core.homing import (
    BearingMatches,
    FeatureKind,
    OmniFeatures,
    Refusal,
    TwoViewVector,
)
from fgslam.frontend.features.settings import OmniMatchingSettings
from fgslam.frontend.homing.homing_vector import pair_generator, vector_between
from fgslam.frontend.homing.settings import HomingVectorSettings
from fgslam.report.content import Picture
from fgslam.runs.engine import Context
from fgslam.runs.tasks.homing_pair_answers import PairAnswer, PairErrors
from fgslam.runs.tasks.homing_views import Views
from fgslam.runs.units import Stage, interleaved

PLAIN_INLIERS = 25
"""A plain answer counts from here on (issue 4, 5.3)."""

_BLOCKS_A_JOB = 4  # so that progress moves, and no process waits long for the last one


@dataclass(frozen=True, slots=True, eq=False)
class PairSearch:
    """Some pairs for one process.

    Attributes:
        features: of all views.
        pairs: numbers (a, b) of views; b is the target.
        matching, vector: settings.
        seed: of the experiment; each pair draws from a generator of its own.
    """

    features: tuple[OmniFeatures, ...]
    pairs: tuple[tuple[int, int], ...]
    matching: OmniMatchingSettings
    vector: HomingVectorSettings
    seed: int


def never_refusing(settings: HomingVectorSettings) -> HomingVectorSettings:
    """RANSAC's answer whatever speaks against it, but for the number of its inliers."""
    return dataclasses.replace(
        settings,
        min_inliers=PLAIN_INLIERS,
        max_false_alarms=1e300,
        rival_log_odds=0.0,
        max_direction_sigma_deg=180.0,
        at_target_parallax_deg=0.0,
    )


def pairs_of(count: int, *, both_ways: bool) -> list[tuple[int, int]]:
    """Pairs (a, b) of views, a before b; both ways also (b, a)."""
    return [(a, b) for a in range(count) for b in range(count) if a < b or (both_ways and a != b)]


def answer_pair(search: PairSearch, a: int, b: int) -> tuple[PairAnswer, BearingMatches]:
    """One pair's answer and its tentative matches."""
    views, rng = (search.features[a], search.features[b]), pair_generator(search.seed, a, b)
    found, matches = vector_between(*views, search.matching, search.vector, rng)
    return PairAnswer(a, b, found, len(matches), _inlier_rows(found, matches)), matches


def answer_pairs(
    search: PairSearch, context: Context, what: str = "pairs"
) -> tuple[list[PairAnswer], list[str]]:
    """All pairs in their order (stopped early, those that are done), and what went wrong."""
    stage = Stage(
        # Their numbers depend on how many views there are: fewer where a run was stopped.
        name=f"{what.replace(' ', '_')}_of_{len(search.features)}_views",
        label=what,
        count=len(search.pairs),
        work=_perform,
        argument=lambda units: search_of(search, [search.pairs[k] for k in units]),
        kind=PairAnswer,
        blocks=interleaved(_BLOCKS_A_JOB * context.jobs),
    )
    done = context.perform(stage)
    failures = [f"{len(units)} pairs: {why}" for units, why in done.ended]
    return list(done.results.values()), failures


def inlier_rows(answers: Sequence[PairAnswer]) -> dict[tuple[int, int], IntArray]:
    """Of each answered pair (a, b): (k, 2) SIFT features of both views that are inliers."""
    return {(k.a, k.b): k.rows for k in answers if k.rows is not None}


def search_of(search: PairSearch, pairs: Sequence[tuple[int, int]]) -> PairSearch:
    """The same search for some pairs only."""
    return PairSearch(search.features, tuple(pairs), search.matching, search.vector, search.seed)


def _inlier_rows(found: TwoViewVector | Refusal, matches: BearingMatches) -> IntArray | None:
    if isinstance(found, Refusal):
        return None
    kept = matches.select(found.inliers & (matches.kind == FeatureKind.SIFT))
    return np.column_stack([kept.index_a, kept.index_b])


def _perform(search: PairSearch) -> list[PairAnswer]:
    return [answer_pair(search, a, b)[0] for a, b in search.pairs]


FOLDER = "pictures"


def draw_pairs(
    folder: Path,
    views: Views,
    search: PairSearch,
    answers: Sequence[PairAnswer],
    errors: PairErrors | None,
    count: int,
) -> tuple[Picture, ...]:
    """Draws at most ``count`` answered pairs: half of them the worst, half spread over the rest.

    Without true poses the worst are those with the least inliers.
    """
    answered = [answer for answer in answers if answer.answered]
    doubt = (
        np.array([-answer.inliers for answer in answered], np.float64)
        if errors is None
        else errors.worst
    )
    order = np.argsort(-doubt, kind="stable")
    worst, rest = order[: (count + 1) // 2], order[(count + 1) // 2 :]
    spread = rest[np.linspace(0, len(rest) - 1, min(count // 2, len(rest))).round().astype(int)]
    chosen = [answered[i] for i in (*worst, *spread)]
    return tuple(draw_pair(folder, views, search, answer) for answer in chosen)


def draw_pair(folder: Path, views: Views, search: PairSearch, answer: PairAnswer) -> Picture:
    """One pair: its accepted matches on both views."""
    from fgslam.report.pictures.image_overlays import MatchedPixels, draw_view_matches

    found, matches = answer_pair(search, answer.a, answer.b)
    a, b = views.names[answer.a], views.names[answer.b]
    vector = found.found
    kept = (
        matches.select(vector.inliers)
        if isinstance(vector, TwoViewVector)
        else matches.select(np.zeros(len(matches), np.bool_))
    )
    camera = views.recording.camera
    pixels = MatchedPixels(
        _pixels(camera, kept.bearing_a, kept.elevation_a),
        _pixels(camera, kept.bearing_b, kept.elevation_b),
        kept.kind == FeatureKind.COLUMN,
    )
    caption = _caption(vector, matches) if isinstance(vector, TwoViewVector) else "refused"
    path = make_subfolder(folder, FOLDER) / f"matches_{a}_{b}.png"
    images = views.recording.image(answer.a), views.recording.image(answer.b)
    draw_view_matches(path, images, pixels, (f"view {a}: {caption}", f"view {b}"))
    return Picture(f"Matches of views {a} and {b}: {caption}", path.read_bytes())


def _caption(vector: TwoViewVector, matches: BearingMatches) -> str:
    direction, rotation = np.rad2deg([vector.direction, vector.rotation])
    return (
        f"{vector.support} of {len(matches)} matches, direction {direction:.1f}, "
        f"rotation {rotation:.1f} degrees"
    )


def _pixels(camera: OmniCamera, bearing: FloatArray, elevation: FloatArray) -> FloatArray:
    rays = np.column_stack([np.cos(bearing), np.sin(bearing), np.tan(elevation)])
    return camera.pixels(rays)
