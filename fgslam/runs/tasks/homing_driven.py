"""What one drive gave."""

from __future__ import annotations

from dataclasses import dataclass

from fgslam.core.arrays import FloatArray
from fgslam.homing.drive_record import DriveRecord
from fgslam.homing.path_memory import PathMemory
from fgslam.runs.tasks.homing_drive_pictures import LegView


@dataclass(frozen=True, slots=True, eq=False)
class DrivenSeed:
    """One drive.

    Attributes:
        seed: of world and chance.
        record: of the drive.
        memory: the path as it is remembered.
        outlines: of the world.
        leg_m: true length of the first leg as driven: start to target.
        views: what the camera saw at the legs' ends; of the first seed alone.
    """

    seed: int
    record: DriveRecord
    memory: PathMemory
    outlines: tuple[FloatArray, ...]
    leg_m: float
    views: tuple[LegView, ...] = ()
