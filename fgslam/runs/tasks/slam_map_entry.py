"""The map that a run is given, and how the run enters it."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from fgslam.core.errors import ConfigError, MapError
from fgslam.core.log import ImageSequence
from fgslam.core.saved_map import SavedMap, load_map
from fgslam.core.types import Prediction, Relocalisation, Remark
from fgslam.report.content import sentence
from fgslam.runs.config import ExperimentConfig, load_config
from fgslam.runs.folder import RUN_MARKER, is_run_folder
from fgslam.slam.build import Arrival, MapStart, make_locator, make_stream
from fgslam.slam.settings import MapSettings

FIRST_FOLDER = "first"
MAP_FILE = "map.fgmap"


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
