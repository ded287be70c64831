"""Arguments and options of the commands, here so that the commands themselves fit on a page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fgslam.cli import given_paths


def _version(wanted: bool) -> None:
    if wanted:
        from fgslam.core import __version__

        typer.echo(f"fgslam {__version__}")
        raise typer.Exit


# --------------------------------------------------------------------------------------------
# All commands

Version = Annotated[
    bool, typer.Option("--version", callback=_version, is_eager=True, help="print it and exit")
]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="A.B=VALUE", help="override one key of the experiment; may be repeated"
    ),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="replace an earlier one")]

# --------------------------------------------------------------------------------------------
# run

Experiment = Annotated[
    Path,
    typer.Argument(
        metavar="EXPERIMENT",
        parser=given_paths.experiment,
        autocompletion=given_paths.names_beginning_with,
        help="a .yaml file, or the name of one that comes with fgslam, e.g. lab_loop",
    ),
]
RunFolder = Annotated[Path | None, typer.Option(help="the run folder itself; default runs/NAME")]
Resume = Annotated[
    bool, typer.Option("--resume", help="continue an interrupted run to the same bytes")
]
MapIn = Annotated[
    Path | None,
    typer.Option("--map-in", metavar="MAP", help="saved map to go on with; sets map.load"),
]
MapOut = Annotated[
    Path | None,
    typer.Option("--map-out", metavar="MAP", help="where to save the map; sets map.save"),
]

# --------------------------------------------------------------------------------------------
# inspect, localize

Recording = Annotated[
    Path,
    typer.Argument(
        metavar="RECORDING",
        parser=given_paths.recording,
        autocompletion=given_paths.names_beginning_with,
        help="a recording's folder; or an experiment, .yaml or name, for its data set",
    ),
]

# --------------------------------------------------------------------------------------------
# Runs and maps

RunToView = Annotated[
    Path, typer.Argument(metavar="RUN", parser=given_paths.run_folder, help="a run folder")
]
RunOrMap = Annotated[
    Path,
    typer.Argument(
        metavar="RUN|MAP",
        parser=given_paths.run_folder_or_map,
        help="a run folder, or a saved map",
    ),
]
SavedMap = Annotated[
    Path, typer.Argument(metavar="MAP", parser=given_paths.saved_map, help="a saved map")
]
FirstMap = Annotated[
    Path,
    typer.Argument(
        metavar="MAP", parser=given_paths.saved_map, help="the map whose world it will be"
    ),
]
SecondMap = Annotated[
    Path,
    typer.Argument(metavar="MAP", parser=given_paths.saved_map, help="the map to lay onto it"),
]

# --------------------------------------------------------------------------------------------
# compare

Runs = Annotated[
    list[Path],
    typer.Argument(
        metavar="RUN...",
        parser=given_paths.run_folder_or_experiment,
        help="run folders; with --trials one run or experiment",
    ),
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
        metavar="A.B=VALUE",
        help="override one key of one estimator, estimators.NAME.KEY; with --trials also any key "
        "of the experiment, e.g. dataset.stop; may be repeated",
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
