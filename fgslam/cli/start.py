"""Entry point of the program: signals are answered before anything else is imported."""

from __future__ import annotations

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
        raise
