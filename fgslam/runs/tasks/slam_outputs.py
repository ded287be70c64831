"""Writes the run folder from what a run has computed so far, and says it in a table."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.estimates import Estimate, Trajectory
from fgslam.core.files import make_subfolder
from fgslam.core.measurements import moved_pixels
from fgslam.core.recordings import LANDMARK_TRUTH_FILE, Sequence, write_landmark_truth
from fgslam.core.sensors import vertical_of
from fgslam.evaluation.judging import Truth, closure_counts, predicted_poses
from fgslam.evaluation.statistics import EstimatorMetrics, JsonValue
from fgslam.report.content import Column, StageTime, TextTable, write_metrics, write_timing
from fgslam.report.results import ReportData, judged_report, truth_in_their_world
from fgslam.runs.config import ExperimentConfig
from fgslam.runs.estimator_files import NOISE_TABLE, write_estimate, write_noise
from fgslam.runs.folder import LOG_FILE
from fgslam.runs.maps import map_points
from fgslam.runs.slam_comparison import GROUND_TRUTH_FILE, load_truth
from fgslam.runs.tables import picture_title
from fgslam.runs.tasks.slam_calibration import (
    calibration_note,
    calibration_numbers,
    write_calibration,
)
from fgslam.runs.tasks.slam_map_entry import GivenMap
from fgslam.runs.tasks.slam_metrics import (
    closures_of,
    estimator_metrics,
    frame_problems,
    located,
    place_numbers,
    run_numbers,
    write_closures,
)
from fgslam.runs.tasks.truth import rendered_landmark_truth
from fgslam.slam.camera_remarks import camera_remarks
from fgslam.slam.first_images import stereo_remarks
from fgslam.slam.part_remarks import in_first_map, part_remarks
from fgslam.slam.pipeline import FrameReport, SlamPipeline
from fgslam.slam.results import STAGES, RunRecorder
from fgslam.slam.session import Session


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
    sequence: Sequence
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
