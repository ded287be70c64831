"""The saved map, one file: landmarks with appearances and counts, and the drive that made them.

docs/concepts/maps.md has its table. The same map gives the same bytes, and a file is written whole
or not at all.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.core.arrays import BoolArray, ByteArray, FloatArray, IntArray
from fgslam.core.errors import MapError
from fgslam.core.log import rig_fault
from fgslam.core.sensors import CameraRig
from fgslam.core.store import FileKind, require_ascending, require_covariances, require_finite
from fgslam.core.types import (
    CUT_PIXELS,
    LandmarkAppearances,
    LandmarkMap,
    LandmarkPatches,
    Trajectory,
)

_SAME_RIG = 1e-6  # relative: the same calibration, perhaps read from another text


@dataclass(frozen=True, slots=True, eq=False)
class SavedMap:
    """A map with all that a later run needs to localise in it or to extend it.

    Attributes:
        rig: the cameras that saw it.
        landmarks: positions and covariances in the map's world, n of them.
        appearances: their stored views.
        hits: (n,) frames in which each was seen (Se et al. 6.1).
        misses: (n,) frames in which it was expected and not seen.
        farthest: (n,) metres, from how far it was ever seen: from farther it is not missed.
        permanent: (n,) never to be pruned for being missed (6.2).
        colour: (n,) grey value.
        trajectory: the drive that made the map.
        about: where it comes from: names, versions, the recording's identity (plain JSON values).
        evidence: (f,) the frames whose measurements are in it (``Frame.digest``), ascending.
        patches: the landmarks' own; None where they were not carried.
        colours: (n, 3) red, green, blue; None from grey images.
    """

    rig: CameraRig
    landmarks: LandmarkMap
    appearances: LandmarkAppearances
    hits: IntArray
    misses: IntArray
    farthest: FloatArray
    permanent: BoolArray
    colour: ByteArray
    trajectory: Trajectory
    about: dict[str, Any]
    evidence: IntArray
    patches: LandmarkPatches | None = None
    colours: ByteArray | None = None

    def __len__(self) -> int:
        return len(self.landmarks)

    @property
    def shown(self) -> ByteArray:
        """(n, 3) red, green, blue; its grey values where the images had no more."""
        return np.repeat(self.colour[:, None], 3, axis=1) if self.colours is None else self.colours


def _require_map(saved: SavedMap) -> None:
    """Raises ValueError unless all parts fit each other."""
    if fault := rig_fault(saved.rig):
        raise ValueError(f"the map's rig cannot be one: {fault}")
    landmarks, views, drive = saved.landmarks, saved.appearances, saved.trajectory
    n, v = len(landmarks), len(views.ids)
    patches = saved.patches or LandmarkPatches.none(n)
    for name, array, shape in (
        ("landmark positions", landmarks.positions, (n, 3)),
        ("landmark covariances", landmarks.covariances, (n, 3, 3)),
        ("hits", saved.hits, (n,)),
        ("misses", saved.misses, (n,)),
        ("farthest", saved.farthest, (n,)),
        ("permanent", saved.permanent, (n,)),
        ("colour", saved.colour, (n,)),
        ("colours", saved.shown, (n, 3)),
        ("descriptors", views.descriptors, (v, 128)),
        ("sizes of views", views.size, (v,)),
        ("orientations of views", views.orientation, (v,)),
        ("directions of views", views.direction, (v, 3)),
        ("poses", drive.poses, (len(drive.timestamps), 4, 4)),
        ("patches", patches.grey, (n, CUT_PIXELS)),
        ("distances of patches", patches.distances, (n,)),
    ):
        if array.shape != shape:
            raise ValueError(f"{name}: {array.shape} instead of {shape}")
    for name, values in (("landmark ids", landmarks.ids), ("times of poses", drive.timestamps)):
        require_ascending(name, values)
    require_ascending("evidence", saved.evidence)
    if not (saved.farthest >= 0.0).all():
        raise ValueError("a distance from which a landmark was seen is negative or not a number")
    if not ((np.diff(views.ids) >= 0).all() and np.isin(views.ids, landmarks.ids).all()):
        raise ValueError("landmarks of views are out of order")
    for name, values in (("positions", landmarks.positions), ("poses", drive.poses)):
        require_finite(name, values)
    require_finite("times of poses", drive.timestamps)
    require_covariances("landmark covariances", landmarks.covariances, definite=False)
    if not ((patches.distances >= 0.0) & np.isfinite(patches.distances)).all():
        raise ValueError("a distance of a patch is negative or not finite")


_FILE = FileKind(
    SavedMap,
    "fgslam map",
    version=6,
    error=MapError,
    give="give a file that fgslam run --map-out wrote",
    again="make the map again",
    check=_require_map,
    packed="biuU",  # nothing of a float's mantissa can be packed
)


def save_map(saved: SavedMap, path: Path) -> int:
    """Writes a map, whole or not at all; the same map gives the same bytes.

    Returns:
        Size of the file in bytes.

    Raises:
        MapError: the map's parts do not fit each other, or ``about`` is not plain JSON.
        OutputError: the file cannot be written.
    """
    try:
        json.dumps(saved.about, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise MapError(f"{path}: `about` is not plain JSON ({error}); leave it out") from None
    kept = saved.patches if saved.patches is not None and saved.patches.kept else None
    whole = replace(saved, appearances=replace(saved.appearances, words=None), patches=kept)
    _FILE.require_sound(whole, str(path))
    return _FILE.save(path, whole)


def load_map(path: Path) -> SavedMap:
    """Reads a map and checks its checksum.

    Raises:
        MapError: the file is missing, truncated, damaged, foreign, or of another version.
    """
    return _FILE.load(path)


def require_rig(saved: SavedMap, rig: CameraRig, where: str) -> None:
    """Refuses a map that other cameras made: sizes, places and depths would not agree.

    Raises:
        MapError: what differs first; ``where`` names the map.
    """
    for name, ours in rig.numbers.items():
        theirs = saved.rig.numbers[name]
        if (theirs is None) != (ours is None) or (
            ours is not None and not np.isclose(theirs, ours, rtol=_SAME_RIG, atol=0.0)
        ):
            raise MapError(
                f"{where}: made with another rig ({name} {theirs}, the recording's is {ours}); "
                "give a map of the same cameras"
            )
    if not np.allclose(saved.rig.bTc, rig.bTc, rtol=0.0, atol=_SAME_RIG):
        raise MapError(
            f"{where}: made with the cameras mounted otherwise on the robot (bTc differs); give a "
            "map of the same robot"
        )
