"""Joins sub-maps with the parts of a session."""

from __future__ import annotations

from fgslam.backend.filters.self_calibration import SETTLING
from fgslam.backend.protocol import KeepsRecord
from fgslam.core.sensors import CameraRig
from fgslam.frontend.settings import FrontendSettings, LoopSettings
from fgslam.slam.factory import make_relocaliser
from fgslam.slam.pipeline import SlamPipeline
from fgslam.slam.submaps.memory import ActiveArea, SubMapParts, SubMaps, require_sets_aside


def make_submaps(
    area: ActiveArea, rig: CameraRig, settings: FrontendSettings, pipeline: SlamPipeline, seed: int
) -> SubMaps:
    """Sub-maps of a pipeline that is at its first frame.

    Raises:
        ConfigError: its estimator keeps every landmark in memory.
    """
    estimator = require_sets_aside(pipeline.estimator)
    if isinstance(estimator, KeepsRecord):
        estimator.keep_record_in(area.folder)
    loops = settings.loops or LoopSettings()
    parts = SubMapParts(
        rig=rig,
        database=pipeline.tracker.database,
        estimator=estimator,
        places=pipeline.places,
        relocaliser=make_relocaliser(rig, settings),
        max_drift_share=loops.max_drift_share,
        seed=seed,
        settling=0 if pipeline.calibration is None else SETTLING,
    )
    return SubMaps(area, parts)
