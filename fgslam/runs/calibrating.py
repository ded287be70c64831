"""Calibrates cameras from images of a board, mirrors from one of rings: `fgslam calibrate`."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import yaml

from fgslam.cameras.boards import Board, Corners, find_corners, find_corners_of_wide, sizes_that_fit
from fgslam.cameras.calibrate import View, calibrate, held_out, held_out_alone
from fgslam.cameras.lenses import Calibration
from fgslam.cameras.omni import MirrorFrame
from fgslam.cameras.rig import assembled
from fgslam.cameras.rings import calibrate_from_rings, find_mirror_circle
from fgslam.cameras.write_formats import raw_values
from fgslam.core.arrays import Image
from fgslam.core.errors import CalibrationError, ConfigError, DatasetError
from fgslam.core.files import write_text
from fgslam.datasets.images import bits_of, read_grey_image
from fgslam.datasets.layouts import find_cameras, images_in
from fgslam.datasets.times import pair_files
from fgslam.runs.calibration_report import (
    Files,
    draw_coverage,
    fit_lines,
    rig_verdict,
    wide_verdict,
    write_tables,
)

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

Progress = Callable[[str, int, int], None]
Finder = Callable[[Image], Corners | None]


@dataclass(frozen=True, slots=True)
class Calibrated:
    """What came out: the calibration, what else was written, and what to tell, a line each."""

    file: Path
    others: tuple[Path, ...]
    lines: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class WideLens:
    """Model of a single wide camera, and how it is mounted.

    Raises:
        ConfigError: one of them is not known.
    """

    model: str = "omni"
    mount: str = "mirror"

    def __post_init__(self) -> None:
        _require_model(self.model, WIDE_MODELS)
        if self.mount not in MOUNTS:
            raise ConfigError(f"mount {self.mount!r} is not known; use {', '.join(MOUNTS)}")

    def camera_file(self, numbers: str) -> dict[str, str | bool]:
        """Keys of a camera file that names the calibration beside it."""
        middle, clockwise, _ = MOUNTS[self.mount]
        return {"kind": "lens", "file": numbers, "middle": middle, "clockwise": clockwise}


def numbers_beside(out: Path) -> Path:
    """Where the calibration is that the camera file ``out`` of one wide camera names."""
    return out.with_name(f"{out.stem}_lens.json")


def _require_model(model: str, known: Sequence[str]) -> None:
    if model not in known:
        raise ConfigError(f"lens {model!r} is not known; use {' or '.join(known)}")


def calibrate_cameras(
    folders: Sequence[Path], board: Board, model: str, out: Path, progress: Progress
) -> Calibrated:
    """Writes the calibration of a rig, a picture of how its images are covered, and tables.

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
    bits, held = bits_of([moment[0] for moment in files])
    views, size = _views(files, bits, partial(find_corners, board), progress)
    _require_found(views, files, bits, board)
    found = calibrate(board, views, size, model)
    checked = [held_out(board, views, size, model, k) for k in range(1, len(found.cameras))]
    calibration = Calibration(str(out), "fgslam calibrate", found.cameras, sided=True)
    remarks = assembled(calibration).remarks
    write_text(out, json.dumps(raw_values(calibration), indent=2) + "\n")
    others = (draw_coverage(out, found), *write_tables(out, files, views, found))
    lines = (*fit_lines(files, views, found), *rig_verdict(board, found, checked), *remarks)
    return Calibrated(out, others, (*notes, *held, *lines))


def calibrate_wide_camera(
    folder: Path, board: Board, lens: WideLens, out: Path, progress: Progress
) -> Calibrated:
    """Writes the calibration of one fisheye or mirror, a picture of its coverage, and tables.

    Args:
        folder: of the images.
        board: what they show.
        lens: how the camera is modelled and mounted.
        out: the camera file, .yaml, for :func:`fgslam.load_camera`, `teach` and `follow`; the
            calibration that it names is written beside it: of camera.yaml camera_lens.json.
        progress: called with what is done, how far, of how much.

    Raises:
        FgslamError: the images are not found, show no such board or too few, or a file cannot be
            written.
    """
    if out.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"{out}: a camera file is written as .yaml; give such a name")
    files = _files_of_one(folder)
    bits, held = bits_of([moment[0] for moment in files])
    finder = partial(find_corners_of_wide, board, mirrored=lens.mount == "mirror")
    views, size = _views(files, bits, finder, progress)
    _require_found(views, files, bits, board)
    found = calibrate(board, views, size, lens.model)
    checked = held_out_alone(board, views, size, lens.model)
    # Not rig.json of rig.yaml, which may be the calibration of a rig, with a picture and tables.
    numbers = numbers_beside(out)
    calibration = Calibration(str(numbers), "fgslam calibrate", found.cameras)
    write_text(numbers, json.dumps(raw_values(calibration), indent=2) + "\n")
    write_text(out, yaml.safe_dump(lens.camera_file(numbers.name), sort_keys=False))
    tables = write_tables(numbers, files, views, found)
    lines = (
        *held,
        *fit_lines(files, views, found),
        *wide_verdict(files, found, checked),
        f"mount       {lens.mount}: {MOUNTS[lens.mount][-1]}; if not, give --mount",
    )
    return Calibrated(out, (numbers, draw_coverage(numbers, found), *tables), lines)


def _files_of_one(folder: Path) -> list[tuple[Path, ...]]:
    """The images of one camera, each a moment of its own."""
    if folder.is_file():
        raise DatasetError(
            f"{folder}: is a file; give the folder of the board's images (a mirror is calibrated "
            "from one image of rings by fgslam calibrate rings)"
        )
    if not folder.is_dir():
        raise DatasetError(f"{folder}: no such folder; give the folder of the board's images")
    found = images_in(folder)
    if not found:
        raise DatasetError(f"{folder}: holds no images; give the folder of the board's images")
    return [(path,) for path in found]


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
    files: Files, bits: int, finder: Finder, progress: Progress
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
        views.append(tuple(finder(image) for image in images))
    progress("board", len(files), len(files))
    return views, sizes.pop()


def _require_found(views: Sequence[View], files: Files, bits: int, board: Board) -> None:
    """Raises CalibrationError where no image shows the board."""
    if any(corners for view in views for corners in view):
        return
    size = f"{board.columns}x{board.rows}"
    others = sizes_that_fit(board, read_grey_image(files[0][0], bits))
    meant = f"; {files[0][0].name} shows {', '.join(others)}" if others else ""
    counted = {
        "chessboard": "inner corners are counted, not squares",
        "charuco": "squares are counted; is --dictionary that of the print",
        "aprilgrid": "tags are counted, of the family 36h11",
    }
    raise CalibrationError(
        f"no image of {len(files)} moments shows a {board.kind} of {size}{meant}; correct --board "
        f"({counted[board.kind]})"
    )


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
