"""A sub-map as a file: a saved map of some landmarks, with what their owners need to go on.

Its trajectory are the poses at which its landmarks were first seen: beside those they lie.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgslam.backend.filters.set_aside import SetAside
from fgslam.core.arrays import StateArrays
from fgslam.core.errors import MapError
from fgslam.core.estimates import Trajectory
from fgslam.core.features import LandmarkAppearances, LandmarkPatches
from fgslam.core.saved_map import SavedMap, load_map, save_map
from fgslam.core.sensors import CameraRig

_OF_ESTIMATOR = ("counts", "homes", "lasts", "frames", "doubt_gain", "doubt_information")
_OF_DATABASE = ("missed", "unlooked", "seen", "contradicted", "view_counts", "used")
_TRACK = "track/"
FILES = "[0-9]" * 6 + ".fgmap"


@dataclass(frozen=True, slots=True, eq=False)
class SubMap:
    """Landmarks as estimator and database gave them up, in ascending order of identity."""

    geometry: SetAside
    entries: StateArrays

    def __len__(self) -> int:
        return len(self.geometry.landmarks)

    @property
    def appearances(self) -> LandmarkAppearances:
        """All views, as kept."""
        held = self.entries
        return LandmarkAppearances(
            ids=np.repeat(held["ids"], held["view_counts"]),
            descriptors=held["descriptors"],
            size=held["size"],
            orientation=held["orientation"],
            direction=held["direction"].astype(np.float64),
        )


def file_of(folder: Path, number: int) -> Path:
    """Where a sub-map lies."""
    return folder / f"{number:06d}.fgmap"


def write_submap(submap: SubMap, rig: CameraRig, path: Path) -> None:
    """Writes a sub-map, whole or not at all; the same one gives the same bytes.

    Raises:
        OutputError: the file cannot be written.
    """
    geometry, held = submap.geometry, submap.entries
    session = {name: getattr(geometry, name) for name in _OF_ESTIMATOR}
    session |= {_TRACK + name: array for name, array in geometry.tracks.items()}
    saved = SavedMap(
        rig=rig,
        landmarks=geometry.landmarks,
        appearances=submap.appearances,
        hits=held["hits"],
        misses=held["misses"],
        permanent=held["permanent"],
        colour=held["colour"],
        trajectory=Trajectory(geometry.timestamps, geometry.poses),
        about={"submap": int(path.stem)},
        session=session | {name: held[name] for name in _OF_DATABASE},
        evidence=np.empty(0, np.int64),
        patches=LandmarkPatches(held["patch"], held["patch_distance"]),
    )
    save_map(saved, path)


def read_submap(path: Path, landmarks: int) -> SubMap:
    """Reads a sub-map.

    Args:
        path: its file.
        landmarks: how many it was written with.

    Raises:
        MapError: it is missing, damaged, or another map.
    """
    saved = load_map(path)
    lacking = {*_OF_ESTIMATOR, *_OF_DATABASE} - saved.session.keys()
    if lacking or len(saved) != landmarks or saved.about != {"submap": int(path.stem)}:
        raise MapError(
            f"{path}: not the sub-map that this run wrote there ({landmarks} landmarks); restore "
            "the file, or run again with --overwrite"
        )
    return SubMap(_geometry(saved), _entries(saved))


def _geometry(saved: SavedMap) -> SetAside:
    session: Mapping[str, np.ndarray] = saved.session
    return SetAside(
        landmarks=saved.landmarks,
        counts=session["counts"],
        homes=session["homes"],
        lasts=session["lasts"],
        frames=session["frames"],
        doubt_gain=session["doubt_gain"],
        doubt_information=session["doubt_information"],
        tracks={n.removeprefix(_TRACK): a for n, a in session.items() if n.startswith(_TRACK)},
        timestamps=saved.trajectory.timestamps,
        poses=saved.trajectory.poses,
    )


def _entries(saved: SavedMap) -> StateArrays:
    views = saved.appearances
    patches = saved.patches or LandmarkPatches.none(len(saved), 0)
    return {
        "patch": patches.grey,
        "patch_distance": patches.distances,
        "ids": saved.landmarks.ids,
        "hits": saved.hits,
        "misses": saved.misses,
        "permanent": saved.permanent,
        "colour": saved.colour,
        "size": views.size,
        "orientation": views.orientation,
        "descriptors": views.descriptors,
        "direction": views.direction.astype(np.float32),
        **{name: saved.session[name] for name in _OF_DATABASE},
    }
