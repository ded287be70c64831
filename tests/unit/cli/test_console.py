"""What the console shows while there is work."""

from __future__ import annotations

import io

from rich.console import Console

from fgslam.cli.console import Display


def test_progress_says_how_many_cases_are_done_and_the_time_left() -> None:
    now, out = [100.0], io.StringIO()
    console = Console(file=out, width=120, get_time=lambda: now[0])
    shown = Display(console)
    for done in range(5):
        shown.tell("cases", done, 20)
        now[0] += 30.0
    shown.close()
    # 30 seconds a case, 16 are left: 8 minutes.
    said = out.getvalue()
    assert "4/20" in said
    assert "0:08:00" in said


def test_nothing_is_drawn_without_a_stage() -> None:
    out = io.StringIO()
    Display(Console(file=out)).close()
    assert not out.getvalue()
