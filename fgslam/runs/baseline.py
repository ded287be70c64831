"""Committed numbers that a new comparison is checked against."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from fgslam.core.errors import ConfigError
from fgslam.core.files import write_text
from fgslam.evaluation.metrics import value_at
from fgslam.report.tables import RESULT_COLUMNS

Results: TypeAlias = Mapping[str, Mapping[str, Mapping[str, Any]]]
"""Numbers as in metrics.json, by the run's name and the estimator's title."""

FORMAT = "fgslam baseline"
VERSION = 1
_SMALLER_IS_BETTER = (
    "ate_final_m",
    "ate_online_m",
    "rpe_final_m",
    "rpe_final_deg",
    "end_error_final_m",
    "end_error_final_deg",
    "landmark_rmse_m",
    "landmark_median_m",
    # of homing runs
    "direction_median_deg",
    "direction_p95_deg",
    "rotation_median_deg",
    "distance_median",
)
_ONE_IS_BEST = (
    "nees_pose_final_per_dof",
    "nees_landmark_per_dof",
    "nis_per_dof",
    # of homing runs
    "nees_robot_per_dof",
    "nees_target_per_dof",
    "nees_home_per_dof",
)
_TOLERANCES = dict.fromkeys(_SMALLER_IS_BETTER, 0.05) | dict.fromkeys(_ONE_IS_BEST, 0.10)
_FLOOR = 1e-6  # metres, degrees: less is rounding, whatever the ratio
_WHERE = dict(RESULT_COLUMNS)


@dataclass(frozen=True, slots=True)
class Deviation:
    """A value outside its tolerance.

    Attributes:
        text: which, both values and by how much, in one line.
        regression: whether it became worse; else better.
    """

    text: str
    regression: bool


def write_baseline(path: Path, results: Results, command: str) -> None:
    """Write the deterministic numbers of a comparison with their tolerances.

    Args:
        path: the file, written atomically.
        results: of the comparison.
        command: what gave them, for whoever wants to repeat it.

    Raises:
        OutputError: the file cannot be written.
    """
    runs = {
        run: {title: _numbers(metrics) for title, metrics in estimators.items()}
        for run, estimators in results.items()
    }
    document = {
        "format": FORMAT,
        "version": VERSION,
        "command": command,
        "relative_tolerances": _TOLERANCES,
        "runs": runs,
    }
    write_text(path, json.dumps(document, indent=2, allow_nan=False) + "\n")


def read_baseline(path: Path) -> dict[str, Any]:
    """A baseline's document. Raises ConfigError where the file is missing or is none."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, ValueError, RecursionError) as error:
        raise ConfigError(
            f"{path}: cannot be read as a baseline ({error}); write one with --write-baseline"
        ) from None
    if not _is_baseline(document):
        raise ConfigError(
            f"{path}: is no {FORMAT} of version {VERSION}; write one with --write-baseline"
        )
    return dict(document)


def check_baseline(document: Mapping[str, Any], results: Results) -> list[Deviation]:
    """Compares results with a baseline; runs and estimators that it does not know are ignored."""
    tolerances: dict[str, float] = document["relative_tolerances"]
    out: list[Deviation] = []
    for run, estimators in document["runs"].items():
        for title, expected in estimators.items():
            metrics = results.get(run, {}).get(title)
            if metrics is None:
                out.append(Deviation(f"{run}, {title}: not among the results", True))
                continue
            found = _numbers(metrics)
            for name, value in expected.items():
                out += _deviation(f"{run}, {title}: {name}", name, value, found, tolerances)
    return out


def deviation_lines(deviations: Sequence[Deviation]) -> list[tuple[str, str]]:
    """What differs from the baseline, label and text each, or that nothing does."""
    if not deviations:
        return [("baseline", "all values are within their tolerances")]
    return [("REGRESSION" if d.regression else "deviation", d.text) for d in deviations]


def _numbers(metrics: Mapping[str, Any]) -> dict[str, float]:
    """The checked columns whose value is known."""
    found = {name: value_at(metrics, _WHERE.get(name, name)) for name in _TOLERANCES}
    return {name: float(value) for name, value in found.items() if value is not None}


def _deviation(
    what: str,
    name: str,
    expected: float,
    found: Mapping[str, float],
    tolerances: Mapping[str, float],
) -> Iterator[Deviation]:
    value = found.get(name)
    if value is None:
        yield Deviation(f"{what}: {expected:.6g} in the baseline, not known now", True)
        return
    tolerance = tolerances[name]
    if abs(value - expected) <= max(tolerance * abs(expected), _FLOOR):
        return
    worse = value > expected if name in _SMALLER_IS_BETTER else _off(value) > _off(expected)
    change = "" if expected == 0.0 else f" ({100.0 * (value / expected - 1.0):+.1f} %)"
    yield Deviation(
        f"{what}: {expected:.6g} in the baseline, {value:.6g} now{change}, tolerance "
        f"{100.0 * tolerance:g} %: {'worse' if worse else 'better'}",
        worse,
    )


def _off(ratio: float) -> float:
    """How far a ratio is from 1, either way."""
    return abs(math.log(ratio)) if ratio > 0.0 else math.inf


def _is_baseline(document: Any) -> bool:
    """Whether all parts are there, with numbers and a tolerance wherever one is needed."""
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        return False
    tolerances, runs = document.get("relative_tolerances"), document.get("runs")
    if document.get("version") != VERSION or not isinstance(tolerances, dict):
        return False
    if not isinstance(runs, dict) or not runs or not all(map(_is_number, tolerances.values())):
        return False
    estimators = [
        e for run in runs.values() for e in (run.values() if isinstance(run, dict) else [0])
    ]
    return bool(estimators) and all(
        isinstance(values, dict)
        and all(name in tolerances and _is_number(value) for name, value in values.items())
        for values in estimators
    )


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
