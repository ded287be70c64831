"""Recordings of measurements instead of images: a finished log with the truth beside it."""

from __future__ import annotations

from dataclasses import dataclass

from fgslam.measurement_log import MeasurementLog
from fgslam.types import FloatArray, IntArray, Trajectory


@dataclass(frozen=True, eq=False)
class LandmarkTruth:
    """True landmark positions, in the frame of the ground-truth trajectory.

    Attributes:
        ids: (n,) identities as in the log, ascending.
        positions: (n, 3) metres.
    """

    ids: IntArray
    positions: FloatArray

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, eq=False)
class MeasurementRecording:
    """Measurements with identities, replayable by any estimator without a front-end.

    Attributes:
        name: short name for titles.
        identity: hexadecimal digest of what defines the recording.
        log: sensor, motion model and one increment a frame.
        ground_truth: true ``wTc`` of the reference camera or sensor, in a world of the
            recording's choice; None where there is none.
        landmark_truth: true landmark positions in that same world, or None. A landmark that moves
            during the recording is not in it.
        notes: what was tolerated, left out or simulated, in words.
    """

    name: str
    identity: str
    log: MeasurementLog
    ground_truth: Trajectory | None
    landmark_truth: LandmarkTruth | None
    notes: tuple[str, ...]
