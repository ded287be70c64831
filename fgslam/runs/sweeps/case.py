"""One case of a sweep: what it is, what tells it from others, and the work itself."""

from __future__ import annotations

import hashlib
import json
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fgslam.core.errors import ConfigError, FgslamError
from fgslam.evaluation.statistics import JsonValue, value_at
from fgslam.report.content import plain, read_metrics
from fgslam.runs.compare import Choice, choose
from fgslam.runs.config import Experiment, ExperimentConfig, make_experiment
from fgslam.runs.engine import run_task
from fgslam.runs.folder import METRICS_FILE, versions
from fgslam.runs.run import opener_of
from fgslam.runs.slam_comparison import judged_apart
from fgslam.runs.tables import RESULT_COLUMNS, TIME_COLUMNS
from fgslam.runs.trial import TrialTask, perform_trial
from fgslam.runs.workers import Failed, InProcess

_ABOUT = ("name", "task", "status", "remarks", "estimators")
_TIMED = ("ms", "mb", "seconds", "second", "growth", "memory")
_FAULTS = (
    ArithmeticError,
    AssertionError,
    ImportError,
    LookupError,
    MemoryError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
)
"""What else than a FgslamError a case may end with, without ending its worker."""


@dataclass(frozen=True, slots=True)
class Row:
    """What one estimator gave in a case: numbers, and times, which no other execution repeats."""

    estimator: str
    numbers: Mapping[str, JsonValue]
    times: Mapping[str, JsonValue]


@dataclass(frozen=True, slots=True)
class CaseResult:
    """What a case gave, and how many seconds it took."""

    seconds: float
    rows: tuple[Row, ...]


@dataclass(frozen=True, slots=True)
class CaseTask:
    """What a worker is given: plain values, that it checks as the command did.

    Attributes:
        values, where: of the experiment.
        overrides: `key=value` of the case; with the prefix `estimators.NAME.` of one estimator.
        names: estimators; None: those of the configuration.
        made_with: versions of the program that began the sweep.
    """

    values: Mapping[str, Any]
    where: str
    overrides: tuple[str, ...]
    names: tuple[str, ...] | None
    made_with: Mapping[str, str | None] = field(default_factory=versions)

    def settled(self) -> tuple[Experiment, tuple[Any, ...]]:
        """The configuration, and settings of the estimators. Raises ConfigError."""
        choice = Choice(self.names, self.overrides)
        config = make_experiment(self.values, self.where, choice.of_experiment)
        _require_no_map_saved(config, self.where)
        if not config.estimators:
            if self.names is not None:
                raise ConfigError(
                    f"{self.where}: task {config.task_name} has no estimators; leave them out"
                )
            return config, ()
        names = self.names or tuple(settings.title for settings in _own(config))
        return config, choose(config, Choice(names, choice.of_estimators.overrides))

    def key(self, identity: str, settled: tuple[Experiment, tuple[Any, ...]] | None = None) -> str:
        """Digest of all that its numbers depend on.

        Args:
            identity: the recording's.
            settled: what :meth:`settled` has given, which takes longer than all else here.
        """
        config, estimators = settled or self.settled()
        values = with_estimators(config, estimators).as_values()
        values = {name: value for name, value in values.items() if name not in ("name", "output")}
        text = json.dumps([values, identity, dict(self.made_with)], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:32]


def _require_no_map_saved(config: Experiment, where: str) -> None:
    """Many cases would write one file. Raises ConfigError."""
    if isinstance(config, ExperimentConfig) and config.map.save is not None:
        raise ConfigError(
            f"{where}: map.save: a sweep saves no map; leave it out, or --set map.save=null, and "
            "save one with fgslam run"
        )


def _own(config: Experiment) -> tuple[Any, ...]:
    """The configuration's estimators whose replay means something, as a run of it compares."""
    if not isinstance(config, ExperimentConfig):
        return config.estimators
    return judged_apart(config, config.estimators) or config.estimators


def with_estimators(config: Experiment, estimators: tuple[Any, ...]) -> Experiment:
    """The configuration with these estimators alone."""
    if not estimators:
        return config
    if isinstance(config, ExperimentConfig):
        return config.model_copy(update={"compare": estimators})
    return config.model_copy(update={"estimator": estimators[0], "compare": estimators[1:]})


def perform_case(task: CaseTask) -> CaseResult | Failed:
    """One case, start to end; what it fails with is handed back, to be tried elsewhere."""
    begun = time.monotonic()
    try:
        _require_same_versions(task.made_with)
        config, estimators = task.settled()
        rows = tuple(_rows(config, estimators))
    except (FgslamError, *_FAULTS) as error:
        kind = "" if isinstance(error, FgslamError) else f"{type(error).__name__}: "
        return Failed(f"{kind}{' '.join(str(error).split())[:500]}")
    return CaseResult(time.monotonic() - begun, rows)


def _rows(config: Experiment, estimators: tuple[Any, ...]) -> Iterator[Row]:
    if isinstance(config, ExperimentConfig):
        trial = perform_trial(TrialTask(config, config.seed, estimators))
        for title, metrics in trial.metrics.items():
            values = {**plain(metrics.as_json()), "odometry": config.odometry.kind}
            numbers = {name: value_at(values, path) for name, path in RESULT_COLUMNS}
            times = {name: value_at(values, path) for name, path in TIME_COLUMNS}
            yield Row(title, numbers, times)
        return
    document = _document(with_estimators(config, estimators))
    alone = {name: value for name, value in document.items() if name not in _ABOUT}
    found = document.get("estimators") or {"": alone}
    for title, values in found.items():
        flat = dict(_leaves(values))
        timed = {name for name in flat if set(name.replace(".", "_").split("_")) & set(_TIMED)}
        yield Row(
            title,
            {name: value for name, value in flat.items() if name not in timed},
            {name: flat[name] for name in flat if name in timed},
        )


def _document(config: Experiment) -> dict[str, Any]:
    """metrics.json of a run that is gone afterwards, done in this process alone."""
    with tempfile.TemporaryDirectory(prefix="fgslam-case-") as scratch:
        run = Path(scratch) / "run"
        run_task(opener_of(config), config, run, jobs=1, executor=InProcess())
        return read_metrics(run / METRICS_FILE)


def _leaves(values: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, JsonValue]]:
    """Single values below a mapping, by dotted name; lists are left out."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{before}{name}.")
        elif not isinstance(value, list):
            yield f"{before}{name}", value


def _require_same_versions(made_with: Mapping[str, str | None]) -> None:
    own = versions()
    other = [f"{k} {own.get(k)} for {v}" for k, v in made_with.items() if own.get(k) != v]
    if other:
        raise ConfigError(
            f"this worker has other versions than the sweep was begun with ({', '.join(other)}), "
            "which would not give the same bytes; install these there"
        )
