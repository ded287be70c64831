"""Ctrl-C and SIGTERM end a command from its first moment on, whatever it is at."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from fgslam.cli.signals import WITHIN_S

_WHILE_IMPORTING = """
import os, sys
from fgslam.cli.start import main
number, module = int(sys.argv.pop(1)), sys.argv.pop(1)

class Signalling:
    def find_spec(self, name, *rest):
        if name == module:
            os.kill(os.getpid(), number)

sys.meta_path.insert(0, Signalling())
main()
"""
_STUCK = """
import os, sys, time
from fgslam.cli import signals
signals.watch()
with signals.stop_flag():
    os.kill(os.getpid(), int(sys.argv[1]))
    time.sleep(600.0)
"""


def ended(code: str, *arguments: object) -> tuple[int, str]:
    given = [sys.executable, "-c", code, *map(str, arguments)]
    done = subprocess.run(given, capture_output=True, text=True, timeout=60.0)  # noqa: S603
    return done.returncode, done.stderr


@pytest.mark.parametrize(
    ("number", "module"),
    [(signal.SIGINT, "typer"), (signal.SIGTERM, "pydantic"), (signal.SIGINT, "yaml")],
)
def test_while_a_command_imports_a_signal_ends_it_with_one_line(
    number: signal.Signals, module: str
) -> None:
    status, said = ended(_WHILE_IMPORTING, int(number), module, "run", "lab_loop")
    assert (status, said) == (128 + number, "fgslam: interrupted\n")


_BEFORE_IT_WATCHES = """
import os, signal, sys
signal.signal(signal.SIGINT, getattr(signal, sys.argv[1]))

class Interrupting:
    def find_spec(self, name, *rest):
        if name == "fgslam.cli.signals":
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupting())
import fgslam.cli.start
"""


@pytest.mark.parametrize(
    ("handler", "status"), [("default_int_handler", -signal.SIGINT), ("SIG_IGN", 0)]
)
def test_ctrl_c_before_signals_are_answered_ends_without_a_traceback(
    handler: str, status: int
) -> None:
    """But not who ignores it, as a worker does."""
    assert ended(_BEFORE_IT_WATCHES, handler) == (status, "")


_ONE_IGNORED = """
import os, signal, sys
ignored, sent = map(int, sys.argv[1:])
signal.signal(ignored, signal.SIG_IGN)
from fgslam.cli import signals
signals.watch()
with signals.stop_flag() as stopped:
    os.kill(os.getpid(), sent)
    print(stopped(), file=sys.stderr)
signals.nothing_to_end()
os.kill(os.getpid(), ignored)
os._exit(signal.getsignal(ignored) is not signal.SIG_IGN)
"""


def test_a_signal_that_the_process_was_started_to_ignore_stays_ignored() -> None:
    ignored, other = map(int, (signal.SIGTERM, signal.SIGINT))
    assert ended(_ONE_IGNORED, ignored, ignored) == (0, "False\n")
    assert ended(_ONE_IGNORED, ignored, other) == (0, "True\n")


_WHILE_IT_STARTS_TO_WATCH = """
import os, sys, threading
from fgslam.cli.start import main
start = threading.Thread.start

def signalled(thread):
    os.kill(os.getpid(), int(sys.argv[1]))
    start(thread)

threading.Thread.start = signalled
main()
"""


def test_a_signal_in_the_moment_in_which_it_starts_to_be_answered_is_one_line() -> None:
    status, said = ended(_WHILE_IT_STARTS_TO_WATCH, int(signal.SIGTERM))
    assert (status, said) == (143, "fgslam: interrupted\n")


def test_a_command_that_does_not_end_by_itself_is_ended() -> None:
    status, said = ended(_STUCK, int(signal.SIGTERM))
    assert status == 128 + signal.SIGTERM
    assert said == "fgslam: interrupted; what was saved until then is in valid files\n"
    assert WITHIN_S < 2.0


def test_an_output_that_is_full_is_said_in_one_line() -> None:
    code = "from fgslam.cli.start import main; main()"
    with Path("/dev/full").open("w") as full:
        given = [sys.executable, "-c", code, "--version"]
        done = subprocess.run(given, stdout=full, stderr=subprocess.PIPE, text=True)  # noqa: S603
    assert done.returncode
    assert done.stderr.startswith("fgslam: standard output: No space left on device")
    assert done.stderr.count("\n") == 1


_SLOW_TO_FREE = """
import time
from fgslam.cli.start import main

class Large:
    def __del__(self, sleep=time.sleep):
        sleep(600.0)

large = Large()
main()
"""


def test_a_command_that_is_done_does_not_free_all_that_it_holds_before_it_ends() -> None:
    status, said = ended(_SLOW_TO_FREE, "--version")
    assert (status, said) == (0, "")
    status, said = ended(_SLOW_TO_FREE, "--no-such-option")
    assert status == 2
    assert "No such option" in said


_ANOTHER_ERROR = """
import os, sys
from fgslam.cli.start import main

class Library:
    def find_spec(self, name, *rest):
        if name == sys.argv[1]:
            try:
                os.kill(os.getpid(), 2)
            except KeyboardInterrupt as error:
                raise ValueError(f"schema: {error!r}")

sys.meta_path.insert(0, Library())
main()
"""


def test_an_error_that_a_library_makes_of_ctrl_c_is_an_interruption() -> None:
    code = _ANOTHER_ERROR.replace("sys.argv[1]", repr("pydantic"))
    status, said = ended(code, "run", "lab_loop")
    assert (status, said) == (130, "fgslam: interrupted\n")


_WHILE_IT_CLEARS_UP = """
import atexit, os, sys
from fgslam.cli.start import main

class Library:
    def find_spec(self, name, *rest):
        if name == "typer":
            atexit.register(os.kill, os.getpid(), 2)

sys.meta_path.insert(0, Library())
main()
"""


def test_a_signal_after_the_command_has_ended_changes_nothing() -> None:
    assert ended(_WHILE_IT_CLEARS_UP, "--version") == (0, "")
