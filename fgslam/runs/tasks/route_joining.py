"""Task `join`: taught routes become one map, joined where their views match.

Units: pairs of path images. Files: routes.fgmap, links.csv, metrics.json, the page.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from fgslam.core.errors import ConfigError
from fgslam.core.homing import OmniFeatures
from fgslam.evaluation.statistics import JsonValue
from fgslam.homing.links import Pair
from fgslam.homing.route import PathMemory
from fgslam.homing.topological_map import FEATURES, VECTOR, Answered, Asker, RouteMap, route_of
from fgslam.report.content import Column, TextTable
from fgslam.runs.config_models import JoinConfig
from fgslam.runs.engine import Context, Opening, RunResult, Task, write_document, write_page
from fgslam.runs.tasks.homing_views import PairSearch, answer_pairs, map_figure, write_links

MAP_FILE = "routes.fgmap"


def open_joining(config: JoinConfig, opening: Opening) -> Task[RunResult]:
    """Opens the routes. Raises StoredMapError or ConfigError."""
    routes = {Path(one).stem: PathMemory.load(one) for one in config.routes}
    if len(routes) < len(config.routes):
        name, _ = Counter(Path(one).stem for one in config.routes).most_common(1)[0]
        raise ConfigError(f"routes: two files are called {name}, as their routes; rename one")
    ground = {"log": {name: len(path) for name, path in routes.items()}}
    return Task(ground, lambda context: _run(config, routes, context))


def _run(config: JoinConfig, routes: Mapping[str, PathMemory], context: Context) -> RunResult:
    """Stopped early there is no map: what is missing might be the crossroads."""
    folder, failures = context.folder, list[str]()
    joined = RouteMap.join(routes, seed=config.seed, ask=_asker(config.seed, context, failures))
    if context.stopped():
        result = RunResult(config, folder, "interrupted", ("There is no map yet.",))
        write_document(result, {})
        return result
    joined.save(folder / MAP_FILE)
    written = folder / MAP_FILE if config.map is None else Path(config.map)
    if config.map is not None:
        joined.save(written)
    write_links(folder, joined.topology)
    meetings = _meetings(joined)
    numbers = _numbers(joined, meetings)
    result = RunResult(
        config, folder, "finished", _sentences(joined, numbers), (_table(meetings),),
        tuple(failures), (("map", str(written)),),
    )  # fmt: skip
    write_document(result, numbers)
    figures = (map_figure(joined.topology),)
    write_page(result, f"{len(joined)} path images of {len(routes)} routes", figures=figures)
    return result


def _asker(seed: int, context: Context, failures: list[str]) -> Asker:
    """Homing vectors found in processes; what went wrong there is added to ``failures``."""
    names = iter(("pairs", "ways back"))

    def ask(images: tuple[OmniFeatures, ...], pairs: Sequence[Pair]) -> Mapping[Pair, Answered]:
        search = PairSearch(images, tuple(pairs), FEATURES.matching, VECTOR, seed)
        found, failed = answer_pairs(search, context, next(names))
        failures.extend(failed)
        return {(one.a, one.b): (one.found, one.rows) for one in found}

    return ask


def _meetings(joined: RouteMap) -> dict[tuple[str, str], int]:
    """Links between images that do not follow each other on a route, by the routes' names."""
    counts: Counter[tuple[str, str]] = Counter()
    for link in joined.topology.links:
        first, second = (route_of(joined.names[k]) for k in (link.a, link.b))
        if first != second:
            counts[first, second] += 1
    return dict(counts)


def _numbers(joined: RouteMap, meetings: Mapping[tuple[str, str], int]) -> dict[str, JsonValue]:
    parts = joined.topology.components()
    return {
        "nodes": len(joined),
        "links": len(joined.topology.links),
        "links_between_routes": sum(meetings.values()),
        "crossroads": len(joined.crossroads),
        "components": len(parts),
        "largest_component": len(parts[0]),
    }


def _sentences(joined: RouteMap, numbers: Mapping[str, JsonValue]) -> tuple[str, ...]:
    said = (
        f"{len(joined)} path images are joined by {numbers['links_between_routes']} links between "
        f"routes; {numbers['crossroads']} are linked with more than two others.",
    )
    if numbers["components"] == 1:
        return (*said, "Every place can be reached from every other one.")
    return (
        *said,
        f"There are {numbers['components']} parts without a way between them: teach a route that "
        "meets both.",
    )


def _table(meetings: Mapping[tuple[str, str], int]) -> TextTable:
    rows = tuple((f"{a} and {b}", (str(count),)) for (a, b), count in meetings.items())
    column = Column("links", "whose homing vectors agree, and that third views confirm")
    return TextTable("meetings", "Where routes meet", "routes", (column,), rows)
