"""Textures of all places: drawn from a seed, named in libraries, packed for sampling.

Drawings are float32 in grey levels 0-255, an albedo; sides are powers of two, and those that are
tiled repeat without a seam. Grey libraries are for the lab, the office building and the corridors,
colour ones for the house; both hold scikit-image's photographs. Hues are laid over grey drawings
without changing their brightness, so that contrast is that of the drawing: a *ramp* gives each grey
level a hue of its own (books, posters, notes differ in level and hence in colour), a *tint* one hue
to all (walls, wood, cloth).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from importlib import import_module
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from fgslam.core.arrays import Float32, IntArray

Grey = npt.NDArray[np.float32]

_GLYPHS = 40


def fractal_noise(rng: np.random.Generator, shape: tuple[int, int], beta: float) -> Grey:
    """Periodic noise of spectrum 1/f^beta, zero mean, unit standard deviation."""
    rows = np.fft.fftfreq(shape[0])[:, None]
    columns = np.fft.rfftfreq(shape[1])[None, :]
    frequency = np.hypot(rows, columns)
    frequency[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.standard_normal(shape)) * frequency ** (-beta / 2.0)
    noise = np.fft.irfft2(spectrum, s=shape)
    return np.asarray(noise / noise.std(), dtype=np.float32)


def plaster(rng: np.random.Generator, size: int, base: float, scuffs: int = 60) -> Grey:
    """A painted wall: faint clouds, specks, and a few scuffs and nail holes."""
    image = base + 4.0 * fractal_noise(rng, (size, size), 2.2)
    image += 2.0 * fractal_noise(rng, (size, size), 0.6)
    marks = np.zeros((size, size), dtype=np.float32)
    for _ in range(scuffs):
        row, column = rng.integers(0, size, 2)
        height, width = rng.integers(2, 12, 2)
        marks[row : row + height, column : column + width] -= rng.uniform(15.0, 90.0)
    image += ndimage.gaussian_filter(marks, 1.0, mode="wrap")
    return np.asarray(np.clip(image, 4.0, 250.0), dtype=np.float32)


def wood(rng: np.random.Generator, size: int, base: float) -> Grey:
    """Wood grain: stretched rings with fibres and knots."""
    y, x = np.mgrid[0:size, 0:size].astype(np.float32) / size
    warp = ndimage.zoom(
        fractal_noise(rng, (size // 4, size // 4), 3.0), 4, order=1, mode="grid-wrap"
    )
    rings = np.sin(2 * np.pi * (9.0 * y + 0.35 * warp))
    fibre = ndimage.gaussian_filter1d(
        rng.standard_normal((size, size)).astype(np.float32), 12.0, axis=1, mode="wrap"
    )
    image = base * (1.0 + 0.13 * rings + 0.25 * fibre / max(float(fibre.std()), 1e-6) * 0.3)
    for row, column in rng.random((5, 2)):
        far = ((x - column + 0.5) % 1.0 - 0.5) ** 2 + 4.0 * ((y - row + 0.5) % 1.0 - 0.5) ** 2
        image *= 1.0 - 0.55 * np.exp(-far / 0.0006)
    return np.asarray(image, dtype=np.float32)


def bricks(rng: np.random.Generator, size: int, rows: int) -> Grey:
    """A brick wall; each brick of its own shade, with light mortar."""
    columns = rows // 3
    shade = 100.0 + 15.0 * rng.standard_normal((rows, columns))
    y, x = np.mgrid[0:size, 0:size] / size
    row = (y * rows).astype(int)
    along = (x * columns + 0.5 * (row % 2)) % columns
    image = shade[row, along.astype(int)] + 9.0 * fractal_noise(rng, (size, size), 1.2)
    edge_y = np.abs((y * rows) % 1.0 - 0.5) > 0.43
    edge_x = np.abs(along % 1.0 - 0.5) > 0.475
    image[edge_x | edge_y] = 132.0
    return _soft(image + 4.0 * fractal_noise(rng, (size, size), 0.8))


def carpet(rng: np.random.Generator, size: int) -> Grey:
    """Speckled floor tiles of two shades, with stains."""
    tiles = 10
    index = np.arange(size) * tiles // size
    shade = 108.0 + 10.0 * rng.standard_normal((tiles, tiles)).astype(np.float32)
    image = shade[np.ix_(index, index)] + 8.0 * fractal_noise(rng, (size, size), 0.5)
    image += 9.0 * fractal_noise(rng, (size, size), 2.4)
    seam = np.diff(index, prepend=-1) != 0
    image[seam] -= 40.0
    image[:, seam] -= 40.0
    specks = fractal_noise(rng, (size, size), 0.9) > 2.6
    image[specks] += rng.choice([-55.0, 60.0], size=int(specks.sum()))
    return _soft(image)


def ceiling(rng: np.random.Generator, size: int) -> Grey:
    """Acoustic panels: a metal grid, pinholes and fissures."""
    panels = 8
    index = np.arange(size) * panels // size
    shade = 196.0 + 7.0 * rng.standard_normal((panels, panels)).astype(np.float32)
    image = shade[np.ix_(index, index)] + 3.0 * fractal_noise(rng, (size, size), 1.0)
    fissures = fractal_noise(rng, (size, size), 1.3) > 2.1
    image[fissures] -= 70.0
    seam = np.diff(index, prepend=-1) != 0
    seam |= np.roll(seam, 1) | np.roll(seam, 2)
    image[seam] = 130.0
    image[:, seam] = 130.0
    return _soft(image)


def book_row(rng: np.random.Generator, height: int, width: int) -> Grey:
    """Book spines standing in a shelf, some leaning away into the dark, with titles and bands."""
    image = np.full((height, width), 22.0, dtype=np.float32)
    x = 4
    while x < width - 8:
        thick = int(rng.integers(width // 36, width // 11))
        if rng.random() < 0.08:
            x += thick
            continue
        top = int(rng.integers(0, height // 3))
        spine = image[top:, x : min(x + thick, width - 2)]
        spine[:] = rng.uniform(35.0, 225.0)
        _decorate_spine(rng, spine)
        x += thick + int(rng.integers(1, 4))
    return _soft(image + 3.0 * fractal_noise(rng, (height, width), 1.0))


def _decorate_spine(rng: np.random.Generator, spine: Grey) -> None:
    height, width = spine.shape
    tone = 225.0 if spine.mean() < 120.0 else 30.0
    for _ in range(int(rng.integers(1, 4))):
        row = int(rng.integers(0, max(height - 12, 1)))
        spine[row : row + int(rng.integers(3, 14))] = rng.uniform(30.0, 230.0)
    if width > 12 and rng.random() < 0.5:
        title = text_lines(rng, (width - 6, height), 1, 0.8)[:, : int(height * 0.6)].T
        row = int(height * 0.2)
        part = spine[row : row + title.shape[0], 3 : 3 + title.shape[1]]
        ink = title[: part.shape[0], : part.shape[1]]
        part[:] = part * (1.0 - ink) + tone * ink
    spine[:, :1] *= 0.5
    spine[:, -1:] *= 0.5


def binder_row(rng: np.random.Generator, height: int, width: int) -> Grey:
    """Ring binders of one make, most with a label; a gap here and there."""
    image = np.full((height, width), 30.0, dtype=np.float32)
    shade = float(rng.uniform(55.0, 150.0))
    binders = int(rng.integers(9, 13))
    edges = np.linspace(2, width - 2, binders + 1).astype(int)
    for left, right in pairwise(edges):
        if rng.random() < 0.12:
            continue
        binder = image[height // 10 :, left + 1 : right - 1]
        binder[:] = shade + float(rng.uniform(-14.0, 14.0))
        if rng.random() < 0.7:
            w, h = binder.shape[1], binder.shape[0]
            top = int(h * rng.uniform(0.15, 0.3))
            binder[top : top + int(0.35 * h), w // 4 : w - w // 4] = rng.uniform(170.0, 220.0)
        binder[
            int(0.8 * height) : int(0.86 * height), binder.shape[1] // 3 : -binder.shape[1] // 3
        ] = 35.0
    return _soft(image + 3.0 * fractal_noise(rng, (height, width), 1.0))


def text_lines(rng: np.random.Generator, shape: tuple[int, int], lines: int, fill: float) -> Grey:
    """Ink coverage 0-1 of lines of invented letters, each line filled from the left."""
    height, width = shape
    cell = max(height / (lines * 1.45), 2.0)
    glyphs = _alphabet(rng)
    out = np.zeros((height, width), dtype=np.float32)
    unit = max(int(cell / 8), 1)
    per_line = max(width // (6 * unit), 1)
    for line in range(lines):
        letters = glyphs[rng.integers(0, _GLYPHS, per_line)].copy()
        letters[rng.random(per_line) < 0.17] = 0.0
        letters[int(per_line * fill * rng.uniform(0.55, 1.0)) :] = 0.0
        strip = np.kron(np.hstack(list(letters)), np.ones((unit, unit), dtype=np.float32))
        row = int((line + 0.2) * height / lines)
        part = out[row : row + strip.shape[0], : strip.shape[1]]
        part[:] = strip[: part.shape[0], : part.shape[1]]
    return out


def _alphabet(rng: np.random.Generator) -> Grey:
    """Forty letters of 8 x 6 cells (with a margin), drawn from strokes."""
    glyphs = np.zeros((_GLYPHS, 8, 6), dtype=np.float32)
    for glyph in glyphs:
        for _ in range(int(rng.integers(2, 5))):
            if rng.random() < 0.5:
                glyph[3 * int(rng.integers(0, 3)), int(rng.integers(0, 3)) : 5] = 1.0
            else:
                glyph[int(rng.integers(0, 4)) : 7, 2 * int(rng.integers(0, 3))] = 1.0
    return glyphs


def poster(rng: np.random.Generator, height: int, width: int) -> Grey:
    """A conference poster: title, columns of text, and charts."""
    paper = np.full((height, width), float(rng.uniform(195.0, 230.0)), dtype=np.float32)
    banner = height // 7
    paper[:banner] = rng.uniform(30.0, 110.0)
    ink = text_lines(rng, (banner - 8, width - 16), 1, 1.0)
    paper[4 : banner - 4, 8 : width - 8] += ink * (215.0 - paper[4 : banner - 4, 8 : width - 8])
    rows, columns = 3, 2
    for row in range(rows):
        for column in range(columns):
            top = banner + 6 + row * (height - banner) // rows
            left = 8 + column * width // columns
            cell = paper[top : top + (height - banner) // rows - 10, left : left + width // 2 - 14]
            _fill_cell(rng, cell)
    return _soft(_framed(paper, 3, 40.0))


def pinboard(rng: np.random.Generator, size: int) -> Grey:
    """Cork with pinned notes, some over others."""
    image = 120.0 + 9.0 * fractal_noise(rng, (size, size), 0.9)
    for _ in range(11):
        h, w = (rng.uniform(0.16, 0.32, 2) * size).astype(int)
        note = _window(rng, image, h, w, 0.03, 0.95)
        note[:] = rng.uniform(150.0, 215.0)
        note[6:, 5:] -= 90.0 * text_lines(rng, (h - 6, w - 5), max(h // 16, 1), 0.9)
        note[2:6, w // 2 : w // 2 + 4] = 35.0
    return _soft(_framed(image, max(size // 40, 2), 70.0))


def _fill_cell(rng: np.random.Generator, cell: Grey) -> None:
    kind = rng.integers(0, 3)
    if kind == 0:
        ink = text_lines(rng, (cell.shape[0], cell.shape[1]), max(cell.shape[0] // 12, 1), 1.0)
        cell -= 170.0 * ink
    elif kind == 1:
        heights = rng.uniform(0.15, 0.95, 7) * cell.shape[0]
        edges = np.linspace(4, cell.shape[1] - 4, 8).astype(int)
        for left, right, tall in zip(edges[:-1], edges[1:], heights, strict=True):
            cell[-int(tall) :, left + 2 : right - 2] = rng.uniform(30.0, 190.0)
    else:
        y, x = np.mgrid[0 : cell.shape[0], 0 : cell.shape[1]]
        cell[:] = 120.0
        for _ in range(9):
            row, column = rng.random(2) * cell.shape
            radius = rng.uniform(4.0, 0.3 * min(cell.shape))
            cell[np.hypot(y - row, x - column) < radius] = rng.uniform(20.0, 240.0)


def screen(rng: np.random.Generator, height: int, width: int) -> Grey:
    """A monitor: windows with title bars, text and a terminal; a dark frame around."""
    image = 70.0 + 12.0 * fractal_noise(rng, (height, width), 2.5)
    for _ in range(4):
        h, w = int(rng.uniform(0.3, 0.6) * height), int(rng.uniform(0.3, 0.55) * width)
        window = _window(rng, image, h, w, 0.05, 0.9)
        dark = rng.random() < 0.5
        window[:] = 28.0 if dark else 215.0
        ink = text_lines(rng, (h - 12, w - 8), max(h // 14, 1), 0.9)
        window[12:, 4 : w - 4] += ink * (150.0 if dark else -165.0)
        window[:9] = rng.uniform(90.0, 190.0)
    return _soft(_framed(image, max(height // 28, 2), 24.0))


def keyboard(rng: np.random.Generator, height: int, width: int) -> Grey:
    """Keys on a dark board."""
    y, x = np.mgrid[0:height, 0:width]
    row, column = y * 6 // height, x * 18 // width
    inside = ((y * 6.0 / height) % 1.0 < 0.8) & ((x * 18.0 / width) % 1.0 < 0.82)
    shade = rng.uniform(150.0, 215.0, (6, 18))
    return _soft(np.where(inside, shade[row, column], 45.0))


def carton(rng: np.random.Generator, size: int, base: float) -> Grey:
    """A cardboard box: tape, a label with text and a bar code, arrows."""
    image = base + 6.0 * fractal_noise(rng, (size, size), 1.8)
    image[:, int(size * 0.46) : int(size * 0.54)] += 38.0
    top, left = (rng.uniform(0.1, 0.5, 2) * size).astype(int)
    h, w = int(size * 0.3), int(size * 0.42)
    label = image[top : top + h, left : left + w]
    label[:] = 225.0
    label[4:, 4:] -= 180.0 * text_lines(rng, (h - 4, w - 4), 5, 1.0)
    code = np.repeat(rng.random(w // 3) < 0.5, 3)[: w - 8]
    label[-int(h * 0.3) : -4, 4 : 4 + len(code)] = np.where(code, 25.0, 225.0)
    for _ in range(3):
        row, column = (rng.uniform(0.05, 0.85, 2) * size).astype(int)
        image[row : row + size // 10, column : column + size // 28] = 50.0
        image[row : row + size // 40, column - size // 40 : column + size // 16] = 50.0
    return _soft(image)


def cloth(rng: np.random.Generator, size: int, base: float) -> Grey:
    """Patterned fabric: checks, folds and a print."""
    y, x = np.mgrid[0:size, 0:size].astype(np.float32) / size
    checks = np.sign(np.sin(2 * np.pi * 6 * x)) + np.sign(np.sin(2 * np.pi * 6 * y))
    image = base * (1.0 + 0.08 * checks + 0.10 * fractal_noise(rng, (size, size), 2.5))
    prints = fractal_noise(rng, (size, size), 3.2) > 1.4
    image[prints] = 235.0 - image[prints]
    return _soft(image)


def metal(rng: np.random.Generator, size: int, base: float) -> Grey:
    """Painted steel with drawers, handles, dents and stickers."""
    image = base + 4.0 * fractal_noise(rng, (size, size), 2.0)
    for k in range(4):
        top = k * size // 4
        image[top : top + 4] -= 60.0
        image[top + size // 12 : top + size // 8, int(size * 0.42) : int(size * 0.58)] = 45.0
        row, column = top + int(size * 0.15), int(rng.uniform(0.05, 0.7) * size)
        sticker = image[row : row + size // 14, column : column + size // 6]
        sticker[:] = 220.0
        sticker -= 170.0 * text_lines(rng, (sticker.shape[0], sticker.shape[1]), 2, 1.0)
    return _soft(image)


def window_view(rng: np.random.Generator, height: int, width: int) -> Grey:
    """A window onto roofs and trees, with a frame and a cross bar."""
    y = np.linspace(0.0, 1.0, height, dtype=np.float32)[:, None]
    image = 235.0 - 40.0 * y + 8.0 * fractal_noise(rng, (height, width), 2.8)
    for _ in range(12):
        left, w = int(rng.uniform(0, 0.9) * width), int(rng.uniform(0.08, 0.25) * width)
        top = int(rng.uniform(0.35, 0.75) * height)
        image[top:, left : left + w] = rng.uniform(50.0, 170.0)
        image[top + 4 :: 9, left + 3 : left + w - 3 : 1] -= 25.0
    trees = fractal_noise(rng, (height, width), 1.8) + 3.0 * (y - 0.75) > 0.3
    image[trees & (y > 0.5)] = 55.0
    image += 5.0 * fractal_noise(rng, (height, width), 1.0)
    bar = max(width // 40, 2)
    _framed(image, bar, 205.0)
    image[:, width // 2 - bar : width // 2 + bar] = 205.0
    return _soft(image)


def panelled(rng: np.random.Generator, height: int, width: int, base: float) -> Grey:
    """A door with four panels, a handle and a sign."""
    image = base + 5.0 * fractal_noise(rng, (height, width), 1.8)
    for top in (0.08, 0.55):
        for left in (0.12, 0.55):
            r0, c0 = int(top * height), int(left * width)
            panel = image[r0 : r0 + int(0.37 * height), c0 : c0 + int(0.33 * width)]
            panel -= 28.0
            panel[4:-4, 4:-4] += 40.0
    image[int(0.5 * height) : int(0.53 * height), int(0.88 * width) : int(0.97 * width)] = 40.0
    sign = image[int(0.3 * height) : int(0.36 * height), int(0.3 * width) : int(0.7 * width)]
    sign[:] = 225.0
    sign -= 180.0 * text_lines(rng, (sign.shape[0], sign.shape[1]), 2, 1.0)
    return _soft(image)


def wallpaper(rng: np.random.Generator, size: int, base: float, scuffs: int = 60) -> Grey:
    """Striped paper with small faded flowers, on top of plaster."""
    image = plaster(rng, size, base, scuffs)
    x = np.arange(size) / size
    image += 7.0 * np.sign(np.sin(2 * np.pi * 16 * x)).astype(np.float32)[None, :]
    y, z = np.mgrid[0:size, 0:size] / size
    petals = np.hypot((16 * z) % 1.0 - 0.5, (12 * y) % 1.0 - 0.5) < 0.14
    image[petals] -= 16.0
    return image


def abstract(rng: np.random.Generator, side: int) -> Grey:
    """An abstract picture: blots, bars and discs of many levels."""
    noise = fractal_noise(rng, (side, side), float(rng.uniform(2.2, 3.4)))
    image = 120.0 + 45.0 * noise
    y, x = np.mgrid[0:side, 0:side] / side
    for _ in range(int(rng.integers(8, 18))):
        row, column, wide, high = rng.random(4)
        level = rng.uniform(30.0, 225.0)
        if rng.random() < 0.5:
            inside = np.hypot(y - row, x - column) < 0.03 + 0.16 * wide
        else:
            tall = np.abs(y - row) < 0.02 + 0.2 * high
            inside = tall & (np.abs(x - column) < 0.02 + 0.2 * wide)
        image[inside] = level + 6.0 * noise[inside]
    return np.asarray(image, dtype=np.float32)


def _framed(image: Grey, width: int, level: float | Grey) -> Grey:
    """The image with a border so wide, drawn into it."""
    for part in (image[:width], image[-width:], image[:, :width], image[:, -width:]):
        part[:] = level
    return image


def _window(rng: np.random.Generator, image: Grey, h: int, w: int, low: float, high: float) -> Grey:
    """A part of the image (h, w), somewhere between two shares of its free height and width."""
    top = int(rng.uniform(low, high) * (image.shape[0] - h))
    left = int(rng.uniform(low, high) * (image.shape[1] - w))
    return image[top : top + h, left : left + w]


def _soft(image: npt.NDArray[np.floating]) -> Grey:
    """Clipped to grey levels and slightly smoothed: nothing is sharper than its own texels."""
    clipped = np.clip(image, 4.0, 250.0).astype(np.float32)
    return np.asarray(ndimage.gaussian_filter(clipped, 0.6, mode="wrap"), dtype=np.float32)


# --------------------------------------------------------------------------------------------
# The named textures of every place, each library drawn from one seed


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
    families: tuple[tuple[str, int, Callable[[], Grey], float], ...] = (
        ("books", BOOK_ROWS, lambda: book_row(rng, 256, 1024), 0.42),
        ("binders", BINDER_ROWS, lambda: binder_row(rng, 256, 1024), 0.7),
        ("poster", POSTERS, lambda: poster(rng, 512, 512), 0.42),
        ("pinboard", PINBOARDS, lambda: pinboard(rng, 256), 0.45),
        ("screen", SCREENS, lambda: screen(rng, 256, 256), 0.5),
        ("carton", CARTONS, lambda: carton(rng, 256, float(rng.uniform(95.0, 165.0))), 0.55),
    )
    for family, count, draw, contrast in families:
        out |= {f"{family}_{i}": faded(draw(), contrast) for i in range(count)}
    return out | {f"photo_{name}": faded(photograph(name, 512), 0.55) for name in PHOTOGRAPHS}


def _materials(rng: np.random.Generator) -> dict[str, Grey]:
    return {
        "plaster": plaster(rng, 1024, 178.0),
        "plaster_dark": plaster(rng, 1024, 140.0),
        "bricks": bricks(rng, 1024, 30),
        "floor": carpet(rng, 2048),
        "ceiling": ceiling(rng, 1024),
        "wood_light": faded(wood(rng, 512, 150.0), 0.6),
        "wood_dark": wood(rng, 512, 88.0),
        "wood_desk": faded(wood(rng, 512, 145.0), 0.5),
        "metal": faded(metal(rng, 512, 150.0), 0.6),
        "metal_dark": metal(rng, 512, 92.0),
        "keyboard": keyboard(rng, 64, 128),
        "cloth": cloth(rng, 256, 95.0),
        "shirt": cloth(rng, 256, 150.0),
        "trousers": faded(cloth(rng, 256, 60.0), 0.3),
        "skin": faded(plaster(rng, 64, 165.0), 0.25),
        "window": window_view(rng, 512, 512),
        "door": panelled(rng, 512, 256, 125.0),
        "plain_dark": plaster(rng, 256, 42.0),
        "plain_light": plaster(rng, 256, 215.0),
        "lamp": np.full((16, 16), 235.0, dtype=np.float32),
    }


def photograph(name: str, side: int) -> Grey:
    """One of scikit-image's photographs as (side, side) grey levels with a white margin."""
    image = _picture(name)
    if image.ndim == 3:
        image = image[..., :3] @ np.array([0.299, 0.587, 0.114])
    return _printed(image, side)


def colour_photograph(name: str, side: int) -> Grey:
    """The same in colour, (side, side, 3) levels of red, green, blue; grey where it is grey."""
    image = np.atleast_3d(_picture(name))
    channels = [_printed(image[..., min(k, image.shape[2] - 1)], side) for k in range(3)]
    return np.stack(channels, axis=-1)


def _picture(name: str) -> npt.NDArray[np.generic]:
    picture = getattr(import_module("skimage.data"), name)()
    return np.asarray(picture[0] if isinstance(picture, tuple) else picture)


def _printed(picture: npt.NDArray[np.generic], side: int) -> Grey:
    """(side, side), bilinear after the low-pass that shrinking needs, with a white margin."""
    image = picture.astype(np.float32)
    factor = np.array(image.shape) / side
    smooth = ndimage.gaussian_filter(image, np.maximum(factor - 1.0, 0.0) * 0.5)
    rows = np.clip((np.arange(side) + 0.5) * factor[0] - 0.5, 0, image.shape[0] - 1)
    columns = np.clip((np.arange(side) + 0.5) * factor[1] - 0.5, 0, image.shape[1] - 1)
    grid = np.meshgrid(rows, columns, indexing="ij")
    out = np.asarray(ndimage.map_coordinates(smooth, grid, order=1, mode="nearest"))
    return np.clip(_framed(out, side // 40, 228.0), 8.0, 245.0)


def faded(image: Grey, contrast: float) -> Grey:
    """The texture with its contrast about the mean reduced to this fraction."""
    mean = float(image.mean())
    return np.asarray(mean + contrast * (image - mean), dtype=np.float32)


# --------------------------------------------------------------------------------------------
# The office building and the corridors: a cover for each room, and many pictures


PICTURES, CORRIDOR_PICTURES = 240, 5
_SCUFFS = 800  # on 41 square metres
FLOORS = ("floor", "floor_1", "floor_2", "floor_3")


def building_library(rng: np.random.Generator) -> dict[str, Grey]:
    """Every texture of the office building, by name."""
    out = build_library(rng)
    for i, base in enumerate((185.0, 150.0, 170.0, 132.0, 195.0, 160.0)):
        out[f"wall_{i}"] = plaster(rng, 1024, base, scuffs=_SCUFFS)
    for i, base in enumerate((165.0, 140.0, 182.0)):
        out[f"paper_{i}"] = wallpaper(rng, 1024, base, scuffs=_SCUFFS)
    out["bricks_dark"] = bricks(rng, 1024, 21) - np.float32(28.0)
    for name in FLOORS[1:]:
        out[name] = carpet(rng, 1024)
    for i in range(PICTURES):
        out[f"picture_{i}"] = _building_picture(rng, i)
    return out


def corridor_library(rng: np.random.Generator) -> dict[str, Grey]:
    """Every texture of the corridors that look alike, by name."""
    out = build_library(rng)
    out["wall_0"] = plaster(rng, 1024, 185.0, scuffs=_SCUFFS)
    out["floor_1"] = carpet(rng, 1024)
    for i in range(CORRIDOR_PICTURES):
        out[f"picture_{i}"] = _building_picture(rng, i)
    return out


def _building_picture(rng: np.random.Generator, number: int) -> Grey:
    """Prints, pinboards and paintings in turn, with more contrast than the lab's."""
    kind = number % 5
    if kind in (0, 2):
        return faded(poster(rng, 256, 256), 0.75)
    if kind in (1, 3):
        return faded(pinboard(rng, 256), 0.8)
    return faded(abstract(rng, 256), 0.8)


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
    out = ramped(rng, abstract(rng, side), 0.75)
    frame = np.array(rng.choice([[52.0, 40.0, 30.0], [215.0, 205.0, 190.0], [120.0, 90.0, 45.0]]))
    return _framed(out, max(side // 24, 2), frame)


def build_colour_library(rng: np.random.Generator) -> dict[str, Colour]:
    """Every texture of the house, by name; sides are powers of two."""
    out = _colour_materials(rng)
    for i in range(SHIRTS):
        red, blue = rng.uniform(-0.4, 0.6), rng.uniform(-0.5, 0.5)
        out[f"shirt_{i}"] = tinted(cloth(rng, 128, 130.0), float(red), float(blue))
    families: tuple[tuple[str, int, Callable[[], Grey], float], ...] = (
        ("books", BOOK_ROWS, lambda: book_row(rng, 128, 512), 0.55),
        ("binders", BINDER_ROWS, lambda: binder_row(rng, 128, 512), 0.5),
        ("poster", POSTERS, lambda: poster(rng, 256, 256), 0.45),
        ("screen", SCREENS, lambda: screen(rng, 128, 128), 0.4),
    )
    for family, count, draw, saturation in families:
        for i in range(count):
            out[f"{family}_{i}"] = ramped(rng, draw(), saturation)
    for i in range(CARTONS):
        box = carton(rng, 128, float(rng.uniform(95.0, 165.0)))
        out[f"carton_{i}"] = tinted(box, 0.22, -0.35)
    out |= {f"painting_{i}": painting(rng, 256) for i in range(PAINTINGS)}
    return out | {f"photo_{name}": colour_photograph(name, 256) for name in PHOTOGRAPHS}


def _colour_materials(rng: np.random.Generator) -> dict[str, Colour]:
    return {
        "parquet": tinted(wood(rng, 512, 120.0), 0.28, -0.45),
        "carpet": tinted(carpet(rng, 512), 0.10, 0.12),
        "ceiling": tinted(ceiling(rng, 512), 0.0, -0.03),
        "wood_light": tinted(wood(rng, 256, 150.0), 0.22, -0.40),
        "wood_dark": tinted(wood(rng, 256, 80.0), 0.40, -0.45),
        "wood_desk": tinted(wood(rng, 256, 140.0), 0.15, -0.30),
        "metal": tinted(metal(rng, 256, 150.0), -0.06, 0.10),
        "metal_dark": tinted(metal(rng, 256, 92.0), -0.05, 0.15),
        "keyboard": tinted(keyboard(rng, 64, 128), 0.0, 0.0),
        "cloth": tinted(cloth(rng, 256, 95.0), -0.35, 0.7),
        "cloth_red": tinted(cloth(rng, 256, 85.0), 0.9, -0.2),
        "cloth_green": tinted(cloth(rng, 256, 95.0), -0.45, -0.3),
        "window": ramped(rng, window_view(rng, 256, 256), 0.35),
        "door": tinted(panelled(rng, 256, 128, 125.0), 0.15, -0.25),
        "plain_dark": tinted(plaster(rng, 128, 42.0), 0.0, 0.05),
        "plain_light": tinted(plaster(rng, 128, 215.0), 0.0, 0.0),
        "lamp": np.full((16, 16, 3), 235.0, dtype=np.float32),
        # One cover for each room and the corridor.
        "wall_cream": tinted(plaster(rng, 512, 185.0), 0.06, -0.22),
        "wall_white": tinted(plaster(rng, 512, 200.0), 0.0, -0.04),
        "wall_blue": tinted(plaster(rng, 512, 150.0), -0.22, 0.30),
        "wall_green": tinted(wallpaper(rng, 512, 150.0), -0.18, -0.15),
        "wall_rose": tinted(wallpaper(rng, 512, 160.0), 0.25, 0.0),
        "wall_ochre": tinted(plaster(rng, 512, 150.0), 0.28, -0.5),
        "bricks": tinted(bricks(rng, 512, 30), 0.55, -0.25),
        "skin": tinted(plaster(rng, 64, 165.0), 0.22, -0.25),
        "trousers": tinted(cloth(rng, 128, 60.0), -0.1, 0.5),
    }


Int32 = npt.NDArray[np.int32]
Packed = npt.NDArray[np.int64]

# --------------------------------------------------------------------------------------------
# Packed with their mip-map pyramids, sampled trilinearly by vectorised gathers


# Sharper than the textbook's choice, whose tent of two texels is wider than a pixel.
_LOD_BIAS = np.float32(-0.35)


class _Corners(NamedTuple):
    """Where the four texels around each point lie, and how far the point is right and below."""

    upper_left: Int32
    upper_right: Int32
    lower_left: Int32
    lower_right: Int32
    right: Float32
    below: Float32


class TextureBank(ABC):
    """All textures of a world in one array; sides are powers of two, and textures repeat.

    Attributes:
        channels: of a texel; textures are (h, w) for one, else (h, w, channels).
        index: number of each texture by name.
        full_width, full_height: (n,) texels of the finest level.
    """

    channels: int

    def __init__(self, textures: Mapping[str, Float32]) -> None:
        """Packs textures, levels 0 to 255, in the mapping's order.

        Raises:
            ValueError: a side is no power of two.
        """
        self.index = {name: i for i, name in enumerate(textures)}
        pyramids = [_pyramid(texture) for texture in textures.values()]
        self._levels = max(len(pyramid) for pyramid in pyramids)
        rows = len(pyramids) * self._levels
        self._offset, self._width, self._height = (np.ones(rows, dtype=np.int32) for _ in range(3))
        parts: list[npt.NDArray[Any]] = []
        start = 0
        for i, pyramid in enumerate(pyramids):
            for level in range(self._levels):
                row, image = i * self._levels + level, pyramid[min(level, len(pyramid) - 1)]
                self._height[row], self._width[row] = image.shape[:2]
                self._offset[row] = self._offset[row - 1] if level >= len(pyramid) else start
                if level < len(pyramid):
                    parts.append(self._packed(image).ravel())
                    start += len(parts[-1])
        self._texels: npt.NDArray[Any] = np.concatenate(parts)
        self.full_width = self._width[:: self._levels].astype(np.float64)
        self.full_height = self._height[:: self._levels].astype(np.float64)

    def indices(self, names: tuple[str, ...]) -> IntArray:
        """(n,) number of each name. Raises KeyError for a texture that the bank lacks."""
        return np.array([self.index[name] for name in names], dtype=np.int64)

    def sample(self, texture: Int32, u: Float32, v: Float32, footprint: Float32) -> Float32:
        """(channels, n) levels at texture coordinates, filtered over a pixel's footprint.

        Args:
            texture: (n,) number of the texture.
            u: (n,) coordinate to the right, 1 per copy of the texture.
            v: (n,) coordinate downwards, likewise.
            footprint: (n,) width of the pixel in texels of the finest level.
        """
        lod = np.log2(np.maximum(footprint, np.float32(1e-6))) + _LOD_BIAS
        np.clip(lod, 0.0, self._levels - 1.001, out=lod)
        level = lod.astype(np.int32)
        finer = texture * np.int32(self._levels) + level
        near, far = self._corners(finer, u, v), self._corners(finer + np.int32(1), u, v)
        return self._mixed(near, far, lod - level)

    @staticmethod
    @abstractmethod
    def _packed(image: Float32) -> npt.NDArray[Any]:
        """(h, w) one number a texel."""

    @abstractmethod
    def _mixed(self, near: _Corners, far: _Corners, fraction: Float32) -> Float32:
        """(channels, n) bilinear at both levels, ``fraction`` (n,) of the way to the coarser."""

    def _corners(self, row: Int32, u: Float32, v: Float32) -> _Corners:
        """The texels around points at one level; ``row`` (n,) picks texture and level."""
        width, height = self._width.take(row), self._height.take(row)
        x, y = u * width - np.float32(0.5), v * height - np.float32(0.5)
        x_floor, y_floor = np.floor(x), np.floor(y)
        x0, y0 = x_floor.astype(np.int32), y_floor.astype(np.int32)
        last_x, last_y = width - np.int32(1), height - np.int32(1)
        x1, y1 = (x0 + np.int32(1)) & last_x, (y0 + np.int32(1)) & last_y
        x0 &= last_x
        y0 &= last_y
        offset = self._offset.take(row)
        top, bottom = offset + y0 * width, offset + y1 * width
        return _Corners(top + x0, top + x1, bottom + x0, bottom + x1, x - x_floor, y - y_floor)


class GreyBank(TextureBank):
    """Grey textures; texels are 16-bit fixed point: half the memory traffic of float32."""

    channels = 1
    _FIXED = 256.0  # steps a grey level: an error of 1/512

    @staticmethod
    def _packed(image: Float32) -> npt.NDArray[np.uint16]:
        return np.round(image * GreyBank._FIXED).astype(np.uint16)

    def _mixed(self, near: _Corners, far: _Corners, fraction: Float32) -> Float32:
        fine, coarse = self._bilinear(near), self._bilinear(far)
        mixed = (fine + fraction * (coarse - fine)) * np.float32(1.0 / self._FIXED)
        return np.asarray(mixed[None])

    def _bilinear(self, at: _Corners) -> Float32:
        texels = self._texels
        a, b = texels.take(at.upper_left), texels.take(at.upper_right)
        c, d = texels.take(at.lower_left), texels.take(at.lower_right)
        upper = a + at.right * (b.astype(np.float32) - a)
        lower = c + at.right * (d.astype(np.float32) - c)
        return np.asarray(upper + at.below * (lower - upper))


class ColourBank(TextureBank):
    """Colour textures, packed so that one gather fetches a whole texel.

    A texel is one 64-bit integer with red, green and blue in lanes of 21 bits. The eight texels
    that trilinear filtering mixes are added with integer weights that sum to 2^13: as
    255 * 2^13 < 2^21, no lane runs over into its neighbour, and three channels cost as much as one.
    """

    channels = 3
    _LANE = 21
    _MASK = np.int64((1 << 21) - 1)
    _WEIGHTS = 8192.0

    @staticmethod
    def _packed(image: Float32) -> Packed:
        levels, lane = np.round(image).astype(np.int64), ColourBank._LANE
        return np.asarray(levels[..., 0] | levels[..., 1] << lane | levels[..., 2] << (2 * lane))

    def _mixed(self, near: _Corners, far: _Corners, fraction: Float32) -> Float32:
        coarse = fraction * np.float32(self._WEIGHTS)
        total = self._bilinear(near, np.float32(self._WEIGHTS) - coarse)
        total += self._bilinear(far, coarse)
        out = np.empty((3, len(total)), dtype=np.float32)
        out[0] = total & self._MASK
        out[1] = (total >> self._LANE) & self._MASK
        out[2] = total >> (2 * self._LANE)
        out *= np.float32(1.0 / self._WEIGHTS)
        return out

    def _bilinear(self, at: _Corners, weight: Float32) -> Packed:
        """(n,) packed sums, the four weights adding to ``weight``."""
        right, below = at.right, at.below * weight
        lower_right = right * below
        upper_right = right * weight - lower_right
        lower_left = below - lower_right
        upper_left = weight - right * weight - lower_left
        texels = self._texels
        total = texels.take(at.upper_left) * _rounded(upper_left)
        total += texels.take(at.upper_right) * _rounded(upper_right)
        total += texels.take(at.lower_left) * _rounded(lower_left)
        total += texels.take(at.lower_right) * _rounded(lower_right)
        return np.asarray(total)


def _rounded(weight: Float32) -> Packed:
    # Eight roundings add at most 4 to the sum of the weights, for which the lanes have room.
    return (weight + np.float32(0.5)).astype(np.int32).astype(np.int64)


def _pyramid(texture: Float32) -> list[Float32]:
    """The texture and its halvings by 2 x 2 means, down to one texel."""
    height, width = texture.shape[:2]
    if height & (height - 1) or width & (width - 1):
        raise ValueError(f"texture sides must be powers of two, got {width} x {height}")
    out = [np.clip(texture, 0.0, 255.0).astype(np.float32)]
    while out[-1].shape[0] * out[-1].shape[1] > 1:
        image = out[-1]
        if image.shape[0] > 1:
            image = 0.5 * (image[0::2] + image[1::2])
        if image.shape[1] > 1:
            image = 0.5 * (image[:, 0::2] + image[:, 1::2])
        out.append(image)
    return out
