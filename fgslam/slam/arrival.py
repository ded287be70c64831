"""Where a run begins in a saved map, and what its estimator takes over."""

from __future__ import annotations

from dataclasses import dataclass

from fgslam.backend.protocol import Estimator, MapUser
from fgslam.core.errors import ConfigError
from fgslam.core.estimates import Prediction
from fgslam.core.saved_map import SavedMap


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
