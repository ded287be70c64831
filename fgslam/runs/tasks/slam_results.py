"""Writes the run folder from what a run has computed so far, and says it in a table."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from fgslam.backend.self_calibration import SelfCalibration
from fgslam.cameras.calib_json import write_corrected
from fgslam.cameras.rectify import Rectifier
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.correction import IMPLAUSIBLE_PX, RigCorrection, term_names
from fgslam.core.errors import ConfigError, FgslamError, OutputError
from fgslam.core.files import make_subfolder, read_text, write_text
from fgslam.core.geometry import inverse, transform_to_world
from fgslam.core.log import (
    LANDMARK_TRUTH_FILE,
    ImageSequence,
    LandmarkTruth,
    MeasurementLog,
    write_landmark_truth,
)
from fgslam.core.saved_map import SavedMap
from fgslam.core.sensors import CameraRig, moved_pixels, vertical_of
from fgslam.core.types import WHOLE_PX, Estimate, LandmarkMap, StereoFeatures, Trajectory
from fgslam.datasets.settings import MeasurementDatasetSettings, RenderedLabSettings
from fgslam.evaluation.judging import Truth, closure_counts, predicted_poses
from fgslam.evaluation.statistics import EstimatorMetrics, JsonValue, align, associate
from fgslam.frontend.settings import FrontendSettings
from fgslam.frontend.tracking.landmarks import LandmarkDatabase
from fgslam.report.content import (
    Column,
    StageTime,
    TextTable,
    write_csv,
    write_metrics,
    write_timing,
)
from fgslam.report.results import ReportData, judged_report, truth_in_their_world
from fgslam.runs.config import Experiment, ExperimentConfig, parse
from fgslam.runs.folder import CALIBRATION_FILE, CAMERA_FILE, LOG_FILE
from fgslam.runs.opening import open_sequence
from fgslam.runs.report import (
    closures_of,
    estimator_metrics,
    frame_problems,
    located,
    place_numbers,
    run_numbers,
    write_closures,
)
from fgslam.runs.session import map_points
from fgslam.runs.slam_comparison import GROUND_TRUTH_FILE, load_truth
from fgslam.runs.tables import NOISE_TABLE, picture_title, write_estimate, write_noise
from fgslam.runs.tasks.slam_map_entry import GivenMap
from fgslam.slam.build import calibrates_itself
from fgslam.slam.pipeline import FrameReport, SlamPipeline
from fgslam.slam.results import (
    STAGES,
    RunRecorder,
    camera_remarks,
    in_first_map,
    part_remarks,
    stereo_remarks,
)
from fgslam.slam.session import Session

# ------------------------------------------------------------------------------------------
# Ground truth by rendered depth (landmarks, disparities, views), and true poses in a saved map

_LEAST_SIGHTINGS = 3
_SAME_SURFACE = 0.03
"""Relative spread of the four depths around a pixel, and bend of the inverse depth from pixel to
pixel, that one surface may have."""

_NORMAL_MAD = 1.4826  # median absolute deviation to standard deviation, normal distribution
_MEDIAN_TO_MEAN = 1.2533  # standard error of a median over that of the mean


@runtime_checkable
class TrueDepth(Protocol):
    """A recording whose exact depth is known."""

    def depth(self, i: int) -> FloatArray:
        """Depth (height, width) of the reference image of frame ``i``, metres."""
        ...


def rendered_landmark_truth(
    sequence: ImageSequence, log: MeasurementLog
) -> tuple[LandmarkTruth, FloatArray] | None:
    """Where the landmarks truly are: the median of the world points under their pixels.

    Each sighting that the run did not reject gives the point where the ray of its pixel meets the
    rendered surface. The truth has an error of its own: a feature's pixel is known to a fraction
    of a pixel only, and at a curved or slanted surface the blob that is matched is no point.
    Where patches show two surfaces, one behind the other, there is no true point at all: their
    contrast may be of either. A landmark is left out where most of its known points are such.

    Args:
        sequence: the recording; frame k is the log's.
        log: the run's measurements.

    Returns:
        Positions in the world of the ground truth, and the standard error (n,) of each in metres,
        from the scatter of its sightings; landmarks with fewer than three are left out, too. None
        where the recording knows no depth.
    """
    truth = sequence.ground_truth
    if not isinstance(sequence, TrueDepth) or truth is None:
        return None
    ids: list[IntArray] = [np.empty(0, np.int64)]
    points: list[FloatArray] = [np.empty((0, 3))]
    split: list[BoolArray] = [np.empty(0, np.bool_)]
    for k, increment in enumerate(log):
        seen = increment.kept
        if not len(seen):
            continue
        depth, pixels = sequence.depth(k), seen.measurement[:, :2]
        local, known = points_under(sequence.rig, depth, pixels)
        ids.append(seen.ids[known])
        points.append(transform_to_world(truth.poses[k], local[known]))
        split.append(at_edges(depth, pixels[known]))
    return medians_of(np.concatenate(ids), np.concatenate(points), np.concatenate(split))


def points_under(
    rig: CameraRig, depth: FloatArray, pixels: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Points (n, 3) of the camera's frame under sub-pixel places (n, 2), and which are known.

    The inverse depth is interpolated, which is exact on a plane; at an edge of depth, where the
    four pixels around do not belong to one surface, the point is not known (NaN).
    """
    low = np.floor(pixels).astype(np.int64)
    height, width = depth.shape
    inside = np.all((low >= 0) & (low < [width - 1, height - 1]), axis=1)
    column, row = np.where(inside[:, None], low, 0).T
    around = np.stack([depth[row + dr, column + dc] for dr in (0, 1) for dc in (0, 1)], axis=1)
    spread = around.max(axis=1) - around.min(axis=1)
    # False where a depth is not known.
    known = np.asarray(inside & (spread <= _SAME_SURFACE * around.min(axis=1)))
    right, below = (pixels - low).T
    weights = np.stack(
        [(1 - below) * (1 - right), (1 - below) * right, below * (1 - right), below * right], axis=1
    )
    z = np.full(len(pixels), np.nan)
    z[known] = 1.0 / (weights[known] / around[known]).sum(axis=1)
    x, y = (pixels[:, 0] - rig.cx) / rig.fx, (pixels[:, 1] - rig.cy) / rig.fy
    return np.column_stack([x * z, y * z, z]), known


def at_edges(depth: FloatArray, pixels: FloatArray) -> BoolArray:
    """Which places (n, 2) in a depth image (h, w) have an edge of depth within a patch's reach.

    On a plane the inverse depth is linear in the image; at a jump its second difference is large.
    """
    inverse = 1.0 / depth
    bend = np.zeros_like(inverse)
    bend[:, 1:-1] = np.abs(np.diff(inverse, 2, axis=1))
    bend[1:-1] = np.maximum(bend[1:-1], np.abs(np.diff(inverse, 2, axis=0)))
    jumps = ~(bend <= _SAME_SURFACE * inverse)  # an unknown depth is no surface
    count = np.zeros((depth.shape[0] + 1, depth.shape[1] + 1), np.int64)
    count[1:, 1:] = jumps.cumsum(axis=0).cumsum(axis=1)
    column, row = np.rint(pixels).astype(np.int64).T
    left, right = _within(column, depth.shape[1])
    top, bottom = _within(row, depth.shape[0])
    near = count[bottom, right] - count[top, right] - count[bottom, left] + count[top, left]
    return np.asarray(near > 0)


def _within(middle: IntArray, size: int) -> tuple[IntArray, IntArray]:
    """The first pixel that a patch reaches in an image of this size, and that after the last."""
    low = np.clip(middle - WHOLE_PX, 0, size)
    return low, np.clip(middle + WHOLE_PX + 1, 0, size)


def medians_of(
    ids: IntArray, points: FloatArray, split: BoolArray
) -> tuple[LandmarkTruth, FloatArray]:
    """Median and its standard error of each landmark's points, those seen often enough.

    ``split`` (n,) are the sightings at edges of depth.
    """
    order = np.argsort(ids, kind="stable")
    unique, start, times = np.unique(ids[order], return_index=True, return_counts=True)
    groups = np.split(points[order], start[1:])
    edges = np.add.reduceat(split[order].astype(np.int64), start) if len(start) else start
    kept = np.flatnonzero((times >= _LEAST_SIGHTINGS) & (2 * edges <= times)).tolist()
    medians = np.array([np.median(groups[k], axis=0) for k in kept]).reshape(-1, 3)
    sigma = [_standard_error(groups[k], median) for k, median in zip(kept, medians, strict=True)]
    return LandmarkTruth(unique[kept], medians), np.array(sigma)


def _standard_error(points: FloatArray, median: FloatArray) -> float:
    """Of the median of points (n, 3), as a distance, robustly from their scatter."""
    deviation = _NORMAL_MAD * np.median(np.abs(points - median), axis=0)
    return float(_MEDIAN_TO_MEAN * np.linalg.norm(deviation) / np.sqrt(len(points)))


_PRECISION_EVERY = 10  # frames between checks of stereo matches against rendered depth
_PRECISION_PX = 1.5  # disparity error of a correct match; a SIFT match's noise is a tenth of it


def stereo_precision(sequence: ImageSequence, i: int, stereo: StereoFeatures) -> float:
    """Fraction of stereo matches with the rendered disparity; NaN but of every tenth frame.

    The nearest of the four pixels around a feature decides: at an edge of depth either side is
    right.
    """
    if i % _PRECISION_EVERY or not isinstance(sequence, TrueDepth) or not len(stereo):
        return float("nan")
    depth = sequence.depth(i)
    height, width = depth.shape
    low = np.floor(stereo.measurement[:, :2]).astype(np.int64)
    columns = np.clip(low[:, 0, None] + [0, 1, 0, 1], 0, width - 1)
    rows = np.clip(low[:, 1, None] + [0, 0, 1, 1], 0, height - 1)
    rig = sequence.rig
    true = rig.fx * rig.baseline / depth[rows, columns]
    error = np.abs(true - stereo.measurement[:, 2:]).min(axis=1)
    return float(np.mean(error <= _PRECISION_PX))


_BEHIND = 1.05  # times the rendered depth, plus the next: what is farther off is hidden
_BEHIND_M = 0.05


@dataclass(frozen=True, slots=True)
class Sighted:
    """How many landmarks are truly in view of a pose; -1 where that is not known.

    Attributes:
        visible: in all images, not too near and not too small for the rig, and not hidden.
        familiar: of these, seen from a direction from which they were seen before.
    """

    visible: int = -1
    familiar: int = -1


class TrueSights:
    """Counts the landmarks in view of true poses, by the database's own expectation."""

    def __init__(
        self,
        saved: SavedMap,
        landmarks: LandmarkMap,
        sequence: ImageSequence,
        frontend: FrontendSettings,
    ) -> None:
        """Of ``landmarks``, those of the map that count; of a recording without depth nothing."""
        self._sequence = sequence if isinstance(sequence, TrueDepth) else None
        self._landmarks = landmarks
        self._rig = sequence.rig
        self._database: LandmarkDatabase | None = None
        if self._sequence is not None:
            largest = frontend.stereo.largest_disparity_px
            self._database = LandmarkDatabase(sequence.rig, frontend.database, largest)
            self._database.load(saved)

    def of(self, i: int, wTc: FloatArray) -> Sighted:
        """In the selected frame ``i``, whose true pose in the map's world is ``wTc``."""
        if self._sequence is None or self._database is None or not np.isfinite(wTc).all():
            return Sighted()
        rig, depth = self._rig, self._sequence.depth(i)
        expected = self._database.expected(self._landmarks, wTc)
        column, row, disparity = expected.measurement.T
        rise = 0.0
        if rig.vertical_baseline is not None:
            rise = disparity * (rig.fy * rig.vertical_baseline) / (rig.fx * rig.baseline)
        inside = (column >= 0.0) & (column + disparity <= rig.width - 1.0)
        inside &= (row >= 0.0) & (row + rise <= rig.height - 1.0)
        at = np.rint(np.column_stack([row, column])[inside]).astype(np.int64)
        near = depth[at[:, 0], at[:, 1]]
        shown = rig.fx * rig.baseline / disparity[inside] <= _BEHIND * near + _BEHIND_M
        familiar = shown & expected.certain[inside]
        return Sighted(int(shown.sum()), int(familiar.sum()))


_SAME_TIME_S = 1e-3
_MOST_SLACK_RAD = 0.5  # of positions whose errors are all made of it: at most, not likely


@dataclass(frozen=True, slots=True, eq=False)
class TruthInMap:
    """True poses of a recording's frames in the map's world.

    Attributes:
        poses: (n, 4, 4) of the selected frames; NaN where unknown.
        alignment: how the two worlds were brought together, in words.
    """

    poses: FloatArray
    alignment: str


def truth_in_map(saved: SavedMap, sequence: ImageSequence, config: ExperimentConfig) -> TruthInMap:
    """True poses in the map's world, as far as they can be known.

    Of rendered places exactly, since the map's world is where its first drive began. Of recordings
    on disk if the map's last drive was part of the same one: by the rigid motion (SE3, least
    squares over positions) that brings the truth of that drive to the map's own trajectory.

    Args:
        saved: the map.
        sequence: the recording.
        config: what it was opened with.
    """
    unknown = np.full((len(sequence), 4, 4), np.nan)
    if sequence.ground_truth is None:
        return TruthInMap(unknown, "the recording has no ground truth")
    drives = saved.about.get("drives") or [{}]
    if isinstance(config.dataset, RenderedLabSettings):
        return _of_rendered(_drive_config(drives[0]), sequence, config) or TruthInMap(
            unknown, "the map is of another place, so errors are not known"
        )
    mapped = _drive_config(drives[-1])
    aligned = None if mapped is None else _of_recorded(saved, mapped, sequence, config)
    if aligned is None:
        return TruthInMap(unknown, "the map is of another recording, so errors are not known")
    mTw, matched, slack = aligned
    if slack > _MOST_SLACK_RAD:
        words = "the map's drive is too straight to lay the truth onto it, so errors are not known"
        return TruthInMap(unknown, words)
    times, true_rows = associate(
        sequence.timestamps, sequence.ground_truth.timestamps, _SAME_TIME_S
    )
    unknown[times] = mTw @ sequence.ground_truth.poses[true_rows]
    words = f"truth aligned to the map's trajectory, SE3 over {matched} poses"
    return TruthInMap(unknown, words)


def _drive_config(drive: object) -> ExperimentConfig | None:
    """What a map's drive was opened with; None where this fgslam cannot tell."""
    if not isinstance(drive, dict) or not isinstance(drive.get("settings"), dict):
        return None
    try:
        values = {"name": "map", **drive["settings"]}
        return parse(ExperimentConfig, values, "map")
    except FgslamError:
        return None


def _of_rendered(
    mapped: ExperimentConfig | None, sequence: ImageSequence, config: ExperimentConfig
) -> TruthInMap | None:
    """Both worlds are camera poses in one room."""
    from fgslam.datasets.rendered import RenderedLabSequence, first_camera_pose  # scipy's, slow

    now, then = config.dataset, None if mapped is None else mapped.dataset
    if not isinstance(now, RenderedLabSettings) or not isinstance(then, RenderedLabSettings):
        return None
    if not isinstance(sequence, RenderedLabSequence) or now.place != then.place:
        return None
    own = sequence.room_from_world @ sequence.ground_truth.poses
    words = "truth in the world of the map's first frame, exactly"
    return TruthInMap(inverse(first_camera_pose(then)) @ own, words)


def _of_recorded(
    saved: SavedMap, mapped: ExperimentConfig, sequence: ImageSequence, config: ExperimentConfig
) -> tuple[FloatArray, int, float] | None:
    """(4, 4) from the truth's world to the map's, how many poses it was found from, its slack."""
    now, then = (getattr(one.dataset, "path", None) for one in (config, mapped))
    if now is None or then is None or Path(now).resolve() != Path(then).resolve():
        return None
    try:
        truth = open_sequence(mapped).ground_truth
    except FgslamError:
        return None
    if truth is None:
        return None
    rows, true_rows = associate(saved.trajectory.timestamps, truth.timestamps, _SAME_TIME_S)
    true, own = truth.poses[true_rows], saved.trajectory.poses[rows]
    mTw = align(true, own)
    if mTw is None:
        return None
    return mTw, len(rows), alignment_slack(transform_to_world(mTw, true[:, :3, 3]), own[:, :3, 3])


def alignment_slack(aligned: FloatArray, own: FloatArray) -> float:
    """By how much aligned positions (n, 3) may yet turn about the line that they lie along.

    Radians: what is left between them and ``own`` (n, 3), over how far they stray from that line;
    infinite where they do not. Of a straight drive's positions no alignment knows the roll.
    """
    spread = np.linalg.svd(own - own.mean(axis=0), compute_uv=False)[1]
    left = np.linalg.norm(aligned - own)
    return float(left / spread) if spread > 0.0 else np.inf


# ------------------------------------------------------------------------------------------
# What a run says of its rig's calibration: calibration.csv, numbers, one sentence

_TOLD_SIGMAS = 3.0  # what is less than this many of its own is not told as a finding
_TOLD_FIELD_PX = 0.1  # of a field that is told: recordings of good rigs show up to so much
_DOUBT = (
    ", more than calibrations leave: calibrate it anew, unless something large that moved was "
    "taken for the scene"
)
_UNITS = {"deg": "degrees", "percent": "%"}
_WORDS = {
    "yaw_deg": "turned by {} in yaw",
    "pitch_deg": "turned by {} in pitch",
    "roll_deg": "turned by {} in roll",
    "focal_percent": "longer by {} in focal length",
}


def write_calibration(
    folder: Path, calibration: SelfCalibration, rectifier: Rectifier | None
) -> None:
    """camera.json and calibration.csv: the cameras, corrected, and what each window knew.

    ``rectifier`` is what rectified the images; the file then is of the raw cameras. Raises
    OutputError.
    """
    write_corrected(folder / CAMERA_FILE, calibration.found.best, rectifier)
    known = calibration.found.estimated
    terms = term_names(known.rig)
    changes = list(known.changes())
    columns = ["timestamp", "knocks"]
    columns += [f"{name}{part}" for name in changes for part in ("", "_sigma")]
    columns += [f"{name}{part}" for name in terms for part in ("", "_sigma", "_applied")]
    rows: list[list[str | int | float]] = []
    for step in calibration.steps:
        then = replace(known, values=step.values, covariance=step.covariance)
        of_terms = np.column_stack([step.values, then.sigmas, step.applied])
        pairs = [number for pair in then.changes().values() for number in pair]
        stamp = f"{step.timestamp:.9f}"  # of an epoch has more digits than a table's numbers
        rows.append([stamp, step.knocks, *pairs, *of_terms.ravel().tolist()])
    write_csv(folder / CALIBRATION_FILE, columns, rows)


def calibration_numbers(calibration: SelfCalibration) -> dict[str, JsonValue]:
    """The rig's part of metrics.json."""
    found = calibration.found
    known = found.estimated
    changes: dict[str, JsonValue] = {
        name: {"value": value, "sigma": sigma} for name, (value, sigma) in known.changes().items()
    }
    terms: dict[str, JsonValue] = {
        name: {"value": float(value), "sigma": float(sigma), "applied": float(applied)}
        for name, value, sigma, applied in zip(
            term_names(known.rig), known.values, known.sigmas, found.applied.values, strict=True
        )
    }
    return {
        "windows": calibration.windows,
        "knocks": calibration.knocks,
        "probability_exact": found.probabilities["exact"],
        "chi_square": known.significance(),
        "degrees_of_freedom": len(known.values),
        "displacement_rms_px": found.applied.rms_px(),
        "field_px": calibration.field_px,
        "changes": changes,
        "terms": terms,
    }


def calibration_note(calibration: SelfCalibration | None, knocked: bool = False) -> str:
    """What the drive showed of the calibration, in a sentence; empty where it showed nothing.

    ``knocked``: a turned camera is reported; then no calibration holds for the whole drive.
    """
    if calibration is None or not calibration.windows:
        return ""
    found = calibration.found
    knocks = f"; the rig moved {calibration.knocks} times on the way" * bool(calibration.knocks)
    if found.probabilities["exact"] > 0.5:
        if knocked:
            return ""
        return f"the drive agrees with the rig's calibration{knocks}{_field(calibration)}"
    parts = [text for camera in ("left", "top") if (text := _told(found.estimated, camera))]
    rms = found.applied.rms_px()
    what = "; ".join(parts) or "the cameras' lenses or axes differ"
    return (
        f"{what} against the rig's calibration, corrected during the drive by {rms:.2f} px "
        f"(rms over the images){_DOUBT * (rms > IMPLAUSIBLE_PX)}{knocks}{_field(calibration)}"
    )


def _field(calibration: SelfCalibration) -> str:
    """What no term of a correction follows, where that is more than usual."""
    px = calibration.field_px
    left = f"; {px:.2f} px (rms) of distortion in each image that no correction describes are left"
    return left * (px >= _TOLD_FIELD_PX)


def _told(known: RigCorrection, camera: str) -> str:
    """One camera's changes that stand out of their uncertainty, the surest first."""
    changes = {
        name.removeprefix(f"{camera}_"): pair
        for name, pair in known.changes().items()
        if name.startswith(camera)
    }
    sure = sorted(changes, key=lambda name: -abs(changes[name][0]) / changes[name][1])
    told = []
    for name in sure:
        value, sigma = changes[name]
        if abs(value) >= _TOLD_SIGMAS * sigma:
            unit = _UNITS[name.rsplit("_", 1)[1]]
            size = f"{value:.3f} {unit}"
            told.append(f"{_WORDS[name].format(size)} ({abs(value) / sigma:.0f} sigma)")
    return f"the {camera} camera is {', '.join(told)}" if told else ""


def require_self_calibration(config: Experiment) -> None:
    """Refuses, before a run, to write the calibration that it will not find. Raises ConfigError."""
    slam = config if isinstance(config, ExperimentConfig) else None
    measured = slam is not None and isinstance(slam.dataset, MeasurementDatasetSettings)
    if slam is None or measured or not calibrates_itself(slam.frontend):
        raise ConfigError(
            "--camera-out: this run takes its cameras as calibrated; it needs SLAM on images with "
            "frontend.self_calibration true and stereo.measurement fused"
        )


def corrected_camera(run: Path, path: Path) -> str:
    """Copies the run's corrected calibration to ``path``; a line about it. Raises OutputError."""
    text = read_text(run / CAMERA_FILE, OutputError)
    write_text(path, text)
    return f"camera      {path}: the calibration, corrected; use it by --camera {path}"


@dataclass(frozen=True, slots=True, eq=False)
class RunOutputs:
    """The run folder of one run.

    Attributes:
        first_frame: number in the recording of the sequence's frame 0.
        notes: what is to be said of the run, besides the recording's own.
        given: the map that it goes on with; None without one.
    """

    folder: Path
    config: ExperimentConfig
    sequence: ImageSequence
    session: Session
    first_frame: int = 0
    notes: tuple[str, ...] = ()
    given: GivenMap | None = None

    @property
    def pipeline(self) -> SlamPipeline:
        """The session's parts."""
        return self.session.pipeline

    @property
    def recorder(self) -> RunRecorder:
        """The session's record of every frame."""
        return self.session.recorder

    @property
    def frames(self) -> int:
        """Frames of the recording, with those before the first that began a map."""
        return self.recorder.left_out + len(self.sequence)

    @property
    def title(self) -> str:
        """The live estimator's label or kind, which names its folder."""
        return self.config.estimator.title

    @property
    def remark(self) -> str:
        """Marks results whose odometry was made from ground truth; empty otherwise."""
        return self.config.remark

    def write_results(self, status: str) -> EstimatorMetrics:
        """Log, trajectories, covariances, map, metrics and timing of the frames so far."""
        estimate = self.pipeline.estimate()
        self.recorder.log.save(self.folder / LOG_FILE)
        truth = self._write_truth(with_landmarks=status == "finished")
        self._write_estimate(estimate)
        metrics = self._with_kind(estimator_metrics(estimate, truth, self.recorder))
        self.write_metrics({self.title: metrics}, status)
        self._write_timing(estimate.trajectory)
        if self.pipeline.calibration is not None:
            rectifier = getattr(self.sequence, "rectifier", None)  # recordings of files have one
            write_calibration(self.folder, self.pipeline.calibration, rectifier)
        return metrics

    def write_metrics(self, estimators: Mapping[str, EstimatorMetrics], status: str) -> None:
        """metrics.json of the live estimator and of those that replayed its log."""
        about = self._about(status) | run_numbers(self.recorder)
        if self._looks_for_places:
            truth = load_truth(self.folder, self.recorder.log).trajectory
            closures = closures_of(self.recorder, self._taken, truth)
            write_closures(self.folder, self.recorder, closures)
            about["places"] = place_numbers(self.recorder, closures)
        if self.pipeline.calibration is not None:
            about["rig"] = calibration_numbers(self.pipeline.calibration)
        write_metrics(self.folder / "metrics.json", len(self.recorder), estimators, about)

    @property
    def _taken(self) -> tuple[bool, ...]:
        """Of all closures offered, whether the estimator took them."""
        return () if self.pipeline.places is None else self.pipeline.places.taken

    @property
    def _looks_for_places(self) -> bool:
        """Whether the configuration asks for place recognition, or it joined parts of the map."""
        frontend = self.config.frontend
        return frontend.loops or frontend.lost or bool(self._taken)

    def _with_kind(self, metrics: EstimatorMetrics) -> EstimatorMetrics:
        closures = closure_counts(self._taken)
        more = {"kind": self.pipeline.estimator.kind} | dict(metrics.more) | closures
        return dataclasses.replace(metrics, more=more)

    def _write_truth(self, with_landmarks: bool) -> Truth:
        """True path, and true landmarks where the recording is rendered and ``with_landmarks``.

        What is returned is read back: replays of the log are judged by the same digits.
        """
        if self.sequence.ground_truth is not None:
            self.sequence.ground_truth.save(self.folder / GROUND_TRUTH_FILE)
        found = (
            rendered_landmark_truth(self.sequence, self.recorder.log) if with_landmarks else None
        )
        if found is not None:
            write_landmark_truth(self.folder / LANDMARK_TRUTH_FILE, *found)
        return load_truth(self.folder, self.recorder.log)

    def _write_estimate(self, estimate: Estimate) -> None:
        folder = make_subfolder(self.folder, self.title)
        online = Trajectory(
            estimate.trajectory.timestamps, np.array(self.recorder.online_poses).reshape(-1, 4, 4)
        )
        points = map_points(estimate.landmarks, self.pipeline.tracker.database)
        write_estimate(folder, online, estimate, points, self.remark)
        write_noise(folder / NOISE_TABLE, online.timestamps, self.recorder.noise)

    def _write_timing(self, trajectory: Trajectory) -> None:
        indices = self.recorder.log.numbers.tolist()
        write_timing(
            self.folder / "timing.csv",
            [
                StageTime(frame, timestamp, stage, milliseconds)
                for frame, timestamp, row in zip(
                    indices,
                    trajectory.timestamps.tolist(),
                    np.array(self.recorder.stage_ms).tolist(),
                    strict=True,
                )
                for stage, milliseconds in zip(STAGES, row, strict=True)
                if not math.isnan(milliseconds)  # of a session before
            ],
        )

    def remarks(self) -> tuple[str, ...]:
        """Notes on the recording, its cameras and its first images."""
        of_cameras = camera_remarks(self.recorder, self.pipeline.watch)
        of_images = stereo_remarks(self.recorder)
        of_parts = part_remarks(self.recorder, self.pipeline.tracker.parts)
        of_run = (*self.sequence.notes, *self.notes, *self._unlocated(), *of_parts)
        return (*of_run, *of_cameras, *of_images, *self.pipeline.tracker.other_motion.remarks())

    def _unlocated(self) -> tuple[str, ...]:
        found = located(self.recorder)
        if found.enough:
            return ()
        return (f"only {found} were located by landmarks; the rest of the path is predicted",)

    def _about(self, status: str) -> dict[str, JsonValue]:
        return {
            "name": self.config.name,
            "status": status,
            "frames_in_recording": self.frames,
            "odometry": self.config.odometry.kind,
            "located_in_first_map": in_first_map(self.recorder, self.pipeline.tracker.parts),
            "landmarks_permanent": int(self.pipeline.tracker.database.permanent.sum()),
            "remark": self.remark or None,
            "notes": list(self.remarks()),
        }


_PROBLEMS_SHOWN = 5


def summary_table(outputs: RunOutputs, metrics: EstimatorMetrics) -> TextTable:
    """The numbers of the live estimator; a table of names and values without headings."""
    numbers = run_numbers(outputs.recorder)
    remark = f"\n{outputs.remark}" if outputs.remark else ""
    matches = numbers["landmark_matches"]
    rows: list[tuple[str, object]] = [
        ("frames", f"{len(outputs.recorder)} of {outputs.frames}"),
        ("located by landmarks", _located(outputs)),
        ("pose found from", _counts(numbers["status_counts"])),
        ("landmarks", metrics.landmarks),
        ("landmarks matched, median (5 %)", _spread(matches)),
        ("ATE rms, SE3 aligned", _metres(metrics.ate_rmse_m)),
        ("RPE a frame", f"{_metres(metrics.rpe_trans_m)}, {_degrees(metrics.rpe_rot_deg)}"),
        ("end error, first pose aligned", _end(outputs, metrics)),
        ("end against start", _start(outputs, metrics)),
        ("drift", "unknown" if metrics.drift_percent is None else f"{metrics.drift_percent:.2f} %"),
        ("pose NEES per dof", _nees(metrics)),
        ("loop without SIFT, median", _milliseconds(numbers["loop_ms"])),
        *_gyroscope(metrics.more.get("gyroscope_bias_dps")),
    ]
    heading = f"{outputs.config.name}: {outputs.title}{remark}"
    cells = tuple((name, (str(value),)) for name, value in rows)
    return TextTable("summary", heading, "", (Column("", "of the run"),), cells)


def _gyroscope(bias: object) -> list[tuple[str, object]]:
    """Its bias in degrees/s; nothing where none was estimated."""
    if not isinstance(bias, dict):
        return []
    pairs = zip(bias["rates"], bias["sigmas"], strict=True)
    words = ", ".join(f"{rate:.3f} +- {sigma:.3f}" for rate, sigma in pairs)
    return [("gyroscope bias, x y z", f"{words} deg/s")]


def _located(outputs: RunOutputs) -> str:
    share = located(outputs.recorder)
    first = in_first_map(outputs.recorder, outputs.pipeline.tracker.parts)
    return str(share) + (f", {first} in the first map" if first < share.frames else "")


def run_notes(outputs: RunOutputs, metrics: EstimatorMetrics) -> tuple[str, ...]:
    """What was tolerated: notes on the recording, and frames that could not be used."""
    problems = frame_problems(outputs.recorder)
    lines = [*outputs.remarks()]
    lines += problems[:_PROBLEMS_SHOWN]
    if len(problems) > _PROBLEMS_SHOWN:
        lines.append(f"and {len(problems) - _PROBLEMS_SHOWN} more such frames, see metrics.json")
    watch = outputs.pipeline.watch
    knocked = watch is not None and watch.knocked
    if note := calibration_note(outputs.pipeline.calibration, knocked):
        lines.append(note)
    if not metrics.landmarks:
        lines.append(
            "there is no landmark in the map; fgslam inspect says what is wrong with the recording"
        )
    return tuple(lines)


def _metres(value: float | None) -> str:
    if value is None:
        return "unknown"
    return f"{100.0 * value:.2f} cm" if value < 1.0 else f"{value:.3f} m"


def _degrees(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3f} deg"


def _counts(counts: object) -> str:
    if not isinstance(counts, dict):
        return "unknown"
    return ", ".join(f"{name} {count}" for name, count in counts.items())


def _spread(spread: object) -> str:
    if not isinstance(spread, dict):
        return "none"
    return f"{spread['median']:.0f} ({spread['p05']:.0f})"


def _milliseconds(times: object) -> str:
    known = isinstance(times, dict) and times["median"] is not None
    return f"{times['median']:.1f} ms" if known and isinstance(times, dict) else "unknown"


def _end(outputs: RunOutputs, metrics: EstimatorMetrics) -> str:
    if metrics.end_error_m is None or len(outputs.recorder) < 2:
        return "unknown"
    return f"{_metres(metrics.end_error_m)}, {_degrees(metrics.end_error_deg)}"


def _start(outputs: RunOutputs, metrics: EstimatorMetrics) -> str:
    end = metrics.more.get("end_against_start")
    if not isinstance(end, dict) or len(outputs.recorder) < 2:
        return "unknown"
    # Adding zero turns -0.00 into 0.00.
    x, y, z = (f"{round(end[name], 2) + 0.0:.2f}" for name in ("x_cm", "y_cm", "z_cm"))
    yaw, pitch, roll = (
        f"{round(end[name], 2) + 0.0:.2f}" for name in ("yaw_deg", "pitch_deg", "roll_deg")
    )
    return f"{x}, {y}, {z} cm\nyaw {yaw}, pitch {pitch}, roll {roll} deg"


def _nees(metrics: EstimatorMetrics) -> str:
    found = metrics.more.get("nees_pose")
    if not isinstance(found, dict):
        return "unknown"
    band = f"{found['lower']:.2f}-{found['upper']:.2f}"
    return f"{found['per_dof']:.1f}: {found['verdict']} (band {band})"


FOLDER = "pictures"
SHOWN = (0.0, 60 / 249, 120 / 249, 180 / 249)
"""Frames shown, as parts of the run: those of the paper's Figure 4."""


def frames_to_show(count: int) -> frozenset[int]:
    """Which of ``count`` frames are drawn; the second is among them for the first flow."""
    return frozenset({round(part * count) for part in SHOWN} | {1}) & frozenset(range(count))


def draw_frame(outputs: RunOutputs, i: int, report: FrameReport) -> None:
    """Features (Fig. 1), disparities (Fig. 2) and flow from the frame before (Fig. 3)."""
    if report.found.frame is None:
        return
    from fgslam.report.pictures import draw_disparities, draw_features, draw_flow

    folder = make_subfolder(outputs.folder, FOLDER)
    images = report.found.frame.images
    title = _title(outputs, f"frame {report.increment.index}")
    if report.found.features:
        draw_features(folder / f"features_{i:06d}.png", images, report.found.features, title)
    draw_disparities(folder / f"disparities_{i:06d}.png", images[0], report.stereo.pixels, title)
    if len(outputs.recorder.log) > 1:
        before, after = moved_pixels(*outputs.recorder.log.increments[-2:])
        draw_flow(folder / f"flow_{i:06d}.png", images[0], before, after, title)


@dataclass(frozen=True, slots=True, eq=False)
class RunFigures:
    """What the pictures of a whole run are drawn from.

    Attributes:
        name: of the run, for titles.
        synthetic: whether its odometry was made from ground truth, which every title says.
        estimate: of the estimator drawn.
        truth: true poses, or None.
        valid: (n,) which landmarks of the estimate were seen often enough (Se et al. 6.1).
        frames: (m,) the recording's numbers of the frames.
        predicted: (m,) poses that no landmark measured, which every title counts.
        matched, inliers, landmarks: (m,) counts of each frame.
        up: (3,) the vertical in the first camera's frame.
    """

    name: str
    synthetic: bool
    estimate: Estimate
    truth: Trajectory | None
    valid: BoolArray
    frames: IntArray
    predicted: BoolArray
    matched: IntArray
    inliers: IntArray
    landmarks: IntArray
    up: FloatArray

    def title(self, what: str) -> str:
        """Title of one picture."""
        return picture_title(f"{self.name}: {what}", int(self.predicted.sum()), self.synthetic)


def figures_of(outputs: RunOutputs) -> RunFigures:
    """A live run's figures."""
    # Once for all pictures: a smoother's estimate may take long.
    estimate = outputs.pipeline.estimate()
    database, recorder = outputs.pipeline.tracker.database, outputs.recorder
    return RunFigures(
        name=outputs.config.name,
        synthetic=bool(outputs.remark),
        estimate=estimate,
        truth=outputs.sequence.ground_truth,
        valid=database.valid[database.rows(estimate.landmarks.ids)],
        frames=recorder.log.numbers,
        predicted=predicted_poses(recorder.column("status").tolist()),
        matched=recorder.column("matched"),
        inliers=recorder.column("inliers"),
        landmarks=recorder.column("landmarks"),
        up=vertical_of(outputs.sequence.rig.bTc),
    )


def draw_run(run: Path, figures: RunFigures) -> list[Path]:
    """Map from above (Fig. 5), in perspective (Fig. 6), errors and matches over time."""
    from fgslam.report import figures as drawn  # Plotly and Matplotlib take a second
    from fgslam.report.pictures import draw_figure, draw_views

    folder = make_subfolder(run, FOLDER)
    results = _results(figures)
    kind = "valid landmarks" if figures.valid.any() else "landmarks"
    what = figures.title(f"{len(results.estimators[0].landmarks):,} {kind}")
    above = drawn.drive_from_above(results, drawn.ON_PAPER)
    draw_figure(folder / "map_from_above.png", above, what, {drawn.LANDMARK_ELLIPSES})
    views = drawn.map_to_turn(results, drawn.ON_PAPER)
    draw_views(folder / "map_views.png", views, what)
    # The first frame has no landmarks to match.
    counts = (figures.frames, figures.matched, figures.inliers, figures.landmarks)
    matches = drawn.matches_over_time(*(values[1:] for values in counts))
    draw_figure(folder / "matches.png", matches, figures.title("landmark matches"))
    if results.truth is not None:
        title = figures.title("position error, first pose aligned")
        draw_figure(folder / "position_error.png", drawn.error_by_axis(results), title)
    return sorted(folder.glob("*.png"))


def _results(figures: RunFigures) -> ReportData:
    """Valid landmarks only (6.1), as in the paper's Figure 6; all while the run is too short."""
    estimate, valid = figures.estimate, figures.valid
    if valid.any():
        estimate = replace(estimate, landmarks=estimate.landmarks.select(valid))
    report = judged_report("estimate", "", estimate, None, figures.truth)
    if len(figures.predicted):
        report = replace(report, predicted=figures.predicted)
    truth = truth_in_their_world((report,), figures.truth)
    return ReportData(
        title=figures.name, subtitle="", estimators=(report,), truth=truth, up=figures.up
    )


def _title(outputs: RunOutputs, what: str) -> str:
    """Title of a frame's picture, with the poses predicted so far."""
    predicted = predicted_poses(outputs.recorder.column("status").tolist())
    return picture_title(
        f"{outputs.config.name}: {what}", int(predicted.sum()), bool(outputs.remark)
    )
