"""`fgslam sweep`: experiments over settings, recordings, estimators and seeds, on many workers.

Every combination of values is a case. Each finished case is a line of cases.jsonl, by a digest of
all that its numbers depend on: so a sweep that is resumed does what is missing. All cases become
one table, and the table a page: means over the repetitions, and paired tests between variants.
`fgslam compare --trials` is a sweep of one experiment over seeds.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
import re
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import combinations, product
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple, TypeAlias

import numpy as np
import yaml

from fgslam.backend.settings import EstimatorSettings, family_of
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError, ConfigError, DatasetError, FgslamError, OutputError
from fgslam.core.files import clear_output_errors, write_text
from fgslam.core.log import MeasurementLog
from fgslam.core.threads import one_blas_thread
from fgslam.core.yaml_text import plain_values
from fgslam.datasets.layouts import is_recording
from fgslam.datasets.opening import open_measurements
from fgslam.datasets.settings import MeasurementDatasetSettings, SimulatedMeasurementsSettings
from fgslam.evaluation.judging import (
    SIGNIFICANT,
    MeanInterval,
    PairedTest,
    describe_test,
    holm,
    judge_replay,
    mean_interval,
    paired_test,
)
from fgslam.evaluation.statistics import Consistency, JsonValue, consistency, value_at
from fgslam.report.content import (
    UNKNOWN,
    Column,
    Figure,
    Page,
    TextTable,
    plain,
    read_metrics,
    write_parquet,
)
from fgslam.runs.bare import bare_experiment
from fgslam.runs.compare import Choice, choose, with_estimators
from fgslam.runs.config import (
    Experiment,
    ExperimentConfig,
    OutputSettings,
    make_experiment,
    read_mapping,
)
from fgslam.runs.engine import Opening, RunResult, run_task
from fgslam.runs.folder import (
    LOG_FILE,
    METRICS_FILE,
    REPORT_FILE,
    ExistingFolder,
    FolderKind,
    Owner,
    begin_folder,
    digest_of,
    require_usable,
    versions,
)
from fgslam.runs.named_experiments import find_experiment, suggestion
from fgslam.runs.run import opener_of
from fgslam.runs.session import override_texts
from fgslam.runs.slam_comparison import judged_apart, load_truth
from fgslam.runs.tables import RESULT_COLUMNS, TIME_COLUMNS, measured_marks, with_marks
from fgslam.runs.tasks.slam import open_slam
from fgslam.runs.tasks.slam_map_entry import arrival_of
from fgslam.runs.tasks.slam_measurements import write_log_and_truth
from fgslam.runs.units import Progress, Stopped
from fgslam.runs.workers import NOT_BEGUN, Executor, Failed
from fgslam.slam.replay import replay

if TYPE_CHECKING:
    import pandas

MARKER = "sweep.yaml"
JOURNAL_FILE = "cases.jsonl"
TABLE_FILE = "results.parquet"
TIMES_FILE = "times.parquet"
SWEEP = FolderKind("sweep", MARKER, (JOURNAL_FILE, TABLE_FILE, TIMES_FILE, REPORT_FILE, MARKER))

_TABLE_EVERY_S = 2.0
_TABLE_SHARE = 20.0  # the sweep goes on at least so many times as long as it writes its table
_FAILURES_SHOWN = 8  # in the terminal; on the page
_FAILURES_ON_PAGE = 20

# --------------------------------------------------------------------------------------------
# What is swept: sources, axes, and the cases that are their combinations

SEED = "seed"
MOST_CASES = 1_000_000
_RANGE = re.compile(r"\s*(\d+):(\d+)(?::(\d+))?\s*")
_PATHS = ("path", "camera_file", "load")
_VALUES_NAMED = 20


class Source(NamedTuple):
    """An experiment or a recording: its name in the table, plain values, source for messages."""

    name: str
    values: Mapping[str, Any]
    where: str


class Axis(NamedTuple):
    """A key of the experiment and the values it takes, as typed."""

    key: str
    values: Sequence[str]

    @property
    def settings(self) -> list[Any]:
        """The values as the table has them: numbers or booleans where all are, else text."""
        found = []
        for text in self.values:
            try:
                found.append(plain_values(text))
            except yaml.YAMLError:
                found.append(text)
        for kinds in ((bool,), (int,), (int, float)):
            if all(type(value) in kinds for value in found):
                return [float(value) for value in found] if float in map(type, found) else found
        return list(self.values)


def read_source(path: Path) -> Source:
    """An experiment's file, the name of a shipped one, or a recording.

    Raises:
        FgslamError: it is none of these, or cannot be used.
    """
    found = find_experiment(path)
    if not found.exists():
        raise ConfigError(f"{found}: no such file or folder; {suggestion(found)}")
    try:
        values = bare_experiment(found).values if is_recording(found) else read_mapping(found)
    except (DatasetError, CalibrationError) as error:  # advises options that a sweep has not
        stated = f"fgslam init {found} with those options > x.yaml, and sweep x.yaml"
        raise type(error)(f"{error}; a sweep takes them from a file: {stated}") from None
    return Source(make_experiment(values, str(found)).name, _resolve_paths(values), str(found))


def _resolve_paths(values: Any, key: str = "") -> Any:
    """The values with paths of what exists made absolute: workers start in folders of their own."""
    if isinstance(values, Mapping):
        return {name: _resolve_paths(value, str(name)) for name, value in values.items()}
    if key in _PATHS and isinstance(values, str) and values and Path(values).exists():
        return str(Path(values).resolve())
    return values


def read_axes(sets: Iterable[str]) -> tuple[Axis, ...]:
    """The axes of `KEY=VALUES`: one value, several with commas, or a range `FIRST:END[:STEP]`.

    A comma in brackets or quotes belongs to its value. END is left out, as in Python.

    Raises:
        ConfigError: one is malformed, empty, or of a key that was given before.
    """
    axes: dict[str, Axis] = {}
    for given in sets:
        key, separator, text = given.partition("=")
        key = key.strip()
        if not separator or not key:
            raise ConfigError(f"--set {given}: not of the form KEY=VALUES; e.g. --set seed=0:100")
        if key in axes:
            raise ConfigError(f"--set {given}: {key} is given twice; write {key}=A,B")
        axes[key] = Axis(key, _read_values(given, text))
    return tuple(axes.values())


def _read_values(given: str, text: str) -> Sequence[str]:
    found = _RANGE.fullmatch(text)
    if found is None:
        values = _split(text)
        if len(values) > 1 and not all(values):
            raise ConfigError(f"--set {given}: a value is empty; remove a comma")
        if len(set(values)) < len(values):
            raise ConfigError(f"--set {given}: a value is given twice; remove one")
        return values
    first, end, step = (int(part) for part in found.groups("1"))
    count = len(range(first, end, step)) if step else 0
    if not 1 <= count <= MOST_CASES:
        raise ConfigError(
            f"--set {given}: {count:,} values; give FIRST:END[:STEP] of 1 to {MOST_CASES:,}, END "
            "not among them"
        )
    return [str(value) for value in range(first, end, step)]


def _split(text: str) -> list[str]:
    """At the commas outside brackets and quotes."""
    parts, depth, quote = [""], 0, ""
    for letter in text:
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "'\"" and not parts[-1].strip():
            quote = letter
        depth += not quote and (letter in "[{") - (letter in "]}")
        if letter == "," and depth <= 0 and not quote:
            parts.append("")
        else:
            parts[-1] += letter
    return [part.strip() for part in parts]


def make_axes(settings: Mapping[str, Any]) -> tuple[Axis, ...]:
    """The axes of values by key: one, or several in a list, a range or an array.

    Raises:
        ConfigError: a value is not plain, or there is none.
    """
    axes = []
    for key, value in settings.items():
        several = isinstance(value, (list, tuple, range, np.ndarray))
        values = list(value) if several else [value]
        texts = [override_texts({key: one})[0].partition("=")[2] for one in values]
        if not texts or len(set(texts)) < len(texts):
            what = "one of its values is given twice" if texts else "it has no value"
            raise ConfigError(f"settings: {key}: {what}; give some that differ")
        axes.append(Axis(key, texts))
    return tuple(axes)


@dataclass(frozen=True, eq=False)
class Plan:
    """What is swept.

    Attributes:
        sources: experiments and recordings.
        axes: keys and their values.
        names: estimators; None: those of each configuration.
    """

    sources: tuple[Source, ...]
    axes: tuple[Axis, ...]
    names: tuple[str, ...] | None = None

    @cached_property
    def cases(self) -> list[Case]:
        """Every combination; the last axis turns fastest.

        Raises:
            ConfigError: two experiments have one name, or there are too many cases.
        """
        names = [source.name for source in self.sources]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ConfigError(f"two experiments are called {twice[0]}; give one another name")
        count = len(names) * math.prod(len(axis.values) for axis in self.axes)
        if count > MOST_CASES:
            raise ConfigError(f"{count:,} cases; a sweep has at most {MOST_CASES:,}")
        made_with, cases = versions(), []
        own = [list(zip(axis.settings, axis.values, strict=True)) for axis in self.axes]
        for source, *chosen in product(self.sources, *own):
            texts = tuple(
                f"{axis.key}={_resolve_paths(text, axis.key.split('.')[-1])}"
                for axis, (_, text) in zip(self.axes, chosen, strict=True)
            )
            settings = tuple(setting for setting, _ in chosen)
            cases.append(Case(source, settings, texts, self.names, made_with))
        return cases

    @property
    def default_folder(self) -> Path:
        """Where the results go unless another folder is named."""
        return Path("runs") / f"{self.sources[0].name}_sweep"

    @property
    def description(self) -> str:
        """The text of sweep.yaml; of many values the first and the last."""
        axes = {
            axis.key: ",".join(axis.values)
            if len(axis.values) <= _VALUES_NAMED
            else f"{axis.values[0]}, ..., {axis.values[-1]} ({len(axis.values)})"
            for axis in self.axes
        }
        values = {
            "experiments": {source.name: dict(source.values) for source in self.sources},
            "axes": axes,
            "estimators": None if self.names is None else list(self.names),
            "versions": versions(),
        }
        return yaml.safe_dump(values, sort_keys=False)


def make_plan(
    sources: Sequence[Path],
    settings: Mapping[str, Any] | Iterable[str],
    names: Iterable[str] | None = None,
) -> Plan:
    """What is to be swept.

    Args:
        sources: experiments and recordings.
        settings: axes as texts, `KEY=VALUES`, or by key one value or several.
        names: estimators; None: those of each configuration.

    Raises:
        FgslamError: a source cannot be used, or an axis is malformed.
    """
    if not sources:
        raise ConfigError("a sweep of no experiment: give the name of one, a file, or a recording")
    axes = make_axes(settings) if isinstance(settings, Mapping) else read_axes(settings)
    chosen = None if names is None else tuple(name.strip() for name in names)
    return Plan(tuple(map(read_source, sources)), axes, chosen)


# --------------------------------------------------------------------------------------------
# One case on some worker

_ABOUT = ("name", "task", "status", "remarks", "estimators")
_TIMED = {"ms", "mb", "seconds", "second", "growth", "memory"}
_FAULTS = (
    *(ArithmeticError, AssertionError, ImportError, LookupError),
    *(MemoryError, OSError, RuntimeError, TypeError, ValueError),
)
"""What else a case may end with, without ending its worker."""

Settled: TypeAlias = tuple[Experiment, tuple[Any, ...]]
"""A configuration, and the settings of its estimators."""


class Row(NamedTuple):
    """What one estimator gave in a case: numbers, and times, which no other execution repeats."""

    estimator: str
    numbers: Mapping[str, JsonValue]
    times: Mapping[str, JsonValue]


class CaseResult(NamedTuple):
    """What a case gave, and how many seconds it took; None for one without a result."""

    seconds: float | None
    rows: tuple[Row, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One combination: plain values, that a worker checks as the command did.

    Attributes:
        source: the experiment.
        settings: value on each axis, as the table has it.
        overrides: `key=value` of each axis; with the prefix `estimators.NAME.` of one estimator.
        names: estimators; None: those of the configuration.
        made_with: versions of the program that began the sweep.
    """

    source: Source
    settings: tuple[Any, ...]
    overrides: tuple[str, ...]
    names: tuple[str, ...] | None
    made_with: Mapping[str, str | None]

    def settled(self) -> Settled:
        """The configuration, and settings of the estimators. Raises ConfigError."""
        choice, where = Choice(self.names, self.overrides), self.source.where
        config = make_experiment(self.source.values, where, choice.of_experiment)
        own: tuple[Any, ...] = config.estimators
        if isinstance(config, ExperimentConfig):
            if config.map.save is not None:
                raise ConfigError(
                    f"{where}: map.save: a sweep saves no map; leave it out, or --set "
                    "map.save=null, and save one with fgslam run"
                )
            # Those whose replay means something, as a run compares them.
            own = judged_apart(config, own) or own
        if not own:
            if self.names is not None:
                raise ConfigError(
                    f"{where}: task {config.task_name} has no estimators; leave them out"
                )
            return config, ()
        names = self.names or tuple(settings.title for settings in own)
        return config, choose(config, Choice(names, choice.of_estimators.overrides))

    def key(self, identity: str, settled: Settled) -> str:
        """Digest of all that its numbers depend on; ``identity`` is the recording's."""
        config, estimators = settled
        values = (with_estimators(config, estimators) if estimators else config).as_values()
        values = {name: value for name, value in values.items() if name not in ("name", "output")}
        text = json.dumps([values, identity, dict(self.made_with)], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:32]


def perform_case(case: Case) -> CaseResult | Failed:
    """One case, start to end; what it fails with is handed back, to be tried elsewhere."""
    begun, own = time.monotonic(), versions()
    try:
        other = [f"{k} {own.get(k)} for {v}" for k, v in case.made_with.items() if own.get(k) != v]
        if other:
            raise ConfigError(
                f"this worker has other versions than the sweep was begun with ({', '.join(other)}"
                "), which would not give the same bytes; install these there"
            )
        rows = tuple(_rows_of_case(*case.settled()))
    except (FgslamError, *_FAULTS) as error:
        kind = "" if isinstance(error, FgslamError) else f"{type(error).__name__}: "
        return Failed(f"{kind}{' '.join(str(error).split())[:500]}")
    return CaseResult(time.monotonic() - begun, rows)


@one_blas_thread()
def perform_trial(config: ExperimentConfig, estimators: Sequence[EstimatorSettings]) -> list[Row]:
    """One world of noise, start to end, in a folder that is gone afterwards."""
    with tempfile.TemporaryDirectory(prefix="fgslam-trial-") as scratch:
        run, output = Path(scratch) / "run", OutputSettings(False, False, checkpoint_seconds=1e9)
        alone = config.model_copy(update={"compare": (), "output": output})
        if isinstance(config.dataset, MeasurementDatasetSettings):
            run.mkdir()
            opened = open_measurements(config.dataset, config.seed, config.odometry)
            write_log_and_truth(run, opened)
        else:
            run_task(open_slam, alone, run)
        log = MeasurementLog.load(run / LOG_FILE)
        truth = load_truth(run, log)
        arrival = None if config.on_measurements else arrival_of(run)  # these begin in no map
    rows = []
    for settings in estimators:
        answer = replay(log, settings, config.frontend.ego_motion, arrival=arrival)
        judged = judge_replay(answer, truth)
        # A process of several estimators has no memory of each.
        metrics = dataclasses.replace(judged.metrics, peak_memory_mb=None)
        values = {**plain(metrics.as_json()), "odometry": config.odometry.kind}
        numbers = {name: value_at(values, path) for name, path in RESULT_COLUMNS}
        for name, errors in judged.nees.items():
            numbers[f"nees_{name}_dof"] = int(errors.dof.sum())
            numbers[f"nees_{name}_items"] = int((errors.dof > 0).sum())
        times = {name: value_at(values, path) for name, path in TIME_COLUMNS}
        rows.append(Row(settings.title, numbers, times))
    return rows


def _rows_of_case(config: Experiment, estimators: tuple[Any, ...]) -> Iterable[Row]:
    if isinstance(config, ExperimentConfig):
        return perform_trial(config, estimators)
    config = with_estimators(config, estimators) if estimators else config
    with tempfile.TemporaryDirectory(prefix="fgslam-case-") as scratch:
        run = Path(scratch) / "run"
        run_task(opener_of(config), config, run, jobs=1, executor=Executor())
        document = read_metrics(run / METRICS_FILE)
    alone = {name: value for name, value in document.items() if name not in _ABOUT}
    rows = []
    for title, values in (document.get("estimators") or {"": alone}).items():
        flat = dict(_leaves(values))
        timed = {name for name in flat if set(re.split(r"[._]", name)) & _TIMED}
        numbers = {name: value for name, value in flat.items() if name not in timed}
        rows.append(Row(title, numbers, {name: flat[name] for name in flat if name in timed}))
    return rows


def _leaves(values: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, JsonValue]]:
    """Single values below a mapping, by dotted name; lists are left out."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{before}{name}.")
        elif not isinstance(value, list):
            yield f"{before}{name}", value


# --------------------------------------------------------------------------------------------
# Finished cases: the journal, and the table of all


class Journal(dict[str, CaseResult]):
    """Results by key, a line of JSON each, appended as they come.

    A line that was cut off, because the process was killed or the disk was full, is dropped when
    the file is opened again: that case is done again, nothing else.
    """

    def __init__(self, path: Path) -> None:
        """Opens or begins it. Raises OutputError where it cannot be written."""
        super().__init__()
        self._path = path
        with clear_output_errors(path):
            self._file: BinaryIO = path.open("a+b")
            self._file.seek(0)
            whole = 0
            while (line := self._file.readline()).endswith(b"\n"):
                whole += len(line)
                with suppress(ValueError, TypeError):  # a line of something else is passed over
                    key, seconds, rows = json.loads(line)
                    self[str(key)] = CaseResult(seconds, tuple(Row(*row) for row in rows))
            self._file.truncate(whole)

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *error: object) -> None:
        self._file.close()

    def add(self, key: str, result: CaseResult) -> None:
        """Keeps a result. Raises OutputError."""
        line = json.dumps([key, *result], allow_nan=False).encode() + b"\n"
        with clear_output_errors(self._path):
            at = self._file.seek(0, os.SEEK_END)
            try:
                self._file.write(line)
                self._file.flush()
            except OSError:
                self._file.truncate(at)
                raise
        self[key] = result


CASE, EXPERIMENT, ESTIMATOR, FAILURE = "case", "experiment", "estimator", "failure"
Columns: TypeAlias = dict[str, list[Any]]
"""Cells by name of the column, all of one length; None where a value is not known."""


def make_table(
    plan: Plan, found: Iterable[tuple[int, CaseResult | str]]
) -> tuple[Columns, Columns]:
    """Metrics and times, a row for each case and estimator, after the columns of what it is of.

    Args:
        plan: what is swept.
        found: cases by their numbers, with the reason in words where one has no result. The same
            give the same metrics to the byte; times differ between executions.
    """
    names = (CASE, EXPERIMENT, *(axis.key for axis in plan.axes), ESTIMATOR)
    keys: list[tuple[Any, ...]] = []
    numbers: list[Mapping[str, Any]] = []
    times: list[Mapping[str, Any]] = []
    for number, result in found:
        case = plan.cases[number]
        if isinstance(result, str):
            result = CaseResult(None, (Row("", {FAILURE: result}, {}),))
        for row in result.rows:
            keys.append((number, case.source.name, *case.settings, row.estimator or None))
            numbers.append(row.numbers)
            took = {} if result.seconds is None else {"case_seconds": result.seconds}
            times.append({**took, **row.times})
    first = {name: [row[k] for row in keys] for k, name in enumerate(names)}
    return first | _columns(numbers), first | _columns(times)


def _columns(rows: Sequence[Mapping[str, Any]]) -> Columns:
    """Columns of one type each, in the order in which they are found; the failure last."""
    names = sorted(dict.fromkeys(name for row in rows for name in row), key=FAILURE.__eq__)
    columns: Columns = {}
    for name in names:
        cells = [row.get(name) for row in rows]
        kinds = {type(cell) for cell in cells if cell is not None}
        if len(kinds) > 1:
            kind = float if kinds == {int, float} else str
            cells = [None if cell is None else kind(cell) for cell in cells]
        columns[name] = cells
    return columns


# --------------------------------------------------------------------------------------------
# What the table shows: variants, repeated over seeds and experiments, and compared with each other

_POOLED = {"nees_pose_final_per_dof": "pose", "nees_landmark_per_dof": "landmark"}
"""Normalised errors that are pooled over repetitions: column, and what they are of."""
METRICS = ("ate_final_m", "ate_online_m", "end_error_final_m", "landmark_median_m", *_POOLED)
"""What is shown of a sweep where its table has it; the first one is tested, the smaller better."""
ALL_PAIRS_OF = 12
"""Variants of which every two are compared; of more each one with the first."""
_VARIANTS_SHOWN = 400
_SERIES_SHOWN = 24


class Comparison(NamedTuple):
    """Variant A against B.

    Attributes:
        a, b: the variants.
        test: over the repetitions that both have.
        p_value: of the test, corrected for all comparisons of the sweep.
        better: which of them is; empty where none is shown to be.
    """

    a: str
    b: str
    test: PairedTest
    p_value: float | None
    better: str


@dataclass(frozen=True, eq=False)
class Findings:
    """What the table shows of its metrics.

    Attributes:
        frame: the rows, with columns `variant`, a combination of settings and an estimator, and
            `series`, the variants that differ in axes of numbers alone; both in words, with marks
            of what is not measured.
        metrics: that are shown; the first is tested.
        axes: keys of the axes that have several numbers for values, but the seed's.
        repeated: columns of what a variant is repeated over: experiments and seeds.
    """

    frame: pandas.DataFrame
    metrics: tuple[str, ...]
    axes: tuple[str, ...]
    repeated: tuple[str, ...]

    @property
    def well(self) -> pandas.DataFrame:
        """Rows that ended well: an estimator that gave up early has an easier drive."""
        return self.frame[self.frame[FAILURE].isna()]

    @cached_property
    def variants(self) -> list[str]:
        """In the order of the table."""
        return list(self.frame["variant"].unique())

    def means(self, metric: str) -> dict[str, MeanInterval | None]:
        """Over the repetitions of each variant."""
        found = {name: own[metric] for name, own in self.well.groupby("variant", sort=False)}
        return {v: mean_interval(_numbers(found[v])) if v in found else None for v in self.variants}

    def pooled(self, metric: str) -> dict[str, Consistency]:
        """Of normalised errors, over the repetitions of each variant: each counts as one sample."""
        names = [metric, f"nees_{_POOLED[metric]}_dof", f"nees_{_POOLED[metric]}_items"]
        found: dict[str, Consistency] = {}
        if not {*names} <= {*self.frame}:  # of other tasks
            return found
        for name, own in self.well.dropna(subset=names).groupby("variant"):
            ratios, dof, items = (_numbers(own[column]) for column in names)
            squared, total = float((ratios * dof).sum()), float(dof.sum())
            found[str(name)] = consistency(squared, total, int(items.sum()), len(own))
        return found

    @cached_property
    def repetitions(self) -> dict[str, FloatArray]:
        """The tested metric by variant, repetition by repetition; NaN where it is not known."""
        values = self.well.pivot_table(
            self.metrics[0], [*self.repeated], "variant", dropna=False, sort=False
        )
        return {name: _numbers(values[name]) for name in self.variants if name in values}

    @cached_property
    def comparisons(self) -> list[Comparison]:
        """Of every two variants, or of each with the first, over the repetitions that both have."""
        values = self.repetitions
        first, *others = self.variants
        every = len(self.variants) <= ALL_PAIRS_OF
        tests = []
        for a, b in combinations(self.variants, 2) if every else ((v, first) for v in others):
            if a in values and b in values:
                test = paired_test(values[a], values[b])
                if test is not None and test.difference.count > 1:
                    tests.append((a, b, test))
        corrected = iter(holm([t.p_value for _, _, t in tests if t.p_value is not None]))
        found = []
        for a, b, test in tests:
            p_value = None if test.p_value is None else next(corrected)
            differ = p_value is not None and p_value < SIGNIFICANT
            better = (a if test.difference.mean < 0.0 else b) if differ else ""
            found.append(Comparison(a, b, test, p_value, better))
        return found

    def compare_families(self) -> list[str]:
        """Each smoother against each filter by final ATE, in words, where only estimators vary."""
        kinds = dict(self.frame.groupby("variant")["kind"].first()) if "kind" in self.frame else {}
        if self.metrics[0] != METRICS[0] or len(self.variants) > self.frame[ESTIMATOR].nunique():
            return []
        ate, families = self.repetitions, {v: family_of(str(k)) for v, k in kinds.items()}
        filters = [v for v in ate if families.get(v) == "filter" and np.isfinite(ate[v]).any()]
        best = min(filters, key=lambda v: float(np.nanmean(ate[v])), default="")
        sentences = []
        for smoother, of in product((v for v in ate if families.get(v) == "smoother"), filters):
            test = paired_test(ate[smoother], ate[of])
            if test is not None:
                against = f"{of} (the best filter)" if of == best else of
                sentences.append(describe_test(smoother, against, test))
        return sentences


def _numbers(column: pandas.Series[Any]) -> FloatArray:
    return column.to_numpy(np.float64)


def find(table: Columns, plan: Plan, metric: str | None = None) -> Findings | None:
    """Findings in a table of metrics; None where it has no number.

    Raises:
        ConfigError: ``metric`` is no column of numbers.
    """
    import pandas  # half a second, that a worker does not need

    frame = pandas.DataFrame({FAILURE: None} | table)
    numeric = list(map(str, frame.select_dtypes("number")))
    keys = {CASE, EXPERIMENT, ESTIMATOR, *(axis.key for axis in plan.axes)}
    known = [name for name in numeric if name not in keys]
    if not known:
        return None
    if metric is not None and metric not in known:
        raise ConfigError(f"--metric {metric}: no column of numbers; known: {', '.join(known)}")
    preferred = [name for name in METRICS if name in known] or known[:1]
    metrics = tuple(dict.fromkeys([*([metric] if metric else []), *preferred]))
    varied = [axis.key for axis in plan.axes if len(axis.values) > 1 and axis.key != SEED]
    axes = tuple(key for key in varied if key in numeric)
    frame = frame[frame[ESTIMATOR].notna() | frame[FAILURE].isna()]
    titles = frame[ESTIMATOR].fillna("")
    several = titles[titles != ""].nunique() > 1

    def marked_label(keys: Sequence[str], titled: bool) -> pandas.Series[Any]:
        """The rows' settings and estimator in words, with what is not measured of all such rows."""
        words = [key.split(".")[-1] + "=" + frame[key].map(str) for key in keys]
        words += [titles] if titled or not words else []
        joined = [" ".join(filter(None, row)) or "all" for row in zip(*words, strict=True)]
        label = pandas.Series(joined, frame.index)
        for name, own in frame.groupby(label):
            predicted = own["predicted_frames"].sum() if "predicted_frames" in own else 0
            synthetic = "odometry" in own and bool((own["odometry"] == "synthetic").any())
            marks = measured_marks(int(predicted), synthetic)
            label[own.index] = with_marks(str(name), marks)
        return label

    series = marked_label([key for key in varied if key not in axes], titled=True)
    frame = frame.assign(variant=marked_label(varied, several), series=series)
    repeated = (EXPERIMENT, *(SEED for axis in plan.axes if axis.key == SEED))
    return Findings(frame, metrics, axes, repeated)


def summarise(findings: Findings | None, cases: int, done: int, failed: int) -> tuple[str, ...]:
    """How many cases there are, and which variant is the best, if one is."""
    first = f"{done:,} of {cases:,} cases done" + (f", {failed:,} failed" if failed else "")
    if findings is None:
        return (first,)
    metric, shown = findings.metrics[0], [one for one in findings.comparisons if one.better]
    means = [(found.mean, v) for v, found in findings.means(metric).items() if found]
    if len(means) < 2:
        return (first,)
    return (
        first,
        "smallest mean of {}: {:.4g}, {}".format(metric, *min(means)),
        f"{len(shown)} of {len(findings.comparisons)} paired comparisons differ at p < "
        f"{SIGNIFICANT}, corrected by Holm",
        *findings.compare_families(),
    )


def table_of_means(findings: Findings) -> TextTable:
    """Means of the variants."""
    columns = (
        Column("cases", "repetitions, over seeds and experiments, in which it ended well"),
        *(
            Column(name, "pooled over the cases: 1 is right; and its 95 % chi-square band")
            if name in _POOLED
            else Column(name, "mean and 95 % interval by Student's t")
            for name in findings.metrics
        ),
        Column("failed", "repetitions in which it failed"),
    )
    shown = [
        {v: _pooled_text(one) for v, one in findings.pooled(metric).items()}
        if metric in _POOLED
        else {v: _interval_text(one) for v, one in findings.means(metric).items()}
        for metric in findings.metrics
    ]
    tested, failed = (
        findings.means(findings.metrics[0]),
        findings.frame.groupby("variant")[FAILURE].count(),
    )
    rows = []
    for name in findings.variants[:_VARIANTS_SHOWN]:
        count = "0" if (mean := tested[name]) is None else str(mean.count)
        cells = (count, *(one.get(name, UNKNOWN) for one in shown), str(failed[name]))
        rows.append((name, cells))
    more = len(findings.variants) - _VARIANTS_SHOWN
    heading = f"Means; {more} more" if more > 0 else "Means"
    return TextTable("means", heading, "variant", columns, tuple(rows))


def table_of_pairs(findings: Findings) -> TextTable:
    """Each two variants against each other."""
    metric = findings.metrics[0]
    columns = (
        Column("cases", "repetitions that both have"),
        Column("difference", f"mean of A minus B in {metric}, with its 95 % interval"),
        Column("A smaller", "repetitions in which A has the smaller value"),
        Column("p", "Wilcoxon's signed-rank test, two-sided; fewer than 6 pairs cannot reach 0.05"),
        Column("p by Holm", "the same corrected for all rows of this table (Holm 1979)"),
        Column("smaller", "the one that is shown to be smaller at p < 0.05 by Holm"),
    )
    rows = []
    for one in findings.comparisons:
        count, p_values = one.test.difference.count, (one.test.p_value, one.p_value)
        cells = (
            str(count),
            _interval_text(one.test.difference),
            f"{one.test.wins} of {count}",
            *("-" if p is None else f"{p:.2g}" for p in p_values),
            one.better or "-",
        )
        rows.append((f"{one.a} | {one.b}", cells))
    heading = f"A against B: {metric}"
    if len(findings.variants) > ALL_PAIRS_OF:
        heading += " (each against the first; with fewer variants every two are compared)"
    return TextTable("pairs", heading, "A | B", columns, tuple(rows))


def _interval_text(found: MeanInterval | None) -> str:
    if found is None:
        return UNKNOWN
    ends = "" if found.lower is None else f"\n[{found.lower:.4g}, {found.upper:.4g}]"
    return f"{found.mean:.4g}{ends}"


def _pooled_text(found: Consistency) -> str:
    return f"{found.per_dof:.4g} {found.verdict}\n[{found.lower:.2f}, {found.upper:.2f}]"


def write_sweep_page(
    path: Path,
    headline: Sequence[str],
    failures: Mapping[int, str],
    findings: Findings | None,
    description: str,
) -> None:
    """The page, with the text of sweep.yaml. Raises OutputError."""
    from fgslam.report.page import write_html  # loads Plotly

    page = Page(
        title=f"Sweep: {path.parent.resolve().name}",
        subtitle="means over the cases that ended well",
        headline=tuple(headline),
        notes=tuple(f"case {k}: {why}" for k, why in sorted(failures.items()))[:_FAILURES_ON_PAGE],
        tables=() if findings is None else (table_of_means(findings), table_of_pairs(findings)),
        figures=() if findings is None else tuple(_figures(findings)),
        config_yaml=description,
        versions=versions(),
    )
    write_html(path, page)


def _figures(findings: Findings) -> Iterator[Figure]:
    """A curve for each metric and axis of numbers, and the spread of the first metric."""
    from fgslam.report.homing_figures import effect_figure, sorted_errors

    groups = list(findings.well.groupby("series", sort=False))[:_SERIES_SHOWN]
    series = {str(name): own for name, own in groups}
    for metric, axis in product(findings.metrics, findings.axes):
        curves = {}
        for name, rows in series.items():
            # Intervals over the repetitions, each averaged over the other settings.
            repetitions = rows.groupby([axis, *findings.repeated])[metric].mean()
            on_axis = repetitions.index.get_level_values(axis).to_numpy(np.float64)
            curve = []
            for value in np.unique(on_axis):
                if (mean := mean_interval(_numbers(repetitions[on_axis == value]))) is not None:
                    curve.append((value, mean.mean, mean.lower, mean.upper))
            curves[name] = np.array(curve, np.float64).reshape(-1, 4)
        yield effect_figure(curves, axis, metric, several=len(findings.axes) > 1)
    metric = findings.metrics[0]
    pooled = {name: _numbers(own[metric].dropna()) for name, own in series.items()}
    yield sorted_errors(pooled, metric, ("spread", f"Spread of {metric} over all cases"))


# --------------------------------------------------------------------------------------------
# The sweep


@dataclass(frozen=True, slots=True, eq=False)
class SweepResult(RunResult):
    """How a sweep ended.

    Attributes:
        cases: how many there are; ``done`` have a result, ``failures`` say why others have none.
    """

    cases: int = field(kw_only=True)
    done: int = field(kw_only=True)
    failures: Mapping[int, str] = field(kw_only=True)

    def table(self) -> pandas.DataFrame:
        """A row for each case and estimator: settings, metrics, and why a case failed."""
        import pandas

        return pandas.read_parquet(self.folder / TABLE_FILE)


def run_sweep(
    plan: Plan,
    folder: Path,
    pool: AbstractContextManager[Executor],
    existing: ExistingFolder = "refuse",
    metric: str | None = None,
    progress: Progress = lambda what, done, total: None,
    stopped: Stopped = lambda: False,
) -> SweepResult:
    """Runs the cases of a sweep that have no result yet, and writes table and page.

    Args:
        plan: what is swept.
        folder: of the results.
        pool: does the cases.
        existing: what to do where it holds a sweep: `resume` does what is missing, also of axes
            that have become longer.
        metric: column of the table that curves and tests are of; None: the first that is known.
        progress: called after each case.
        stopped: True ends it within a moment; the cases so far are kept and in the table.

    Raises:
        FgslamError: a case is impossible, the recording cannot be opened, or the results cannot be
            written.
    """
    cases = plan.cases
    require_usable(folder, existing, SWEEP)
    if existing == "resume":
        _require_same_experiments(folder, plan)
    with pool as workers, Owner(folder) as owner:
        keys, config = check_cases(plan, progress, stopped)
        begin_folder(folder, existing, owner, SWEEP)
        write_text(folder / MARKER, plan.description)
        reasons: dict[str, str] = {}
        with Journal(folder / JOURNAL_FILE) as journal:
            write_table = partial(_write_table, plan, folder, keys, journal, reasons)
            write_table()
            missing: dict[str, int] = {}
            for number, key in enumerate(keys):
                if key not in journal:
                    missing.setdefault(key, number)
            todo = list(missing.values())
            had, due = len(cases) - len(todo), 0.0
            progress("cases", had, len(cases))
            units = [cases[k] for k in todo]
            for index, outcome in workers.run(perform_case, units, stopped):
                key = keys[todo[index]]
                if isinstance(outcome, CaseResult):
                    journal.add(key, outcome)
                elif outcome.why == NOT_BEGUN:
                    continue
                else:
                    reasons[key] = outcome.why
                had += 1
                progress("cases", had, len(cases))
                begun = time.monotonic()
                if begun > due:
                    write_table()
                    took = time.monotonic() - begun
                    due = begun + max(_TABLE_EVERY_S, _TABLE_SHARE * took)
            table = write_table()
            done = sum(key in journal for key in keys)
        lost = workers.lost
    failures = {k: reasons[key] for k, key in enumerate(keys) if key in reasons}
    complete = done + len(failures) == len(cases)
    # An interrupted sweep has its table at once; tests and page are of all cases.
    findings = find(table, plan, metric) if complete else None
    lines = summarise(findings, len(cases), done, len(failures))
    if complete:
        write_sweep_page(folder / REPORT_FILE, lines, failures, findings, plan.description)
    labelled = [("failed", f"case {k}: {why}") for k, why in sorted(failures.items())]
    if len(labelled) > _FAILURES_SHOWN:
        more = len(labelled) - _FAILURES_SHOWN
        labelled = [*labelled[:_FAILURES_SHOWN], ("failed", f"and {more} more, see {TABLE_FILE}")]
    if lost:
        labelled.append(("scheduler", "it has gone, and what was under way with it"))
    return SweepResult(
        config,
        folder,
        "finished" if complete else "interrupted",
        lines=lines,
        tables=() if findings is None else (table_of_means(findings),),
        particulars=(*labelled, ("table", str(folder / TABLE_FILE))),
        failed=bool(failures),
        reached=f"after {done + len(failures)} of {len(cases)} cases",
        cases=len(cases),
        done=done,
        failures=failures,
    )


def _write_table(
    plan: Plan, folder: Path, keys: Sequence[str], journal: Journal, reasons: Mapping[str, str]
) -> Columns:
    """The metrics so far; each file whole or not at all: killed, it is one of a moment ago."""
    numbers, times = make_table(
        plan,
        (
            (number, journal[key] if key in journal else reasons[key])
            for number, key in enumerate(keys)
            if key in journal or key in reasons
        ),
    )
    about = {
        f"fgslam.experiment.{source.name}": yaml.safe_dump(dict(source.values), sort_keys=False)
        for source in plan.sources
    }
    write_parquet(folder / TABLE_FILE, numbers, about)
    write_parquet(folder / TIMES_FILE, times, about)
    return numbers


def _require_same_experiments(folder: Path, plan: Plan) -> None:
    path = folder / MARKER
    try:
        held = yaml.safe_load(path.read_text(encoding="utf-8"))
        names = sorted(held["experiments"])
    except (OSError, ValueError, TypeError, KeyError, yaml.YAMLError):
        raise OutputError(f"{path}: cannot be read; start again with --overwrite") from None
    own = sorted(source.name for source in plan.sources)
    if not set(names) <= set(own):
        raise ConfigError(
            f"{path}: is a sweep of {', '.join(names)}, not of {', '.join(own)}; resume with the "
            "same experiments, or choose another --out"
        )


def check_cases(
    plan: Plan,
    progress: Progress = lambda what, done, total: None,
    stopped: Stopped = lambda: False,
) -> tuple[list[str], Experiment]:
    """Key of every case, and the first configuration; what cannot be run is refused now.

    Recordings are opened, each once; what has to be rendered is rendered before workers would.
    """
    opened: dict[str, str] = {}
    keys: list[str] = []
    for case in plan.cases:
        config, estimators = case.settled()
        identity = ""
        if not isinstance(getattr(config, "dataset", None), SimulatedMeasurementsSettings):
            values = config.as_values()
            parts = {name: values.get(name) for name in ("task", "dataset", "odometry", "map")}
            ground = json.dumps(parts, sort_keys=True)
            if ground not in opened:
                task = opener_of(config)(config, Opening(Path("no such run"), False, progress))
                opened[ground] = str((task.provenance.get("dataset") or {}).get("identity", ""))
                if (given := getattr(getattr(config, "map", None), "load", None)) is not None:
                    opened[ground] += f" {digest_of([Path(given)])}"
            identity = opened[ground]
        keys.append(case.key(identity, (config, estimators)))
        if stopped():
            raise KeyboardInterrupt
    return keys, plan.cases[0].settled()[0]
