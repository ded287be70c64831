"""Effects of a real camera on rendered images: gain, noise, and a cover before the lens.

Each image has its own random generator, so that any can be had alone and always the same.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import Image
from fgslam.worlds.settings import LabEffectsSettings

Float32 = npt.NDArray[np.float32]

_COVER_SEED = 7
# The camera's automatic exposure: a slow wave of the gain, half a minute at two frames a second,
# and a sudden jump half way through the paper's drive.
WAVE, WAVE_FRAMES = 0.15, 60.0
JUMP, JUMP_FRAME = 0.7, 125
BLUR_RENDERS = 5  # a frame with motion blur: more look the same at 8 bits


def noisy(levels: Float32, sigma: float, seed: tuple[int, ...]) -> Float32:
    """Levels with Gaussian noise; the seed names the image, so that it is always the same."""
    if sigma == 0.0:
        return levels
    rng = np.random.Generator(np.random.SFC64(seed))
    noise = rng.standard_normal(levels.shape, dtype=np.float32)
    noise *= np.float32(sigma)
    noise += levels
    return noise


def exposure_gain(index: int) -> float:
    """Gain of frame ``index``: a slow wave, and a factor from the jump on."""
    wave = 1.0 + WAVE * np.sin(2.0 * np.pi * index / WAVE_FRAMES)
    return float(wave * (JUMP if index >= JUMP_FRAME else 1.0))


def is_blocked(settings: LabEffectsSettings, index: int) -> bool:
    """Whether the cover is on the cameras in frame ``index``."""
    blocked = settings.blocked_frames
    return blocked is not None and blocked[0] <= index < blocked[1]


def cover(shape: tuple[int, ...]) -> Float32:
    """A dark cloth right before the lens: nearly black, blurred blotches; images (k, h, w)."""
    rng = np.random.default_rng(_COVER_SEED)
    coarse = rng.random((shape[0], 4, 5)).astype(np.float32)
    rows = np.linspace(0, 2.999, shape[1], dtype=np.float32)
    columns = np.linspace(0, 3.999, shape[2], dtype=np.float32)
    r, c = rows.astype(int), columns.astype(int)
    fr, fc = (rows - r)[None, :, None], (columns - c)[None, None, :]
    upper = coarse[:, r][:, :, c] * (1 - fc) + coarse[:, r][:, :, c + 1] * fc
    lower = coarse[:, r + 1][:, :, c] * (1 - fc) + coarse[:, r + 1][:, :, c + 1] * fc
    return np.asarray(6.0 + 9.0 * (upper * (1 - fr) + lower * fr), dtype=np.float32)


def apply_effects(
    clean: Image, settings: LabEffectsSettings, index: int, seed: int
) -> tuple[Image, ...]:
    """Images as the camera delivers them.

    Args:
        clean: (k, h, w) rendered images of one frame.
        settings: the effects; motion blur and the person are in the render already.
        index: the recording's frame number.
        seed: of the recording; frame and seed together determine the noise.
    """
    gain = exposure_gain(index) if settings.exposure else 1.0
    if is_blocked(settings, index):
        grey = cover(clean.shape)
    elif gain == 1.0 and settings.noise_grey == 0.0:
        return tuple(clean)
    else:
        grey = clean.astype(np.float32)
    if gain != 1.0:
        grey *= np.float32(gain)
    grey = noisy(grey, settings.noise_grey, (seed, index, 0))
    # Adding one half before the cut to integers rounds; it is faster than np.rint and clip.
    grey += np.float32(0.5)
    np.clip(grey, 0.0, 255.0, out=grey)
    return tuple(grey.astype(np.uint8))
