"""Whether numbers can be those of a camera rig, wherever they come from."""

from __future__ import annotations

from typing import get_args

import numpy as np

from fgslam.core.checks import is_finite_number
from fgslam.core.geometry import is_rigid
from fgslam.core.sensors import CameraRig
from fgslam.core.settings import RigPlaces

_FOCAL_RANGE = 1000.0
"""Of focal length and image size: at one end a telescope, at the other no picture."""


def rig_fault(rig: CameraRig) -> str:
    """Why the numbers cannot be those of a rig, and what to give; empty where they can."""
    for name in ("width", "height"):
        value = getattr(rig, name)
        if not isinstance(value, int | np.integer) or isinstance(value, bool) or value <= 0:
            return f"{name} is {value!r}; give the images' size in pixels"
    for name in ("fx", "fy", "baseline", "vertical_baseline"):
        if fault := _length_fault(rig, name):
            return fault
    for name in ("fx", "fy"):
        value, size = getattr(rig, name), max(rig.width, rig.height)
        if not size / _FOCAL_RANGE <= value <= size * _FOCAL_RANGE:
            return (
                f"{name} is {value!r} for images of {rig.width}x{rig.height} pixels; give the "
                "focal length in pixels of these images"
            )
    for name, extent in (("cx", rig.width), ("cy", rig.height)):
        value = getattr(rig, name)
        # Cropped images may have it outside, but hardly by more than their own size.
        if not is_finite_number(value) or not -extent <= value <= 2 * extent:
            return (
                f"{name} is {value!r}, far from the image of {rig.width}x{rig.height} pixels; "
                "give the principal point (column, row) in pixels of these images"
            )
    return _mounting_fault(rig)


def _mounting_fault(rig: CameraRig) -> str:
    if not isinstance(rig.exact, bool | np.bool_):
        return f"exact is {rig.exact!r}; give True for a rig known without error, as a rendered one"
    if rig.places not in get_args(RigPlaces):
        return f"places is {rig.places!r}; give {' or '.join(get_args(RigPlaces))}"
    if not is_rigid(np.asarray(rig.bTc, np.float64)):
        return (
            "bTc must be a rigid motion (4, 4), the pose of the right camera in the body; "
            "correct it, or leave it out"
        )
    return ""


def _length_fault(rig: CameraRig, name: str) -> str:
    value = getattr(rig, name)
    if name == "vertical_baseline" and value is None:
        return ""
    if is_finite_number(value) and value > 0.0:
        return ""
    what = (
        "the distance between the cameras in metres; one camera alone cannot measure depth, "
        "and a negative one means that left and right are swapped"
        if "baseline" in name
        else "the focal length in pixels"
    )
    return f"{name} is {value!r}, not a positive number; give {what}"
