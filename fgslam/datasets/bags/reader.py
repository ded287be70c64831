"""ROS 1 and ROS 2 bags as stereo recordings, without ROS (docs/datasets/bags.md)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.cameras.formats.ros import read_camera_info_pair
from fgslam.cameras.rig import StereoRig, load_rig, rig_of
from fgslam.core.arrays import FloatArray, Image, IntArray
from fgslam.core.errors import CalibrationError, DatasetError, FrameError
from fgslam.core.geometry import BODY_FORWARD_LEFT_UP_FROM_CAMERA
from fgslam.datasets.bags import messages
from fgslam.datasets.bags.cut import Message
from fgslam.datasets.bags.files import BagFiles, MessagesByPlace, bag_files, paths_of
from fgslam.datasets.bags.motion import odometry_source
from fgslam.datasets.bags.topics import Chosen, choose_topics
from fgslam.datasets.calibrated import mounted
from fgslam.datasets.images import sized
from fgslam.datasets.pairing import NANOSECONDS, pair_stamps
from fgslam.datasets.recording import Recording, recording_identity, select_frames
from fgslam.datasets.settings import BagSettings, RecordedOdometrySettings


def open_bag(settings: BagSettings, odometry: RecordedOdometrySettings) -> Recording:
    """Open a bag; it is read through once for the stamps, images are read when asked for.

    Raises:
        DatasetError: it is no bag, has no pair of cameras, or their images do not pair.
        CalibrationError: neither its camera_info nor a file says where the cameras are.
    """
    where = Path(settings.path)
    paths = paths_of(where)
    files = BagFiles(paths)
    chosen = choose_topics(files.topics, settings.topics, str(where))
    index = _indexed(files, chosen)
    source = _Images(files, index, chosen)
    found, chosen, notes = _calibration(settings, index, chosen, source)
    rig = mounted(found, settings)
    (rows, partners), unpaired = _pairs(index, chosen, settings)
    stamps = NANOSECONDS * index.stamps[chosen.right][rows].astype(np.float64)
    used = select_frames(len(rows), settings)
    places = np.column_stack(
        [index.places[chosen.right][rows], index.places[chosen.left][partners]]
    )
    motions = odometry_source(chosen.motion, index.motions, odometry)
    if motions is not None and np.array_equal(rig.bTc, np.eye(4)):
        rig = replace(rig, bTc=BODY_FORWARD_LEFT_UP_FROM_CAMERA)
        notes += (_LOOKS_AHEAD,)
    return Recording(
        name=where.resolve().stem,
        rig=rig.plain(),
        rectifier=rig.rectifier,
        timestamps=stamps[used],
        identity=recording_identity([], [f for path in paths for f in bag_files(path)]),
        ground_truth=None,
        notes=(*files.notes, *chosen.notes, *index.notes, *unpaired, *notes),
        indices=used,
        load_images=_Pairs(source, places, rig).load,
        odometry_source=motions,
    )


_LOOKS_AHEAD = (
    "nothing says where the camera sits on the robot whose odometry is used: it is taken to look "
    "straight ahead from there (dataset.camera_yaw_deg and lever_arm_m say otherwise)"
)


# --------------------------------------------------------------------------------------------
# Once through the bag


@dataclass(frozen=True, eq=False)
class _Index:
    """What was found on the way through a bag, by topic.

    Attributes:
        topics: all that were looked at.
        times: (n,) the bag's time of each of their messages, nanoseconds.
        places: (k,) of each image topic's messages among the n, by increasing stamp.
        stamps: (k,) their stamps, nanoseconds, increasing.
        calibrations: the first camera_info of each camera, as in a file.
        motions: stamps in seconds and values of the odometry.
        notes: which stamps could not be used.
    """

    topics: frozenset[str]
    times: IntArray
    places: dict[str, IntArray]
    stamps: dict[str, IntArray]
    calibrations: dict[str, dict[str, Any]]
    motions: tuple[FloatArray, FloatArray]
    notes: tuple[str, ...]


def _indexed(files: BagFiles, chosen: Chosen) -> _Index:
    images, infos = {chosen.left, chosen.right}, {chosen.left_info, chosen.right_info}
    motion = chosen.motion.name if chosen.motion else None
    topics = frozenset(name for name in (*images, *infos, motion) if name)
    calibrations: dict[str, dict[str, Any]] = {}

    def take(message: Message) -> tuple[str, int, int, Any]:
        connection, time, raw = message
        topic, value = connection.topic, None
        if topic in infos and topic not in calibrations:
            calibrations[topic] = messages.calibration_of(files.decoded(connection, raw))
        if topic == motion:
            value = messages.motion_of(files.decoded(connection, raw))
        return topic, time, files.stamp(raw), value

    rows = files.collect(topics, take)
    names = np.array([row[0] for row in rows])
    times, stamps = (np.array([row[k] for row in rows], np.int64) for k in (1, 2))
    places, by_stamp, notes = {}, {}, []
    for topic in sorted(images):
        places[topic], by_stamp[topic], note = _in_order(topic, names, times, stamps)
        notes += note
    moved = [(row[2], row[3]) for row in rows if row[0] == motion]
    values = np.array([value for _, value in moved])
    motions = (NANOSECONDS * np.array([stamp for stamp, _ in moved], np.float64), values)
    return _Index(topics, times, places, by_stamp, calibrations, motions, tuple(notes))


def _in_order(
    topic: str, names: Any, times: IntArray, stamps: IntArray
) -> tuple[IntArray, IntArray, list[str]]:
    """Places and increasing stamps of a topic's messages, and what had to be mended."""
    places = np.flatnonzero(names == topic)
    if len(places) == 0:
        raise DatasetError(f"no message of {topic} can be read; record the bag again")
    own, notes = stamps[places], []
    if len(places) > 1 and (own == own[0]).all():
        own = times[places]
        notes.append(f"{topic}: its headers have no time stamps, the bag's own times are used")
    order = np.argsort(own, kind="stable")
    kept = order[np.concatenate([[True], np.diff(own[order]) > 0])]
    if len(kept) < len(order):
        notes.append(f"{topic}: {len(order) - len(kept)} images repeat a stamp and are left out")
    return places[kept], own[kept], notes


def _pairs(
    index: _Index, chosen: Chosen, settings: BagSettings
) -> tuple[tuple[IntArray, IntArray], tuple[str, ...]]:
    right, left = index.stamps[chosen.right], index.stamps[chosen.left]
    tolerance = 1e-3 * settings.pairing_tolerance_ms
    return pair_stamps(right, left, tolerance, (chosen.right, chosen.left))


# --------------------------------------------------------------------------------------------
# Calibration


def _calibration(
    settings: BagSettings, index: _Index, chosen: Chosen, source: _Images
) -> tuple[StereoRig, Chosen, tuple[str, ...]]:
    """The rig, the topics with sides as calibrated, and what was noticed."""
    if settings.camera_file is not None:
        height, width = source.first(chosen.right).shape
        rig = load_rig(settings.camera_file, size=(width, height))
        return rig, chosen, rig.remarks
    left, right = (index.calibrations.get(t or "") for t in (chosen.left_info, chosen.right_info))
    if left is None or right is None:
        raise CalibrationError(_lacking(settings.path, chosen, left is None, right is None))
    notes: tuple[str, ...] = ()
    if left["projection_matrix"]["data"][3] < 0.0 <= right["projection_matrix"]["data"][3]:
        notes = (f"by their camera_info {chosen.left} is the right camera, and is taken so",)
        left, right = right, left
        chosen = replace(
            chosen,
            left=chosen.right,
            right=chosen.left,
            left_info=chosen.right_info,
            right_info=chosen.left_info,
        )
    rectified = [_is_rectified(topic) for topic in (chosen.left, chosen.right)]
    if all(rectified):
        left, right = (_without_distortion(values) for values in (left, right))
    named = [Path(f"{settings.path}:{name}") for name in (chosen.left_info, chosen.right_info)]
    rig = rig_of(read_camera_info_pair((named[0], named[1]), (left, right)))
    return rig, chosen, (*notes, *rig.remarks)


def _lacking(path: str, chosen: Chosen, no_left: bool, no_right: bool) -> str:
    which = [t for t, absent in ((chosen.left, no_left), (chosen.right, no_right)) if absent]
    return (
        f"{path}: no camera_info belongs to {' and '.join(which)}, and one camera's says nothing "
        "of the other; give the calibration of both by --camera FILE"
    )


def _is_rectified(topic: str) -> bool:
    return "rect" in topic.removesuffix("/compressed").rpartition("/")[2].split("_")


def _without_distortion(values: dict[str, Any]) -> dict[str, Any]:
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
# Images


class _Images:
    """Images of a bag by their place."""

    def __init__(self, files: BagFiles, index: _Index, chosen: Chosen) -> None:
        self._files, self._index = files, index
        views = (chosen.left, chosen.right)
        self._messages = MessagesByPlace(files, index.topics, index.times, views)

    def load(self, place: int) -> Image:
        """A grey image. Raises FrameError."""
        connection, raw = self._messages.read(place)
        where = f"{self._files.paths[0]}, {connection.topic}"
        message = self._files.decoded(connection, raw)
        try:
            return messages.grey_of(message, where)
        except AttributeError as fault:  # the bag's own definition of the type is not ROS's
            raise FrameError(
                f"{where}: message without a field of its type ({fault}); copy the bag again"
            ) from None

    def first(self, topic: str) -> Image:
        """The first image of a topic that can be read. Raises DatasetError without any."""
        fault: FrameError | None = None
        for place in self._index.places[topic]:
            try:
                return self.load(int(place))
            except FrameError as error:
                fault = error
        raise DatasetError(f"not one image of {topic} can be read: {fault}")


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Pairs of images by frame."""

    images: _Images
    places: IntArray
    rig: StereoRig

    def load(self, index: int) -> tuple[Image, ...]:
        """Rectified (right, left). Raises FrameError: damaged or of another size."""
        found = []
        for place in self.places[index]:
            name = f"message {place}"
            found.append(sized(self.images.load(int(place)), name, *self.rig.image_size))
        return self.rig.rectified(tuple(found))
