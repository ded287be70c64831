"""Calibrates cameras from images of a board, mirrors from one of rings: `fgslam calibrate`."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from fgslam.cameras.assembly import assembled
from fgslam.cameras.board_calibration import MODELS, NAMES, BoardCalibration, View, calibrate
from fgslam.cameras.board_check import DEPTH_SHARE, HeldOut, coverage, held_out
from fgslam.cameras.boards import Board, find_corners, sizes_that_fit
from fgslam.cameras.formats.own import raw_values
from fgslam.cameras.omni.mirrors import MirrorFrame
from fgslam.cameras.omni.ring_calibration import calibrate_from_rings, find_mirror_circle
from fgslam.cameras.raw_cameras import Calibration
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError, ConfigError, DatasetError
from fgslam.core.files import write_text
from fgslam.datasets.images import bits_of, read_grey_image
from fgslam.datasets.loose_files import find_cameras, images_in, pair_files
from fgslam.report.pictures.board import draw_corners

_ROWS_PX = 0.5  # stereo matching takes rows that agree to 1.5; half a pixel leaves it room
_SQUARE = 0.01  # of the square's side: what a tape measure is good for
_COVERAGE = 0.5
_VIEWS = 10
_WITHIN_RIM = 0.98  # of a mirror's radius: its edge is a border of two bands, too
_SEED = 0  # of the search for a mirror's circle: the same image gives the same calibration

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class Calibrated:
    """What came out: the file, its picture and what to tell, a line each."""

    file: Path
    picture: Path
    lines: tuple[str, ...]


def calibrate_cameras(
    folders: Sequence[Path], board: Board, model: str, out: Path, progress: Progress
) -> Calibrated:
    """Writes the calibration of a rig and a picture of how its images are covered.

    Args:
        folders: one folder with the images of a pair, or one folder for each of two or three
            cameras, left, right, top.
        board: what the images show.
        model: of the lenses.
        out: the calibration, .json, for `--camera`.
        progress: called with what is done, how far, of how much.

    Raises:
        FgslamError: the images are not found or not paired, show no such board or too few, or a
            file cannot be written.
    """
    if out.suffix != ".json":
        raise ConfigError(f"{out}: a calibration is written as .json; give such a name")
    if model not in MODELS:
        raise ConfigError(f"lens {model!r} is not known; use {' or '.join(MODELS)}")
    files, notes = _files(folders)
    bits, held = bits_of([moment[0] for moment in files])
    views, size = _views(files, bits, board, progress)
    found = calibrate(board, views, size, model)
    checked = [held_out(board, views, size, model, k) for k in range(1, len(found.cameras))]
    calibration = Calibration(str(out), "fgslam calibrate", found.cameras, sided=True)
    remarks = assembled(calibration).remarks
    write_text(out, json.dumps(raw_values(calibration), indent=2) + "\n")
    picture = out.with_suffix(".png")
    draw_corners(picture, size, _shown(views, found), NAMES)
    lines = (
        *notes,
        *held,
        *_told(files, views, found),
        *_judged(board, views, found, checked),
        *remarks,
    )
    return Calibrated(out, picture, lines)


def _files(folders: Sequence[Path]) -> tuple[list[tuple[Path, ...]], tuple[str, ...]]:
    """Files of each moment, left, right[, top], and what was left out."""
    for folder in folders:
        if not folder.is_dir():
            what = "is a file" if folder.is_file() else "no such folder"
            raise DatasetError(f"{folder}: {what}; give the folder of the images")
    if len(folders) == 1:
        found = find_cameras(folders[0])
        if found is None:
            raise DatasetError(
                f"{folders[0]}: images of two cameras are not told apart there; name them left and "
                "right, or give a folder for each"
            )
        pairs, notes = pair_files(found, tolerance_ms=None)
        return [(left, right) for right, left in pairs], notes
    listed = [images_in(folder) for folder in folders]
    counts = [len(images) for images in listed]
    if len(set(counts)) > 1 or not counts[0]:
        named = ", ".join(f"{folder}: {n}" for folder, n in zip(folders, counts, strict=True))
        raise DatasetError(
            f"the cameras have different numbers of images ({named}); each needs the image of the "
            "same moment at the same place of its folder"
        )
    return list(zip(*listed, strict=True)), ()


def _views(
    files: Sequence[tuple[Path, ...]], bits: int, board: Board, progress: Progress
) -> tuple[list[View], tuple[int, int]]:
    """What the cameras see of the board at each moment, and the size of all images."""
    views, sizes = [], set()
    for done, moment in enumerate(files):
        progress("board", done, len(files))
        images = [read_grey_image(path, bits) for path in moment]
        sizes |= {(image.shape[1], image.shape[0]) for image in images}
        if len(sizes) > 1:
            raise DatasetError(
                f"{moment[0]}: its images, or those before, differ in size ({sorted(sizes)}); "
                "calibrate cameras of one resolution"
            )
        views.append(tuple(find_corners(board, image) for image in images))
    progress("board", len(files), len(files))
    if not any(corners for view in views for corners in view):
        raise CalibrationError(_no_board(files, bits, board))
    return views, sizes.pop()


def _no_board(files: Sequence[tuple[Path, ...]], bits: int, board: Board) -> str:
    size = f"{board.columns}x{board.rows}"
    others = sizes_that_fit(board, read_grey_image(files[0][0], bits))
    meant = f"; {files[0][0].name} shows {', '.join(others)}" if others else ""
    counted = {
        "chessboard": "inner corners are counted, not squares",
        "charuco": "squares are counted; is --dictionary that of the print",
        "aprilgrid": "tags are counted, of the family 36h11",
    }
    return (
        f"no image of {len(files)} moments shows a {board.kind} of {size}{meant}; correct --board "
        f"({counted[board.kind]})"
    )


# --------------------------------------------------------------------------------------------
# What is told


def _told(
    files: Sequence[tuple[Path, ...]], views: Sequence[View], found: BoardCalibration
) -> Iterator[str]:
    total = sum(len(corners) for view in views for corners in view if corners is not None)
    yield (
        f"corners     {total - found.left_out} used, {found.left_out} left out that do not fit, "
        f"rms {found.rms:.3f} px"
    )
    for k, camera in enumerate(found.cameras):
        seen = sum(view[k] is not None for view in views)
        covered = coverage(views, k, camera.size)
        matrix, sigma = camera.matrix, found.sigmas[k]
        yield (
            f"{NAMES[k]:11} {seen} of {len(views)} images, {covered:.0%} of the image; "
            f"f {matrix[0, 0]:.2f} {matrix[1, 1]:.2f} +- {sigma[:2].max():.2f} px, "
            f"centre {matrix[0, 2]:.2f} {matrix[1, 2]:.2f} +- {sigma[2:4].max():.2f} px"
        )
    for k in range(1, len(found.cameras)):
        length = float(np.linalg.norm(found.cameras[k].bTc[:3, 3]))
        turn, shift = found.turn_sigmas[k, :3], found.turn_sigmas[k, 3:]
        yield (
            f"{NAMES[0]}-{NAMES[k]:6} {1e3 * length:.2f} +- {1e3 * shift.max():.2f} mm apart, "
            f"turned to +- {np.degrees(turn.max()):.3f} deg"
        )
    worst = np.unravel_index(int(np.nanargmax(found.errors)), found.errors.shape)
    name = files[int(worst[0])][int(worst[1])].name
    yield f"worst       {name}: {found.errors[worst]:.2f} px"


def _judged(
    board: Board,
    views: Sequence[View],
    found: BoardCalibration,
    checked: Sequence[HeldOut | None],
) -> Iterator[str]:
    """How the rig does on images that it was not calibrated with, and what to mend."""
    faults = []
    for k, held in enumerate(checked, start=1):
        if held is None:
            yield "held out    not known: half of the images are not enough to calibrate with"
            continue
        off = held.square / board.square - 1.0
        yield (
            f"held out    {NAMES[0]}-{NAMES[k]}, {held.views} images: rows agree to "
            f"{held.rows_px:.2f} px, squares of {1e3 * held.square:.2f} mm ({off:+.1%}); depth to "
            f"{DEPTH_SHARE:.0%} up to {held.reach_m:.1f} m"
        )
        if held.rows_px > _ROWS_PX:
            faults.append(f"rows agree to {held.rows_px:.2f} px only")
        if abs(off) > _SQUARE:
            faults.append(f"squares come out {off:+.1%}")
    least = min(coverage(views, k, camera.size) for k, camera in enumerate(found.cameras))
    if least < _COVERAGE:
        faults.append(f"a camera shows the board in {least:.0%} of its image only")
    both = sum(all(corners is not None for corners in view) for view in views)
    if both < _VIEWS:
        faults.append(f"only {both} moments show it to all cameras")
    if faults or None in checked:
        mend = "take more images: tilted, near and far, in each corner, with a sharp and flat board"
        yield f"verdict     doubtful: {'; '.join(faults or ['not checked'])}; {mend}"
    else:
        yield "verdict     good for mapping"


def _shown(views: Sequence[View], found: BoardCalibration) -> list[FloatArray]:
    """Of each camera (n, 2) pixels of all corners."""
    return [
        np.concatenate([corners.pixels for view in views if (corners := view[k]) is not None])
        for k in range(len(found.cameras))
    ]


# --------------------------------------------------------------------------------------------
# Mirrors


def calibrate_mirror(
    image: Path, elevations_deg: Sequence[float], inner_px: float, out: Path
) -> list[str]:
    """Writes a mirror's calibration from one image of rings; lines about it.

    The mirror's circle gives its centre and outer radius.

    Args:
        image: of an upright cylinder around the camera with black and white bands.
        elevations_deg: of the bands' borders as the mirror sees them, the innermost first.
        inner_px: radius that all rings lie outside of.
        out: the camera file, .yaml.

    Raises:
        FgslamError: the image cannot be read, shows no mirror or not these rings, or the file
            cannot be written.
    """
    if out.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"{out}: a mirror's calibration is written as .yaml; give such a name")
    picture = read_grey_image(image, bits_of([image])[0])
    circle = find_mirror_circle(picture, np.random.default_rng(_SEED))
    frame = MirrorFrame(picture.shape[1], picture.shape[0], circle.centre)
    radii = (inner_px, _WITHIN_RIM * circle.radius)
    found = calibrate_from_rings(picture, np.radians(elevations_deg), frame, radii)
    settings = {
        "kind": "radial_polynomial",
        "size": [frame.width, frame.height],
        "centre": [float(number) for number in frame.centre],
        "ring_px": [float(number) for number in radii],
        "coefficients_deg": np.degrees(found.fit.camera.coefficients).tolist(),
    }
    write_text(out, yaml.safe_dump(settings, sort_keys=False))
    rings = ", ".join(f"{radius:.1f}" for radius in found.radii)
    return [
        f"mirror      centre {circle.centre[0]:.1f} {circle.centre[1]:.1f} px, radius "
        f"{circle.radius:.1f} px, its edge found in {circle.support:.0%} of the directions",
        f"rings       radii {rings} px, found in {found.directions:.0%} of the directions",
        f"fit         worst ring off by {np.degrees(found.fit.worst):.2f} deg",
        f"calibration {out}",
    ]
