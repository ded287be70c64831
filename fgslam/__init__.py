"""Filters and smoothers for stereo, trinocular and omnidirectional SLAM on one measurement log."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fgslam.cameras.omni.camera_files import load_camera
    from fgslam.core.homing import Refusal, TwoViewVector
    from fgslam.homing.api import HomingVector, PathFollower, teach
    from fgslam.homing.command import DriveCommand
    from fgslam.homing.path_memory import PathMemory

__version__ = "0.1.0"

__all__ = [
    "DriveCommand",
    "HomingVector",
    "PathFollower",
    "PathMemory",
    "Refusal",
    "TwoViewVector",
    "__version__",
    "load_camera",
    "teach",
]

_HOMES = {
    "DriveCommand": "fgslam.homing.command",
    "HomingVector": "fgslam.homing.api",
    "PathFollower": "fgslam.homing.api",
    "PathMemory": "fgslam.homing.path_memory",
    "Refusal": "fgslam.core.homing",
    "TwoViewVector": "fgslam.core.homing",
    "load_camera": "fgslam.cameras.omni.camera_files",
    "teach": "fgslam.homing.api",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'fgslam' has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
