"""Writes the run folder from what a run has computed so far."""

from __future__ import annotations

import platform
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from fgslam import __version__
from fgslam.config import ExperimentConfig
from fgslam.export.atomic import make_subfolder, write_text
from fgslam.export.metrics import (
    EstimatorMetrics,
    JsonValue,
    StageTime,
    write_metrics,
    write_timing,
)
from fgslam.export.point_cloud import MapPoints, write_ply
from fgslam.export.trajectories import write_covariances, write_tum
from fgslam.frontend.database import LandmarkDatabase
from fgslam.pipeline import SlamPipeline
from fgslam.runs.checkpoint import save_log
from fgslam.runs.recorder import STAGES, RunRecorder
from fgslam.runs.summary import estimator_metrics, run_numbers
from fgslam.types import Estimate, LandmarkMap, Sequence, Trajectory

_VERSIONS_OF = ("numpy", "scipy", "opencv-python-headless", "gtsam", "open3d")


@dataclass(frozen=True, slots=True, eq=False)
class RunOutputs:
    """The run folder of one run."""

    folder: Path
    config: ExperimentConfig
    sequence: Sequence
    pipeline: SlamPipeline
    recorder: RunRecorder

    @property
    def kind(self) -> str:
        """The live estimator's kind, which names its folder."""
        return self.pipeline.estimator.kind

    @property
    def remark(self) -> str:
        """Marks results whose odometry was made from ground truth; empty otherwise."""
        if self.config.odometry.kind != "synthetic":
            return ""
        return "odometry: SYNTHETIC (ground truth plus stated noise, see config.yaml)"

    def write_config(self) -> None:
        """The resolved configuration with what it takes to repeat the run."""
        values = self.config.as_values() | {"provenance": self._provenance()}
        write_text(self.folder / "config.yaml", yaml.safe_dump(values, sort_keys=False))

    def write_results(self, status: str) -> EstimatorMetrics:
        """Log, trajectories, covariances, map, metrics and timing of the frames so far."""
        estimate = self.pipeline.estimator.estimate()
        save_log(self.folder, self.recorder.log)
        if self.sequence.ground_truth is not None:
            write_tum(self.folder / "ground_truth.tum", self.sequence.ground_truth)
        self._write_estimate(estimate)
        metrics = estimator_metrics(estimate, self.sequence.ground_truth, self.recorder)
        write_metrics(
            self.folder / "metrics.json",
            len(self.recorder),
            {self.kind: metrics},
            self._about(status) | run_numbers(self.recorder),
        )
        self._write_timing(estimate.trajectory)
        return metrics

    def _write_estimate(self, estimate: Estimate) -> None:
        folder = make_subfolder(self.folder, self.kind)
        online = Trajectory(
            estimate.trajectory.timestamps, np.array(self.recorder.online_poses).reshape(-1, 4, 4)
        )
        write_tum(folder / "online.tum", online, self.remark)
        write_tum(folder / "final.tum", estimate.trajectory, self.remark)
        write_covariances(
            folder / "covariance.csv",
            estimate.trajectory.timestamps,
            estimate.covariances,
            self.remark,
        )
        points = map_points(estimate.landmarks, self.pipeline.tracker.database)
        write_ply(folder / "map.ply", points, self.remark)

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
            ],
        )

    def _about(self, status: str) -> dict[str, JsonValue]:
        return {
            "name": self.config.name,
            "status": status,
            "frames_in_recording": len(self.sequence),
            "odometry": self.config.odometry.kind,
            "remark": self.remark or None,
            "notes": list(self.sequence.notes),
        }

    def _provenance(self) -> dict[str, Any]:
        return {
            "versions": versions(),
            "dataset": {"name": self.sequence.name, "identity": self.sequence.identity},
        }


def versions() -> dict[str, str | None]:
    """Versions of this program, of Python and of the packages that shape the numbers."""
    own = {"fgslam": __version__, "python": platform.python_version()}
    return own | {name: _version(name) for name in _VERSIONS_OF}


def map_points(landmarks: LandmarkMap, database: LandmarkDatabase) -> MapPoints:
    """The estimator's geometry joined with the database's bookkeeping."""
    rows = database.rows(landmarks.ids)
    return MapPoints(
        ids=landmarks.ids,
        positions=landmarks.positions,
        covariances=landmarks.covariances,
        colours=np.repeat(database.colour[rows, None], 3, axis=1),
        hits=database.hits[rows],
        misses=database.misses[rows],
        valid=database.valid[rows],
        permanent=np.zeros(len(landmarks), np.bool_),
    )


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
