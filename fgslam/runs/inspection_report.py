"""The text that ``fgslam inspect`` prints."""

from __future__ import annotations

import textwrap
from typing import TypeAlias

from fgslam.datasets.checks.findings import Finding, Level

Facts: TypeAlias = tuple[tuple[str, str], ...]
"""Labels and values."""

_WIDTH = 100
_MOTION = ("ground truth", "odometry", "odometry against truth")


def render_report(recording: Facts, seen: Facts, findings: tuple[Finding, ...]) -> str:
    """Aligned facts, then the findings with their mends, then the verdict.

    Args:
        recording: what it is.
        seen: what its images show.
        findings: the worst first; those that only tell something stand among the facts.
    """
    told = [(f.subject, f.text) for f in findings if f.level is Level.INFO]
    moved = tuple(fact for fact in told if fact[0] in _MOTION)
    matched = tuple(fact for fact in told if fact[0] not in _MOTION)
    width = max(len(label) for label, _ in (*recording, *seen, *told))
    bad = tuple(
        (f.level.value.upper(), f"{f.subject}: {f.text}")
        for f in findings
        if f.level is not Level.INFO
    )
    blocks = [_aligned(facts, width) for facts in (recording, moved, (*seen, *matched))]
    blocks += [_aligned(bad, len(Level.PROBLEM.value)), _verdict(findings)]
    return "\n\n".join(block for block in blocks if block)


def _verdict(findings: tuple[Finding, ...]) -> str:
    problems = sum(f.level is Level.PROBLEM for f in findings)
    warnings = sum(f.level is Level.WARNING for f in findings)
    if problems:
        also = f" and {_counted(warnings, 'warning')}" if warnings else ""
        return f"{_counted(problems, 'problem')}{also}: problems spoil a run, or the frames named."
    if warnings:
        return f"No problem, {_counted(warnings, 'warning')}."
    return "No problem found."


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _aligned(rows: Facts, width: int) -> str:
    """Two columns, the first ``width`` wide, the second wrapped under itself; no word is broken."""
    indent = width + 2
    return "\n".join(
        textwrap.fill(
            value,
            _WIDTH,
            initial_indent=label.ljust(indent),
            subsequent_indent=" " * indent,
            break_long_words=False,
            break_on_hyphens=False,
        )
        for label, value in rows
    )
