"""Calibration files: what one says, in words and as a picture; the same in another format."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgslam.cameras.lenses import Calibration, RawCamera, StatedView
from fgslam.cameras.rig import (
    StereoRig,
    assembled,
    at_size,
    chosen_cameras,
    in_metres,
    read_calibration_file,
    require_options,
    rig_of,
)
from fgslam.cameras.write_formats import write_calibration
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError, ConfigError
from fgslam.core.sensors import CAMERA_NAMES

_EDGE_STEPS = 60


@dataclass(frozen=True, slots=True)
class Asked:
    """Which calibration, and what it leaves open; see :func:`fgslam.load_rig`."""

    path: Path
    second: Path | None = None
    size: str | None = None
    scale: bool = False
    unit_m: float = 1.0
    fov_deg: float | None = None
    cameras: str | None = None

    def read(self) -> Calibration:
        """The calibration. Raises CalibrationError, or ConfigError for an option that is none."""
        size = None if self.size is None else _whole_numbers(self.size, "x", "--size", "640x480")
        chosen = None
        if self.cameras is not None:
            chosen = _whole_numbers(self.cameras, ",", "--cameras", "0,1")
        pair = None if size is None else (size[0], size[1]) if len(size) == 2 else size
        require_options(pair, self.unit_m, self.fov_deg)
        found = read_calibration_file(self.path, self.second, pair)  # type: ignore[arg-type]
        found = in_metres(chosen_cameras(found, chosen), self.unit_m)
        return at_size(found, pair, self.scale)  # type: ignore[arg-type]


def _whole_numbers(text: str, separator: str, option: str, example: str) -> tuple[int, ...]:
    words = text.lower().split(separator)
    if not all(word.strip().isdecimal() for word in words):
        raise ConfigError(f"{option} {text}: give whole numbers, as {option} {example}")
    return tuple(int(word) for word in words)


# --------------------------------------------------------------------------------------------
# In another format


def convert_calibration(asked: Asked, out: Path, form: str | None = None) -> list[str]:
    """Writes the calibration in a format, None: the one that the name of ``out`` says; lines.

    Raises:
        CalibrationError: it cannot be read, or that format has no such cameras.
        OutputError: the file cannot be written.
    """
    found = asked.read()
    lacking = [camera.name for camera in found.cameras if camera.width == 0]
    if lacking:
        raise CalibrationError(
            f"{found.source} does not state the images' size; give it: --size 640x480"
        )
    for_ros = form == "ros" or (form is None and not out.suffix)
    view = _view(found, asked.fov_deg) if for_ros and len(found.cameras) == 2 else None
    words = write_calibration(found, out, view, form)
    return [f"{out}: {words}, {len(found.cameras)} cameras of {found.source}", *found.notes]


def _view(found: Calibration, fov_deg: float | None) -> StatedView:
    """The rectification of a pair, left camera first."""
    if found.view is not None and fov_deg is None:
        return found.view
    made = assembled(found, fov_deg)
    if made.sources != (1, 0):
        raise CalibrationError(
            f"{found.source}: its first camera is the right one, and ROS wants the left one first; "
            "choose them in that order: --cameras 1,0"
        )
    rig = made.rig
    axes = rig.bTc[:3, :3].T
    rotations = tuple(axes @ camera.bTc[:3, :3] for camera in found.cameras)
    matrix = np.array([[rig.fx, 0.0, rig.cx], [0.0, rig.fy, rig.cy], [0.0, 0.0, 1.0]])
    return StatedView((rotations[0], rotations[1]), matrix, (rig.width, rig.height))


# --------------------------------------------------------------------------------------------
# In words, and as a picture


def show_calibration(asked: Asked, picture: Path | None) -> list[str]:
    """What was understood, in lines; the picture as well, where one is wanted.

    Raises:
        CalibrationError: the calibration cannot be read.
        OutputError: the picture cannot be written.
    """
    found = asked.read()
    many = f"{len(found.cameras)} camera{'s' if len(found.cameras) > 1 else ''}"
    lines = [f"{found.source}: {found.format}, {many}", *_table(found)]
    rig = None
    if len(found.cameras) > 1:
        rig = rig_of(found, asked.fov_deg)
        lines += _about(rig, found)
    if picture is not None:
        _draw(found, rig, picture)
        lines.append(f"picture: {picture}")
    return lines


_HEAD = ("camera", "image", "model", "focal px", "view deg (h x v x d)", "place mm", "turned deg")


def _table(found: Calibration) -> list[str]:
    rows = [_HEAD, *(_row(found, k) for k in range(len(found.cameras)))]
    widths = [max(len(row[k]) for row in rows) for k in range(len(_HEAD))]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]


def _row(found: Calibration, k: int) -> tuple[str, ...]:
    camera, place = found.cameras[k], found.offset(k, 0)
    angles = np.degrees(camera.field_of_view()) if camera.width else np.full(3, np.nan)
    cosine = 0.5 * (float(np.trace(place[:3, :3])) - 1.0)
    return (
        f"{k}: {camera.name}",
        f"{camera.width}x{camera.height}" if camera.width else "unknown",
        camera.model,
        f"{camera.focal_px:.1f}",
        " x ".join(f"{angle:.0f}" for angle in angles),
        " ".join(f"{1e3 * v:+.1f}" for v in place[:3, 3]),
        f"{np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))):.2f}",
    )


def _about(rig: StereoRig, found: Calibration) -> list[str]:
    names = [found.cameras[k].name for k in rig.sources]
    parts = [f"{side} = {name}" for side, name in zip(CAMERA_NAMES, names, strict=False)]
    lines = [f"rig: {', '.join(parts)}; baseline {1e3 * rig.baseline:.2f} mm"]
    if rig.vertical_baseline is not None:
        lines[0] += f", vertical baseline {1e3 * rig.vertical_baseline:.2f} mm"
    view = rig.angles_deg
    what = "rectified already" if rig.rectifier is None else "rectified view"
    lines.append(
        f"{what}: {rig.width}x{rig.height}, focal length {rig.fx:.1f} px, {view[0]:.0f} x "
        f"{view[1]:.0f} degrees, {100.0 * _overlap(rig):.1f} % of it seen by all cameras; 1 px of "
        f"disparity at {rig.fx * rig.baseline:.1f} m"
    )
    return [*lines, *rig.remarks]


def _overlap(rig: StereoRig) -> float:
    """Share of the rectified pixels that every camera sees."""
    if rig.rectifier is None:
        return 1.0
    return float(np.logical_and.reduce(rig.rectifier.masks).mean())


def _draw(found: Calibration, rig: StereoRig | None, path: Path) -> None:
    from fgslam.report.pictures.cameras import CameraDrawing, draw_cameras

    reference = found.cameras[0]
    drawings = []
    for k, camera in enumerate(found.cameras):
        place = found.offset(k, 0)
        size = camera.size if camera.width else _guessed_size(camera)
        outline = np.empty((0, 2))
        if rig is not None and k in rig.sources and rig.rectifier is not None:
            outline = _outline(rig.rectifier.maps[rig.sources.index(k)])
        half = 0.5 * float(camera.field_of_view()[0]) if camera.width else 0.5
        drawings.append(
            CameraDrawing(camera.name, size, camera.matrix[:2, 2], outline, place, half)
        )
    draw_cameras(path, f"{found.format}, {reference.model}", drawings)


def _guessed_size(camera: RawCamera) -> tuple[int, int]:
    width, height = np.round(2.0 * camera.matrix[:2, 2]).astype(int).tolist()
    return max(width, 1), max(height, 1)


def _outline(maps: Sequence[FloatArray] | tuple[object, ...]) -> FloatArray:
    """Where the border of the rectified view lies in the raw image, (n, 2) pixels."""
    both = np.stack([np.asarray(one, np.float64) for one in maps], axis=2)
    height, width = both.shape[:2]
    across = np.linspace(0, width - 1, _EDGE_STEPS).astype(int)
    down = np.linspace(0, height - 1, _EDGE_STEPS).astype(int)
    border = [both[0, across], both[down, -1], both[-1, across[::-1]], both[down[::-1], 0]]
    return np.concatenate(border)
