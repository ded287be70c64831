"""Omnidirectional cameras as plain values, for files that name the camera they were made with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from fgslam.cameras.omni.camera import OmniCamera
from fgslam.cameras.omni.lens_camera import LensCamera
from fgslam.cameras.omni.mirrors import HyperbolicMirror, MirrorFrame, RadialPolynomial
from fgslam.cameras.omni.ocamcalib import OCamCamera
from fgslam.cameras.omni.panoramas import Cylinder, Equirectangular
from fgslam.core.errors import CalibrationError

_MODELS: dict[str, Any] = {
    model.__name__: model
    for model in (
        Equirectangular,
        Cylinder,
        HyperbolicMirror,
        RadialPolynomial,
        OCamCamera,
        LensCamera,
    )
}


def camera_values(camera: OmniCamera) -> dict[str, Any]:
    """Model and numbers of a camera, as JSON holds them to the bit.

    Raises:
        CalibrationError: it is a model of the user's own.
    """
    name = type(camera).__name__
    if _MODELS.get(name) is not type(camera):
        raise CalibrationError(
            f"camera: a {name} has no place in files; use one of {', '.join(_MODELS)}"
        )
    return {"model": name} | _plain(camera)


def camera_of(values: Any, where: str) -> OmniCamera:
    """The camera of :func:`camera_values`.

    Args:
        values: as read from a file.
        where: the file, for messages.

    Raises:
        CalibrationError: they describe none.
    """
    try:
        given = dict(values)
        model = _MODELS[given.pop("model")]
        if isinstance(given.get("frame"), Mapping):
            given["frame"] = MirrorFrame(**_tuples(given["frame"]))
        camera: OmniCamera = model(**_tuples(given))
    except (KeyError, TypeError, ValueError) as error:
        raise CalibrationError(
            f"{where}: its camera is damaged ({error}); write it again"
        ) from None
    return camera


def _plain(value: Any) -> dict[str, Any]:
    found = {f.name: getattr(value, f.name) for f in fields(value) if f.init}
    return {name: _plain(one) if name == "frame" else one for name, one in found.items()}


def _tuples(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: tuple(v) if isinstance(v, list) else v for name, v in values.items()}
