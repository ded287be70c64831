"""The view that points are tracked in: unwrapped, continued over its seam, and held stabilised.

On an unwrapped view a turn of the robot is a shift of the whole picture. It is measured from the
picture as a whole and undone, so that what is left for the tracker are the small motions of
parallax; and since columns then stand still, hardly a point ever crosses the seam.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt
from scipy.fft import next_fast_len

from fgslam.cameras.omni import Equirectangular, Float32, OmniCamera, require_own_image, unwrap_maps
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import FrameError
from fgslam.frontend.features.colour_sift import wrapping_period
from fgslam.frontend.features.omni_features import pixels_a_radian

_BANDS = 8  # of rows, averaged, from which the common shift is estimated
_PROBED = np.deg2rad(np.arange(-89.0, 90.0, 1.0))
_HIGHEST = np.deg2rad(60.0)  # beyond, a panorama's rows are stretched many times


@dataclass(frozen=True, slots=True, eq=False)
class StabilisedImage:
    """One image's view.

    Attributes:
        grey: (height, period + 2 margin) view, its rows continued on both sides.
        bands: (bands, period) complex spectra of bands of rows, of the view *before* any shift.
        shift: columns by which the view was moved to the right, modulo the period.
        light: mean and standard deviation of the grey values.
    """

    grey: Image
    bands: npt.NDArray[np.complex128]
    shift: int
    light: tuple[float, float]


class StabilisedView:
    """Makes views of one camera's images."""

    def __init__(self, camera: OmniCamera, max_width: int, window: int, levels: int) -> None:
        self._camera = camera
        resolution = pixels_a_radian(camera)
        width = _fast_period(min(max_width, round(2.0 * np.pi * resolution)) - 1) + 1
        bottom, top = _seen_elevations(camera)
        height = max(round((top - bottom) * (width - 1) / (2.0 * np.pi)) + 1, 2)
        self.view = Equirectangular(width, height, top, bottom)
        self.margin = window * 2**levels
        self.period = width - 1
        self._maps = cv2.convertMaps(*_period_maps(camera, self.view), cv2.CV_16SC2)
        wraps = wrapping_period(camera) is not None
        self._border = cv2.BORDER_WRAP if wraps else cv2.BORDER_CONSTANT

    def grey(self, image: Image) -> Image:
        """(height, period) grey view of an image (h, w, 3) in R, G, B; not shifted.

        Raises:
            FrameError: the image is not the camera's.
        """
        require_own_image(self._camera, image)
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        view = cv2.remap(grey, *self._maps, cv2.INTER_LINEAR, borderMode=self._border)
        return np.asarray(view, dtype=np.uint8)

    def make(
        self, image: Image, before: StabilisedImage | None, max_shift: float
    ) -> StabilisedImage:
        """The view of an image, shifted as the image before was, and by the turn since.

        Args:
            image: (h, w, 3).
            before: what came before, or None.
            max_shift: largest turn, in columns.
        """
        grey = self.grey(image)
        bands = _spectra(grey)
        shift = 0
        if before is not None:
            turned = _common_shift(before.bands, bands, self.period, max_shift)
            # The picture moved right by `turned` columns: undo it on top of what was undone before.
            shift = (before.shift - turned) % self.period
        view = self._continued(grey, (-shift - self.margin) % self.period)
        mean, spread = cv2.meanStdDev(view)
        return StabilisedImage(view, bands, shift, (float(mean[0, 0]), float(spread[0, 0])))

    def _continued(self, grey: Image, first: int) -> Image:
        """(height, period + 2 margin) columns from the ``first`` on, the view over and over."""
        wanted, parts = self.period + 2 * self.margin, []
        while wanted > 0:
            parts.append(grey[:, first : first + wanted])
            wanted -= parts[-1].shape[1]
            first = 0
        return np.concatenate(parts, axis=1)

    def to_stabilised(self, pixels: FloatArray, image: StabilisedImage) -> FloatArray:
        """(n, 2) places in the padded view of places (n, 2) in the view itself."""
        columns = (pixels[:, 0] + image.shift) % self.period + self.margin
        return np.column_stack([columns, pixels[:, 1]])

    def from_stabilised(self, places: FloatArray, image: StabilisedImage) -> FloatArray:
        """The inverse of :meth:`to_stabilised`."""
        columns = (places[:, 0] - self.margin - image.shift) % self.period
        return np.column_stack([columns, places[:, 1]])


def _seen_elevations(camera: OmniCamera) -> tuple[float, float]:
    """Lowest and highest elevation that the camera sees all around, radians."""
    around = np.linspace(-np.pi, np.pi, 16, endpoint=False)
    level = np.cos(_PROBED)[:, None]
    rays = np.stack(
        [
            level * np.cos(around),
            level * np.sin(around),
            np.broadcast_to(np.sin(_PROBED)[:, None], (len(_PROBED), len(around))),
        ],
        axis=-1,
    )
    seen = np.isfinite(camera.pixels(rays.reshape(-1, 3))[:, 0]).reshape(len(_PROBED), -1)
    whole = _PROBED[np.all(seen, axis=1) & (np.abs(_PROBED) <= _HIGHEST)]
    if len(whole) < 2:
        raise FrameError("the camera sees no elevation all around; check its model and centre")
    return float(whole[0]), float(whole[-1])


def _fast_period(longest: int) -> int:
    """A period that Fourier transforms are fast for, at most a few columns shorter."""
    return next(n for n in range(longest, 0, -1) if next_fast_len(n) == n)


def _period_maps(camera: OmniCamera, view: Equirectangular) -> tuple[Float32, Float32]:
    """Maps of the view without its last column, which shows what the first does."""
    columns, rows = unwrap_maps(camera, view)
    return columns[:, :-1].copy(), rows[:, :-1].copy()


def _spectra(grey: Image) -> npt.NDArray[np.complex128]:
    """(bands, frequencies) spectra of the mean rows of bands, without their own means."""
    bands = min(_BANDS, len(grey))
    edges = [len(grey) * k // bands for k in range(bands + 1)]
    means = [
        cv2.reduce(grey[low:high], 0, cv2.REDUCE_AVG, dtype=cv2.CV_32F)
        for low, high in pairwise(edges)
    ]
    spectra = np.fft.rfft(np.concatenate(means).astype(np.float64), axis=1)
    spectra[:, 0] = 0.0
    return np.asarray(spectra)


def _common_shift(
    before: npt.NDArray[np.complex128],
    now: npt.NDArray[np.complex128],
    period: int,
    max_shift: float,
) -> int:
    """Columns by which the picture moved to the right, by phase correlation of all bands."""
    cross = now * np.conj(before)
    # Half-way between plain and phase correlation: blur and noise have no say, edges keep theirs.
    cross = np.sum(cross / np.sqrt(np.maximum(np.abs(cross), 1e-9)), axis=0)
    score = np.fft.irfft(cross, n=period)
    most = min(int(max_shift), (period - 1) // 2)
    score[most + 1 : period - most] = -np.inf
    best = int(np.argmax(score))
    return best if best <= most else best - period
