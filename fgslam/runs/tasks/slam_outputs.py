"""Writes the run folder from what a run has computed so far."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgslam.core.atomic_files import make_subfolder
from fgslam.core.estimates import Estimate, Trajectory
from fgslam.core.recordings import Sequence
from fgslam.core.trajectories import write_tum
from fgslam.evaluation.judging import Truth, closure_counts
from fgslam.evaluation.metrics import EstimatorMetrics, JsonValue
from fgslam.report.landmark_truth import LANDMARK_TRUTH_FILE, write_landmark_truth
from fgslam.report.metrics import StageTime, write_metrics, write_timing
from fgslam.runs.comparison import GROUND_TRUTH_FILE, load_truth, remark_of
from fgslam.runs.config import ExperimentConfig
from fgslam.runs.estimator_files import write_estimate
from fgslam.runs.maps import map_points
from fgslam.runs.tasks.rendered_truth import rendered_landmark_truth
from fgslam.runs.tasks.slam_checkpoint import save_log
from fgslam.runs.tasks.slam_places import closures_of, place_numbers, write_closures
from fgslam.runs.tasks.slam_summary import estimator_metrics, run_numbers
from fgslam.slam.pipeline import SlamPipeline
from fgslam.slam.recorder import STAGES, RunRecorder
from fgslam.slam.session import Session


@dataclass(frozen=True, slots=True, eq=False)
class RunOutputs:
    """The run folder of one run.

    Attributes:
        first_frame: number in the recording of the sequence's frame 0.
        notes: what is to be said of the run, besides the recording's own.
    """

    folder: Path
    config: ExperimentConfig
    sequence: Sequence
    session: Session
    first_frame: int = 0
    notes: tuple[str, ...] = ()

    @property
    def pipeline(self) -> SlamPipeline:
        """The session's parts."""
        return self.session.pipeline

    @property
    def recorder(self) -> RunRecorder:
        """The session's record of every frame."""
        return self.session.recorder

    @property
    def title(self) -> str:
        """The live estimator's label or kind, which names its folder."""
        return self.config.estimator.title

    @property
    def remark(self) -> str:
        """Marks results whose odometry was made from ground truth; empty otherwise."""
        return remark_of(self.config)

    def write_results(self, status: str) -> EstimatorMetrics:
        """Log, trajectories, covariances, map, metrics and timing of the frames so far."""
        estimate = self.pipeline.estimator.estimate()
        save_log(self.folder, self.recorder.log)
        truth = self._write_truth(with_landmarks=status == "finished")
        self._write_estimate(estimate)
        metrics = self._with_kind(estimator_metrics(estimate, truth, self.recorder))
        self.write_metrics({self.title: metrics}, status)
        self._write_timing(estimate.trajectory)
        return metrics

    def write_metrics(self, estimators: Mapping[str, EstimatorMetrics], status: str) -> None:
        """metrics.json of the live estimator and of those that replayed its log."""
        about = self._about(status) | run_numbers(self.recorder)
        if self.pipeline.places is not None:
            truth = load_truth(self.folder, self.recorder.log).trajectory
            closures = closures_of(self.recorder, self.pipeline.places.taken, truth)
            write_closures(self.folder, self.recorder, closures)
            about["places"] = place_numbers(self.recorder, closures)
        write_metrics(self.folder / "metrics.json", len(self.recorder), estimators, about)

    def _with_kind(self, metrics: EstimatorMetrics) -> EstimatorMetrics:
        places = self.pipeline.places
        told = {} if places is None else closure_counts(places.taken)
        more = {"kind": self.pipeline.estimator.kind} | dict(metrics.more) | told
        return dataclasses.replace(metrics, more=more)

    def _write_truth(self, with_landmarks: bool) -> Truth:
        """True path, and true landmarks where the recording is rendered and ``with_landmarks``.

        What is returned is read back: replays of the log are judged by the same digits.
        """
        if self.sequence.ground_truth is not None:
            write_tum(self.folder / GROUND_TRUTH_FILE, self.sequence.ground_truth)
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

    def _write_timing(self, trajectory: Trajectory) -> None:
        indices = [increment.index for increment in self.recorder.log]
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

    def _about(self, status: str) -> dict[str, JsonValue]:
        return {
            "name": self.config.name,
            "status": status,
            "frames_in_recording": len(self.sequence),
            "odometry": self.config.odometry.kind,
            "landmarks_permanent": int(self.pipeline.tracker.database.permanent.sum()),
            "remark": self.remark or None,
            "notes": [*self.sequence.notes, *self.notes],
        }
