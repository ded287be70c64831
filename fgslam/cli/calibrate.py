"""`fgslam calibrate`: cameras from images of a board, mirrors from one of rings."""

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
    from fgslam.runs.calibrating import Calibrated

app = typer.Typer(
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


def _refuse_rings(given: str | None) -> None:
    """Options that `omni` had while it was the command for mirrors and rings."""
    if given is not None:
        raise ConfigError(
            "calibrate omni is of images of a board; a mirror from an image of rings (--elevations "
            "and --inner) is now `fgslam calibrate rings`"
        )


OfRings = Annotated[
    str | None, typer.Option(hidden=True, is_eager=True, callback=_refuse_rings, help="of rings")
]
Out = Annotated[Path, typer.Option(metavar="FILE", help="where to write it, .json, for --camera")]
MirrorOut = Annotated[Path, typer.Option(metavar="FILE", help="where to write it, .yaml")]


@app.command()
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


@app.command()
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


@app.command()
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
    elevations: OfRings = None,
    inner: OfRings = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Calibrate one fisheye, or a camera below a mirror, from images of a board."""
    from fgslam.cli.console import progress_bar
    from fgslam.runs import calibrating

    known = _board(target, board, square, spacing, dictionary)
    wide = calibrating.WideLens(lens, mount)
    del elevations, inner  # refused before
    require_output(out, overwrite, [images])
    _require_outputs(calibrating.numbers_beside(out), overwrite, [images])
    with progress_bar() as progress:
        found = calibrating.calibrate_wide_camera(images, known, wide, out, progress)
    _tell(found)


@app.command()
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
    for line in calibrate_mirror(image, degrees, inner, out):
        typer.echo(line)


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
        found = calibrate_cameras(folders, known, lens, out, progress)
    _tell(found)


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


def _tell(found: Calibrated) -> None:
    for line in found.lines:
        typer.echo(line)
    typer.echo(f"calibration {found.file}, with {', '.join(str(path) for path in found.others)}")
