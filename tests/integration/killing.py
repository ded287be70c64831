"""Runs in processes that are forked once all is imported: for tests that kill many of them.

Reads a line of JSON for each run, answers with the process's number, and with its status when it
has ended. A process forked after images were worked on could wait for threads that it lacks.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
from running import units_in_this_process

from fgslam.core.errors import FgslamError
from fgslam.runs.compare import Choice, compare_runs
from fgslam.runs.config import make_experiment
from fgslam.runs.folder import ExistingFolder
from fgslam.runs.run import opener_of, run_experiment
from fgslam.runs.trials import run_trials

REFUSED = 2
_STEPS = {
    "fgslam.runs.tasks.homing_views.VIEWS_A_BLOCK": 2,
    "fgslam.runs.tasks.homing_replay.TRIALS_A_BLOCK": 1,
    "fgslam.runs.tasks.homing_drives.SAVE_EVERY_S": 0.0,
    "fgslam.runs.tasks.localisation.SAVE_EVERY_S": 0.0,
    "fgslam.report.pictures.DPI": 50,
}


def perform(
    values: dict[str, Any], folder: Path, existing: ExistingFolder, do: str, source: str
) -> None:
    """A run of the values, or what is made of the run or the experiment ``source``."""
    if do == "compare":
        compare_runs([Path(source)], Choice(tuple(values["names"])), folder, existing)
    elif do == "trials":
        run_trials(Path(source), range(5, 7), Choice(), folder, existing)
    else:
        run_experiment(make_experiment(values, "test"), folder, existing)


def _in_a_child(request: dict[str, Any]) -> None:
    said = Path(request.pop("said"))
    try:
        perform(**(request | {"folder": Path(request["folder"])}))
    except FgslamError as error:
        said.write_text(str(error))
        os._exit(REFUSED)
    os._exit(0)


def serve(experiments: list[dict[str, Any]]) -> None:
    with units_in_this_process(), ExitStack() as stack:
        patch = stack.enter_context(pytest.MonkeyPatch.context())
        for values in experiments:
            opener_of(make_experiment(values, "test"))
        for name, value in _STEPS.items():
            patch.setattr(name, value)
        print("ready", flush=True)
        for line in sys.stdin:
            number = os.fork()
            if not number:
                _in_a_child(json.loads(line))
            print(number, flush=True)
            _, status = os.waitpid(number, 0)
            print(os.waitstatus_to_exitcode(status), flush=True)


class Server:
    """The other end: starts runs, and tells how they ended."""

    def __init__(self, process: subprocess.Popen[str], said: Path) -> None:
        self._process, self._said = process, said

    def start(self, **request: Any) -> int:
        """Number of the process that performs so."""
        self._said.unlink(missing_ok=True)
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(request | {"said": str(self._said)}) + "\n")
        self._process.stdin.flush()
        return int(self.line())

    def ended(self) -> tuple[int, str]:
        """Status of the process, once it has ended, and what it refused by."""
        status = int(self.line())
        return status, self._said.read_text() if self._said.is_file() else ""

    def line(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()


@contextmanager
def server(experiments: list[dict[str, Any]], scratch: Path) -> Iterator[Server]:
    given = [sys.executable, __file__, json.dumps(experiments)]
    paths = os.pathsep.join(sys.path)
    with subprocess.Popen(  # noqa: S603
        given,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": paths},
    ) as process:
        found = Server(process, scratch / "said")
        assert found.line() == "ready"
        yield found
        process.kill()


if __name__ == "__main__":
    serve(json.loads(sys.argv[1]))
