"""A SLAM session: frames are pushed into it one by one, results may be asked for at any time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Self

import numpy.typing as npt

from fgslam.backend.protocol import Estimator
from fgslam.backend.settings import EstimatorSettings
from fgslam.cameras.rig import require_rig
from fgslam.core.arrays import FloatArray
from fgslam.core.checks import later_time, require_seed
from fgslam.core.errors import FrameError, SessionError
from fgslam.core.measurement_log import MeasurementLog
from fgslam.core.measurements import Odometry
from fgslam.core.recordings import Frame
from fgslam.core.sensors import CameraRig
from fgslam.core.threads import one_blas_thread
from fgslam.datasets.settings import OdometrySettings, RecordedOdometrySettings
from fgslam.frontend.settings import FrontendSettings
from fgslam.slam.arrival import Arrival
from fgslam.slam.factory import chosen_estimator, chosen_frontend, make_extractor, make_pipeline
from fgslam.slam.feature_stream import FeatureExtractor, FeatureFrame, FrameDescriber
from fgslam.slam.inputs import Images, checked_images, checked_odometry
from fgslam.slam.pipeline import FrameReport
from fgslam.slam.results import RunRecorder, SessionResult, Step, result_of


class Session:
    """Simultaneous localisation and mapping over stereo frames (Se, Lowe and Little 2001).

    Frames are handed in by :meth:`track`, which never needs the next one; :meth:`result` may be
    asked for at any time and changes nothing of what follows. Sessions are independent: several
    may run side by side in one process, each used by one thread at a time. A frame that is refused
    leaves the session as it was.

    The world is the right camera's first frame: x right, y down, z forward, metres.

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
        estimator: str | EstimatorSettings | Estimator = "isam2",
        *,
        frontend: FrontendSettings | Mapping[str, Any] | None = None,
        odometry: OdometrySettings | None = None,
        features: FeatureExtractor | None = None,
        seed: int = 0,
        arrival: Arrival | None = None,
    ) -> None:
        """Begins with an empty map, or where ``arrival`` says in a saved one.

        Args:
            rig: the rectified cameras, two or three.
            estimator: the kind (`odometry`, `landmark_kalman`, `landmark_kalman_graph`,
                `ekf`, `fixed_lag`, `isam2` or `batch`), settings of one, or an own object with the
                members of :class:`fgslam.backend.protocol.Estimator`.
            frontend: settings of features, matching and tracking; None for the defaults; a mapping
                for what differs from these: ``{"stereo": {"max_disparity_px": 80}}``.
            odometry: what predicts the motion. None: the odometry that is handed in, and constant
                velocity over frames without any. With `constant_velocity` what is handed in is
                ignored.
            features: an own extractor, from a grey image (height, width) uint8 to
                :class:`~fgslam.core.features.Features`; it is called from several threads. None
                for SIFT.
            seed: of everything random: samples of place recognition.
            arrival: where to begin in a saved map.

        Raises:
            CalibrationError: the rig is impossible.
            ConfigError: no such estimator, it cannot use what will be measured, the seed is
                negative, or a setting of the front-end is not known or not usable.
        """
        require_rig(rig)
        require_seed(seed, "session")
        frontend = chosen_frontend(frontend)
        odometry = odometry or RecordedOdometrySettings()
        self.rig = rig
        self.frontend = frontend
        self.numbering = (0, 1)
        self.pipeline = make_pipeline(
            rig, frontend, odometry, chosen_estimator(estimator), seed, arrival
        )
        self.recorder = RunRecorder(MeasurementLog(rig, self.pipeline.motion.description()))
        self._odometry = odometry
        self._describer = FrameDescriber(features or make_extractor(frontend))
        self._ended = ""
        self._failed = False

    # -- frames ------------------------------------------------------------------------------

    def track(
        self,
        t: float,
        images: Images | None,
        odometry: Odometry | FloatArray | npt.ArrayLike | None = None,
    ) -> Step:
        """Takes in the next frame; returns its pose and what was matched.

        Args:
            t: time stamp in seconds, later than the last frame's.
            images: (left, right) or (left, right, top), taken at the same moment and rectified, or
                raw where the rig was loaded with its rectification:
                (height, width) grey or (height, width, 3) red, green, blue; uint8, or uint16 of
                which the upper eight bits count; any memory layout. None where the cameras gave
                nothing: the frame is then placed by the odometry alone.
            odometry: motion of the robot's body since the last frame: a (4, 4) pose of the body now
                in its frame before, metres, with the noise of the odometry settings; or an
                :class:`Odometry` with its own covariance. None where none was measured: constant
                velocity. That of the first frame is ignored.

        Raises:
            FrameError: wrong number, size, type or shape of images, or the time does not increase.
            OdometryError: the odometry is not finite, of another shape, or no rigid motion.
            SessionError: the session is closed, or its estimator failed before.
            EstimatorError: the estimator failed in this frame; the session is then at its end,
                with :meth:`result` of the frames before.
        """
        self._require_open()
        i = len(self.recorder)
        timestamp = later_time(t, self._last_time(), "session", FrameError)
        body = checked_odometry(odometry, self._odometry) if i else None
        checked = None if images is None else checked_images(images, self.rig)
        frame = None if checked is None else Frame(i, timestamp, checked)
        with one_blas_thread():
            report = self.advance(self._describer.describe(i, frame), timestamp, body)
        return Step.of(report)

    def advance(
        self,
        found: FeatureFrame,
        timestamp: float,
        body: Odometry | None = None,
        index: int | None = None,
        wait_ms: float = 0.0,
        precision_of: Callable[[FrameReport], float] | None = None,
    ) -> FrameReport:
        """Takes in a frame whose features are known: what :meth:`track` does after finding them.

        Args:
            found: the frame and its features; ``found.i`` counts the session's frames.
            timestamp: seconds.
            body: odometry of the body, checked.
            index: number of the frame in its recording, for the log; None: by ``numbering``.
            wait_ms: time that the loop waited for this frame, for the record.
            precision_of: fraction of right stereo matches, where truth is known.
        """
        self._require_open()
        first, stride = self.numbering
        index = first + stride * found.i if index is None else index
        try:
            report = self.pipeline.process(found, index, timestamp, self._usable(body))
            precision = float("nan") if precision_of is None else precision_of(report)
            self.recorder.add(report, wait_ms, precision)
        except BaseException as error:
            # Parts of the frame may be booked: going on would estimate something else.
            self._failed = True
            self._ended = f"it failed at t = {timestamp:.6f} s ({' '.join(str(error).split())})"
            raise
        return report

    def __len__(self) -> int:
        """Frames so far."""
        return len(self.recorder)

    # -- results -----------------------------------------------------------------------------

    @property
    def log(self) -> MeasurementLog:
        """Measurements of all frames so far, which any estimator can replay."""
        return self.recorder.log

    def result(self) -> SessionResult:
        """Trajectory, covariances and map as known now; tracking may go on afterwards.

        Raises:
            SessionError: there is no frame yet.
        """
        if not len(self.recorder):
            raise SessionError("no frame has been tracked yet; call track first")
        with one_blas_thread():
            return result_of(self.pipeline, self.recorder, self._failed)

    def close(self) -> None:
        """Ends the session and its threads; results can still be asked for."""
        self._ended = self._ended or "it is closed"
        self._describer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    # ----------------------------------------------------------------------------------------

    def _require_open(self) -> None:
        if self._ended:
            raise SessionError(f"the session takes no more frames: {self._ended}; make a new one")

    def _last_time(self) -> float | None:
        increments = self.recorder.log.increments
        return increments[-1].timestamp if increments else None

    def _usable(self, body: Odometry | None) -> Odometry | None:
        return body if self.pipeline.motion.uses_odometry else None
