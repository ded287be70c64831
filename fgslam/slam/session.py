"""A SLAM session: frames are pushed into it one by one, results may be asked for at any time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from threading import Condition
from typing import TYPE_CHECKING, Any, Self, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from fgslam.backend.protocol import Estimator
from fgslam.backend.settings import DEFAULT_ESTIMATOR, EstimatorSettings
from fgslam.cameras.rig import StereoRig, require_rig
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.checks import later_time, require_seed
from fgslam.core.errors import (
    ConfigError,
    FrameError,
    MeasurementLogError,
    OdometryError,
    SessionError,
)
from fgslam.core.geometry import is_rigid
from fgslam.core.log import Frame, MeasurementLog
from fgslam.core.memory import keep_freed_memory
from fgslam.core.sensors import CameraRig, Measured, Odometry, compose_odometry
from fgslam.core.threads import one_blas_thread
from fgslam.core.types import LandmarkMap, Remark, Trajectory
from fgslam.datasets.odometry import pose_noise
from fgslam.datasets.settings import OdometrySettings, RecordedOdometrySettings
from fgslam.frontend.features.sift import grey_image
from fgslam.frontend.settings import FrontendSettings
from fgslam.slam.build import (
    Arrival,
    MapStart,
    as_measured,
    chosen_estimator,
    chosen_frontend,
    chosen_odometry,
    is_settings,
    make_describer,
    make_locator,
    make_pipeline,
)
from fgslam.slam.feature_stream import FeatureExtractor, FeatureFrame, undescribed
from fgslam.slam.motion import MotionModel, description_of
from fgslam.slam.pipeline import FrameReport, SlamPipeline
from fgslam.slam.results import (
    FirstImages,
    RunRecorder,
    SessionResult,
    Step,
    any_uint16,
    result_of,
    session_remarks,
)

if TYPE_CHECKING:
    from fgslam.slam.rig_memory import RigMemory

Images: TypeAlias = Sequence[npt.ArrayLike | None]
"""Images (left, right[, top]) of one instant; None where one is missing."""


class Session:
    """Simultaneous localisation and mapping over stereo frames (Se, Lowe and Little 2001).

    Frames are handed in by :meth:`track`, which never needs the next one; :meth:`result` may be
    asked for at any time and changes nothing of what follows. Sessions are independent: several
    may run side by side in one process, each used by one thread at a time. A frame that is refused
    leaves the session as it was.

    The world is the right camera's first frame: x right, y down, z forward, metres. Frames before
    the first one that shows enough to begin a map are left out of every result when that one comes,
    unless odometry was measured to it: nothing shows where they lie.

    Attributes:
        rig: the cameras.
        frontend: settings of features, matching and tracking.
        numbering: number in its recording of the first frame tracked, and the step to the next;
            the log keeps them.
        pipeline: the parts: stereo matching, tracking, motion model, estimator, place recognition.
        recorder: everything computed so far, frame by frame.
    """

    def __init__(
        self,
        rig: CameraRig,
        estimator: str | EstimatorSettings | Estimator = DEFAULT_ESTIMATOR,
        *,
        frontend: FrontendSettings | Mapping[str, Any] | None = None,
        odometry: OdometrySettings | MotionModel | None = None,
        features: FeatureExtractor | None = None,
        seed: int = 0,
        beginning: Arrival | MapStart | None = None,
        rig_memory: RigMemory | None = None,
    ) -> None:
        """Begins with an empty map, or in a saved one.

        Args:
            rig: the rectified cameras, two or three.
            estimator: the kind (``fgslam.backend.settings.ESTIMATORS``), settings of one, or an own
                object with the members of :class:`fgslam.backend.protocol.Estimator`.
            frontend: settings of features, matching and tracking; None for the defaults; a mapping
                for what differs from these: ``{"stereo": {"max_disparity_px": 80}}``.
            odometry: what predicts the motion. None: the odometry that is handed in, and constant
                velocity over frames without any. With `constant_velocity` what is handed in is
                ignored. Or an own object with the members of
                :class:`fgslam.slam.motion.MotionModel`, for this session alone.
            features: an own extractor, from a grey image (height, width) uint8 to
                :class:`~fgslam.core.types.Features`; it is called from several threads, with two
                cameras for the right image alone (``frontend.stereo.others``). None for SIFT.
            seed: of everything random: samples of place recognition.
            beginning: a saved map: with the first frame's place in it, or to be located in by the
                first frames. Those before the first one that could be located have no pose.
            rig_memory: what earlier drives have shown of the rig's calibration; None: nothing.

        Raises:
            CalibrationError: the rig is impossible.
            ConfigError: no such estimator, it cannot use what will be measured or begin in a map,
                the seed is negative, or a setting of the front-end is not known or not usable.
            MapError: other cameras made the map, or it is empty.
        """
        keep_freed_memory()
        require_rig(rig)
        require_seed(seed, "session")
        frontend = chosen_frontend(frontend)
        odometry = chosen_odometry(odometry)
        self.rig = rig
        self.frontend = frontend
        self.numbering = (0, 1)
        chosen = chosen_estimator(estimator)
        self._make = partial(make_pipeline, rig, frontend, odometry, chosen, seed, rig_memory)
        self._start: MapStart | None = None
        own = is_settings(chosen) and not hasattr(odometry, "between")
        self._movable = beginning is None and own
        if isinstance(beginning, MapStart):
            beginning = self._begun(beginning, chosen, seed)
        self.describer = make_describer(rig, frontend, checked_extractor(features))
        self.pipeline = self._made(beginning)
        sensor = as_measured(rig, frontend)
        self.recorder = RunRecorder(MeasurementLog(sensor, description_of(self.pipeline.motion)))
        self._left_out = _LeftOut()
        self._seen = FirstImages()
        self._margins = rig.margins if isinstance(rig, StereoRig) else ()
        self._odometry = odometry
        self._ended = ""
        self._failed = False

    # -- frames --------------------------------------------------------------------------------

    def track(
        self,
        t: float,
        images: Images | None,
        odometry: Odometry | FloatArray | npt.ArrayLike | None = None,
        measurements: Iterable[Measured] = (),
    ) -> Step:
        """Takes in the next frame; returns its pose and what was matched.

        Args:
            t: time stamp in seconds, later than the last frame's.
            images: (left, right) or (left, right, top), taken at the same moment and rectified, or
                raw where the rig was loaded with its rectification:
                (height, width) grey or (height, width, 3) red, green, blue; uint8, or uint16 of
                which the upper eight bits count; any memory layout. None in place of one that is
                missing: the frame is located by the other; None for all of them where the cameras
                gave nothing: it is then placed by the odometry alone.
            odometry: motion of the robot's body since the last frame: a (4, 4) pose of the body now
                in its frame before, metres, with the noise of the odometry settings; or an
                :class:`Odometry` with its own covariance. None where none was measured: constant
                velocity. That of the first frame is ignored.
            measurements: by other sensors, one item a kind, as ``model.measured(...)`` makes them;
                identities of landmarks from ``fgslam.Measured.FIRST_ID`` on.

        Raises:
            MeasurementLogError: a measurement is none, or of a smaller identity.
            FrameError: wrong number, size, type or shape of images, or the time does not increase.
            OdometryError: the odometry is not finite, of another shape, or no rigid motion.
            SessionError: the session is closed, or its estimator failed before.
            EstimatorError: the estimator failed in this frame; the session is then at its end,
                with :meth:`result` of the frames before. So it is after any other exception that
                an estimator of your own raises.
        """
        self._require_open()
        i = self._left_out.count if self._start is not None else len(self.recorder)
        timestamp = later_time(t, self._last_time(), "session", FrameError)
        body = checked_odometry(odometry, self._odometry) if i else None
        measured = checked_measurements(measurements)
        images, alone = _completed(images, self.rig)
        checked = None if images is None else checked_images(images, self.rig)
        frame = None if checked is None else Frame(i, timestamp, checked, self._margins, alone)
        with one_blas_thread():
            bare = undescribed(i, frame)
            every = self.frontend.tracking == "sift"
            found = self.describer.complete(bare) if every or self._start is not None else bare
            if images is not None:
                self._seen.add(found, any_uint16(images))
            if self._start is None:
                now = found
                if self.begins_anew(found, body):
                    # An extractor that fails does so before anything has changed.
                    now, body = self.describer.of_reference(replace(found, i=0)), None
                    self._begin_again(timestamp)
                report = self.advance(now, timestamp, body, measured=measured)
                if images is not None and not found.features:
                    self._seen.add(report.found, any_uint16(images))
                return Step.of(report)
            if not self._arrives(self._start, found, timestamp):
                return Step.not_located(timestamp, len(self.pipeline.tracker.database))
            first = found if every else bare  # then measured as every key frame is
            return Step.of(self.advance(replace(first, i=0), timestamp, measured=measured))

    def advance(
        self,
        found: FeatureFrame,
        timestamp: float,
        body: Odometry | None = None,
        index: int | None = None,
        wait_ms: float = 0.0,
        precision_of: Callable[[FrameReport], float] | None = None,
        measured: tuple[Measured, ...] = (),
    ) -> FrameReport:
        """Takes in a frame whose features are known: what :meth:`track` does after finding them.

        Args:
            found: the frame and its features; ``found.i`` counts the session's frames.
            timestamp: seconds.
            body: odometry of the body, checked.
            index: number of the frame in its recording, for the log; None: by ``numbering``.
            wait_ms: time that the loop waited for this frame, for the record.
            precision_of: fraction of right stereo matches, where truth is known.
            measured: by other sensors, checked.
        """
        self._require_open()
        first, stride = self.numbering
        index = first + stride * found.i if index is None else index
        try:
            report = self.pipeline.process(found, index, timestamp, self._usable(body), measured)
            precision = float("nan") if precision_of is None else precision_of(report)
            self.recorder.add(report, wait_ms, precision)
        except BaseException as error:
            if self.pipeline.rewound:
                raise
            # Parts of the frame may be recorded: going on would estimate something else.
            self._failed = True
            self._ended = f"it failed at t = {timestamp:.6f} s ({' '.join(str(error).split())})"
            raise
        return report

    def _require_open(self) -> None:
        if self._ended:
            raise SessionError(f"the session takes no more frames: {self._ended}; make a new one")

    def _last_time(self) -> float | None:
        increments = self.recorder.log.increments
        return increments[-1].timestamp if increments else self._left_out.timestamp

    def _usable(self, body: Odometry | None) -> Odometry | None:
        return body if self.pipeline.motion.uses_odometry else None

    def begins_anew(self, found: FeatureFrame, body: Odometry | None) -> bool:
        """Whether the world begins with this frame, and those before it are to be left out.

        They had too few stereo matches to place a frame after them, this one has enough, and no
        odometry measured how the camera moved to it.

        Args:
            found: the frame; its features are found where it came without.
            body: odometry of the body since the last frame, as for :meth:`advance`.
        """
        least, known = self.frontend.ego_motion.min_matches, self._usable(body)
        if not (self._movable and len(self)) or (known is not None and not known.turned):
            return False
        if self.recorder.most_stereo >= least:
            return False
        return self.pipeline.can_initialise(found, least)

    def _begin_again(self, timestamp: float) -> None:
        """Leaves out all frames so far: the next one is the first."""
        count = len(self)
        self._left_out = _LeftOut(self._left_out.count + count, timestamp)
        self.log.increments.clear()
        self.recorder = RunRecorder(self.log, left_out=self._left_out.count)
        self._begin(None, count)

    def _begin(self, arrival: Arrival | None, count: int) -> None:
        """New parts, for a session that begins after ``count`` frames."""
        self.pipeline = self._made(arrival)
        first, stride = self.numbering
        self.numbering = (first + stride * count, stride)

    def _made(self, beginning: Arrival | None) -> SlamPipeline:
        pipeline = self._make(beginning)
        pipeline.describe = self.describer.complete
        pipeline.describe_reference = self.describer.of_reference
        return pipeline

    def _begun(
        self, start: MapStart, estimator: EstimatorSettings | Estimator, seed: int
    ) -> Arrival:
        """The first pose in a saved map; until a frame is located, that of the map's world."""
        if not is_settings(estimator):
            raise ConfigError(
                "estimator: an own estimator begins at a pose of its own, not where the first "
                "frame is located in the map; give a kind or its settings"
            )
        start.require_usable(self.rig)
        known = start.known()
        if known is not None:
            return known
        self._start, self._map = start, start.name
        self._locate = make_locator(self.rig, self.frontend, start.saved, seed)
        return start.at(np.eye(4), relocalised=True)

    def _arrives(self, start: MapStart, found: FeatureFrame, timestamp: float) -> bool:
        """True if the frame can be located in the map: the session then begins with it."""
        left_out, why = self._left_out, found.problem
        if found.frame is not None:
            located = self._locate(found)
            why = located.why
            if located.found:
                self._begin(start.at(located.wTc, relocalised=True), left_out.count)
                self._start = None
                return True
        self._left_out = _LeftOut(left_out.count + 1, timestamp, why)
        return False

    def __len__(self) -> int:
        """Frames so far."""
        return len(self.recorder)

    # -- results -------------------------------------------------------------------------------

    @property
    def path(self) -> Trajectory:
        """Each pose so far as it was first estimated: in microseconds, without a solution."""
        return self.recorder.online

    @property
    def landmarks(self) -> LandmarkMap:
        """The map as the next frame is matched to it: without a solution, in microseconds.

        A smoother's covariances are here given the poses; :meth:`result` has marginals. The arrays
        are good until the next frame.
        """
        return self.pipeline.estimator.landmarks()

    def result(self) -> SessionResult:
        """Trajectory, covariances and map as known now; tracking may go on afterwards.

        Raises:
            SessionError: there is no frame yet.
        """
        left_out = self._left_out
        if not len(self.recorder):
            raise SessionError(self._why_empty())
        notes = session_remarks(self.pipeline, self.recorder, self._seen)
        if left_out.count:
            notes = (*notes, Remark("left_out", values={"count": left_out.count}))
        with one_blas_thread():
            return result_of(self.pipeline, self.recorder, notes, self._failed)

    def _why_empty(self) -> str:
        if self._failed:
            return f"the session has no result: {self._ended}"
        left_out = self._left_out
        if left_out.count:
            why = "; ".join(filter(None, (left_out.why, self._seen.fault())))
            return f"none of {left_out.count} frames could be located in {self._map}: {why}"
        return "no frame has been tracked yet; call track first"

    def remembered(self, memory: RigMemory) -> RigMemory:
        """A memory of the rig with what this drive has shown; as it is where that is nothing."""
        calibration = self.pipeline.calibration
        return memory if calibration is None else memory.after(calibration, self.recorder.seen)

    @property
    def failed(self) -> bool:
        """True if a frame failed half-way: the parts may know more than the record does."""
        return self._failed

    @property
    def log(self) -> MeasurementLog:
        """Measurements of all frames so far, which any estimator can replay."""
        return self.recorder.log

    def close(self) -> None:
        """Ends the session and its threads; results can still be asked for."""
        self._ended = self._ended or "it is closed"
        self.describer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


@dataclass(frozen=True)
class _LeftOut:
    """Frames before the first that was located in the map: how many, the last one's time, why."""

    count: int = 0
    timestamp: float | None = None
    why: str = ""


# ------------------------------------------------------------------------------------------
# Input of a session, checked before it touches any state

_NAMES = ("left", "right", "top")
_SYMMETRY = 1e-6  # relative: covariances that were added up in another order


def checked_extractor(features: FeatureExtractor | None) -> FeatureExtractor | None:
    """Raises ConfigError for what cannot be called."""
    if features is not None and not callable(features):
        raise ConfigError(
            f"features: {type(features).__name__} cannot be called; give a function from an image "
            "to fgslam.Features, or None for SIFT"
        )
    return features


def _completed(
    images: Images | None, rig: CameraRig
) -> tuple[Sequence[npt.ArrayLike] | None, int | None]:
    """Images with black ones in place of missing ones, and the camera whose image is left.

    None for images that are all missing; no camera where none is, or their number is wrong.
    """
    missing = isinstance(images, tuple | list) and any(one is None for one in images)
    if images is None or not missing or len(images) != rig.cameras:
        return cast("Sequence[npt.ArrayLike] | None", images), None
    # The rig's order is right, left, top.
    there = [k for k, one in zip((1, 0, 2), images, strict=False) if one is not None]
    if not there:
        return None, None
    black = np.zeros(_size(rig)[::-1], np.uint8)
    return [black if one is None else one for one in images], min(there)


def checked_images(images: Sequence[npt.ArrayLike], rig: CameraRig) -> tuple[Image, ...]:
    """Grey rectified images (right, left[, top]) of the rig's size from (left, right[, top]).

    Copies: tracking needs the last images again, and a camera loop may fill the same ones again.

    Raises:
        FrameError: another number of images, or one of another size, type or shape.
    """
    wanted = ", ".join(_NAMES[: rig.cameras])
    try:
        if isinstance(images, str | bytes | Mapping):
            raise TypeError
        given = len(images)
    except TypeError:
        raise FrameError(
            f"the images are a {type(images).__name__}; give a tuple ({wanted}), or None where the "
            "cameras gave nothing"
        ) from None
    if isinstance(images, np.ndarray) and (
        images.ndim < 3 or (images.ndim == 3 and images.shape[2] in (3, 4))  # of one image
    ):
        raise FrameError(f"one image given instead of {rig.cameras}; give ({wanted})")
    if given != rig.cameras:
        other = {2: ", or a rig without vertical_baseline", 3: ", or a rig with one more camera"}
        raise FrameError(
            f"{given} images given, the rig has {rig.cameras} cameras; give ({wanted})"
            f"{other.get(given, '')}"
        )
    grey, size = [], _size(rig)
    for name, image in zip(_NAMES, images, strict=False):
        converted = grey_image(image, f"{name} image")
        if converted.shape[::-1] != size:
            height, width = converted.shape
            raise FrameError(
                f"{name} image is {width}x{height}, the rig's are {size[0]}x{size[1]}; give images "
                "of that size, or the calibration of these"
            )
        grey.append(converted.copy())
    left, right, *top = grey
    inside = (right, left, *top)
    return rig.rectified(inside) if isinstance(rig, StereoRig) else inside


def _size(rig: CameraRig) -> tuple[int, int]:
    """Width and height of the images that are given."""
    return rig.image_size if isinstance(rig, StereoRig) else (rig.width, rig.height)


def checked_measurements(given: Iterable[Measured]) -> tuple[Measured, ...]:
    """Raises MeasurementLogError for other things, and for identities that are the cameras'."""
    measured = tuple(given)
    for one in measured:
        if not isinstance(one, Measured):
            raise MeasurementLogError(
                f"measurements: a {type(one).__name__}; give what model.measured(...) makes"
            )
        if len(one.ids) and one.ids.min() < Measured.FIRST_ID:
            raise MeasurementLogError(
                f"measurements: identity {one.ids.min()} of {one.kind} may be a camera's landmark; "
                "add fgslam.Measured.FIRST_ID"
            )
    return measured


def checked_odometry(
    given: Odometry | npt.ArrayLike | None, settings: OdometrySettings | MotionModel
) -> Odometry | None:
    """Motion of the body with covariance; a bare (4, 4) gets the noise of settings.

    Raises:
        OdometryError: it is not finite, of another shape, no rigid motion, or its covariance is
            not symmetric and positive semi-definite.
    """
    if given is None:
        return None
    if isinstance(given, Odometry):
        motion = _rigid(given.motion)
        return replace(given, motion=motion, covariance=_covariance(given.covariance))
    motion = _rigid(given)
    noise = settings if isinstance(settings, RecordedOdometrySettings) else None
    return Odometry(motion, pose_noise(motion, noise or RecordedOdometrySettings()))


def _numbers(given: npt.ArrayLike, what: str, shape: tuple[int, int]) -> FloatArray:
    try:
        array = np.array(given, np.float64)
    except (TypeError, ValueError):
        raise OdometryError(f"odometry: the {what} is no array of numbers; give {shape}") from None
    if array.shape != shape:
        raise OdometryError(f"odometry: the {what} has shape {array.shape}; give {shape}")
    if not np.isfinite(array).all():
        raise OdometryError(
            f"odometry: the {what} is not finite; give None where nothing was measured"
        )
    return array


def _rigid(given: npt.ArrayLike) -> FloatArray:
    motion = _numbers(given, "motion", (4, 4))
    if not is_rigid(motion):
        raise OdometryError(
            "odometry: the motion is no rigid motion; give the pose (4, 4) of the body now in its "
            "frame before: an orthonormal rotation, metres, and 0 0 0 1 below"
        )
    return motion


def _covariance(given: npt.ArrayLike) -> FloatArray:
    covariance = _numbers(given, "covariance", (6, 6))
    scale = float(np.abs(covariance).max())
    symmetric = np.allclose(covariance, covariance.T, rtol=0.0, atol=_SYMMETRY * scale)
    if not symmetric or np.linalg.eigvalsh(covariance).min() < -_SYMMETRY * scale:
        raise OdometryError(
            "odometry: the covariance is not symmetric and positive; give that of the tangent "
            "vector [rotation, translation], radians and metres"
        )
    return covariance


# ------------------------------------------------------------------------------------------
# Between a camera that delivers at its own pace and a session that takes what it can keep up with

BodyMotion: TypeAlias = Odometry | FloatArray | npt.ArrayLike | None
LiveFrame: TypeAlias = tuple[float, Images | None, BodyMotion]


class NewestFrame:
    """Holds one frame, the newest that has not been taken; safe between threads.

    ::

        frames = fgslam.NewestFrame()
        threading.Thread(target=read_camera, args=(frames,)).start()  # puts, then closes
        for t, images, odometry in frames:
            slam.track(t, images, odometry)
    """

    def __init__(self) -> None:
        self._changed = Condition()
        self._waiting: LiveFrame | None = None
        self._closed = False
        self._dropped = 0

    @property
    def dropped(self) -> int:
        """Frames that were replaced before they were taken."""
        return self._dropped

    def put(self, t: float, images: Images | None, odometry: BodyMotion = None) -> None:
        """Hands a frame over; never waits. Arguments as of :meth:`fgslam.Slam.track`.

        They are copied: a camera loop may fill the same arrays again.

        Raises:
            SessionError: closed already.
        """
        images, odometry = deepcopy((images, odometry))
        with self._changed:
            if self._closed:
                raise SessionError("the frames are closed; make a new NewestFrame")
            if self._waiting is not None:
                self._dropped += 1
                odometry = _joined(self._waiting[2], odometry)
            self._waiting = (t, images, odometry)
            self._changed.notify()

    def take(self, timeout: float | None = None) -> LiveFrame | None:
        """Waits for a frame and takes it; None after ``timeout`` seconds or :meth:`close`."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting is not None or self._closed, timeout)
            frame, self._waiting = self._waiting, None
            return frame

    def close(self) -> None:
        """No frame will come any more; one that waits can still be taken. May be called twice."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def __iter__(self) -> Iterator[LiveFrame]:
        """Frames as they come, until :meth:`close`."""
        while (frame := self.take()) is not None:
            yield frame


def _joined(first: BodyMotion, second: BodyMotion) -> BodyMotion:
    """Two motions as one: with covariance where both have one; None where one was not measured."""
    if first is None or second is None:
        return None
    if isinstance(first, Odometry) and isinstance(second, Odometry):
        return compose_odometry((first, second))
    return np.asarray(_motion(first) @ _motion(second))


def _motion(odometry: BodyMotion) -> FloatArray:
    return np.asarray(odometry.motion if isinstance(odometry, Odometry) else odometry, np.float64)
