"""The files of a localisation run: a row for each query, numbers, a picture and a page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from fgslam.core.files import make_subfolder
from fgslam.core.geometry import yaw_pitch_roll
from fgslam.evaluation.localisation import Bounds, LocalisationScore, Spread
from fgslam.evaluation.metrics import JsonValue
from fgslam.report.figures.located import Located, located_figure
from fgslam.report.figures.traces import Figure
from fgslam.report.tables import Cell, write_csv, write_json
from fgslam.runs.documents import write_page
from fgslam.runs.folder import METRICS_FILE
from fgslam.runs.tasks.localisation_results import (
    LOCALISATION_FILE,
    LocalisationResult,
    Scored,
    bounds_of,
    in_frames,
    scored,
    sigmas_of,
    verdict_of,
)
from fgslam.runs.tasks.slam_map_entry import GivenMap

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
        from fgslam.report.pictures.on_paper import draw_figure  # Matplotlib takes a second

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
        "verdicts": dict(sorted(Counter(verdict_of(a) for a in judged.attempts).items())),
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
