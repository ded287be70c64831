"""Task `homing_pairs`: the homing vector between every two of a folder's panoramas."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.evaluation.metrics import JsonValue
from fgslam.frontend.homing.matching import PLAIN_MATCHING
from fgslam.report.content import Column, TextTable
from fgslam.report.figures.homing import claimed_against_true, sorted_errors
from fgslam.report.figures.plan import Links, network_figure
from fgslam.report.figures.traces import Figure
from fgslam.runs.config_models import HomingPairsConfig
from fgslam.runs.documents import write_document, write_page
from fgslam.runs.engine import Context, Opening, RunResult, Task
from fgslam.runs.tasks.homing_pair_answers import (
    WRONG_DEG,
    PairAnswer,
    PairErrors,
    answer_numbers,
    error_numbers,
    pair_errors,
    with_support,
    write_pairs,
)
from fgslam.runs.tasks.homing_pair_search import (
    PLAIN_INLIERS,
    PairSearch,
    answer_pairs,
    draw_pairs,
    never_refusing,
    pairs_of,
)
from fgslam.runs.tasks.homing_views import Views, extract_features, open_views

PAIRS_FILE = "pairs.csv"
REFERENCE_FILE = "reference_pairs.csv"
_GOOD_DEG = 2.0
_ROWS = ("all pairs", "same room", "different rooms")


def open_pairs(config: HomingPairsConfig, opening: Opening) -> Task[RunResult]:
    """Opens the recording. Raises DatasetError."""
    views = open_views(config.dataset)
    return Task({"dataset": views.provenance}, lambda context: _run(config, views, context))


def _run(config: HomingPairsConfig, views: Views, context: Context) -> RunResult:
    """Features once an image, then every pair; stopped early, the pairs that are done count."""
    folder = context.folder
    features = extract_features(views, config.features, context)
    every = tuple(pairs_of(len(features), both_ways=config.both_ways))
    search = PairSearch(
        tuple(features), every, config.features.matching, config.homing_vector, config.seed
    )
    answers, failures = answer_pairs(search, context)
    whole = len(features) == len(views) and len(answers) == len(every)
    write_pairs(folder / PAIRS_FILE, answers, views.names)
    errors = None if views.poses is None else pair_errors(answers, views.poses, views.rooms)
    numbers = answer_numbers(answers) | _judged(errors)
    numbers["images"] = len(features)
    numbers["reference"] = _reference(config, views, context) if whole else None
    whole = whole and not context.stopped()
    result = RunResult(
        config,
        folder,
        "finished" if whole else "interrupted",
        _verdict(numbers, errors),
        _tables(errors),
        (*views.recording.notes, *failures),
    )
    write_document(result, numbers)
    pictures = draw_pairs(folder, views, search, answers, errors, config.output.pictures)
    figures = tuple(_figures(errors, answers, views))
    write_page(
        result,
        f"{len(answers)} pairs of {len(features)} views of {views.recording.name}",
        figures=figures,
        pictures=pictures,
        series=("direction", "rotation") if figures else (),
    )
    return result


def _reference(
    config: HomingPairsConfig, views: Views, context: Context
) -> dict[str, JsonValue] | None:
    """The same pairs by plain SIFT and two-point RANSAC, for comparison; None where not asked."""
    if not config.reference:
        return None
    features = extract_features(views, None, context)
    every = tuple(pairs_of(len(features), both_ways=config.both_ways))
    vector = never_refusing(config.homing_vector)
    search = PairSearch(tuple(features), every, PLAIN_MATCHING, vector, config.seed)
    answers, _ = answer_pairs(search, context, "plain pairs")
    answers = [with_support(answer, PLAIN_INLIERS) for answer in answers]
    write_pairs(context.folder / REFERENCE_FILE, answers, views.names)
    errors = None if views.poses is None else pair_errors(answers, views.poses, views.rooms)
    return answer_numbers(answers) | _judged(errors)


def _judged(errors: PairErrors | None) -> dict[str, JsonValue]:
    """Errors against the true poses; null where there are none."""
    return {"errors": None if errors is None else error_numbers(errors)}


def _verdict(numbers: dict[str, JsonValue], errors: PairErrors | None) -> tuple[str, ...]:
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
    return tuple(lines)


_COLUMNS = (
    ("answered", "answered", "pairs with a homing vector", "d"),
    ("direction deg median", "direction_median_deg", "absolute error of the direction", ".2f"),
    ("p95", "direction_p95_deg", "95 % of the answers are better", ".2f"),
    ("rotation deg median", "rotation_median_deg", "absolute error of the rotation", ".2f"),
    ("p95 ", "rotation_p95_deg", "95 % of the answers are better", ".2f"),
    ("worse than 10 deg", "worse_than_10_deg", "answers whose direction or rotation is", "d"),
    ("covered joint 95 %", "covered_joint_95", "errors within the stated joint 95 % region", ".3f"),
    ("NEES", "nees_per_dof", "normalised error squared per degree of freedom: 1 is right", ".2f"),
)


def _tables(errors: PairErrors | None) -> tuple[TextTable, ...]:
    if errors is None:
        return ()
    numbers = error_numbers(errors)
    groups = [numbers, numbers.get("same_room"), numbers.get("different_rooms")]
    rows = tuple(
        (name, tuple(_cell(group, key, spec) for _, key, _, spec in _COLUMNS))
        for name, group in zip(_ROWS, groups, strict=True)
        if isinstance(group, dict)
    )
    columns = tuple(Column(name, meaning) for name, _, meaning, _ in _COLUMNS)
    return (TextTable("errors", "Errors of the answered pairs", "pairs", columns, rows),)


def _cell(group: dict[str, JsonValue], key: str, spec: str) -> str:
    value = group.get(key)
    return "-" if not isinstance(value, int | float) else format(value, spec)


def _figures(
    errors: PairErrors | None, answers: Sequence[PairAnswer], views: Views
) -> Iterator[Figure]:
    """Where the answered pairs lie, and how good they are; nothing without true poses."""
    if errors is None or views.poses is None:
        return
    yield _plan(errors, answers, views.poses, views.names)
    true = {"direction": errors.direction, "rotation": errors.rotation}
    claimed = {"direction": errors.sigma_direction, "rotation": errors.sigma_rotation}
    yield sorted_errors(true, "degrees", ("errors", "Errors of the answered pairs"))
    yield claimed_against_true(claimed, true)


def _plan(
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
