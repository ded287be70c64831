"""Procedural grey textures: noise, wood, bricks, books, text, screens, floors and ceilings.

Each returns float32 in grey levels 0-255 as an albedo; sides are powers of two, and those that
are tiled repeat without a seam.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy import ndimage

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
                glyph[int(rng.choice([0, 3, 6])), int(rng.integers(0, 3)) : 5] = 1.0
            else:
                glyph[int(rng.integers(0, 4)) : 7, int(rng.choice([0, 2, 4]))] = 1.0
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
    paper[:3], paper[-3:], paper[:, :3], paper[:, -3:] = 40.0, 40.0, 40.0, 40.0
    return _soft(paper)


def pinboard(rng: np.random.Generator, size: int) -> Grey:
    """Cork with pinned notes, some over others."""
    image = 120.0 + 9.0 * fractal_noise(rng, (size, size), 0.9)
    for _ in range(11):
        h, w = (rng.uniform(0.16, 0.32, 2) * size).astype(int)
        top, left = (
            int(rng.uniform(0.03, 0.95) * (size - h)),
            int(rng.uniform(0.03, 0.95) * (size - w)),
        )
        note = image[top : top + h, left : left + w]
        note[:] = rng.uniform(150.0, 215.0)
        note[6:, 5:] -= 90.0 * text_lines(rng, (h - 6, w - 5), max(h // 16, 1), 0.9)
        image[top + 2 : top + 6, left + w // 2 : left + w // 2 + 4] = 35.0
    edge = max(size // 40, 2)
    image[:edge], image[-edge:], image[:, :edge], image[:, -edge:] = 70.0, 70.0, 70.0, 70.0
    return _soft(image)


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
        top, left = (
            int(rng.uniform(0.05, 0.9) * (height - h)),
            int(rng.uniform(0.05, 0.9) * (width - w)),
        )
        dark = rng.random() < 0.5
        window = image[top : top + h, left : left + w]
        window[:] = 28.0 if dark else 215.0
        ink = text_lines(rng, (h - 12, w - 8), max(h // 14, 1), 0.9)
        window[12:, 4 : w - 4] += ink * (150.0 if dark else -165.0)
        window[:9] = rng.uniform(90.0, 190.0)
    edge = max(height // 28, 2)
    image[:edge], image[-edge:], image[:, :edge], image[:, -edge:] = 24.0, 24.0, 24.0, 24.0
    return _soft(image)


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
    for part in (image[:, :bar], image[:, -bar:], image[:bar], image[-bar:]):
        part[:] = 205.0
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


def _soft(image: npt.NDArray[np.floating]) -> Grey:
    """Clipped to grey levels and slightly smoothed: nothing is sharper than its own texels."""
    clipped = np.clip(image, 4.0, 250.0).astype(np.float32)
    return np.asarray(ndimage.gaussian_filter(clipped, 0.6, mode="wrap"), dtype=np.float32)
