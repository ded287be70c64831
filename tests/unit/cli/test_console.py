"""What the console shows while there is work."""

from __future__ import annotations

import io

from rich.console import Console

from fgslam.cli.console import fitting_tables, progress_bar
from fgslam.report.content import Column, TextTable


def test_progress_says_how_many_cases_are_done_and_the_time_left() -> None:
    now, out = [100.0], io.StringIO()
    console = Console(file=out, width=120, get_time=lambda: now[0])
    with progress_bar(console) as tell:
        for done in range(5):
            tell("cases", done, 20)
            now[0] += 30.0
    # 30 seconds a case, 16 are left: 8 minutes.
    said = out.getvalue()
    assert "4/20" in said
    assert "0:08:00" in said


def test_a_table_is_parted_where_its_words_would_be_cut() -> None:
    headings = ("NEES pose online", "NEES landmarks", "noise factor", "update ms median p95")
    columns = tuple(Column(name, "") for name in headings)
    cells = ("37.50 overconfident", "0.52 consistent", "1.00", "1.60 18.98 45.0")
    rows = tuple((f"estimator_{k} (1 pose predicted)", cells) for k in range(2))
    table = TextTable("key", "a heading", "estimator", columns, rows)
    for width, parts in ((62, 3), (80, 2), (120, 1)):
        out = io.StringIO()
        found = list(fitting_tables(table, width))
        assert len(found) == parts
        console = Console(file=out, width=width)
        for part in found:
            console.print(part)
        said = out.getvalue()
        assert max(map(len, said.splitlines())) <= width
        assert "…" not in said
        for word in (*" ".join((*headings, *cells)).split(), "estimator_1 (1 pose predicted)"):
            assert word in said
        assert said.count("a heading") == 1


def test_nothing_is_drawn_without_a_stage() -> None:
    out = io.StringIO()
    with progress_bar(Console(file=out)):
        pass
    assert not out.getvalue()
