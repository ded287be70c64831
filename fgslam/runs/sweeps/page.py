"""The page of a sweep, and what the terminal says of it: curves, intervals, pairwise tests."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.evaluation.judging import MeanInterval, mean_interval
from fgslam.report.content import Column, Figure, Page, TextTable
from fgslam.report.homing_figures import effect_figure, sorted_errors
from fgslam.report.page import write_html
from fgslam.runs.folder import versions
from fgslam.runs.sweeps.findings import ALL_PAIRS_OF, Comparison, Findings, Variant
from fgslam.runs.tables import measured_marks, with_marks

_SERIES_SHOWN = 24
_VARIANTS_SHOWN = 400
_FAILURES_SHOWN = 20


def sentences(findings: Findings | None, cases: int, done: int, failed: int) -> tuple[str, ...]:
    """How many cases there are, and which variant is the best, if one is."""
    first = f"{done:,} of {cases:,} cases done" + (f", {failed:,} failed" if failed else "")
    if findings is None:
        return (first,)
    means = [(found.mean, v.shown) for v in findings.variants if (found := v.mean(findings.metric))]
    if len(means) < 2:
        return (first,)
    least = min(means)
    shown = [one for one in findings.comparisons if one.better]
    return (
        first,
        f"smallest mean of {findings.metric}: {least[0]:.4g}, {least[1]}",
        f"{len(shown)} of {len(findings.comparisons)} paired comparisons differ at p < 0.05, "
        "corrected by Holm",
    )


def comparison_tables(findings: Findings | None) -> tuple[TextTable, ...]:
    """Means of each variant, and each two against each other."""
    if findings is None:
        return ()
    return (_means(findings), _pairs(findings))


def _means(findings: Findings) -> TextTable:
    columns = [
        Column("cases", "repetitions, over seeds and experiments, in which it ended well"),
        *(Column(name, "mean and 95 % interval by Student's t") for name in findings.metrics),
        Column("failed", "repetitions in which it failed"),
    ]
    rows = [
        (
            v.shown,
            (
                str(len(v.values[findings.metric])),
                *(_interval(v.mean(name)) for name in findings.metrics),
                str(v.failures),
            ),
        )
        for v in findings.variants[:_VARIANTS_SHOWN]
    ]
    return TextTable("means", "Means", "variant", tuple(columns), tuple(rows))


def _pairs(findings: Findings) -> TextTable:
    columns = (
        Column("cases", "repetitions that both have"),
        Column("difference", f"mean of A minus B in {findings.metric}, with its 95 % interval"),
        Column("A smaller", "repetitions in which A has the smaller value"),
        Column("p", "Wilcoxon's signed-rank test, two-sided; fewer than 6 pairs cannot reach 0.05"),
        Column("p by Holm", "the same corrected for all rows of this table (Holm 1979)"),
        Column("smaller", "the one that is shown to be smaller at p < 0.05 by Holm"),
    )
    rows = tuple((f"{one.a} | {one.b}", _pair(one)) for one in findings.comparisons)
    heading = f"A against B: {findings.metric}"
    if len(findings.variants) > ALL_PAIRS_OF:
        heading += " (each against the first; with fewer variants every two are compared)"
    return TextTable("pairs", heading, "A | B", columns, rows)


def _pair(one: Comparison) -> tuple[str, ...]:
    test = one.test
    return (
        str(test.difference.count),
        _interval(test.difference),
        f"{test.wins} of {test.difference.count}",
        "-" if test.p_value is None else f"{test.p_value:.2g}",
        "-" if one.p_value is None else f"{one.p_value:.2g}",
        one.better or "-",
    )


def _interval(found: MeanInterval | None) -> str:
    if found is None:
        return "-"
    ends = "" if found.lower is None else f"\n[{found.lower:.4g}, {found.upper:.4g}]"
    return f"{found.mean:.4g}{ends}"


# --------------------------------------------------------------------------------------------
# The page


def write_sweep_page(
    path: Path,
    headline: Sequence[str],
    failures: Mapping[int, str],
    findings: Findings | None,
    description: str,
) -> None:
    """The page, with the text of sweep.yaml. Raises OutputError."""
    series = _series(findings)
    page = Page(
        title=f"Sweep: {path.parent.resolve().name}",
        subtitle="means over the cases that ended well",
        headline=tuple(headline),
        notes=tuple(f"case {k}: {why}" for k, why in sorted(failures.items()))[:_FAILURES_SHOWN],
        tables=comparison_tables(findings),
        figures=tuple(_figures(findings, series)),
        config_yaml=description,
        versions=versions(),
    )
    write_html(path, page)


def _series(findings: Findings | None) -> dict[str, list[Variant]]:
    """Variants that differ in axes of numbers alone, by what they have in common."""
    found: dict[str, list[Variant]] = {}
    for variant in () if findings is None else findings.variants:
        words = [
            f"{key.split('.')[-1]}={value}"
            for key, value in variant.settings.items()
            if findings is not None and key not in findings.axes
        ]
        label = " ".join(filter(None, [*words, variant.estimator])) or "all"
        if label in found or len(found) < _SERIES_SHOWN:
            found.setdefault(label, []).append(variant)
    return {with_marks(label, _marks(own)): own for label, own in found.items()}


def _marks(variants: Sequence[Variant]) -> tuple[str, str]:
    return measured_marks(sum(v.predicted for v in variants), any(v.synthetic for v in variants))


def _figures(findings: Findings | None, series: dict[str, list[Variant]]) -> Iterator[Figure]:
    if findings is None:
        return
    for metric in findings.metrics:
        for axis in findings.axes:
            curves = {name: _curve(own, axis, metric) for name, own in series.items()}
            yield effect_figure(curves, axis, metric, several=len(findings.axes) > 1)
    pooled = {
        name: np.array([x for v in own for x in v.values[findings.metric].values()])
        for name, own in series.items()
    }
    words = ("spread", f"Spread of {findings.metric} over all cases")
    yield sorted_errors(pooled, findings.metric, words)


def _curve(variants: Sequence[Variant], axis: str, metric: str) -> FloatArray:
    """(n, 4): value on the axis, mean over the other settings and the seeds, ends of its interval.

    The interval is over the repetitions, each averaged over the other settings.
    """
    rows = []
    for value in sorted({v.settings[axis] for v in variants}):
        found: dict[object, list[float]] = {}
        for v in variants:
            for key, number in v.values[metric].items() if v.settings[axis] == value else ():
                found.setdefault(key, []).append(number)
        mean = mean_interval(np.array([np.mean(one) for one in found.values()]))
        if mean is not None:
            lower = np.nan if mean.lower is None else mean.lower
            upper = np.nan if mean.upper is None else mean.upper
            rows.append((float(value), mean.mean, lower, upper))
    return np.array(rows, np.float64).reshape(-1, 4)
