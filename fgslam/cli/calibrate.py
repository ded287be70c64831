"""`fgslam calibrate`, cameras from images of a board or of rings; `fgslam camera`, their files."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fgslam.cli import options
from fgslam.core.errors import ConfigError
from fgslam.core.files import require_output

if TYPE_CHECKING:
    from fgslam.cameras.boards import Board as CalibrationBoard

calibrate_app = typer.Typer(
    help="Calibrate cameras from images of a board, a mirror from one of rings.",
    no_args_is_help=True,
)

Board = Annotated[
    str,
    typer.Option(
        metavar="COLUMNSxROWS",
        help="inner corners of a chessboard, squares of a ChArUco board, tags of an AprilGrid",
    ),
]
Square = Annotated[float, typer.Option(metavar="M", help="side of a square, or of a tag, metres")]
Target = Annotated[str, typer.Option(help="chessboard, charuco or aprilgrid (tags 36h11)")]
Spacing = Annotated[float, typer.Option(help="of an AprilGrid: gap between tags over a tag's side")]
Dictionary = Annotated[str, typer.Option(help="of a ChArUco board: OpenCV's name of its markers")]
Lens = Annotated[str, typer.Option(help="radtan (perspective) or equidistant (fisheye)")]
WideLens = Annotated[
    str, typer.Option(help="omni (unified model of mirrors and fisheyes, Mei) or equidistant")
]
Mount = Annotated[
    str, typer.Option(help="mirror (above the camera), or up or down, where a fisheye looks")
]
CameraOut = Annotated[
    Path,
    typer.Option(
        metavar="FILE", help="where to write it, .yaml, for --camera; numbers in *_lens.json"
    ),
]
Out = Annotated[Path, typer.Option(metavar="FILE", help="where to write it, .json, for --camera")]
MirrorOut = Annotated[Path, typer.Option(metavar="FILE", help="where to write it, .yaml")]


@calibrate_app.command()
def stereo(  # noqa: PLR0913 - each option is a parameter
    images: Annotated[
        list[Path],
        typer.Argument(metavar="IMAGES...", help="folder of both cameras, or two: left right"),
    ],
    board: Board,
    square: Square,
    target: Target = "chessboard",
    spacing: Spacing = 0.3,
    dictionary: Dictionary = "DICT_4X4_50",
    lens: Lens = "radtan",
    out: Out = Path("rig.json"),
    overwrite: options.Overwrite = False,
) -> None:
    """Calibrate two cameras: intrinsics, pose to each other, and whether that is good enough.

    Left and right images of one moment have the same name but for the side.
    """
    if len(images) > 2:
        raise ConfigError(
            f"{len(images)} folders or files were given; give the folder of all images, or that of "
            "the left and that of the right ones"
        )
    _calibrate(images, (target, board, square, spacing, dictionary), lens, out, overwrite)


@calibrate_app.command()
def trinocular(  # noqa: PLR0913 - each option is a parameter
    left: Annotated[Path, typer.Argument(metavar="LEFT", help="folder of the left images")],
    right: Annotated[Path, typer.Argument(metavar="RIGHT", help="folder of the right images")],
    top: Annotated[Path, typer.Argument(metavar="TOP", help="folder of the third camera's images")],
    board: Board,
    square: Square,
    target: Target = "chessboard",
    spacing: Spacing = 0.3,
    dictionary: Dictionary = "DICT_4X4_50",
    lens: Lens = "radtan",
    out: Out = Path("rig.json"),
    overwrite: options.Overwrite = False,
) -> None:
    """Calibrate three cameras, in an L or a line; images of one moment in the same order."""
    _calibrate(
        [left, right, top], (target, board, square, spacing, dictionary), lens, out, overwrite
    )


@calibrate_app.command()
def omni(  # noqa: PLR0913 - each option is a parameter
    images: Annotated[Path, typer.Argument(metavar="IMAGES", help="folder of the board's images")],
    board: Board,
    square: Square,
    target: Target = "chessboard",
    spacing: Spacing = 0.3,
    dictionary: Dictionary = "DICT_4X4_50",
    lens: WideLens = "omni",
    mount: Mount = "mirror",
    out: CameraOut = Path("camera.yaml"),
    overwrite: options.Overwrite = False,
) -> None:
    """Calibrate one fisheye, or a camera below a mirror, from images of a board."""
    from fgslam.cli.console import progress_bar
    from fgslam.runs import calibrating

    known = _board(target, board, square, spacing, dictionary)
    require_output(out, overwrite, [images])
    _require_outputs(calibrating.numbers_beside(out), overwrite, [images])
    with progress_bar() as progress:
        lines = calibrating.calibrate_wide_camera(images, known, lens, mount, out, progress)
    _show(lines)


@calibrate_app.command()
def rings(
    image: Annotated[
        Path, typer.Argument(metavar="IMAGE", help="rings around the camera in its mirror")
    ],
    elevations: Annotated[
        str,
        typer.Option(metavar="DEG,DEG,...", help="of the rings' borders, the innermost first"),
    ],
    inner: Annotated[
        float, typer.Option(metavar="PX", help="radius that all rings lie outside of")
    ],
    out: MirrorOut = Path("mirror.yaml"),
    overwrite: options.Overwrite = False,
) -> None:
    """Calibrate a mirror from one image of an upright cylinder with black and white bands."""
    from fgslam.runs.calibrating import calibrate_mirror

    try:
        degrees = [float(number) for number in elevations.split(",")]
    except ValueError:
        raise ConfigError(
            f"--elevations {elevations}: give degrees as --elevations=-15,-5,5,15"
        ) from None
    require_output(out, overwrite, [image])
    _show(calibrate_mirror(image, degrees, inner, out))


def _calibrate(
    folders: list[Path],
    board: tuple[str, str, float, float, str],
    lens: str,
    out: Path,
    overwrite: bool,
) -> None:
    from fgslam.cli.console import progress_bar
    from fgslam.runs.calibrating import calibrate_cameras

    known = _board(*board)
    _require_outputs(out, overwrite, folders)
    with progress_bar() as progress:
        lines = calibrate_cameras(folders, known, lens, out, progress)
    _show(lines)


def _require_outputs(numbers: Path, overwrite: bool, images: Sequence[Path]) -> None:
    """The gate of a calibration's numbers, picture and tables. Raises OutputError."""
    tables = [numbers.with_name(f"{numbers.stem}_{part}.csv") for part in ("images", "parameters")]
    for path in (numbers, numbers.with_suffix(".png"), *tables):
        require_output(path, overwrite, images)


def _board(
    kind: str, size: str, square: float, spacing: float, dictionary: str
) -> CalibrationBoard:
    from fgslam.cameras.boards import Board as KnownBoard

    counted = re.fullmatch(r"(\d{1,3})x(\d{1,3})", size)
    if counted is None:
        raise ConfigError(f"--board {size}: give columns and rows as 9x6")
    return KnownBoard(kind, int(counted[1]), int(counted[2]), square, spacing, dictionary)


def _show(lines: Sequence[str]) -> None:
    for line in lines:
        typer.echo(line)


# --------------------------------------------------------------------------------------------
# Calibration files

camera = typer.Typer(help="Calibration files: what one says, and the same in another format.")

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


@camera.command()
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
    from fgslam.runs.calibrating import Asked, show_calibration

    asked = Asked(file, second, size, scale, unit, fov, cameras)
    if out is not None:
        require_output(out, overwrite, [file, *([] if second is None else [second])])
    _show(show_calibration(asked, out))


@camera.command()
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
    from fgslam.runs.calibrating import Asked, convert_calibration

    asked = Asked(file, second, size, scale, unit, fov, cameras)
    # Of a folder, which may hold a recording, the files that it gets.
    parts = [*out.glob("*.yaml"), *out.glob("*/sensor.yaml")] if out.is_dir() else [out]
    for path in parts:
        require_output(path, overwrite, [file, *([] if second is None else [second])])
    _show(convert_calibration(asked, out, form))
