"""The saved map: landmarks with their looks and counts, the drive that made them, one file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from fgslam.map_types import LandmarkAppearances
from fgslam.types import (
    BoolArray,
    ByteArray,
    CameraRig,
    IntArray,
    LandmarkMap,
    StateArrays,
    Trajectory,
)


@dataclass(frozen=True, slots=True, eq=False)
class SavedMap:
    """A map that outlives its run.

    Attributes:
        rig: the cameras that saw it.
        landmarks: positions and covariances in the map's world, n of them.
        appearances: their stored views.
        hits: (n,) frames in which each was seen (Se et al. 6.1).
        misses: (n,) frames in which it was expected and not seen.
        permanent: (n,) never to be pruned for being missed (6.2).
        colour: (n,) grey value.
        trajectory: the drive that made the map.
        about: where it comes from: names, versions, the recording's identity (plain JSON values).
        session: state of the run that made it, for continuing it to the bit; may be empty.
    """

    rig: CameraRig
    landmarks: LandmarkMap
    appearances: LandmarkAppearances
    hits: IntArray
    misses: IntArray
    permanent: BoolArray
    colour: ByteArray
    trajectory: Trajectory
    about: dict[str, Any]
    session: StateArrays

    def __len__(self) -> int:
        return len(self.landmarks)
