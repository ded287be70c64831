"""Which of a map's landmarks a rendered frame truly shows: what a query could go by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.estimates import LandmarkMap
from fgslam.core.recordings import Sequence
from fgslam.core.saved_map import SavedMap
from fgslam.frontend.tracking.database import LandmarkDatabase
from fgslam.runs.tasks.rendered_truth import TrueDepth
from fgslam.slam.frontend_settings import FrontendSettings

_BEHIND = 1.05  # times the rendered depth, plus the next: what is farther off is hidden
_BEHIND_M = 0.05


@dataclass(frozen=True, slots=True)
class Sighted:
    """How many landmarks are truly in view of a pose; -1 where nobody knows.

    Attributes:
        visible: in all images, not too near and not too small for the rig, and not hidden.
        familiar: of these, seen from a direction from which they were seen before.
    """

    visible: int = -1
    familiar: int = -1


class TrueSights:
    """Counts the landmarks in view of true poses, by the database's own expectation."""

    def __init__(
        self,
        saved: SavedMap,
        landmarks: LandmarkMap,
        sequence: Sequence,
        frontend: FrontendSettings,
    ) -> None:
        """Of ``landmarks``, those of the map that count; of a recording without depth nothing."""
        self._sequence = sequence if isinstance(sequence, TrueDepth) else None
        self._landmarks = landmarks
        self._rig = sequence.rig
        self._database: LandmarkDatabase | None = None
        if self._sequence is not None:
            largest = frontend.stereo.max_disparity_px
            self._database = LandmarkDatabase(sequence.rig, frontend.database, largest)
            self._database.load(saved)

    def of(self, i: int, wTc: FloatArray) -> Sighted:
        """In the selected frame ``i``, whose true pose in the map's world is ``wTc``."""
        if self._sequence is None or self._database is None or not np.isfinite(wTc).all():
            return Sighted()
        rig, depth = self._rig, self._sequence.depth(i)
        expected = self._database.expected(self._landmarks, wTc)
        column, row, disparity = expected.measurement.T
        rise = 0.0
        if rig.vertical_baseline is not None:
            rise = disparity * (rig.fy * rig.vertical_baseline) / (rig.fx * rig.baseline)
        inside = (column >= 0.0) & (column + disparity <= rig.width - 1.0)
        inside &= (row >= 0.0) & (row + rise <= rig.height - 1.0)
        at = np.rint(np.column_stack([row, column])[inside]).astype(np.int64)
        near = depth[at[:, 0], at[:, 1]]
        shown = rig.fx * rig.baseline / disparity[inside] <= _BEHIND * near + _BEHIND_M
        familiar = shown & expected.certain[inside]
        return Sighted(int(shown.sum()), int(familiar.sum()))
