"""Colour and depth as a stereo pair: the colour camera, and one beside it that depth makes up."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from fgslam.cameras.lenses import RawCamera
from fgslam.cameras.rectify import MapArray, View, pixel_grid, sampling_maps
from fgslam.core.arrays import Image
from fgslam.core.errors import DatasetError, FrameError
from fgslam.core.sensors import CameraRig
from fgslam.datasets.settings import CalibratedSettings
from fgslam.datasets.virtual_view import seen_from_the_left

BASELINE_M = 0.08
"""Of the camera that is made up: about that of depth cameras, so that both see much the same."""

Depth: TypeAlias = npt.NDArray[np.float32]
"""Depths (height, width) in metres; 0, infinite or NaN where unknown."""

_FOUND_AGAIN_PX = 0.15  # by which SIFT finds a point again in a view made of the same image


def depth_sigma_px(focal_px: float, sigma_m: float) -> float:
    """Noise of the disparity, pixels, where a depth of 1 m has ``sigma_m``, growing with Z^2."""
    return round(float(np.hypot(focal_px * BASELINE_M * sigma_m, _FOUND_AGAIN_PX)), 3)


_WORDS = (
    ("left and right images", "colour and depth"),
    ("right images", "colour images"),
    ("left images", "depth images"),
)


def in_words(note: str) -> str:
    """A note on the pairs of two cameras for those of colour and depth."""
    for theirs, own in _WORDS:
        note = note.replace(theirs, own)
    return note


def require_one_camera(settings: CalibratedSettings) -> None:
    """Raises DatasetError where something is asked for that two cameras alone have."""
    for name, asked in (
        ("fov_deg", settings.fov_deg),
        ("unit_m", settings.unit_m != 1.0),
    ):
        if asked:
            raise DatasetError(f"{settings.path}: dataset.{name} is for two cameras; leave it out")


@dataclass(frozen=True, eq=False)
class Undistorted:
    """Where each pixel of an undistorted image is in the camera's own."""

    columns: MapArray
    rows: MapArray

    @staticmethod
    def of(camera: RawCamera) -> Undistorted | None:
        """None where there is nothing to mend."""
        if camera.model == "radtan" and not np.any(camera.distortion):
            return None
        view = View(camera.matrix, (camera.width, camera.height))
        return Undistorted(*sampling_maps(camera, np.eye(3), view, pixel_grid(view.size)))

    def image(self, image: Image) -> Image:
        """The image, with its pixels between others blended."""
        return np.asarray(cv2.remap(image, self.columns, self.rows, cv2.INTER_LINEAR), np.uint8)

    def depth(self, metres: Depth) -> Depth:
        """The depths, of each pixel the nearest: between two surfaces there is none."""
        found = cv2.remap(metres, self.columns, self.rows, cv2.INTER_NEAREST)
        return np.asarray(found, np.float32)


ReadPair: TypeAlias = Callable[[int], tuple[Image, Depth, str]]
"""Of a frame its image, the depth of each pixel in metres, and the name of the depth image."""


@dataclass(frozen=True, eq=False)
class DepthFrames:
    """Frames as a stereo pair: the colour camera on the right, the view made by depth left.

    Attributes:
        read: what gives image and depth.
        rig: of both cameras.
        undistorted: what straightens both images; None where they are straight.
    """

    read: ReadPair
    rig: CameraRig
    undistorted: Undistorted | None

    def load(self, index: int) -> tuple[Image, ...]:
        """(right, left) in grey. Raises FrameError."""
        return tuple(_grey(image) for image in self.load_colour(index))

    def load_colour(self, index: int) -> tuple[Image, ...]:
        """The same in red, green, blue, or grey where the camera is."""
        colour, metres, name = self.read(index)
        if metres.shape != colour.shape[:2]:
            raise FrameError(
                f"image {name} is {metres.shape[1]}x{metres.shape[0]}, its colour image "
                f"{colour.shape[1]}x{colour.shape[0]}; depth must be registered to colour"
            )
        if self.undistorted is not None:
            colour = self.undistorted.image(colour)
            metres = self.undistorted.depth(metres)
        known = np.isfinite(metres) & (metres > 0.0)
        shift = self.rig.fx * self.rig.baseline / np.where(known, metres, np.inf)
        return colour, seen_from_the_left(colour, shift.astype(np.float32), known)


def _grey(image: Image) -> Image:
    if image.ndim == 2:
        return image
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
