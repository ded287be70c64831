"""Task `homing_pairs`: the homing vector between every two of a folder's panoramas.

Units: features of a view, pairs of views. Files: pairs.csv, reference_pairs.csv, metrics.json,
pictures of matches, the page. Numbers: pairs answered, errors against the true poses, coverage.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.homing import Refusal, RefusalReason, TwoViewVector
from fgslam.core.planar import wrap
from fgslam.core.quantiles import chi_square_quantile
from fgslam.datasets.omni_recording import OmniRecording
from fgslam.evaluation.metrics import JsonValue
from fgslam.frontend.homing.matching import PLAIN_MATCHING
from fgslam.frontend.homing.settings import HomingVectorSettings
from fgslam.report.content import Column, Picture, TextTable
from fgslam.report.figures.homing import claimed_against_true, sorted_errors
from fgslam.report.figures.plan import Links, network_figure
from fgslam.report.figures.traces import Figure
from fgslam.report.tables import Cell, write_csv
from fgslam.runs.config_models import HomingPairsConfig
from fgslam.runs.engine import (
    Context,
    Opening,
    RunResult,
    Task,
    provenance_of,
    write_document,
    write_page,
)
from fgslam.runs.tasks.homing_views import (
    PairAnswer,
    PairSearch,
    answer_pairs,
    draw_pair,
    extract_features,
    open_checked,
    view_names,
)

PAIRS_FILE = "pairs.csv"
REFERENCE_FILE = "reference_pairs.csv"
_GOOD_DEG = 2.0
_ROWS = ("all pairs", "same room", "different rooms")


PLAIN_INLIERS = 25
"""Inliers from which on an answer of the reference, which never refuses, counts."""


def open_pairs(config: HomingPairsConfig, opening: Opening) -> Task[RunResult]:
    """Opens the recording. Raises DatasetError."""
    views = open_checked(config.dataset)
    return Task(provenance_of(views), lambda context: _run(config, views, context))


def _run(config: HomingPairsConfig, views: OmniRecording, context: Context) -> RunResult:
    """Features once an image, then every pair; stopped early, the pairs that are done count."""
    folder = context.folder
    features = extract_features(views, config.dataset, config.features, context)
    every = tuple(pairs_of(len(features)))
    search = PairSearch(
        tuple(features), every, config.features.matching, config.homing_vector, config.seed
    )
    answers, failures = answer_pairs(search, context)
    whole = len(features) == len(views) and len(answers) == len(every)
    write_pairs(folder / PAIRS_FILE, answers, view_names(views))
    errors, numbers = _judged(answers, views)
    numbers["images"] = len(features)
    numbers["reference"] = _reference(config, views, context) if whole else None
    whole = whole and not context.stopped()
    left = len(pairs_of(len(views))) - len(answers)
    asked = f" {left} more are not answered yet." if left else ""
    result = RunResult(
        config,
        folder,
        "finished" if whole else "interrupted",
        _sentences(numbers, errors, asked),
        error_tables(errors),
        (*views.notes, *failures),
        reached=f"after {len(answers)} of {len(answers) + left} pairs",
    )
    write_document(result, numbers)
    pictures = draw_pairs(folder, views, search, answers, errors, config.output.pictures)
    figures = tuple(_figures(errors, answers, views))
    write_page(
        result,
        f"{len(answers)} pairs of {len(features)} views of {views.name}",
        figures=figures,
        pictures=pictures,
        series=("direction", "rotation") if figures else (),
    )
    return result


def _reference(
    config: HomingPairsConfig, views: OmniRecording, context: Context
) -> dict[str, JsonValue] | None:
    """The same pairs by plain SIFT and two-point RANSAC, for comparison.

    None where it is not asked for, or not all pairs are done.
    """
    if not config.reference:
        return None
    features = extract_features(views, config.dataset, None, context)
    every = tuple(pairs_of(len(features)))
    vector = never_refusing(config.homing_vector)
    search = PairSearch(tuple(features), every, PLAIN_MATCHING, vector, config.seed)
    answers, _ = answer_pairs(search, context, "plain pairs")
    if len(features) < len(views) or len(answers) < len(every):
        return None
    answers = [with_support(answer, PLAIN_INLIERS) for answer in answers]
    write_pairs(context.folder / REFERENCE_FILE, answers, view_names(views))
    return _judged(answers, views)[1]


def never_refusing(settings: HomingVectorSettings) -> HomingVectorSettings:
    """RANSAC's first answer whatever speaks against it, but for the number of its inliers."""
    return dataclasses.replace(
        settings,
        min_inliers=PLAIN_INLIERS,
        max_false_alarms=1e300,
        rival_log_odds=0.0,
        max_direction_sigma_deg=180.0,
        at_target_parallax_deg=0.0,
        second_look=False,
    )


def pairs_of(count: int) -> list[tuple[int, int]]:
    """Pairs (a, b) of views, a before b; both ways also (b, a)."""
    return [(a, b) for a in range(count) for b in range(count) if a < b]


def _judged(
    answers: Sequence[PairAnswer], views: OmniRecording
) -> tuple[PairErrors | None, dict[str, JsonValue]]:
    """Errors against the true poses, and the numbers; the errors are null where there are none."""
    errors = None if views.poses is None else pair_errors(answers, views.poses, views.rooms)
    of_errors = {"errors": None if errors is None else error_numbers(errors)}
    return errors, answer_numbers(answers) | of_errors


def _sentences(
    numbers: dict[str, JsonValue], errors: PairErrors | None, asked: str
) -> tuple[str, ...]:
    lines = [f"{numbers['answered']} of {numbers['pairs']} pairs are answered.{asked}"]
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
    ("covered joint 95 %", "covered_joint_95", "errors within the stated joint 95 % region", ".1%"),
    ("NEES", "nees_per_dof", "normalised error squared per degree of freedom: 1 is right", ".2f"),
)


def error_tables(errors: PairErrors | None) -> tuple[TextTable, ...]:
    """The errors of all pairs, of those in one room and of the others; empty without truth."""
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
    return "-" if not isinstance(value, int | float) else format(value, spec).replace("%", " %")


def _figures(
    errors: PairErrors | None, answers: Sequence[PairAnswer], views: OmniRecording
) -> Iterator[Figure]:
    """Where the answered pairs lie, and how good they are; nothing without true poses."""
    if errors is None or views.poses is None:
        return
    yield _plan(errors, answers, views.poses, view_names(views))
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


PAIR_COLUMNS = (
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
WRONG_DEG = 10.0
"""An answer whose direction or rotation is off by more is a wrong one."""

_JOINT_PROBABILITY = 0.95
_SIGMAS = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class PairErrors:
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

    def __len__(self) -> int:
        return len(self.direction)

    @property
    def worst(self) -> FloatArray:
        """(n,) larger of both errors' sizes."""
        return np.asarray(np.maximum(np.abs(self.direction), np.abs(self.rotation)))


def with_support(answer: PairAnswer, inliers: int) -> PairAnswer:
    """The same, refused where fewer inliers support it."""
    if not answer.answered or answer.inliers >= inliers:
        return answer
    why = Refusal(RefusalReason.TOO_FEW_INLIERS, f"{answer.inliers} inliers of {inliers} needed")
    return PairAnswer(answer.a, answer.b, why, answer.matches)


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
        numbers["same_room"] = _numbers(_taken(errors, errors.same_room))
        numbers["different_rooms"] = _numbers(_taken(errors, ~errors.same_room))
    return numbers


def answer_numbers(answers: Sequence[PairAnswer]) -> dict[str, JsonValue]:
    """How many pairs were answered, and why the others were not."""
    reasons: dict[str, int] = {}
    for pair in answers:
        if isinstance(pair.found, Refusal):
            name = pair.found.reason.value
            reasons[name] = reasons.get(name, 0) + 1
    inliers = [pair.inliers for pair in answers if pair.answered]
    return {
        "pairs": len(answers),
        "answered": len(inliers),
        "refused": dict(sorted(reasons.items())),
        "inliers_median": float(np.median(inliers)) if inliers else None,
    }


def write_pairs(path: Path, answers: Sequence[PairAnswer], names: Sequence[str]) -> None:
    """pairs.csv: a row for each pair, degrees, counter-clockwise positive. Raises OutputError."""
    write_csv(path, PAIR_COLUMNS, (_row(pair, names) for pair in answers))


def _row(pair: PairAnswer, names: Sequence[str]) -> list[Cell]:
    start: list[Cell] = [names[pair.a], names[pair.b], pair.answered]
    found = pair.found
    if isinstance(found, TwoViewVector):
        sigma = np.rad2deg(np.sqrt(np.diagonal(found.covariance)))
        direction, rotation = np.rad2deg([found.direction, found.rotation])
        return [*start, direction, sigma[0], rotation, sigma[1], found.support, ""]
    turn = None if found.rotation is None else float(np.rad2deg(found.rotation))
    return [*start, None, None, turn, None, 0, found.reason.value]


def _numbers(errors: PairErrors) -> dict[str, JsonValue]:
    if not len(errors):
        return {"answered": 0}
    limit = chi_square_quantile(_JOINT_PROBABILITY, 2)
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
        "covered_joint_95": float(np.mean(errors.mahalanobis2 <= limit)),
        "covered_direction_2_sigma": float(np.mean(direction <= _SIGMAS * errors.sigma_direction)),
        "covered_rotation_2_sigma": float(np.mean(rotation <= _SIGMAS * errors.sigma_rotation)),
        "nees_per_dof": float(np.mean(errors.mahalanobis2) / 2.0),
    }


def _taken(errors: PairErrors, which: BoolArray) -> PairErrors:
    columns = {field.name: getattr(errors, field.name) for field in dataclasses.fields(errors)}
    rows: dict[str, Any] = {k: None if v is None else v[which] for k, v in columns.items()}
    return PairErrors(**rows)


def draw_pairs(
    folder: Path,
    views: OmniRecording,
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
