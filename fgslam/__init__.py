"""Filters and smoothers for stereo, trinocular and omnidirectional SLAM on one measurement log.

::

    import fgslam as fg

    rig = fg.StereoRig(width=640, height=480, fx=500, fy=500, cx=319.5, cy=239.5, baseline=0.12)
    slam = fg.Slam(rig, estimator="isam2")
    for t, images, odometry in frames:
        step = slam.track(t, images, odometry)
    slam.result().trajectory.save("path.tum")

Names are imported when they are first used: `import fgslam` itself loads no library. Every error
that is raised on purpose descends from ``fgslam.errors.FgslamError``.
"""

from __future__ import annotations

import sys
from importlib import import_module

from fgslam.core import __version__, errors

TYPE_CHECKING = False  # as in typing, whose import takes as long as all else here
if TYPE_CHECKING:
    from typing import Any

    from fgslam.backend.protocol import Estimator
    from fgslam.cameras.omni_files import load_camera
    from fgslam.cameras.rig import StereoRig, load_rig
    from fgslam.core.bearings import Refusal, TwoViewVector
    from fgslam.core.log import MeasurementLog
    from fgslam.core.sensors import Increment, Measured, Odometry
    from fgslam.core.types import Features, Trajectory
    from fgslam.evaluation.judging import compare
    from fgslam.factors.measurement import LandmarkModel, PoseModel
    from fgslam.factors.models import Position, Range, RangeBearing
    from fgslam.homing.api import HomingVector, PathFollower, teach
    from fgslam.homing.route import PathMemory
    from fgslam.homing.steering import DriveCommand
    from fgslam.homing.topological_map import RouteMap
    from fgslam.report.figures import plot
    from fgslam.runs.judge import judge
    from fgslam.runs.library import graph, open_recording, rendered_recording, replay, run, sweep
    from fgslam.runs.session import Map, Result, Slam
    from fgslam.slam.feature_stream import FeatureExtractor
    from fgslam.slam.motion import MotionModel
    from fgslam.slam.results import Step
    from fgslam.slam.rig_memory import RigMemory
    from fgslam.slam.session import NewestFrame

__all__ = [
    "DriveCommand",
    "Estimator",
    "FeatureExtractor",
    "Features",
    "HomingVector",
    "Increment",
    "LandmarkModel",
    "Map",
    "Measured",
    "MeasurementLog",
    "MotionModel",
    "NewestFrame",
    "Odometry",
    "PathFollower",
    "PathMemory",
    "PoseModel",
    "Position",
    "Range",
    "RangeBearing",
    "Refusal",
    "Result",
    "RigMemory",
    "RouteMap",
    "Slam",
    "Step",
    "StereoRig",
    "Trajectory",
    "TwoViewVector",
    "__version__",
    "compare",
    "errors",
    "graph",
    "judge",
    "load_camera",
    "load_rig",
    "open_recording",
    "plot",
    "rendered_recording",
    "replay",
    "run",
    "sweep",
    "teach",
]

_HOMES = {
    "DriveCommand": "fgslam.homing.steering",
    "Estimator": "fgslam.backend.protocol",
    "FeatureExtractor": "fgslam.slam.feature_stream",
    "Features": "fgslam.core.types",
    "HomingVector": "fgslam.homing.api",
    "Increment": "fgslam.core.sensors",
    "LandmarkModel": "fgslam.factors.measurement",
    "Map": "fgslam.runs.session",
    "Measured": "fgslam.core.sensors",
    "MeasurementLog": "fgslam.core.log",
    "MotionModel": "fgslam.slam.motion",
    "NewestFrame": "fgslam.slam.session",
    "Odometry": "fgslam.core.sensors",
    "PathFollower": "fgslam.homing.api",
    "PathMemory": "fgslam.homing.route",
    "PoseModel": "fgslam.factors.measurement",
    "Position": "fgslam.factors.models",
    "Range": "fgslam.factors.models",
    "RangeBearing": "fgslam.factors.models",
    "Refusal": "fgslam.core.bearings",
    "Result": "fgslam.runs.session",
    "RigMemory": "fgslam.slam.rig_memory",
    "RouteMap": "fgslam.homing.topological_map",
    "Slam": "fgslam.runs.session",
    "Step": "fgslam.slam.results",
    "StereoRig": "fgslam.cameras.rig",
    "Trajectory": "fgslam.core.types",
    "TwoViewVector": "fgslam.core.bearings",
    "compare": "fgslam.evaluation.judging",
    "graph": "fgslam.runs.library",
    "judge": "fgslam.runs.judge",
    "load_camera": "fgslam.cameras.omni_files",
    "load_rig": "fgslam.cameras.rig",
    "open_recording": "fgslam.runs.library",
    "plot": "fgslam.report.figures",
    "rendered_recording": "fgslam.runs.library",
    "replay": "fgslam.runs.library",
    "run": "fgslam.runs.library",
    "sweep": "fgslam.runs.library",
    "teach": "fgslam.homing.api",
}
"""Module that each public name is imported from, on first use (PEP 562)."""

# Errors belong to core, where everything may raise them; users know them by this shorter name.
sys.modules[f"{__name__}.errors"] = errors


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'fgslam' has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
