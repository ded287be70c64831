"""The options of ``fgslam compare``, here so that the command itself fits on a page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Runs = Annotated[
    list[Path],
    typer.Argument(metavar="RUN...", help="run folders; with --trials one run or experiment.yaml"),
]
Estimators = Annotated[
    str | None,
    typer.Option(
        metavar="A,B,C",
        help="which ones: kinds, or labels of the run's configuration; default those that it "
        "compares, else every kind",
    ),
]
EstimatorOverrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="estimators.NAME.KEY=VALUE",
        help="override one key of one estimator; may be repeated",
    ),
]
Out = Annotated[
    Path | None, typer.Option(help="folder of the results; default RUN/compare or RUN/trials")
]
OverwriteResults = Annotated[
    bool, typer.Option("--overwrite", help="replace an earlier comparison")
]
Jobs = Annotated[
    int, typer.Option(min=1, help="processes at a time; more than 1 disturbs the times")
]
TrialCount = Annotated[
    int | None, typer.Option("--trials", min=1, help="repeat over so many worlds of noise")
]
FirstSeed = Annotated[
    int | None, typer.Option(min=0, help="of the first trial; default the configuration's")
]
WriteBaseline = Annotated[
    Path | None, typer.Option(metavar="FILE", help="write the results as a baseline")
]
CheckBaseline = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="compare with a baseline; exit with 1 where one got worse"),
]
