"""Settings files of other SLAM programs: ORB-SLAM, stella_vslam, VINS, camodocal."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fgslam.cameras.formats.kalibr import ocam_matrix
from fgslam.cameras.formats.trees import Tree, Values, intrinsic_matrix, read_tree
from fgslam.cameras.raw_cameras import (
    Calibration,
    RawCamera,
    StatedView,
    checked_camera,
    checked_view,
)
from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import pose

_FOCAL = ("fx", "fy", "cx", "cy")
_BROWN = ("k1", "k2", "p1", "p2")
_KANNALA = ("k1", "k2", "k3", "k4")


# --------------------------------------------------------------------------------------------
# ORB-SLAM2 and ORB-SLAM3: keys such as Camera1.fx


_ORB = {"pinhole": "radtan", "kannalabrandt8": "equidistant", "rectified": "radtan"}


def is_orb_slam(tree: Tree) -> bool:
    """Whether it is a settings file of ORB-SLAM."""
    return "Camera.fx" in tree or "Camera1.fx" in tree


def read_orb_slam(path: Path, tree: Tree, size: tuple[int, int] | None) -> Calibration:
    """The pair of a stereo settings file, or the one camera of another; the body is the left one.

    Raises:
        CalibrationError: a value is missing or impossible, or the camera's type is not known.
    """
    part = Values(path, tree)
    kind = part.text("Camera.type", "pinhole")
    if kind not in _ORB:
        raise part.refuse(f"Camera.type {kind} is not known; known: {', '.join(_ORB)}")
    if "Camera.width" in part or size is None:
        size = part.size("Camera.width", "Camera.height")
    if "LEFT.K" in part and "RIGHT.K" in part:
        return _stated_pair(part, size, ("LEFT.{}", "RIGHT.{}"), "ORB-SLAM settings", "radtan")
    first = "Camera1." if "Camera1.fx" in part else "Camera."
    left = _orb_camera(part, first, kind, size, np.eye(4))
    found = Calibration(str(path), "ORB-SLAM settings", (left,), sided=True)
    lTr = _orb_step(part, left)
    if lTr is None:
        return found
    second = "Camera2." if "Camera2.fx" in part else first
    right = _orb_camera(part, second, kind, size, lTr)
    return Calibration(str(path), found.format, (left, right), sided=True)


def _orb_step(part: Values, left: RawCamera) -> FloatArray | None:
    """Pose of the right camera in the left one; None where there is but one camera."""
    for key in ("Stereo.T_c1_c2", "Tlr"):
        if key in part:
            return part.motion(key)
    if "Stereo.b" in part:
        baseline = part.number("Stereo.b")
    elif "Camera.bf" in part:
        baseline = part.number("Camera.bf") / float(left.matrix[0, 0])
    else:
        return None
    return pose(np.eye(3), np.array([baseline, 0.0, 0.0]))


def _orb_camera(
    part: Values, prefix: str, kind: str, size: tuple[int, int], bTc: FloatArray
) -> RawCamera:
    names = _KANNALA if kind == "kannalabrandt8" else _BROWN
    parameters = part.named([prefix + name for name in names], 0.0)
    if prefix + "k3" in part and names is _BROWN:
        parameters = np.append(parameters, part.number(prefix + "k3"))
    matrix = intrinsic_matrix(*part.named([prefix + name for name in _FOCAL]))
    name = f"{part.path.name}: {prefix[:-1]}"
    return checked_camera(RawCamera(*size, matrix, parameters, bTc, name, _ORB[kind]))


def _stated_pair(
    part: Values, size: tuple[int, int], names: tuple[str, str], kind: str, model: str
) -> Calibration:
    """A pair with matrices K, D and R of each camera, beside the rectified intrinsics."""
    left, right = names
    rotations = tuple(part.matrix(name.format("R"), 3, 3) for name in names)
    if right.format("P") in part:
        projection = part.matrix(right.format("P"), 3, 4)
        matrix, offset = projection[:, :3], -projection[0, 3] / projection[0, 0]
    else:
        focal = part.named(_FOCAL)
        matrix, offset = intrinsic_matrix(*focal), part.number("focal_x_baseline") / focal[0]
    cameras = tuple(
        checked_camera(
            RawCamera(
                *size,
                part.matrix(name.format("K"), 3, 3),
                part.numbers(name.format("D")),
                pose(rotation, np.array([x, 0.0, 0.0])),
                f"{part.path.name}: {name.format('K')}",
                model,
            )
        )
        for name, rotation, x in zip((left, right), rotations, (-offset, 0.0), strict=True)
    )
    view = checked_view(StatedView((rotations[0], rotations[1]), matrix, size), str(part.path))
    return Calibration(str(part.path), kind, cameras, True, view)


# --------------------------------------------------------------------------------------------
# stella_vslam


_STELLA = {"perspective": "radtan", "fisheye": "equidistant"}


def is_stella(tree: Tree) -> bool:
    """Whether it is a configuration of stella_vslam."""
    camera = tree.get("Camera")
    return isinstance(camera, dict) and "model" in camera


def read_stella(path: Path, tree: Tree) -> Calibration:
    """The pair of a stereo configuration, or the one camera of another.

    Raises:
        CalibrationError: a value is missing or impossible, or the camera's model is not known.
    """
    camera = Values(path, tree["Camera"], "Camera.")
    model = camera.text("model")
    if model not in _STELLA:
        raise camera.refuse(
            f"model {model} is not known; known: {', '.join(_STELLA)} (panoramas: fg.load_camera)"
        )
    size, kind = camera.size("cols", "rows"), "stella_vslam configuration"
    stated = tree.get("StereoRectifier")
    if isinstance(stated, dict):
        lens = str(stated.get("model", "perspective")).lower()
        merged = Values(path, {**camera.tree, **stated}, "StereoRectifier.")
        names = ("{}_left", "{}_right")
        return _stated_pair(merged, size, names, kind, _STELLA.get(lens, "radtan"))
    terms = _KANNALA if model == "fisheye" else (*_BROWN, "k3")
    matrix = intrinsic_matrix(*camera.named(_FOCAL))
    left = RawCamera(*size, matrix, camera.named(terms, 0.0), np.eye(4), path.name, _STELLA[model])
    cameras = [checked_camera(left)]
    if camera.text("setup") == "stereo":
        offset = camera.number("focal_x_baseline") / matrix[0, 0]
        bTc = pose(np.eye(3), np.array([offset, 0.0, 0.0]))
        cameras.append(RawCamera(*size, matrix, left.distortion, bTc, path.name, left.model))
    return Calibration(str(path), kind, tuple(cameras), sided=True)


# --------------------------------------------------------------------------------------------
# camodocal, and VINS-Fusion whose configuration names two of its files


_CAMODOCAL = ("pinhole", "mei", "kannala_brandt")


def is_camodocal(tree: Tree) -> bool:
    """Whether it is one camera of camodocal."""
    return "model_type" in tree


def read_camodocal(path: Path, tree: Tree) -> Calibration:
    """One camera: PINHOLE, MEI or KANNALA_BRANDT."""
    return Calibration(str(path), "camodocal camera", (_camodocal(path, tree, np.eye(4)),))


def _camodocal(path: Path, tree: Tree, bTc: FloatArray) -> RawCamera:
    part = Values(path, tree)
    kind = part.text("model_type")
    inner, brown = part.inside("projection_parameters"), part.inside("distortion_parameters")
    if kind == "mei":
        xi = part.inside("mirror_parameters").number("xi")
        focal = inner.named(("gamma1", "gamma2", "u0", "v0"))
        parameters, model = np.append(xi, brown.named(_BROWN)), "omni"
    elif kind == "kannala_brandt":
        focal = inner.named(("mu", "mv", "u0", "v0"))
        parameters, model = inner.named(("k2", "k3", "k4", "k5")), "equidistant"
    elif kind == "pinhole":
        focal, parameters, model = inner.named(_FOCAL), brown.named(_BROWN), "radtan"
    else:
        raise part.refuse(f"model_type {kind} is not known; known: {', '.join(_CAMODOCAL)}")
    size = part.size("image_width", "image_height")
    matrix = intrinsic_matrix(*focal)
    return checked_camera(RawCamera(*size, matrix, parameters, bTc, path.name, model))


def is_vins(tree: Tree) -> bool:
    """Whether it is a configuration of VINS-Fusion."""
    return "cam0_calib" in tree


def read_vins(path: Path, tree: Tree) -> Calibration:
    """Its cameras, each in a file of its own beside it; the body is the IMU.

    Raises:
        CalibrationError: a file is missing or malformed.
    """
    part = Values(path, tree)
    cameras = []
    for k in (0, 1):
        if f"cam{k}_calib" not in part:
            continue
        beside = path.parent / str(part.tree[f"cam{k}_calib"])
        own = read_tree(beside)
        if own is None or not is_camodocal(own):
            raise part.refuse(f"cam{k}_calib names {beside}, which is no camera of camodocal")
        cameras.append(_camodocal(beside, own, part.motion(f"body_T_cam{k}")))
    return Calibration(str(path), "VINS-Fusion configuration", tuple(cameras))


# --------------------------------------------------------------------------------------------
# MultiCol-SLAM: one camera of OCamCalib


def is_multicol(tree: Tree) -> bool:
    """Whether it is one camera of MultiCol-SLAM."""
    return "Camera.a0" in tree


def read_multicol(path: Path, tree: Tree) -> Calibration:
    """One camera: OCamCalib's model under keys such as Camera.a0."""
    part = Values(path, tree)
    count = round(part.number("Camera.nrpol", 5.0))
    parameters = part.named([f"Camera.a{k}" for k in range(count)])
    centre = part.named(("Camera.u0", "Camera.v0"))
    affine = part.named(("Camera.c", "Camera.d", "Camera.e"))
    matrix = ocam_matrix((affine[0], affine[1], affine[2]), (centre[0], centre[1]))
    size = part.size("Camera.Iw", "Camera.Ih")
    camera = RawCamera(*size, matrix, parameters, np.eye(4), path.name, "ocam")
    return Calibration(str(path), "MultiCol-SLAM camera", (checked_camera(camera),))
