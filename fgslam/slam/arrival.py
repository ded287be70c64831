"""Saved maps of sessions: where one begins, what its estimator takes over, and what is saved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from fgslam.backend.protocol import Estimator, MapUser
from fgslam.core.arrays import StateArrays
from fgslam.core.errors import ConfigError
from fgslam.core.estimates import Estimate, Prediction
from fgslam.core.saved_map import SavedMap
from fgslam.core.sensors import CameraRig
from fgslam.slam.pipeline import SlamPipeline


@dataclass(frozen=True, slots=True, eq=False)
class Arrival:
    """The first pose of a run in a map.

    Attributes:
        saved: the map; its world is the run's.
        prior: pose expected of the first frame, and how well it is known before its landmarks
            are seen.
        relocalised: it was found by these landmarks, and says nothing beside them.
        extends: the run adds to the map and corrects it; else it leaves it as it is.
    """

    saved: SavedMap
    prior: Prediction
    relocalised: bool
    extends: bool


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
            "ekf, isam2 or batch"
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
    session: StateArrays | None = None,
) -> SavedMap:
    """The estimator's geometry joined with the database's appearances and counts.

    Args:
        pipeline: the parts as they are now.
        rig: the cameras that saw the map.
        estimate: the estimator's.
        about: where the map comes from; plain JSON values.
        session: what its run needs to go on; None for nothing.
    """
    database, places = pipeline.tracker.database, pipeline.places
    landmarks = estimate.landmarks
    if places is not None:  # no later frame of this run ends them
        landmarks = landmarks.without(places.ending)
    rows = database.rows(landmarks.ids)
    return SavedMap(
        rig=rig,
        landmarks=landmarks,
        appearances=database.appearances(landmarks.ids),
        hits=database.hits[rows],
        misses=database.misses[rows],
        permanent=database.lasting[rows],
        colour=database.colour[rows],
        trajectory=estimate.trajectory,
        about=about,
        session=session or {},
    )
