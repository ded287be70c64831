"""The map that a run is given, and how the run enters it."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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


@dataclass(frozen=True, slots=True, eq=False)
class Entry:
    """How a run entered a map: kept in its config.yaml, for those who resume or replay it.

    Attributes:
        file: the map's.
        identity: of the map's file.
        frames_before: selected frames left out because they could not be located.
        relocalised: the first pose was found without a prior.
        prior: pose expected of the first frame.
    """

    file: str
    identity: str
    frames_before: int
    relocalised: bool
    prior: Prediction

    def as_values(self) -> dict[str, Any]:
        """Plain values for YAML, exact."""
        return {
            "file": self.file,
            "sha256": self.identity,
            "frames_before": self.frames_before,
            "relocalised": self.relocalised,
            "wTc": self.prior.wTc.tolist(),
            "covariance": self.prior.covariance.tolist(),
        }

    @staticmethod
    def of(values: Mapping[str, Any]) -> Entry:
        """Back from :meth:`as_values`."""
        prior = Prediction(np.array(values["wTc"]), np.array(values["covariance"]))
        return Entry(
            values["file"], values["sha256"], values["frames_before"], values["relocalised"], prior
        )

    def require_same(self, given: GivenMap) -> None:
        """Refuses another map than the run entered. Raises MapError."""
        if self.identity != given.identity:
            raise MapError(
                f"{given.path}: the map has changed since the run began; restore it, or run again "
                "with --overwrite"
            )

    def arrival(self, given: GivenMap, settings: MapSettings) -> Arrival:
        """Where a run's parts begin."""
        return Arrival(given.saved, self.prior, self.relocalised, settings.extend)

    def notes(self, given: GivenMap, settings: MapSettings) -> tuple[str, ...]:
        """Notes on the entry: which map, where, and frames left out."""
        x, y, z = self.prior.wTc[:3, 3]
        how = "located" if self.relocalised else f"put back at its {settings.start}"
        use = "extended" if settings.extend else "left as it is"
        entered = (
            f"map {given.path} of {len(given.saved)} landmarks, {use}: {how} at ({x:.2f}, "
            f"{y:.2f}, {z:.2f}) m"
        )
        if not self.frames_before:
            return (entered,)
        return (entered, sentence(Remark("left_out", values={"count": self.frames_before})))


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
    return Entry(str(given.path), given.identity, before, arrival.relocalised, arrival.prior)


def _locate(
    config: ExperimentConfig, given: GivenMap, sequence: ImageSequence
) -> tuple[int, Relocalisation]:
    """The first frame that the map's landmarks place beyond doubt, and its number."""
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
    given = open_map(Path(entry.file) if settings.made_from is None else first)
    entry.require_same(given)
    return entry.arrival(given, settings)


def entry_of(run: Path) -> Entry | None:
    """How the run in a folder entered its map; None without.

    Raises:
        ConfigError: config.yaml says it in words of another fgslam.
    """
    if not is_run_folder(run):
        return None
    values = (load_config(run / RUN_MARKER).provenance or {}).get("map")
    try:
        return None if values is None else Entry.of(values)
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(
            f"{run / RUN_MARKER}: provenance.map does not say how the run entered its map "
            f"({type(error).__name__}: {error}); run again with --overwrite"
        ) from None
