"""What measurements and landmarks become where the correction of a rig changes between two frames.

A map measured with one correction contradicts what is measured with the next: every landmark is as
far off as its disparity was. So it moves to where the new correction would have put it, seen from
the pose that saw it last: to first order, as corrections are fractions of a disparity. Derived in
docs/derivations/self_calibration.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.geometry import in_front, project, triangulate
from fgslam.core.measurements import Increment
from fgslam.core.rig_correction import displacements
from fgslam.core.sensors import CameraRig, pixel_model, rig_map, vertical_to_horizontal

_LEAST_SHARE = 0.5  # of a disparity that is left: below, it is no first-order change


@dataclass(frozen=True, slots=True, eq=False)
class RigChange:
    """A change of the correction of a rig's pixels.

    Attributes:
        rig: the cameras.
        values: (p,) the new correction less the old one
            (:func:`fgslam.core.rig_correction.term_names`).
    """

    rig: CameraRig
    values: FloatArray

    def measured(self, measurement: FloatArray) -> FloatArray:
        """Measurements (k, 3) (column, row, disparity) of all images, by the new correction."""
        ratio, cameras = vertical_to_horizontal(self.rig), self.rig.cameras
        pixels = measurement @ pixel_model(cameras, ratio).T
        moved = displacements(self.rig, pixels.reshape(-1, cameras, 2)) @ self.values
        return np.asarray(measurement - moved @ rig_map(self.rig).T)

    def moved(self, poses: FloatArray, positions: FloatArray) -> tuple[FloatArray, float]:
        """Landmarks (k, 3) in the world, each measured again from a pose (k, 4, 4) that saw it.

        Returns:
            Where they are then, one that its pose does not see where it was; and by how many
            pixels of disparity they were off, root mean square.
        """
        turn, place = poses[:, :3, :3], poses[:, :3, 3]
        local = np.einsum("kji,kj->ki", turn, positions - place)
        ahead = in_front(local)
        before = project(self.rig, np.where(ahead[:, None], local, [0.0, 0.0, 1.0]))
        after = self.measured(before)
        size = np.array([self.rig.width, self.rig.height])
        seen = ahead & ((before[:, :2] >= 0.0) & (before[:, :2] < size)).all(axis=1)
        seen &= after[:, 2] > _LEAST_SHARE * before[:, 2]
        again = triangulate(self.rig, np.where(seen[:, None], after, before))
        again = np.einsum("kij,kj->ki", turn, again) + place
        off = (after - before)[seen, 2]
        rms = float(np.sqrt(np.mean(off**2))) if len(off) else 0.0
        return np.where(seen[:, None], again, positions), rms


@dataclass(slots=True, eq=False)
class KnownCorrections:
    """Which correction the measurements of which frames contain, and what became known later.

    Attributes:
        begins: first frame of each segment with one correction and one rig, ascending.
        applied: (p,) of each, the correction that its measurements contain.
        knocks: of each, how often the rig was found to have moved before.
        settled: after so many knocks, what was known last for all frames alike, if anything.
        field_px: what no term follows, as known last.
    """

    begins: list[int] = field(default_factory=list)
    applied: list[FloatArray] = field(default_factory=list)
    knocks: list[int] = field(default_factory=list)
    settled: dict[int, FloatArray | None] = field(default_factory=dict)
    field_px: float = 0.0

    def note(self, frame: int, increment: Increment) -> None:
        """Takes in one more frame; one without a correction changes nothing."""
        applied, known = increment.rig_correction, increment.settled_rig
        if applied is None:
            return
        knocks = 0 if known is None else known.knocks
        if known is not None:
            self.settled[knocks] = known.values
            self.field_px = known.field_px
        if not (self.begins and knocks == self.knocks[-1] and (applied == self.applied[-1]).all()):
            self.begins.append(frame)
            self.applied.append(applied)
            self.knocks.append(knocks)

    def recalibrate(self, change: RigChange) -> None:
        """All measurements so far were corrected by a change."""
        self.applied = [then + change.values for then in self.applied]

    def settle(self, rig: CameraRig, frames: IntArray, measurement: FloatArray) -> FloatArray:
        """Measurements (k, 3) of frames (k,) by what was known last of the rig as it was then."""
        out = measurement.copy()
        segment = np.searchsorted(self.begins, frames, side="right") - 1
        for k, (applied, knocks) in enumerate(zip(self.applied, self.knocks, strict=True)):
            settled, rows = self.settled.get(knocks), segment == k
            if settled is not None and rows.any():
                out[rows] = RigChange(rig, settled - applied).measured(measurement[rows])
        return out
