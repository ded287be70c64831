"""Writes the run folder from what a run has computed so far, and its summary as a table."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np

from fgslam.backend.self_calibration import SelfCalibration
from fgslam.cameras.calib_json import write_corrected
from fgslam.cameras.rectify import Rectifier
from fgslam.core.arrays import BoolArray, FloatArray, IntArray, thinned
from fgslam.core.correction import FIELD_PX, IMPLAUSIBLE_PX, term_names
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
from fgslam.core.sensors import CameraRig, moved_pixels
from fgslam.core.types import WHOLE_PX, LandmarkMap, StereoFeatures
from fgslam.datasets.ledger import Entry, as_values, rests_on_guess
from fgslam.datasets.settings import MeasurementDatasetSettings, RenderedLabSettings
from fgslam.evaluation.judging import closure_counts, predicted_poses
from fgslam.evaluation.statistics import EstimatorMetrics, JsonValue, align, associate
from fgslam.frontend.settings import FrontendSettings
from fgslam.frontend.tracking.landmarks import LandmarkDatabase
from fgslam.report.content import (
    Column,
    TextTable,
    metres,
    sentence,
    write_csv,
    write_metrics,
    write_timing,
)
from fgslam.report.overlays import draw_disparities, draw_features, draw_flow, draw_view
from fgslam.runs.config import Experiment, ExperimentConfig, parse
from fgslam.runs.engine import LocatedShare
from fgslam.runs.folder import CALIBRATION_FILE, CAMERA_FILE, LOG_FILE, METRICS_FILE
from fgslam.runs.opening import open_sequence
from fgslam.runs.report import (
    closures_of,
    estimator_metrics,
    frame_problems,
    frame_rows,
    located,
    place_numbers,
    run_numbers,
    write_closures,
)
from fgslam.runs.results import PICTURES, VIEW
from fgslam.runs.session import drives_of, map_points
from fgslam.runs.slam_comparison import GROUND_TRUTH_FILE, load_truth
from fgslam.runs.tables import (
    FRAMES_FILE,
    NOISE_TABLE,
    picture_title,
    write_estimate,
    write_frames,
    write_noise,
)
from fgslam.runs.tasks.slam_map_entry import GivenMap, GivenMemory
from fgslam.slam.build import calibrates_itself
from fgslam.slam.pipeline import FrameReport, SlamPipeline
from fgslam.slam.results import (
    STAGES,
    RunRecorder,
    located_frames,
    session_remarks,
)
from fgslam.slam.session import Session

# ------------------------------------------------------------------------------------------
# Ground truth by rendered depth (landmarks, disparities, views), and true poses in a saved map

_LEAST_SIGHTINGS = 3
_SAME_SURFACE = 0.03
"""Relative spread of the four depths around a pixel, and curvature of the inverse depth from pixel
to pixel, that one surface may have."""

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
    curvature = np.zeros_like(inverse)
    curvature[:, 1:-1] = np.abs(np.diff(inverse, 2, axis=1))
    curvature[1:-1] = np.maximum(curvature[1:-1], np.abs(np.diff(inverse, 2, axis=0)))
    jumps = ~(curvature <= _SAME_SURFACE * inverse)  # an unknown depth is no surface
    count = np.zeros((depth.shape[0] + 1, depth.shape[1] + 1), np.int64)
    count[1:, 1:] = jumps.cumsum(axis=0).cumsum(axis=1)
    column, row = np.rint(pixels).astype(np.int64).T
    # The first pixel that a patch reaches in the image, and that after the last.
    (left, right), (top, bottom) = (
        (np.clip(middle - WHOLE_PX, 0, size), np.clip(middle + WHOLE_PX + 1, 0, size))
        for middle, size in ((column, depth.shape[1]), (row, depth.shape[0]))
    )
    near = count[bottom, right] - count[top, right] - count[bottom, left] + count[top, left]
    return np.asarray(near > 0)


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
    sigma = []
    for k, median in zip(kept, medians, strict=True):  # as a distance, robustly from the scatter
        deviation = _NORMAL_MAD * np.median(np.abs(groups[k] - median), axis=0)
        error = _MEDIAN_TO_MEAN * np.linalg.norm(deviation) / np.sqrt(len(groups[k]))
        sigma.append(float(error))
    return LandmarkTruth(unique[kept], medians), np.array(sigma)


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


Sights: TypeAlias = Callable[[int, FloatArray], tuple[int, int]]
"""Landmarks in view of a true pose ``wTc`` in the selected frame ``i``; -1 where it is not known.

In all images, not too near and not too small for the rig, and not hidden; and how many of these are
seen from a direction from which they were seen before.
"""


def true_sights(
    saved: SavedMap, landmarks: LandmarkMap, sequence: ImageSequence, frontend: FrontendSettings
) -> Sights:
    """Counts the landmarks in view of true poses, by the database's own expectation.

    Of ``landmarks``, those of the map that count; of a recording without depth nothing.
    """
    rig, largest = sequence.rig, frontend.stereo.largest_disparity_px
    database = LandmarkDatabase(rig, frontend.database, largest)
    database.load(saved)

    def in_view(i: int, wTc: FloatArray) -> tuple[int, int]:
        if not isinstance(sequence, TrueDepth) or not np.isfinite(wTc).all():
            return -1, -1
        depth = sequence.depth(i)
        expected = database.expected(landmarks, wTc)
        column, row, disparity = expected.measurement.T
        rise = 0.0
        if rig.vertical_baseline is not None:
            rise = disparity * (rig.fy * rig.vertical_baseline) / (rig.fx * rig.baseline)
        inside = (column >= 0.0) & (column + disparity <= rig.width - 1.0)
        inside &= (row >= 0.0) & (row + rise <= rig.height - 1.0)
        at = np.rint(np.column_stack([row, column])[inside]).astype(np.int64)
        near = depth[at[:, 0], at[:, 1]]
        shown = rig.fx * rig.baseline / disparity[inside] <= _BEHIND * near + _BEHIND_M
        return int(shown.sum()), int((shown & expected.certain[inside]).sum())

    return in_view


_SAME_TIME_S = 1e-3
_MOST_SLACK_RAD = 0.5  # of positions whose errors are all made of it: at most, not likely


def truth_in_map(
    saved: SavedMap, sequence: ImageSequence, config: ExperimentConfig
) -> tuple[FloatArray, str]:
    """True poses in the map's world, as far as they can be known.

    Of rendered places exactly, since the map's world is where its first drive began. Of recordings
    on disk if the map's last drive was part of the same one: by the rigid motion (SE3, least
    squares over positions) that brings the truth of that drive to the map's own trajectory.

    Args:
        saved: the map.
        sequence: the recording.
        config: what it was opened with.

    Returns:
        (n, 4, 4) poses of the selected frames, NaN where unknown; and how the two worlds were
        brought together, in words.
    """
    unknown = np.full((len(sequence), 4, 4), np.nan)
    truth, drives = sequence.ground_truth, drives_of(saved) or [{}]
    if truth is None:
        return unknown, "the recording has no ground truth"
    if isinstance(config.dataset, RenderedLabSettings):
        own = _of_rendered(_drive_config(drives[0]), sequence, config)
        if own is None:
            return unknown, "the map is of another place, so errors are not known"
        return own, "truth in the world of the map's first frame, exactly"
    mapped = _drive_config(drives[-1])
    aligned = None if mapped is None else _of_recorded(saved, mapped, config)
    if aligned is None:
        return unknown, "the map is of another recording, so errors are not known"
    mTw, matched, slack = aligned
    if slack > _MOST_SLACK_RAD:
        why = "the map's drive is too straight to lay the truth onto it, so errors are not known"
        return unknown, why
    times, true_rows = associate(sequence.timestamps, truth.timestamps, _SAME_TIME_S)
    unknown[times] = mTw @ truth.poses[true_rows]
    return unknown, f"truth aligned to the map's trajectory, SE3 over {matched} poses"


def _drive_config(drive: Mapping[str, Any]) -> ExperimentConfig | None:
    """What a map's drive was opened with; None where this fgslam cannot tell."""
    settings = drive.get("settings")
    with suppress(FgslamError):
        if isinstance(settings, dict):
            return parse(ExperimentConfig, {"name": "map", **settings}, "map")
    return None


def _of_rendered(
    mapped: ExperimentConfig | None, sequence: ImageSequence, config: ExperimentConfig
) -> FloatArray | None:
    """Both worlds are camera poses in one room; None where they are not."""
    from fgslam.datasets.rendered import RenderedLabSequence, first_camera_pose  # scipy's, slow

    now, then = config.dataset, None if mapped is None else mapped.dataset
    if not isinstance(now, RenderedLabSettings) or not isinstance(then, RenderedLabSettings):
        return None
    if not isinstance(sequence, RenderedLabSequence) or now.place != then.place:
        return None
    own = sequence.room_from_world @ sequence.ground_truth.poses
    return np.asarray(inverse(first_camera_pose(then)) @ own)


def _of_recorded(
    saved: SavedMap, mapped: ExperimentConfig, config: ExperimentConfig
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
# What a run finds of its rig's calibration: calibration.csv, numbers, one sentence

_SURE_SIGMAS = 3.0  # a change of fewer of its own sigmas is not reported
_LEAST_FIELD_PX = 2.0 * FIELD_PX  # of a field that is reported; less is expected of any lens
_IMPLAUSIBLE = (
    ", more than calibrations leave: calibrate it again, unless something large that moved was "
    "taken for the scene"
)
_CHANGES = {
    "yaw_deg": "turned by {:.3f} degrees in yaw",
    "pitch_deg": "turned by {:.3f} degrees in pitch",
    "roll_deg": "turned by {:.3f} degrees in roll",
    "focal_percent": "longer by {:.3f} % in focal length",
}


def write_calibration(
    folder: Path, calibration: SelfCalibration, rectifier: Rectifier | None
) -> None:
    """camera.json and calibration.csv: the cameras, corrected, and what each window knew.

    ``rectifier`` is what rectified the images; the file then is of the raw cameras. Raises
    OutputError.
    """
    write_corrected(folder / CAMERA_FILE, calibration.found.applied, rectifier)
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
        "shake_px": calibration.shake_px,
        "changes": changes,
        "terms": terms,
    }


def calibration_note(calibration: SelfCalibration | None, knocked: bool = False) -> str:
    """What the drive showed of the calibration, in a sentence; empty where it showed nothing.

    ``knocked``: a turned camera is reported; then no calibration holds for the whole drive.
    """
    if calibration is None or not calibration.windows:
        return ""
    found, field, more = calibration.found, calibration.field_px, ""
    # What no term of a correction follows, where that is more than usual.
    if field >= _LEAST_FIELD_PX:
        more += (
            f"; {field:.2f} px (rms) of distortion in each image that no correction describes are "
            "left"
        )
    if found.probabilities["exact"] > 0.5:
        return "" if knocked else f"the drive agrees with the rig's calibration{more}"
    cameras = []
    for camera in ("left", "top"):
        changes = {  # those that stand out of their uncertainty, the surest first
            name.removeprefix(f"{camera}_"): (value, abs(value) / sigma)
            for name, (value, sigma) in found.estimated.changes().items()
            if name.startswith(camera) and abs(value) >= _SURE_SIGMAS * sigma
        }
        surest = sorted(changes.items(), key=lambda item: -item[1][1])
        words = [
            f"{_CHANGES[k].format(value)} ({sigmas:.0f} sigma)" for k, (value, sigmas) in surest
        ]
        cameras += [f"the {camera} camera is {', '.join(words)}"] * bool(words)
    rms = found.applied.rms_px()
    return (
        f"{'; '.join(cameras) or 'the lenses or axes of the cameras differ'} against the rig's "
        f"calibration, corrected during the drive by {rms:.2f} px (rms over the images)"
        f"{_IMPLAUSIBLE * (rms > IMPLAUSIBLE_PX)}{more}"
    )


def require_self_calibration(config: Experiment) -> None:
    """Refuses, before a run, to write the calibration that it will not find. Raises ConfigError."""
    slam = config if isinstance(config, ExperimentConfig) else None
    measured = slam is not None and isinstance(slam.dataset, MeasurementDatasetSettings)
    if slam is None or measured or not calibrates_itself(slam.frontend):
        raise ConfigError(
            "--camera-out: this run takes its cameras as calibrated; it needs images of two or "
            "three cameras, frontend.self_calibration true and stereo.measurement fused"
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
        notes: what is to be reported of the run, besides the recording's own.
        given: the map that it goes on with; None without one.
        memory: what earlier drives have shown of the rig; None where it does not remember.
    """

    folder: Path
    config: ExperimentConfig
    sequence: ImageSequence
    session: Session
    first_frame: int = 0
    notes: tuple[str, ...] = ()
    given: GivenMap | None = None
    memory: GivenMemory | None = None

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
    def located(self) -> LocatedShare:
        """Frames located in the map."""
        known, misplaced = self.pipeline.calibration, self.pipeline.witnesses.misplaced
        return located(self.recorder, self.pipeline.tracker.parts, known, misplaced)

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
        known, frame, rig = self.sequence.ground_truth, self.sequence.truth_frame, self.sequence.rig
        if known is not None:
            known.of(frame, rig).save(self.folder / GROUND_TRUTH_FILE)
        if status == "finished":
            landmarks = rendered_landmark_truth(self.sequence, self.recorder.log)
            if landmarks is not None:
                write_landmark_truth(self.folder / LANDMARK_TRUTH_FILE, *landmarks)
        # Read back: replays of the log are judged by the same digits.
        truth = load_truth(self.folder, self.recorder.log)
        online_path = self.recorder.online
        points = map_points(estimate.landmarks, self.pipeline.tracker.database)
        own = make_subfolder(self.folder, self.title)
        paths = online_path.of(frame, rig), estimate.of(frame, rig)
        write_estimate(own, *paths, points, self.remark)
        write_frames(own / FRAMES_FILE, online_path.timestamps, frame_rows(self.recorder))
        write_noise(own / NOISE_TABLE, online_path.timestamps, self.recorder.noise)
        metrics = estimator_metrics(estimate, truth, self.recorder)
        taken = () if self.pipeline.places is None else self.pipeline.places.taken
        more = {"kind": self.pipeline.estimator.kind} | dict(metrics.more) | closure_counts(taken)
        metrics = dataclasses.replace(metrics, more=more)
        self.write_metrics({self.title: metrics}, status)
        stamps, numbers = estimate.trajectory.timestamps, self.recorder.log.numbers
        frames = zip(numbers.tolist(), stamps.tolist(), self.recorder.stage_ms, strict=True)
        times = (
            (frame, stamp, stage, milliseconds)
            for frame, stamp, row in frames
            for stage, milliseconds in zip(STAGES, row.tolist(), strict=True)
            if not math.isnan(milliseconds)  # of a session before
        )
        write_timing(self.folder / "timing.csv", times)
        if self.pipeline.calibration is not None:
            rectifier = getattr(self.sequence, "rectifier", None)  # recordings of files have one
            write_calibration(self.folder, self.pipeline.calibration, rectifier)
        return metrics

    def write_metrics(self, estimators: Mapping[str, EstimatorMetrics], status: str) -> None:
        """metrics.json of the live estimator and of those that replayed its log."""
        about: dict[str, JsonValue] = {
            "name": self.config.name,
            "status": status,
            "frames_in_recording": self.frames,
            "odometry": self.config.odometry.kind,
            "located": {"frames": self.located.frames, "of": self.located.of},
            "landmarks_permanent": int(self.pipeline.tracker.database.permanent.sum()),
            "remark": self.remark or None,
            "notes": list(self.remarks()),
            "ledger": as_values(self.ledger),
            **run_numbers(self.recorder),
        }
        # Place recognition is asked for, or it joined parts of the map.
        taken = () if self.pipeline.places is None else self.pipeline.places.taken
        if self.config.frontend.loops or self.config.frontend.lost or taken:
            truth = load_truth(self.folder, self.recorder.log).of_camera().trajectory
            closures = closures_of(self.recorder, taken, truth)
            write_closures(self.folder, self.recorder, closures)
            about["places"] = place_numbers(self.recorder, closures)
        if self.pipeline.calibration is not None:
            about["rig"] = calibration_numbers(self.pipeline.calibration)
        write_metrics(self.folder / METRICS_FILE, len(self.recorder), estimators, about)

    @property
    def ledger(self) -> tuple[Entry, ...]:
        """What is taken to be so of a recording of files; of others nothing is."""
        return getattr(self.sequence, "ledger", ())

    def remarks(self) -> tuple[str, ...]:
        """Notes on the recording, its cameras and its first images."""
        return (
            *self.sequence.notes,
            *self.notes,
            *(() if self.memory is None else self.memory.notes(self.pipeline.calibration)),
            *map(sentence, session_remarks(self.pipeline, self.recorder)),
        )


_PROBLEMS_SHOWN = 5


def summary_table(outputs: RunOutputs, metrics: EstimatorMetrics) -> TextTable:
    """The numbers of the live estimator; a table of names and values without headings."""
    recorder, more = outputs.recorder, metrics.more
    numbers: dict[str, Any] = run_numbers(recorder)
    elsewhere = int(located_frames(recorder).sum()) - outputs.located.frames
    matches, nees = numbers["landmark_matches"], more.get("nees_pose")
    bias, start = more.get("gyroscope_bias_dps"), more.get("end_against_start")
    end = "unknown"
    if metrics.end_error_m is not None and len(recorder) > 1:
        end = f"{metres(metrics.end_error_m)}, {_number('{:.3f} deg', metrics.end_error_deg)}"

    def poses(count: object) -> str:
        return f", {count} poses" if count else ""

    rpe = f"{metres(metrics.rpe_trans_m)}, {_number('{:.3f} deg', metrics.rpe_rot_deg)}"
    rows = {
        "frames": f"{len(recorder)} of {outputs.frames}",
        "located in the map": f"{outputs.located}" + f", {elsewhere} elsewhere" * (elsewhere > 0),
        "pose found from": ", ".join(f"{k} {n}" for k, n in numbers["status_counts"].items()),
        "landmarks": str(metrics.landmarks),
        "landmarks matched, median (5 %)": "none"
        if matches is None
        else f"{matches['median']:.0f} ({matches['p05']:.0f})",
        "ATE rms, SE3 aligned": f"{metres(metrics.ate_rmse_m)}{poses(more.get('matched_poses'))}",
        "RPE a frame": f"{rpe}{poses(more.get('matched_poses'))}",
        "end error, first pose aligned": f"{end}{poses(more.get('judged_poses'))}",
        "end against start": "unknown",
        "drift": _number("{:.2f} %", metrics.drift_percent),
        "pose NEES per dof": "unknown",
        "loop without SIFT, median": _number("{:.1f} ms", numbers["loop_ms"]["median"]),
    }
    if isinstance(start, dict) and len(recorder) > 1:
        # Adding zero turns -0.00 into 0.00.
        known = {name: round(value, 2) + 0.0 for name, value in start.items()}
        rows["end against start"] = (
            "{}, {}, {}\nyaw {yaw_deg:.2f}, pitch {pitch_deg:.2f}, roll {roll_deg:.2f} deg".format(
                *(metres(known[f"{axis}_cm"] / 100.0) for axis in "xyz"), **known
            )
        )
    if isinstance(nees, dict):
        band = f"(band {nees['lower']:.2f}-{nees['upper']:.2f}){poses(nees['items'])}"
        rows["pose NEES per dof"] = f"{nees['per_dof']:.1f}: {nees['verdict']} {band}"
    if isinstance(bias, dict):
        pairs = zip(bias["rates"], bias["sigmas"], strict=True)
        words = ", ".join(f"{rate:.3f} +- {sigma:.3f}" for rate, sigma in pairs)
        rows["gyroscope bias, x y z"] = f"{words} deg/s"
    guessed = [entry for entry in outputs.ledger if entry.guessed]
    on_guess = [rests_on_guess(text, guessed) for text in rows.values()]
    if any(on_guess):
        rows = {name + " *" * mark: text
                for (name, text), mark in zip(rows.items(), on_guess, strict=True)}  # fmt: skip
        why = (f"{e.what}: {e.value}{f' ({e.option})' * bool(e.option)}" for e in guessed)
        rows["* rests on a guess"] = "\n".join(why)
    remark = f"\n{outputs.remark}" if outputs.remark else ""
    heading = f"{outputs.config.name}: {outputs.title}{remark}"
    cells = tuple((name, (value,)) for name, value in rows.items())
    return TextTable("summary", heading, "", (Column("", "of the run"),), cells)


def _number(text: str, value: float | None) -> str:
    return "unknown" if value is None else text.format(value)


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
    if why := metrics.more.get("truth_remark"):
        lines.append(str(why))
    if not metrics.landmarks:
        lines.append(
            "there is no landmark in the map; fgslam inspect states what the recording's fault is"
        )
    return tuple(lines)


_VIEWS = 24


def frames_to_show(count: int) -> frozenset[int]:
    """Which of ``count`` frames are drawn: the first, the middle, and those of the views."""
    return frozenset({0, count // 2, *thinned(count, _VIEWS).tolist()})


def draw_frame(outputs: RunOutputs, i: int, report: FrameReport) -> None:
    """Pictures of the sequence's frame ``i``, one of those that are drawn.

    Views of frames evenly spread; features (Fig. 1) of the first; disparities (Fig. 2) and flow
    (Fig. 3) of the middle one.
    """
    if report.found.frame is None:
        return
    count = len(outputs.sequence)
    folder = make_subfolder(outputs.folder, PICTURES)
    images = report.found.frame.images
    if i in thinned(count, _VIEWS):
        draw_view(folder / f"{VIEW}_{len(outputs.recorder) - 1:06d}.jpg", images[0])
    if i not in (0, count // 2):
        return
    predicted = predicted_poses(outputs.recorder.column("status").tolist())  # so far
    what = f"{outputs.config.name}: frame {report.increment.index}"
    title = picture_title(what, int(predicted.sum()), bool(outputs.remark))
    if len(outputs.recorder.log) == 1 and report.found.features:
        draw_features(folder / f"features_{i:06d}.png", images, report.found.features, title)
    if len(outputs.recorder.log) > 1:
        pixels = report.stereo.pixels
        draw_disparities(folder / f"disparities_{i:06d}.png", images[0], pixels, title)
        before, after = moved_pixels(*outputs.recorder.log.increments[-2:])
        draw_flow(folder / f"flow_{i:06d}.png", images[0], before, after, title)
