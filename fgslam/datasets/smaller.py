"""A recording whose images are made smaller, the calibration with them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from fgslam.core.arrays import Image
from fgslam.core.errors import DatasetError
from fgslam.core.sensors import CameraRig
from fgslam.datasets.recording import ImageLoader, Recording

_SMALLEST_PX = 8  # SIFT finds nothing in less


def smaller(recording: Recording, scale: float) -> Recording:
    """The recording with rectified images smaller by a factor ``scale``.

    Pixels are averaged over what they cover. Noise that the recording states is in pixels of the
    images it gives.

    Raises:
        DatasetError: nothing would be left of the images.
    """
    before = recording.rig
    rig = _scaled_rig(before, scale)
    if min(rig.width, rig.height) < _SMALLEST_PX:
        raise DatasetError(
            f"dataset.scale {scale:g} makes images of {rig.width}x{rig.height} pixels of "
            f"{before.width}x{before.height}; choose a larger one"
        )
    size = (rig.width, rig.height)
    margins = () if recording.rectifier is None else recording.rectifier.margins
    colour = recording.load_colour
    note = f"images of {before.width}x{before.height} are made {rig.width}x{rig.height}"
    return replace(
        recording,
        rig=rig,
        margins=tuple(
            scale * cv2.resize(m, size, interpolation=cv2.INTER_NEAREST) for m in margins
        ),
        load_images=_loader(recording.load_images, size),
        load_colour=None if colour is None else _loader(colour, size),
        notes=(note, *recording.notes),
    )


def _scaled_rig(rig: CameraRig, scale: float) -> CameraRig:
    width, height = (max(round(scale * length), 1) for length in (rig.width, rig.height))
    x, y = width / rig.width, height / rig.height
    return replace(
        rig,
        width=width,
        height=height,
        fx=x * rig.fx,
        fy=y * rig.fy,
        # Whole pixels are at their centres: the image reaches from -0.5.
        cx=x * (rig.cx + 0.5) - 0.5,
        cy=y * (rig.cy + 0.5) - 0.5,
    )


def _loader(load: Callable[[int], tuple[Image, ...]], size: tuple[int, int]) -> ImageLoader:
    def loaded(index: int) -> tuple[Image, ...]:
        return tuple(
            np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
            for image in load(index)
        )

    return loaded
