"""What a session keeps of every frame, and what it gives back: steps, and the whole result."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fgslam.backend.protocol import Estimator
from fgslam.backend.self_calibration import WeighedCorrection
from fgslam.core.arrays import BoolArray, Brief, FloatArray, IntArray
from fgslam.core.errors import ConfigError, FgslamError
from fgslam.core.log import MeasurementLog
from fgslam.core.sensors import Observations
from fgslam.core.store import Kept
from fgslam.core.types import (
    NO_LANDMARKS,
    EgoMotionStatus,
    Estimate,
    Outcome,
    Remark,
    StereoFeatures,
    Trajectory,
)
from fgslam.frontend.tracking.landmarks import MapParts
from fgslam.slam.bridging import bridged_frames
from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.pipeline import FrameNoise, FrameReport, SlamPipeline

if TYPE_CHECKING:
    from fgslam.backend.smoothers.graph import FactorGraph

STAGES = (
    "load",
    "sift",
    "wait",
    "watch",
    "predict",
    "stereo",
    "track",
    "places",
    "update",
    "calibrate",
)
"""Per frame: `load` and `sift` run in threads next to the loop, `wait` is what they held it up."""


class FrameRow(NamedTuple):
    """Numbers of one frame; NaN where unknown."""

    status: str
    features: int
    stereo: int
    matched: int
    inliers: int
    landmarks: int
    mean_residual_px: float
    nis: float
    nis_dof: int
    stereo_precision: float
    problem: str
    refused: bool = False
    """An image of it was: the problem is a camera's, not a file's."""


@dataclass(slots=True, eq=False)
class RunRecorder:
    """Record of all frames, besides the estimator's result.

    Attributes:
        left_out: frames before the first one, which saw too little to begin a map.
        most_stereo: stereo matches of the frame that has the most.
    """

    log: MeasurementLog
    rows: Kept[list[FrameRow]] = field(default_factory=list)
    tracked_poses: Kept[list[FloatArray]] = field(default_factory=list)
    online_poses: Kept[list[FloatArray]] = field(default_factory=list)
    online_covariances: Kept[list[FloatArray]] = field(default_factory=list)
    stage_ms: Kept[list[FloatArray]] = field(default_factory=list)
    frame_digests: Kept[list[int]] = field(default_factory=list)
    noise: Kept[list[FrameNoise]] = field(default_factory=list)
    left_out: int = 0
    most_stereo: Kept[int] = field(default=0, init=False)

    def __len__(self) -> int:
        return len(self.rows)

    def add(self, report: FrameReport, wait_ms: float, stereo_precision: float) -> None:
        """Appends one frame."""
        waited = {"load": report.found.load_ms, "sift": report.found.sift_ms, "wait": wait_ms}
        stages = dict.fromkeys(STAGES, 0.0) | report.stage_ms
        times = stages | waited
        row = _row(report, stereo_precision)
        self.log.append(report.increment)  # may write to disk, and fail
        self.stage_ms.append(np.array([times[stage] for stage in STAGES]))
        self.tracked_poses.append(report.tracking.wTc)
        self.online_poses.append(report.stats.wTc)
        self.online_covariances.append(report.stats.covariance)
        frame = report.found.frame
        self.frame_digests.append(0 if frame is None else frame.digest())
        self.rows.append(row)
        self.noise.append(report.noise)
        self.most_stereo = max(self.most_stereo, row.stereo)

    @property
    def online(self) -> Trajectory:
        """Each pose as it was first estimated, at its own time."""
        poses = np.array(self.online_poses).reshape(-1, 4, 4)
        return Trajectory(self.log.timestamps, poses)

    @property
    def seen(self) -> IntArray:
        """(f,) digests of the frames with images, ascending."""
        return np.unique(np.array([d for d in self.frame_digests if d], np.int64))

    def column(self, name: str) -> npt.NDArray[Any]:
        """One number of all frames."""
        return np.array([getattr(row, name) for row in self.rows])

    def known_times(self) -> FloatArray:
        """(n, stages) milliseconds, without the frames of a session before: NaN there."""
        times = np.array(self.stage_ms).reshape(-1, len(STAGES))
        return times[np.isfinite(times).all(axis=1)]


def _row(report: FrameReport, stereo_precision: float) -> FrameRow:
    tracking = report.tracking
    used = tracking.residuals[tracking.inliers]
    return FrameRow(
        status=tracking.status.value,
        features=len(report.found.features[0]) if report.found.features else 0,
        stereo=len(report.stereo),
        matched=len(tracking.inliers),
        inliers=int(tracking.inliers.sum()),
        landmarks=report.stats.landmarks,
        mean_residual_px=float(used.mean()) if len(used) else float("nan"),
        nis=report.stats.nis,
        nis_dof=report.stats.nis_dof,
        stereo_precision=stereo_precision,
        problem=report.found.problem,
        refused=report.found.refused,
    )


ESTIMATOR_FAULTS = (
    FgslamError,
    RuntimeError,
    ValueError,
    ArithmeticError,
    LookupError,
    MemoryError,
)
"""What an estimator may end with: its own errors, GTSAM's (RuntimeError), NumPy's (ValueError)."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Step(Brief):
    """Pose of one tracked frame, and what was matched in it.

    Attributes:
        index: number of the frame in the session, from 0, and from 0 again where the session begins
            again; -1 of one that was not located in the map that the session is to begin in.
        timestamp: seconds.
        wTc: (4, 4) pose of the right camera in the world, metres.
        covariance: (6, 6) of it, [rotation, translation], radians and metres, in the tangent space
            at ``wTc``: ``T = wTc * Exp(xi)``.
        status: how the pose was found: `first`, `ok`, `capped`, `relocalised`, `contradicted` (by
            images that odometry contradicts, and nothing decides between them), `one_image` (by
            that of one camera, the others' being of no use); or, by odometry alone,
            `too_few_matches`, `diverged`, `no_image`, `camera_fault`; or not at all,
            `not_located` in the map that the session is to begin in: pose and covariance are NaN.
        matches: the k landmarks of the map that the frame sees again: ids (k,), (column, row,
            disparity) (k, 3) in pixels with covariance, raw pixels (k, 3, 2) in right, left, top.
        inliers: (k,) which of the matches agree with the pose.
        new: landmarks that the frame adds to the map, in the same form.
        landmarks: number of landmarks in the map now.
        closed: for each loop closure offered by this frame, whether the estimator took it.
    """

    index: int
    timestamp: float
    wTc: FloatArray
    covariance: FloatArray
    status: EgoMotionStatus
    matches: Observations
    inliers: BoolArray
    new: Observations
    landmarks: int
    closed: tuple[bool, ...]

    @staticmethod
    def not_located(timestamp: float, landmarks: int) -> Step:
        """Step of a frame that was not located in the map that its session is to begin in."""
        none = StereoFeatures.empty().observations(
            np.empty(0, np.int64), np.empty(0, np.int64), is_new=False
        )
        return Step(
            index=-1,
            timestamp=timestamp,
            wTc=np.full((4, 4), np.nan),
            covariance=np.full((6, 6), np.nan),
            status=EgoMotionStatus.NOT_LOCATED,
            matches=none,
            inliers=np.empty(0, np.bool_),
            new=none,
            landmarks=landmarks,
            closed=(),
        )

    @staticmethod
    def of(report: FrameReport) -> Step:
        """Step of a frame's report."""
        increment, stats = report.increment, report.stats
        seen = increment.observations
        return Step(
            index=report.found.i,
            timestamp=increment.timestamp,
            wTc=np.array(stats.wTc),
            covariance=np.array(stats.covariance),
            status=report.tracking.status,
            matches=seen.select(~seen.is_new),
            inliers=~increment.rejected[~seen.is_new],
            new=seen.select(seen.is_new),
            landmarks=stats.landmarks,
            closed=stats.closed,
        )


class Answered(Outcome):
    """The parts that results of sessions and of replays share."""

    __slots__ = ()
    estimator: Estimator | None

    @property
    def trajectory(self) -> Trajectory:
        """All poses ``wTc`` of the right camera as known now, n of them."""
        return self.estimate.trajectory

    @property
    def covariances(self) -> FloatArray:
        """(n, 6, 6) of the poses, as in :class:`Step`; NaN where one cannot be had."""
        return self.estimate.covariances

    def graph(self) -> FactorGraph:
        """The estimator's factor graph of all frames so far, at its solution.

        Raises:
            ConfigError: it keeps no whole graph.
        """
        made = getattr(self.estimator, "graph", None)
        if made is None:
            raise ConfigError(
                f"estimator: {getattr(self.estimator, 'kind', None)} keeps no whole graph; use "
                "batch, isam2 or sliding_window"
            )
        found: FactorGraph = made()
        return found


@dataclass(frozen=True, slots=True, eq=False, repr=False, kw_only=True)
class SessionResult(Answered):
    """Everything that a session knows at one moment.

    Attributes:
        frames: the record of every frame, by name of the column.
        notes: remarks on frames, cameras and images, and on frames left out.
        rig: what the drive shows of the rig's calibration: estimated, with its covariance, and
            applied; None where the calibration is taken as it is stated.
        estimator: of whom all this is known.
    """

    frames: dict[str, npt.NDArray[Any]]
    notes: tuple[Remark | str, ...]
    rig: WeighedCorrection | None
    estimator: Estimator | None = field(repr=False)

    @property
    def remarks(self) -> tuple[Remark | str, ...]:
        """Remarks on the images, and on what the estimator left out or had to repair."""
        return (*self.notes, *self.estimate.remarks)

    def column(self, name: str) -> npt.NDArray[Any]:
        """(n,) one number of every frame: `status`, `matched`, `inliers`, `nis`, `update_ms`...

        With them the :class:`~fgslam.slam.pipeline.FrameNoise` of each.
        `connected` is False where a gap that nothing bridges lies between the first frame and it.
        """
        return self.frames[name]


def result_of(
    pipeline: SlamPipeline, recorder: RunRecorder, notes: tuple[Remark, ...], failed: bool
) -> SessionResult:
    """The result of the frames so far; nothing is changed.

    Where the estimator ``failed`` in the frame after them, it may have taken in a part of that
    frame, and may have no answer any more.
    """
    online = recorder.online
    covariances = np.array(recorder.online_covariances).reshape(-1, 6, 6)
    if failed:
        estimate, _ = estimate_of_failed(pipeline.estimator, online, covariances)
        unknown = np.setdiff1d(estimate.landmarks.ids, pipeline.tracker.database.ids)
        estimate = replace(estimate, landmarks=estimate.landmarks.without(unknown))
    else:
        estimate = pipeline.estimate()
    return SessionResult(
        kind=pipeline.estimator.kind,
        estimate=estimate,
        online=online,
        online_covariances=covariances,
        closed=() if pipeline.places is None else tuple(pipeline.places.taken),
        frames=_columns(recorder)
        | {"connected": connected_frames(recorder, pipeline.tracker.parts)},
        notes=notes,
        rig=None if pipeline.calibration is None else pipeline.calibration.found,
        estimator=pipeline.estimator,
    )


def estimate_of_failed(
    estimator: Estimator, online: Trajectory, covariances: FloatArray
) -> tuple[Estimate, str]:
    """The estimate of the frames that went well; without one the online poses, and the reason.

    Args:
        estimator: it may hold a part of one more frame.
        online: the n poses as they were first estimated.
        covariances: (n, 6, 6) of them.
    """
    n = len(online)
    try:
        found = estimator.estimate()
        if not np.isfinite(found.trajectory.poses[:n]).all():
            raise ValueError("a pose of the final trajectory is not finite")
        if not np.isfinite(found.landmarks.positions).all():
            raise ValueError("a landmark of the final map is not finite")
    except ESTIMATOR_FAULTS as error:
        remark = ("the final trajectory is the online one: no final estimate could be had",)
        return Estimate(
            online, covariances, NO_LANDMARKS, remark
        ), f"no final estimate: {reason(error)}"
    poses = Trajectory(found.trajectory.timestamps[:n], found.trajectory.poses[:n])
    relative = {lag: one[: max(n - lag, 0)] for lag, one in found.relative.items()}
    covariances = found.covariances[:n]
    return replace(found, trajectory=poses, covariances=covariances, relative=relative), ""


def reason(error: BaseException) -> str:
    """An error in one line; GTSAM's messages have several."""
    text = " ".join(str(error).split())
    if isinstance(error, FgslamError):
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def _columns(recorder: RunRecorder) -> dict[str, npt.NDArray[Any]]:
    times = np.array(recorder.stage_ms).reshape(-1, len(STAGES))
    stage = {name: times[:, k] for k, name in enumerate(STAGES)}
    columns = {name: recorder.column(name) for name in recorder.rows[0]._fields}
    columns |= dict(zip(FrameNoise._fields, np.array(recorder.noise).T, strict=True))
    return columns | {
        "update_ms": stage["predict"] + stage["update"],
        "solve_ms": stage["track"],
    }


# ------------------------------------------------------------------------------------------
# Remarks on images that stereo matching cannot use: swapped cameras, darkness, 12-bit values

_FRAMES = 10  # judged: what is wrong with cables, drivers or calibration is wrong from the start
_FEWEST = 3  # frames: one or two may show a blank wall
_LEAST_MATCHED = 0.02
"""Of the right image's features, share that finds its partner. Of swapped images only what agrees
by chance does, under 0.01 (rendered lab with three cameras, kitti06); of sound ones a third and
more (those two, the light field, the drone, the suburb). Of two swapped cameras up to 0.13 agree
in the lab, 0.07 in euroc_v101: those the camera watch finds."""
_DARK = 15
"""Largest grey value of a dark image, of 255: 12-bit values reach 4095, of which the upper eight of
16 bits are 15."""


class FirstImages:
    """What the first images of a session were like."""

    def __init__(self) -> None:
        """No image yet."""
        self._frames = 0
        self._left: list[int] = []  # features, where they were sought
        self._spread = np.zeros((0, 2))  # standard deviations of grey values, right and left
        self._brightest = 0
        self._uint16 = False

    def add(self, found: FeatureFrame, uint16: bool) -> None:
        """Counts a frame with features; ``uint16``: they were given so."""
        if (whole := found.whole) is None or not found.features or self._frames >= _FRAMES:
            return
        self._frames += 1
        self._left += [len(own) for own in found.features[1:2]]
        spread = [float(image.std()) for image in whole.images[:2]]
        self._spread = np.vstack([self._spread, spread])
        self._brightest = max(self._brightest, *(int(image.max()) for image in whole.images))
        self._uint16 |= uint16

    def left(self) -> str:
        """What the left images have: features, or contrast; empty where there was no image."""
        if self._left or not self._frames:
            return f"{np.mean(self._left):.0f} in the left image" if self._left else ""
        right, left = self._spread.mean(axis=0)
        return f"grey values vary by {right:.0f} in the right image, by {left:.0f} in the left one"

    def lost_bits(self) -> str:
        """That bits were given which are not used; empty where none were."""
        if not self._frames or self._brightest > _DARK or not self._uint16:
            return ""
        return (
            f"of uint16 the upper eight bits count, and they reach {self._brightest} of 255: "
            "shift 12-bit values to 16 bits (image << 4)"
        )

    def fault(self) -> str:
        """What is wrong with the grey values: bits lost, or darkness; empty where nothing is."""
        if not self._frames or self._brightest > _DARK:
            return ""
        dark = f"the images are dark, their largest grey value is {self._brightest} of 255"
        return self.lost_bits() or dark


def any_uint16(images: Sequence[npt.ArrayLike]) -> bool:
    """True if one of the images is an array of 16 bits a value."""
    return any(getattr(image, "dtype", None) == np.uint16 for image in images)


def _image_remarks(recorder: RunRecorder, seen: FirstImages) -> Iterator[Remark]:
    """Whether the first frames, or later ones, have next to no stereo match; or lost bits."""
    rows = [row for row in recorder.rows if not row.problem][:_FRAMES]
    features, matched = sum(row.features for row in rows), sum(row.stereo for row in rows)
    if len(rows) < _FEWEST:
        return
    if matched > _LEAST_MATCHED * features:
        if seen.lost_bits():
            yield Remark("lost_bits", values={"fault": seen.lost_bits()})
        pairs = zip(recorder.log.numbers.tolist(), recorder.rows, strict=True)
        lost = [
            (number, row)
            for number, row in pairs
            if not (row.problem or EgoMotionStatus(row.status).measured)
            and row.stereo <= _LEAST_MATCHED * row.features
        ]
        if len(lost) >= _FEWEST:
            numbers, lacking = zip(*lost, strict=True)
            n, features = len(lost), sum(row.features for row in lacking)
            values = {"features": features / n, "matched": sum(row.stereo for row in lacking) / n}
            yield Remark("pairs_unmatched", numbers, values)
        return
    n, values = len(rows), dict[str, float | str]()
    values |= {"count": n, "features": features / n, "matched": matched / n}
    if seen.fault():
        yield Remark("no_matches_fault", values=values | {"fault": seen.fault()})
        return
    left = f" ({seen.left()})" if seen.left() else ""
    code = "no_matches" if features else "no_features"
    yield Remark(code, values=values | {"left": left})


# ------------------------------------------------------------------------------------------
# Remarks on frames that a guess alone places relative to the rest


def located_frames(recorder: RunRecorder) -> BoolArray:
    """(n,) frames that landmarks gave a pose; the first one, which the world is, among them."""
    statuses = [EgoMotionStatus(status) for status in recorder.column("status").tolist()]
    return np.array([one.measured or one is EgoMotionStatus.FIRST for one in statuses], np.bool_)


def connected_frames(recorder: RunRecorder, parts: MapParts) -> BoolArray:
    """(n,) frames that measurements tie to the first one; of a frame that failed, nothing."""
    return parts.connected[: len(recorder)]


def in_first_map(recorder: RunRecorder, parts: MapParts) -> BoolArray:
    """(n,) frames that are located in what measurements connect with the first one."""
    return located_frames(recorder) & connected_frames(recorder, parts)


def session_remarks(
    pipeline: SlamPipeline, recorder: RunRecorder, seen: FirstImages | None = None
) -> tuple[Remark, ...]:
    """On frames, cameras and images of a drive; ``seen``: its first images, where known."""
    watch = pipeline.watch
    return (
        *part_remarks(recorder, pipeline.tracker.parts),
        *camera_remarks(recorder),
        *(() if watch is None else watch.remarks()),
        *_image_remarks(recorder, seen or FirstImages()),
        *pipeline.witnesses.remarks(),
        *(() if pipeline.calibration is None else pipeline.calibration.remarks()),
        *pipeline.tracker.other_motion.remarks(),
    )


def camera_remarks(recorder: RunRecorder) -> tuple[Remark, ...]:
    """One for each fault of a camera, with the frames that are not used for it."""
    frames: dict[tuple[str, str], list[int]] = {}
    for number, row in zip(recorder.log.numbers.tolist(), recorder.rows, strict=True):
        if row.refused:
            frames.setdefault((row.status, row.problem), []).append(number)
    return tuple(
        Remark(
            "cameras_swapped" if "swapped" in fault else status,
            tuple(which),
            {"fault": fault, "all": len(recorder)},
        )
        for (status, fault), which in frames.items()
    )


def part_remarks(recorder: RunRecorder, parts: MapParts) -> tuple[Remark, ...]:
    """On frames that nothing measured, or that lie in parts of their own."""
    out, numbers, n = [], recorder.log.numbers, len(recorder)
    bridged = bridged_frames(parts)
    bridged = bridged[bridged < n]
    if len(bridged):  # final poses may be interpolated
        out.append(Remark("bridged", tuple(numbers[bridged].tolist())))
    apart = located_frames(recorder) & ~connected_frames(recorder, parts)
    if apart.any():
        known = int(in_first_map(recorder, parts).sum())
        values = {"known": known, "all": n, "percent": 100.0 * known / n}
        out.append(Remark("unconnected", tuple(numbers[apart].tolist()), values))
    return tuple(out)
