"""The named colour textures of the house: the lab's grey drawings with hues, and photographs.

Hues are laid over grey drawings without changing their brightness, so that contrast is that of the
drawing: a *ramp* gives each grey level a hue of its own (books, posters, notes differ in level and
hence in colour), a *tint* one hue to all (walls, wood, cloth).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from fgslam.worlds.rendering import textures
from fgslam.worlds.rendering.texture_library import (
    BINDER_ROWS,
    BOOK_ROWS,
    CARTONS,
    PHOTOGRAPHS,
    POSTERS,
    SCREENS,
    colour_photograph,
)
from fgslam.worlds.rendering.textures import Grey

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
    out = _materials(rng) | _walls(rng) | _clothes(rng)
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


def _materials(rng: np.random.Generator) -> dict[str, Colour]:
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


def _walls(rng: np.random.Generator) -> dict[str, Colour]:
    """One cover for each room and the corridor; :mod:`house` names them."""
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
