"""Which topics of a bag are used: found by type and by the cameras' names, or named by the user."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

from fgslam.cameras.lenses import RawCamera
from fgslam.cameras.rig import is_stereo_pair, read_calibration_file
from fgslam.core.errors import CalibrationError, DatasetError
from fgslam.core.sides import camera_pairs, is_view
from fgslam.datasets import bag_messages as messages
from fgslam.datasets.settings import BagSettings


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a bag: its name, message type ``package/msg/Type`` and number of messages."""

    name: str
    kind: str
    count: int


@dataclass(frozen=True, slots=True)
class Chosen:
    """Topics that are used.

    Attributes:
        views: of left and right images, perhaps of top ones; or of depth and of colour. One topic
            twice has images that show both views.
        numbers: which cameras of the calibration file the views are, so that it determines the
            sides; empty: the topics do.
        notes: what else could have been taken.
        guessed: whether other topics could be meant as well.
        depth: whether left is the depth of right, in place of a second camera.
        infos: of the camera_info of left and right; None where there is none.
        motion: of odometry, or None.
        transforms: of tf_static; where the bag has none, of tf, which states again what stays.
        unit: of the metres in a unit of depth, as RealSense's viewer records it; or empty.
    """

    views: tuple[str, ...]
    numbers: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()
    depth: bool = False
    guessed: bool = False
    infos: tuple[str | None, str | None] = (None, None)
    motion: Topic | None = None
    transforms: tuple[str, ...] = ()
    unit: str = ""

    @property
    def left(self) -> str:
        """Topic of the left images, or of depth."""
        return self.views[0]

    @property
    def right(self) -> str:
        """Topic of the right images, or of colour."""
        return self.views[1]


IMAGES = (messages.IMAGE, messages.COMPRESSED)
MOTIONS = (messages.ODOMETRY, messages.TWIST, messages.TWIST_WITH_COVARIANCE, messages.IMU)
"""The first that a bag has is its odometry."""

TRANSPORT = "/compressed"
_PREFERRED = ("image_raw", "image_rect", "image_rect_raw", "image", "image_mono")
"""Last parts of topics, grey and raw ones first; others after them."""


def choose_topics(
    topics: Sequence[Topic], settings: BagSettings, frame_of: Callable[[Topic], str]
) -> Chosen:
    """The topics of two or three cameras, or of one and its depth, and of their odometry.

    Args:
        topics: of the bag.
        settings: with the topics that the user names: images of each camera, perhaps odometry.
        frame_of: the frame in which a topic states its first message.

    Raises:
        DatasetError: a wanted topic is not there or of no use, or the bag has no pair of cameras.
    """
    used = [topic for topic in topics if topic.count]
    by_name = {topic.name: topic for topic in used}
    for name in settings.topics:
        if name not in by_name:
            raise DatasetError(
                f"{settings.path} has no topic {name} with messages; it has {_list(used)}"
            )
        if by_name[name].kind not in (*IMAGES, *MOTIONS):
            raise DatasetError(
                f"{settings.path}: {name} is {by_name[name].kind}, no image or odometry; "
                "name the left camera's images, the right one's, then perhaps one of odometry"
            )
    images = [topic.name for topic in used if topic.kind in IMAGES]
    named = [name for name in settings.topics if by_name[name].kind in IMAGES]
    cameras = _cameras_of_file(settings)
    if named:
        chosen = _as_named(named, images, cameras, settings)
    else:
        chosen = _by_rostopics(images, cameras, settings) or _by_names(used, cameras, settings)
    motion = next((by_name[n] for n in settings.topics if by_name[n].kind in MOTIONS), None)
    notes = chosen.notes
    if motion is None:
        motion, others = find_motion(used, frame_of)
        notes = (*notes, *others)
    trees = tuple(topic.name for topic in used if topic.kind in messages.TRANSFORMS)
    static = tuple(name for name in trees if name.endswith("tf_static"))
    infos = _infos([t.name for t in used if t.kind == messages.CAMERA_INFO], *chosen.views[:2])
    sensor = SENSOR.match(chosen.left)
    of_sensor = (t.name for t in used if t.kind == messages.NUMBER and sensor is not None
                 and t.name.startswith(sensor[0]) and _DEPTH_UNIT.search(t.name))  # fmt: skip
    unit = next(of_sensor, "") if chosen.depth else ""
    return replace(
        chosen, notes=notes, infos=infos, motion=motion, transforms=static or trees, unit=unit
    )


def _cameras_of_file(settings: BagSettings) -> tuple[RawCamera, ...]:
    """Of the calibration file; none where it cannot be read before the images' size is known."""
    try:
        file = settings.camera_file
        return () if file is None else read_calibration_file(Path(file)).cameras
    except CalibrationError:  # a file at fault is refused with the rig
        return ()


def _as_named(
    names: Sequence[str],
    images: Sequence[str],
    cameras: tuple[RawCamera, ...],
    settings: BagSettings,
) -> Chosen:
    """The user's topics and, where the file names them or must, their cameras in it."""
    depths = [name for name in names if _is_depth(name, images)]
    if len(names) == 2 and len(depths) == 1:
        return Chosen((depths[0], next(name for name in names if name not in depths)), depth=True)
    if len(names) not in (2, 3):
        raise DatasetError(
            f"{settings.path}: {len(names)} topics of images are named; name the left camera's and "
            "the right one's, or those of three cameras in the order of their --camera FILE"
        )
    numbers = {_absolute(c.topic): k for k, c in enumerate(cameras) if c.topic}
    known = {numbers.get(name.removesuffix(TRANSPORT), -1): name for name in names}
    if -1 not in known and len(known) == len(names):
        return Chosen(tuple(names), tuple(known))
    if len(names) == 2:
        return Chosen(tuple(names))
    if settings.camera_file is None or len(cameras) not in (0, 3):
        file = Path(settings.camera_file or "").name
        raise DatasetError(
            f"{settings.path}: three topics need one calibration of three cameras "
            f"({f'{file} is of {len(cameras)}' if file else 'none'}); give it by --camera FILE"
        )
    return Chosen(tuple(names), (0, 1, 2))


def _by_rostopics(
    images: Sequence[str], cameras: tuple[RawCamera, ...], settings: BagSettings
) -> Chosen | None:
    """The topics that the calibration file states; None where the bag has not two of them."""
    by_view = _by_view(images)
    found = {k: by_view[view] for k, c in enumerate(cameras)
             if c.topic and (view := _absolute(c.topic)) in by_view}  # fmt: skip
    if len(found) < 2:
        return None
    file, listed = Path(settings.camera_file or "").name, ", ".join(found.values())
    note = f"topics by rostopic of {file}: {listed}"
    if len(found) > 3:
        pairs = [p for p in combinations(range(len(cameras)), 2)
                 if is_stereo_pair([cameras[k] for k in p])]  # fmt: skip
        if len(pairs) != 1 or not found.keys() >= set(pairs[0]):
            raise DatasetError(
                f"{settings.path}: {file} names the topics of {len(found)} cameras, {listed}; say "
                "which two or three form the rig: --topics"
            )
        found = {k: found[k] for k in pairs[0]}
        note += (
            f"; {' and '.join(found.values())} are the only two of them that form a stereo pair "
            "(--topics chooses others)"
        )
    return Chosen(tuple(found.values()), tuple(found), (note,))


def _by_names(
    topics: Sequence[Topic], cameras: tuple[RawCamera, ...], settings: BagSettings
) -> Chosen:
    """The preferred pair; with a file of three cameras the one that the next number names, too."""
    where = settings.path
    images = [topic.name for topic in topics if topic.kind in IMAGES]
    views = [name for name in images if is_view(name)]
    by_view = _by_view(views)
    # Cameras that look ahead come first: those called left and right may look sideways (Spot).
    ranked = sorted(
        camera_pairs(by_view),
        key=lambda pair: ("front" not in pair[0].lower(), _rank(pair[0]), pair),
    )
    if not ranked:
        if (with_depth := _colour_and_depth(images)) is not None:
            return with_depth
        if not views:
            raise DatasetError(
                f"{where} has no topic of camera images (sensor_msgs Image or CompressedImage); it "
                f"has {_list(topics)}: record both cameras' images"
            )
        if len(views) == 1 and settings.camera_file is not None:
            return Chosen((views[0], views[0]))
        if len(views) == 1:
            raise DatasetError(
                f"{where} has images of one camera only, {views[0]}; a stereo pair is the least: "
                "record both cameras; where each image shows both views, side by side or over "
                "under, give the calibration of one pair of views: --camera FILE"
            )
        raise DatasetError(
            f"{where}: which of {', '.join(views)} are left and right is unknown by their names; "
            "say it: --topics LEFT,RIGHT"
        )
    used, *others = ranked
    third = [pair for pair in others if pair[0] == used[1] and len(cameras) == 3][:1]
    also = ", ".join(f"{a} with {b}" for a, b in others if (a, b) not in third)
    notes = [f"also there: {also}; --topics chooses"] if also else []
    absent = [c.topic for c in cameras if c.topic and _absolute(c.topic) not in _by_view(images)]
    if absent:
        file = Path(settings.camera_file or "").name
        text = f"no images here of {', '.join(absent)}, the rostopic in {file}"
        notes.insert(0, f"{text}: topics are recognised by their names")
    names = (*used, *(pair[1] for pair in third))
    numbers = (0, 1, 2) if third else ()
    shown = tuple(by_view[name] for name in names)
    return Chosen(shown, numbers, tuple(notes), guessed=bool(also))


def _list(topics: Sequence[Topic]) -> str:
    return ", ".join(f"{t.name} ({t.kind.rpartition('/')[2]})" for t in topics) or "no message"


def _absolute(topic: str) -> str:
    return "/" + topic.strip().strip("/").removesuffix(TRANSPORT)


def _by_view(names: Sequence[str]) -> dict[str, str]:
    """Topics by their names without transport, raw before compressed."""
    by_view: dict[str, str] = {}
    for name in sorted(names, key=len):
        by_view.setdefault(name.removesuffix(TRANSPORT), name)
    return by_view


def _rank(view: str) -> int:
    last = view.rpartition("/")[2]
    return _PREFERRED.index(last) if last in _PREFERRED else len(_PREFERRED)


def _infos(names: Sequence[str], left: str, right: str) -> tuple[str | None, str | None]:
    """camera_info next to each image topic; else the only pair of camera_info that there is."""
    found = []
    for topic in (left, right):
        plain = topic.removesuffix(_DEPTHS[1]).removesuffix(TRANSPORT)
        # RealSense's viewer records .../image/data next to .../info/camera_info.
        viewer = plain.removesuffix("/image/data") + "/info/camera_info"
        near = (plain.rpartition("/")[0] + "/camera_info", viewer)
        found.append(next((name for name in near if name in names), None))
    pairs = camera_pairs(names)
    if found == [None, None] and len(pairs) == 1:
        return pairs[0]
    return found[0], found[1]


# --------------------------------------------------------------------------------------------
# Colour and depth


_REGISTERED = re.compile(r"aligned|regist|to_(rgb|colou?r)", re.IGNORECASE)
_COLOUR = re.compile(r"rgb|colou?r", re.IGNORECASE)
_OF_DEPTHAI = re.compile(r"/stereo/image_raw(/|$)")  # next to its colour camera's images
SENSOR = re.compile(r"/device_\d+/(sensor_\d+)/")  # of a file of RealSense's viewer
_DEPTH_UNIT = re.compile(r"/option/depth[_ ]units(/value)?$", re.IGNORECASE)
_DEPTHS = ("", "/compressedDepth", TRANSPORT)
"""Endings of topics of depth, plain before compressed."""


def _colour_and_depth(images: Sequence[str]) -> Chosen | None:
    """A camera's images and their depth; None where there is no depth, or no image."""
    depths = [name for name in images if _is_depth(name, images)]
    by_view = _by_view([name for name in images if name not in depths])
    colours = [view for view in by_view if is_view(_own_part(view, images))]
    if not depths or not colours:
        return None

    def depth_rank(name: str) -> tuple[bool, int, int, str]:
        ending = max((k for k, e in enumerate(_DEPTHS) if name.endswith(e)), default=0)
        return not is_registered(name), ending, len(name), name

    depth = min(depths, key=depth_rank)
    colour = min(colours, key=lambda v: (not _COLOUR.search(v), _rank(v), v))
    note = f"{depth} is the depth of {colour} (--topics COLOUR,DEPTH chooses others)"
    several = len(depths) > 1 or len(colours) > 1
    return Chosen((depth, by_view[colour]), notes=(note,), depth=True, guessed=several)


def is_registered(topic: str) -> bool:
    """Whether the name of a topic of depth states that it is registered to colour."""
    return _REGISTERED.search(topic) is not None


def _is_depth(name: str, images: Sequence[str]) -> bool:
    return "depth" in _own_part(name, images).lower() or _OF_DEPTHAI.search(name) is not None


def _own_part(name: str, images: Sequence[str]) -> str:
    """A topic's name without the camera's, which all images share: it may be depth_camera."""
    common = 0
    for words in zip(*(image.split("/")[:-1] for image in images), strict=False):
        if len(set(words)) > 1:
            break
        common += 1
    return "/".join(name.split("/")[common:])


# --------------------------------------------------------------------------------------------
# Odometry: poses of nav_msgs/Odometry, speeds of a stamped twist, turns of an Imu


_TRUTH = re.compile(
    r"truth|(?<![a-z])gt(?![a-z])|vicon|mocap|optitrack|qualisys|leica", re.IGNORECASE
)
# Wheel odometry is stated in a frame odom; map and earth are those of localisation (REP 105), world
# is what simulators and trackers call theirs.
_GLOBAL = re.compile(r"(map|earth|world|utm|enu|ned)(_(enu|ned))?", re.IGNORECASE)
_OF_WHEELS = re.compile(r"wheel|encoder", re.IGNORECASE)
# Their odometry is the truth; pictures of each pixel's object are made by simulators.
_SIMULATED = re.compile(r"^/(airsim|carla|tesse)|/segmentation(/|$)|/seg_cam/", re.IGNORECASE)


def find_motion(
    topics: Sequence[Topic], frame_of: Callable[[Topic], str]
) -> tuple[Topic | None, tuple[str, ...]]:
    """Odometry, of the preferred type the topic whose name states so; and what is none, in a note.

    Truth, and others' answers in a global frame, would make the drive look better than it is.
    """
    simulated = next((t.name for t in topics if _SIMULATED.search(t.name)), "")
    used, left_out = [], []
    for topic in (topic for topic in topics if topic.kind in MOTIONS):
        reason = ""
        if _TRUTH.search(topic.name):
            reason = "truth by its name"
        elif topic.kind == messages.ODOMETRY and not _OF_WHEELS.search(topic.name):
            if simulated:
                reason = f"truth of a simulator, by {simulated}"
            elif _GLOBAL.fullmatch((frame := frame_of(topic)).strip("/")):
                reason = f"in the global frame {frame}"
        if reason:
            left_out.append(f"{topic.name} ({reason})")
        else:
            used.append(topic)
    used.sort(key=lambda t: (MOTIONS.index(t.kind), "odom" not in t.name, len(t.name), t.name))
    note = f"not taken for odometry: {', '.join(left_out)}; --topics LEFT,RIGHT,ODOMETRY takes one"
    return next(iter(used), None), (note,) if left_out else ()
