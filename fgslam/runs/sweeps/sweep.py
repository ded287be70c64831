"""`fgslam sweep`: every case on some worker, kept as it comes, and what all of them say."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, overload

from fgslam.core.errors import ConfigError
from fgslam.datasets.settings import SimulatedMeasurementsSettings
from fgslam.report.content import TextTable
from fgslam.runs.config import Experiment
from fgslam.runs.engine import Opening, RunResult, Status
from fgslam.runs.folder import REPORT_FILE, ExistingFolder, Owner, digest_of, versions
from fgslam.runs.run import opener_of
from fgslam.runs.sweeps.case import CaseResult, CaseTask, perform_case
from fgslam.runs.sweeps.findings import Findings, find
from fgslam.runs.sweeps.folder import JOURNAL_FILE, MARKER, Plan, begin_sweep
from fgslam.runs.sweeps.grid import Case, Grid, make_axes, read_axes, read_source
from fgslam.runs.sweeps.journal import Journal
from fgslam.runs.sweeps.page import comparison_tables, sentences, write_sweep_page
from fgslam.runs.sweeps.running import RunningMeans
from fgslam.runs.sweeps.table import TABLE_FILE, SweepTable, make_table
from fgslam.runs.units import Progress, Stopped
from fgslam.runs.workers import NOT_BEGUN, Executor, Pool

if TYPE_CHECKING:
    import pandas

_FAILURES_SHOWN = 8
_TABLE_EVERY_S = 30.0
_TABLE_SHARE = 20.0  # the sweep goes on at least so many times as long as it writes its table

Shown: TypeAlias = Callable[[TextTable], None]
"""Called with the means so far, now and then."""

Watch: TypeAlias = tuple[Progress, Stopped, Shown]
"""Called after each case; asked whether to end, within a moment; called with the means so far."""

UNWATCHED: Watch = (lambda what, done, total: None, lambda: False, lambda table: None)


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
    return Plan(Grid(tuple(map(read_source, sources)), axes), chosen)


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
        import pandas  # half a second, and only tables need it

        return pandas.read_parquet(self.folder / TABLE_FILE)


def workers_of(jobs: int | None, scheduler: str | None) -> Pool:
    """Workers of a scheduler, or so many of this machine; None: one a core.

    Raises:
        ConfigError: both are given, or there would be no worker.
    """
    if jobs is not None and jobs < 1:
        raise ConfigError(f"jobs is {jobs}; give at least 1, or none for one a core")
    if jobs is not None and scheduler is not None:
        raise ConfigError("--jobs is for workers of this machine; leave it out with --scheduler")
    return Pool(jobs, scheduler)


def run_sweep(
    plan: Plan,
    folder: Path,
    pool: AbstractContextManager[Executor],
    existing: ExistingFolder = "refuse",
    metric: str | None = None,
    watch: Watch = UNWATCHED,
) -> SweepResult:
    """Runs the cases of a sweep that have no result yet, and writes table and page.

    Args:
        plan: what is swept.
        folder: of the results.
        pool: does the cases, as :func:`workers_of` makes it.
        existing: what to do where it holds a sweep: `resume` does what is missing, also of axes
            that have become longer.
        metric: column of the table that curves and tests are of; None: the first that is known.
        watch: who is told, and who may end it; the cases so far are kept and in the table.

    Raises:
        FgslamError: a case is impossible, the recording cannot be opened, or the results cannot be
            written.
    """
    begin_sweep(folder, existing, plan)
    with pool as workers, Owner(folder) as owner:
        keys, config = _checked(plan, watch)
        begin_sweep(folder, existing, plan, owner)
        with Journal(folder / JOURNAL_FILE) as journal:
            work = _Work(plan, keys, journal, RunningMeans(plan.grid, metric), folder)
            work.do(workers, watch)
            table = work.write()
        lost = workers.lost
    # An interrupted sweep has its table at once; tests and page are of all cases.
    findings = find(table, plan.grid, metric) if work.complete else None
    failures = work.failures
    result = _result(config, work, findings, lost)
    if work.complete:
        description = (folder / MARKER).read_text(encoding="utf-8")
        write_sweep_page(folder / REPORT_FILE, result.lines, failures, findings, description)
    return result


def _result(config: Experiment, work: _Work, findings: Findings | None, lost: bool) -> SweepResult:
    cases, done, failures = len(work.keys), work.done, work.failures
    status: Status = "finished" if work.complete else "interrupted"
    told = [("failed", f"case {k}: {why}") for k, why in sorted(failures.items())]
    if len(told) > _FAILURES_SHOWN:
        more = len(told) - _FAILURES_SHOWN
        told = [*told[:_FAILURES_SHOWN], ("failed", f"and {more} more, see {TABLE_FILE}")]
    if lost:
        told.append(("scheduler", "it has gone, and what was under way with it"))
    return SweepResult(
        config,
        work.folder,
        status,
        lines=sentences(findings, cases, done, len(failures)),
        tables=comparison_tables(findings)[:1],
        particulars=(*told, ("table", str(work.folder / TABLE_FILE))),
        failed=bool(failures),
        reached=f"after {done + len(failures)} of {cases} cases",
        cases=cases,
        done=done,
        failures=failures,
    )


# --------------------------------------------------------------------------------------------
# The cases


class _Tasks(Sequence[CaseTask]):
    """What workers are given, made when it is handed out."""

    def __init__(self, plan: Plan, cases: Sequence[int]) -> None:
        self._plan, self._cases, self._versions = plan, cases, versions()

    def __len__(self) -> int:
        return len(self._cases)

    @overload
    def __getitem__(self, index: int) -> CaseTask: ...
    @overload
    def __getitem__(self, index: slice) -> list[CaseTask]: ...
    def __getitem__(self, index: int | slice) -> CaseTask | list[CaseTask]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        case = self._plan.grid[self._cases[index]]
        source = self._plan.grid.sources[case.source]
        return CaseTask(
            source.values, source.where, case.overrides, self._plan.names, self._versions
        )


def _checked(plan: Plan, watch: Watch) -> tuple[list[str], Experiment]:
    """Key of every case, and the first configuration; what cannot be run is refused now.

    Recordings are opened, each once; what has to be rendered is rendered before workers would.
    """
    tasks = _Tasks(plan, range(len(plan.grid)))
    progress, stopped, _ = watch
    opened: dict[str, str] = {}
    keys: list[str] = []
    for number in range(len(tasks)):
        task = tasks[number]
        settled = task.settled()
        config = settled[0]
        ground = json.dumps(_ground(config), sort_keys=True)
        if ground not in opened:
            opened[ground] = _identity(config, progress)
        keys.append(task.key(opened[ground], settled))
        if stopped():
            raise KeyboardInterrupt
    return keys, tasks[0].settled()[0]


def _ground(config: Experiment) -> dict[str, Any]:
    """What says which recording it is."""
    if isinstance(getattr(config, "dataset", None), SimulatedMeasurementsSettings):
        return {"simulated": True}
    values = config.as_values()
    return {name: values.get(name) for name in ("task", "dataset", "odometry", "map")}


def _identity(config: Experiment, progress: Progress) -> str:
    """Digests of the recording and of the map that is given; empty where all is simulated.

    Raises FgslamError.
    """
    if isinstance(getattr(config, "dataset", None), SimulatedMeasurementsSettings):
        return ""
    task = opener_of(config)(config, Opening(Path("no such run"), False, progress))
    recording = str((task.provenance.get("dataset") or {}).get("identity", ""))
    given = getattr(getattr(config, "map", None), "load", None)
    return recording if given is None else f"{recording} {digest_of([Path(given)])}"


@dataclass(slots=True, eq=False)
class _Work:
    plan: Plan
    keys: Sequence[str]
    journal: Journal
    means: RunningMeans
    folder: Path
    reasons: dict[str, str] = field(default_factory=dict)
    """Why cases failed, by key."""
    _due: float = 0.0

    @property
    def failures(self) -> dict[int, str]:
        """Why cases failed, by their number."""
        return {k: self.reasons[key] for k, key in enumerate(self.keys) if key in self.reasons}

    @property
    def done(self) -> int:
        """Cases that have a result."""
        return sum(key in self.journal for key in self.keys)

    @property
    def complete(self) -> bool:
        """Whether nothing is left to do."""
        return self.done + len(self.failures) == len(self.keys)

    def do(self, workers: Executor, watch: Watch) -> None:
        """Does what has no result yet."""
        progress, stopped, shown = watch
        todo = self._missing()
        self.write()
        count = len(self.keys)
        had = count - len(todo)
        progress("cases", had, count)
        for index, outcome in workers.run(perform_case, _Tasks(self.plan, todo), stopped):
            number = todo[index]
            if isinstance(outcome, CaseResult):
                self.journal.add(self.keys[number], outcome)
            elif outcome.why == NOT_BEGUN:
                continue
            else:
                self.reasons[self.keys[number]] = outcome.why
            had += 1
            progress("cases", had, count)
            if self.means.add(self.plan.grid[number], outcome):
                shown(self.means.table())
            if time.monotonic() > self._due:
                self.write()

    def write(self) -> SweepTable:
        """The table so far, whole or not at all; killed, the sweep leaves one of a moment ago."""
        begun = time.monotonic()
        table = make_table(self.plan.grid, self._found())
        table.write(self.folder, self.plan.grid)
        now = time.monotonic()
        self._due = now + max(_TABLE_EVERY_S, _TABLE_SHARE * (now - begun))
        return table

    def _missing(self) -> list[int]:
        """Cases without a result, each key once."""
        first: dict[str, int] = {}
        for number, key in enumerate(self.keys):
            if key not in self.journal:
                first.setdefault(key, number)
        return sorted(first.values())

    def _found(self) -> Iterator[tuple[Case, CaseResult | str]]:
        for number, key in enumerate(self.keys):
            if key in self.journal:
                yield self.plan.grid[number], self.journal.result(key)
            elif key in self.reasons:
                yield self.plan.grid[number], self.reasons[key]
