"""The map that a run is given, and how the run enters it; the rig's memory that it is given."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from fgslam.backend.self_calibration import SelfCalibration
from fgslam.core.errors import ConfigError, FgslamError, FrameError, MapError, OutputError
from fgslam.core.files import require_output
from fgslam.core.log import ImageSequence
from fgslam.core.saved_map import SavedMap, load_map
from fgslam.core.types import Prediction, Relocalisation, Remark
from fgslam.report.content import sentence
from fgslam.runs.config import ExperimentConfig, load_config
from fgslam.runs.folder import RUN_MARKER, is_run_folder
from fgslam.slam.build import Arrival, MapStart, calibrates_itself, make_locator, make_stream
from fgslam.slam.rig_memory import RigMemory
from fgslam.slam.settings import MapSettings

FIRST_FOLDER = "first"
MAP_FILE = "map.fgmap"
RIG_MEMORY_FILE = "rig_memory.npz"


@dataclass(frozen=True, slots=True, eq=False)
class GivenMap:
    """The map that a run is given.

    Attributes:
        path: its file.
        identity: SHA-256 of the file, hexadecimal.
        saved: what is in it.
    """

    path: Path
    identity: str
    saved: SavedMap


Entry: TypeAlias = dict[str, Any]
"""How a run entered a map, as its config.yaml states it for those who resume or replay it.

The map's ``file`` and its digest ``sha256``; ``frames_before``, selected frames left out because
they could not be located; whether the first pose was found without a prior, ``relocalised``; the
pose expected of the first frame, ``wTc`` (4, 4) with ``covariance`` (6, 6), exact.
"""


def require_same_map(entry: Entry, given: GivenMap) -> None:
    """Refuses another map than the run entered. Raises MapError."""
    if entry["sha256"] != given.identity:
        raise MapError(
            f"{given.path}: the map has changed since the run began; restore it, or run again "
            "with --overwrite"
        )


def arrival_by(entry: Entry, given: GivenMap, settings: MapSettings) -> Arrival:
    """Where a run's parts begin."""
    prior = Prediction(np.array(entry["wTc"]), np.array(entry["covariance"]))
    return Arrival(given.saved, prior, entry["relocalised"], settings.extend)


def entry_notes(entry: Entry, given: GivenMap, settings: MapSettings) -> tuple[str, ...]:
    """Notes on the entry: which map, where, and frames left out."""
    x, y, z = np.array(entry["wTc"])[:3, 3]
    how = "located" if entry["relocalised"] else f"put back at its {settings.start}"
    use = "extended" if settings.extend else "left as it is"
    entered = (
        f"map {given.path} of {len(given.saved)} landmarks, {use}: {how} at ({x:.2f}, "
        f"{y:.2f}, {z:.2f}) m"
    )
    return (entered, *left_out_notes(entry["frames_before"]))


def left_out_notes(frames: int) -> tuple[str, ...]:
    """That so many frames before the first were left out; none for none."""
    return (sentence(Remark("left_out", values={"count": frames})),) if frames else ()


def open_map(path: Path) -> GivenMap:
    """Reads a map. Raises MapError where it is not one."""
    saved = load_map(path)
    return GivenMap(path, hashlib.sha256(path.read_bytes()).hexdigest(), saved)


def enter(config: ExperimentConfig, given: GivenMap, sequence: ImageSequence) -> Entry:
    """Where the recording begins in the map.

    Raises:
        MapError: another rig made the map, it is empty, or no frame could be located.
    """
    start = MapStart(given.saved, config.map, str(given.path))
    start.require_usable(sequence.rig)
    arrival, before = start.known(), 0
    if arrival is None:
        before, found = _locate(config, given, sequence)
        arrival = start.at(found.wTc, relocalised=True)
    return {
        "file": str(given.path),
        "sha256": given.identity,
        "frames_before": before,
        "relocalised": arrival.relocalised,
        "wTc": arrival.prior.wTc.tolist(),
        "covariance": arrival.prior.covariance.tolist(),
    }


def _locate(
    config: ExperimentConfig, given: GivenMap, sequence: ImageSequence
) -> tuple[int, Relocalisation]:
    """The first frame that the map's landmarks place for certain, and its number."""
    locate = make_locator(sequence.rig, config.frontend, given.saved, config.seed)
    within, why = min(config.map.begin.within, len(sequence)), "no image could be read"
    stream = make_stream(sequence, config.frontend)()
    try:
        for found in stream:
            if found.i >= within:
                break
            if found.frame is None:
                continue
            located = locate(found)
            if located.found:
                return found.i, located
            why = located.why
    finally:
        stream.close()
    raise MapError(
        f"{given.path}: none of the first {within} frames of {sequence.name} could be located in "
        f"the map ({why}); raise map.begin.within, or tell the place by map.start"
    )


def arrival_of(run: Path) -> Arrival | None:
    """Where the run in a folder began in its map, for those who replay it; None without one.

    Raises:
        MapError: the map is no longer there, or another one.
    """
    entry = entry_of(run)
    if entry is None:
        return None
    settings = load_config(run / RUN_MARKER).map
    first = run / FIRST_FOLDER / MAP_FILE
    given = open_map(Path(entry["file"]) if settings.made_from is None else first)
    require_same_map(entry, given)
    return arrival_by(entry, given, settings)


def entry_of(run: Path) -> Entry | None:
    """How the run in a folder entered its map; None without.

    Raises:
        ConfigError: config.yaml states it as another fgslam does.
    """
    if not is_run_folder(run):
        return None
    entry = (load_config(run / RUN_MARKER).provenance or {}).get("map")
    try:
        if entry is not None:
            Prediction(np.array(entry["wTc"], float), np.array(entry["covariance"], float))
            _ = entry["file"], entry["sha256"], entry["frames_before"], entry["relocalised"]
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(
            f"{run / RUN_MARKER}: provenance.map does not say how the run entered its map "
            f"({type(error).__name__}: {error}); run again with --overwrite"
        ) from None
    return entry


# ------------------------------------------------------------------------------------------
# What earlier drives have shown of the rig


@dataclass(frozen=True, slots=True, eq=False)
class GivenMemory:
    """The rig's memory that a run begins with.

    Attributes:
        path: of its file, in which this drive is kept, too.
        known: what is in there of other drives than this one.
        fault: why this one is not kept; empty where it is.
    """

    path: Path
    known: RigMemory
    fault: str = ""

    def notes(self, calibration: SelfCalibration | None) -> tuple[str, ...]:
        """What was used of it, and what the drive has made of that."""
        notes = []
        if count := len(self.known):
            drives = f"{count} earlier drive{'s' * (count > 1)}"
            known = f"as {drives} found it ({self.path})"
            notes.append(f"the calibration begins {known}; --rig-memory off leaves that out")
        if calibration is not None and calibration.moved_before:
            notes.append("the cameras have moved since those drives, which therefore are left out")
        if self.fault:
            notes.append(f"what this drive shows of the calibration is not kept: {self.fault}")
        return tuple(notes)


def open_memory(
    config: ExperimentConfig, sequence: ImageSequence, resumed: Path | None
) -> GivenMemory | None:
    """The memory of a recording's rig, without the recording itself; None where it has none.

    ``resumed``: folder of the run that goes on, with what it began with.

    Raises:
        CalibrationError: the file that is named is none, or of another calibration.
        OutputError: it cannot be written.
        ConfigError: it is to lie next to a calibration that is in no file.
    """
    where, rig = config.rig_memory, sequence.rig
    if where == "off" or not calibrates_itself(config.frontend):
        return None
    rectifier, path, fault = getattr(sequence, "rectifier", None), Path(where), ""
    known = RigMemory.of(rig, rectifier)
    if where == "auto":
        files = getattr(sequence, "calibration", ""), getattr(config.dataset, "path", "")
        file = next((Path(name) for name in files if name and Path(name).exists()), None)
        if file is None:
            raise ConfigError("rig_memory: no file holds the calibration; give a file, or off")
        folder = file if file.is_dir() else file.parent
        path = folder / f"rig_memory_{known.calibration}.npz"
    try:
        known = RigMemory.open(path, rig, rectifier)
        require_output(path, overwrite=True)
        if not path.parent.stat().st_mode & 0o222:  # which does not stop root
            raise OutputError(f"{path.parent} is read-only; --rig-memory FILE keeps it elsewhere")
    except FgslamError as error:
        if where != "auto":
            raise
        fault = str(error)
    if resumed is not None:
        known = RigMemory.open(resumed / RIG_MEMORY_FILE, rig, rectifier)
    seen = []
    for i in {0, len(sequence) // 2, len(sequence) - 1}:
        with suppress(FrameError):
            seen.append(sequence.frame(i).digest())
    return GivenMemory(path, known.without(np.array(seen, np.int64)), fault)
