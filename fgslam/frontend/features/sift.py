"""SIFT features of a frame's images, found in parallel (Se et al. 2.1)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.linalg import hadamard

from fgslam.core.arrays import ByteArray, Float32, FloatArray, Image, IntArray
from fgslam.core.errors import ConfigError, FrameError
from fgslam.core.types import PATCH_PX, Features
from fgslam.frontend.settings import Appearance, SiftSettings

SCALE_LEVELS = 8  # searched, finest first, as in the paper
OCTAVE_LAYERS = 2  # levels an octave: a factor of 1.41; the paper's is 1.5
EDGE_THRESHOLD = 10.0  # ratio of principal curvatures above which edges go: OpenCV's own
_NOISE_ANSWER = 0.4
"""Contrast that 1 of 100 features of white noise exceed at the first level, in the noise's sigmas.

Found on noise, base sigma 1.6 and two levels an octave; it is smaller for others, and falls with
the scale."""
_WHITE = 255.0
_NOISE_CONTRAST = OCTAVE_LAYERS * _NOISE_ANSWER / _WHITE
"""OpenCV's contrast threshold that such features just pass, in the noise's sigmas."""
_ENOUGH = 400
"""Features of an image, or one a patch's area where these are fewer (more would overlap): of links
between views some tenth is recognised, and a pose by fewer than 40 landmarks is poor."""


class SiftExtractor:
    """Finds SIFT features; keeps the finest levels of the pyramid.

    The first level is that of the doubled image, as Lowe proposed. Up-scaling is precise: without
    it OpenCV's key points are a quarter of a pixel off in both axes.
    """

    def __init__(self, settings: SiftSettings, appearance: Appearance) -> None:
        """OpenCV's own threads are switched off, images run in parallel."""
        cv2.setNumThreads(1)
        self._settings = settings
        self._describe = appearance == "descriptor"

    def extract(self, image: Image) -> Features:
        """Features of one grey image (height, width), in OpenCV's order, which is repeatable.

        With ``contrast: relative`` those that the image would have if it were well exposed and not
        too noisy, without what is likely to be noise. One that is so is taken as it is. Where they
        are few, its strongest ones, down to the noise.
        """
        share, noise = 1.0, 0.0
        if self._settings.contrast == "relative":
            share, noise = contrast_share(image), noise_sigma(image)
            image = smoothed(image, noise)
        threshold, by_noise = share * self._settings.contrast_threshold, noise * (share < 1.0)
        found = self._found(image, threshold, by_noise, self._settings.max_features)
        most = min(_ENOUGH, image.size // PATCH_PX**2, self._settings.max_features or _ENOUGH)
        if len(found) < most and 0.0 < _NOISE_CONTRAST * noise < threshold:
            found = self._found(image, _NOISE_CONTRAST * noise, noise, most)
        return found

    def _found(self, image: Image, contrast: float, noise: float, most: int) -> Features:
        """Features of the levels searched that answer more than noise of that sigma would."""
        blur = self._settings.base_sigma_px
        sift = cv2.SIFT.create(most, OCTAVE_LAYERS, contrast, EDGE_THRESHOLD, blur, cv2.CV_8U, True)
        # One call for both: two calls would build the pyramid twice.
        if self._describe:
            keypoints, computed = sift.detectAndCompute(image, None)
        else:
            keypoints, computed = sift.detect(image, None), None
        if computed is None:
            computed = np.zeros((len(keypoints), 128), np.uint8)
        # Column by column: half the time of one row a key point.
        packed = np.array([kp.octave for kp in keypoints], np.int64)  # octave and layer
        octave = ((packed & 255) ^ 128) - 128  # signed
        level = (octave + 1) * OCTAVE_LAYERS + ((packed >> 8) & 255) - 1  # 0: the finest
        by_noise = _NOISE_ANSWER * noise * 2.0 ** (-level / OCTAVE_LAYERS)
        response = np.array([kp.response for kp in keypoints])
        keep = (level < SCALE_LEVELS) & (_WHITE * response >= by_noise)
        xy = np.asarray(cv2.KeyPoint.convert(keypoints), np.float64).reshape(-1, 2)
        return Features(
            xy=xy[keep],
            scale=0.5 * np.array([kp.size for kp in keypoints])[keep],
            orientation=np.deg2rad(np.array([kp.angle for kp in keypoints])[keep]),
            descriptors=np.asarray(computed, np.uint8)[keep],
        )


# ------------------------------------------------------------------------------------------
# What an image's exposure leaves of its contrast: the measure that detection is relative to

_GREY_LEVELS = 256
_TAILS = (0.01, 0.99)  # a lamp and its reflection are not what an image is exposed for
_FULL_RANGE = 170.0
"""Grey levels between the tails of a well exposed image: two thirds of the scale."""
_LAPLACIAN = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
_ANSWERS = 8 * 255 + 1  # different sizes that its answers can have
_LAPLACIAN_GAIN = 6.0  # deviation of its answer to white noise of deviation one
_MEDIAN_OF_NORMAL = 0.6745  # median of a standard normal variable's absolute value
_ROUNDING = 12.0**-0.5  # deviation of what rounding to grey levels adds
GREY_NOISE = 4.0
"""Sigma of a grey value that the front-end reckons with: noise, and what no affine map does."""
_SMOOTHING = 2.0 ** np.arange(-1.0, 1.25, 0.25)  # pixels


def contrast_share(image: Image) -> float:
    """Contrast of a grey image (height, width) against a well exposed one's, in [0, 1].

    The grey levels that all but the darkest and the brightest hundredth of the pixels lie in. An
    image that fills two thirds of the scale has the share 1, one of half the light half of it.
    """
    low, high = np.searchsorted(_up_to(image, _GREY_LEVELS), np.array(_TAILS) * image.size)
    return float(min(1.0, (high - low) / _FULL_RANGE))


def noise_sigma(image: Image) -> float:
    """Deviation of a grey image's noise, grey levels; at least that of rounding.

    From the answers to the difference of two Laplacians, which is blind to edges that are straight
    (Immerkaer 1996); by their median instead of their mean, so that texture counts little.
    """
    answers = np.abs(cv2.filter2D(image, cv2.CV_16S, _LAPLACIAN))[1:-1, 1:-1]
    if answers.size == 0:
        return _ROUNDING
    counts = _up_to(answers.astype(np.uint16), _ANSWERS)
    ranks = np.array([(answers.size - 1) // 2, answers.size // 2])
    median = float(np.searchsorted(counts, ranks, side="right").mean())
    return max(median / (_MEDIAN_OF_NORMAL * _LAPLACIAN_GAIN), _ROUNDING)


def smoothed(image: Image, noise: float) -> Image:
    """The image by the Gaussian that brings it nearest to what it is without noise of that sigma.

    One with no more noise than :data:`GREY_NOISE` stays as it is. The mean squared distance from
    the image without noise is estimated without knowing that (Stein 1981): of an image y smoothed
    to G y, with a kernel of g in its middle, by ``mean (y - G y)^2 + noise^2 (2 g - 1)``.
    """
    nearest, least = image, noise**2
    for sigma in _SMOOTHING.tolist() if noise > GREY_NOISE else ():
        reach = math.ceil(3.0 * sigma)
        kernel = cv2.getGaussianKernel(2 * reach + 1, sigma)
        now = cv2.sepFilter2D(image, -1, kernel, kernel)
        moved = cv2.norm(image, now, cv2.NORM_L2SQR) / image.size
        risk = moved + noise**2 * (2.0 * float(kernel[reach, 0]) ** 2 - 1.0)
        if risk >= least:
            break
        nearest, least = np.asarray(now, np.uint8), risk
    return nearest


def _up_to(values: Image | npt.NDArray[np.uint16], levels: int) -> IntArray:
    """(levels,) how many values are at most 0, 1 and so on: exact, and without sorting."""
    counts = cv2.calcHist([values], [0], None, (levels,), (0, levels))
    return np.cumsum(counts, dtype=np.int64)


# ------------------------------------------------------------------------------------------
# Descriptors of any kind as the bytes that matching compares, at the distances that they had

PLACES = 128
_NORM = 512.0 / np.sqrt(2.0)
"""Two unrelated signed vectors of this norm are as far apart as two of SIFT's, about 512."""
_MIDDLE = 128.0


def as_bytes(given: npt.NDArray[Any]) -> ByteArray:
    """Descriptors (n, 128) uint8 of descriptors (n, d).

    Args:
        given: uint8 with d = 128: bytes of a norm of about 512, as they are. Other uint8: packed
            bits, as OpenCV's ORB, BRISK and AKAZE give them; or bool: bits. All other numbers:
            vectors that are compared by their direction.

    Raises:
        ConfigError: there are not n rows of numbers, or one is not finite.
    """
    if given.ndim != 2 or given.shape[1] == 0:
        raise ConfigError(
            f"features: descriptors has shape {given.shape}; give a row for each feature"
        )
    if given.dtype == np.uint8 and given.shape[1] == PLACES:
        return given
    if given.dtype == np.uint8:
        return _spread(_signs(np.unpackbits(given, axis=1)))
    if given.dtype == np.bool_:
        return _spread(_signs(given))
    if given.dtype.kind not in "iuf":
        raise ConfigError(f"features: descriptors are {given.dtype}; give numbers or bits")
    vectors = given.astype(np.float64)
    if not np.isfinite(vectors).all():
        raise ConfigError("features: descriptors are not finite; give numbers")
    norms = np.linalg.norm(vectors, axis=1, keepdims=True)
    return _spread(vectors / np.where(norms > 0.0, norms, 1.0))


def _signs(bits: npt.NDArray[Any]) -> FloatArray:
    """Unit vectors (n, d) of bits (n, d)."""
    return np.asarray((2.0 * bits - 1.0) / np.sqrt(bits.shape[1]))


def _spread(vectors: FloatArray) -> ByteArray:
    turned = vectors @ _transform(vectors.shape[1])
    return np.asarray(np.clip(np.rint(_MIDDLE + _NORM * turned), 0, 255), np.uint8)


@cache
def _transform(width: int) -> FloatArray:
    """(d, 128), which keeps lengths: random signs, then columns of a Hadamard matrix."""
    order = max(PLACES, 1 << (width - 1).bit_length())
    rng = np.random.default_rng(0)
    signs = rng.choice([-1.0, 1.0], width)
    columns = rng.permutation(order)[:PLACES]
    chosen = hadamard(order)[:width, columns] / np.sqrt(PLACES)
    return np.asarray(signs[:, None] * chosen)


# ------------------------------------------------------------------------------------------
# An image with the values halfway between its pixels, to be sampled at fractions of them

PER_PIXEL = 2
"""Values of a fine image along a pixel of its image."""
_HALFWAY = np.array([3.0, -25.0, 150.0, 150.0, -25.0, 3.0]) / 256.0
_HERE = np.ones(1)
_BEFORE = 2  # of the six pixels: those before the one that the place lies behind


@dataclass(eq=False)
class FineImage:
    """A grey image (h, w) uint8, and what is found of it when needed."""

    image: Image

    @cached_property
    def quiet(self) -> Image:
        """The image, smoothed where it is noisy."""
        return smoothed(self.image, noise_sigma(self.image))

    @cached_property
    def grey(self) -> Float32:
        """(2 h - 1, 2 w - 1) with the values halfway between pixels.

        The pixel (column, row) is at (2 column, 2 row).
        """
        height, width = self.quiet.shape
        values = self.quiet.astype(np.float32)  # not rounded: a dark image has few grey values
        out = np.empty((PER_PIXEL * height - 1, PER_PIXEL * width - 1), np.float32)
        out[::2, ::2] = values
        out[::2, 1::2] = _filtered(values, across=True, down=False)[:, :-1]
        out[1::2, ::2] = _filtered(values, across=False, down=True)[:-1]
        out[1::2, 1::2] = _filtered(values, across=True, down=True)[:-1, :-1]
        return out


def _filtered(values: Float32, *, across: bool, down: bool) -> Float32:
    """Values (h, w) half a pixel to the right, below, or both."""
    anchor = (_BEFORE if across else 0, _BEFORE if down else 0)
    along, below = (_HALFWAY if one else _HERE for one in (across, down))
    found = cv2.sepFilter2D(
        values, cv2.CV_32F, along, below, anchor=anchor, borderType=cv2.BORDER_REPLICATE
    )
    return np.asarray(found, np.float32)


# ------------------------------------------------------------------------------------------
# Grey and colour 8-bit images from what cameras and image libraries give

_CHANNELS = (1, 3, 4)


def grey_image(image: npt.ArrayLike, name: str = "image") -> Image:
    """The image in grey, (height, width) uint8, contiguous; the same input gives the same bytes.

    Colour is weighted as in ITU-R BT.601 (0.299 R + 0.587 G + 0.114 B). Of uint16 the upper eight
    bits are kept, whatever the image holds: stretching each image to its own contrast would change
    its features from frame to frame. Scale 10- and 12-bit images to 16 bits first.

    Args:
        image: (height, width) grey, or (height, width, 1, 3 or 4) grey, RGB or RGBA; uint8 or
            uint16; any memory layout. Not changed, and not copied where it is grey, uint8 and
            contiguous already.
        name: of the image in messages.

    Raises:
        FrameError: another type or shape.
    """
    array = _checked(as_array(image, name), name)
    if array.dtype == np.uint16:
        array = (array >> 8).astype(np.uint8)
    if array.ndim == 2:
        return np.ascontiguousarray(array, np.uint8)
    if array.shape[2] == 1:
        return np.ascontiguousarray(array[:, :, 0], np.uint8)
    code = cv2.COLOR_RGB2GRAY if array.shape[2] == 3 else cv2.COLOR_RGBA2GRAY
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(array), code), np.uint8)


def colour_image(image: npt.ArrayLike, size: tuple[int, int], name: str = "image") -> Image:
    """The image in colour, (height, width, 3) uint8 in red, green, blue, contiguous.

    A grey image gets three equal channels: its features are found, their colours tell nothing.

    Args:
        image: (height, width) grey, or (height, width, 3) RGB; uint8; any memory layout. Not
            changed, and not copied where it is colour and contiguous already.
        size: width and height of the camera's images.
        name: of the image in messages.

    Raises:
        FrameError: another type, shape or size.
    """
    array = as_array(image, name)
    wanted = (size[1], size[0])
    if array.dtype != np.uint8:
        raise FrameError(
            f"{name} is of type {array.dtype}; give uint8 (a float image in 0 to 1: "
            "(255 * image).astype(numpy.uint8))"
        )
    if array.shape not in (wanted, (*wanted, 3)):
        raise FrameError(
            f"{name} has shape {array.shape}, but the camera's images are {wanted} in grey or "
            f"{(*wanted, 3)} in red, green, blue; scale it, or take the calibration for its size"
        )
    if array.ndim == 2:
        array = np.repeat(array[:, :, None], 3, axis=2)
    return np.ascontiguousarray(array)


def as_array(image: npt.ArrayLike, name: str) -> npt.NDArray[Any]:
    """The image as an array, of any type and shape. Raises FrameError where it has none."""
    if image is None:
        raise FrameError(f"{name} is missing (None); could its file be read?")
    if isinstance(image, str | bytes | Path):
        raise FrameError(f"{name} is a {type(image).__name__}; give its pixels as an array")
    try:
        return np.asarray(image)
    except (TypeError, ValueError):
        raise FrameError(f"{name} has rows of different lengths; give one array") from None


def _checked(array: npt.NDArray[Any], name: str) -> npt.NDArray[Any]:
    if array.dtype not in (np.uint8, np.uint16):
        raise FrameError(
            f"{name} is of type {array.dtype}; give uint8 or uint16 (a float image in 0 to 1: "
            "(255 * image).astype(numpy.uint8))"
        )
    grey = array.ndim == 2
    colour = array.ndim == 3 and array.shape[2] in _CHANNELS
    if not (grey or colour) or 0 in array.shape:
        raise FrameError(
            f"{name} has shape {array.shape}; give (height, width), or (height, width, 3) in red, "
            "green, blue"
        )
    return array
