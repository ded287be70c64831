"""Calibration files of other tools: which key holds which number, in what unit.

A format is a :class:`Row` of keys, or a few lines around one. Which format a file has is found at
the end (:func:`calibration_of_tree`, :func:`calibration_of_text`).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from configparser import ConfigParser
from configparser import Error as ConfigParserError
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fgslam.cameras.lenses import (
    LENSES,
    Calibration,
    RawCamera,
    StatedView,
    checked_camera,
    checked_view,
)
from fgslam.cameras.omni import read_ocamcalib
from fgslam.cameras.stereo_formats import (
    has_intrinsics,
    has_step,
    is_camera_info,
    is_opencv_one,
    is_opencv_pair,
    read_camera_info,
    read_kitti,
    read_opencv_one,
    read_opencv_pair,
)
from fgslam.cameras.trees import (
    BROWN,
    FOCAL,
    KANNALA,
    ORIGIN,
    Row,
    Size,
    Tree,
    Values,
    camera_of,
    flat_numbers,
    intrinsic_matrix,
    kind_of,
    read_json,
    read_tree,
)
from fgslam.core.arrays import FloatArray
from fgslam.core.checks import is_finite_number
from fgslam.core.errors import CalibrationError
from fgslam.core.files import read_text
from fgslam.core.geometry import (
    BODY_FORWARD_LEFT_UP_FROM_CAMERA,
    inverse,
    is_rigid,
    pose,
    rotation_from_quaternion,
)
from fgslam.core.sensors import CameraRig

# --------------------------------------------------------------------------------------------
# fgslam's own calib.json, of cameras as calibrated


OWN_FORMAT = "calib.json of fgslam"
CORRECTIONS = "corrections"
OF_RECTIFIED = {"baseline_m", "baseline", "rectified", "fx"}
_OWN = Row(
    size=("width", "height"),
    matrix="matrix",
    kind=("model",),
    lenses={model: (model, ("parameters",)) for model in LENSES},
)


def is_rectified(tree: Tree) -> bool:
    """Whether it is a ``calib.json`` of rectified cameras."""
    return not _is_own(tree) and bool(OF_RECTIFIED & tree.keys())


def _is_own(tree: Tree) -> bool:
    cameras = tree.get("cameras")
    first = cameras[0] if isinstance(cameras, list) and cameras else None
    return isinstance(first, dict) and {"model", "matrix"} <= first.keys()


def _read_own(path: Path, tree: Tree, _: Size | None) -> Calibration:
    parts = [Values(path, values, f"cameras[{k}].") for k, values in enumerate(tree["cameras"])]
    corrections = stated_corrections(path, tree)
    if corrections is not None and "rectified_view" not in tree:
        raise CalibrationError(
            f"{path}: {CORRECTIONS} are of rectified images, but rectified_view is missing; "
            f"restore it, or remove {CORRECTIONS}"
        )
    return Calibration(
        str(path),
        OWN_FORMAT,
        tuple(
            camera_of(part, _OWN, part.motion("bTc"), str(part.tree.get("name", part.where[:-1])))
            for part in parts
        ),
        sided=tree.get("sided") is True,
        view=_own_view(Values(path, tree).inside("rectified_view"), len(parts)),
        corrections=corrections,
    )


def stated_corrections(path: Path, tree: Tree) -> Mapping[str, float] | None:
    """Its corrections by name; None where it has none. Raises CalibrationError: no object."""
    values = tree.get(CORRECTIONS)
    if values is not None and not isinstance(values, dict):
        raise CalibrationError(
            f"{path}: {CORRECTIONS} must be an object with a number for each term; correct or "
            "remove it"
        )
    return values


def _own_view(part: Values, cameras: int) -> StatedView | None:
    if not part.tree:
        return None
    kind = part.text("kind", "perspective")
    if kind != "perspective":
        raise part.refuse(f"kind is {kind!r}, but a view is perspective; rectify anew")
    rotations = part.numbers("rotations", 9 * cameras).reshape(cameras, 3, 3)
    if not all(is_rigid(pose(rotation, np.zeros(3))) for rotation in rotations):
        raise part.refuse("rotations has one that is no rotation; correct the file")
    size = part.size("width", "height")
    if min(size) <= 0:
        raise part.refuse(f"width and height are {size[0]} and {size[1]}; correct the file")
    view = StatedView(tuple(rotations), part.matrix("matrix", 3, 3), size)
    return checked_view(view, str(part.path))


# --------------------------------------------------------------------------------------------
# The same, of rectified cameras

# 'baseline' is close to 'baseline_m' (0.89); 'fy' to 'fx' (0.5) and 'baseline_m' to
# 'vertical_baseline_m' (0.69), which are keys of their own, are not.
_CLOSE_NAMES = 0.8


def read_rectified(path: Path, three_cameras: bool) -> CameraRig:
    """The rig of a ``calib.json``; ``three_cameras`` asks for its vertical baseline as well.

    Raises:
        CalibrationError: a value is missing, not finite or impossible.
    """
    values = read_json_object(path)
    if values.get("rectified") is False:
        raise CalibrationError(
            f"{path} says that the images are not rectified; rectify them first (rows of the left "
            "and right image must agree), or give the raw cameras' calibration by --camera FILE"
        )
    if values.get("view", "perspective") != "perspective":
        raise CalibrationError(
            f"{path}: view is {values['view']!r}, but rectified images are perspective ones; "
            "rectify the raw images anew"
        )
    bTc = BODY_FORWARD_LEFT_UP_FROM_CAMERA
    if "bTc" in values:
        found = flat_numbers(values["bTc"])
        bTc = np.empty(0) if found is None or len(found) != 16 else found.reshape(4, 4)
        if not is_rigid(bTc):
            raise CalibrationError(
                f"{path}: bTc must be a rigid 4x4 matrix (the pose of the right camera in the "
                "body); correct or remove it"
            )
    return CameraRig(
        width=pixels(path, values, "width"),
        height=pixels(path, values, "height"),
        fx=positive(path, values, "fx"),
        fy=positive(path, values, "fy"),
        cx=number(path, values, "cx"),
        cy=number(path, values, "cy"),
        baseline=positive(path, values, "baseline_m"),
        vertical_baseline=positive(path, values, "vertical_baseline_m") if three_cameras else None,
        bTc=bTc,
    )


def read_json_object(path: Path) -> Mapping[str, Any]:
    """A JSON file's outermost object. Raises CalibrationError when there is none."""
    remedy = "give a calibration: this file (docs/datasets/images.md has its keys), or "
    remedy += "another one by --camera FILE"
    values = read_json(path, read_text(path, CalibrationError, remedy))
    if not isinstance(values, dict):
        raise CalibrationError(f"{path} must hold one JSON object with the calibration's keys")
    return values


def number(path: Path, values: Mapping[str, Any], key: str) -> float:
    """A finite number of the calibration. Raises CalibrationError otherwise."""
    if key not in values:
        remedy = "add it to the calibration"
        for close in get_close_matches(key, values, n=1, cutoff=_CLOSE_NAMES):
            unit = " in metres" if key.endswith("_m") else ""
            remedy = f"if {close!r} means it, rename it to {key!r} (a number{unit})"
        raise CalibrationError(f"{path} has no {key!r}; {remedy}")
    value = values[key]
    if not is_finite_number(value):
        raise CalibrationError(f"{path}: {key} is {value!r}, not a finite number; correct it")
    return float(value)


def positive(path: Path, values: Mapping[str, Any], key: str) -> float:
    """A positive number of the calibration. Raises CalibrationError otherwise."""
    value = number(path, values, key)
    if value <= 0.0:
        hint = "correct it"
        if "baseline" in key:
            hint = "it is the distance between the cameras in metres; if left and right are "
            hint += "swapped, swap the folders"
        raise CalibrationError(f"{path}: {key} is {value:g}, must be positive: {hint}")
    return value


def pixels(path: Path, values: Mapping[str, Any], key: str) -> int:
    """A positive whole number of the calibration. Raises CalibrationError otherwise."""
    value = positive(path, values, key)
    if value != int(value):
        raise CalibrationError(f"{path}: {key} is {value:g}, not a whole number of pixels")
    return int(value)


# --------------------------------------------------------------------------------------------
# Kalibr's camchain, and the files of tools that write it: OpenVINS, MSCKF-VIO, Kimera-VIO


_KALIBR = {
    "pinhole-radtan": ("radtan", 0),
    "pinhole-none": ("radtan", 0),
    "pinhole-equidistant": ("equidistant", 0),
    "pinhole-equi": ("equidistant", 0),
    "pinhole-fov": ("fov", 0),
    "omni-radtan": ("omni", 1),
    "omni-none": ("omni", 1),
    "ds-none": ("ds", 2),
    "eucm-none": ("eucm", 2),
}
"""Our model, and how many of the intrinsics are the model's own; fx, fy, cx and cy follow."""
_CONTRADICTION_M = 0.005  # what two calibrations of one rig agree to, and the angle next to it
_CONTRADICTION = np.cos(np.radians(1.0))


def is_camchain(tree: Tree) -> bool:
    """Whether it holds a camera ``cam0`` with a model, as Kalibr writes it."""
    first = tree.get("cam0", tree.get("input_camera"))
    return isinstance(first, dict) and "camera_model" in first


def _read_camchain(path: Path, tree: Tree, _: Size | None) -> Calibration:
    """Cameras ``cam0``, ``cam1``, ...; the body is the IMU where it is stated, else the first.

    ``T_cn_cnm1`` of a camera takes points from the axes of the one before it to its own,
    ``T_cam_imu`` those of the IMU, and ``T_imu_cam`` is a camera's pose in the IMU.
    """
    names = [name for name in (f"cam{k}" for k in range(16)) if name in tree] or ["input_camera"]
    parts = [Values(path, tree[name], f"{name}.") for name in names]
    by_imu = all("T_cam_imu" in part or "T_imu_cam" in part for part in parts)
    cameras: list[RawCamera] = []
    for part in parts:
        if cameras and ("T_cn_cnm1" in part or not by_imu):  # what Kalibr measured directly
            bTc = cameras[-1].bTc @ inverse(part.motion("T_cn_cnm1"))
        elif not by_imu:
            bTc = np.eye(4)
        elif "T_imu_cam" in part:
            bTc = part.motion("T_imu_cam")
        else:
            bTc = inverse(part.motion("T_cam_imu"))
        cameras.append(_kalibr_camera(part, bTc))
    notes = tuple(_contradiction(part, k, parts, cameras) for k, part in enumerate(parts) if k)
    told = tuple(filter(None, notes))
    return Calibration(str(path), "Kalibr camchain", tuple(cameras), notes=told)


def _kalibr_camera(part: Values, bTc: FloatArray) -> RawCamera:
    model, own = _KALIBR[kind_of(part, ("camera_model", "distortion_model"), _KALIBR)]
    intrinsics = part.numbers("intrinsics", own + 4)
    none = part.text("distortion_model", "none") == "none"
    coefficients = np.zeros(0) if none else part.numbers("distortion_coeffs")
    if model in ("radtan", "omni") and not len(coefficients):
        coefficients = np.zeros(4)
    return checked_camera(
        RawCamera(
            *part.size("resolution"),
            intrinsic_matrix(*intrinsics[own:]),
            np.concatenate([intrinsics[:own], coefficients]),
            bTc,
            part.name,
            model,
            str(part.tree.get("rostopic") or ""),
        )
    )


def _contradiction(part: Values, k: int, parts: list[Values], cameras: list[RawCamera]) -> str:
    """What to tell where the step to a camera and the places on the IMU say different things."""
    if not all("T_cam_imu" in p for p in (part, parts[k - 1])) or "T_cn_cnm1" not in part:
        return ""
    by_imu = parts[k - 1].motion("T_cam_imu") @ inverse(part.motion("T_cam_imu"))
    by_step = inverse(cameras[k - 1].bTc) @ cameras[k].bTc
    apart = float(np.linalg.norm(by_imu[:3, 3] - by_step[:3, 3]))
    cosine = 0.5 * (float(np.trace(by_imu[:3, :3].T @ by_step[:3, :3])) - 1.0)
    if apart < _CONTRADICTION_M and cosine > _CONTRADICTION:
        return ""
    return (
        f"{part.path.name}: {part.where}T_cn_cnm1 and T_cam_imu contradict each other by "
        f"{apart:.3f} m and {np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))):.1f} degrees; "
        "T_cn_cnm1 is taken"
    )


# --------------------------------------------------------------------------------------------
# The ASL layout (EuRoC): one sensor.yaml a camera


_LISTED = ("distortion_coefficients",)
_ASL = Row(
    size=("resolution",),
    focal=("intrinsics",),
    kind=("distortion_model",),
    lenses={
        "radial-tangential": ("radtan", _LISTED),
        "radtan": ("radtan", _LISTED),
        "plumb_bob": ("radtan", _LISTED),
        "rational": ("radtan", _LISTED),
        "none": ("radtan", ()),
        "equidistant": ("equidistant", _LISTED),
        "fisheye": ("equidistant", _LISTED),
        "fov": ("fov", _LISTED),
        "omni": ("ocam", _LISTED),
    },
)


def is_asl(tree: Tree) -> bool:
    """Whether it is a camera's sensor.yaml."""
    return "T_BS" in tree and "intrinsics" in tree


def read_asl_camera(path: Path, tree: Tree) -> RawCamera:
    """The camera of a sensor.yaml; ``T_BS`` is its pose in the body.

    Raises:
        CalibrationError: a value is missing, not finite or impossible, or the distortion model is
            not known.
    """
    part = Values(path, tree)
    name = str(path.parent) if path.name == "sensor.yaml" else path.name
    bTc = part.motion("T_BS") if "T_BS" in part else np.eye(4)
    if part.text("distortion_model") != "omni":
        return camera_of(part, _ASL, bTc, name)
    # Kimera's omnidirectional camera: the polynomial's depth grows forward.
    centre, (e, d, c) = part.numbers("omni_distortion_center", 2), part.numbers("omni_affine", 3)
    depth = -part.numbers(*_LISTED)
    matrix = ocam_matrix((c, d, e), centre)
    return checked_camera(RawCamera(*part.size("resolution"), matrix, depth, bTc, name, "ocam"))


def _read_asl(path: Path, tree: Tree, _: Size | None) -> Calibration:
    return Calibration(str(path), "ASL sensor.yaml", (read_asl_camera(path, tree),))


def read_asl_mounting(path: Path) -> FloatArray:
    """``T_BS`` (4, 4) of a sensor.yaml: the pose of the sensor in the body."""
    return Values(path, read_tree(path)).motion("T_BS")


def ocam_matrix(affine: Iterable[float], centre: Sequence[float] | FloatArray) -> FloatArray:
    """(3, 3) of OCamCalib's affine parameters (c, d, e) and its centre (column, row)."""
    c, d, e = affine
    return np.array([[1.0, e, centre[0]], [d, c, centre[1]], [0.0, 0.0, 1.0]])


# --------------------------------------------------------------------------------------------
# Settings of SLAM programs: ORB-SLAM 2 and 3, stella_vslam, camodocal, VINS-Fusion, MultiCol-SLAM


_ORB = {"pinhole": "radtan", "kannalabrandt8": "equidistant", "rectified": "radtan"}


def _read_orb_slam(path: Path, tree: Tree, size: Size | None) -> Calibration:
    """The pair of a stereo file, or the one camera of another; the body is the left one."""
    part = Values(path, {"Camera.type": "pinhole", **tree})
    model = _ORB[kind_of(part, ("Camera.type",), _ORB)]
    if "Camera.width" in part or size is None:
        size = part.size("Camera.width", "Camera.height")
    if "LEFT.K" in part and "RIGHT.K" in part:
        return _rectified_pair(part, size, ("LEFT.{}", "RIGHT.{}"), "ORB-SLAM settings", "radtan")
    sized = Values(path, {**part.tree, "size": list(size)})

    def camera(prefix: str, bTc: FloatArray) -> RawCamera:
        terms = KANNALA if model == "equidistant" else BROWN
        keys = tuple(f"{prefix}{name}?" for name in terms)
        if model == "radtan" and prefix + "k3" in part:
            keys = (*keys, prefix + "k3")
        focal = tuple(prefix + name for name in FOCAL)
        row = Row(size=("size",), focal=focal, lenses={"": (model, keys)})
        return camera_of(sized, row, bTc, f"{path.name}: {prefix[:-1]}")

    first = "Camera1." if "Camera1.fx" in part else "Camera."
    cameras = [camera(first, np.eye(4))]
    lTr = next((part.motion(key) for key in ("Stereo.T_c1_c2", "Tlr") if key in part), None)
    if lTr is None and ("Stereo.b" in part or "Camera.bf" in part):
        focal = float(cameras[0].matrix[0, 0])
        given = "Stereo.b" in part
        baseline = part.number("Stereo.b") if given else part.number("Camera.bf") / focal
        lTr = pose(np.eye(3), np.array([baseline, 0.0, 0.0]))
    if lTr is not None:
        cameras.append(camera("Camera2." if "Camera2.fx" in part else first, lTr))
    return Calibration(str(path), "ORB-SLAM settings", tuple(cameras), sided=True)


def _rectified_pair(
    part: Values, size: Size, names: tuple[str, str], form: str, model: str
) -> Calibration:
    """A pair with matrices K, D and R of each camera, beside the rectified intrinsics."""
    rotations = tuple(part.matrix(name.format("R"), 3, 3) for name in names)
    if names[1].format("P") in part:
        projection = part.matrix(names[1].format("P"), 3, 4)
        matrix, offset = projection[:, :3], -projection[0, 3] / projection[0, 0]
    else:
        matrix = part.intrinsics(FOCAL)
        offset = part.number("focal_x_baseline") / matrix[0, 0]
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
        for name, rotation, x in zip(names, rotations, (-offset, 0.0), strict=True)
    )
    view = checked_view(StatedView((rotations[0], rotations[1]), matrix, size), str(part.path))
    return Calibration(str(part.path), form, cameras, True, view)


_STELLA = Row(
    size=("cols", "rows"),
    kind=("model",),
    lenses={
        "perspective": ("radtan", ("k1?", "k2?", "p1?", "p2?", "k3?")),
        "fisheye": ("equidistant", ("k1?", "k2?", "k3?", "k4?")),
    },
)


def _is_stella(tree: Tree) -> bool:
    camera = tree.get("Camera")
    return isinstance(camera, dict) and "model" in camera


def _read_stella(path: Path, tree: Tree, _: Size | None) -> Calibration:
    """The pair of a stereo configuration, or the one camera of another."""
    part, form = Values(path, tree["Camera"], "Camera."), "stella_vslam configuration"
    stated = tree.get("StereoRectifier")
    if isinstance(stated, dict):
        lens = str(stated.get("model", "perspective")).lower()
        merged = Values(path, {**part.tree, **stated}, "StereoRectifier.")
        model = _STELLA.lenses.get(lens, ("radtan", ()))[0]
        return _rectified_pair(
            merged, part.size(*_STELLA.size), ("{}_left", "{}_right"), form, model
        )
    cameras = [camera_of(part, _STELLA, name=path.name)]
    if part.text("setup") == "stereo":
        offset = part.number("focal_x_baseline") / cameras[0].matrix[0, 0]
        cameras.append(replace(cameras[0], bTc=pose(np.eye(3), np.array([offset, 0.0, 0.0]))))
    return Calibration(str(path), form, tuple(cameras), sided=True)


_OF_IMAGES = ("image_width", "image_height")
_CAMODOCAL = {
    "pinhole": Row(
        size=_OF_IMAGES,
        focal=tuple(f"projection_parameters.{name}" for name in FOCAL),
        lenses={"": ("radtan", tuple(f"distortion_parameters.{name}" for name in BROWN))},
    ),
    "mei": Row(
        size=_OF_IMAGES,
        focal=tuple(f"projection_parameters.{name}" for name in ("gamma1", "gamma2", "u0", "v0")),
        lenses={
            "": (
                "omni",
                ("mirror_parameters.xi", *(f"distortion_parameters.{name}" for name in BROWN)),
            )
        },
    ),
    "kannala_brandt": Row(
        size=_OF_IMAGES,
        focal=tuple(f"projection_parameters.{name}" for name in ("mu", "mv", "u0", "v0")),
        lenses={"": ("equidistant", tuple(f"projection_parameters.k{k}" for k in (2, 3, 4, 5)))},
    ),
}


def is_camodocal(tree: Tree) -> bool:
    """Whether it is one camera of camodocal."""
    return "model_type" in tree


def _camodocal(path: Path, tree: Tree, bTc: FloatArray = ORIGIN) -> RawCamera:
    part = Values(path, tree)
    return camera_of(part, _CAMODOCAL[kind_of(part, ("model_type",), _CAMODOCAL)], bTc)


def _read_camodocal(path: Path, tree: Tree, _: Size | None) -> Calibration:
    return Calibration(str(path), "camodocal camera", (_camodocal(path, tree),))


def _read_vins(path: Path, tree: Tree, _: Size | None) -> Calibration:
    """Its cameras, each in a file of camodocal beside it; the body is the IMU."""
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


def _read_multicol(path: Path, tree: Tree, _: Size | None) -> Calibration:
    """One camera: OCamCalib's model under keys such as Camera.a0."""
    part = Values(path, tree)
    count = round(part.number("Camera.nrpol", 5.0))
    depth = part.values([f"Camera.a{k}" for k in range(count)])
    affine = part.values(("Camera.c", "Camera.d", "Camera.e"))
    matrix = ocam_matrix(affine, part.values(("Camera.u0", "Camera.v0")))
    size = part.size("Camera.Iw", "Camera.Ih")
    camera = checked_camera(RawCamera(*size, matrix, depth, np.eye(4), path.name, "ocam"))
    return Calibration(str(path), "MultiCol-SLAM camera", (camera,))


# --------------------------------------------------------------------------------------------
# Basalt


def _inner(*names: str) -> tuple[str, ...]:
    return tuple(f"intrinsics.{name}" for name in names)


_BASALT = Row(
    size=("resolution",),
    focal=_inner(*FOCAL),
    kind=("camera_type",),
    lenses={
        "pinhole": ("radtan", ()),
        "ds": ("ds", _inner("xi", "alpha")),
        "eucm": ("eucm", _inner("alpha", "beta")),
        "kb4": ("equidistant", _inner(*KANNALA)),
        "pinhole-radtan8": ("radtan", _inner(*BROWN, "k3", "k4", "k5", "k6")),
        "pinhole-equi": ("equidistant", _inner(*KANNALA)),
    },
)


def _is_basalt(tree: Tree) -> bool:
    inner = tree.get("value0")
    return isinstance(inner, dict) and "T_imu_cam" in inner


def _read_basalt(path: Path, tree: Tree, _: Size | None) -> Calibration:
    """The cameras; the body is the IMU."""
    part = Values(path, tree["value0"], "value0.")
    places, lenses, sizes = (part.listed(key) for key in ("T_imu_cam", "intrinsics", "resolution"))
    if not len(places) == len(lenses) == len(sizes):
        raise part.refuse("T_imu_cam, intrinsics and resolution must be lists of one length")
    cameras = []
    for k, (place, inner, size) in enumerate(zip(places, lenses, sizes, strict=True)):
        at = Values(path, place, f"T_imu_cam {k}: ")
        quaternion = at.values(("qx", "qy", "qz", "qw"))
        turn = rotation_from_quaternion(quaternion / np.linalg.norm(quaternion))
        bTc = pose(turn, at.values(("px", "py", "pz")))
        known = inner if isinstance(inner, dict) else {}
        one = Values(path, {**known, "resolution": size}, f"intrinsics {k}: ")
        cameras.append(camera_of(one, _BASALT, bTc, f"{path.name}: camera {k}"))
    return Calibration(str(path), "Basalt calibration", tuple(cameras))


# --------------------------------------------------------------------------------------------
# OAK (DepthAI): lengths are centimetres


def _read_oak(path: Path, tree: Tree, _: Size | None) -> Calibration:
    """The stereo pair, left first; the body is the left camera."""
    data = tree["cameraData"] if isinstance(tree["cameraData"], list) else []
    boards = {
        int(one[0]): Values(path, one[1], f"camera {one[0]}: ")
        for one in data
        if isinstance(one, list) and len(one) == 2 and isinstance(one[0], int)
    }
    stereo = Values(path, tree.get("stereoRectificationData"), "stereoRectificationData.")
    sockets = ("leftCameraSocket", 1.0), ("rightCameraSocket", 2.0)
    left, right = (round(stereo.number(key, k)) for key, k in sockets)
    if not {left, right} <= boards.keys():
        raise CalibrationError(f"{path}: holds no stereo pair, of sockets {left} and {right}")
    for a, b in ((left, right), (right, left)):  # either names the other
        part = boards[a].inside("extrinsics")
        if round(part.number("toCameraSocket", -1.0)) == b:
            moved = 0.01 * part.inside("translation").values(("x", "y", "z"))
            bTa = pose(part.matrix("rotationMatrix", 3, 3), moved)
            lTr = inverse(bTa) if a == left else bTa
            break
    else:
        raise boards[left].refuse("extrinsics do not lead to the other camera of the pair")
    cameras = (_oak_camera(boards[left], np.eye(4)), _oak_camera(boards[right], lTr))
    return Calibration(str(path), "OAK calibration", cameras, sided=True)


def _oak_camera(part: Values, bTc: FloatArray) -> RawCamera:
    kind = round(part.number("cameraType", 0.0))  # CameraModel of DepthAI
    if kind not in (0, 1):
        raise part.refuse("cameraType is not known; known: 0 (perspective), 1 (fisheye)")
    coefficients = part.numbers("distortionCoeff")
    model, lens = ("equidistant", coefficients[:4]) if kind else ("radtan", coefficients)
    size, matrix = part.size("width", "height"), part.matrix("intrinsicMatrix", 3, 3)
    return checked_camera(RawCamera(*size, matrix, lens, bTc, part.name, model))


# --------------------------------------------------------------------------------------------
# ZED: lengths are millimetres


_ZED_SIZES = {
    "2K": (2208, 1242),
    "FHD1200": (1920, 1200),
    "FHD": (1920, 1080),
    "HD": (1280, 720),
    "SVGA": (960, 600),
    "VGA": (672, 376),
}
_LONG_BROWN = (*BROWN, "k3", "k4", "k5", "k6")


def _read_zed(path: Path, text: str, size: Size | None) -> Calibration:
    """The pair at one of its resolutions; the body is the left camera.

    ``RX``, ``CV`` and ``RZ`` are the rotation vector that takes points from the left to the right
    camera.
    """
    parser = ConfigParser(interpolation=None)
    try:
        parser.read_string(text)
    except ConfigParserError as error:
        raise CalibrationError(f"{path}: {' '.join(str(error).split())}") from None
    sizes = {name: s for name, s in _ZED_SIZES.items() if f"LEFT_CAM_{name}" in parser}
    chosen = [name for name, s in sizes.items() if size in (None, s)]
    if not chosen:
        known = ", ".join(f"{w}x{h}" for w, h in sizes.values())
        raise CalibrationError(f"{path}: no calibration for {size}; there are {known}")
    name = "HD" if "HD" in chosen else chosen[0]

    def section(title: str) -> dict[str, str]:
        return dict(parser.items(title)) if parser.has_section(title) else {}

    stereo = Values(path, section("STEREO"), "STEREO: ")
    turn = stereo.values([f"{axis}_{name.lower()}" for axis in ("rx", "cv", "rz")])
    shift = -1e-3 * stereo.values(("baseline?", "ty?", "tz?"))
    lTr = inverse(pose(np.asarray(cv2.Rodrigues(turn)[0]), shift))
    cameras = []
    for side, bTc in (("LEFT", np.eye(4)), ("RIGHT", lTr)):
        # The lens has a part of its own in files of ZED X.
        part = Values(path, section(f"{side}_DISTO") | section(f"{side}_CAM_{name}"), f"{side}: ")
        lens = part.values([f"{term}?" for term in _LONG_BROWN])
        lens = lens if lens[5:].any() else lens[:5]
        matrix = part.intrinsics(FOCAL)
        cameras.append(checked_camera(RawCamera(*_ZED_SIZES[name], matrix, lens, bTc, part.name)))
    notes = () if len(chosen) == 1 else (f"taken at {name}; give the size for another",)
    return Calibration(str(path), "ZED factory file", tuple(cameras), True, None, notes)


# --------------------------------------------------------------------------------------------
# RealSense, and what Open3D writes of it


_PRINCIPAL = ("fx", "fy", "ppx", "ppy")  # rs2_intrinsics
_RS2_BROWN = ("", "brownconrady", "modifiedbrownconrady", "plumbbob", "radtan", "pinhole", "opencv")
_RS2_KANNALA = ("kannalabrandt4", "kannalabrandt", "equidistant", "fisheye", "opencvfisheye")
_RS2_MODELS = {"1": "modifiedbrownconrady", "4": "brownconrady", "5": "kannalabrandt4"}
_LISTS = ("coeffs", "distortion", "distortion_coefficients", "dist_coeffs", "dist", "D")


def is_realsense(tree: Tree) -> bool:
    """Whether it is the intrinsics of one camera as librealsense, Open3D or people name them."""
    plain = tree.keys() >= {*FOCAL, "width", "height"}
    alone = plain and not (OF_RECTIFIED - {"fx"}) & tree.keys()
    return alone or "intrinsic_matrix" in tree or tree.keys() >= set(_PRINCIPAL)


def _read_realsense(path: Path, tree: Tree, _: Size | None) -> Calibration:
    """One camera; Open3D's matrix goes column by column, other people's row by row."""
    part = Values(path, tree)
    if "intrinsic_matrix" in part:
        given = part.matrix("intrinsic_matrix", 3, 3)
        matrix = given.T if given[2, :2].any() else given
        if not np.array_equal(matrix[2], (0.0, 0.0, 1.0)):
            raise part.refuse("intrinsic_matrix must end with the row 0 0 1; correct the file")
    else:
        matrix = part.intrinsics(_PRINCIPAL if "ppx" in part else FOCAL)
    model, lens = _realsense_lens(part)
    size = part.size("width", "height")
    camera = checked_camera(RawCamera(*size, matrix, lens, np.eye(4), path.name, model))
    return Calibration(str(path), "RealSense intrinsics", (camera,))


def _realsense_lens(part: Values) -> tuple[str, FloatArray]:
    """Model and parameters, by rs2_distortion where that is stated, else OpenCV's."""
    key = next((k for k in ("model", "distortion_model", "camera_model") if k in part), "model")
    stated = re.sub(r"[^a-z0-9]|^(rs2_)?distortion[._]", "", part.text(key))
    name = _RS2_MODELS.get(stated, stated)
    fisheye = name in _RS2_KANNALA
    listed = next((k for k in _LISTS if k in part), None)
    if listed is not None:
        found = part.numbers(listed)
    else:
        terms = KANNALA if fisheye else _LONG_BROWN if "k4" in part else _LONG_BROWN[:5]
        found = part.values([f"{term}?" for term in terms])
        if found[5:].any() and "p1" not in part:
            raise part.refuse('k1 to k4 without p1, p2 need "model": fisheye or brown_conrady')
    if fisheye:
        return "equidistant", found[:4]
    if found.any() and name not in _RS2_BROWN:
        raise part.refuse(
            f"{key} {part.text(key)} is not known with coefficients other than 0; known: "
            "brown_conrady, kannala_brandt4"
        )
    return "radtan", found if found.any() else np.zeros(4)


# --------------------------------------------------------------------------------------------
# One colour camera, next to its depth: Replica's cam_params.json, NICE-SLAM's and SplaTAM's
# configurations. COLMAP's cameras.txt and nerfstudio's transforms.json


_PARTS = ("camera", "cam", "camera_params")
_SIZES = (("w", "h"), ("W", "H"), ("image_width", "image_height"))


def rgbd_part(tree: Tree) -> Tree:
    """The part of a configuration that holds fx, fy, cx, cy and the size; empty without one."""
    found = [part for key in _PARTS if isinstance(part := tree.get(key), Mapping)]
    needed = ({*FOCAL, *size} for size in _SIZES)
    return next((part for keys in needed for part in found if keys <= part.keys()), {})


def _read_rgbd(path: Path, tree: Tree, _: Size | None) -> Calibration:
    part = Values(path, rgbd_part(tree), "camera: ")
    size = next(keys for keys in _SIZES if keys[0] in part)
    camera = camera_of(part, Row(size, {"": ("radtan", ())}), name="camera")
    return Calibration(str(path), "camera of colour and depth", (camera,))


_COLMAP = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": FOCAL,
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": (*FOCAL, *BROWN),
    "OPENCV_FISHEYE": (*FOCAL, *KANNALA),
}
"""Parameters of its models, in their order."""
_COLMAP_LINE = re.compile(rf"^\d+\s+({'|'.join(_COLMAP)})\s+(\d+)\s+(\d+)\s+(.*)$", re.M)


def _read_colmap(path: Path, text: str, _: Size | None) -> Calibration:
    ((model, width, height, numbers),) = _COLMAP_LINE.findall(text)
    names, words = _COLMAP[model], numbers.split()
    if len(words) != len(names):
        raise CalibrationError(f"{path}: {model} takes {' '.join(names)}; correct the file")
    tree = dict(zip(names, words, strict=True)) | {"w": width, "h": height}
    camera = _from_corner(Values(path, tree, f"{model}: "), model)
    return Calibration(str(path), "COLMAP cameras", (camera,))


def _read_nerfstudio(path: Path, tree: Tree, _: Size | None) -> Calibration:
    part = Values(path, {"fx": tree["fl_x"], "fy": tree.get("fl_y", tree["fl_x"]), **tree})
    camera = _from_corner(part, str(tree.get("camera_model", "OPENCV")))
    return Calibration(str(path), "nerfstudio transforms", (camera,))


def _from_corner(part: Values, model: str) -> RawCamera:
    """The camera of numbers whose pixels begin at the corner of the first one."""
    if model not in _COLMAP:
        raise part.refuse(f"camera_model {model} is not known; known: {', '.join(_COLMAP)}")
    if model != "OPENCV_FISHEYE" and part.number("k4", 0.0):
        raise part.refuse(f"k4 of {model} is not known; calibrate without it")
    focal = ("f", "f", "cx", "cy") if "f" in part else FOCAL
    fisheye = ("equidistant", ("k1?", "k2?", "k3?", "k4?"))
    lens = fisheye if model == "OPENCV_FISHEYE" else ("radtan", ("k1?", "k2?", "p1?", "p2?", "k3?"))
    camera = camera_of(part, Row(("w", "h"), {"": lens}, focal=focal), name=part.path.name)
    return replace(camera, matrix=camera.matrix - [[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0] * 3])


# --------------------------------------------------------------------------------------------
# OCamCalib


def _is_ocamcalib(text: str) -> bool:
    lines = (line.split() for line in text.splitlines() if not line.startswith("#"))
    first = next((words for words in lines if words), [""])
    return first[0].isdecimal() and first[0].lstrip("0") == str(len(first) - 1)


def _read_ocamcalib(path: Path, *_: object) -> Calibration:
    """One camera, forward along its axis."""
    found = read_ocamcalib(path)
    matrix, depth = ocam_matrix(found.affine, found.centre[::-1]), np.array(found.direct)
    size = found.width, found.height
    camera = checked_camera(RawCamera(*size, matrix, depth, np.eye(4), path.name, "ocam"))
    return Calibration(str(path), "OCamCalib", (camera,))


# --------------------------------------------------------------------------------------------
# Which format a file has


KNOWN = (
    "known: calib.json of fgslam, Kalibr's camchain, OpenCV's stereo files (M1, D1, M2, D2, R, T), "
    "left.yaml and right.yaml of ROS camera_info, KITTI's calib.txt, EuRoC's sensor.yaml, settings "
    "of ORB-SLAM, stella_vslam and VINS, files of Basalt, OAK, ZED, RealSense and OCamCalib"
)

_READERS: tuple[
    tuple[Callable[[Tree], bool], Callable[[Path, Tree, Size | None], Calibration]], ...
] = (
    (is_realsense, _read_realsense),
    (_is_own, _read_own),
    (_is_basalt, _read_basalt),
    (lambda tree: {"cameraData", "boardName"} <= tree.keys(), _read_oak),
    (is_camchain, _read_camchain),
    (is_asl, _read_asl),
    (is_camera_info, lambda path, tree, _: read_camera_info(path, tree)),
    (lambda tree: "cam0_calib" in tree, _read_vins),
    (is_camodocal, _read_camodocal),
    (lambda tree: "Camera.fx" in tree or "Camera1.fx" in tree, _read_orb_slam),
    (_is_stella, _read_stella),
    (lambda tree: "Camera.a0" in tree, _read_multicol),
    (lambda tree: bool(rgbd_part(tree)), _read_rgbd),
    (lambda tree: {"fl_x", "cx", "cy", "w", "h"} <= tree.keys(), _read_nerfstudio),
    (is_opencv_pair, read_opencv_pair),
    (is_opencv_one, read_opencv_one),
)
"""What recognises a format by its keys, and reads it; the first that fits counts."""

_TEXTS: tuple[
    tuple[Callable[[str], bool], Callable[[Path, str, Size | None], Calibration]], ...
] = (
    (
        lambda text: re.search(r"^(P0|P_rect_\d+):", text, re.M) is not None,
        lambda path, _, size: read_kitti(path, size),
    ),
    (lambda text: "[LEFT_CAM_" in text and "[STEREO]" in text, _read_zed),
    (lambda text: len(_COLMAP_LINE.findall(text)) == 1, _read_colmap),
    (_is_ocamcalib, _read_ocamcalib),
)
"""The same of files that are no keys and values."""


def is_opencv_half(tree: Tree) -> bool:
    """Whether it holds either intrinsics or extrinsics of a pair, and the rest is elsewhere."""
    if has_intrinsics(tree) == has_step(tree) or is_rectified(tree):
        return False
    known = next((read for recognises, read in _READERS if recognises(tree)), None)
    return known is read_opencv_pair


def calibration_of_text(path: Path, text: str, size: Size | None) -> Calibration | None:
    """What a file of other texts than keys and values says; None: it is of no such format."""
    found = (read(path, text, size) for recognises, read in _TEXTS if recognises(text))
    return next(found, None)


def calibration_of_tree(path: Path, tree: Tree, size: Size | None) -> Calibration:
    """What keys and values say. Raises CalibrationError: they are of no format that is known."""
    for recognises, read in _READERS:
        if recognises(tree):
            return read(path, tree, size)
    raise CalibrationError(f"{path}: not a calibration that is known; {KNOWN}")
