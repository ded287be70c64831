"""Tasks `homing_pairs` and `topological_map`: homing vectors between views, routes on their map.

Units: features of a view, pairs of views. `homing_pairs` asks every pair, judges the answers by the
true poses and sets plain SIFT with two-point RANSAC next to them; `topological_map` asks pairs that
look alike, links those that agree, and finds routes and held-out views on the map.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from fgslam.cameras.omni import unit_rays
from fgslam.core.arrays import FloatArray, IntArray, chi_square_quantile
from fgslam.core.bearings import (
    BearingMatches,
    FeatureKind,
    OmniFeatures,
    Refusal,
    RefusalReason,
    TwoViewVector,
)
from fgslam.core.errors import ConfigError, OutputError, StoredMapError
from fgslam.core.geometry import wrap
from fgslam.datasets.omni import OmniRecording
from fgslam.datasets.opening import open_checked, open_omni
from fgslam.datasets.settings import OmniDatasetSettings
from fgslam.evaluation.statistics import JsonValue
from fgslam.frontend.features.omni import OmniFeatureExtractor, empty_segments
from fgslam.frontend.homing.two_view import PLAIN_MATCHING, plain_sift
from fgslam.frontend.homing.vector import pair_generator, vector_between
from fgslam.frontend.settings import HomingVectorSettings, OmniFeatureSettings, OmniMatchingSettings
from fgslam.homing.links import UNORDERED, Answer, Link, Pair, VisualWords, Walks, sift_inliers
from fgslam.homing.places import Localiser, transition_along
from fgslam.homing.topological_map import TopologicalMap, map_candidates, map_of_answers
from fgslam.report.content import Figure, Picture, TextTable, write_csv
from fgslam.report.homing_figures import (
    Links,
    claimed_against_true,
    network_figure,
    sorted_errors,
    unfolded,
)
from fgslam.runs.config import HomingPairsConfig, TopologicalMapConfig
from fgslam.runs.engine import Context, Opening, RunResult, Task, provenance_of
from fgslam.runs.results import (
    draw_picture,
    finish,
    median,
    metrics_table,
    numbers_table,
    write_table,
)

VIEWS_A_BLOCK = 4
_BLOCKS_A_JOB = 4  # so that progress moves, and no process waits long for the last one
PLAIN_INLIERS = 25
"""Inliers from which on an answer of the reference, which never refuses, counts."""
_GOOD_DEG = 2.0
WRONG_DEG = 10.0
"""An answer whose direction or rotation is off by more is a wrong one."""


# --------------------------------------------------------------------------------------------
# Task homing_pairs


def open_pairs(config: HomingPairsConfig, opening: Opening) -> Task[RunResult]:
    """Opens the recording. Raises DatasetError."""
    views = open_checked(config.dataset)
    return Task(provenance_of(views), lambda context: _run_pairs(config, views, context))


def _run_pairs(config: HomingPairsConfig, views: OmniRecording, context: Context) -> RunResult:
    """Features once an image, then every pair; stopped early, the pairs that are done count."""
    folder = context.folder
    features = extract_features(views, config.dataset, config.features, context)
    search = PairSearch(
        tuple(features),
        tuple(itertools.combinations(range(len(features)), 2)),
        config.features.matching,
        config.homing_vector,
        config.seed,
    )
    answers, failures = answer_pairs(search, context)
    whole = len(features) == len(views) and len(answers) == len(search.pairs)
    write_pairs(folder / "pairs.csv", answers, view_names(views))
    numbers = _numbers(answers, views)
    numbers["images"] = len(features)
    reference = _reference(config, views, context) if whole and config.reference else None
    numbers["reference"] = reference
    every = len(views) * (len(views) - 1) // 2
    left = every - len(answers)
    lines = [
        f"{numbers['answered']} of {len(answers)} pairs are answered."
        + f" {left} more are not answered yet." * bool(left)
    ]
    if reference is not None:
        lines.append(
            f"Plain SIFT with at least {PLAIN_INLIERS} inliers answers {reference['answered']}."
        )
    answered = [answer for answer in answers if answer.answered]
    uncertainty = -np.array([answer.inliers for answer in answered])
    figures: list[Figure] = []
    if views.poses is None:
        lines.append("How accurate they are is not known: there are no true poses.")
    else:
        errors = pair_errors(answers, views.poses, views.rooms)
        uncertainty = worst(errors)
        figures = list(_pair_figures(errors, answers, views.poses, view_names(views)))
        if len(errors):
            lines.append(
                f"The median error is {errors.direction.abs().median():.2f} degrees of the "
                f"direction and {errors.rotation.abs().median():.2f} of the rotation; the worst "
                f"answer is off by {uncertainty.max():.1f} degrees."
            )
    return finish(
        config,
        folder,
        whole and not context.stopped(),
        numbers,
        f"{len(answers)} pairs of {len(features)} views of {views.name}",
        figures,
        draw_uncertain(folder, views, search, answered, uncertainty, config.output.pictures),
        lines=tuple(lines),
        tables=error_tables(numbers["errors"]),
        notes=(*views.notes, *failures),
        reached=f"after {len(answers)} of {every} pairs",
    )


def _reference(
    config: HomingPairsConfig, views: OmniRecording, context: Context
) -> dict[str, Any] | None:
    """The same pairs by plain SIFT and two-point RANSAC; None where not all are done."""
    features = extract_features(views, config.dataset, None, context)
    every = tuple(itertools.combinations(range(len(features)), 2))
    # RANSAC's first answer whatever speaks against it, but for the number of its inliers.
    never_refusing = replace(
        config.homing_vector,
        min_inliers=PLAIN_INLIERS,
        max_false_alarms=1e300,
        rival_log_odds=0.0,
        max_direction_sigma_deg=180.0,
        at_target_parallax_deg=0.0,
        second_look=False,
    )
    search = PairSearch(tuple(features), every, PLAIN_MATCHING, never_refusing, config.seed)
    found, _ = answer_pairs(search, context, "plain pairs")
    if len(features) < len(views) or len(found) < len(every):
        return None
    few = Refusal(RefusalReason.TOO_FEW_INLIERS, f"{PLAIN_INLIERS} inliers are needed")
    answers = [
        replace(one, found=few, rows=None) if one.answered and one.inliers < PLAIN_INLIERS else one
        for one in found
    ]
    write_pairs(context.folder / "reference_pairs.csv", answers, view_names(views))
    return _numbers(answers, views)


# --------------------------------------------------------------------------------------------
# Task topological_map


def open_topological_map(config: TopologicalMapConfig, opening: Opening) -> Task[RunResult]:
    """Opens the recording. Raises DatasetError, or ConfigError of routes to unknown views."""
    views = open_checked(config.dataset)
    names = view_names(views)
    for name in itertools.chain(*config.routes):
        if name not in names:
            raise ConfigError(
                f"routes: there is no view {name}; {config.dataset.path} has {names[0]} to "
                f"{names[-1]}"
            )
    return Task(provenance_of(views), lambda context: _run_map(config, views, context))


def _run_map(config: TopologicalMapConfig, views: OmniRecording, context: Context) -> RunResult:
    """Features once a view, homings of all candidates both ways, the map of those that agree."""
    folder = context.folder
    features = extract_features(views, config.dataset, config.features, context)
    rng = np.random.default_rng(config.seed)
    candidates = map_candidates(features, config.map, rng, _walks(config, len(features)))
    pairs = tuple(pair for a, b in candidates for pair in ((a, b), (b, a)))
    matching, vector = config.features.matching, config.homing_vector
    search = PairSearch(tuple(features), pairs, matching, vector, config.seed)
    found, failures = answer_pairs(search, context)
    names = view_names(views)[: len(features)]
    topology = _map_of(config, features, found, list(range(len(features))), names)
    kilobytes = topology.save(folder / "map.npz")
    routes = [_route(topology, asked) for asked in config.routes]
    located = _localise(config, features, found, names, context)
    parts, links = topology.components(), link_table(topology, views.poses)
    numbers: dict[str, JsonValue] = {
        "nodes": len(topology),
        "homings_tried": len(found),
        "links": len(links),
        "components": len(parts),
        "largest_component": len(parts[0]) if parts else 0,
        "outside_largest": [topology.names[k] for part in parts[1:] for k in part.tolist()],
        "longest_link_places": max(links["places_apart"], default=None),
        "longest_link_m": max(links["distance_m"].dropna(), default=None),
        "least_support": min(links["inliers"], default=None),
        "pairs_not_linked": len(topology.rejected),
        "kilobytes_per_view": kilobytes,
        "routes": [
            {"asked": list(r.asked), "found": list(r.found), "reason": r.reason or None}
            for r in routes
        ],
        "routes_found": sum(not r.reason for r in routes),
        "localisation": None
        if located is None
        else {
            "held_out": len(located),
            "at_a_neighbour": sum(one.neighbour for one in located),
            "last_probability": located[-1].probability if located else None,
        },
    }
    write_links(folder, topology, views.poses)
    rows = [["-".join(r.asked), "-".join(r.found), r.reason] for r in routes]
    write_csv(folder / "routes.csv", Route._fields, rows)
    if located is not None:
        write_csv(folder / "localisation.csv", Localised._fields, located)
    lines = [
        f"{numbers['largest_component']} of {len(topology)} views are connected by "
        f"{numbers['links']} links; there are {numbers['components']} parts."
    ]
    lines += [
        f"From {r.asked[0]} to {r.asked[-1]}: {'-'.join(r.found) or 'no way'}." for r in routes
    ]
    if located:
        right = sum(one.neighbour for one in located)
        lines.append(f"Localisation finds {right} of {len(located)} held-out views at a neighbour.")
    missing = [f"route {'-'.join(r.asked)}: {r.reason}" for r in routes if r.reason]
    whole = len(features) == len(views) and len(found) == len(pairs) and not context.stopped()
    by_pair = {(one.a, one.b): one for one in found}
    linked = [by_pair[link.a, link.b] for link in topology.links]
    uncertainty = -np.array([link.support for link in topology.links])
    return finish(
        config,
        folder,
        whole,
        numbers,
        f"{len(topology)} views of {views.name}",
        (map_figure(topology, views.poses),),
        draw_uncertain(folder, views, search, linked, uncertainty, config.output.pictures),
        lines=tuple(lines),
        tables=(numbers_table("map", "The map", numbers, _MAP_ROWS),),
        notes=(*views.notes, *failures, *missing),
    )


class Route(NamedTuple):
    """A path on the map that was asked for: a row of routes.csv.

    Attributes:
        asked: names of the nodes, start first; further ones must lie one link apart.
        found: names of the cheapest path's nodes; empty where there is none.
        reason: why there is none, or which link of those asked for is absent; else empty.
    """

    asked: tuple[str, ...]
    found: tuple[str, ...]
    reason: str


def _route(topology: TopologicalMap, asked: tuple[str, ...]) -> Route:
    try:
        nodes = [topology.names.index(name) for name in asked]
        path = topology.route(nodes[0], nodes[-1])
    except (StoredMapError, ValueError) as error:
        return Route(asked, (), str(error))
    links = {(link.a, link.b) for link in topology.links}
    absent = [
        f"{topology.names[a]}-{topology.names[b]}"
        for a, b in itertools.pairwise(nodes)
        if len(nodes) > 2 and (min(a, b), max(a, b)) not in links
    ]
    reason = f"no link {', '.join(absent)}" if absent else ""
    return Route(asked, tuple(topology.names[k] for k in path), reason)


class Localised(NamedTuple):
    """What became of one held-out view: a row of localisation.csv.

    Attributes:
        view: its name.
        node: name of the node that is the most probable one then.
        probability: of this node.
        neighbour: whether the node is the next one before or after the view in the recording.
    """

    view: str
    node: str
    probability: float
    neighbour: bool


def _localise(
    config: TopologicalMapConfig,
    features: Sequence[OmniFeatures],
    found: Sequence[PairAnswer],
    names: Sequence[str],
    context: Context,
) -> list[Localised] | None:
    """Holds out every so many views, maps the others, and walks through those held out.

    Nothing is known at first; from then on the belief goes along the map's links. None where
    nothing is held out, or there is no time.
    """
    every = config.held_out_every
    if not every or context.stopped():
        return None
    out = list(range(every - 1, len(features), every))
    kept = [k for k in range(len(features)) if k not in set(out)]
    nodes = [features[k] for k in kept]
    topology = _map_of(config, nodes, found, kept, [names[k] for k in kept])
    rng = np.random.default_rng((config.seed, 1))

    def linker(image: OmniFeatures, which: Sequence[int]) -> dict[int, TwoViewVector | Refusal]:
        matching, vector = config.features.matching, config.homing_vector
        return {k: vector_between(image, nodes[k], matching, vector, rng)[0] for k in which}

    moves = transition_along(topology.graph())
    localiser = Localiser(moves, VisualWords(nodes, rng), linker, config.localisation)
    located: list[Localised] = []
    context.progress("localising", 0, len(out))
    for k in context.steps("localising", range(len(out))):
        view = out[k]
        localiser.update(features[view])
        node, probability = localiser.best()
        low, high = sorted((view, kept[node]))
        neighbour = not any(low < k < high for k in kept if k != kept[node])
        located.append(Localised(names[view], names[kept[node]], probability, neighbour))
    return located


def _map_of(
    config: TopologicalMapConfig,
    nodes: Sequence[OmniFeatures],
    found: Sequence[PairAnswer],
    views: Sequence[int],
    names: Sequence[str],
) -> TopologicalMap:
    """The map of some views by the answers about their pairs, which are renumbered."""
    number = {view: k for k, view in enumerate(views)}
    among = {(number[k.a], number[k.b]): k for k in found if k.a in number and k.b in number}
    answers: dict[Pair, Answer] = {pair: k.found for pair, k in among.items()}
    rows = {pair: k.rows for pair, k in among.items() if k.rows is not None}
    walks = _walks(config, len(views))
    return map_of_answers(nodes, answers, walks=walks, names=names, rows=rows)


def _walks(config: TopologicalMapConfig, count: int) -> Walks:
    """One walk through all views of an ordered set."""
    return Walks((count,)) if config.ordered else UNORDERED


_MAP_ROWS = {
    "nodes": "nodes",
    "links": "links",
    "parts": "components",
    "views in the largest part": "largest_component",
    "longest link, places apart in the recording": "longest_link_places",
    "longest link, metres": "longest_link_m",
    "fewest inliers of a link": "least_support",
    "pairs tried and not linked": "pairs_not_linked",
}


def link_table(topology: TopologicalMap, poses: FloatArray | None = None) -> pd.DataFrame:
    """The columns of links.csv; lengths where places (n, 3) are known."""
    links, names = topology.links, topology.names
    a, b = (np.array([getattr(k, end) for k in links], np.int64) for end in "ab")
    angles = np.rad2deg(np.array([(k.direction, k.rotation, k.back) for k in links]).reshape(-1, 3))
    variances = [np.diagonal(link.covariance) for link in links]
    sigmas = np.rad2deg(np.sqrt(np.array(variances).reshape(-1, 2)))
    lengths = np.full(len(links), np.nan)
    if poses is not None:
        lengths = np.hypot(*(poses[b, :2] - poses[a, :2]).T)
    return pd.DataFrame(
        {
            "from": [names[k] for k in a],
            "to": [names[k] for k in b],
            "direction_deg": angles[:, 0],
            "sigma_direction_deg": sigmas[:, 0],
            "rotation_deg": angles[:, 1],
            "sigma_rotation_deg": sigmas[:, 1],
            "back_deg": angles[:, 2],
            "inliers": [link.support for link in links],
            "cost": topology.costs,
            "places_apart": b - a,
            "distance_m": lengths,
        }
    )


def write_links(folder: Path, topology: TopologicalMap, poses: FloatArray | None = None) -> None:
    """links.csv; lengths where places (n, 3) are known. Raises OutputError."""
    write_table(folder / "links.csv", link_table(topology, poses))


# --------------------------------------------------------------------------------------------
# Features and pairs of views


def view_names(views: OmniRecording) -> tuple[str, ...]:
    """(n) the recording's own numbers of its views, as text."""
    return tuple(str(number) for number in views.ids.tolist())


def extract_features(
    views: OmniRecording,
    dataset: OmniDatasetSettings,
    settings: OmniFeatureSettings | None,
    context: Context,
) -> list[OmniFeatures]:
    """Features of all views in their order; stopped early, of the first ones without a gap.

    Args:
        views: opened.
        dataset: that it is opened with, in any process.
        settings: of the features; None for plain SIFT, the baseline.
        context: of the run.

    Raises:
        DatasetError: a view cannot be read.
        OutputError: a process ended by itself, perhaps for lack of memory.
    """
    what = "features" if settings is not None else "plain SIFT"
    names, work = (what.replace(" ", "_"), what), partial(_extract, dataset, settings)
    done = context.perform(names, work, range(len(views)), OmniFeatures, VIEWS_A_BLOCK)
    if done.ended and not context.stopped():
        raise OutputError(f"features of {views.name}: {done.ended[0][1]}")
    gap = next((k for k in range(len(views)) if k not in done.results), len(views))
    return [done.results[k] for k in range(gap)]


def _extract(
    dataset: OmniDatasetSettings, settings: OmniFeatureSettings | None, i: int
) -> OmniFeatures:
    recording = open_omni(dataset)
    if settings is None:
        return OmniFeatures(plain_sift(recording.camera, recording.image(i)), empty_segments())
    return _extractor(dataset, settings).extract(recording.image(i))


@lru_cache(maxsize=1)
def _extractor(dataset: OmniDatasetSettings, settings: OmniFeatureSettings) -> OmniFeatureExtractor:
    """Its maps take as long as an image's features; a process does several views."""
    return OmniFeatureExtractor(open_omni(dataset).camera, settings)


@dataclass(frozen=True, slots=True, eq=False)
class PairAnswer:
    """The answer about one pair.

    Attributes:
        a, b: numbers of the views; b is the target.
        found: the homing vector, or why there is none.
        matches: tentative ones.
        rows: (k, 2) SIFT features of both views that are inliers; None where they were not kept.
    """

    a: int
    b: int
    found: TwoViewVector | Refusal
    matches: int
    rows: IntArray | None = None

    @property
    def answered(self) -> bool:
        """Whether there is a homing vector."""
        return isinstance(self.found, TwoViewVector)

    @property
    def inliers(self) -> int:
        """Of the answer; 0 where there is none."""
        return self.found.support if isinstance(self.found, TwoViewVector) else 0


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

    def answer(self, a: int, b: int) -> tuple[TwoViewVector | Refusal, BearingMatches]:
        """One pair's homing vector and its tentative matches."""
        views, rng = (self.features[a], self.features[b]), pair_generator(self.seed, a, b)
        return vector_between(*views, self.matching, self.vector, rng)


def answer_pairs(
    search: PairSearch, context: Context, what: str = "pairs"
) -> tuple[list[PairAnswer], list[str]]:
    """All pairs in their order (stopped early, those that are done), and what went wrong."""
    # Their numbers depend on how many views there are: fewer where a run was stopped.
    names = f"{what.replace(' ', '_')}_of_{len(search.features)}_views", what
    block = max(1, -(-len(search.pairs) // (_BLOCKS_A_JOB * context.jobs)))
    work = partial(_answer, replace(search, pairs=()))
    done = context.perform(names, work, search.pairs, PairAnswer, block)
    failures = [f"{len(units)} pairs: {why}" for units, why in done.ended]
    return list(done.results.values()), failures


def _answer(search: PairSearch, pair: tuple[int, int]) -> PairAnswer:
    found, matches = search.answer(*pair)
    return PairAnswer(*pair, found, len(matches), sift_inliers(found, matches))


# --------------------------------------------------------------------------------------------
# Errors of pairs


def true_pair(wTa: FloatArray, wTb: FloatArray) -> tuple[float, float]:
    """Direction of b seen from a against a's heading, and b's heading minus a's; radians."""
    offset = wTb[:2] - wTa[:2]
    direction = np.arctan2(offset[1], offset[0]) - wTa[2]
    return float(wrap(direction)), float(wrap(wTb[2] - wTa[2]))


def pair_errors(
    answers: Sequence[PairAnswer], poses: FloatArray, rooms: Sequence[str] | None = None
) -> pd.DataFrame:
    """Errors of the answered pairs, degrees, a row each.

    Args:
        answers: of any pairs; those without an answer are passed over.
        poses: (m, 3) true planar poses of all views, metres and radians.
        rooms: of all views; None where they are not known.

    Returns:
        ``direction`` and ``rotation`` minus truth, their stated standard deviations ``sigma_*``,
        the squared error ``mahalanobis2`` in units of the stated joint covariance, and where rooms
        are known whether both views are of the ``same_room``.
    """
    found = [(p, p.found) for p in answers if isinstance(p.found, TwoViewVector)]
    errors = np.zeros((len(found), 2))
    covariances = np.zeros((len(found), 2, 2))
    for k, (pair, vector) in enumerate(found):
        truth = true_pair(poses[pair.a], poses[pair.b])
        errors[k] = wrap(np.array([vector.direction, vector.rotation]) - truth)
        covariances[k] = vector.covariance
    solved = np.linalg.solve(covariances, errors[..., None])[..., 0]
    sigmas = np.rad2deg(np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)))
    table = pd.DataFrame(np.rad2deg(errors), columns=["direction", "rotation"])
    table[["sigma_direction", "sigma_rotation"]] = sigmas
    table["mahalanobis2"] = np.sum(errors * solved, axis=1)
    if rooms is not None:
        table["same_room"] = np.array([rooms[p.a] == rooms[p.b] for p, _ in found], np.bool_)
    return table


def worst(errors: pd.DataFrame) -> FloatArray:
    """(n,) larger of both errors' sizes, degrees."""
    return errors[["direction", "rotation"]].abs().max(axis=1).to_numpy()


def _numbers(answers: Sequence[PairAnswer], views: OmniRecording) -> dict[str, Any]:
    poses, rooms = views.poses, views.rooms
    errors = None if poses is None else error_numbers(pair_errors(answers, poses, rooms))
    return answer_numbers(answers) | {"errors": errors}


def answer_numbers(answers: Sequence[PairAnswer]) -> dict[str, Any]:
    """How many pairs were answered, and why the others were not."""
    reasons = Counter(p.found.reason.value for p in answers if isinstance(p.found, Refusal))
    inliers = [pair.inliers for pair in answers if pair.answered]
    return {
        "pairs": len(answers),
        "answered": len(inliers),
        "refused": dict(sorted(reasons.items())),
        "inliers_median": median(inliers),
    }


def error_numbers(errors: pd.DataFrame) -> dict[str, Any]:
    """The metrics of :func:`pair_errors`: sizes, the worst, and whether the sigmas hold."""
    numbers: dict[str, Any] = {"answered": len(errors)}
    if len(errors):
        for name in ("direction", "rotation"):
            size = errors[name].abs().to_numpy()
            numbers[f"{name}_median_deg"] = float(np.median(size))
            numbers[f"{name}_p95_deg"] = float(np.percentile(size, 95))
            numbers[f"{name}_worst_deg"] = float(size.max())
        numbers["worse_than_10_deg"] = int(np.count_nonzero(worst(errors) > WRONG_DEG))
        squared = errors["mahalanobis2"].to_numpy()
        numbers["covered_joint_95"] = float(np.mean(squared <= chi_square_quantile(0.95, 2)))
        for name in ("direction", "rotation"):
            held = errors[name].abs() <= 2.0 * errors[f"sigma_{name}"]
            numbers[f"covered_{name}_2_sigma"] = float(np.mean(held))
        numbers["nees_per_dof"] = float(np.mean(squared) / 2.0)
    if "same_room" in errors:
        same, plain = errors["same_room"], errors.drop(columns="same_room")
        numbers["same_room"] = error_numbers(plain[same])
        numbers["different_rooms"] = error_numbers(plain[~same])
    return numbers


_ERROR_COLUMNS = (
    ("answered", "answered", "d", "pairs with a homing vector"),
    ("direction deg median", "direction_median_deg", ".2f", "absolute error of the direction"),
    ("p95", "direction_p95_deg", ".2f", "95 % of the answers are better"),
    ("rotation deg median", "rotation_median_deg", ".2f", "absolute error of the rotation"),
    ("p95 ", "rotation_p95_deg", ".2f", "95 % of the answers are better"),
    ("worse than 10 deg", "worse_than_10_deg", "d", "answers whose direction or rotation is"),
    ("covered joint 95 %", "covered_joint_95", ".1%", "errors within the stated joint 95 % region"),
    ("NEES", "nees_per_dof", ".2f", "normalised error squared per degree of freedom: 1 is right"),
)


def error_tables(numbers: Mapping[str, Any] | None) -> tuple[TextTable, ...]:
    """:func:`error_numbers` of all pairs, and of those within one room and not; none without."""
    if numbers is None:
        return ()
    parts = [name for name in ("same_room", "different_rooms") if name in numbers]
    groups = {"all pairs": numbers} | {name.replace("_", " "): numbers[name] for name in parts}
    heading = "Errors of the answered pairs"
    return (metrics_table("errors", heading, "pairs", _ERROR_COLUMNS, groups),)


def write_pairs(path: Path, answers: Sequence[PairAnswer], names: Sequence[str]) -> None:
    """pairs.csv: a row for each pair, degrees, counter-clockwise positive. Raises OutputError."""
    write_csv(path, _PAIR_COLUMNS, (_pair_row(pair, names) for pair in answers))


_PAIR_COLUMNS = (
    "from", "to", "answered", "direction_deg", "sigma_direction_deg", "rotation_deg",
    "sigma_rotation_deg", "inliers", "reason",
)  # fmt: skip


def _pair_row(pair: PairAnswer, names: Sequence[str]) -> list[Any]:
    start, found = [names[pair.a], names[pair.b], pair.answered], pair.found
    if isinstance(found, TwoViewVector):
        sigma = np.rad2deg(np.sqrt(np.diagonal(found.covariance)))
        direction, rotation = np.rad2deg([found.direction, found.rotation])
        return [*start, direction, sigma[0], rotation, sigma[1], found.support, ""]
    turn = None if found.rotation is None else np.rad2deg(found.rotation)
    return [*start, None, None, turn, None, 0, found.reason.value]


# --------------------------------------------------------------------------------------------
# Figures and pictures


def _pair_figures(
    errors: pd.DataFrame, answers: Sequence[PairAnswer], poses: FloatArray, names: Sequence[str]
) -> Iterator[Figure]:
    """The pairs from above by the size of their errors, and how good they are."""
    kinds = {
        f"off by less than {_GOOD_DEG:g} degrees": (0.0, _GOOD_DEG),
        f"off by {_GOOD_DEG:g} to {WRONG_DEG:g} degrees": (_GOOD_DEG, WRONG_DEG),
        f"off by more than {WRONG_DEG:g} degrees": (WRONG_DEG, np.inf),
    }
    answered, size = [answer for answer in answers if answer.answered], worst(errors)
    links = []
    for k, (kind, (low, high)) in enumerate(kinds.items()):
        rows = np.flatnonzero((size >= low) & (size < high)).tolist()
        pairs = tuple((answered[i].a, answered[i].b) for i in rows)
        labels = tuple(
            f"{names[answered[i].a]} to {names[answered[i].b]}: direction off by "
            f"{errors.direction[i]:.2f} degrees, rotation by {errors.rotation[i]:.2f}"
            for i in rows
        )
        links.append(Links(kind, k, pairs, labels))
    refused = tuple((answer.a, answer.b) for answer in answers if not answer.answered)
    labels = tuple(f"{names[a]} to {names[b]}: refused" for a, b in refused)
    links.append(Links("refused", 3, refused, labels, shown=False))
    about = (
        "Views at their true places, and the pairs that are answered; the switches choose by the "
        "larger of the errors of direction and rotation."
    )
    yield network_figure(("pairs", "The pairs, from above", about), poses[:, :2], names, links)
    true = {name: errors[name].to_numpy() for name in ("direction", "rotation")}
    claimed = {name: errors[f"sigma_{name}"].to_numpy() for name in true}
    yield sorted_errors(true, "degrees", ("errors", "Errors of the answered pairs"))
    yield claimed_against_true(claimed, true)


def map_figure(topology: TopologicalMap, poses: FloatArray | None = None) -> Figure:
    """The map from above, its nodes at their true places (n, 3) where these are known."""
    names, pairs = topology.names, tuple((link.a, link.b) for link in topology.links)
    if poses is None:
        places, axes = unfolded(len(topology), pairs), ("", "")
        where = (
            "There are no true places: views are drawn so that distances are as along the links."
        )
    else:
        places, axes = poses[: len(topology), :2], ("x (m)", "y (m)")
        where = "Views at their true places."
    rejected = tuple(sorted(topology.rejected))
    why = tuple(f"{names[a]} to {names[b]}: {topology.rejected[a, b]}" for a, b in rejected)
    kinds = (
        Links("links", 0, pairs, tuple(_link_label(names, link) for link in topology.links)),
        Links("tried, no link", 1, rejected, why, shown=False),
    )
    words = ("map", "The topological map", f"{where} A line is a homing that is accepted.")
    return network_figure(words, places, names, kinds, axes)


def _link_label(names: Sequence[str], link: Link) -> str:
    ends = f"{names[link.a]} to {names[link.b]}"
    if not link.support:
        return f"{ends}: driven, but without a homing vector"
    return f"{ends}: {link.support} inliers, rotation {np.rad2deg(link.rotation):.0f} degrees"


def draw_uncertain(
    folder: Path,
    views: OmniRecording,
    search: PairSearch,
    answered: Sequence[PairAnswer],
    uncertainty: FloatArray | IntArray,
    count: int,
) -> tuple[Picture, ...]:
    """Draws at most ``count`` answers: half the most doubtful, half spread over the rest.

    ``uncertainty`` (n,): errors, or inliers, negated.
    """
    order = np.argsort(-uncertainty, kind="stable")
    first, rest = order[: (count + 1) // 2], order[(count + 1) // 2 :]
    spread = rest[np.linspace(0, len(rest) - 1, min(count // 2, len(rest))).round().astype(int)]
    return tuple(_draw_pair(folder, views, search, answered[i]) for i in (*first, *spread))


def _draw_pair(
    folder: Path, views: OmniRecording, search: PairSearch, answer: PairAnswer
) -> Picture:
    """One pair: its accepted matches on both views."""
    from fgslam.report.overlays import draw_view_matches

    vector, matches = search.answer(answer.a, answer.b)
    kept, caption = matches.select(np.zeros(len(matches), np.bool_)), "refused"
    if isinstance(vector, TwoViewVector):
        kept = matches.select(vector.inliers)
        direction, rotation = np.rad2deg([vector.direction, vector.rotation])
        caption = (
            f"{vector.support} of {len(matches)} matches, direction {direction:.1f}, "
            f"rotation {rotation:.1f} degrees"
        )
    here = views.camera.pixels(unit_rays(kept.bearing_a, kept.elevation_a))
    there = views.camera.pixels(unit_rays(kept.bearing_b, kept.elevation_b))
    a, b = view_names(views)[answer.a], view_names(views)[answer.b]
    images = views.image(answer.a), views.image(answer.b)
    titles = (f"view {a}: {caption}", f"view {b}")
    seen: dict[str, Any] = {"pixels": (here, there), "columns": kept.kind == FeatureKind.COLUMN}
    draw = partial(draw_view_matches, images=images, titles=titles, **seen)
    about = f"Matches of views {a} and {b}: {caption}"
    return draw_picture(folder, f"matches_{a}_{b}.png", about, draw)
