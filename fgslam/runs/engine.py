"""Runs an experiment of any task: configuration in, run folder out; interruptible and resumable.

What is the same for all tasks is done here once: the folder that is refused, replaced or resumed,
the resolved configuration with versions and data, linear algebra on one thread, the units that are
kept until the run has finished. What a task does is its own module in :mod:`fgslam.runs.tasks`.
"""

from __future__ import annotations

import dataclasses
import os
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeAlias, TypeVar

from fgslam.core.errors import ConfigError, DatasetError, OutputError
from fgslam.core.threads import one_blas_thread
from fgslam.report.content import TextTable, read_metrics
from fgslam.runs.config import Experiment, load_experiment
from fgslam.runs.folder import (
    METRICS_FILE,
    OWNER_NAME,
    RUN_MARKER,
    STATE_FILE,
    ExistingFolder,
    Owner,
    begin_folder,
    is_empty,
    is_run_folder,
    require_usable,
    versions,
    write_config,
)
from fgslam.runs.units import Done, Progress, Stopped, UnitStore, holds_units
from fgslam.runs.workers import Argument, Executor, Failed, Pool, Result

if TYPE_CHECKING:
    from fgslam.backend.settings import EstimatorSettings
    from fgslam.backend.smoothers.graph import FactorGraph
    from fgslam.core.log import ImageSequence, MeasurementRecording
    from fgslam.datasets.omni import OmniRecording
    from fgslam.runs.dense import DenseMap

Status: TypeAlias = Literal["finished", "interrupted"]
R_co = TypeVar("R_co", bound="RunResult", covariant=True)


_UNDECIDED = 15
"""Frames that follow images which odometry contradicts, with nothing to tell which of the two errs,
from which on a run is no success."""


@dataclass(frozen=True, slots=True)
class LocatedShare:
    """How many frames (or queries) what was seen gave a pose in the map, of how many.

    Attributes:
        least: share that is a success.
        undecided: frames for which nothing shows whether images or odometry are right.
    """

    frames: int
    of: int
    least: float = 0.5
    undecided: int = 0

    @property
    def decided(self) -> bool:
        """Whether next to no frame is undecided."""
        return self.undecided < _UNDECIDED

    @property
    def enough(self) -> bool:
        """Whether so many were, decided; less is no success, and `fgslam` exits with 3."""
        return self.frames >= self.least * self.of and self.decided

    def __str__(self) -> str:
        share = 100.0 * self.frames / self.of if self.of else 0.0
        return f"{self.frames} of {self.of} frames ({share:.0f} %)"


@dataclass(frozen=True, slots=True, eq=False)
class RunResult:
    """How a run ended, and what is shown of it: terminal and page show the same.

    Attributes:
        config: what was run.
        folder: the run folder.
        status: whether all of it was done; `fgslam run --resume` goes on with the rest.
        lines: sentences.
        tables: numbers as text.
        notes: what was tolerated, or failed.
        particulars: label and text of further lines: failures, remarks, files to look at.
        failed: an estimator was asked for, and none gave an answer.
        reached: how far an interrupted run got, in words; may be empty.
        located: frames that were located; None where the task locates none.
        alarms: sentences about what makes it no success.
    """

    config: Experiment
    folder: Path
    status: Status
    lines: tuple[str, ...] = ()
    tables: tuple[TextTable, ...] = ()
    notes: tuple[str, ...] = ()
    particulars: tuple[tuple[str, str], ...] = ()
    failed: bool = False
    reached: str = ""
    located: LocatedShare | None = None
    alarms: tuple[str, ...] = ()

    @property
    def metrics(self) -> dict[str, Any]:
        """The document of metrics.json. Raises DatasetError where there is none."""
        return read_metrics(self.folder / METRICS_FILE)

    def graph(self, estimator: str | EstimatorSettings | None = None) -> FactorGraph:
        """The log of a run of SLAM as GTSAM's factor graph, as :func:`fgslam.graph` gives it.

        Args:
            estimator: whose solution; None for the one that steered.

        Raises:
            FgslamError: no run of SLAM, or the estimator keeps no whole graph.
        """
        from fgslam.runs.export import graph_of_run  # loads all of the back-end

        return graph_of_run(self.folder, estimator)

    def dense_map(self, estimator: str | None = None, **how: Any) -> DenseMap:
        """All that the images of a run of SLAM show: ``surface``, and ``grid`` to drive by.

        Args:
            estimator: whose trajectory; None for the one that steered.
            how: ``voxel_m``, ``range_m``, ``cameras``, ``every``; for their defaults see
                :class:`fgslam.runs.dense.DenseSettings`.

        Raises:
            FgslamError: no run of SLAM, its recording is gone or has no images, or they show no
                depth.
        """
        from fgslam.runs.dense import DenseSettings  # these load OpenCV and much of SciPy
        from fgslam.runs.export import dense_map

        return dense_map(self.folder, estimator, DenseSettings(**how))


@dataclass(frozen=True, slots=True, eq=False)
class Context:
    """What a task works with.

    Attributes:
        folder: the run folder; it holds the resolved configuration already.
        resumed: it may hold results of an earlier session.
        store: of finished units.
        jobs: processes at a time.
        progress, stopped: as of :func:`run_task`.
        executor: does the units.
    """

    folder: Path
    resumed: bool
    store: UnitStore
    jobs: int
    progress: Progress
    stopped: Stopped
    executor: Executor

    def perform(
        self,
        names: tuple[str, str],
        function: Callable[[Argument], Result],
        arguments: Sequence[Argument],
        kind: Any,
        block: int = 1,
        fresh: bool = False,
    ) -> Done[Result]:
        """Does what is missing of the units of one sort; what is done until a stop is kept.

        Args:
            names: unique in the run, of the files; and of the progress.
            function: of a module's top level; makes the result of one unit.
            arguments: one a unit; the units are numbered from 0.
            kind: type of one unit's result.
            block: units that are handed out, and kept, together.
            fresh: each block in a process that has done nothing before: its memory is measured.

        Raises:
            FgslamError: what a unit raised, or a unit's file cannot be written or read.
        """
        (name, label), count = names, len(arguments)
        found: dict[int, Result] = self.store.load(name, kind)
        missing = [k for k in range(count) if k not in found]
        blocks = [tuple(missing[k : k + block]) for k in range(0, len(missing), block)]
        ended: list[tuple[tuple[int, ...], str]] = []
        work = partial(_call_each, function)
        handed = [[arguments[k] for k in units] for units in blocks]
        done = len(found)
        self.progress(label, done, count)
        for index, result in self.executor.run(work, handed, self.stopped, fresh):
            units = blocks[index]
            if isinstance(result, Failed):
                ended.append((units, result.why))
            else:
                found |= self.store.add(name, dict(zip(units, result, strict=True)), kind)
            done += len(units)
            self.progress(label, done, count)
        return Done({k: found[k] for k in sorted(found)}, sorted(ended))

    def steps(self, label: str, numbers: range) -> Iterator[int]:
        """The numbers until a stop, with the progress after each."""
        for number in numbers:
            if self.stopped():
                return
            yield number
            self.progress(label, number + 1, numbers.stop)


def _call_each(
    function: Callable[[Argument], Result], arguments: Sequence[Argument]
) -> list[Result]:
    return [function(argument) for argument in arguments]


@dataclass(frozen=True, slots=True, eq=False)
class Task(Generic[R_co]):
    """An experiment whose data is open; nothing is done or written yet.

    Attributes:
        provenance: what config.yaml states of the data, next to the versions; its `dataset` has an
            `identity` where the data can change.
        run: does what is missing and writes all files of the run folder; raises FgslamError of
            any kind, with a message for the user.
    """

    provenance: Mapping[str, Any]
    run: Callable[[Context], R_co]


def provenance_of(
    recording: ImageSequence | OmniRecording | MeasurementRecording,
) -> dict[str, Any]:
    """What config.yaml states of a recording, by which a changed one is recognised on resuming."""
    return {"dataset": {"name": recording.name, "identity": recording.identity}}


@dataclass(frozen=True, slots=True, eq=False)
class Opening:
    """What a task is opened with.

    Attributes:
        folder: the run folder, which need not exist yet.
        resumed: it holds results of an earlier session.
        progress: as of :func:`run_task`.
    """

    folder: Path
    resumed: bool
    progress: Progress


Opener: TypeAlias = Callable[[Any, Opening], Task[R_co]]
"""Opens the data of a configuration, and refuses now, by a FgslamError, what could not work."""


@one_blas_thread()
def run_task(
    opener: Opener[R_co],
    config: Experiment,
    folder: Path,
    existing: ExistingFolder = "refuse",
    progress: Progress = lambda what, done, total: None,
    stopped: Stopped = lambda: False,
    jobs: int | None = None,
    executor: Executor | None = None,
) -> R_co:
    """Runs a configuration into a run folder by the task that ``opener`` opens.

    Args:
        opener: opens the task; may refuse.
        config: the experiment.
        folder: the run folder itself.
        existing: what to do where it holds a run already.
        progress: called after each step of the work.
        stopped: asked after each step; True ends the run early, resumable, with all files valid.
        jobs: processes at a time; None: as configured, else one.
        executor: does the units; None: processes of this machine.

    Raises:
        FgslamError: of any kind, with a message for the user.
    """
    config = config.resolved()
    with Owner(folder) as owner:
        # What would be refused after minutes of rendering is refused now.
        if existing == "resume" and folder.is_dir() and is_empty(folder):
            existing = "refuse"  # it was killed before its first file
        require_usable(folder, existing)
        resumed = existing == "resume"
        if resumed:
            if is_finished(folder):
                raise OutputError(
                    f"{folder}: nothing to resume (no unfinished units): the run has finished; use "
                    "--overwrite to run again"
                )
            require_same(config, folder)
        if is_run_folder(folder):
            owner.take()
        task = opener(config, Opening(folder, resumed, progress))
        begin_folder(folder, existing, owner)
        if resumed:
            require_same_ground(task.provenance, folder)
        else:
            write_config(folder, config, dict(task.provenance))
        store = UnitStore(folder)
        jobs = jobs or getattr(config, "jobs", 1) or os.cpu_count() or 1
        with Pool(jobs) as pool:
            loop = (jobs, progress, stopped, executor or pool)
            result = task.run(Context(folder, resumed, store, *loop))
        if result.status == "finished":
            store.remove()
    if not owner.before:
        return result
    note = ("taken over", f"from {owner.before}, which had ended without finishing")
    return dataclasses.replace(result, particulars=(note, *result.particulars))


def is_finished(folder: Path) -> bool:
    """Whether a run folder has nothing left to do."""
    path = folder / METRICS_FILE
    left = [folder / STATE_FILE, folder / OWNER_NAME]  # the second by a process that was killed
    begun = holds_units(folder) or any(file.is_file() for file in left)
    return not begun and path.is_file() and read_metrics(path).get("status") != "interrupted"


def require_same(config: Experiment, folder: Path) -> None:
    """A run resumes only with the configuration that it was started with.

    Where its recording lies may differ: that it is the same one is seen by its contents.
    """
    path = folder / RUN_MARKER
    before = load_experiment(path)
    then, now = before.as_values(), config.as_values()
    if isinstance(now.get("dataset", {}).get("path"), str):
        then.get("dataset", {})["path"] = now["dataset"]["path"]
    if then != now:
        compared = "run" in (before.provenance or {})  # not begun by `fgslam run`
        command = "" if compared else f" ({resume_command(folder)})"
        raise ConfigError(
            f"{path}: differs from the configuration given; resume with the same one{command} or "
            "start again with --overwrite"
        )


def require_same_ground(now: Mapping[str, Any], folder: Path) -> None:
    """A run resumes to the same bytes only on its own recording and with its own packages."""
    path = folder / RUN_MARKER
    then = load_experiment(path).provenance or {}
    dataset, before = now.get("dataset") or {}, then.get("dataset") or {}
    if before.get("identity") != dataset.get("identity"):
        raise DatasetError(
            f"{dataset.get('name')}: the recording has changed since {path} was written; restore "
            "it, or start again with --overwrite"
        )
    if then.get("log") != now.get("log"):
        raise ConfigError(
            f"{path}: was begun with log {then.get('log')}, and now it is {now.get('log')}; "
            "resume with the same, or start again with --overwrite"
        )
    before, own = then.get("versions") or {}, versions()
    differing = [name for name in own if name in before and before[name] != own[name]]
    changed = [f"{name} {before[name]} -> {own[name]}" for name in differing]
    if changed:
        raise ConfigError(
            f"{path}: started with other versions ({', '.join(changed)}), which would not give the "
            "same bytes; restore them, or start again with --overwrite"
        )


def resume_command(folder: Path) -> str:
    """What to type to continue the run in ``folder``, whatever overrides it was started with."""
    run = shlex.quote(str(folder))
    return f"fgslam run {shlex.quote(str(folder / RUN_MARKER))} --out {run} --resume"
