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

    from fgslam.backend.protocol import Estimator as Estimator
    from fgslam.cameras.omni_files import load_camera as load_camera
    from fgslam.cameras.rig import StereoRig as StereoRig, load_rig as load_rig
    from fgslam.core.bearings import Refusal as Refusal, TwoViewVector as TwoViewVector
    from fgslam.core.log import MeasurementLog as MeasurementLog
    from fgslam.core.sensors import (
        Increment as Increment,
        Measured as Measured,
        Odometry as Odometry,
    )
    from fgslam.core.types import Features as Features, Trajectory as Trajectory
    from fgslam.evaluation.judging import compare as compare
    from fgslam.factors.measurement import LandmarkModel as LandmarkModel, PoseModel as PoseModel
    from fgslam.factors.models import (
        Position as Position,
        Range as Range,
        RangeBearing as RangeBearing,
    )
    from fgslam.homing.api import (
        HomingVector as HomingVector,
        PathFollower as PathFollower,
        teach as teach,
    )
    from fgslam.homing.route import PathMemory as PathMemory
    from fgslam.homing.steering import DriveCommand as DriveCommand
    from fgslam.homing.topological_map import RouteMap as RouteMap
    from fgslam.report.figures import plot as plot
    from fgslam.runs.judge import judge as judge
    from fgslam.runs.library import (
        graph as graph,
        open_recording as open_recording,
        rendered_recording as rendered_recording,
        replay as replay,
        run as run,
        sweep as sweep,
    )
    from fgslam.runs.session import Map as Map, Result as Result, Slam as Slam
    from fgslam.slam.feature_stream import FeatureExtractor as FeatureExtractor
    from fgslam.slam.motion import MotionModel as MotionModel
    from fgslam.slam.results import Step as Step
    from fgslam.slam.rig_memory import RigMemory as RigMemory
    from fgslam.slam.session import NewestFrame as NewestFrame

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
__all__ = ["__version__", "errors", *_HOMES]

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
