"""`fgslam calibrate`, cameras from images of a board or of rings; `fgslam camera`, their files."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fgslam.cli.options import command
from fgslam.core.errors import ConfigError
from fgslam.core.files import require_output

if TYPE_CHECKING:
    from fgslam.cameras.boards import Board
    from fgslam.cameras.lenses import Calibration

calibrate_app = typer.Typer(
    help="Calibrate cameras from images of a board, a mirror from one of rings.",
    no_args_is_help=True,
)
camera_app = typer.Typer(help="Calibration files: what one states, and the same in another format.")


@dataclass(frozen=True)
class BoardOptions:
    """The board that is seen.

    Attributes:
        board (--board COLUMNSxROWS): inner corners of a chessboard, squares of a ChArUco board,
            tags of an AprilGrid
        square (--square M): side of a square, or of a tag, metres
        target: chessboard, charuco or aprilgrid (tags 36h11)
        spacing: of an AprilGrid: gap between tags over a tag's side
        dictionary: of a ChArUco board: OpenCV's name of its markers
    """

    board: str
    square: float
    target: str = "chessboard"
    spacing: float = 0.3
    dictionary: str = "DICT_4X4_50"

    def known(self) -> Board:
        """The board. Raises ConfigError."""
        from fgslam.cameras.boards import Board

        counted = re.fullmatch(r"(\d{1,3})x(\d{1,3})", self.board)
        if counted is None:
            raise ConfigError(f"--board {self.board}: give columns and rows as 9x6")
        columns, rows = int(counted[1]), int(counted[2])
        return Board(self.target, columns, rows, self.square, self.spacing, self.dictionary)


@command(calibrate_app)
def stereo(
    images: list[Path],
    board: BoardOptions,
    lens: str = "radtan",
    out: Path = Path("rig.json"),
    overwrite: bool = False,
) -> None:
    """Calibrate two cameras: intrinsics, pose to each other, and whether that is good enough.

    Left and right images of one moment have the same name but for the side.

    Args:
        images (IMAGES...): folder of both cameras, or two: left right
        lens: radtan (perspective) or equidistant (fisheye)
        out (FILE): where to write it, .json, for --camera
        overwrite: replace an earlier one
        board: that is seen
    """
    if len(images) > 2:
        raise ConfigError(
            f"{len(images)} folders or files were given; give the folder of all images, or that of "
            "the left and that of the right ones"
        )
    _calibrate(images, board, lens, out, overwrite)


@command(calibrate_app)
def trinocular(
    left: Path,
    right: Path,
    top: Path,
    board: BoardOptions,
    lens: str = "radtan",
    out: Path = Path("rig.json"),
    overwrite: bool = False,
) -> None:
    """Calibrate three cameras, in an L or a line; images of one moment in the same order.

    Args:
        left (LEFT): folder of the left images
        right (RIGHT): folder of the right images
        top (TOP): folder of the third camera's images
        lens: radtan (perspective) or equidistant (fisheye)
        out (FILE): where to write it, .json, for --camera
        overwrite: replace an earlier one
        board: that is seen
    """
    _calibrate([left, right, top], board, lens, out, overwrite)


def _calibrate(
    folders: list[Path], board: BoardOptions, lens: str, out: Path, overwrite: bool
) -> None:
    from fgslam.cli.console import progress_bar
    from fgslam.runs.calibrating import calibrate_cameras

    known = board.known()
    _require_outputs(out, overwrite, folders)
    with progress_bar() as progress:
        lines = calibrate_cameras(folders, known, lens, out, progress)
    _show(lines)


@command(calibrate_app)
def omni(
    images: Path,
    board: BoardOptions,
    lens: str = "omni",
    mount: str = "mirror",
    out: Path = Path("camera.yaml"),
    overwrite: bool = False,
) -> None:
    """Calibrate one fisheye, or a camera below a mirror, from images of a board.

    Args:
        images (IMAGES): folder of the board's images
        lens: omni (unified model of mirrors and fisheyes, Mei) or equidistant
        mount: mirror (above the camera), or up or down, where a fisheye points
        out (FILE): where to write it, .yaml, for --camera; numbers in *_lens.json
        overwrite: replace an earlier one
        board: that is seen
    """
    from fgslam.cli.console import progress_bar
    from fgslam.runs import calibrating

    known = board.known()
    require_output(out, overwrite, [images])
    _require_outputs(calibrating.numbers_beside(out), overwrite, [images])
    with progress_bar() as progress:
        lines = calibrating.calibrate_wide_camera(images, known, lens, mount, out, progress)
    _show(lines)


@command(calibrate_app)
def rings(
    image: Path,
    elevations: str,
    inner: float,
    out: Path = Path("mirror.yaml"),
    overwrite: bool = False,
) -> None:
    """Calibrate a mirror from one image of an upright cylinder with black and white bands.

    Args:
        image (IMAGE): rings around the camera in its mirror
        elevations (--elevations DEG,DEG,...): of the rings' borders, the innermost first
        inner (--inner PX): radius that all rings lie outside of
        out (FILE): where to write it, .yaml
        overwrite: replace an earlier one
    """
    from fgslam.runs.calibrating import calibrate_mirror

    try:
        degrees = [float(number) for number in elevations.split(",")]
    except ValueError:
        raise ConfigError(
            f"--elevations {elevations}: give degrees as --elevations=-15,-5,5,15"
        ) from None
    require_output(out, overwrite, [image])
    _show(calibrate_mirror(image, degrees, inner, out))


def _require_outputs(numbers: Path, overwrite: bool, images: Iterable[Path]) -> None:
    """The gate of a calibration's numbers, picture and tables. Raises OutputError."""
    tables = [numbers.with_name(f"{numbers.stem}_{part}.csv") for part in ("images", "parameters")]
    for path in (numbers, numbers.with_suffix(".png"), *tables):
        require_output(path, overwrite, images)


def _show(lines: Iterable[str]) -> None:
    for line in lines:
        typer.echo(line)


# --------------------------------------------------------------------------------------------
# Calibration files


@dataclass(frozen=True)
class FileOptions:
    """How a calibration file is read.

    Attributes:
        second (FILE): the second of two files: the right camera's, extrinsics
        size (WxH): size of the images, where the file has none
        scale: the images were resized: scale the calibration to --size
        unit (METRES): one unit of the file's lengths, 0.001: millimetres
        fov (DEGREES): horizontal angle of the rectified view
        cameras (N,N): which of the file's cameras, as 0,1
    """

    second: Path | None = None
    size: str | None = None
    scale: bool = False
    unit: float = 1.0
    fov: float | None = None
    cameras: str | None = None

    def read(self, file: Path, outputs: Iterable[Path], overwrite: bool) -> Calibration:
        """The calibration of a file. Raises OutputError where an output is in the way."""
        from fgslam.runs.calibrating import read_calibration

        for path in outputs:
            require_output(path, overwrite, [file, *([] if self.second is None else [self.second])])
        return read_calibration(file, **vars(self))


@command(camera_app)
def show(file: Path, given: FileOptions, out: Path | None = None, overwrite: bool = False) -> None:
    """Report what a calibration file states: cameras, fields of view, baselines, rectified view.

    Args:
        file (FILE): calibration file, or the folder that holds one
        out (FILE.png): the picture; default none
        overwrite: replace an earlier one
        given: how the file is read
    """
    from fgslam.runs.calibrating import show_calibration

    found = given.read(file, [] if out is None else [out], overwrite)
    _show(show_calibration(found, out, given.fov))


@command(camera_app)
def convert(
    file: Path,
    out: Annotated[Path, typer.Argument()],
    given: FileOptions,
    form: str | None = None,
    overwrite: bool = False,
) -> None:
    """Write a calibration in another tool's format, number by number.

    Args:
        file (FILE): calibration file, or the folder that holds one
        out (OUT): .json is fgslam's, .yml or .xml OpenCV's, .yaml Kalibr's, no ending a folder with
            left.yaml and right.yaml of ROS
        form (--format NAME): the format, if not that of OUT's ending: fgslam, opencv, kalibr, ros
        overwrite: replace an earlier one
        given: how the file is read
    """
    from fgslam.runs.calibrating import convert_calibration

    # Of a folder, which may hold a recording, the files that it gets.
    parts = [*out.glob("*.yaml"), *out.glob("*/sensor.yaml")] if out.is_dir() else [out]
    _show(convert_calibration(given.read(file, parts, overwrite), out, form, given.fov))
