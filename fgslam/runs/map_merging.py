"""Merges two saved maps, as ``fgslam merge`` does."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fgslam.core.errors import MapError
from fgslam.core.geometry import so3_log
from fgslam.core.saved_map import load_map, require_rig, save_map
from fgslam.frontend.places.map_alignment import align_maps
from fgslam.frontend.places.map_fusion import merge_maps

_SEED = 0  # the same maps give the same bytes


def merge_files(first: Path, second: Path, out: Path, overwrite: bool = False) -> list[str]:
    """Lays the second map onto the first and writes both as one; lines about what was found.

    Raises:
        MapError: one is no map, another rig made it, they do not overlap or that is ambiguous, or
            ``out`` is there already.
        OutputError: the map cannot be written.
    """
    if out.exists() and not overwrite:
        raise MapError(f"{out}: is there already; choose another --out, or add --overwrite")
    a, b = load_map(first), load_map(second)
    require_rig(b, a.rig, str(second))
    rng = np.random.default_rng(_SEED)
    found = align_maps(a, b, rng, f"{first} and {second}")
    merged = merge_maps(a, b, found)
    size = save_map(merged, out)
    x, y, z = found.aTb[:3, 3]
    turn = np.degrees(np.linalg.norm(so3_log(found.aTb[:3, :3])))
    return [
        f"{second} lies at ({x:.3f}, {y:.3f}, {z:.3f}) m, turned by {turn:.2f} deg, in {first}",
        f"{found.agreeing} of {found.candidates} landmarks that look alike agree, {found.second} "
        "with the second-best alignment elsewhere",
        f"{len(found.pairs)} landmarks fused, residual {100.0 * found.residual_m:.2f} cm rms "
        f"({found.residual_sigmas:.2f} sigma); {found.found} of the {found.among} that lie among "
        "the first map's were found there",
        f"{out}: {len(merged)} landmarks of {len(a)} and {len(b)}, {size / 1e6:.2f} MB",
    ]
