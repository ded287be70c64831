"""The command `fgslam film`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fgslam.cli import options


def film(
    run_folder: options.RunToView,
    out: Annotated[Path, typer.Argument(metavar="FILE", help="the film, .mp4 or .gif")],
    estimator: Annotated[
        str | None, typer.Option(help="whose path and map; default the one that steered")
    ] = None,
    taught: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="of a route that was followed: the run folder of fgslam teach (its --report), for "
            "the pictures of path images",
        ),
    ] = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Make a film of a run: images with their matches, next to the map as it grows.

    Of what fgslam follow wrote: images with the path image, its probability, the way home as an
    arrow, and the command or why there is none.
    """
    from fgslam.cli.console import progress_bar
    from fgslam.runs.film import film_of_run

    with progress_bar() as progress:
        line = film_of_run(run_folder, out, estimator, taught, progress, overwrite)
    typer.echo(line)
