"""What the commands that run something share: progress and stop flag, results, exit status."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import typer

from fgslam.cli import signals
from fgslam.cli.signals import Tell, stop_flag, stoppable

if TYPE_CHECKING:
    from pathlib import Path

    from fgslam.runs.config_models import Experiment
    from fgslam.runs.engine import RunResult
    from fgslam.runs.folder import ExistingFolder
    from fgslam.runs.tasks.slam import Watch

EXIT_FAULT = 1
EXIT_NOT_LOCATED = 3


@contextmanager
def under_way() -> Iterator[tuple[Tell, Callable[[], bool]]]:
    """Progress bar and stop flag while something is under way."""
    from fgslam.cli.console import progress_bar

    with stop_flag() as stopped, progress_bar() as progress:
        yield stoppable(progress, stopped), stopped


@contextmanager
def watched_by(config: Experiment, live: bool, file: Path | None) -> Iterator[Watch | None]:
    """What shows a run in the viewer, frame by frame; None without a viewer."""
    if not live and file is None:
        yield None
        return
    from fgslam.runs.view import watched

    with watched(config, live, file) as watch:
        yield watch


def show_all(results: Sequence[RunResult], resume: str = "") -> None:
    """Prints what the results say; ``resume`` is the command that goes on with the rest."""
    from fgslam.cli.console import show

    for result in results:
        show(result, resume)


def exit_as(results: Sequence[RunResult]) -> None:
    """Exits as the results ended: done, interrupted, an estimator in vain, or hardly located."""
    if any(result.status == "interrupted" for result in results):
        raise SystemExit(signals.status())
    if any(result.failed for result in results):
        raise typer.Exit(EXIT_FAULT)
    if any(result.located is not None and not result.located.enough for result in results):
        raise typer.Exit(EXIT_NOT_LOCATED)


def same_with_resume() -> str:
    """This command once more, to go on with what it left."""
    given = [word for word in sys.argv[1:] if word not in ("--overwrite", "--resume")]
    return shlex.join(["fgslam", *given, "--resume"])


def existing_folder(overwrite: bool, resume: bool = False) -> ExistingFolder:
    """What to do with results that are there. Raises ConfigError where both were asked for."""
    from fgslam.core.errors import ConfigError

    if overwrite and resume:
        raise ConfigError("--overwrite and --resume exclude each other; give one of them")
    return "resume" if resume else "overwrite" if overwrite else "refuse"
