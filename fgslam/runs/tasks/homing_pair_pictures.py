"""Pictures of pairs: their accepted matches on both views, the doubtful ones first."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fgslam.cameras.omni.protocol import OmniCamera
from fgslam.core.arrays import FloatArray
from fgslam.core.atomic_files import make_subfolder
from fgslam.core.homing import BearingMatches, FeatureKind, TwoViewVector
from fgslam.report.content import Picture
from fgslam.report.pictures.view_matches import MatchedPixels, draw_view_matches
from fgslam.runs.tasks.homing_pair_answers import PairAnswer, PairErrors
from fgslam.runs.tasks.homing_pair_search import PairSearch, answer_pair
from fgslam.runs.tasks.homing_views import Views

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
    told = _told(vector, matches) if isinstance(vector, TwoViewVector) else "refused"
    path = make_subfolder(folder, FOLDER) / f"matches_{a}_{b}.png"
    images = views.recording.image(answer.a), views.recording.image(answer.b)
    draw_view_matches(path, images, pixels, (f"view {a}: {told}", f"view {b}"))
    return Picture(f"Matches of views {a} and {b}: {told}", path.read_bytes())


def _told(vector: TwoViewVector, matches: BearingMatches) -> str:
    direction, rotation = np.rad2deg([vector.direction, vector.rotation])
    return (
        f"{vector.support} of {len(matches)} matches, direction {direction:.1f}, "
        f"rotation {rotation:.1f} degrees"
    )


def _pixels(camera: OmniCamera, bearing: FloatArray, elevation: FloatArray) -> FloatArray:
    rays = np.column_stack([np.cos(bearing), np.sin(bearing), np.tan(elevation)])
    return camera.pixels(rays)
