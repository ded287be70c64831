"""The named textures of the lab, all drawn from one seed, and scikit-image's photographs."""

from __future__ import annotations

from importlib import import_module

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from fgslam.worlds.rendering import textures
from fgslam.worlds.rendering.textures import Grey

# Photographs inside scikit-image's wheel: reading them needs neither a download nor pooch.
PHOTOGRAPHS = (
    "camera",
    "astronaut",
    "coffee",
    "chelsea",
    "rocket",
    "coins",
    "hubble_deep_field",
    "page",
    "immunohistochemistry",
    "stereo_motorcycle",
    "text",
)

BOOK_ROWS, BINDER_ROWS, POSTERS, PINBOARDS, SCREENS, CARTONS = 14, 10, 8, 5, 8, 8


def build_library(rng: np.random.Generator) -> dict[str, Grey]:
    """Every texture of the lab, by name; sides are powers of two."""
    out = _materials(rng)
    for i in range(BOOK_ROWS):
        out[f"books_{i}"] = faded(textures.book_row(rng, 256, 1024), 0.42)
    for i in range(BINDER_ROWS):
        out[f"binders_{i}"] = faded(textures.binder_row(rng, 256, 1024), 0.7)
    for i in range(POSTERS):
        out[f"poster_{i}"] = faded(textures.poster(rng, 512, 512), 0.42)
    for i in range(PINBOARDS):
        out[f"pinboard_{i}"] = faded(textures.pinboard(rng, 256), 0.45)
    for i in range(SCREENS):
        out[f"screen_{i}"] = faded(textures.screen(rng, 256, 256), 0.5)
    for i in range(CARTONS):
        out[f"carton_{i}"] = faded(textures.carton(rng, 256, float(rng.uniform(95.0, 165.0))), 0.55)
    for name in PHOTOGRAPHS:
        out[f"photo_{name}"] = faded(photograph(name, 512), 0.55)
    return out


def _materials(rng: np.random.Generator) -> dict[str, Grey]:
    return {
        "plaster": textures.plaster(rng, 1024, 178.0),
        "plaster_dark": textures.plaster(rng, 1024, 140.0),
        "bricks": textures.bricks(rng, 1024, 30),
        "floor": textures.carpet(rng, 2048),
        "ceiling": textures.ceiling(rng, 1024),
        "wood_light": faded(textures.wood(rng, 512, 150.0), 0.6),
        "wood_dark": textures.wood(rng, 512, 88.0),
        "wood_desk": faded(textures.wood(rng, 512, 145.0), 0.5),
        "metal": faded(textures.metal(rng, 512, 150.0), 0.6),
        "metal_dark": textures.metal(rng, 512, 92.0),
        "keyboard": textures.keyboard(rng, 64, 128),
        "cloth": textures.cloth(rng, 256, 95.0),
        "shirt": textures.cloth(rng, 256, 150.0),
        "trousers": faded(textures.cloth(rng, 256, 60.0), 0.3),
        "skin": faded(textures.plaster(rng, 64, 165.0), 0.25),
        "window": textures.window_view(rng, 512, 512),
        "door": textures.panelled(rng, 512, 256, 125.0),
        "plain_dark": textures.plaster(rng, 256, 42.0),
        "plain_light": textures.plaster(rng, 256, 215.0),
        "lamp": np.full((16, 16), 235.0, dtype=np.float32),
    }


def photograph(name: str, side: int) -> Grey:
    """One of scikit-image's photographs as (side, side) grey levels with a white margin."""
    image = _picture(name)
    if image.ndim == 3:
        image = image[..., :3] @ np.array([0.299, 0.587, 0.114])
    return _framed(_resized(image.astype(np.float32), side))


def colour_photograph(name: str, side: int) -> Grey:
    """The same in colour, (side, side, 3) levels of red, green, blue; grey where it is grey."""
    image = _picture(name)
    channels = [image] * 3 if image.ndim == 2 else [image[..., k] for k in range(3)]
    return np.stack([_framed(_resized(c.astype(np.float32), side)) for c in channels], axis=-1)


def _picture(name: str) -> npt.NDArray[np.generic]:
    picture = getattr(import_module("skimage.data"), name)()
    return np.asarray(picture[0] if isinstance(picture, tuple) else picture)


def faded(image: Grey, contrast: float) -> Grey:
    """The texture with its contrast about the mean reduced to this fraction."""
    mean = float(image.mean())
    return np.asarray(mean + contrast * (image - mean), dtype=np.float32)


def _resized(image: Grey, side: int) -> Grey:
    """Bilinear, after the low-pass that shrinking needs."""
    factor = np.array(image.shape) / side
    smooth = ndimage.gaussian_filter(image, np.maximum(factor - 1.0, 0.0) * 0.5)
    rows = np.clip((np.arange(side) + 0.5) * factor[0] - 0.5, 0, image.shape[0] - 1)
    columns = np.clip((np.arange(side) + 0.5) * factor[1] - 0.5, 0, image.shape[1] - 1)
    grid = np.meshgrid(rows, columns, indexing="ij")
    return np.asarray(ndimage.map_coordinates(smooth, grid, order=1, mode="nearest"))


def _framed(image: npt.NDArray[np.float32]) -> Grey:
    margin = image.shape[0] // 40
    for part in (image[:margin], image[-margin:], image[:, :margin], image[:, -margin:]):
        part[:] = 228.0
    return np.clip(image, 8.0, 245.0)
