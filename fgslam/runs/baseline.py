"""Committed numbers that a new comparison is checked against."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

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


class Baseline(BaseModel):
    """Numbers of estimators by the run's name and their title, and how far each may be off."""

    model_config = ConfigDict(strict=True, allow_inf_nan=False)

    format: Literal["fgslam baseline"]
    version: Literal[1]
    relative_tolerances: dict[str, float]
    runs: dict[str, Annotated[dict[str, dict[str, float]], Field(min_length=1)]] = Field(
        min_length=1
    )

    @model_validator(mode="after")
    def _all_have_tolerances(self) -> Self:
        every = (numbers for estimators in self.runs.values() for numbers in estimators.values())
        if not all(numbers.keys() <= self.relative_tolerances.keys() for numbers in every):
            raise ValueError("a number without a tolerance")
        return self


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
        ConfigError: no number of a run is among those that a baseline holds.
        OutputError: the file cannot be written.
    """
    runs = {
        run: {title: _numbers(metrics) for title, metrics in estimators.items()}
        for run, estimators in results.items()
    }
    empty = [run for run, numbers in runs.items() if not any(numbers.values())]
    if empty:
        raise ConfigError(
            f"{path}: not written: a baseline holds numbers of replayed estimators, and {empty[0]} "
            "has none (no ground truth, or trials of homing); leave out --write-baseline"
        )
    document = {
        "format": FORMAT,
        "version": VERSION,
        "command": command,
        "relative_tolerances": _TOLERANCES,
        "runs": runs,
    }
    write_text(path, json.dumps(document, indent=2, allow_nan=False) + "\n")


def read_baseline(path: Path) -> Baseline:
    """A baseline's document. Raises ConfigError where the file is missing or is none."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, ValueError, RecursionError) as error:
        raise ConfigError(
            f"{path}: cannot be read as a baseline ({error}); write one with --write-baseline"
        ) from None
    try:
        return Baseline.model_validate(values)
    except ValidationError:
        raise ConfigError(
            f"{path}: is no {FORMAT} of version {VERSION}; write one with --write-baseline"
        ) from None


def check_baseline(expected: Baseline, results: Results) -> list[Deviation]:
    """Compares results with a baseline; runs and estimators that it does not know are ignored."""
    out: list[Deviation] = []
    for run, estimators in expected.runs.items():
        for title, numbers in estimators.items():
            metrics = results.get(run, {}).get(title)
            if metrics is None:
                out.append(Deviation(f"{run}, {title}: not among the results", True))
                continue
            found = _numbers(metrics)
            for name, value in numbers.items():
                tolerance = expected.relative_tolerances[name]
                out += _deviation(f"{run}, {title}: {name}", name, value, found, tolerance)
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
    tolerance: float,
) -> Iterator[Deviation]:
    value = found.get(name)
    if value is None:
        yield Deviation(f"{what}: {expected:.6g} in the baseline, not known now", True)
        return
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
