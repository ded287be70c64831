"""Commands of routes: teach one from a recording, follow it with another, join several."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fgslam.cli import options
from fgslam.cli.performing import existing_folder, exit_as, show_all, under_way

if TYPE_CHECKING:
    from fgslam.runs.config_models import Experiment

Recording = Annotated[
    Path,
    typer.Argument(
        metavar="RECORDING",
        help="a film, or a folder of pictures, of an omnidirectional camera",
    ),
]
OmniCamera = Annotated[
    str | None,
    typer.Option(
        "--camera",
        metavar="FILE",
        help="calibration of its camera: OCamCalib, BloggieUnwarp, YAML; or `equirectangular` "
        "for whole panoramas",
    ),
]
Report = Annotated[
    Path | None, typer.Option(metavar="DIR", help="the run folder itself; default runs/NAME")
]


def teach(  # noqa: PLR0913 - each option is a parameter
    recording: Recording,
    out: Annotated[Path, typer.Option(metavar="ROUTE", help="the file to write, .fgpath")],
    camera: OmniCamera = None,
    poses: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="RUN/ESTIMATOR/final.tum of stereo SLAM on this drive: metres"
        ),
    ] = None,
    report: Report = None,
    start: options.Start = None,
    stop: options.Stop = None,
    stride: options.Stride = None,
    overrides: options.Overrides = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Choose the path images of a drive, and write what is to be remembered of them.

    Few images are chosen, each seen well from the one before; a table and the page say why each.
    """
    from fgslam.runs.bare_routes import teaching

    chosen = options.of_recording(start=start, stop=stop, stride=stride)
    chosen += options.as_overrides({"poses": poses})
    config = teaching(recording, camera, out, [*(overrides or ()), *chosen])
    _perform(config, report, overwrite)


def follow(  # noqa: PLR0913 - each option is a parameter
    route: Annotated[
        Path, typer.Argument(metavar="ROUTE", help="a route, as fgslam teach writes it")
    ],
    recording: Recording,
    camera: OmniCamera = None,
    out: Report = None,
    start: options.Start = None,
    stop: options.Stop = None,
    stride: options.Stride = None,
    overrides: options.Overrides = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Follow a route with another recording of the way: place, homing vector and command.

    What a robot would be commanded at each image, by the same follower; refusals with their reason.
    Exits with 1 where no image is recognised. Without --camera it is the route's own.
    """
    from fgslam.runs.bare_routes import following

    chosen = options.of_recording(start=start, stop=stop, stride=stride)
    config = following(route, recording, camera, [*(overrides or ()), *chosen])
    _perform(config, out, overwrite)


def join(
    routes: Annotated[
        list[Path], typer.Argument(metavar="ROUTE...", help="routes, as fgslam teach writes them")
    ],
    out: Annotated[Path, typer.Option(metavar="MAP", help="the file to write, .fgmap")],
    report: Report = None,
    overrides: options.Overrides = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Join routes where their views match: one map, with crossroads.

    A place is called after its route's file and its image: monday/12. Routes may have been taught
    on different days; where they have nothing in common they stay apart, and that is reported.
    """
    from fgslam.runs.bare_routes import joining

    config = joining(routes, out, overrides or ())
    _perform(config, report, overwrite)


def route(
    stored: Annotated[
        Path, typer.Argument(metavar="MAP", help="routes, as fgslam join writes them")
    ],
    start: Annotated[
        str,
        typer.Option(
            "--from", metavar="IMAGE", help="a picture from where the robot is, or a place's name"
        ),
    ],
    goal: Annotated[
        str, typer.Option("--to", metavar="PLACE", help="a place's name; of a route: its end")
    ],
    camera: OmniCamera = None,
    out: Annotated[
        Path | None, typer.Option(metavar="ROUTE", help="write the way as a route, to be followed")
    ] = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Say the shortest way on a map of routes, and write it as a route of its own.

    Without --camera the picture is of the routes' own. Exits with 2 where there is no way.
    """
    from fgslam.runs.bare_routes import way_said

    for line in way_said(stored, start, goal, camera, out, overwrite):
        typer.echo(line)


def _perform(config: Experiment, folder: Path | None, overwrite: bool) -> None:
    from fgslam.runs.run import require_outputs, run_experiment

    place, existing = folder or Path("runs") / config.name, existing_folder(overwrite)
    require_outputs(config, place, existing)
    with under_way() as (progress, stopped):
        result = run_experiment(config, place, existing, progress, stopped)
    show_all([result], "the same command with --overwrite")
    exit_as([result])
