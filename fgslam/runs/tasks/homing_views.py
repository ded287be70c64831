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
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from fgslam.cameras.omni import OmniCamera
from fgslam.core.arrays import BoolArray, FloatArray, IntArray, Rows, chi_square_quantile
from fgslam.core.bearings import (
    BearingMatches,
    FeatureKind,
    OmniFeatures,
    Refusal,
    RefusalReason,
    TwoViewVector,
)
from fgslam.core.errors import ConfigError, OutputError, StoredMapError
from fgslam.core.files import make_subfolder
from fgslam.core.geometry import wrap
from fgslam.datasets.omni import OmniRecording
from fgslam.datasets.omni_checks import open_checked
from fgslam.datasets.opening import open_omni
from fgslam.datasets.settings import OmniDatasetSettings
from fgslam.evaluation.statistics import JsonValue
from fgslam.frontend.features.omni import OmniFeatureExtractor, empty_segments
from fgslam.frontend.features.settings import OmniFeatureSettings, OmniMatchingSettings
from fgslam.frontend.homing.settings import HomingVectorSettings
from fgslam.frontend.homing.two_view import PLAIN_MATCHING, plain_sift
from fgslam.frontend.homing.vector import pair_generator, vector_between
from fgslam.homing.links import UNORDERED, Answer, Link, Pair, VisualWords, Walks, sift_inliers
from fgslam.homing.places import Localiser
from fgslam.homing.topological_map import TopologicalMap, map_candidates, map_of_answers
from fgslam.report.content import Cell, Column, Figure, Picture, TextTable, write_csv
from fgslam.report.homing_figures import (
    Links,
    claimed_against_true,
    network_figure,
    sorted_errors,
    unfolded,
)
from fgslam.runs.config import HomingPairsConfig, TopologicalMapConfig
from fgslam.runs.engine import (
    Context,
    Opening,
    RunResult,
    Task,
    provenance_of,
    write_document,
    write_page,
)
from fgslam.runs.units import Stage, in_blocks, interleaved

PAIRS_FILE = "pairs.csv"
REFERENCE_FILE = "reference_pairs.csv"
MAP_FILE = "map.npz"
LINKS_FILE = "links.csv"
ROUTES_FILE = "routes.csv"
LOCALISATION_FILE = "localisation.csv"
VIEWS_A_BLOCK = 4
_BLOCKS_A_JOB = 4  # so that progress moves, and no process waits long for the last one
PLAIN_INLIERS = 25
"""Inliers from which on an answer of the reference, which never refuses, counts."""
_GOOD_DEG = 2.0
WRONG_DEG = 10.0
"""An answer whose direction or rotation is off by more is a wrong one."""
Found = TypeVar("Found")


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
    write_pairs(folder / PAIRS_FILE, answers, view_names(views))
    errors, numbers = _judged(answers, views)
    numbers["images"] = len(features)
    numbers["reference"] = (
        _reference(config, views, context) if whole and config.reference else None
    )
    left = len(views) * (len(views) - 1) // 2 - len(answers)
    sentences = _accuracy(numbers, errors)
    sentences[0] += f" {left} more are not answered yet." if left else ""
    result = RunResult(
        config,
        folder,
        "finished" if whole and not context.stopped() else "interrupted",
        tuple(sentences),
        error_tables(errors),
        (*views.notes, *failures),
        reached=f"after {len(answers)} of {len(answers) + left} pairs",
    )
    write_document(result, numbers)
    doubts = (
        -np.array([k.inliers for k in answers if k.answered]) if errors is None else errors.worst
    )
    pictures = draw_doubtful(folder, views, search, answers, doubts, config.output.pictures)
    figures = tuple(_figures(errors, answers, views))
    write_page(
        result,
        f"{len(answers)} pairs of {len(features)} views of {views.name}",
        figures=figures,
        pictures=pictures,
    )
    return result


def _reference(
    config: HomingPairsConfig, views: OmniRecording, context: Context
) -> dict[str, JsonValue] | None:
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
    answers = []
    for answer in found:
        if answer.answered and answer.inliers < PLAIN_INLIERS:
            why = f"{answer.inliers} inliers of {PLAIN_INLIERS} needed"
            few = Refusal(RefusalReason.TOO_FEW_INLIERS, why)
            answer = PairAnswer(answer.a, answer.b, few, answer.matches)
        answers.append(answer)
    write_pairs(context.folder / REFERENCE_FILE, answers, view_names(views))
    return _judged(answers, views)[1]


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
    """Features once a view, homings of all candidates both ways, the map of those believed."""
    folder = context.folder
    features = extract_features(views, config.dataset, config.features, context)
    walks = _walks(config, len(features))
    rng = np.random.default_rng(config.seed)
    candidates = map_candidates(features, config.map, rng, walks)
    pairs = tuple(pair for a, b in candidates for pair in ((a, b), (b, a)))
    matching, vector = config.features.matching, config.homing_vector
    search = PairSearch(tuple(features), pairs, matching, vector, config.seed)
    found, failures = answer_pairs(search, context)
    names = view_names(views)[: len(features)]
    topology = _map_of(config, features, found, list(range(len(features))), names)
    kilobytes = topology.save(folder / MAP_FILE)
    routes = [_route(topology, asked) for asked in config.routes]
    located = _localise(config, features, found, names, context)
    whole = len(features) == len(views) and len(found) == len(pairs) and not context.stopped()
    numbers = _map_numbers(topology, views, len(found), kilobytes, routes, located)
    missing = [f"route {'-'.join(r.asked)}: {r.reason}" for r in routes if r.reason]
    result = RunResult(
        config,
        folder,
        "finished" if whole else "interrupted",
        _map_sentences(topology, routes, located),
        (_map_table(numbers),),
        (*views.notes, *failures, *missing),
    )
    write_links(folder, topology, views.poses)
    rows = [["-".join(r.asked), "-".join(r.found), r.reason] for r in routes]
    write_csv(folder / ROUTES_FILE, ("asked", "found", "reason"), rows)
    if located is not None:
        write_csv(folder / LOCALISATION_FILE, Localised._fields, located)
    write_document(result, numbers)
    lengths = link_lengths(topology, views.poses)
    if lengths is None:
        lengths = np.array([float(link.b - link.a) for link in topology.links])
    count = config.output.pictures
    # The doubtful links: half of them the longest ones, half those with the fewest inliers.
    longest = np.argsort(-lengths, kind="stable")[: (count + 1) // 2].tolist()
    support = np.array([link.support for link in topology.links])
    weakest = np.argsort(support, kind="stable")[: count // 2].tolist()
    by_pair = {(k.a, k.b): k for k in found}
    doubtful = [topology.links[k] for k in dict.fromkeys([*longest, *weakest])]
    write_page(
        result,
        f"{len(topology)} views of {views.name}",
        figures=(map_figure(topology, views.poses),),
        pictures=tuple(draw_pair(folder, views, search, by_pair[k.a, k.b]) for k in doubtful),
    )
    return result


@dataclass(frozen=True, slots=True)
class Route:
    """A way on the map that was asked for.

    Attributes:
        asked: names of the nodes, start first; further ones must lie one link apart.
        found: names of the cheapest way's nodes; empty where there is none.
        reason: why there is none, or which link of those asked for is absent; empty if all is
            well.
    """

    asked: tuple[str, ...]
    found: tuple[str, ...]
    reason: str


def _route(topology: TopologicalMap, asked: tuple[str, ...]) -> Route:
    """The cheapest way between the ends, and whether every step that was asked for is a link."""
    try:
        nodes = [topology.names.index(name) for name in asked]
        way = topology.route(nodes[0], nodes[-1])
    except (StoredMapError, ValueError) as error:
        return Route(asked, (), str(error))
    links = {(link.a, link.b) for link in topology.links}
    absent = [
        f"{topology.names[a]}-{topology.names[b]}"
        for a, b in itertools.pairwise(nodes)
        if len(nodes) > 2 and (min(a, b), max(a, b)) not in links
    ]
    reason = f"no link {', '.join(absent)}" if absent else ""
    return Route(asked, tuple(topology.names[k] for k in way), reason)


class Localised(NamedTuple):
    """What became of one held-out view: a row of localisation.csv.

    Attributes:
        view: its name.
        node: name of the node that the belief then liked best.
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

    def linker(image: OmniFeatures, node: int) -> TwoViewVector | Refusal:
        matching, vector = config.features.matching, config.homing_vector
        return vector_between(image, nodes[node], matching, vector, rng)[0]

    localiser = Localiser(topology, VisualWords(nodes, rng), linker, config.localisation)
    located: list[Localised] = []
    context.progress("localising", 0, len(out))
    for done, view in enumerate(out):
        if context.stopped():
            break
        localiser.update(features[view])
        node, probability = localiser.best()
        low, high = sorted((view, kept[node]))
        neighbour = not any(low < k < high for k in kept if k != kept[node])
        located.append(Localised(names[view], names[kept[node]], probability, neighbour))
        context.progress("localising", done + 1, len(out))
    return located


def _map_of(
    config: TopologicalMapConfig,
    nodes: Sequence[OmniFeatures],
    found: Sequence[PairAnswer],
    views: Sequence[int],
    names: Sequence[str],
) -> TopologicalMap:
    """The map of some views by what was found about their pairs, which are numbered anew."""
    number = {view: k for k, view in enumerate(views)}
    among = {(number[k.a], number[k.b]): k for k in found if k.a in number and k.b in number}
    answers: dict[Pair, Answer] = {pair: k.found for pair, k in among.items()}
    rows = {pair: k.rows for pair, k in among.items() if k.rows is not None}
    walks = _walks(config, len(views))
    return map_of_answers(nodes, answers, walks=walks, names=names, rows=rows)


def _walks(config: TopologicalMapConfig, count: int) -> Walks:
    """One walk through all views of an ordered set."""
    return Walks((count,)) if config.ordered else UNORDERED


# --------------------------------------------------------------------------------------------
# Features and pairs of views


def view_names(views: OmniRecording) -> tuple[str, ...]:
    """(n) the recording's own numbers of its views, as text."""
    return tuple(str(number) for number in views.ids.tolist())


@dataclass(frozen=True, slots=True)
class _Block:
    dataset: OmniDatasetSettings
    features: OmniFeatureSettings | None
    views: tuple[int, ...]


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
    stage = Stage(
        name=what.replace(" ", "_"),
        label=what,
        count=len(views),
        work=_extract,
        argument=lambda units: _Block(dataset, settings, units),
        kind=OmniFeatures,
        blocks=in_blocks(VIEWS_A_BLOCK),
    )
    done = context.perform(stage)
    if done.ended and not context.stopped():
        raise OutputError(f"features of {views.name}: {done.ended[0][1]}")
    gap = next((k for k in range(len(views)) if k not in done.results), len(views))
    return [done.results[k] for k in range(gap)]


def _extract(block: _Block) -> list[OmniFeatures]:
    recording = open_omni(block.dataset)
    if block.features is None:
        return [
            OmniFeatures(plain_sift(recording.camera, recording.image(i)), empty_segments())
            for i in block.views
        ]
    extractor = _extractor(block.dataset, block.features)
    return [extractor.extract(recording.image(i)) for i in block.views]


@lru_cache(maxsize=1)
def _extractor(dataset: OmniDatasetSettings, settings: OmniFeatureSettings) -> OmniFeatureExtractor:
    """Its maps take as long as an image's features; a process does several blocks of views."""
    return OmniFeatureExtractor(open_omni(dataset).camera, settings)


@dataclass(frozen=True, slots=True, eq=False)
class PairAnswer:
    """What was found about one pair.

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


def answer_pairs(
    search: PairSearch, context: Context, what: str = "pairs"
) -> tuple[list[PairAnswer], list[str]]:
    """All pairs in their order (stopped early, those that are done), and what went wrong."""
    stage = Stage(
        # Their numbers depend on how many views there are: fewer where a run was stopped.
        name=f"{what.replace(' ', '_')}_of_{len(search.features)}_views",
        label=what,
        count=len(search.pairs),
        work=_answer,
        argument=lambda units: replace(search, pairs=tuple(search.pairs[k] for k in units)),
        kind=PairAnswer,
        blocks=interleaved(_BLOCKS_A_JOB * context.jobs),
    )
    done = context.perform(stage)
    failures = [f"{len(units)} pairs: {why}" for units, why in done.ended]
    return list(done.results.values()), failures


def _answer(search: PairSearch) -> list[PairAnswer]:
    answers = []
    for a, b in search.pairs:
        found, matches = _vector(search, a, b)
        answers.append(PairAnswer(a, b, found, len(matches), sift_inliers(found, matches)))
    return answers


def _vector(search: PairSearch, a: int, b: int) -> tuple[TwoViewVector | Refusal, BearingMatches]:
    """One pair's homing vector and its tentative matches."""
    views, rng = (search.features[a], search.features[b]), pair_generator(search.seed, a, b)
    return vector_between(*views, search.matching, search.vector, rng)


# --------------------------------------------------------------------------------------------
# Errors of pairs


@dataclass(frozen=True, slots=True, eq=False)
class PairErrors(Rows):
    """Errors of the answered pairs, degrees.

    Attributes:
        direction, rotation: (n,) estimate minus truth, wrapped.
        sigma_direction, sigma_rotation: (n,) as stated.
        mahalanobis2: (n,) squared error in units of the stated joint covariance.
        same_room: (n,) whether both views are of one room; None where rooms are not known.
    """

    direction: FloatArray
    rotation: FloatArray
    sigma_direction: FloatArray
    sigma_rotation: FloatArray
    mahalanobis2: FloatArray
    same_room: BoolArray | None

    @property
    def worst(self) -> FloatArray:
        """(n,) larger of both errors' sizes."""
        return np.asarray(np.maximum(np.abs(self.direction), np.abs(self.rotation)))


def true_pair(wTa: FloatArray, wTb: FloatArray) -> tuple[float, float]:
    """Direction of b seen from a against a's heading, and b's heading minus a's; radians."""
    offset = wTb[:2] - wTa[:2]
    direction = np.arctan2(offset[1], offset[0]) - wTa[2]
    return float(wrap(direction)), float(wrap(wTb[2] - wTa[2]))


def pair_errors(
    answers: Sequence[PairAnswer], poses: FloatArray, rooms: Sequence[str] | None = None
) -> PairErrors:
    """Errors of the answered pairs.

    Args:
        answers: of any pairs; those without an answer are passed over.
        poses: (m, 3) true planar poses of all views, metres and radians.
        rooms: of all views; None where they are not known.
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
    same = None if rooms is None else np.array([rooms[p.a] == rooms[p.b] for p, _ in found], bool)
    degrees = np.rad2deg(errors)
    distance = np.sum(errors * solved, axis=1)
    return PairErrors(degrees[:, 0], degrees[:, 1], sigmas[:, 0], sigmas[:, 1], distance, same)


def error_numbers(errors: PairErrors) -> dict[str, JsonValue]:
    """The metrics of answered pairs: errors, the worst, and whether the stated sigmas hold."""
    numbers = _numbers(errors)
    if errors.same_room is not None:
        numbers["same_room"] = _numbers(errors.select(errors.same_room))
        numbers["different_rooms"] = _numbers(errors.select(~errors.same_room))
    return numbers


def _numbers(errors: PairErrors) -> dict[str, JsonValue]:
    if not len(errors):
        return {"answered": 0}
    direction, rotation = np.abs(errors.direction), np.abs(errors.rotation)
    return {
        "answered": len(errors),
        "direction_median_deg": float(np.median(direction)),
        "direction_p95_deg": float(np.percentile(direction, 95)),
        "direction_worst_deg": float(direction.max()),
        "rotation_median_deg": float(np.median(rotation)),
        "rotation_p95_deg": float(np.percentile(rotation, 95)),
        "rotation_worst_deg": float(rotation.max()),
        "worse_than_10_deg": int(np.count_nonzero(errors.worst > WRONG_DEG)),
        "covered_joint_95": float(np.mean(errors.mahalanobis2 <= chi_square_quantile(0.95, 2))),
        "covered_direction_2_sigma": float(np.mean(direction <= 2.0 * errors.sigma_direction)),
        "covered_rotation_2_sigma": float(np.mean(rotation <= 2.0 * errors.sigma_rotation)),
        "nees_per_dof": float(np.mean(errors.mahalanobis2) / 2.0),
    }


def answer_numbers(answers: Sequence[PairAnswer]) -> dict[str, JsonValue]:
    """How many pairs were answered, and why the others were not."""
    reasons = Counter(p.found.reason.value for p in answers if isinstance(p.found, Refusal))
    inliers = [pair.inliers for pair in answers if pair.answered]
    return {
        "pairs": len(answers),
        "answered": len(inliers),
        "refused": dict(sorted(reasons.items())),
        "inliers_median": float(np.median(inliers)) if inliers else None,
    }


def _judged(
    answers: Sequence[PairAnswer], views: OmniRecording
) -> tuple[PairErrors | None, dict[str, JsonValue]]:
    """Errors against the true poses, and the numbers; the errors are null where there are none."""
    errors = None if views.poses is None else pair_errors(answers, views.poses, views.rooms)
    of_errors = {"errors": None if errors is None else error_numbers(errors)}
    return errors, answer_numbers(answers) | of_errors


def _accuracy(numbers: dict[str, JsonValue], errors: PairErrors | None) -> list[str]:
    lines = [f"{numbers['answered']} of {numbers['pairs']} pairs are answered."]
    reference = numbers["reference"]
    if isinstance(reference, dict):
        lines.append(
            f"Plain SIFT with at least {PLAIN_INLIERS} inliers answers {reference['answered']}."
        )
    if errors is None:
        lines.append("How accurate they are is not known: there are no true poses.")
    elif len(errors):
        direction = np.median(np.abs(errors.direction))
        rotation = np.median(np.abs(errors.rotation))
        lines.append(
            f"The median error is {direction:.2f} degrees of the direction and {rotation:.2f} of "
            f"the rotation; the worst answer is off by {errors.worst.max():.1f} degrees."
        )
    return lines


_ERROR_COLUMNS = (
    ("answered", "answered", "pairs with a homing vector", "d"),
    ("direction deg median", "direction_median_deg", "absolute error of the direction", ".2f"),
    ("p95", "direction_p95_deg", "95 % of the answers are better", ".2f"),
    ("rotation deg median", "rotation_median_deg", "absolute error of the rotation", ".2f"),
    ("p95 ", "rotation_p95_deg", "95 % of the answers are better", ".2f"),
    ("worse than 10 deg", "worse_than_10_deg", "answers whose direction or rotation is", "d"),
    ("covered joint 95 %", "covered_joint_95", "errors within the stated joint 95 % region", ".1%"),
    ("NEES", "nees_per_dof", "normalised error squared per degree of freedom: 1 is right", ".2f"),
)


def error_tables(errors: PairErrors | None) -> tuple[TextTable, ...]:
    """The numbers of all pairs, and of those within one room and not; none without true poses."""
    if errors is None:
        return ()
    numbers = error_numbers(errors)
    groups = {
        "all pairs": numbers,
        "same room": numbers.get("same_room"),
        "different rooms": numbers.get("different_rooms"),
    }
    rows = tuple(
        (
            name,
            tuple(
                format(group[key], spec).replace("%", " %") if key in group else "-"
                for _, key, _, spec in _ERROR_COLUMNS
            ),
        )
        for name, group in groups.items()
        if isinstance(group, dict)
    )
    columns = tuple(Column(name, meaning) for name, _, meaning, _ in _ERROR_COLUMNS)
    return (TextTable("errors", "Errors of the answered pairs", "pairs", columns, rows),)


def write_pairs(path: Path, answers: Sequence[PairAnswer], names: Sequence[str]) -> None:
    """pairs.csv: a row for each pair, degrees, counter-clockwise positive. Raises OutputError."""
    columns = (
        "from",
        "to",
        "answered",
        "direction_deg",
        "sigma_direction_deg",
        "rotation_deg",
        "sigma_rotation_deg",
        "inliers",
        "reason",
    )
    write_csv(path, columns, (_pair_row(pair, names) for pair in answers))


def _pair_row(pair: PairAnswer, names: Sequence[str]) -> list[Cell]:
    start: list[Cell] = [names[pair.a], names[pair.b], pair.answered]
    found = pair.found
    if isinstance(found, TwoViewVector):
        sigma = np.rad2deg(np.sqrt(np.diagonal(found.covariance)))
        direction, rotation = np.rad2deg([found.direction, found.rotation])
        return [*start, direction, sigma[0], rotation, sigma[1], found.support, ""]
    turn = None if found.rotation is None else float(np.rad2deg(found.rotation))
    return [*start, None, None, turn, None, 0, found.reason.value]


# --------------------------------------------------------------------------------------------
# Numbers and words of the map


def _map_numbers(
    topology: TopologicalMap,
    views: OmniRecording,
    tried: int,
    kilobytes: float,
    routes: Sequence[Route],
    located: list[Localised] | None,
) -> dict[str, JsonValue]:
    parts = topology.components()
    gaps = [link.b - link.a for link in topology.links]
    lengths = link_lengths(topology, views.poses)
    return {
        "nodes": len(topology),
        "homings_tried": tried,
        "links": len(topology.links),
        "components": len(parts),
        "largest_component": len(parts[0]) if parts else 0,
        "outside_largest": [topology.names[k] for part in parts[1:] for k in part.tolist()],
        "longest_link_places": max(gaps, default=None),
        "longest_link_m": None if lengths is None or not len(lengths) else float(lengths.max()),
        "least_support": min((link.support for link in topology.links), default=None),
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


def _map_sentences(
    topology: TopologicalMap, routes: Sequence[Route], located: list[Localised] | None
) -> tuple[str, ...]:
    parts = topology.components()
    largest = len(parts[0]) if parts else 0
    lines = [
        f"{largest} of {len(topology)} views are connected by {len(topology.links)} links; "
        f"there are {len(parts)} parts."
    ]
    lines += [
        f"From {r.asked[0]} to {r.asked[-1]}: {'-'.join(r.found) or 'no way'}." for r in routes
    ]
    if located:
        right = sum(one.neighbour for one in located)
        lines.append(f"Localisation finds {right} of {len(located)} held-out views at a neighbour.")
    return tuple(lines)


def _map_table(numbers: Mapping[str, JsonValue]) -> TextTable:
    rows = {
        "nodes": "nodes",
        "links": "links",
        "parts": "components",
        "views in the largest part": "largest_component",
        "longest link, places apart in the recording": "longest_link_places",
        "longest link, metres": "longest_link_m",
        "fewest inliers of a link": "least_support",
        "pairs tried and not linked": "pairs_not_linked",
    }
    cells = tuple((name, (quantity(numbers[key], 2),)) for name, key in rows.items())
    column = Column("value", "of the whole map; links.csv has each link")
    return TextTable("map", "The map", "quantity", (column,), cells)


def quantity(value: JsonValue, decimals: int) -> str:
    """A number of metrics.json as text; a dash where it is not known."""
    if value is None:
        return "-"
    return f"{value:.{decimals}f}" if isinstance(value, float) else str(value)


def link_lengths(topology: TopologicalMap, poses: FloatArray | None) -> FloatArray | None:
    """(m,) lengths of the links between places (n, 3), metres; None without these."""
    if poses is None:
        return None
    ends = [(poses[k.a, :2], poses[k.b, :2]) for k in topology.links]
    return np.array([float(np.hypot(*(b - a))) for a, b in ends])


def write_links(folder: Path, topology: TopologicalMap, poses: FloatArray | None = None) -> None:
    """links.csv; lengths where places (n, 3) are known. Raises OutputError."""
    columns = (
        "from",
        "to",
        "direction_deg",
        "sigma_direction_deg",
        "rotation_deg",
        "sigma_rotation_deg",
        "back_deg",
        "inliers",
        "cost",
        "places_apart",
        "distance_m",
    )
    lengths = link_lengths(topology, poses)
    rows: list[list[Cell]] = []
    for k, link in enumerate(topology.links):
        sigma = np.rad2deg(np.sqrt(np.diagonal(link.covariance)))
        direction, rotation, back = np.rad2deg([link.direction, link.rotation, link.back])
        ends = [topology.names[link.a], topology.names[link.b]]
        length = None if lengths is None else float(lengths[k])
        of_map = [link.support, float(topology.costs[k]), link.b - link.a, length]
        rows.append([*ends, direction, sigma[0], rotation, sigma[1], back, *of_map])
    write_csv(folder / LINKS_FILE, columns, rows)


# --------------------------------------------------------------------------------------------
# Figures and pictures


def _figures(
    errors: PairErrors | None, answers: Sequence[PairAnswer], views: OmniRecording
) -> Iterator[Figure]:
    """Where the answered pairs lie, and how good they are; nothing without true poses."""
    if errors is None or views.poses is None:
        return
    yield _pairs_figure(errors, answers, views.poses, view_names(views))
    true = {"direction": errors.direction, "rotation": errors.rotation}
    claimed = {"direction": errors.sigma_direction, "rotation": errors.sigma_rotation}
    yield sorted_errors(true, "degrees", ("errors", "Errors of the answered pairs"))
    yield claimed_against_true(claimed, true)


def _pairs_figure(
    errors: PairErrors, answers: Sequence[PairAnswer], poses: FloatArray, names: Sequence[str]
) -> Figure:
    """The pairs from above, by the size of their errors."""
    limits = (0.0, _GOOD_DEG, WRONG_DEG, np.inf)
    kinds = (
        f"off by less than {_GOOD_DEG:g} degrees",
        f"off by {_GOOD_DEG:g} to {WRONG_DEG:g} degrees",
        f"off by more than {WRONG_DEG:g} degrees",
    )
    answered = [answer for answer in answers if answer.answered]
    links = []
    for k, kind in enumerate(kinds):
        rows = np.flatnonzero((errors.worst >= limits[k]) & (errors.worst < limits[k + 1]))
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
    words = (
        "pairs",
        "The pairs, from above",
        "Views at their true places, and the pairs that are answered; the switches choose by the "
        "larger of the errors of direction and rotation.",
    )
    return network_figure(words, poses[:, :2], names, links)


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
    words = ("map", "The topological map", f"{where} A line is a homing that is believed.")
    return network_figure(words, places, names, kinds, axes)


def _link_label(names: Sequence[str], link: Link) -> str:
    ends = f"{names[link.a]} to {names[link.b]}"
    if not link.support:
        return f"{ends}: driven, but without a homing vector"
    return f"{ends}: {link.support} inliers, rotation {np.rad2deg(link.rotation):.0f} degrees"


def draw_doubtful(
    folder: Path,
    views: OmniRecording,
    search: PairSearch,
    answers: Sequence[PairAnswer],
    doubts: FloatArray,
    count: int,
) -> tuple[Picture, ...]:
    """Draws at most ``count`` answered pairs: half the most doubtful, half spread over the rest.

    ``doubts`` (n,) of the answered ones: errors, or inliers, negated.
    """
    answered = [answer for answer in answers if answer.answered]
    order = np.argsort(-doubts, kind="stable")
    worst, rest = order[: (count + 1) // 2], order[(count + 1) // 2 :]
    spread = rest[np.linspace(0, len(rest) - 1, min(count // 2, len(rest))).round().astype(int)]
    chosen = [answered[i] for i in (*worst, *spread)]
    return tuple(draw_pair(folder, views, search, answer) for answer in chosen)


def draw_pair(
    folder: Path, views: OmniRecording, search: PairSearch, answer: PairAnswer
) -> Picture:
    """One pair: its accepted matches on both views."""
    from fgslam.report.pictures import MatchedPixels, draw_view_matches

    vector, matches = _vector(search, answer.a, answer.b)
    if isinstance(vector, TwoViewVector):
        kept = matches.select(vector.inliers)
        direction, rotation = np.rad2deg([vector.direction, vector.rotation])
        caption = (
            f"{vector.support} of {len(matches)} matches, direction {direction:.1f}, "
            f"rotation {rotation:.1f} degrees"
        )
    else:
        kept, caption = matches.select(np.zeros(len(matches), np.bool_)), "refused"
    pixels = MatchedPixels(
        _pixels(views.camera, kept.bearing_a, kept.elevation_a),
        _pixels(views.camera, kept.bearing_b, kept.elevation_b),
        kept.kind == FeatureKind.COLUMN,
    )
    a, b = view_names(views)[answer.a], view_names(views)[answer.b]
    path = make_subfolder(folder, "pictures") / f"matches_{a}_{b}.png"
    images = views.image(answer.a), views.image(answer.b)
    draw_view_matches(path, images, pixels, (f"view {a}: {caption}", f"view {b}"))
    return Picture(f"Matches of views {a} and {b}: {caption}", path.read_bytes())


def _pixels(camera: OmniCamera, bearing: FloatArray, elevation: FloatArray) -> FloatArray:
    rays = np.column_stack([np.cos(bearing), np.sin(bearing), np.tan(elevation)])
    return camera.pixels(rays)
