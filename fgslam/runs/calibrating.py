"""`fgslam calibrate` and `fgslam camera`: calibrations from images, shown, and in other formats.

Cameras are calibrated from images of a board, mirrors from one of rings.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import yaml

from fgslam.cameras.boards import Board, Corners, find_corners, sizes_that_fit
from fgslam.cameras.calib_json import raw_values
from fgslam.cameras.calibrate import (
    DEPTH_SHARE,
    INTRINSICS,
    NAMES,
    PARAMETERS,
    BoardCalibration,
    HeldOut,
    HeldOutAlone,
    View,
    calibrate,
    coverage,
    coverage_of_circle,
    farthest_from_axis,
    held_out,
    held_out_alone,
)
from fgslam.cameras.formats import pose_difference
from fgslam.cameras.lenses import Calibration
from fgslam.cameras.omni import MirrorFrame
from fgslam.cameras.rig import (
    StereoRig,
    at_size,
    chosen_cameras,
    in_metres,
    read_calibration_file,
    require_options,
    rig_of,
)
from fgslam.cameras.rings import calibrate_from_rings, find_mirror_circle
from fgslam.cameras.write_formats import write_calibration
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import CalibrationError, ConfigError, DatasetError
from fgslam.core.files import write_text
from fgslam.core.sensors import CAMERA_NAMES
from fgslam.core.threads import one_blas_thread
from fgslam.datasets.images import bits_of, read_grey_image
from fgslam.datasets.layouts import find_cameras, images_in
from fgslam.datasets.times import pair_files
from fgslam.report.content import write_csv
from fgslam.runs.units import Progress

_WITHIN_RIM = 0.98  # of a mirror's radius: its edge is a border of two bands, too
_SEED = 0  # of the search for a mirror's circle: the same image gives the same calibration

RIG_MODELS = ("radtan", "equidistant")
WIDE_MODELS = ("omni", "equidistant")
MOUNTS = {
    "mirror": ("down", True, "a mirror above the camera, the image's middle looks down"),
    "up": ("up", True, "a fisheye that looks up"),
    "down": ("down", False, "a fisheye that looks down"),
}
"""How an omnidirectional camera may be mounted: where the image's middle looks, whether bearings
grow clockwise in it, and that in words."""

Files = Sequence[tuple[Path, ...]]
"""Images of each moment, in the cameras' order."""
Finder = Callable[[Image], Corners | None]

_OFF_PX = 0.5  # stereo matching takes rows that agree to 1.5; half a pixel leaves it room
_SQUARE = 0.01  # of the square's side: what a tape measure is good for
_COVERAGE = 0.5
_VIEWS = 10
_TURNS = ("turn_x", "turn_y", "turn_z", "x", "y", "z")
_MORE_IMAGES = "take more images: tilted, near and far, in each corner, with a sharp and flat board"


def numbers_beside(out: Path) -> Path:
    """Where the calibration is that the camera file ``out`` of one wide camera names."""
    return out.with_name(f"{out.stem}_lens.json")


def _require_model(model: str, known: Sequence[str]) -> None:
    if model not in known:
        raise ConfigError(f"lens {model!r} is not known; use {' or '.join(known)}")


@one_blas_thread()
def calibrate_cameras(
    folders: Sequence[Path], board: Board, model: str, out: Path, progress: Progress
) -> list[str]:
    """Writes the calibration of a rig, a picture of its coverage, and tables; lines about it.

    Args:
        folders: one folder with the images of a pair, or one folder for each of two or three
            cameras, left, right, top.
        board: what the images show.
        model: of the lenses, one of :data:`RIG_MODELS`.
        out: the calibration, .json, for `--camera`.
        progress: called with what is done, how far, of how much.

    Raises:
        FgslamError: the images are not found or not paired, show no such board or too few, or a
            file cannot be written.
    """
    if out.suffix != ".json":
        raise ConfigError(f"{out}: a calibration is written as .json; give such a name")
    _require_model(model, RIG_MODELS)
    files, notes = _files(folders)
    views, size, held = _views(files, board, partial(find_corners, board), progress)
    found = calibrate(board, views, size, model)
    checked = [held_out(board, found.views, size, model, k) for k in range(1, len(found.cameras))]
    calibration = Calibration(str(out), "fgslam calibrate", found.cameras, sided=True)
    rig = rig_of(calibration)
    others = _write(calibration, out, files, views, found)
    fit = _fit_lines(files, views, found)
    lines = [*notes, *held, *fit, f"rectified   {_view_words(rig)}"]
    lines += [*_rig_verdict(board, found, checked), *rig.remarks]
    return [*lines, f"calibration {out}, with {', '.join(map(str, others))}"]


@one_blas_thread()
def calibrate_wide_camera(
    folder: Path, board: Board, model: str, mount: str, out: Path, progress: Progress
) -> list[str]:
    """Writes the calibration of one fisheye or mirror, a picture, and tables; lines about it.

    Args:
        folder: of the images.
        board: what they show.
        model: of the lens, one of :data:`WIDE_MODELS`.
        mount: of the camera, one of :data:`MOUNTS`.
        out: the camera file, .yaml, for :func:`fgslam.load_camera`, `teach` and `follow`; the
            calibration that it names is written next to it: of camera.yaml camera_lens.json.
        progress: called with what is done, how far, of how much.

    Raises:
        FgslamError: the images are not found, show no such board or too few, or a file cannot be
            written.
    """
    _require_model(model, WIDE_MODELS)
    if mount not in MOUNTS:
        raise ConfigError(f"mount {mount!r} is not known; use {', '.join(MOUNTS)}")
    if out.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"{out}: a camera file is written as .yaml; give such a name")
    if not folder.is_dir():
        what = "is a file" if folder.is_file() else "no such folder"
        raise DatasetError(
            f"{folder}: {what}; give the folder of the board's images (a mirror is calibrated from "
            "one image of rings by fgslam calibrate rings)"
        )
    files = [(path,) for path in images_in(folder)]
    if not files:
        raise DatasetError(f"{folder}: holds no images; give the folder of the board's images")
    finder = partial(find_corners, board, mirrored=mount == "mirror")
    views, size, held = _views(files, board, finder, progress)
    found = calibrate(board, views, size, model)
    checked = held_out_alone(board, views, size, model)
    # Not rig.json of rig.yaml, which may be the calibration of a rig, with a picture and tables.
    numbers = numbers_beside(out)
    calibration = Calibration(str(numbers), "fgslam calibrate", found.cameras)
    others = numbers, *_write(calibration, numbers, files, views, found)
    middle, clockwise, words = MOUNTS[mount]
    keys = {"kind": "lens", "file": numbers.name, "middle": middle, "clockwise": clockwise}
    write_text(out, yaml.safe_dump(keys, sort_keys=False))
    return [
        *held,
        *_fit_lines(files, views, found),
        *wide_verdict(files, found, checked),
        f"mount       {mount}: {words}; if not, give --mount",
        f"calibration {out}, with {', '.join(map(str, others))}",
    ]


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
                f"{folders[0]}: images of two cameras cannot be distinguished there; name them "
                "left and right, or give a folder for each"
            )
        pairs, notes, _ = pair_files(found, at_once=False)
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
    files: Files, board: Board, finder: Finder, progress: Progress
) -> tuple[list[View], tuple[int, int], tuple[str, ...]]:
    """What the cameras see of the board at each moment, the size of all images, and remarks.

    Raises:
        CalibrationError: no image shows the board.
        DatasetError: the images differ in size.
    """
    bits, held = bits_of([moment[0] for moment in files])
    views: list[View] = []
    sizes = set()
    for done, moment in enumerate(files):
        progress("board", done, len(files))
        images = [read_grey_image(path, bits) for path in moment]
        sizes |= {(image.shape[1], image.shape[0]) for image in images}
        if len(sizes) > 1:
            raise DatasetError(
                f"{moment[0]}: its images, or those before, differ in size ({sorted(sizes)}); "
                "calibrate cameras of one resolution"
            )
        views.append(tuple(finder(image) for image in images))
    progress("board", len(files), len(files))
    if any(corners for view in views for corners in view):
        return views, sizes.pop(), held
    others = sizes_that_fit(board, read_grey_image(files[0][0], bits))
    meant = f"; {files[0][0].name} shows {', '.join(others)}" if others else ""
    counted = {
        "chessboard": "inner corners are counted, not squares",
        "charuco": "squares are counted; is --dictionary that of the print",
        "aprilgrid": "tags are counted, of the family 36h11",
    }
    raise CalibrationError(
        f"no image of {len(files)} moments shows a {board.kind} of {board.columns}x{board.rows}"
        f"{meant}; correct --board ({counted[board.kind]})"
    )


# --------------------------------------------------------------------------------------------
# What came out, and how good it is


def _fit_lines(files: Files, views: Sequence[View], found: BoardCalibration) -> Iterator[str]:
    """Corners used, all parameters with standard deviations, and the worst image."""
    total = sum(len(corners) for view in views for corners in view if corners is not None)
    names = _names(found)
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


def _rig_verdict(
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
        return f"verdict     doubtful: {'; '.join(faults or ['not checked'])}; {_MORE_IMAGES}"
    return "verdict     good for mapping"


def _write(
    calibration: Calibration,
    out: Path,
    files: Files,
    views: Sequence[View],
    found: BoardCalibration,
) -> tuple[Path, Path, Path]:
    """Writes a calibration, a picture of where corners were used, tables of images and parameters.

    Of each image: its camera, the corners found, those left out, and the residual of the others.
    Of each parameter: its value and standard deviation. Turns and shifts take coordinates of the
    first camera to a camera's own, radians and metres.

    Returns:
        Picture and tables.

    Raises:
        OutputError: a file cannot be written.
    """
    from fgslam.report.pictures import draw_corners

    write_text(out, json.dumps(raw_values(calibration), indent=2) + "\n")
    picture = out.with_suffix(".png")
    images = out.with_name(f"{out.stem}_images.csv")
    parameters = out.with_name(f"{out.stem}_parameters.csv")
    names = _names(found)
    corners = [
        np.concatenate([corners.pixels for view in found.kept if (corners := view[k]) is not None])
        for k in range(len(names))
    ]
    draw_corners(picture, found.cameras[0].size, corners, names)
    of_images = []
    for v, view in enumerate(views):
        for c, (seen, kept) in enumerate(zip(view, found.kept[v], strict=True)):
            count, used = (0 if one is None else len(one) for one in (seen, kept))
            rms = float(found.errors[v, c])
            of_images.append((files[v][c].name, names[c], count, count - used, rms))
    write_csv(images, ("image", "camera", "corners", "left_out", "rms_px"), of_images)
    rows: list[tuple[str, str, float, float]] = []
    for k, camera in enumerate(found.cameras):
        named = (*INTRINSICS, *PARAMETERS[camera.model], *(_TURNS if k else ()))
        values = [*camera.intrinsics, *camera.distortion, *(found.turns[k] if k else ())]
        sigmas = [*found.sigmas[k], *(found.turn_sigmas[k] if k else ())]
        for name, value, sigma in zip(named, values, sigmas, strict=True):
            rows.append((names[k], name, float(value), float(sigma)))
    write_csv(parameters, ("camera", "parameter", "value", "sigma"), rows)
    return picture, images, parameters


def _names(found: BoardCalibration) -> tuple[str, ...]:
    """Of the cameras; of a single one `camera`."""
    return NAMES[: len(found.cameras)] if len(found.cameras) > 1 else ("camera",)


# --------------------------------------------------------------------------------------------
# Mirrors


@one_blas_thread()
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
        "coefficients_deg": np.degrees(found.camera.coefficients).tolist(),
    }
    write_text(out, yaml.safe_dump(settings, sort_keys=False))
    rings = ", ".join(f"{radius:.1f}" for radius in found.radii)
    return [
        f"mirror      centre {circle.centre[0]:.1f} {circle.centre[1]:.1f} px, radius "
        f"{circle.radius:.1f} px, its edge found in {circle.support:.0%} of the directions",
        f"rings       radii {rings} px, found in {found.directions:.0%} of the directions",
        f"fit         worst ring off by {np.degrees(found.worst):.2f} deg",
        f"calibration {out}",
    ]


# --------------------------------------------------------------------------------------------
# Calibration files

_EDGE_STEPS = 60


def read_calibration(
    path: Path,
    second: Path | None = None,
    size: str | None = None,
    scale: bool = False,
    unit: float = 1.0,
    fov: float | None = None,
    cameras: str | None = None,
) -> Calibration:
    """The calibration of a file, what it leaves open being stated; see :func:`fgslam.load_rig`.

    Raises CalibrationError, or ConfigError for an option that is none.
    """
    sizes = None if size is None else _whole_numbers(size, "x", "--size", "640x480")
    chosen = None if cameras is None else _whole_numbers(cameras, ",", "--cameras", "0,1")
    pair = None if sizes is None else (sizes[0], sizes[1]) if len(sizes) == 2 else sizes
    require_options(pair, unit, fov)
    found = read_calibration_file(path, second, pair)  # type: ignore[arg-type]
    found = in_metres(chosen_cameras(found, chosen), unit)
    return at_size(found, pair, scale)  # type: ignore[arg-type]


def _whole_numbers(text: str, separator: str, option: str, example: str) -> tuple[int, ...]:
    words = text.lower().split(separator)
    if not all(word.strip().isdecimal() for word in words):
        raise ConfigError(f"{option} {text}: give whole numbers, as {option} {example}")
    return tuple(int(word) for word in words)


# --------------------------------------------------------------------------------------------
# In another format


def convert_calibration(
    found: Calibration, out: Path, form: str | None = None, fov_deg: float | None = None
) -> list[str]:
    """Writes the calibration in a format, None: that of the name of ``out``; lines.

    Raises:
        CalibrationError: that format has no such cameras.
        OutputError: the file cannot be written.
    """
    lacking = [camera.name for camera in found.cameras if camera.width == 0]
    if lacking:
        raise CalibrationError(
            f"{found.source} does not state the images' size; give it: --size 640x480"
        )
    words = write_calibration(found, out, form, fov_deg)
    return [f"{out}: {words}, {len(found.cameras)} cameras of {found.source}", *found.notes]


# --------------------------------------------------------------------------------------------
# In words, and as a picture


def show_calibration(
    found: Calibration, picture: Path | None, fov_deg: float | None = None
) -> list[str]:
    """What was understood, in lines; the picture as well, where one is wanted.

    Raises:
        CalibrationError: its cameras make no rig.
        OutputError: the picture cannot be written.
    """
    many = f"{len(found.cameras)} camera{'s' if len(found.cameras) > 1 else ''}"
    lines = [f"{found.source}: {found.format}, {many}", *_table(found)]
    rig = None
    if len(found.cameras) > 1:
        rig = rig_of(found, fov_deg)
        lines += _about(rig, found)
    if picture is not None:
        _draw(found, rig, picture)
        lines.append(f"picture: {picture}")
    return lines


def _table(found: Calibration) -> list[str]:
    rows = [
        ("camera", "image", "model", "focal px", "view deg (h x v x d)", "place mm", "turned deg")
    ]
    for k, camera in enumerate(found.cameras):
        place = found.offset(k, 0)
        angles = np.degrees(camera.field_of_view()) if camera.width else np.full(3, np.nan)
        rows.append(
            (
                f"{k}: {camera.name}",
                f"{camera.width}x{camera.height}" if camera.width else "unknown",
                camera.model,
                f"{camera.focal_px:.1f}",
                " x ".join(f"{angle:.0f}" for angle in angles),
                " ".join(f"{1e3 * v:+.1f}" for v in place[:3, 3]),
                f"{pose_difference(np.eye(4), place)[1]:.2f}",
            )
        )
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]


def _about(rig: StereoRig, found: Calibration) -> list[str]:
    names = [found.cameras[k].name for k in rig.sources]
    parts = [f"{side} = {name}" for side, name in zip(CAMERA_NAMES, names, strict=False)]
    lines = [f"rig: {', '.join(parts)}; baseline {1e3 * rig.baseline:.2f} mm"]
    if rig.vertical_baseline is not None:
        lines[0] += f", vertical baseline {1e3 * rig.vertical_baseline:.2f} mm"
    what = "rectified already" if rig.rectifier is None else "rectified view"
    if rig.format.startswith("OpenCV"):
        lines.append("unit: taken as metres, which the file does not state (--unit)")
    return [*lines, f"{what}: {_view_words(rig)}", *rig.remarks]


def _view_words(rig: StereoRig) -> str:
    """Size, focal length, angles and overlap of the rectified view."""
    across, down = rig.angles_deg
    return (
        f"{rig.width}x{rig.height}, focal length {rig.fx:.1f} px, {across:.0f} x {down:.0f} "
        f"degrees, the cameras overlap in {100.0 * rig.overlap:.1f} % of it; 1 px of disparity at "
        f"{rig.fx * rig.baseline:.1f} m"
    )


def _draw(found: Calibration, rig: StereoRig | None, path: Path) -> None:
    from fgslam.report.pictures import CameraDrawing, draw_cameras

    drawings = []
    for k, camera in enumerate(found.cameras):
        size, half, outline = camera.size, 0.5, np.empty((0, 2))
        if camera.width:
            half = 0.5 * float(camera.field_of_view()[0])
        else:  # as large as the principal point makes it
            width, height = np.round(2.0 * camera.matrix[:2, 2]).astype(int).tolist()
            size = max(width, 1), max(height, 1)
        if rig is not None and k in rig.sources and rig.rectifier is not None:
            # Where the border of the rectified view lies in the raw image.
            both = np.stack(rig.rectifier.maps[rig.sources.index(k)], axis=2).astype(np.float64)
            across = np.linspace(0, both.shape[1] - 1, _EDGE_STEPS).astype(int)
            down = np.linspace(0, both.shape[0] - 1, _EDGE_STEPS).astype(int)
            sides = both[0, across], both[down, -1], both[-1, across[::-1]], both[down[::-1], 0]
            outline = np.concatenate(sides)
        place = found.offset(k, 0)
        drawings.append(
            CameraDrawing(camera.name, size, camera.matrix[:2, 2], outline, place, half)
        )
    draw_cameras(path, f"{found.format}, {found.cameras[0].model}", drawings)
