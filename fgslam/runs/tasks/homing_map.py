"""Task `topological_map`: views as nodes, homings that agree as edges, routes and localisation.

Units: features of a view, pairs of views. Files: map.npz, links.csv, routes.csv, localisation.csv,
metrics.json, pictures of doubtful links, the page. Numbers: links, parts, routes and views found.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from fgslam.core.errors import ConfigError, StoredMapError
from fgslam.core.homing import OmniFeatures, Refusal, TwoViewVector
from fgslam.datasets.omni_recording import OmniRecording
from fgslam.evaluation.metrics import JsonValue
from fgslam.frontend.homing.view_pairs import vector_between
from fgslam.homing.link_consistency import UNORDERED, InlierRows, Walks
from fgslam.homing.links import Answer, Pair
from fgslam.homing.localisation import Localiser
from fgslam.homing.retrieval import VisualWords
from fgslam.homing.topological_map import TopologicalMap, map_candidates, map_of_answers
from fgslam.report.content import Column, Picture, TextTable
from fgslam.report.tables import Cell, write_csv
from fgslam.runs.config_models import TopologicalMapConfig
from fgslam.runs.engine import (
    Context,
    Opening,
    RunResult,
    Task,
    provenance_of,
    write_document,
    write_page,
)
from fgslam.runs.tasks.homing_map_links import link_lengths, map_figure, write_links
from fgslam.runs.tasks.homing_views import (
    PairAnswer,
    PairSearch,
    answer_pairs,
    draw_pair,
    extract_features,
    inlier_rows,
    open_checked,
    view_names,
)

MAP_FILE = "map.npz"
ROUTES_FILE = "routes.csv"
_UNKNOWN = "-"
Found = TypeVar("Found")


@dataclasses.dataclass(frozen=True, slots=True)
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


def open_topological_map(config: TopologicalMapConfig, opening: Opening) -> Task[RunResult]:
    """Opens the recording. Raises DatasetError, or ConfigError of routes to unknown views."""
    views = open_checked(config.dataset)
    _require_nodes(config, view_names(views))
    return Task(provenance_of(views), lambda context: _run(config, views, context))


def _run(config: TopologicalMapConfig, views: OmniRecording, context: Context) -> RunResult:
    """Features once a view, homings of all candidates both ways, the map of those believed."""
    folder = context.folder
    features = extract_features(views, config.dataset, config.features, context)
    rng = np.random.default_rng(config.seed)
    walks = _walks(config, len(features))
    half = map_candidates(features, config.map, rng, walks)
    pairs = tuple(pair for a, b in half for pair in ((a, b), (b, a)))
    search = PairSearch(
        tuple(features), pairs, config.features.matching, config.homing_vector, config.seed
    )
    found, failures = answer_pairs(search, context)
    answers: dict[Pair, Answer] = {(answer.a, answer.b): answer.found for answer in found}
    names, rows = view_names(views)[: len(features)], inlier_rows(found)
    topology = map_of_answers(features, answers, walks=walks, names=names, rows=rows)
    kilobytes = topology.save(folder / MAP_FILE)
    routes = [_route(topology, asked) for asked in config.routes]
    located = _localise(config, features, answers, rows, names, context)
    whole = len(features) == len(views) and len(found) == len(pairs) and not context.stopped()
    numbers = _numbers(topology, views, answers, kilobytes) | _of_routes(routes)
    numbers |= {"localisation": _localised_numbers(located)}
    missing = [f"route {'-'.join(r.asked)}: {r.reason}" for r in routes if r.reason]
    result = RunResult(
        config,
        folder,
        "finished" if whole else "interrupted",
        _sentences(topology, routes, located),
        (_table(numbers),),
        (*views.notes, *failures, *missing),
    )
    write_links(folder, topology, views.poses)
    write_csv(folder / ROUTES_FILE, ("asked", "found", "reason"), _route_rows(routes))
    if located is not None:
        write_csv(folder / LOCALISATION_FILE, Localised._fields, located)
    write_document(result, numbers)
    pictures = _pictures(folder, views, search, topology, answers, config.output.pictures)
    write_page(
        result,
        f"{len(topology)} views of {views.name}",
        figures=(map_figure(topology, views.poses),),
        pictures=pictures,
    )
    return result


def _walks(config: TopologicalMapConfig, count: int) -> Walks:
    """One walk through all views of an ordered set."""
    return Walks((count,)) if config.ordered else UNORDERED


def _require_nodes(config: TopologicalMapConfig, names: Sequence[str]) -> None:
    for route in config.routes:
        for name in route:
            if name not in names:
                raise ConfigError(
                    f"routes: there is no view {name}; {config.dataset.path} has "
                    f"{names[0]} to {names[-1]}"
                )


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


# --------------------------------------------------------------------------------------------
# Numbers and words


def _numbers(
    topology: TopologicalMap, views: OmniRecording, answers: dict[Pair, Answer], kilobytes: float
) -> dict[str, JsonValue]:
    parts = topology.components()
    gaps = [link.b - link.a for link in topology.links]
    lengths = link_lengths(topology, views.poses)
    return {
        "nodes": len(topology),
        "homings_tried": len(answers),
        "links": len(topology.links),
        "components": len(parts),
        "largest_component": len(parts[0]) if parts else 0,
        "outside_largest": [topology.names[k] for part in parts[1:] for k in part.tolist()],
        "longest_link_places": max(gaps, default=None),
        "longest_link_m": None if lengths is None or not len(lengths) else float(lengths.max()),
        "least_support": min((link.support for link in topology.links), default=None),
        "pairs_not_linked": len(topology.rejected),
        "kilobytes_per_view": kilobytes,
    }


def _of_routes(routes: Sequence[Route]) -> dict[str, JsonValue]:
    found = [
        {"asked": list(r.asked), "found": list(r.found), "reason": r.reason or None} for r in routes
    ]
    return {"routes": found, "routes_found": sum(not r.reason for r in routes)}


def _sentences(
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


def _table(numbers: Mapping[str, JsonValue]) -> TextTable:
    rows = (
        ("nodes", "nodes"),
        ("links", "links"),
        ("parts", "components"),
        ("views in the largest part", "largest_component"),
        ("longest link, places apart in the recording", "longest_link_places"),
        ("longest link, metres", "longest_link_m"),
        ("fewest inliers of a link", "least_support"),
        ("pairs tried and not linked", "pairs_not_linked"),
    )
    labels = tuple((name, (_value(numbers[key]),)) for name, key in rows)
    column = Column("value", "of the whole map; links.csv has each link")
    return TextTable("map", "The map", "quantity", (column,), labels)


def _value(value: JsonValue) -> str:
    if value is None:
        return _UNKNOWN
    return f"{value:.2f}" if isinstance(value, float) else str(value)


# --------------------------------------------------------------------------------------------
# Rows, figures, pictures


def _route_rows(routes: Sequence[Route]) -> Iterator[list[Cell]]:
    for route in routes:
        yield ["-".join(route.asked), "-".join(route.found), route.reason]


def _pictures(
    folder: Path,
    views: OmniRecording,
    search: PairSearch,
    topology: TopologicalMap,
    answers: dict[Pair, Answer],
    count: int,
) -> tuple[Picture, ...]:
    """The doubtful links: half of them the longest ones, half those with the fewest inliers."""
    lengths = link_lengths(topology, views.poses)
    gaps = np.array([float(link.b - link.a) for link in topology.links])
    length = gaps if lengths is None else lengths
    support = np.array([link.support for link in topology.links])
    longest = np.argsort(-length, kind="stable")[: (count + 1) // 2].tolist()
    weakest = np.argsort(support, kind="stable")[: count // 2].tolist()
    chosen = [topology.links[k] for k in dict.fromkeys([*longest, *weakest])]
    return tuple(
        draw_pair(folder, views, search, PairAnswer(k.a, k.b, answers[k.a, k.b], 0)) for k in chosen
    )


# --------------------------------------------------------------------------------------------
# Localisation of views that are held out

LOCALISATION_FILE = "localisation.csv"


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
    answers: dict[Pair, Answer],
    rows: InlierRows,
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
    topology = map_of_answers(
        nodes,
        _among(kept, answers),
        walks=_walks(config, len(kept)),
        names=[names[k] for k in kept],
        rows=_among(kept, rows),
    )
    rng = np.random.default_rng((config.seed, 1))

    def linker(image: OmniFeatures, node: int) -> TwoViewVector | Refusal:
        matching, vector = config.features.matching, config.homing_vector
        return vector_between(image, nodes[node], matching, vector, rng)[0]

    words = VisualWords(nodes, rng)
    localiser = Localiser(topology, words, linker, config.localisation)
    located: list[Localised] = []
    context.progress("localising", 0, len(out))
    for done, view in enumerate(out):
        if context.stopped():
            break
        localiser.update(features[view])
        node, probability = localiser.best()
        near = _next_to(view, kept, node)
        located.append(Localised(names[view], names[kept[node]], probability, near))
        context.progress("localising", done + 1, len(out))
    return located


def _among(kept: Sequence[int], pairs: Mapping[Pair, Found]) -> dict[Pair, Found]:
    """What was found about the pairs of those views alone, numbered anew."""
    number = {view: k for k, view in enumerate(kept)}
    return {
        (number[a], number[b]): found
        for (a, b), found in pairs.items()
        if a in number and b in number
    }


def _localised_numbers(located: list[Localised] | None) -> JsonValue:
    """For metrics.json; null where nothing was held out."""
    if located is None:
        return None
    return {
        "held_out": len(located),
        "at_a_neighbour": sum(one.neighbour for one in located),
        "last_probability": located[-1].probability if located else None,
    }


def _next_to(view: int, kept: Sequence[int], node: int) -> bool:
    """Whether no other node lies between a view and its node in the recording."""
    low, high = sorted((view, kept[node]))
    return not any(low < k < high for k in kept if k != kept[node])
