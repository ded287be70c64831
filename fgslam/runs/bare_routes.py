"""The experiments that `fgslam teach` and `fgslam follow` are: a recording, a camera, a route."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from fgslam.core.errors import CalibrationError, DatasetError
from fgslam.runs.config import make_experiment
from fgslam.runs.config_models import Experiment

_NOT_IN_NAMES = re.compile(r"[^\w.-]+")


def teaching(
    recording: Path, camera: str | None, route: Path, overrides: Iterable[str] = ()
) -> Experiment:
    """The experiment that teaches a route.

    Args:
        recording: a film, or a folder of pictures.
        camera: calibration file, or the kind of camera; of a mirror it must be given.
        route: the file to write.
        overrides: ``a.b=value``.

    Raises:
        FgslamError: recording or camera cannot be used.
    """
    if camera is None:
        raise CalibrationError(
            f"{recording}: no camera is given; add --camera FILE, its calibration, or --camera "
            "equirectangular for whole panoramas"
        )
    values = {
        "task": "teach",
        "name": f"teach_{_named(recording)}",
        "dataset": _dataset(recording, camera),
        "route": str(route),
    }
    return make_experiment(values, str(recording), overrides)


def following(
    route: Path, recording: Path, camera: str | None = None, overrides: Iterable[str] = ()
) -> Experiment:
    """The experiment that follows a route; ``camera`` None is the one that it was taught with.

    Raises:
        FgslamError: recording or camera cannot be used.
    """
    values = {
        "task": "follow",
        "name": f"follow_{_named(recording)}",
        "dataset": _dataset(recording, camera or "equirectangular"),
        "route": str(route),
        "taught_camera": camera is None,
    }
    return make_experiment(values, str(recording), overrides)


def _named(recording: Path) -> str:
    return _NOT_IN_NAMES.sub("_", recording.resolve().stem).strip("_") or "recording"


def _dataset(recording: Path, camera: str) -> dict[str, Any]:
    from fgslam.cameras.omni.camera_files import camera_keys  # loads arrays

    if not recording.exists():
        raise DatasetError(f"{recording}: no such film or folder; check the path")
    keys = camera_keys(camera)
    panoramas = keys["kind"] == "equirectangular"
    kind = "panoramas" if panoramas else "omni_path"
    if recording.is_file():
        kind = "omni_video"
    return {"kind": kind, "path": str(recording), "camera": keys}
