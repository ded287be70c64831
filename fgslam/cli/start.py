"""Entry point of the program: signals are answered before anything else is imported."""

from __future__ import annotations

import os
import sys

from fgslam.cli import signals


def main() -> None:
    """The command line; as :func:`fgslam.cli.main.main`."""
    signals.watch()
    try:
        from fgslam.cli.main import main as command

        command()
    except KeyboardInterrupt:
        print("fgslam: interrupted", file=sys.stderr)
        signals.end()
    except SystemExit as ended:
        if signals.was_asked() and ended.code == signals.status():
            signals.end()
        _flush()
        raise


def _flush() -> None:
    """Says now what could not be written: the interpreter would with a traceback."""
    try:
        sys.stdout.flush()
    except OSError as error:
        if not isinstance(error, BrokenPipeError):
            print(f"fgslam: standard output: {error.strerror}", file=sys.stderr)
        os._exit(1)
