"""Which topics of a bag are used: found by type and by the cameras' names, or named by the user."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

from fgslam.cameras.rig import is_stereo_pair, read_calibration_file
from fgslam.core.errors import CalibrationError, DatasetError
from fgslam.core.sides import camera_pairs, differ_in_number, is_view
from fgslam.datasets import bag_messages as messages
from fgslam.datasets.settings import BagSettings


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a bag: its name, message type ``package/msg/Type`` and number of messages."""

    name: str
    kind: str
    count: int


IMAGES = (messages.IMAGE, messages.COMPRESSED)
MOTIONS = (messages.ODOMETRY, messages.TWIST, messages.TWIST_WITH_COVARIANCE, messages.IMU)
"""The first that a bag has is its odometry."""

TRANSPORT = "/compressed"
_PREFERRED = ("image_raw", "image_rect", "image_rect_raw", "image", "image_mono")
"""Last parts of topics, grey and raw ones first; others after them."""


@dataclass(frozen=True, slots=True)
class _Views:
    """Topics of left, right[, top], their cameras in the file, and what else could be taken."""

    topics: tuple[str, ...]
    numbers: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()
    depth: bool = False


@dataclass(frozen=True, slots=True)
class Chosen:
    """Topics that are used.

    Attributes:
        views: of left and right images, perhaps of top ones.
        left_info, right_info: of their camera_info; None where there is none.
        motion: of odometry, or None.
        transforms: of tf_static; where the bag has none, of tf, which states again what stays.
        notes: what else could have been taken.
        numbers: which cameras of the calibration file the views are, so that it determines the
            sides; empty: the topics do.
        depth: whether left is the depth of right, in place of a second camera.
    """

    views: tuple[str, ...]
    left_info: str | None
    right_info: str | None
    motion: Topic | None
    transforms: tuple[str, ...]
    notes: tuple[str, ...]
    numbers: tuple[int, ...] = ()
    depth: bool = False

    @property
    def left(self) -> str:
        """Topic of the left images, or of depth."""
        return self.views[0]

    @property
    def right(self) -> str:
        """Topic of the right images."""
        return self.views[1]


@dataclass(frozen=True, slots=True)
class FileCameras:
    """The cameras of a calibration file.

    Attributes:
        file: its name; empty: there is none.
        topics: of each camera's images, empty where it states none; () where it cannot be read
            before the images' size is known.
        ahead: of more than three cameras the only two that form a stereo pair; () where there are
            several such pairs, or none.
    """

    file: str = ""
    topics: tuple[str, ...] = ()
    ahead: tuple[int, ...] = ()


def file_cameras(settings: BagSettings) -> FileCameras:
    """What the calibration file states of topics; a file at fault is refused with the rig."""
    if settings.camera_file is None:
        return FileCameras()
    file = Path(settings.camera_file)
    try:
        cameras = read_calibration_file(file).cameras
    except CalibrationError:
        return FileCameras(file.name)
    ahead: list[tuple[int, ...]] = []
    if len(cameras) > 3:
        pairs = combinations(range(len(cameras)), 2)
        ahead = [pair for pair in pairs if is_stereo_pair([cameras[k] for k in pair])]
    topics = tuple(camera.topic for camera in cameras)
    return FileCameras(file.name, topics, ahead[0] if len(ahead) == 1 else ())


def choose_topics(
    topics: Sequence[Topic],
    wanted: Sequence[str],
    where: str,
    cameras: FileCameras,
    frame_of: Callable[[Topic], str] = lambda _: "",
) -> Chosen:
    """The topics of two or three cameras and of their odometry.

    Args:
        topics: of the bag.
        wanted: named by the user: images of each camera, and perhaps odometry.
        where: the bag, in messages.
        cameras: of the calibration file.
        frame_of: the frame in which a topic states its first message.

    Raises:
        DatasetError: a wanted topic is not there or of no use, or the bag has no pair of cameras.
    """
    used = [topic for topic in topics if topic.count]
    by_name = {topic.name: topic for topic in used}
    for name in wanted:
        if name not in by_name:
            raise DatasetError(f"{where} has no topic {name} with messages; it has {_list(used)}")
        if by_name[name].kind not in (*IMAGES, *MOTIONS):
            raise DatasetError(
                f"{where}: {name} is {by_name[name].kind}, which is no image and no odometry; name "
                "the left camera's images, the right one's, then perhaps one of odometry"
            )
    named = [name for name in wanted if by_name[name].kind in IMAGES]
    if named:
        views = _views_as_named(named, used, cameras, where)
    else:
        views = _views_by_file(used, cameras, where) or _views_by_names(used, cameras, where)
    motions = [by_name[name] for name in wanted if by_name[name].kind in MOTIONS]
    motion, others = (motions[0], ()) if motions else motion_of_bag(used, frame_of)
    of_frames = tuple(topic.name for topic in used if topic.kind in messages.TRANSFORMS)
    return Chosen(
        views.topics,
        *_infos(used, *views.topics[:2]),
        motion,
        tuple(name for name in of_frames if name.endswith("tf_static")) or of_frames,
        (*views.notes, *others),
        views.numbers,
        views.depth,
    )


def _views_as_named(
    names: Sequence[str], topics: Sequence[Topic], cameras: FileCameras, where: str
) -> _Views:
    """The user's topics and, where the file names them or must, their cameras in it."""
    images = [topic.name for topic in topics if topic.kind in IMAGES]
    depths = [name for name in names if _is_depth(name, images)]
    if len(names) == 2 and len(depths) == 1:
        (colour,) = set(names) - set(depths)
        return _Views((depths[0], colour), depth=True)
    if len(names) not in (2, 3):
        raise DatasetError(
            f"{where}: {len(names)} topics of images are named; name the left camera's and the "
            "right one's, or those of three cameras in the order of their --camera FILE"
        )
    numbers = {_absolute(topic): k for k, topic in enumerate(cameras.topics) if topic}
    found = [numbers.get(name.removesuffix(TRANSPORT)) for name in names]
    known = tuple(k for k in found if k is not None)
    if len(set(known)) == len(names):
        return _Views(tuple(names), known)
    if len(names) == 2:
        return _Views(tuple(names), _numbered_of_many(names, cameras))
    if not cameras.file or len(cameras.topics) not in (0, 3):
        known_of = f"{cameras.file} is of {len(cameras.topics)}" if cameras.file else "none"
        raise DatasetError(
            f"{where}: three topics of images are named, which need one calibration of all three "
            f"cameras ({known_of}); give it by --camera FILE, or name two topics"
        )
    return _Views(tuple(names), (0, 1, 2))


def _views_by_file(topics: Sequence[Topic], cameras: FileCameras, where: str) -> _Views | None:
    """The topics that the calibration file states; None where the bag has not two of them."""
    by_view = _by_view([topic.name for topic in topics if topic.kind in IMAGES])
    stated = {k: _absolute(topic) for k, topic in enumerate(cameras.topics) if topic}
    found = {k: by_view[view] for k, view in stated.items() if view in by_view}
    if len(found) < 2:
        return None
    listed = ", ".join(found.values())
    note = f"topics by rostopic of {cameras.file}: {listed}"
    if len(found) > 3:
        if not cameras.ahead or not found.keys() >= set(cameras.ahead):
            raise DatasetError(
                f"{where}: {cameras.file} names the topics of {len(found)} cameras, {listed}; say "
                "which two or three form the rig: --topics"
            )
        found = {k: found[k] for k in cameras.ahead}
        note += (
            f"; {' and '.join(found.values())} are the only two of them that form a stereo pair "
            "(--topics chooses others)"
        )
    return _Views(tuple(found.values()), tuple(found), (note,))


def _views_by_names(topics: Sequence[Topic], cameras: FileCameras, where: str) -> _Views:
    """The preferred pair; with a file of three cameras the one that the next number names, too."""
    views = [t.name for t in topics if t.kind in IMAGES and is_view(t.name)]
    by_view = _by_view(views)
    # Cameras that look ahead come first: those called left and right may look sideways (Spot).
    ranked = sorted(
        camera_pairs(by_view),
        key=lambda pair: ("front" not in pair[0].lower(), _rank(pair[0]), pair),
    )
    if not ranked:
        if (with_depth := _colour_and_depth(topics)) is not None:
            return with_depth
        raise DatasetError(_no_pair(topics, views, where))
    if cameras.ahead:
        ranked = sorted(ranked, key=lambda pair: _differing_numbers(pair) != cameras.ahead)
    used, *others = ranked
    third = [pair for pair in others if pair[0] == used[1] and len(cameras.topics) == 3][:1]
    names = (*used, *(pair[1] for pair in third))
    also = ", ".join(f"{a} with {b}" for a, b in others if (a, b) not in third)
    notes = [f"also there: {also}; --topics chooses"] if also else []
    shown = set(_by_view([topic.name for topic in topics if topic.kind in IMAGES]))
    absent = [topic for topic in cameras.topics if topic and _absolute(topic) not in shown]
    if absent:
        text = f"no images here of {', '.join(absent)}, the rostopic in {cameras.file}"
        notes.insert(0, f"{text}: topics are recognised by their names")
    numbers = (0, 1, 2) if third else _numbered_of_many(used, cameras)
    return _Views(tuple(by_view[name] for name in names), numbers, tuple(notes))


def _no_pair(topics: Sequence[Topic], views: Sequence[str], where: str) -> str:
    if not views:
        return (
            f"{where} has no topic of camera images (sensor_msgs Image or CompressedImage); it has "
            f"{_list(topics)}: record both cameras' images"
        )
    if len(views) == 1:
        return (
            f"{where} has images of one camera only, {views[0]}; a stereo pair is the least: "
            "record both cameras"
        )
    return (
        f"{where}: which of {', '.join(views)} are left and right is unknown by their names; "
        "say it: --topics LEFT,RIGHT"
    )


def _list(topics: Sequence[Topic]) -> str:
    return ", ".join(f"{t.name} ({t.kind.rpartition('/')[2]})" for t in topics) or "no message"


def _numbered_of_many(names: Sequence[str], cameras: FileCameras) -> tuple[int, ...]:
    """Of a file of more than three cameras those that numbers in names state; () where none do."""
    numbers = _differing_numbers(names)
    count = len(cameras.topics)
    return numbers if count > 3 and numbers and max(numbers) < count else ()


def _differing_numbers(names: Sequence[str]) -> tuple[int, ...]:
    """The first number in which two names differ, of each; () where they differ in more."""
    if not differ_in_number(*names):
        return ()
    words = zip(*(re.findall(r"\d+", name) for name in names), strict=False)
    return next((tuple(map(int, both)) for both in words if len(set(both)) > 1), ())


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


def _infos(topics: Sequence[Topic], left: str, right: str) -> tuple[str | None, str | None]:
    """camera_info next to each image topic; else the only pair of camera_info that there is."""
    names = {topic.name for topic in topics if topic.kind == messages.CAMERA_INFO}
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


# Colour and depth


_REGISTERED = re.compile(r"aligned|regist|to_(rgb|colou?r)", re.IGNORECASE)
_COLOUR = re.compile(r"rgb|colou?r", re.IGNORECASE)
_OF_DEPTHAI = re.compile(r"/stereo/image_raw(/|$)")  # next to its colour camera's images
SENSOR = re.compile(r"/device_\d+/(sensor_\d+)/")  # of a file of RealSense's viewer
_DEPTHS = ("", "/compressedDepth", TRANSPORT)
"""Endings of topics of depth, plain before compressed."""


def _colour_and_depth(topics: Sequence[Topic]) -> _Views | None:
    """A camera's images and their depth; None where there is no depth, or no image."""
    images = [topic.name for topic in topics if topic.kind in IMAGES]
    depths = sorted((name for name in images if _is_depth(name, images)), key=_depth_rank)
    by_view = _by_view([name for name in images if not _is_depth(name, images)])
    colours = sorted(by_view, key=lambda v: (not _COLOUR.search(v), _rank(v), v))
    colours = [view for view in colours if is_view(_own_part(view, images))]
    if not depths or not colours:
        return None
    note = f"{depths[0]} is the depth of {colours[0]} (--topics COLOUR,DEPTH chooses others)"
    return _Views((depths[0], by_view[colours[0]]), notes=(note,), depth=True)


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


def _depth_rank(name: str) -> tuple[bool, int, int, str]:
    ending = max((k for k, e in enumerate(_DEPTHS) if name.endswith(e)), default=0)
    return not is_registered(name), ending, len(name), name


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


def motion_of_bag(
    topics: Sequence[Topic], frame_of: Callable[[Topic], str]
) -> tuple[Topic | None, tuple[str, ...]]:
    """Odometry, of the preferred type the topic whose name states so; and what is none, in a note.

    Truth, and others' answers in a global frame, would make the drive look better than it is.
    """
    simulated = next((t.name for t in topics if _SIMULATED.search(t.name)), "")

    def why_none(topic: Topic) -> str:
        if _TRUTH.search(topic.name):
            return "truth by its name"
        if topic.kind != messages.ODOMETRY or _OF_WHEELS.search(topic.name):
            return ""
        if simulated:
            return f"truth of a simulator, by {simulated}"
        frame = frame_of(topic)
        return f"in the global frame {frame}" if _GLOBAL.fullmatch(frame.strip("/")) else ""

    reasons = {topic: why_none(topic) for topic in topics if topic.kind in MOTIONS}
    left_out = ", ".join(f"{topic.name} ({why})" for topic, why in reasons.items() if why)
    used = sorted(
        (topic for topic, reason in reasons.items() if not reason),
        key=lambda t: (MOTIONS.index(t.kind), "odom" not in t.name, len(t.name), t.name),
    )
    note = f"not taken for odometry: {left_out}; --topics LEFT,RIGHT,ODOMETRY takes one"
    return next(iter(used), None), (note,) if left_out else ()
