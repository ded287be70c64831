"""From a calibration to a rectified rig: which camera is which, the common view, what to tell."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from fgslam.cameras.corrected import correction_values
from fgslam.cameras.raw_cameras import Calibration, RawCamera, StatedView, checked_camera
from fgslam.cameras.rectification import (
    Rectifier,
    View,
    chosen_view,
    orientation,
    rectifier,
)
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import pose
from fgslam.core.sensors import CameraRig

_LEAST_BASELINE_M = 1e-3  # below it two cameras are one, up to rounding
# Longer than any vehicle carries; in millimetres even an eye's 10 mm are more.
_LONGEST_BASELINE_M = 3.0
# Cosine of 45 degrees: beyond, a common image plane would stretch the views out of use.
_LEAST_COMMON_VIEW = 0.707
# A stated view with less of the raw resolution than this has collapsed.
_LEAST_STATED = 0.5
_SAME_PX = 1e-3  # cameras that differ by less are rectified already
_TOLD_SHARE = 0.8  # of the angle of view; less is said to be cut off
_TOLD_SKEW_DEG = 0.5  # from a right angle between the baselines, of three cameras


@dataclass(frozen=True, slots=True, eq=False)
class Assembly:
    """A rectified rig.

    Attributes:
        rig: reference = right camera.
        rectifier: what rectifies its raw images; None where they are rectified already.
        sources: which of the file's cameras are right, left[, top].
        remarks: what a user should know, a line each.
    """

    rig: CameraRig
    rectifier: Rectifier | None
    sources: tuple[int, ...]
    remarks: tuple[str, ...]


def assembled(calibration: Calibration, fov_deg: float | None = None) -> Assembly:
    """The rig of a calibration.

    Args:
        calibration: of two or three cameras.
        fov_deg: horizontal angle of the rectified view; None: as much as all cameras fill.

    Raises:
        CalibrationError: it is of one camera only or of more than three, their images differ in
            size, or they are no stereo pair.
    """
    cameras = _usable(calibration)
    sources, turn, told = _pair(cameras) if len(cameras) == 2 else _three(cameras)
    chosen = tuple(cameras[k] for k in sources)
    _require_side_by_side(chosen, turn)
    rotations, view, also = _view(calibration, chosen, sources, turn, fov_deg)
    found = rectifier(chosen, rotations, view, _corrected(calibration))
    found = replace(found, calibration=_with_view(calibration, sources, rotations, view))
    remarks = (*calibration.notes, *told, *also)
    if calibration.sided and len(sources) == 2:
        found = replace(found, order=tuple(_GIVEN_AS[k] for k in sources))
        if sources == (0, 1) and not told:
            remarks = (*remarks, _swapped(chosen, found.rig))
    remarks = (*remarks, *implausible(calibration.source, found.rig))
    straight = found.order[:2] == (0, 1) and fov_deg is None and _is_rectified(chosen, turn)
    kept = None if straight and found.correction is None else found
    return Assembly(found.rig, kept, sources, remarks)


_GIVEN_AS = (1, 0, 2)
"""Where the images of a sided file's left, right and third camera are among right, left, top."""


def _corrected(calibration: Calibration) -> Callable[[CameraRig], FloatArray] | None:
    values = calibration.corrections
    if values is None:
        return None
    return lambda rig: correction_values(calibration.source, values, rig)


def _with_view(
    calibration: Calibration,
    sources: tuple[int, ...],
    rotations: Sequence[FloatArray],
    view: View,
) -> Calibration:
    """The calibration with the view that was chosen, without corrections."""
    turns = [np.eye(3)] * len(calibration.cameras)
    for source, rotation in zip(sources, rotations, strict=True):
        turns[source] = rotation
    stated = StatedView(tuple(turns), view.matrix, view.size)
    return replace(calibration, view=stated, corrections=None)


def _usable(calibration: Calibration) -> tuple[RawCamera, ...]:
    cameras = calibration.cameras
    if len(cameras) == 1:
        raise CalibrationError(
            f"{calibration.source}: one camera alone ({calibration.format}) knows no baseline; "
            "give the calibration of the pair, or both cameras' files"
        )
    if len(cameras) > 3:
        raise CalibrationError(
            f"{calibration.source}: holds {len(cameras)} cameras; say which two or three form the "
            "rig: cameras=(0, 1)"
        )
    for camera in cameras:
        if camera.width == 0:
            raise CalibrationError(
                f"{calibration.source} does not state the images' size; give size=(width, "
                "height), on the command line --size WxH"
            )
    _require_one_size(cameras)
    return cameras


def _require_one_size(cameras: Sequence[RawCamera]) -> None:
    first = cameras[0]
    for camera in cameras:
        if camera.size != first.size:
            raise CalibrationError(
                f"{first.name} is {first.width}x{first.height} but {camera.name} is "
                f"{camera.width}x{camera.height}; both must have one resolution"
            )


# --------------------------------------------------------------------------------------------
# Which camera is which


Placed: TypeAlias = tuple[tuple[int, ...], FloatArray, tuple[str, ...]]
"""The cameras that are right, left[, top], how the view is turned, and what to tell."""


def _offset(camera: RawCamera, reference: RawCamera) -> FloatArray:
    """Position (3,) of a camera in another's axes."""
    turned = reference.bTc[:3, :3]
    return np.asarray((camera.bTc[:3, 3] - reference.bTc[:3, 3]) @ turned)


def _pair(cameras: Sequence[RawCamera]) -> Placed:
    """Right and left: the left one sees the other at +x. Of two above each other, the upper one."""
    x, y, _ = _offset(cameras[1], cameras[0])
    if abs(x) >= abs(y):
        return ((1, 0) if x > 0.0 else (0, 1)), np.eye(3), ()
    lower, upper = (1, 0) if y > 0.0 else (0, 1)
    text = (
        f"{cameras[upper].name} is above {cameras[lower].name}: the view is turned by a quarter "
        "turn, in which the upper camera is the left one"
    )
    return (lower, upper), _quarter_turn(upper_side=True), (text,)


def is_stereo_pair(cameras: Sequence[RawCamera]) -> bool:
    """Whether two cameras see the same from beside each other, or above."""
    sources, turn, _ = _pair(cameras)
    try:
        _require_side_by_side([cameras[k] for k in sources], turn)
    except CalibrationError:
        return False
    return True


def _quarter_turn(upper_side: bool) -> FloatArray:
    """Turn (3, 3) of the view after which the camera above, or the one below, is the left one."""
    sign = 1.0 if upper_side else -1.0
    return np.array([[0.0, sign, 0.0], [-sign, 0.0, 0.0], [0.0, 0.0, 1.0]])


def _three(cameras: Sequence[RawCamera]) -> Placed:
    """Right, left[, top], how the view is turned about its axis, and what to tell.

    Of cameras in a line the outer two are used. The corner of an L becomes the right one; the view
    is turned by a multiple of 90 degrees where its neighbours are not to the left and above.
    """
    across = [k for k in range(3) if not _in_line(cameras, k)]
    if not across:
        x = [_offset(camera, cameras[0])[0] for camera in cameras]
        right, left = int(np.argmax(x)), int(np.argmin(x))
        third = 3 - right - left
        text = f"three cameras in a line: {cameras[third].name}, between the others, is not used"
        return (right, left), np.eye(3), (text,)
    corner = min(range(3), key=lambda k: abs(_cosine(cameras, k)))
    away = [_offset(camera, cameras[corner])[:2] for camera in cameras]
    others = [k for k in range(3) if k != corner]
    beside = max(others, key=lambda k: abs(away[k][0]) - abs(away[k][1]))
    above = next(k for k in others if k != beside)
    left_side, upper_side = away[beside][0] < 0.0, away[above][1] < 0.0
    skew = 90.0 - np.degrees(np.arccos(np.clip(_cosine(cameras, corner), -1.0, 1.0)))
    told: tuple[str, ...] = ()
    if abs(skew) > _TOLD_SKEW_DEG:
        told = (
            f"the two baselines are {abs(skew):.1f} degrees off a right angle: columns of the top "
            f"image differ by {np.sin(np.radians(abs(skew))):.3f} of the vertical disparity",
        )
    if left_side == upper_side:
        turn = np.eye(3) if left_side else np.diag([-1.0, -1.0, 1.0])
        return (corner, beside, above), turn, told
    return (corner, above, beside), _quarter_turn(upper_side), told


def _sides(cameras: Sequence[RawCamera], corner: int) -> tuple[FloatArray, FloatArray]:
    first, second = (
        camera.bTc[:3, 3] - cameras[corner].bTc[:3, 3]
        for k, camera in enumerate(cameras)
        if k != corner
    )
    return first, second


def _cosine(cameras: Sequence[RawCamera], corner: int) -> float:
    a, b = _sides(cameras, corner)
    return float(a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-12))


def _in_line(cameras: Sequence[RawCamera], corner: int) -> bool:
    return bool(abs(_cosine(cameras, corner)) > np.cos(np.radians(15.0)))


def _require_side_by_side(chosen: Sequence[RawCamera], turn: FloatArray) -> None:
    """Raises CalibrationError unless the cameras form a stereo rig."""
    right, left = chosen[:2]
    offset = turn @ _offset(right, left)
    if np.linalg.norm(offset) < _LEAST_BASELINE_M:
        raise CalibrationError(
            f"{left.name} and {right.name} are {1e3 * np.linalg.norm(offset):.3g} mm apart, as one "
            "camera; check T_BS (or T) in the calibration, and the unit of its lengths (--unit)"
        )
    if np.abs(offset[0]) < 2.0 * np.hypot(offset[1], offset[2]):
        x, y, z = offset
        raise CalibrationError(
            f"{left.name} and {right.name} are not side by side (offset {x:.3f}, {y:.3f}, {z:.3f} "
            "m along x, y, z); check T_BS (or R and T) in the calibration"
        )
    for other in chosen[1:]:
        if right.bTc[:3, 2] @ other.bTc[:3, 2] < _LEAST_COMMON_VIEW:
            raise CalibrationError(
                f"{other.name} and {right.name} look more than 45 degrees apart; check T_BS (or R "
                "and T) in the calibration"
            )


# --------------------------------------------------------------------------------------------
# The view


def _view(
    calibration: Calibration,
    chosen: Sequence[RawCamera],
    sources: tuple[int, ...],
    turn: FloatArray,
    fov_deg: float | None,
) -> tuple[tuple[FloatArray, ...], View, tuple[str, ...]]:
    """Rotation of each camera into the view, the view, and what to tell."""
    stated = calibration.view
    if stated is not None and fov_deg is None and calibration.corrections is not None:
        rotations = tuple(stated.rotations[k] for k in sources)
        return rotations, View(stated.matrix, stated.size), ()
    calibration.require_uncorrected("another view (fov_deg) is asked for")
    if fov_deg is None and _is_rectified(chosen, turn):
        return (np.eye(3),) * len(chosen), View(chosen[0].matrix, chosen[0].size), ()
    told: tuple[str, ...] = ()
    natural = float(np.mean([camera.focal_px for camera in chosen]))
    if stated is not None and fov_deg is None:
        if stated.matrix[0, 0] > _LEAST_STATED * natural:
            rotations = tuple(stated.rotations[k] for k in sources)
            return rotations, View(stated.matrix, stated.size), ()
        told = (
            f"the rectified focal length that the file states, {stated.matrix[0, 0]:.0f} px, would "
            f"shrink the images ({natural:.0f} px); another view is chosen",
        )
    width, height = chosen[0].size
    size = (width, height) if abs(turn[0, 0]) > 0.5 else (height, width)
    axes = np.array([camera.bTc[:3, 2] for camera in chosen])
    body_to_view = orientation([camera.bTc[:3, 3] for camera in chosen], axes)
    rotations = tuple(body_to_view @ camera.bTc[:3, :3] for camera in chosen)
    view = chosen_view(chosen, rotations, size, fov_deg)
    seen = np.degrees(chosen[0].field_of_view()[:2])
    seen = seen if size == chosen[0].size else seen[::-1]
    return rotations, view, (*told, *_cut_off(seen, view))


def _cut_off(seen: FloatArray, view: View) -> tuple[str, ...]:
    """What the view does not show of the angles (2,) across and down that a camera sees."""
    kept = np.degrees(view.angles)
    if kept[0] > _TOLD_SHARE * seen[0]:
        return ()
    return (
        f"of {seen[0]:.0f} x {seen[1]:.0f} degrees the rectified view shows {kept[0]:.0f} x "
        f"{kept[1]:.0f}; what lies beyond is cut off (dataset.fov_deg chooses another angle)",
    )


def _is_rectified(chosen: Sequence[RawCamera], turn: FloatArray) -> bool:
    """Whether the images are rectified as they are: equal cameras, to the left and above."""
    right = chosen[0]
    if not np.array_equal(turn, np.eye(3)):
        return False
    for k, camera in enumerate(chosen):
        turned = right.bTc[:3, :3].T @ camera.bTc[:3, :3]
        away = np.delete(_offset(camera, right), 0 if k == 1 else 1)
        if (
            camera.model != "radtan"
            or camera.distortion.any()
            or not np.allclose(camera.matrix, right.matrix, rtol=0.0, atol=_SAME_PX)
            or not np.allclose(turned, np.eye(3), rtol=0.0, atol=1e-6)
            or np.abs(away).max() > 1e-6
        ):
            return False
    return True


# --------------------------------------------------------------------------------------------
# What to tell


def _swapped(chosen: Sequence[RawCamera], rig: CameraRig) -> str:
    return (
        f"left and right are swapped: {chosen[0].name}, the left one by its name, is "
        f"{rig.baseline:.3f} m to the right of the other; its images are taken as the right ones"
    )


def implausible(source: str, rig: CameraRig) -> tuple[str, ...]:
    """A remark where no vehicle carries cameras so far apart."""
    if rig.baseline <= _LONGEST_BASELINE_M:
        return ()
    return (
        f"{source}: the baseline is {rig.baseline:.4g} m; if its unit is not the metre, give it: "
        "--unit 0.001 for millimetres, or the side of a square in metres (unit_m of load_rig)",
    )


# --------------------------------------------------------------------------------------------
# Changes before that are asked for


def in_metres(calibration: Calibration, unit_m: float) -> Calibration:
    """The calibration with its lengths, given in a unit of ``unit_m`` metres, in metres."""
    if unit_m == 1.0:
        return calibration
    cameras = tuple(
        replace(c, bTc=pose(c.bTc[:3, :3], unit_m * c.bTc[:3, 3])) for c in calibration.cameras
    )
    return replace(calibration, cameras=cameras)


def at_size(calibration: Calibration, size: tuple[int, int] | None, scale: bool) -> Calibration:
    """The calibration for images of a size.

    Raises:
        CalibrationError: it is for images of another size, and scaling was not asked for.
    """
    if size is None:
        return calibration
    other = [c for c in calibration.cameras if c.size != size and c.width]
    if other:
        calibration.require_uncorrected(f"images of {size[0]}x{size[1]} pixels are given")
    if other and not scale:
        _require_one_size(calibration.cameras)
        different = (
            f"{calibration.source} is for images of {other[0].width}x{other[0].height} pixels, the "
            f"images have {size[0]}x{size[1]}"
        )
        if other[0].size == size[::-1]:
            raise CalibrationError(
                f"{different}: they lie on their side; turn them upright again (of a film: remove "
                "its rotation), or calibrate them as they are"
            )
        raise CalibrationError(
            f"{different}; if they were resized as a whole, say so: --set "
            "dataset.resized=true, --scale of fgslam camera, scale=True of load_rig"
        )
    cameras = tuple(
        c.scaled(size) if c.width else checked_camera(replace(c, width=size[0], height=size[1]))
        for c in calibration.cameras
    )
    view = calibration.view if not other else None
    return replace(calibration, cameras=cameras, view=view)
