"""Kalibr's camchain, and the files of tools that write it: OpenVINS, MSCKF-VIO, Kimera-VIO."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fgslam.cameras.formats.trees import Tree, Values, intrinsic_matrix, read_tree
from fgslam.cameras.raw_cameras import Calibration, RawCamera, checked_camera
from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import inverse

_LENSES = {
    ("pinhole", "radtan"): "radtan",
    ("pinhole", "none"): "radtan",
    ("pinhole", "equidistant"): "equidistant",
    ("pinhole", "equi"): "equidistant",
    ("pinhole", "fov"): "fov",
    ("omni", "radtan"): "omni",
    ("omni", "none"): "omni",
    ("ds", "none"): "ds",
    ("eucm", "none"): "eucm",
}
"""Our model of Kalibr's camera model and distortion model."""

_OWN_FIRST = {"pinhole": 0, "omni": 1, "ds": 2, "eucm": 2}
"""How many of the intrinsics are the model's own; fx, fy, cx and cy follow."""


def is_camchain(tree: Tree) -> bool:
    """Whether it holds a camera ``cam0`` with a model, as Kalibr writes it."""
    first = tree.get("cam0", tree.get("input_camera"))
    return isinstance(first, dict) and "camera_model" in first


def read_camchain(path: Path, tree: Tree) -> Calibration:
    """Cameras ``cam0``, ``cam1``, ...; the body is the IMU where it is stated, else the first.

    ``T_cn_cnm1`` of a camera takes points from the axes of the one before it to its own,
    ``T_cam_imu`` those of the IMU, and ``T_imu_cam`` is a camera's pose in the IMU.

    Raises:
        CalibrationError: a value is missing or impossible, or a model is not known.
    """
    names = [name for name in (f"cam{k}" for k in range(16)) if name in tree] or ["input_camera"]
    parts = [Values(path, tree[name], f"{name}.") for name in names]
    by_imu = all("T_cam_imu" in part or "T_imu_cam" in part for part in parts)
    cameras: list[RawCamera] = []
    for part in parts:
        before = cameras[-1].bTc if cameras else None
        cameras.append(_camera(part, _pose(part, before, by_imu), path.name))
    notes = tuple(_contradiction(part, k, parts, cameras) for k, part in enumerate(parts) if k)
    told = tuple(filter(None, notes))
    return Calibration(str(path), "Kalibr camchain", tuple(cameras), notes=told)


_CONTRADICTION_M = 0.005  # what two calibrations of one rig agree to, and the angle beside it
_CONTRADICTION = np.cos(np.radians(1.0))


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


def _pose(part: Values, before: FloatArray | None, by_imu: bool) -> FloatArray:
    # The step between cameras is what Kalibr measured directly.
    if before is not None and "T_cn_cnm1" in part:
        return np.asarray(before @ inverse(part.motion("T_cn_cnm1")))
    if by_imu:
        given = "T_imu_cam" in part
        return part.motion("T_imu_cam") if given else inverse(part.motion("T_cam_imu"))
    return np.eye(4) if before is None else part.motion("T_cn_cnm1")


def _camera(part: Values, bTc: FloatArray, file: str) -> RawCamera:
    model, distortion = part.text("camera_model"), part.text("distortion_model", "none")
    lens = _LENSES.get((model, distortion))
    if lens is None:
        known = ", ".join("-".join(pair) for pair in _LENSES)
        raise part.refuse(
            f"camera_model {model} with distortion_model {distortion} is not known; known: {known}"
        )
    own = _OWN_FIRST[model]
    intrinsics = part.numbers("intrinsics", own + 4)
    coefficients = part.numbers("distortion_coeffs") if distortion != "none" else np.zeros(0)
    if lens in ("radtan", "omni") and not len(coefficients):
        coefficients = np.zeros(4)
    width, height = part.size("resolution", "resolution")
    name = f"{file}: {part.where[:-1]}"
    return checked_camera(
        RawCamera(
            width,
            height,
            intrinsic_matrix(*intrinsics[own:]),
            np.concatenate([intrinsics[:own], coefficients]),
            bTc,
            name,
            lens,
            str(part.tree.get("rostopic") or ""),
        )
    )


# --------------------------------------------------------------------------------------------
# The ASL layout (EuRoC): one sensor.yaml a camera


_ASL = {
    "radial-tangential": "radtan",
    "radtan": "radtan",
    "plumb_bob": "radtan",
    "rational": "radtan",
    "none": "radtan",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
    "fov": "fov",
    "omni": "ocam",
}


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
    model = part.text("distortion_model", "none")
    lens = _ASL.get(model)
    if lens is None:
        raise part.refuse(f"distortion_model {model} is not known; known: {', '.join(_ASL)}")
    matrix, parameters = _ocam(part) if lens == "ocam" else _pinhole(part, model)
    width, height = part.size("resolution", "resolution")
    name = str(path.parent) if path.name == "sensor.yaml" else path.name
    bTc = part.motion("T_BS") if part.tree.get("T_BS") is not None else np.eye(4)
    return checked_camera(RawCamera(width, height, matrix, parameters, bTc, name, lens))


def read_asl(path: Path, tree: Tree) -> Calibration:
    """The calibration of one camera's sensor.yaml."""
    return Calibration(str(path), "ASL sensor.yaml", (read_asl_camera(path, tree),))


def read_asl_mounting(path: Path) -> FloatArray:
    """``T_BS`` (4, 4) of a sensor.yaml: the pose of the sensor in the body."""
    return Values(path, read_tree(path)).motion("T_BS")


def _pinhole(part: Values, model: str) -> tuple[FloatArray, FloatArray]:
    matrix = intrinsic_matrix(*part.numbers("intrinsics", 4))
    if model == "none":
        return matrix, np.zeros(4)
    return matrix, part.numbers("distortion_coefficients")


def _ocam(part: Values) -> tuple[FloatArray, FloatArray]:
    """Kimera's omnidirectional camera: the polynomial's depth grows forward."""
    column, row = part.numbers("omni_distortion_center", 2)
    e, d, c = part.numbers("omni_affine", 3)
    return ocam_matrix((c, d, e), (column, row)), -part.numbers("distortion_coefficients")


def ocam_matrix(affine: tuple[float, float, float], centre: tuple[float, float]) -> FloatArray:
    """(3, 3) of OCamCalib's affine parameters (c, d, e) and its centre (column, row)."""
    c, d, e = affine
    return np.array([[1.0, e, centre[0]], [d, c, centre[1]], [0.0, 0.0, 1.0]])
