"""Saved map of a session."""

from __future__ import annotations

from typing import Any

from fgslam.core.arrays import StateArrays
from fgslam.core.estimates import Estimate
from fgslam.core.saved_map import SavedMap
from fgslam.core.sensors import CameraRig
from fgslam.slam.pipeline import SlamPipeline


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
