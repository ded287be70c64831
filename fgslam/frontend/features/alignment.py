"""Kernel that moves and deforms patches until they fit a view: inverse compositional alignment.

With b and G of a patch (:mod:`fgslam.frontend.features.anchoring`), and the grey values s that the
view shows where its map A puts its pixels (Baker and Matthews 2004)::

    p = sum w b s
    (offset, gain) = (G_light + flat)^-1 p_light        light by the first look; G_light (2, 2)
    r = (s - offset) / gain - f                         what remains;
    sum w b r = (p - offset G_1) / gain - G_f           columns of G: no second pass over pixels
    (t, D) = (G + prior)^-1 sum w b r                   move and deformation
    A <- A (I + D)^-1,  place <- place - A t
    correlation = 1 / sqrt(1 + |r|^2 / |f - mean|^2)    before the move, weighted
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fgslam.core.arrays import Float32, FloatArray
from fgslam.core.kernels import Kernel
from fgslam.frontend.features.anchoring import (
    FLAT,
    TERMS,
    every_term,
    offsets,
    remapped,
    sample,
    weighted_terms,
)

_GAIN = (0.2, 5.0)  # of light against the first patch; beyond, it is another thing
_FARTHEST_PX = 4.0  # of one alignment; the tracker was closer than this, or elsewhere


def _align(  # noqa: PLR0913  kernels take plain arrays
    grey: Any, scale: int, cut: Any, weight: Any, gram: Any, inverse: Any, times: int,
    maps: Any, places: Any, correlation: Any, room: Any, seen: Any,
) -> None:  # fmt: skip
    pixels, size = len(weight), int(math.sqrt(len(weight)))
    p, q = room[pixels], room[pixels + 1]
    for n in range(len(cut)):
        weighted_terms(cut, n, size, weight, room)
        g, inv, a = gram[n], inverse[n], maps[n]
        contrast = max(math.sqrt(max(g[1, 1] / g[0, 0] - (g[0, 1] / g[0, 0]) ** 2, 0.0)), FLAT)
        for _ in range(times):
            sample(grey, scale, places[n], a, size, seen)
            # One by one, in registers: an array's would be stored at each pixel.
            square = p0 = p1 = p2 = p3 = p4 = p5 = p6 = p7 = 0.0
            for k in range(pixels):
                s, b = seen[k], room[k]
                square += weight[k] * s * s
                p0, p1, p2, p3 = p0 + b[0] * s, p1 + b[1] * s, p2 + b[2] * s, p3 + b[3] * s
                p4, p5, p6, p7 = p4 + b[4] * s, p5 + b[5] * s, p6 + b[6] * s, p7 + b[7] * s
            p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7] = p0, p1, p2, p3, p4, p5, p6, p7
            n00, n01, n11 = g[0, 0] + FLAT, g[0, 1], g[1, 1] + FLAT
            det = n00 * n11 - n01 * n01
            offset, light = (n11 * p[0] - n01 * p[1]) / det, (n00 * p[1] - n01 * p[0]) / det
            gain = min(max(light, _GAIN[0]), _GAIN[1])
            rest = (square - 2.0 * offset * p[0] + offset * offset * g[0, 0]) / (gain * gain)
            rest += g[1, 1] - 2.0 * (p[1] - offset * g[0, 1]) / gain
            unlike = math.sqrt(max(rest, 0.0) / g[0, 0]) / contrast
            for i in range(TERMS):
                q[i] = (p[i] - offset * g[i, 0]) / gain - g[i, 1]
            for i in range(2, TERMS):
                p[i] = 0.0
                for j in range(TERMS):
                    p[i] += inv[i, j] * q[j]
            d00, d01, d10, d11 = 1.0 + p[4], p[5], p[6], 1.0 + p[7]
            det = d00 * d11 - d01 * d10
            b00, b01 = (a[0, 0] * d11 - a[0, 1] * d10) / det, (a[0, 1] * d00 - a[0, 0] * d01) / det
            b10, b11 = (a[1, 0] * d11 - a[1, 1] * d10) / det, (a[1, 1] * d00 - a[1, 0] * d01) / det
            x, y = -(b00 * p[2] + b01 * p[3]), -(b10 * p[2] + b11 * p[3])
            correlation[n] = -1.0
            if _GAIN[0] < light < _GAIN[1] and math.sqrt(x * x + y * y) < _FARTHEST_PX:
                correlation[n] = 1.0 / math.sqrt(1.0 + unlike * unlike)
                a[0, 0], a[0, 1], a[1, 0], a[1, 1] = b00, b01, b10, b11
                places[n, 0] += x
                places[n, 1] += y


def _align_numpy(  # noqa: PLR0913
    grey: Float32, scale: int, cut: Float32, weight: FloatArray, gram: FloatArray,
    inverse: FloatArray, times: int, maps: FloatArray, places: FloatArray,
    correlation: FloatArray, *rooms: Any,
) -> None:  # fmt: skip
    size = int(math.sqrt(len(weight)))
    x, y = offsets(size)
    middle = np.s_[:, 1:-1, 1:-1]
    first_look = cut.reshape(-1, size + 2, size + 2)[middle].reshape(len(cut), size**2)
    weighted = weight * every_term(cut, size)
    one, first = gram[:, :, 0], gram[:, :, 1]
    total = one[:, 0]
    contrast = np.sqrt(np.maximum(first[:, 1] / total - (one[:, 1] / total) ** 2, 0.0))
    light = np.linalg.inv(gram[:, :2, :2] + FLAT * np.eye(2))
    for _ in range(times):
        columns = places[:, :1] + maps[:, 0, :1] * x + maps[:, 0, 1:] * y
        rows = places[:, 1:] + maps[:, 1, :1] * x + maps[:, 1, 1:] * y
        seen = remapped(grey, scale * columns, scale * rows).astype(np.float64)
        p = (weighted @ seen[:, :, None])[:, :, 0]
        offset, found = (light @ p[:, :2, None])[:, :, 0].T
        gain = np.clip(found, *_GAIN)
        rest = (seen - offset[:, None]) / gain[:, None] - first_look
        unlike = np.sqrt((rest * rest) @ weight / total) / np.maximum(contrast, FLAT)
        of_rest = (p - offset[:, None] * one) / gain[:, None] - first
        change = (inverse @ of_rest[:, :, None])[:, :, 0]
        with np.errstate(all="ignore"):  # crushed to nothing by one step: lost
            a, b, c, d = 1.0 + change[:, 4], change[:, 5], change[:, 6], 1.0 + change[:, 7]
            inverted = np.array([[d, -b], [-c, a]]) / (a * d - b * c)
            moved = maps @ inverted.transpose(2, 0, 1)
            move = -(moved @ change[:, 2:4, None])[:, :, 0]
        good = (found > _GAIN[0]) & (found < _GAIN[1])
        good &= np.hypot(move[:, 0], move[:, 1]) < _FARTHEST_PX
        correlation[:] = np.where(good, 1.0 / np.hypot(1.0, unlike), -1.0)
        maps[good], places[good] = moved[good], places[good] + move[good]


align_patches = Kernel(
    _align,
    _align_numpy,
    "f4[:,::1] i8 f4[:,::1] f8[::1] f8[:,:,::1] f8[:,:,::1] i8 f8[:,:,::1] f8[:,::1] f8[::1] "
    "f8[:,::1] f8[::1]",
    sample,
    weighted_terms,
)
"""(grey, scale, cut, weight (m,), gram, inverse, times, maps, places, correlation, room (m + 2, 8),
(m,)):
maps (n, 2, 2) and places (n, 2) after so many steps, in place, and correlations (n,)."""
