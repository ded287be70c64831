"""The rig of a bag: by camera_info, tf_static or a file, and where it sits on the robot."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from fgslam.cameras.lenses import Calibration, RawCamera
from fgslam.cameras.rig import (
    StereoRig,
    at_size,
    implausible,
    in_metres,
    is_stereo_pair,
    read_calibration_file,
)
from fgslam.cameras.stereo_formats import read_camera_info, read_camera_info_pair
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import BODY_FORWARD_LEFT_UP_FROM_CAMERA, inverse
from fgslam.core.sensors import body_is_camera
from fgslam.core.sides import differ_in_number
from fgslam.datasets.bags.frames import FrameTree, view_axes
from fgslam.datasets.bags.topics import Chosen, FileCameras, is_registered, of_two_sensors
from fgslam.datasets.calibrated import LOOKS_AHEAD, loaded_rig, mounted, numbered, read_rig
from fgslam.datasets.depth_view import BASELINE_M, require_one_camera
from fgslam.datasets.settings import BagSettings

_BODIES = ("base_link", "base_footprint")
"""The robot itself, where odometry does not name its frame (REP 105)."""

Info: TypeAlias = dict[str, Any]
"""A camera_info with the keys of camera_calibration's files."""


@dataclass(frozen=True, eq=False)
class Stated:
    """What a bag says of its cameras.

    Attributes:
        infos: by topic of camera_info its first message, as in a file.
        frames: by topic the frame of its first message.
        tree: of tf_static.
        size: width and height of the images.
    """

    infos: dict[str, Info]
    frames: dict[str, str]
    tree: FrameTree
    size: tuple[int, int]


@dataclass(frozen=True, eq=False)
class _Found:
    """A rig, its cameras left and right, the topics as calibrated, what was noticed.

    ``on_body``: the file's body is another thing than a camera, as an IMU, whatever its axes.
    """

    rig: StereoRig
    cameras: tuple[RawCamera, ...]
    chosen: Chosen
    notes: tuple[str, ...] = ()
    on_body: bool = False


def file_cameras(settings: BagSettings) -> FileCameras:
    """What the calibration file says of topics; a file at fault is refused with the rig."""
    if settings.camera_file is None:
        return FileCameras()
    file = Path(settings.camera_file)
    try:
        cameras = read_calibration_file(file).cameras
    except CalibrationError:
        return FileCameras(file.name)
    topics = tuple(camera.topic for camera in cameras)
    return FileCameras(file.name, topics, _ahead(cameras) if len(cameras) > 3 else ())


def _ahead(cameras: tuple[RawCamera, ...]) -> tuple[int, ...]:
    """The only two cameras that form a stereo pair; () where there are several pairs, or none."""
    numbers = combinations(range(len(cameras)), 2)
    pairs = [pair for pair in numbers if is_stereo_pair([cameras[k] for k in pair])]
    return pairs[0] if len(pairs) == 1 else ()


@dataclass(frozen=True, eq=False)
class Placed:
    """The rig on the robot, the right camera, topics with sides as calibrated, what was noticed."""

    rig: StereoRig
    camera: RawCamera
    chosen: Chosen
    notes: tuple[str, ...]


def rig_of_bag(settings: BagSettings, stated: Stated, chosen: Chosen) -> Placed:
    """The rig of the topics that are chosen, or of one of them and its depth.

    Raises:
        CalibrationError: nothing says where the cameras are, or what does is malformed.
    """
    if chosen.depth:
        found = _of_depth(settings, stated, chosen)
    else:
        found = _of_file(settings, stated, chosen) or _of_topics(settings, stated, chosen)
    notes = (*found.notes, *found.rig.remarks)
    if settings.camera_yaw_deg is not None or settings.lever_arm_m is not None:
        return Placed(mounted(found.rig, settings), found.cameras[1], found.chosen, notes)
    rig, said = _on_robot(found, stated)
    return Placed(rig, found.cameras[1], found.chosen, (*notes, *said))


def _of_file(settings: BagSettings, stated: Stated, chosen: Chosen) -> _Found | None:
    if settings.camera_file is None:
        return None
    file, numbers = Path(settings.camera_file), chosen.numbers
    cameras = in_metres(read_calibration_file(file, size=stated.size), settings.unit_m).cameras
    on_body = not any(np.array_equal(camera.bTc, np.eye(4)) for camera in cameras)
    if numbers:
        rig = loaded_rig(settings, file, size=stated.size, cameras=numbers, pair=False)
        return replace(_of_numbers(rig, [cameras[k] for k in numbers], chosen), on_body=on_body)
    if len(cameras) > 3:
        raise CalibrationError(
            f"{file} holds {len(cameras)} cameras, and nothing says which of them {chosen.left} "
            f"and {chosen.right} are; write those two: fgslam camera convert {file.name} "
            "two.yaml --cameras 0,1"
        )
    rig = loaded_rig(settings, file, size=stated.size)
    if differ_in_number(chosen.left, chosen.right):
        rig = numbered(rig)
    order = (0, 1) if rig.rectifier is None else rig.rectifier.order
    right, left = (rig.sources[order.index(k)] for k in (0, 1))
    return _Found(rig, (cameras[left], cameras[right]), chosen, on_body=on_body)


def _of_numbers(rig: StereoRig, cameras: list[RawCamera], chosen: Chosen) -> _Found:
    """The topics on the sides where the calibration sees their cameras."""
    views = [chosen.views[k] for k in rig.sources[: rig.cameras]]
    right, left, *top = views
    placed = replace(chosen, left=left, right=right, top=top[0] if top else None)
    if rig.rectifier is not None:
        rig = replace(rig, rectifier=replace(rig.rectifier, order=tuple(range(rig.cameras))))
    by_side = (cameras[rig.sources[1]], cameras[rig.sources[0]])
    return _Found(rig, by_side, placed)


def _of_depth(settings: BagSettings, stated: Stated, chosen: Chosen) -> _Found:
    """The camera whose depth is recorded, by the file or its camera_info, and one made up."""
    require_one_camera(settings)
    notes = _unregistered(settings, stated, chosen)
    camera = _one_camera(settings, stated, chosen)
    (fx, _, cx), (_, fy, cy) = camera.matrix[:2].tolist()
    rig = StereoRig(camera.width, camera.height, fx, fy, cx, cy, BASELINE_M)
    return _Found(rig, (camera, camera), chosen, notes)


def _unregistered(settings: BagSettings, stated: Stated, chosen: Chosen) -> tuple[str, ...]:
    """What to tell where depth may not be registered. Raises CalibrationError: nobody chose it."""
    colour, depth = (stated.frames[topic] for topic in (chosen.right, chosen.left))
    apart = of_two_sensors(chosen.left, chosen.right)
    same = not colour or not depth or colour == depth or is_registered(chosen.left)
    if same and not apart:
        return ()
    text = f"{chosen.left} is in the frame {depth}, {chosen.right} in {colour}"
    text = f"{chosen.left} and {chosen.right} are of two sensors" if apart else text
    if settings.topics:
        return (f"{text}: it is taken as registered to colour, as it was chosen by --topics",)
    raise CalibrationError(
        f"{settings.path}: {text}: depth must be registered to colour; record the driver's aligned "
        "or registered depth, or choose: --topics COLOUR,DEPTH"
    )


def _one_camera(settings: BagSettings, stated: Stated, chosen: Chosen) -> RawCamera:
    if settings.camera_file is not None:
        found = read_calibration_file(Path(settings.camera_file), size=stated.size)
        alone = replace(found, cameras=found.cameras[:1], view=None)
        return at_size(alone, stated.size, settings.resized).cameras[0]
    # Registered depth has the colour camera's calibration.
    topics = (chosen.right_info, chosen.left_info)
    topic = next((name for name in topics if name is not None), None)
    if topic is None:
        raise CalibrationError(
            f"{settings.path}: no camera_info belongs to {chosen.right}; give its calibration by "
            "--camera FILE"
        )
    values = _as_sent(stated.infos[topic], stated.size)
    _require_calibrated(settings, topic, values)
    values = _without_distortion(values) if _is_rectified(chosen.right) else values
    found = read_camera_info(Path(f"{settings.path}:{topic}"), values)
    return at_size(found, stated.size, settings.resized).cameras[0]


# --------------------------------------------------------------------------------------------
# By camera_info, and by tf_static where that has no baseline


def _of_topics(settings: BagSettings, stated: Stated, chosen: Chosen) -> _Found:
    topics = (chosen.left_info, chosen.right_info)
    left, right = (stated.infos.get(topic or "") for topic in topics)
    if left is None or right is None:
        raise CalibrationError(_lacking(settings.path, chosen, left is None, right is None))
    for topic, values in zip(topics, (left, right), strict=True):
        _require_calibrated(settings, str(topic), values)
    left, right = (_as_sent(values, stated.size) for values in (left, right))
    if all(_is_rectified(topic) for topic in (chosen.left, chosen.right)):
        left, right = (_without_distortion(values) for values in (left, right))
    named = (Path(f"{settings.path}:{topics[0]}"), Path(f"{settings.path}:{topics[1]}"))
    if not _shift(left) and not _shift(right):
        return _by_tree(settings, named, (left, right), stated, chosen)
    notes: tuple[str, ...] = ()
    if _shift(left) < 0.0 <= _shift(right):
        notes = (f"by their camera_info {chosen.left} is the right camera, and is taken so",)
        left, right, named = right, left, (named[1], named[0])
        chosen = replace(
            chosen,
            left=chosen.right,
            right=chosen.left,
            left_info=chosen.right_info,
            right_info=chosen.left_info,
        )
    found = read_camera_info_pair(named, (left, right))
    cameras = in_metres(found, settings.unit_m).cameras
    return _Found(read_rig(settings, found, stated.size), cameras, chosen, notes)


def _require_calibrated(settings: BagSettings, topic: str, values: Info) -> None:
    if not values["camera_matrix"]["data"][0]:
        raise CalibrationError(
            f"{settings.path}: {topic} is of a camera that is not calibrated (its numbers are 0); "
            "calibrate it, and give the calibration of all cameras by --camera FILE"
        )


def _shift(info: Info) -> float:
    """-fx times the baseline, of the right camera; 0 where none is stated."""
    return float(info["projection_matrix"]["data"][3])


def _by_tree(
    settings: BagSettings,
    named: tuple[Path, Path],
    infos: tuple[Info, Info],
    stated: Stated,
    chosen: Chosen,
) -> _Found:
    """Each camera by its own camera_info, their places by the transforms of their frames."""
    left, right = (stated.frames[topic] for topic in (chosen.left, chosen.right))
    try:
        if left == right:
            raise CalibrationError(f"both cameras have the frame {left or 'without a name'}")
        fTc, said = view_axes(stated.tree, left, right, "")
        apart = inverse(fTc) @ stated.tree.pose(left, right) @ fTc
    except CalibrationError as fault:
        raise CalibrationError(
            f"{named[0]} and {named[1].name}: projection_matrix states no baseline, and {fault}; "
            "give the calibration of both by --camera FILE"
        ) from None
    cameras = [
        replace(read_camera_info(file, info).cameras[0], name=str(topic), bTc=place)
        for file, info, topic, place in zip(
            named, infos, (chosen.left, chosen.right), (apart, np.eye(4)), strict=True
        )
    ]
    source, form = f"{named[0]} and {named[1].name}", "camera_info with tf_static"
    pair = Calibration(source, form, tuple(cameras), sided=True)
    # A unit is that of camera_info; transforms are in metres (REP 103).
    rig = read_rig(replace(settings, unit_m=1.0), pair, stated.size)
    note = f"camera_info has no baseline: by tf_static {right} is {rig.baseline:.4g} m from {left}"
    if doubted := implausible(source, rig.plain()):  # --unit, which that names, is another's
        note += ", which no rig has: tf_static is in metres; give the calibration by --camera FILE"
        rig = replace(rig, remarks=tuple(text for text in rig.remarks if text not in doubted))
    return _Found(rig, pair.cameras, chosen, (note, *filter(None, [said])))


def _as_sent(info: Info, size: tuple[int, int]) -> Info:
    """The camera_info of images that were cropped and binned as it says; itself where not so."""
    (across, down), (x, y, width, height) = info["binning"], info["roi"]
    full = (width or info["image_width"], height or info["image_height"])
    if size == (info["image_width"], info["image_height"]):
        return info
    if size != (full[0] // across, full[1] // down):
        return info
    sent = np.array(
        [
            [1.0 / across, 0.0, (0.5 - x) / across - 0.5],
            [0.0, 1.0 / down, (0.5 - y) / down - 0.5],
            [0.0, 0.0, 1.0],
        ]
    )
    matrices = {
        name: {"data": (sent @ np.reshape(info[name]["data"], (3, -1))).ravel().tolist()}
        for name in ("camera_matrix", "projection_matrix")
    }
    return {**info, **matrices, "image_width": size[0], "image_height": size[1]}


def _lacking(path: str, chosen: Chosen, no_left: bool, no_right: bool) -> str:
    which = [t for t, absent in ((chosen.left, no_left), (chosen.right, no_right)) if absent]
    return (
        f"{path}: no camera_info belongs to {' and '.join(which)}, and one camera's says nothing "
        "of the other; give the calibration of both by --camera FILE"
    )


def _is_rectified(topic: str) -> bool:
    return "rect" in topic.removesuffix("/compressed").rpartition("/")[2].split("_")


def _without_distortion(values: Info) -> Info:
    """The camera_info of the image that image_proc has rectified by it."""
    p = values["projection_matrix"]["data"]
    return {
        **values,
        "distortion_model": "plumb_bob",
        "camera_matrix": {"data": [*p[0:3], *p[4:7], *p[8:11]]},
        "distortion_coefficients": {"data": [0.0] * 5},
        "rectification_matrix": {"data": np.eye(3).ravel().tolist()},
    }


# --------------------------------------------------------------------------------------------
# On the robot


def _on_robot(found: _Found, stated: Stated) -> tuple[StereoRig, tuple[str, ...]]:
    """The rig in the frame whose motion the odometry is, and how that was known."""
    if found.chosen.motion is None:
        return found.rig, ()
    left, right = (stated.frames[topic] for topic in (found.chosen.left, found.chosen.right))
    body = _body(stated.frames[found.chosen.motion.name], stated.tree)
    # Where both have one frame it is the left camera's (CameraInfo.msg, P).
    camera, frame = (0, left) if left == right else (1, right)
    try:
        bTf = stated.tree.pose(frame, body)
    except CalibrationError as fault:
        return _unconnected(found, stated.tree, body, f" ({fault})" if stated.tree else "")
    fTc, said = view_axes(stated.tree, left, right, body)
    bTc = bTf @ fTc @ inverse(found.cameras[camera].bTc) @ found.rig.bTc
    x, y, z = (round(float(v), 3) + 0.0 for v in bTc[:3, 3])
    note = (
        f"by tf_static the right camera is {x:g}, {y:g}, {z:g} m (x, y, z) from {body}, whose "
        f"motion {found.chosen.motion.name} is"
    )
    return replace(found.rig, bTc=bTc), (*stated.tree.notes, note, *filter(None, [said]))


def _unconnected(
    found: _Found, tree: FrameTree, body: str, reason: str
) -> tuple[StereoRig, tuple[str, ...]]:
    """The same where no transform leads to the camera: as calibrated, else by its frame's axes."""
    if found.on_body or not body_is_camera(found.rig.bTc):
        return found.rig, ()
    if "optical" in body:  # axes of a camera (REP 103), as RealSense's gyroscope has
        said = f"{body} has a camera's axes, and is taken as turned like the camera{reason}"
        return found.rig, (*tree.notes, said)
    ahead = replace(found.rig, bTc=BODY_FORWARD_LEFT_UP_FROM_CAMERA)
    return ahead, (*tree.notes, f"{_UNKNOWN_PLACE}{reason}: {LOOKS_AHEAD}")


def _body(named: str, tree: FrameTree) -> str:
    """The frame whose motion odometry is: the one it names, else the robot's."""
    return named or next((body for body in _BODIES if body in tree), "")


_UNKNOWN_PLACE = "nothing says where the camera sits on the robot whose odometry is used"
