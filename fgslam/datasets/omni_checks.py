"""Whether the pictures of a recording can be of the camera that is stated for it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np

from fgslam.cameras.omni import Equirectangular, LensCamera, OCamCamera, RadialCamera
from fgslam.cameras.rings import MirrorCircle, find_mirror_circle
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import CalibrationError, FrameError
from fgslam.datasets.omni import OmniRecording
from fgslam.datasets.opening import open_omni
from fgslam.datasets.settings import OmniDatasetSettings

_PICTURES = 3  # the rim may be as dark as its holder in one of them
_CLEARLY_OFF = 0.025
"""Of the radius: a calibrated mirror was seen off by 0.015, its rim and its axis not being one
(docs/datasets/omnidirectional.md); this is an error of 1.4 degrees at the rim, more within."""
_LEAST_OFF_PX = 3.0
_UNEVEN = 1.25  # columns over rows a degree, or the reverse, that no one means
_BLACK = 16.0  # mean of red, green and blue; a film's black is up to that
_DARK_SIDES = 0.01  # of the width: so many black columns are no dark corner
_STEEP = 0.01  # of the steps between columns are larger than any around a real panorama's end


def open_checked(settings: OmniDatasetSettings) -> OmniRecording:
    """A recording, with a note where its pictures cannot be of the stated camera.

    Raises:
        DatasetError: as :func:`fgslam.datasets.opening.open_omni`.
    """
    recording = open_omni(settings)
    return replace(recording, notes=recording.notes + camera_notes(recording))


def camera_notes(recording: OmniRecording, stated: bool = True) -> tuple[str, ...]:
    """What the pictures show of the stated mirror or panoramas, and what a file does not state.

    The latter, and a mirror that is where it should be, only of a camera that is stated here, not
    of one that a route brings along.
    """
    camera = recording.camera
    if isinstance(camera, Equirectangular):
        return (*_panorama_notes(camera), *_side_notes(recording))
    if isinstance(camera, LensCamera):
        middle, other = ("up", "down") if camera.up else ("down", "up")
        turn = "clockwise" if camera.clockwise else "counter-clockwise"
        assumed = (
            f"the picture's middle is taken to look {middle}, bearings to grow {turn} in it; "
            f"dataset.camera.middle={other} and dataset.camera.clockwise say otherwise",
        )
        hole, rim = camera.ring
        # A mirror reflects its camera in the middle; a lens has no rim that must be in the picture.
        mirror = _mirror_notes(recording, camera.centre, rim, stated) if hole > 0.0 else ()
        return (*(assumed if stated else ()), *mirror)
    if isinstance(camera, RadialCamera):
        assumed = (
            "the picture's middle is taken to look down, as of a mirror above the camera; of a "
            "fisheye that points up dataset.camera.kind=lens and dataset.camera.middle=up say so",
        )
        mirror = _mirror_notes(recording, camera.frame.centre, camera.outer_radius, stated)
        return (*(assumed if stated and isinstance(camera, OCamCamera) else ()), *mirror)
    return ()


def _panorama_notes(camera: Equirectangular) -> tuple[str, ...]:
    """A note where columns and rows are not equally fine: a cropped panorama, or none at all."""
    view = np.rad2deg(camera.top_elevation - camera.bottom_elevation)
    across, down = (camera.width - 1) / 360.0, (camera.height - 1) / view
    if max(across, down) <= _UNEVEN * min(across, down):
        return ()
    return (
        f"pictures of {camera.width}x{camera.height} pixels over 360 x {view:g} degrees have "
        f"{across:.1f} columns but {down:.1f} rows a degree: are they whole panoramas? Else give "
        "dataset.camera.top_elevation_deg and bottom_elevation_deg",
    )


def _side_notes(recording: OmniRecording) -> tuple[str, ...]:
    """A note where the pictures do not go on from their last column to the first one.

    In whole panoramas these are neighbours; here the step between them is larger than nearly all
    others, or what is next to the picture proper is black.
    """
    ends = [_ends(image.mean(axis=2)) for image in _first_pictures(recording)]
    if not ends:
        return ()
    black, step = np.median(ends, axis=0)
    if black > _DARK_SIDES * recording.camera.width:
        what = f"{black:.0f} columns of the pictures are black at the sides"
    elif step > 0.0:
        what = "the right and left ends of the pictures do not meet"
    else:
        return ()
    return (
        f"{recording.name}: {what}: they are no panoramas of all 360 degrees from end to end, so "
        "directions are wrong; cut off what is next to them, or give the camera that took them",
    )


def _ends(grey: FloatArray) -> tuple[int, float]:
    """Black columns at both sides of a picture (h, w), and how unusual the step around it is.

    That is by how many grey levels it exceeds nearly all steps between two columns.
    """
    lit = np.flatnonzero(grey.max(axis=0) > _BLACK)
    if not len(lit):
        return 0, 0.0
    black = grey.shape[1] - int(lit[-1] - lit[0] + 1)
    steps = np.abs(np.diff(grey)).mean(axis=0)
    around = float(np.abs(grey[:, -1] - grey[:, 0]).mean())
    return black, around - float(np.quantile(steps, 1.0 - _STEEP))


def _first_pictures(recording: OmniRecording) -> Iterator[Image]:
    """As many as a check needs, without damaged ones."""
    for k in range(min(_PICTURES, len(recording))):
        with suppress(FrameError):
            yield recording.image(k)


def _mirror_notes(
    recording: OmniRecording, centre: tuple[float, float], radius: float, always: bool
) -> tuple[str, ...]:
    """A note on where the rim is in the first pictures; of one in its place only where asked."""
    circles = [c for k in _first_pictures(recording) if (c := _rim(centre, radius, k)) is not None]
    if not circles:
        return (
            f"the mirror's rim is not found in {recording.names[0]}, so its centre is unchecked",
        )
    column, row = np.median([c.centre for c in circles], axis=0)
    away = float(np.hypot(column - centre[0], row - centre[1]))
    if away <= max(_CLEARLY_OFF * radius, _LEAST_OFF_PX):
        found = f"the mirror's rim is found, {away:.1f} px from where it is stated"
        return (found,) if always else ()
    return (
        f"the mirror lies {away:.1f} px off its stated centre ({centre[0]:.1f}, {centre[1]:.1f}): "
        f"its rim's is ({column:.1f}, {row:.1f}); bearings are wrong by up to "
        f"{np.degrees(away / radius):.1f} degrees at the rim and more within: correct "
        "dataset.camera or the calibration",
    )


def _rim(centre: tuple[float, float], radius: float, image: Image) -> MirrorCircle | None:
    """The rim near where it should be, else around any circle: its holder's, say, is concentric."""
    found = _circle(image, (centre, radius))
    if found is not None:
        return found
    around = _circle(image, None)
    return None if around is None else _circle(image, (around.centre, radius))


def _circle(image: Image, near: tuple[tuple[float, float], float] | None) -> MirrorCircle | None:
    try:
        return find_mirror_circle(image, np.random.default_rng(0), near)
    except CalibrationError:
        return None
