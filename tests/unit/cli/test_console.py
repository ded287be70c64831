"""What the console shows while there is work."""

from __future__ import annotations

import io

from rich.console import Console

from fgslam.cli.console import Bars


def test_progress_says_how_many_cases_are_done_and_the_time_left() -> None:
    now, out = [100.0], io.StringIO()
    console = Console(file=out, force_terminal=True, width=120, get_time=lambda: now[0])
    bars = Bars(console, begin=lambda: None)
    for done in range(5):
        bars.tell("cases", done, 20)
        now[0] += 30.0
    console.print(bars.drawn)
    # 30 seconds a case, 16 are left: 8 minutes.
    said = Console(width=120).render_str(out.getvalue()).plain
    assert "4/20" in said
    assert "0:08:00" in said
