"""Localisation on a map by views that are not in it: every so many are held out, and sought."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgslam.core.homing import OmniFeatures, Refusal, TwoViewVector
from fgslam.evaluation.metrics import JsonValue
from fgslam.frontend.homing.homing_vector import vector_between
from fgslam.homing.link_consistency import InlierRows
from fgslam.homing.links import Answer, Pair
from fgslam.homing.localisation import Localiser
from fgslam.homing.retrieval import VisualWords
from fgslam.homing.topological_map import map_of_answers
from fgslam.report.tables import write_csv
from fgslam.runs.config_models import TopologicalMapConfig
from fgslam.runs.engine import Context

LOCALISATION_FILE = "localisation.csv"


@dataclass(frozen=True, slots=True)
class Localised:
    """What became of the held-out views, in their order.

    Attributes:
        views: names of the views.
        nodes: names of the nodes that the belief then liked best.
        probabilities: of these nodes.
        near: whether the node is the next one before or after the view in the recording.
    """

    views: tuple[str, ...]
    nodes: tuple[str, ...]
    probabilities: tuple[float, ...]
    near: tuple[bool, ...]

    def __len__(self) -> int:
        return len(self.views)

    @property
    def right(self) -> int:
        """How many were found at a neighbour."""
        return sum(self.near)


def localise(
    config: TopologicalMapConfig,
    features: Sequence[OmniFeatures],
    answers: dict[Pair, Answer],
    rows: InlierRows,
    names: Sequence[str],
    context: Context,
) -> Localised:
    """Holds out every so many views, maps the others, and walks through those held out.

    Nothing is known at first; from then on the belief goes along the map's links.
    """
    every = config.held_out_every or 0
    out = list(range(every - 1, len(features), every))
    kept = [k for k in range(len(features)) if k not in set(out)]
    number = {view: k for k, view in enumerate(kept)}
    nodes = [features[k] for k in kept]
    among = {
        (number[a], number[b]): answer
        for (a, b), answer in answers.items()
        if a in number and b in number
    }
    kept_rows = {
        (number[a], number[b]): inliers
        for (a, b), inliers in rows.items()
        if a in number and b in number
    }
    topology = map_of_answers(
        nodes,
        among,
        ordered=config.ordered,
        names=[names[k] for k in kept],
        rows=kept_rows,
    )
    rng = np.random.default_rng((config.seed, 1))

    def linker(image: OmniFeatures, node: OmniFeatures) -> TwoViewVector | Refusal:
        return vector_between(image, node, config.features.matching, config.homing_vector, rng)[0]

    words = VisualWords(nodes, rng)
    localiser = Localiser(topology, words, linker, config.localisation)
    located = []
    context.progress("localising", 0, len(out))
    for done, view in enumerate(out):
        if context.stopped():
            break
        localiser.update(features[view])
        node, probability = localiser.best()
        located.append((names[view], names[kept[node]], probability, _next_to(view, kept, node)))
        context.progress("localising", done + 1, len(out))
    return Localised(*zip(*located, strict=True)) if located else Localised((), (), (), ())


def localised_numbers(found: Localised | None) -> JsonValue:
    """For metrics.json; null where nothing was held out."""
    if found is None:
        return None
    return {
        "held_out": len(found),
        "at_a_neighbour": found.right,
        "last_probability": found.probabilities[-1] if len(found) else None,
    }


def write_localised(folder: Path, found: Localised | None) -> None:
    """localisation.csv; nothing where nothing was held out. Raises OutputError."""
    if found is not None:
        columns = ("view", "node", "probability", "neighbour")
        rows = zip(found.views, found.nodes, found.probabilities, found.near, strict=True)
        write_csv(folder / LOCALISATION_FILE, columns, rows)


def _next_to(view: int, kept: Sequence[int], node: int) -> bool:
    """Whether no other node lies between a view and its node in the recording."""
    low, high = sorted((view, kept[node]))
    return not any(low < k < high for k in kept if k != kept[node])
