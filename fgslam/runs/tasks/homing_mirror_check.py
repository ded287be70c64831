"""Whether a mirror lies in its pictures where the camera has it; told as notes on the run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fgslam.cameras.omni.radial import RadialCamera
from fgslam.cameras.omni.ring_calibration import MirrorCircle, find_mirror_circle
from fgslam.core.arrays import Image
from fgslam.core.errors import CalibrationError
from fgslam.datasets.omni.opening import open_omni
from fgslam.datasets.omni.recording import OmniRecording
from fgslam.datasets.omni.settings import OmniDatasetSettings

_PICTURES = 3  # the rim may be as dark as its holder in one of them
_CLEARLY_OFF = 0.025
"""Of the radius: a calibrated mirror was seen off by 0.015, its rim and its axis not being one
(docs/datasets/mirror_images.md); this is an error of 1.4 degrees at the rim, more within."""
_LEAST_OFF_PX = 3.0


def open_checked(settings: OmniDatasetSettings) -> OmniRecording:
    """Opens a recording, with a note where its mirror lies off the stated centre.

    Raises:
        DatasetError: as :func:`fgslam.datasets.omni.opening.open_omni`.
    """
    recording = open_omni(settings)
    return replace(recording, notes=recording.notes + mirror_notes(recording))


def mirror_notes(recording: OmniRecording) -> tuple[str, ...]:
    """A note where the rim in the first pictures lies clearly off, or cannot be found at all.

    Cameras without a mirror have none.
    """
    camera = recording.camera
    if not isinstance(camera, RadialCamera):
        return ()
    count = min(_PICTURES, len(recording))
    circles = [c for k in range(count) if (c := _rim(camera, recording, k)) is not None]
    if not circles:
        return (
            f"the mirror's rim is not found in {recording.names[0]}, so its centre is unchecked",
        )
    column, row = np.median([c.centre for c in circles], axis=0)
    stated = camera.frame.centre
    away = float(np.hypot(column - stated[0], row - stated[1]))
    if away <= max(_CLEARLY_OFF * camera.outer_radius, _LEAST_OFF_PX):
        return ()
    return (
        f"the mirror lies {away:.1f} px off its stated centre ({stated[0]:.1f}, {stated[1]:.1f}): "
        f"its rim's is ({column:.1f}, {row:.1f}); bearings are wrong by up to "
        f"{np.degrees(away / camera.outer_radius):.1f} degrees at the rim and more within: correct "
        "dataset.camera or the calibration",
    )


def _rim(camera: RadialCamera, recording: OmniRecording, place: int) -> MirrorCircle | None:
    """The rim near where it should be, else amid any circle: its holder's, say, is concentric."""
    image = recording.image(place)
    found = _circle(image, (camera.frame.centre, camera.outer_radius))
    if found is not None:
        return found
    around = _circle(image, None)
    return None if around is None else _circle(image, (around.centre, camera.outer_radius))


def _circle(image: Image, near: tuple[tuple[float, float], float] | None) -> MirrorCircle | None:
    try:
        return find_mirror_circle(image, np.random.default_rng(0), near)
    except CalibrationError:
        return None
