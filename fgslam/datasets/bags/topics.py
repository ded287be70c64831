"""Which topics of a bag are used: found by type and by the cameras' names, or named by the user."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from fgslam.core.errors import DatasetError
from fgslam.datasets.bags import messages as kinds
from fgslam.datasets.bags.files import Topic
from fgslam.datasets.sides import camera_pairs

IMAGES = (kinds.IMAGE, kinds.COMPRESSED)
MOTIONS = (kinds.ODOMETRY, kinds.TWIST, kinds.TWIST_WITH_COVARIANCE, kinds.IMU)
"""The first that a bag has is its odometry."""

_TRANSPORT = "/compressed"
_NO_VIEW = re.compile(r"depth|dispar|theora|mask|debug|segment|heat|thumb", re.IGNORECASE)
_TRUTH = re.compile(r"truth|(?<![a-z])gt(?![a-z])|vicon|mocap|optitrack", re.IGNORECASE)
_PREFERRED = ("image_raw", "image_rect", "image_rect_raw", "image", "image_mono")
"""Last parts of topics, grey and raw ones first; others after them."""


@dataclass(frozen=True, slots=True)
class Chosen:
    """Topics that are used.

    Attributes:
        left, right: of images.
        left_info, right_info: of their camera_info; None where there is none.
        motion: of odometry, or None.
        transforms: of tf_static; where the bag has none, of tf, which says again what stays.
        notes: what else could have been taken.
    """

    left: str
    right: str
    left_info: str | None
    right_info: str | None
    motion: Topic | None
    transforms: tuple[str, ...]
    notes: tuple[str, ...]


def choose_topics(topics: Sequence[Topic], wanted: Sequence[str], where: str) -> Chosen:
    """The topics of one stereo pair and of its odometry.

    Raises:
        DatasetError: a wanted topic is not there or of no use, or the bag has no pair of cameras.
    """
    used = [topic for topic in topics if topic.count]
    named = _named(used, wanted, where)
    images = [topic for topic in named if topic.kind in IMAGES]
    motions = [topic for topic in named if topic.kind in MOTIONS]
    if wanted and len(images) not in (0, 2):
        raise DatasetError(
            f"{where}: {len(images)} topics of images are named; name the left camera's and the "
            "right one's"
        )
    others: tuple[str, ...] = ()
    if images:
        left, right = (topic.name for topic in images)
    else:
        left, right, others = _pair(used, where)
    infos = _infos(used, left, right)
    notes = (f"also there: {', '.join(others)}; --topics chooses",) if others else ()
    motion = motions[0] if motions else _motion(used)
    of_frames = tuple(topic.name for topic in used if topic.kind in kinds.TRANSFORMS)
    transforms = tuple(name for name in of_frames if name.endswith("tf_static")) or of_frames
    return Chosen(left, right, *infos, motion, transforms, notes)


def _named(topics: Sequence[Topic], wanted: Sequence[str], where: str) -> list[Topic]:
    by_name = {topic.name: topic for topic in topics}
    for name in wanted:
        if name not in by_name:
            raise DatasetError(f"{where} has no topic {name} with messages; it has {_list(topics)}")
        if by_name[name].kind not in (*IMAGES, *MOTIONS):
            raise DatasetError(
                f"{where}: {name} is {by_name[name].kind}, which is no image and no odometry; name "
                "the left camera's images, the right one's, then perhaps one of odometry"
            )
    return [by_name[name] for name in wanted]


def _pair(topics: Sequence[Topic], where: str) -> tuple[str, str, tuple[str, ...]]:
    """The preferred pair of image topics, left first, and the other pairs in words."""
    views = [t.name for t in topics if t.kind in IMAGES and not _NO_VIEW.search(t.name)]
    by_view: dict[str, str] = {}
    for name in sorted(views, key=len):
        by_view.setdefault(name.removesuffix(_TRANSPORT), name)  # raw before compressed
    pairs = sorted(camera_pairs(by_view), key=lambda pair: (_rank(pair[0]), pair))
    if not pairs:
        raise DatasetError(_no_pair(topics, views, where))
    left, right = pairs[0]
    others = tuple(f"{a} with {b}" for a, b in pairs[1:])
    return by_view[left], by_view[right], others


def _rank(view: str) -> int:
    last = view.rpartition("/")[2]
    return _PREFERRED.index(last) if last in _PREFERRED else len(_PREFERRED)


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
        f"{where}: which of {', '.join(views)} are left and right cannot be told by their names; "
        "say it: --topics LEFT,RIGHT"
    )


def _list(topics: Sequence[Topic]) -> str:
    return ", ".join(f"{t.name} ({t.kind.rpartition('/')[2]})" for t in topics) or "no message"


def _infos(topics: Sequence[Topic], left: str, right: str) -> tuple[str | None, str | None]:
    """camera_info beside each image topic; else the only pair of camera_info that there is."""
    names = {topic.name for topic in topics if topic.kind == kinds.CAMERA_INFO}
    beside = [_info_beside(topic) for topic in (left, right)]
    found = [name if name in names else None for name in beside]
    pairs = camera_pairs(names)
    if found == [None, None] and len(pairs) == 1:
        return pairs[0]
    return found[0], found[1]


def _info_beside(image_topic: str) -> str:
    return image_topic.removesuffix(_TRANSPORT).rpartition("/")[0] + "/camera_info"


def _motion(topics: Sequence[Topic]) -> Topic | None:
    """Odometry: the preferred type, of it the topic whose name says so."""
    found = [t for t in topics if t.kind in MOTIONS and not _TRUTH.search(t.name)]
    key = {kind: k for k, kind in enumerate(MOTIONS)}
    return min(
        found, key=lambda t: (key[t.kind], "odom" not in t.name, len(t.name), t.name), default=None
    )
