"""Where frames sit on the robot: the tree of a bag's tf_static."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import (
    BODY_FORWARD_LEFT_UP_FROM_CAMERA,
    inverse,
    is_rigid,
    pose,
    rotation_from_quaternion,
)

_NAMED = 8  # frames that a message lists
_STILL = 1e-5  # metres, and of a quaternion; less is rounding
_UPWARD = 0.7071  # cosine of 45 degrees


class FrameTree:
    """Transforms between frames that do not move against each other."""

    def __init__(self, transforms: Iterable[tuple[str, str, FloatArray]]) -> None:
        """Takes what :meth:`add` takes."""
        self._parents: dict[str, tuple[str, FloatArray]] = {}
        self._moving: set[str] = set()
        self._other: dict[str, str] = {}
        self.add(transforms, static=True)

    def add(self, transforms: Iterable[tuple[str, str, FloatArray]], static: bool) -> None:
        """Takes parent, child, and (7,) position and quaternion x, y, z, w of the child in it.

        Of several transforms of one child the last counts, as in tf. Those that are not from
        tf_static count as long as they stay the same.
        """
        for parent, child, numbers in transforms:
            if child in self._moving:
                continue
            before = self._parents.get(child)
            if before is not None and before[0] != parent:
                text = f"{child} has two parents, {before[0]} and {parent}; the latter counts"
                self._other[child] = f"tf_static: {text}"
            elif before is not None and not static and np.abs(before[1] - numbers).max() > _STILL:
                self._moving.add(child)
                del self._parents[child]
                continue
            self._parents[child] = parent, numbers

    @property
    def notes(self) -> tuple[str, ...]:
        """What is not as it should be, a line each."""
        return tuple(self._other.values())

    def __bool__(self) -> bool:
        return bool(self._parents)

    def __contains__(self, frame: str) -> bool:
        return frame in self._parents or any(p == frame for p, _ in self._parents.values())

    def pose(self, frame: str, base: str) -> FloatArray:
        """Pose (4, 4) of a frame in the axes of another.

        Raises:
            CalibrationError: the tree does not connect them, runs in a circle, or has a number that
                is none.
        """
        for name in (frame, base):
            if name not in self:
                raise CalibrationError(
                    f"tf_static has no frame {name or 'without a name'}; it has {self._names()}"
                )
        ups = [self._up(name) for name in (frame, base)]
        common = next((name for name in ups[0] if name in ups[1]), None)
        if common is None:
            raise CalibrationError(f"tf_static does not connect {frame} with {base}")
        return np.asarray(inverse(ups[1][common]) @ ups[0][common])

    def _up(self, frame: str) -> dict[str, FloatArray]:
        """Poses of a frame in itself and in all that are above it, nearest first."""
        found = {frame: np.eye(4)}
        while frame in self._parents:
            parent, numbers = self._parents[frame]
            if parent in found:
                circle = " under ".join([*list(found)[list(found).index(parent) :], parent])
                raise CalibrationError(f"tf_static runs in a circle: {circle}")
            found[parent] = _placed(frame, numbers) @ found[frame]
            frame = parent
        return found

    def _names(self) -> str:
        names = sorted({*self._parents, *(parent for parent, _ in self._parents.values())})
        more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
        return ", ".join(names[:_NAMED]) + more or "none"


def _placed(child: str, numbers: FloatArray) -> FloatArray:
    quaternion = numbers[3:]
    if np.isfinite(numbers).all() and np.linalg.norm(quaternion) > 0.5:
        found = pose(rotation_from_quaternion(quaternion), numbers[:3])
        if is_rigid(found):
            return found
    raise CalibrationError(
        f"tf_static: the transform of {child} is none: {', '.join(f'{v:g}' for v in numbers)}"
    )


def view_axes(tree: FrameTree, left: str, right: str, body: str) -> tuple[FloatArray, str]:
    """Pose (4, 4) of a camera in its frame, and what was assumed.

    Images are given in axes x right, y down, z ahead, and their frame's name says "optical"
    (REP 103). Some give a frame with the axes of a robot, x ahead and z up: there the cameras sit
    beside each other along y, or would look upwards.
    """
    if "optical" in left + right:
        return np.eye(4), ""
    try:
        apart = tree.pose(left, right)[:3, 3]
        robot = abs(apart[1]) > 2.0 * abs(apart[0])
        if not apart.any():
            robot = tree.pose(right, body)[2, 2] > _UPWARD
    except CalibrationError:
        return np.eye(4), ""
    if not robot:
        return np.eye(4), ""
    return BODY_FORWARD_LEFT_UP_FROM_CAMERA, (
        f"frame {right} of the camera has the axes of a robot, z up: the camera is taken to look "
        "along its x axis"
    )
