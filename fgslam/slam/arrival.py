"""Saved maps of sessions: where one begins, what its estimator takes over, and what is saved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fgslam.backend.protocol import Estimator, MapUser
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import ConfigError, MapError
from fgslam.core.estimates import Estimate, LandmarkMap, Prediction
from fgslam.core.features import LandmarkAppearances
from fgslam.core.saved_map import SavedMap, require_rig
from fgslam.core.sensors import CameraRig
from fgslam.slam.map_settings import MapSettings
from fgslam.slam.pipeline import SlamPipeline
from fgslam.slam.results import RunRecorder


@dataclass(frozen=True, slots=True, eq=False)
class Arrival:
    """The first pose of a run in a map.

    Attributes:
        saved: the map; its world is the run's.
        prior: pose expected of the first frame, and how well it is known before its landmarks
            are seen.
        relocalised: it was found by these landmarks, and adds nothing to them.
        extends: the run adds to the map and corrects it; else it leaves it as it is.
    """

    saved: SavedMap
    prior: Prediction
    relocalised: bool
    extends: bool


@dataclass(frozen=True, slots=True, eq=False)
class MapStart:
    """A saved map in which a session begins, and how it finds its first pose there.

    Attributes:
        saved: the map; its world is the session's.
        settings: ``start`` (`relocalise`, `origin` or `last`), ``extend`` and ``begin`` count.
        name: of the map, for messages.
    """

    saved: SavedMap
    settings: MapSettings
    name: str = "the map"

    def require_usable(self, rig: CameraRig) -> None:
        """Refuses a map of other cameras, and an empty one. Raises MapError."""
        require_rig(self.saved, rig, self.name)
        if not len(self.saved):
            raise MapError(f"{self.name}: holds no landmark; make the map again")

    def known(self) -> Arrival | None:
        """Where the map itself states the first pose; None where a frame is to be located in it.

        Raises:
            MapError: it is to be the map's last pose, and the map has no trajectory.
        """
        if self.settings.start == "relocalise":
            return None
        if self.settings.start != "last":
            return self.at(np.eye(4), relocalised=False)
        if not len(self.saved.trajectory):
            raise MapError(f"{self.name}: knows no last pose; use map.start relocalise")
        return self.at(self.saved.trajectory.poses[-1], relocalised=False)

    def at(self, wTc: FloatArray, relocalised: bool) -> Arrival:
        """A first pose that is known roughly: what is known better its landmarks will tell."""
        begin = self.settings.begin
        sigma = np.repeat([np.deg2rad(begin.sigma_deg), begin.sigma_m], 3)
        prior = Prediction(wTc, np.diag(sigma**2))
        return Arrival(self.saved, prior, relocalised, self.settings.extend)


def trusted(saved: SavedMap, valid_hits: int) -> tuple[LandmarkMap, LandmarkAppearances]:
    """Landmarks seen often enough to be there (Se et al. 6.1), with their appearances."""
    sure = saved.permanent | (saved.hits >= valid_hits)
    landmarks = saved.landmarks.select(sure)
    return landmarks, saved.appearances.of(landmarks.ids)


def take_over(estimator: Estimator, arrival: Arrival) -> None:
    """Gives a new estimator the map's landmarks.

    Raises:
        ConfigError: it cannot begin in a saved map, or cannot leave one as it is.
        EstimatorError: the map is too large for it.
    """
    user = require_map_user(estimator, arrival.extends)
    user.begin_in(arrival.saved.landmarks, arrival.saved.hits, fixed=not arrival.extends)


def require_map_user(estimator: Estimator, extends: bool) -> MapUser:
    """The estimator, if it can begin in a saved map, and leave it as it is unless it ``extends``.

    Raises:
        ConfigError: it cannot.
    """
    if not isinstance(estimator, MapUser):
        raise ConfigError(
            f"estimator.kind {estimator.kind} cannot begin in a saved map; use landmark_kalman, "
            "ekf, isam2, sliding_window or batch"
        )
    if not extends and not estimator.keeps_maps:
        raise ConfigError(
            f"estimator.kind {estimator.kind} cannot leave a map as it is; use landmark_kalman or "
            "ekf, or map.extend true"
        )
    return estimator


def saved_map(
    pipeline: SlamPipeline,
    rig: CameraRig,
    estimate: Estimate,
    about: dict[str, Any],
    evidence: IntArray,
) -> SavedMap:
    """The estimator's geometry joined with the database's appearances and counts.

    Args:
        pipeline: the parts as they are now.
        rig: the cameras that saw the map.
        estimate: the estimator's.
        about: where the map comes from; plain JSON values.
        evidence: the frames that are in it (:func:`evidence_of`).
    """
    database, places = pipeline.tracker.database, pipeline.places
    landmarks = estimate.landmarks
    if places is not None:  # no later frame of this run ends them
        landmarks = landmarks.without(places.ending)
    rows, patches = database.rows(landmarks.ids), database.patches(landmarks.ids)
    return SavedMap(
        rig=rig,
        landmarks=landmarks,
        appearances=database.appearances(landmarks.ids),
        hits=database.hits[rows],
        misses=database.misses[rows],
        permanent=database.lasting[rows],
        colour=database.colour[rows],
        patches=patches if patches.kept else None,
        trajectory=estimate.trajectory,
        about=about,
        evidence=evidence,
    )


def evidence_of(pipeline: SlamPipeline, recorder: RunRecorder, before: SavedMap | None) -> IntArray:
    """Frames (f,) whose measurements are in a session's map, ascending.

    Those of the map that it began in count, too; a map that is only localised in takes in nothing.
    """
    own = np.array([d for d in recorder.frame_digests if d], np.int64)
    if pipeline.tracker.keeps_map:
        own = own[:0]
    return np.unique(own) if before is None else np.union1d(before.evidence, own)
