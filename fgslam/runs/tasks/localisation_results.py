"""The answers of a localisation run judged: sentences, tables, and the files of the run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.estimates import Relocalisation
from fgslam.core.files import make_subfolder
from fgslam.core.geometry import yaw_pitch_roll
from fgslam.evaluation.localisation import (
    Answers,
    Bounds,
    LocalisationErrors,
    LocalisationScore,
    Spread,
    enough,
    localisation_errors,
    score,
)
from fgslam.evaluation.statistics import JsonValue
from fgslam.report.content import Cell, Column, Figure, TextTable, write_csv, write_json
from fgslam.report.homing_figures import Located, located_figure
from fgslam.runs.config_models import LocalisationConfig
from fgslam.runs.engine import RunResult, write_page
from fgslam.runs.folder import METRICS_FILE
from fgslam.runs.tasks.localisation_queries import Asked, Attempt
from fgslam.runs.tasks.slam_map_entry import GivenMap

LOCALISATION_FILE = "localisation.csv"
_UNKNOWN = "-"
_WRONG_M, _WRONG_DEG = 0.30, 5.0  # an accepted pose farther off than this is false
_LEAST_VISIBLE = 20
"""A pose from which fewer of the map's landmarks are visible is counted apart; where depth is not
known all count."""


@dataclass(frozen=True, slots=True, eq=False)
class LocalisationResult(RunResult):
    """How a localisation run ended; ``asked`` are all queries with their answers."""

    config: LocalisationConfig
    asked: Asked = field(kw_only=True)


@dataclass(frozen=True, slots=True, eq=False)
class Scored:
    """The queries of one length.

    Attributes:
        frames: of a query.
        attempts: all of them.
        answers: the same as arrays.
        errors: of the accepted ones.
        counts: of those from which enough landmarks are visible.
        familiar: of those from which enough are visible from about where they were seen before.
        apart: of those from which too few are visible.
    """

    frames: int
    attempts: tuple[Attempt, ...]
    answers: Answers
    errors: LocalisationErrors
    counts: LocalisationScore
    familiar: LocalisationScore
    apart: LocalisationScore


def bounds_of(config: LocalisationConfig) -> Bounds:
    """What the configuration calls right and false."""
    wanted = config.localisation
    within, wrong = np.deg2rad([wanted.within_deg, _WRONG_DEG]).tolist()
    return Bounds(wanted.within_m, within, _WRONG_M, wrong, _LEAST_VISIBLE)


def scored(config: LocalisationConfig, asked: Asked) -> tuple[Scored, ...]:
    """The answers judged, by frames of a query."""
    bounds = bounds_of(config)
    out = []
    for frames in config.localisation.frames:
        attempts = asked.of(frames)
        answers = answers_of(attempts)
        visible, familiar = (enough(n, bounds) for n in (answers.visible, answers.familiar))
        out.append(
            Scored(
                frames,
                attempts,
                answers,
                localisation_errors(answers),
                score(answers.select(visible), bounds),
                score(answers.select(familiar), bounds),
                score(answers.select(~visible), bounds),
            )
        )
    return tuple(out)


def answers_of(attempts: Sequence[Attempt]) -> Answers:
    """The same as arrays; NaN where there is no covariance or no truth."""
    found = [one.found for one in attempts]
    nowhere = np.full((6, 6), np.nan)
    return Answers(
        accepted=np.array([one.accepted for one in attempts], np.bool_),
        poses=_stacked([np.eye(4) if f is None else f.wTc for f in found], (4, 4)),
        covariances=_stacked([nowhere if f is None else f.covariance for f in found], (6, 6)),
        truth=_stacked([one.truth for one in attempts], (4, 4)),
        visible=np.array([one.sighted.visible for one in attempts], np.int64),
        familiar=np.array([one.sighted.familiar for one in attempts], np.int64),
    )


def _stacked(arrays: Sequence[FloatArray], shape: tuple[int, int]) -> FloatArray:
    return np.array(arrays, np.float64).reshape(-1, *shape)


# --------------------------------------------------------------------------------------------
# Words


def result_of(
    config: LocalisationConfig, folder: Path | None, asked: Asked, notes: Sequence[str]
) -> LocalisationResult:
    """Sentences and tables of a run."""
    judged = scored(config, asked)
    tables = (_score_table(config, judged), _refusal_table(judged))
    return LocalisationResult(
        config=config,
        folder=folder or Path(),
        status="finished" if asked.whole else "interrupted",
        lines=tuple(_sentence(config, one) for one in judged),
        tables=tables,
        notes=(*notes, asked.alignment),
        particulars=() if folder is None else (("queries", str(folder / LOCALISATION_FILE)),),
        written=folder is not None,
        asked=asked,
    )


def in_frames(count: int) -> str:
    """``1 frame``, ``3 frames``."""
    return "1 frame" if count == 1 else f"{count} frames"


def _sentence(config: LocalisationConfig, judged: Scored) -> str:
    counts, wanted = judged.counts, config.localisation
    start = f"from {in_frames(judged.frames)}: {counts.accepted} of {counts.queries} queries found"
    if not counts.known:
        return f"{start}; their errors are not known"
    apart = ""
    if judged.apart.queries:
        apart = (
            f"; counted apart: {judged.apart.queries} poses from which fewer than "
            f"{_LEAST_VISIBLE} landmarks are visible, {judged.apart.accepted} of them found, "
            f"{judged.apart.false} false"
        )
    return (
        f"{start}, {counts.right} ({_percent(counts.share_right)}) within "
        f"{100 * wanted.within_m:g} cm and {wanted.within_deg:g} degrees, {counts.inexact} less "
        f"exact, {counts.false} false{apart}"
    )


def _score_table(config: LocalisationConfig, judged: Sequence[Scored]) -> TextTable:
    wanted = config.localisation
    right = f"accepted, within {100 * wanted.within_m:g} cm and {wanted.within_deg:g} degrees"
    columns = (
        Column("queries", "asked; those with too few landmarks in view are counted apart"),
        Column("right", right),
        Column("less exact", "accepted, neither right nor false"),
        Column("false", f"accepted, off by more than {_WRONG_M:g} m or {_WRONG_DEG:g} deg"),
        Column("refused", "no pose was to be believed"),
        Column("cm: 50, 95, 100 %", "errors of accepted positions: median, 95 %, largest"),
        Column("deg: 50, 95, 100 %", "the same of rotations"),
        Column("NEES", "mean normalised error squared per degree of freedom; 1 is consistent"),
        Column("in 95 %", "share of the true poses in the 95 % region of the covariance"),
        Column("ms: 50, 95 %", "time of an answer, without the features"),
    )
    rows = []
    for one in judged:
        ms = Spread.of(np.array([a.milliseconds for a in one.attempts]))
        times = f"{_number(ms.median, 0)}, {_number(ms.p95, 0)}"
        rows.append((in_frames(one.frames), (*_score_cells(one.counts), times)))
        if one.apart.queries or one.familiar.queries != one.counts.queries:
            least, name = _LEAST_VISIBLE, in_frames(one.frames)
            familiar = f"{name}, {least} in view from familiar sides"
            rows.append((familiar, (*_score_cells(one.familiar), _UNKNOWN)))
            few = f"{name}, fewer than {least} in view"
            rows.append((few, (*_score_cells(one.apart), _UNKNOWN)))
    return TextTable("score", "Localisation", "query", columns, tuple(rows))


def _score_cells(counts: LocalisationScore) -> tuple[str, ...]:
    judged = [str(n) for n in (counts.right, counts.inexact, counts.false)]
    return (
        str(counts.queries),
        *(judged if counts.known else [_UNKNOWN] * 3),
        str(counts.queries - counts.accepted),
        _spread(counts.metres, 100.0, 1),
        _spread(counts.degrees, 1.0, 2),
        _number(counts.nees_per_dof, 2),
        _percent(counts.held),
    )


def _refusal_table(judged: Sequence[Scored]) -> TextTable:
    """How many queries ended with which status of relocalisation."""
    counts = [Counter(status_of(one) for one in j.attempts) for j in judged]
    names = sorted({name for count in counts for name in count})
    columns = tuple(Column(in_frames(j.frames), "queries that ended so") for j in judged)
    rows = tuple((name, tuple(str(count[name]) for count in counts)) for name in names)
    return TextTable("verdicts", "Verdicts", "verdict", columns, rows)


def status_of(attempt: Attempt) -> str:
    """Name of the relocalisation status; ``no_image`` of a frame that could not be read."""
    return "no_image" if attempt.found is None else attempt.found.status.value


def _percent(share: float | None) -> str:
    return _UNKNOWN if share is None else f"{100 * share:.1f} %"


def _number(value: float | None, digits: int) -> str:
    return _UNKNOWN if value is None else f"{value:.{digits}f}"


def _spread(values: Spread, factor: float, digits: int) -> str:
    if values.median is None or values.p95 is None or values.largest is None:
        return _UNKNOWN
    parts = (values.median, values.p95, values.largest)
    return ", ".join(f"{factor * part:.{digits}f}" for part in parts)


def sigmas_of(found: Relocalisation) -> tuple[float, float]:
    """Standard deviation of position and of rotation, metres and degrees."""
    variances = np.diagonal(found.covariance)
    turned, moved = np.sqrt(variances[:3].sum()), np.sqrt(variances[3:].sum())
    return float(moved), float(np.rad2deg(turned))


# --------------------------------------------------------------------------------------------
# Files

TIMING_FILE = "timing.csv"
_COLUMNS = (
    "frame",
    "frames",
    "verdict",
    "x_m",
    "y_m",
    "z_m",
    "yaw_deg",
    "pitch_deg",
    "roll_deg",
    "sigma_position_m",
    "sigma_rotation_deg",
    "features",
    "candidates",
    "inliers",
    "expected",
    "second",
    "residual_px",
    "visible",
    "familiar",
    "error_m",
    "error_deg",
    "nees",
    "nees_dof",
    "why",
)


def write_results(result: LocalisationResult, given: GivenMap, subtitle: str) -> None:
    """All files of a run into its folder, which holds its config.yaml. Raises OutputError."""
    folder = result.folder
    if not result.written:
        return
    judged = scored(result.config, result.asked)
    rows = (row for one in judged for row in _rows(one))
    write_csv(folder / LOCALISATION_FILE, _COLUMNS, rows)
    timing = ((a.frame, a.frames, a.milliseconds, a.frontend_ms) for a in result.asked.attempts)
    write_csv(folder / TIMING_FILE, ("frame", "frames", "locate_ms", "frontend_ms"), timing)
    write_json(folder / METRICS_FILE, _document(result, judged))
    output = result.config.output
    bounds = bounds_of(result.config)
    figures = {one.frames: _figure(given, one, bounds) for one in judged}
    if output.pictures:
        from fgslam.report.pictures import draw_figure  # Matplotlib takes a second

        pictures = make_subfolder(folder, "pictures")
        for frames, figure in figures.items():
            draw_figure(pictures / f"localisation_{frames}.png", figure, figure.heading)
    write_page(result, subtitle, figures=tuple(figures.values()))


def _rows(judged: Scored) -> Iterator[tuple[Cell, ...]]:
    for k, attempt in enumerate(judged.attempts):
        errors = judged.errors
        judgement = errors.metres[k], np.rad2deg(errors.radians[k]), errors.nees[k], errors.dof[k]
        found = attempt.found
        sighted = attempt.sighted
        in_view = [n if n >= 0 else None for n in (sighted.visible, sighted.familiar)]
        if found is None:
            nothing = [None] * (len(_COLUMNS) - 4)
            yield (attempt.frame, attempt.frames, "no_image", *nothing, attempt.problem)
            continue
        posed = np.isfinite(found.covariance).all()
        pose = (*found.wTc[:3, 3], *np.rad2deg(yaw_pitch_roll(found.wTc)), *sigmas_of(found))
        yield (
            attempt.frame,
            attempt.frames,
            found.status.value,
            *(pose if posed else [None] * len(pose)),
            attempt.features,
            found.candidates,
            len(found.ids),
            found.expected,
            found.second,
            found.residual_px,
            *in_view,
            *judgement,
            found.why,
        )


def _document(result: LocalisationResult, judged: Sequence[Scored]) -> dict[str, JsonValue]:
    return {
        "name": result.config.name,
        "task": result.config.task,
        "status": result.status,
        "landmarks": len(result.asked.landmarks),
        "alignment": result.asked.alignment,
        "notes": list(result.notes),
        "queries": {str(one.frames): _numbers(one) for one in judged},
    }


def _numbers(judged: Scored) -> dict[str, JsonValue]:
    milliseconds = np.array([a.milliseconds for a in judged.attempts])
    frontend = np.array([a.frontend_ms for a in judged.attempts])
    return {
        **_score_numbers(judged.counts),
        "familiar_view": _score_numbers(judged.familiar),
        "too_few_in_view": _score_numbers(judged.apart),
        "verdicts": dict(sorted(Counter(status_of(a) for a in judged.attempts).items())),
        "locate_ms": _spread_numbers(Spread.of(milliseconds)),
        "frontend_ms": _spread_numbers(Spread.of(frontend)),
    }


def _score_numbers(counts: LocalisationScore) -> dict[str, JsonValue]:
    return {
        "asked": counts.queries,
        "accepted": counts.accepted,
        "with_truth": counts.known,
        "right": counts.right,
        "inexact": counts.inexact,
        "false": counts.false,
        "share_right": counts.share_right,
        "error_m": _spread_numbers(counts.metres),
        "error_deg": _spread_numbers(counts.degrees),
        "nees_per_dof": counts.nees_per_dof,
        "share_in_95_percent": counts.held,
    }


def _spread_numbers(values: Spread) -> dict[str, JsonValue]:
    return {"median": values.median, "p95": values.p95, "max": values.largest}


def _figure(given: GivenMap, judged: Scored, bounds: Bounds) -> Figure:
    answers, errors = judged.answers, judged.errors
    false = (errors.metres > bounds.wrong_m) | (errors.radians > bounds.wrong_rad)
    located = Located(
        landmarks=given.saved.landmarks.positions,
        path=given.saved.trajectory.poses,
        found=answers.accepted,
        poses=answers.poses,
        covariances=answers.covariances,
        truth=answers.truth,
        false=np.asarray(false),
    )
    title = f"Found from {in_frames(judged.frames)}"
    return located_figure(located, f"localisation-{judged.frames}", title)
