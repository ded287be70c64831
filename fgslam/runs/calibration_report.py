"""What a calibration from images of a board says: lines, tables, picture."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from fgslam.cameras.boards import Board
from fgslam.cameras.calibrate import (
    DEPTH_SHARE,
    INTRINSICS,
    NAMES,
    PARAMETERS,
    BoardCalibration,
    HeldOut,
    HeldOutAlone,
    View,
    coverage,
    coverage_of_circle,
    farthest_from_axis,
)
from fgslam.core.arrays import FloatArray
from fgslam.report.content import write_csv
from fgslam.report.pictures.board import draw_corners

Files = Sequence[tuple[Path, ...]]
"""Images of each moment, in the cameras' order."""

_OFF_PX = 0.5  # stereo matching takes rows that agree to 1.5; half a pixel leaves it room
_SQUARE = 0.01  # of the square's side: what a tape measure is good for
_COVERAGE = 0.5
_VIEWS = 10
_TURNS = ("turn_x", "turn_y", "turn_z", "x", "y", "z")
_MORE_IMAGES = "take more images: tilted, near and far, in each corner, with a sharp and flat board"


def names_of(cameras: int) -> tuple[str, ...]:
    """Names of the cameras of a calibration; of a single one `camera`."""
    return NAMES[:cameras] if cameras > 1 else ("camera",)


def fit_lines(files: Files, views: Sequence[View], found: BoardCalibration) -> Iterator[str]:
    """Corners used, all parameters with standard deviations, and the worst image."""
    total = sum(len(corners) for view in views for corners in view if corners is not None)
    names = names_of(len(found.cameras))
    yield (
        f"corners     {total - found.left_out} used, {found.left_out} left out that do not fit, "
        f"rms {found.rms:.3f} px"
    )
    for k, camera in enumerate(found.cameras):
        seen = sum(view[k] is not None for view in views)
        covered = coverage(found.kept, k, camera.size)
        sigmas, at = found.sigmas[k], len(INTRINSICS)
        yield (
            f"{names[k]:11} {seen} of {len(views)} images, {covered:.0%} of the image; "
            f"{_with_sigmas(INTRINSICS, camera.intrinsics, sigmas[:at], 2)} px"
        )
        own = _with_sigmas(PARAMETERS[camera.model], camera.distortion, sigmas[at:], 5)
        yield f"            {camera.model}: {own}"
    for k in range(1, len(found.cameras)):
        length = float(np.linalg.norm(found.cameras[k].bTc[:3, 3]))
        turn, shift = found.turn_sigmas[k, :3], found.turn_sigmas[k, 3:]
        yield (
            f"{names[0]}-{names[k]:6} {1e3 * length:.2f} +- {1e3 * shift.max():.2f} mm apart, "
            f"turned to +- {np.degrees(turn.max()):.3f} deg"
        )
    worst = np.unravel_index(int(np.nanargmax(found.errors)), found.errors.shape)
    name = files[int(worst[0])][int(worst[1])].name
    yield f"worst       {name}: {found.errors[worst]:.2f} px"


def _with_sigmas(names: Sequence[str], values: FloatArray, sigmas: FloatArray, digits: int) -> str:
    return ", ".join(
        f"{name} {value:.{digits}f} +- {sigma:.{digits}f}"
        for name, value, sigma in zip(names, values, sigmas, strict=True)
    )


# --------------------------------------------------------------------------------------------
# How good it is


def rig_verdict(
    board: Board,
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
        if held.rows_px > _OFF_PX:
            faults.append(f"rows agree to {held.rows_px:.2f} px only")
        if abs(off) > _SQUARE:
            faults.append(f"squares come out {off:+.1%}")
    least = min(coverage(found.kept, k, camera.size) for k, camera in enumerate(found.cameras))
    if least < _COVERAGE:
        faults.append(f"a camera shows the board in {least:.0%} of its image only")
    both = sum(all(corners is not None for corners in view) for view in found.kept)
    if both < _VIEWS:
        faults.append(f"only {both} moments show it to all cameras")
    yield _verdict(faults, None not in checked)


def wide_verdict(files: Files, found: BoardCalibration, held: HeldOutAlone | None) -> Iterator[str]:
    """How a single camera does on images that it was not calibrated with, and what to mend."""
    camera, faults = found.cameras[0], []
    angle, covered = farthest_from_axis(found.kept, camera), coverage_of_circle(found.kept, camera)
    across, down, _ = np.degrees(camera.field_of_view())
    yield (
        f"view        {across:.0f} x {down:.0f} degrees; corners up to {np.degrees(angle):.0f} "
        f"degrees from the axis, in {covered:.0%} of the widest circle in the image"
    )
    if held is None:
        yield "held out    not known: half of the images are not enough to calibrate with"
    else:
        worst = int(np.argmax(held.each_px))
        direction = np.degrees(held.off_px / camera.focal_px)
        yield (
            f"held out    {len(held.views)} images: corners to {held.off_px:.2f} px, directions to "
            f"{direction:.3f} deg; worst {files[held.views[worst]][0].name}: "
            f"{held.each_px[worst]:.2f} px"
        )
        if held.off_px > _OFF_PX:
            faults.append(f"corners agree to {held.off_px:.2f} px only")
    if covered < _COVERAGE:
        faults.append(f"the board is seen in {covered:.0%} of the circle only")
    seen = sum(view[0] is not None for view in found.kept)
    if seen < _VIEWS:
        faults.append(f"only {seen} images show it")
    yield _verdict(faults, held is not None)


def _verdict(faults: Sequence[str], checked: bool) -> str:
    if faults or not checked:
        said = "; ".join(faults or ["not checked"])
        return f"verdict     doubtful: {said}; {_MORE_IMAGES}"
    return "verdict     good for mapping"


# --------------------------------------------------------------------------------------------
# Files beside the calibration


def write_tables(
    out: Path, files: Files, views: Sequence[View], found: BoardCalibration
) -> tuple[Path, Path]:
    """Writes a table of all images and one of all parameters; their paths.

    Of each image: its camera, the corners found, those left out, and the residual of the others.
    Of each parameter: its value and standard deviation. Turns and shifts take coordinates of the
    first camera to a camera's own, radians and metres.

    Raises:
        OutputError: a file cannot be written.
    """
    images = out.with_name(f"{out.stem}_images.csv")
    parameters = out.with_name(f"{out.stem}_parameters.csv")
    write_csv(
        images,
        ("image", "camera", "corners", "left_out", "rms_px"),
        _image_rows(files, views, found),
    )
    write_csv(parameters, ("camera", "parameter", "value", "sigma"), _parameter_rows(found))
    return images, parameters


def _image_rows(
    files: Files, views: Sequence[View], found: BoardCalibration
) -> Iterator[tuple[str, str, int, int, float]]:
    names = names_of(len(found.cameras))
    for v, view in enumerate(views):
        for c, corners in enumerate(view):
            count = 0 if corners is None else len(corners)
            used = len(found.off[v][c])
            rms = float(found.errors[v, c])
            yield files[v][c].name, names[c], count, count - used, rms


def _parameter_rows(found: BoardCalibration) -> Iterator[tuple[str, str, float, float]]:
    names = names_of(len(found.cameras))
    for k, camera in enumerate(found.cameras):
        own = np.concatenate([camera.intrinsics, camera.distortion])
        named = INTRINSICS + PARAMETERS[camera.model]
        for name, value, sigma in zip(named, own, found.sigmas[k], strict=True):
            yield names[k], name, float(value), float(sigma)
        if k:
            rows = zip(_TURNS, found.turn(k), found.turn_sigmas[k], strict=True)
            for name, value, sigma in rows:
                yield names[k], name, float(value), float(sigma)


def draw_coverage(out: Path, found: BoardCalibration) -> Path:
    """Draws where in the images the corners are that were used; the picture's path.

    Raises:
        OutputError: the file cannot be written.
    """
    picture = out.with_suffix(".png")
    corners = [
        np.concatenate([corners.pixels for view in found.kept if (corners := view[k]) is not None])
        for k in range(len(found.cameras))
    ]
    draw_corners(picture, found.cameras[0].size, corners, names_of(len(corners)))
    return picture
