"""The named textures of every place, each library drawn from one seed.

Grey ones for the lab, the office building and the corridors, colour ones for the house, and
scikit-image's photographs. Hues are laid over grey drawings without changing their brightness, so
that contrast is that of the drawing: a *ramp* gives each grey level a hue of its own (books,
posters, notes differ in level and hence in colour), a *tint* one hue to all (walls, wood, cloth).
"""

from __future__ import annotations

from collections.abc import Callable
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


# --------------------------------------------------------------------------------------------
# The office building and the corridors: a cover for each room, and many pictures


PICTURES, CORRIDOR_PICTURES = 240, 5
_SCUFFS = 800  # on 41 square metres
FLOORS = ("floor", "floor_1", "floor_2", "floor_3")


def building_library(rng: np.random.Generator) -> dict[str, Grey]:
    """Every texture of the office building, by name."""
    out = build_library(rng)
    for i, base in enumerate((185.0, 150.0, 170.0, 132.0, 195.0, 160.0)):
        out[f"wall_{i}"] = textures.plaster(rng, 1024, base, scuffs=_SCUFFS)
    for i, base in enumerate((165.0, 140.0, 182.0)):
        out[f"paper_{i}"] = textures.wallpaper(rng, 1024, base, scuffs=_SCUFFS)
    out["bricks_dark"] = textures.bricks(rng, 1024, 21) - np.float32(28.0)
    for name in FLOORS[1:]:
        out[name] = textures.carpet(rng, 1024)
    for i in range(PICTURES):
        out[f"picture_{i}"] = _building_picture(rng, i)
    return out


def corridor_library(rng: np.random.Generator) -> dict[str, Grey]:
    """Every texture of the corridors that look alike, by name."""
    out = build_library(rng)
    out["wall_0"] = textures.plaster(rng, 1024, 185.0, scuffs=_SCUFFS)
    out["floor_1"] = textures.carpet(rng, 1024)
    for i in range(CORRIDOR_PICTURES):
        out[f"picture_{i}"] = _building_picture(rng, i)
    return out


def _building_picture(rng: np.random.Generator, number: int) -> Grey:
    """Prints, pinboards and paintings in turn, with more contrast than the lab's."""
    kind = number % 5
    if kind in (0, 2):
        return faded(textures.poster(rng, 256, 256), 0.75)
    if kind in (1, 3):
        return faded(textures.pinboard(rng, 256), 0.8)
    return faded(textures.abstract(rng, 256), 0.8)


# --------------------------------------------------------------------------------------------
# The house, in colour


Colour = npt.NDArray[np.float32]

PAINTINGS, SHIRTS = 16, 4

# Two directions in (red, green, blue) that leave the brightness 0.299 R + 0.587 G + 0.114 B alone.
_TO_RED = np.array([1.0, -0.299 / 0.587, 0.0])
_TO_BLUE = np.array([0.0, -0.114 / 0.587, 1.0])
_RAMP_KNOTS = 12


def tinted(grey: Grey, red: float, blue: float) -> Colour:
    """(h, w, 3) of one hue: ``red`` and ``blue`` are excesses relative to the brightness."""
    hue = 1.0 + red * _TO_RED + blue * _TO_BLUE
    return np.clip(grey[..., None] * hue, 0.0, 255.0).astype(np.float32)


def ramped(rng: np.random.Generator, grey: Grey, saturation: float) -> Colour:
    """(h, w, 3) whose hue depends on the grey level; near white it fades as on printed paper."""
    knots = rng.uniform(-saturation, saturation, (2, _RAMP_KNOTS))
    at = np.linspace(0.0, 255.0, _RAMP_KNOTS)
    level = np.arange(256.0)
    fade = 1.0 - 0.9 * (level / 255.0) ** 2
    red, blue = (np.interp(level, at, knot) * fade for knot in knots)
    hue = 1.0 + red[:, None] * _TO_RED + blue[:, None] * _TO_BLUE
    chosen = hue[np.clip(grey, 0.0, 255.0).astype(np.int64)]
    return np.asarray(np.clip(grey[..., None] * chosen, 0.0, 255.0), dtype=np.float32)


def painting(rng: np.random.Generator, side: int) -> Colour:
    """An abstract picture of many colours in a dark or light frame."""
    out = ramped(rng, textures.abstract(rng, side), 0.75)
    edge = max(side // 24, 2)
    frame = np.array(rng.choice([[52.0, 40.0, 30.0], [215.0, 205.0, 190.0], [120.0, 90.0, 45.0]]))
    for part in (out[:edge], out[-edge:], out[:, :edge], out[:, -edge:]):
        part[:] = frame
    return out


def build_colour_library(rng: np.random.Generator) -> dict[str, Colour]:
    """Every texture of the house, by name; sides are powers of two."""
    out = _colour_materials(rng) | _wall_covers(rng) | _clothes(rng)
    families: tuple[tuple[str, int, Callable[[], Grey], float], ...] = (
        ("books", BOOK_ROWS, lambda: textures.book_row(rng, 128, 512), 0.55),
        ("binders", BINDER_ROWS, lambda: textures.binder_row(rng, 128, 512), 0.5),
        ("poster", POSTERS, lambda: textures.poster(rng, 256, 256), 0.45),
        ("screen", SCREENS, lambda: textures.screen(rng, 128, 128), 0.4),
    )
    for family, count, draw, saturation in families:
        for i in range(count):
            out[f"{family}_{i}"] = ramped(rng, draw(), saturation)
    for i in range(CARTONS):
        carton = textures.carton(rng, 128, float(rng.uniform(95.0, 165.0)))
        out[f"carton_{i}"] = tinted(carton, 0.22, -0.35)
    for i in range(PAINTINGS):
        out[f"painting_{i}"] = painting(rng, 256)
    for name in PHOTOGRAPHS:
        out[f"photo_{name}"] = colour_photograph(name, 256)
    return out


def _colour_materials(rng: np.random.Generator) -> dict[str, Colour]:
    return {
        "parquet": tinted(textures.wood(rng, 512, 120.0), 0.28, -0.45),
        "carpet": tinted(textures.carpet(rng, 512), 0.10, 0.12),
        "ceiling": tinted(textures.ceiling(rng, 512), 0.0, -0.03),
        "wood_light": tinted(textures.wood(rng, 256, 150.0), 0.22, -0.40),
        "wood_dark": tinted(textures.wood(rng, 256, 80.0), 0.40, -0.45),
        "wood_desk": tinted(textures.wood(rng, 256, 140.0), 0.15, -0.30),
        "metal": tinted(textures.metal(rng, 256, 150.0), -0.06, 0.10),
        "metal_dark": tinted(textures.metal(rng, 256, 92.0), -0.05, 0.15),
        "keyboard": tinted(textures.keyboard(rng, 64, 128), 0.0, 0.0),
        "cloth": tinted(textures.cloth(rng, 256, 95.0), -0.35, 0.7),
        "cloth_red": tinted(textures.cloth(rng, 256, 85.0), 0.9, -0.2),
        "cloth_green": tinted(textures.cloth(rng, 256, 95.0), -0.45, -0.3),
        "window": ramped(rng, textures.window_view(rng, 256, 256), 0.35),
        "door": tinted(textures.panelled(rng, 256, 128, 125.0), 0.15, -0.25),
        "plain_dark": tinted(textures.plaster(rng, 128, 42.0), 0.0, 0.05),
        "plain_light": tinted(textures.plaster(rng, 128, 215.0), 0.0, 0.0),
        "lamp": np.full((16, 16, 3), 235.0, dtype=np.float32),
    }


def _wall_covers(rng: np.random.Generator) -> dict[str, Colour]:
    """One cover for each room and the corridor."""
    return {
        "wall_cream": tinted(textures.plaster(rng, 512, 185.0), 0.06, -0.22),
        "wall_white": tinted(textures.plaster(rng, 512, 200.0), 0.0, -0.04),
        "wall_blue": tinted(textures.plaster(rng, 512, 150.0), -0.22, 0.30),
        "wall_green": tinted(textures.wallpaper(rng, 512, 150.0), -0.18, -0.15),
        "wall_rose": tinted(textures.wallpaper(rng, 512, 160.0), 0.25, 0.0),
        "wall_ochre": tinted(textures.plaster(rng, 512, 150.0), 0.28, -0.5),
        "bricks": tinted(textures.bricks(rng, 512, 30), 0.55, -0.25),
    }


def _clothes(rng: np.random.Generator) -> dict[str, Colour]:
    out = {
        "skin": tinted(textures.plaster(rng, 64, 165.0), 0.22, -0.25),
        "trousers": tinted(textures.cloth(rng, 128, 60.0), -0.1, 0.5),
    }
    for i in range(SHIRTS):
        red, blue = rng.uniform(-0.4, 0.6), rng.uniform(-0.5, 0.5)
        out[f"shirt_{i}"] = tinted(textures.cloth(rng, 128, 130.0), float(red), float(blue))
    return out
