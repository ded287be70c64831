"""Both kinds of features of one image: all that is kept of a path image (Goedemé III-A)."""

from __future__ import annotations

import cv2
import numpy as np

from fgslam.cameras.omni import (
    Cylinder,
    Equirectangular,
    OmniCamera,
    require_own_image,
    unit_rays,
    unwrap_maps,
)
from fgslam.core.arrays import Image
from fgslam.core.errors import FrameError
from fgslam.core.homing import ColumnSegments, OmniFeatures, UprightFeatures
from fgslam.frontend.features.colour_sift import (
    MAX_ELEVATION_DEG,
    MIN_ELEVATION_DEG,
    UprightSift,
    empty_features,
    up_in_image,
    wrapping_period,
)
from fgslam.frontend.features.column_segments import ColumnSegmentFinder, empty_segments
from fgslam.frontend.features.settings import OmniFeatureSettings

_MAX_VIEW_WIDTH = 2048  # of the unwrapped view, pixels
_MAX_TANGENT = 1.0  # of the elevation, up and down, that the cylinder has
_MAX_CYLINDER_WIDTH = 2048  # of the cylinder, pixels; less for coarser cameras


class View:
    """Another camera's picture of what one camera sees."""

    def __init__(self, source: OmniCamera, target: OmniCamera) -> None:
        self._maps = unwrap_maps(source, target)
        seen = self._maps[0] > -1.0
        self.seen = None if seen.all() else seen

    def of(self, image: Image) -> Image:
        """The picture, black where the source does not see.

        A panorama's seam needs no care: its last column repeats the first.
        """
        return np.asarray(cv2.remap(image, *self._maps, cv2.INTER_LINEAR))


class OmniFeatureExtractor:
    """Extracts both kinds of features from the colour images of one camera."""

    def __init__(self, camera: OmniCamera, settings: OmniFeatureSettings) -> None:
        """Prepares views and detectors; panoramas need no unwrapping for SIFT."""
        self._camera, self._kinds = camera, settings.kinds
        resolution = pixels_a_radian(camera)
        self._sift_view: View | None = None
        if wrapping_period(camera) is None:
            width = min(_MAX_VIEW_WIDTH, round(2.0 * np.pi * resolution))
            high, low = np.deg2rad([MAX_ELEVATION_DEG, MIN_ELEVATION_DEG])
            height = round((high - low) * width / (2.0 * np.pi)) + 1
            view = Equirectangular(width, height, float(high), float(low))
            self._sift_view = View(camera, view)
            self._sift = UprightSift(view, settings.sift, self._sift_view.seen)
        else:
            self._sift = UprightSift(camera, settings.sift)
        width = min(_MAX_CYLINDER_WIDTH, round(2.0 * np.pi * resolution))
        height = round(2.0 * _MAX_TANGENT * width / (2.0 * np.pi)) + 1
        cylinder = Cylinder(width, height, -_MAX_TANGENT, _MAX_TANGENT)
        self._cylinder = View(camera, cylinder)
        self._columns = ColumnSegmentFinder(cylinder, self._cylinder.seen)

    def extract(self, image: Image) -> OmniFeatures:
        """Features of an image (height, width, 3) in R, G, B.

        A blank or dark image has none. Raises FrameError where the image is not this camera's.
        """
        return OmniFeatures(self.extract_sift(image), self.extract_columns(image))

    def extract_sift(self, image: Image) -> UprightFeatures:
        """Upright SIFT features alone; none where the settings exclude them."""
        require_own_image(self._camera, image)
        if self._kinds == "columns":
            return empty_features()
        if self._sift_view is None:
            return self._sift.extract(image)
        found = self._sift.extract(self._sift_view.of(image))
        if not len(found):
            return found
        pixels = self._camera.pixels(unit_rays(found.bearing, found.elevation))
        seen = np.isfinite(pixels).all(axis=1)
        return UprightFeatures(
            pixels[seen],
            found.bearing[seen],
            found.elevation[seen],
            found.covariance[seen],
            found.scale[seen],
            found.descriptors[seen],
            found.colour[seen],
        )

    def extract_columns(self, image: Image) -> ColumnSegments:
        """Column segments alone; none where the settings exclude them."""
        require_own_image(self._camera, image)
        if self._kinds == "sift":
            return empty_segments()
        return self._columns.extract(self._cylinder.of(image))


def pixels_a_radian(camera: OmniCamera) -> float:
    """Finer of both resolutions at the horizon, or near it where the camera does not see that far.

    Pixels a radian; the median around the camera.
    """
    around = np.linspace(-np.pi, np.pi, 72, endpoint=False)
    for elevation in np.deg2rad([0.0, -5.0, 5.0, -15.0, 15.0, -30.0, 30.0]):
        rays = np.column_stack(
            [np.cos(around), np.sin(around), np.full(len(around), np.tan(elevation))]
        )
        pixels = camera.pixels(rays)
        seen = np.isfinite(pixels).all(axis=1)
        if seen.sum() >= 3:
            up = up_in_image(camera, pixels[seen])
            along = np.hypot(*np.diff(pixels[seen], axis=0).T) / np.diff(around[seen])
            return float(max(np.nanmedian(np.hypot(up[:, 0], up[:, 1])), np.nanmedian(along)))
    raise FrameError("the camera sees nothing within 30 degrees of the horizon; check its model")
