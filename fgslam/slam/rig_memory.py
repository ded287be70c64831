"""A rig that remembers: what its drives have shown of it, as what the next one begins with.

Each drive has a rig of its own, off from that which all share by a little: what it drifts from
drive to drive, and what else makes drives disagree. By how much is estimated from how far they do,
so that what the next drive begins with is as sure as it may be. docs/derivations/cameras.md.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgslam.backend.self_calibration import RigFilter, RigUnknowns, SelfCalibration
from fgslam.cameras.rectify import Rectifier
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.correction import FIELD_PX
from fgslam.core.errors import CalibrationError
from fgslam.core.files import as_path
from fgslam.core.sensors import CameraRig
from fgslam.core.store import FileKind, digest, pack, require_finite

SPREAD = 0.01
"""Variance between drives, as share of that of calibrations, before drives show it: 0.1 px of 1."""
_TRUSTED = 4.0  # how many numbers that is worth, next to those observed
_STEPS = 10  # of a fixed point that is near after three
_MOST_DRIVES = 20  # the newest; older ones are of a rig that has drifted since


@dataclass(frozen=True, slots=True, eq=False)
class DriveEvidence:
    """What one drive showed, without what was known before it.

    Attributes:
        frames: (f,) digests of its images, ascending.
        information: (n, n) on terms and nuisances.
        pull: (n,) ``information @ best``.
    """

    frames: IntArray
    information: FloatArray
    pull: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class RigMemory:
    """What drives with one calibration have shown of it.

    ::

        memory = fgslam.RigMemory.open("rig_memory.npz", rig)
        slam = fgslam.Slam(rig, rig_memory=memory)
        ...
        slam.remembered(memory).save("rig_memory.npz")

    Attributes:
        calibration: digest of its content: numbers of the rig, of the raw cameras, corrections.
        drives: the newest last.
    """

    calibration: str
    drives: tuple[DriveEvidence, ...] = ()

    @staticmethod
    def of(rig: CameraRig, rectifier: Rectifier | None = None) -> RigMemory:
        """That of a rig that has not been driven.

        ``rectifier``: what rectifies its images; None: the rig's own, if it has one.
        """
        rectifier = rectifier or getattr(rig, "rectifier", None)
        content = list(rig.numbers.values())
        if rectifier is not None:
            raw = rectifier.calibration
            content += [rectifier.correction, () if raw is None else raw.cameras]
        return RigMemory(digest(pack(content))[:12])

    @staticmethod
    def open(path: str | Path, rig: CameraRig, rectifier: Rectifier | None = None) -> RigMemory:
        """The memory in a file; of a file that is not there, that of a rig not driven yet.

        Raises:
            CalibrationError: the file is damaged, is something else, or of another calibration.
        """
        new = RigMemory.of(rig, rectifier)
        if not as_path(path, CalibrationError).exists():
            return new
        found = _FILE.load(path)
        if found.calibration != new.calibration:
            text = f"{path}: remembers drives with another calibration; name another file"
            raise CalibrationError(text)
        return found

    def save(self, path: str | Path) -> None:
        """Writes it, whole or not at all. Raises OutputError."""
        _FILE.save(path, self)

    def __len__(self) -> int:
        return len(self.drives)

    def without(self, frames: IntArray) -> RigMemory:
        """The memory without drives that saw any of these frames: what they showed counts once."""
        other = (d for d in self.drives if not np.isin(frames, d.frames).any())
        return dataclasses.replace(self, drives=tuple(other))

    def after(self, calibration: SelfCalibration, frames: IntArray) -> RigMemory:
        """With a drive more, in place of those of the same frames.

        Where the rig was found to have moved, without all drives before: they had another one.
        """
        if not calibration.windows:
            return self
        drive = DriveEvidence(np.unique(frames), *calibration.shown())
        moved = calibration.moved_before or calibration.knocks
        before = () if moved else self.without(frames).drives
        return dataclasses.replace(self, drives=(*before, drive)[-_MOST_DRIVES:])

    def known(self, of: RigUnknowns) -> RigFilter:
        """What the next drive begins with.

        Raises:
            CalibrationError: the memory is of other cameras.
        """
        if any(len(drive.pull) != of.size for drive in self.drives):
            raise CalibrationError("rig_memory: it is of other cameras; give RigMemory.of(rig)")
        total, prior = RigFilter.none(of), of.prior(FIELD_PX)
        held = prior / self._spread(prior)
        for drive in self.drives:
            total = total.adding(*_loosened(drive.information, drive.pull, held))
        begun = _loosened(total.information, total.pull, held)
        return RigFilter(*begun, remembered=float(len(self) > 0))

    def _spread(self, prior: FloatArray) -> float:
        """Variance between drives over the prior's under which they are likeliest (MacKay 2003)."""
        spread = SPREAD
        for _ in range(_STEPS):
            own = [np.linalg.inv(d.information + prior / spread) for d in self.drives]
            both = [_loosened(d.information, d.pull, prior / spread) for d in self.drives]
            shared = np.linalg.inv(prior + sum(information for information, _ in both))
            values = shared @ sum((pull for _, pull in both), np.zeros(len(prior)))
            squared, shown = 0.0, 0.0
            for drive, covariance in zip(self.drives, own, strict=True):
                gain = covariance @ drive.information
                off = covariance @ drive.pull - gain @ values
                squared += float(off @ prior @ off)
                left = np.sum((covariance + gain @ shared @ gain.T) * prior) / spread
                shown += len(prior) - float(left)
            spread = (_TRUSTED * SPREAD + squared) / (_TRUSTED + shown)
        return spread


def _loosened(
    information: FloatArray, pull: FloatArray, held: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Evidence on what drives share, by that on one of them; ``held``: information on the rest."""
    gain = np.linalg.solve(information + held, np.column_stack([information, pull]))
    left = information - information @ gain[:, :-1]
    return (left + left.T) / 2.0, pull - information @ gain[:, -1]


def _require_memory(memory: RigMemory) -> None:
    """Raises ValueError for what no drive leaves."""
    for drive in memory.drives:
        require_finite("a drive's evidence", np.column_stack([drive.information, drive.pull]))
        if drive.information.shape != (len(drive.pull),) * 2:
            raise ValueError("a drive's information is not square")


_FILE = FileKind(
    RigMemory,
    "fgslam rig memory",
    version=1,
    error=CalibrationError,
    give="give another FILE by --rig-memory, or move this one away",
    again="move it away: the next drive begins another one",
    check=_require_memory,
)
