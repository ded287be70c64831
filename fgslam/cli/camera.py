"""Commands about calibration files: what one says, and the same in another format."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fgslam.cli import options
from fgslam.core.files import require_output

app = typer.Typer(help="Calibration files: what one says, and the same in another format.")

_FILE = "calibration file, or the folder that holds one"
File = Annotated[Path, typer.Argument(metavar="FILE", help=_FILE)]
Second = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="the second of two files: the right camera's, extrinsics"),
]
Size = Annotated[
    str | None, typer.Option(metavar="WxH", help="size of the images, where the file has none")
]
Scale = Annotated[
    bool, typer.Option("--scale", help="the images were resized: scale the calibration to --size")
]
Unit = Annotated[
    float, typer.Option(metavar="METRES", help="one unit of the file's lengths, 0.001: millimetres")
]
Fov = Annotated[
    float | None, typer.Option(metavar="DEGREES", help="horizontal angle of the rectified view")
]
Cameras = Annotated[
    str | None, typer.Option(metavar="N,N", help="which of the file's cameras, as 0,1")
]


@app.command()
def show(  # noqa: PLR0913 - each option is a parameter
    file: File,
    second: Second = None,
    size: Size = None,
    scale: Scale = False,
    unit: Unit = 1.0,
    fov: Fov = None,
    cameras: Cameras = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="the picture; default none")
    ] = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Say what a calibration file says: cameras, fields of view, baselines, rectified view."""
    from fgslam.runs.camera_files import Asked, show_calibration

    asked = Asked(file, second, size, scale, unit, fov, cameras)
    if out is not None:
        require_output(out, overwrite, [file, *([] if second is None else [second])])
    for line in show_calibration(asked, out):
        typer.echo(line)


@app.command()
def convert(  # noqa: PLR0913 - each option is a parameter
    file: File,
    out: Annotated[
        Path,
        typer.Argument(
            metavar="OUT",
            help=".json is fgslam's, .yml or .xml OpenCV's, .yaml Kalibr's, no ending a folder "
            "with left.yaml and right.yaml of ROS",
        ),
    ],
    form: Annotated[
        str | None,
        typer.Option(
            "--format",
            metavar="NAME",
            help="the format, if not that of OUT's ending: fgslam, opencv, kalibr, ros",
        ),
    ] = None,
    second: Second = None,
    size: Size = None,
    scale: Scale = False,
    unit: Unit = 1.0,
    fov: Fov = None,
    cameras: Cameras = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Write a calibration in another tool's format, number by number."""
    from fgslam.runs.camera_files import Asked, convert_calibration

    asked = Asked(file, second, size, scale, unit, fov, cameras)
    # Of a folder, which may hold a recording, the files that it gets.
    parts = [*out.glob("*.yaml"), *out.glob("*/sensor.yaml")] if out.is_dir() else [out]
    for path in parts:
        require_output(path, overwrite, [file, *([] if second is None else [second])])
    for line in convert_calibration(asked, out, form):
        typer.echo(line)
