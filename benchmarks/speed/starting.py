"""Cost of starting: processor time of fresh interpreters, as a multiple of a bare one's."""

from __future__ import annotations

import resource
import subprocess
import sys
from collections.abc import Sequence

_REPEATS = 7

_COMMANDS: dict[str, tuple[str, ...]] = {
    "import": ("-c", "import fgslam"),
    "help": ("-m", "fgslam", "--help"),
    "wrong_folder": ("-m", "fgslam", "inspect", "no/such/folder"),
    "wrong_setting": ("-m", "fgslam", "run", "lab_loop", "--set", "dataset.kin=1"),
}

LIMITS: dict[str, float] = {
    "start_import": 5.0,
    "start_help": 15.0,
    "start_wrong_folder": 20.0,
}
"""A bare interpreter takes 0.025 s on the machine of the bounds: 0.1 s more for the import, 0.35 s
for the help, 0.5 s for a wrong folder."""


def ratios_of_starting() -> dict[str, float]:
    """Least processor time of each command over that of an interpreter that does nothing."""
    bare = _seconds(("-c", "pass"))
    return {f"start_{name}": _seconds(command) / bare for name, command in _COMMANDS.items()}


def _seconds(arguments: Sequence[str]) -> float:
    """Least processor time of several runs; the first, which may compile modules, never counts."""
    return sorted(_once(arguments) for _ in range(_REPEATS))[0]


def _once(arguments: Sequence[str]) -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(  # noqa: S603 - this interpreter and constant arguments
        [sys.executable, *arguments], capture_output=True, check=False
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
