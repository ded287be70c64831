"""What a localisation run hands back: its answers judged, in sentences and tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.estimates import Relocalisation
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
from fgslam.report.content import Column, TextTable
from fgslam.runs.config_models import LocalisationConfig
from fgslam.runs.engine import RunResult
from fgslam.runs.tasks.localisation_queries import Asked, Attempt

LOCALISATION_FILE = "localisation.csv"
_UNKNOWN = "-"


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
    within, wrong = np.deg2rad([wanted.within_deg, wanted.wrong_deg]).tolist()
    return Bounds(wanted.within_m, within, wanted.wrong_m, wrong, wanted.least_visible)


def scored(config: LocalisationConfig, asked: Asked) -> tuple[Scored, ...]:
    """The answers judged, by frames of a query."""
    bounds = bounds_of(config)
    out = []
    for frames in config.localisation.frames:
        attempts = asked.of(frames)
        answers = _answers(attempts)
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


def _answers(attempts: Sequence[Attempt]) -> Answers:
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
            f"{wanted.least_visible} landmarks are visible, {judged.apart.accepted} of them found, "
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
        Column(
            "false", f"accepted, off by more than {wanted.wrong_m:g} m or {wanted.wrong_deg:g} deg"
        ),
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
            least, name = wanted.least_visible, in_frames(one.frames)
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
    """How the queries ended, by verdict."""
    counts = [Counter(verdict_of(one) for one in j.attempts) for j in judged]
    names = sorted({name for count in counts for name in count})
    columns = tuple(Column(in_frames(j.frames), "queries that ended so") for j in judged)
    rows = tuple((name, tuple(str(count[name]) for count in counts)) for name in names)
    return TextTable("verdicts", "Verdicts", "verdict", columns, rows)


def verdict_of(attempt: Attempt) -> str:
    """The verdict's name; ``no_image`` of a frame that could not be read."""
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


def answer_line(attempt: Attempt) -> str:
    """One query in a line, for the terminal."""
    start = f"frame {attempt.frame:>5}  {verdict_of(attempt):<16}"
    found = attempt.found
    if found is None:
        return f"{start}{attempt.problem}"
    if not found.found:
        return f"{start}{found.why}"
    x, y, z = found.wTc[:3, 3]
    yaw = np.rad2deg(yaw_pitch_roll(found.wTc)[0])
    metres, degrees = sigmas_of(found)
    where = f"({x:7.3f}, {y:6.3f}, {z:7.3f}) m  heading {yaw:7.2f} deg"
    return (
        f"{start}{where}  sigma {100 * metres:4.1f} cm {degrees:4.2f} deg  "
        f"inliers {len(found.ids)} of {found.candidates}"
    )


def details(attempt: Attempt) -> Iterator[tuple[str, str]]:
    """One query in full: name and value of what there is to know."""
    yield "frame", f"{attempt.frame}, from {in_frames(attempt.frames)}"
    yield "verdict", verdict_of(attempt)
    found = attempt.found
    if found is None:
        yield "why", attempt.problem
        return
    if np.isfinite(found.covariance).all():
        x, y, z = found.wTc[:3, 3]
        yaw, pitch, roll = np.rad2deg(yaw_pitch_roll(found.wTc))
        metres, degrees = sigmas_of(found)
        doubt = "" if found.found else ", not to be believed"
        yield "position", f"{x:.3f} {y:.3f} {z:.3f} m (right, down, ahead){doubt}"
        yield "yaw, pitch, roll", f"{yaw:.2f} {pitch:.2f} {roll:.2f} deg"
        yield "sigma", f"{100 * metres:.1f} cm, {degrees:.2f} deg"
    yield "features", str(attempt.features)
    yield "candidates", f"{found.candidates} tentative matches by appearance"
    yield "inliers", f"{len(found.ids)} matches that agree with the pose"
    yield "expected", f"{found.expected} landmarks that should be recognised from there"
    yield "residual", f"{found.residual_px:.2f} px" if len(found.ids) else _UNKNOWN
    yield "second-best place", f"{found.second} inliers"
    yield "why", found.why
    if np.isfinite(attempt.truth).all():
        errors = localisation_errors(_answers([attempt]))
        if attempt.accepted:
            error = f"{100 * errors.metres[0]:.1f} cm, {np.rad2deg(errors.radians[0]):.2f} deg"
            yield "error", error


def sigmas_of(found: Relocalisation) -> tuple[float, float]:
    """Standard deviation of position and of rotation, metres and degrees."""
    variances = np.diagonal(found.covariance)
    turned, moved = np.sqrt(variances[:3].sum()), np.sqrt(variances[3:].sum())
    return float(moved), float(np.rad2deg(turned))
