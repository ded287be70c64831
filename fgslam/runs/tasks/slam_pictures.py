"""Chooses what of a run to draw: the paper's figures 1 to 6, and the curves over time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.atomic_files import make_subfolder
from fgslam.core.estimates import Estimate, Trajectory
from fgslam.core.measurements import Increment
from fgslam.evaluation.trajectory import to_estimate_world
from fgslam.report.pictures import (
    MapDrawing,
    draw_birds_eye,
    draw_disparities,
    draw_errors,
    draw_features,
    draw_flow,
    draw_map_views,
    draw_matches,
)
from fgslam.report.pictures.birds_eye import world_position_covariances
from fgslam.runs.tasks.slam_outputs import RunOutputs
from fgslam.slam.pipeline import FrameReport

FOLDER = "pictures"
_SYNTHETIC = ", synthetic odometry"
_SHOWN = (0.0, 60 / 249, 120 / 249, 180 / 249)
"""Frames shown, as parts of the run: those of the paper's Figure 4."""


def frames_to_show(count: int) -> frozenset[int]:
    """Which of ``count`` frames are drawn; the second is among them for the first flow."""
    return frozenset({round(part * count) for part in _SHOWN} | {1}) & frozenset(range(count))


def draw_frame(outputs: RunOutputs, i: int, report: FrameReport) -> None:
    """Features (Fig. 1), disparities (Fig. 2) and flow from the frame before (Fig. 3)."""
    if report.found.frame is None:
        return
    folder = make_subfolder(outputs.folder, FOLDER)
    images = report.found.frame.images
    title = _title(outputs, f"frame {report.increment.index}")
    draw_features(folder / f"features_{i:06d}.png", images, report.found.features, title)
    draw_disparities(folder / f"disparities_{i:06d}.png", images[0], report.stereo.pixels, title)
    if len(outputs.recorder.log) > 1:
        earlier, now = outputs.recorder.log.increments[-2:]
        a, b = _common(earlier, now)
        before = earlier.observations.measurement[a, :2]
        after = now.observations.measurement[b, :2]
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
        matched, inliers, landmarks: (m,) counts of each frame.
    """

    name: str
    synthetic: bool
    estimate: Estimate
    truth: Trajectory | None
    valid: BoolArray
    frames: IntArray
    matched: IntArray
    inliers: IntArray
    landmarks: IntArray

    def title(self, what: str) -> str:
        """Title of one picture."""
        return f"{self.name}: {what}{_SYNTHETIC if self.synthetic else ''}"


def figures_of(outputs: RunOutputs) -> RunFigures:
    """A live run's figures."""
    # Once for all pictures: a smoother's estimate may be dear.
    estimate = outputs.pipeline.estimator.estimate()
    database, recorder = outputs.pipeline.tracker.database, outputs.recorder
    return RunFigures(
        name=outputs.config.name,
        synthetic=bool(outputs.remark),
        estimate=estimate,
        truth=outputs.sequence.ground_truth,
        valid=database.valid[database.rows(estimate.landmarks.ids)],
        frames=np.array([increment.index for increment in recorder.log], np.int64),
        matched=recorder.column("matched"),
        inliers=recorder.column("inliers"),
        landmarks=recorder.column("landmarks"),
    )


def draw_run(run: Path, figures: RunFigures) -> list[Path]:
    """Map from above (Fig. 5), in perspective (Fig. 6), errors and matches over time."""
    folder = make_subfolder(run, FOLDER)
    estimate, truth = figures.estimate, figures.truth
    found = None if truth is None else to_estimate_world(estimate.trajectory, truth)
    drawing = _map_drawing(figures, None if found is None else found[1])
    draw_birds_eye(folder / "map_from_above.png", drawing)
    draw_map_views(folder / "map_views.png", drawing)
    # The first frame has no landmarks to match.
    draw_matches(
        folder / "matches.png",
        figures.frames[1:],
        figures.matched[1:],
        figures.inliers[1:],
        figures.landmarks[1:],
        figures.title("landmark matches"),
    )
    if found is not None:
        _draw_position_errors(folder / "position_error.png", figures, *found)
    return sorted(folder.glob("*.png"))


def _draw_position_errors(
    path: Path, figures: RunFigures, rows: IntArray, true_poses: FloatArray
) -> None:
    trajectory = figures.estimate.trajectory
    errors = trajectory.poses[rows, :3, 3] - true_poses[:, :3, 3]
    covariances = world_position_covariances(
        trajectory.poses[rows], figures.estimate.covariances[rows]
    )
    # A planar covariance, rotated, may round to just below zero.
    sigmas = np.sqrt(np.maximum(np.diagonal(covariances, axis1=1, axis2=2), 0.0))
    title = figures.title("position error, first pose aligned")
    draw_errors(path, trajectory.timestamps[rows], errors, sigmas, title)


def _map_drawing(figures: RunFigures, true_poses: FloatArray | None) -> MapDrawing:
    """Valid landmarks only (6.1), as in the paper's Figure 6; all while the run is too short."""
    valid, estimate = figures.valid, figures.estimate
    shown = valid if valid.any() else np.ones_like(valid)
    return MapDrawing(
        landmarks=estimate.landmarks.positions[shown],
        poses=estimate.trajectory.poses,
        landmark_covariances=estimate.landmarks.covariances[shown],
        pose_covariances=estimate.covariances,
        truth=true_poses,
        title=figures.title("valid landmarks" if valid.any() else "landmarks"),
    )


def _common(earlier: Increment, now: Increment) -> tuple[IntArray, IntArray]:
    """Rows of the landmarks that both frames saw, rejected ones left out."""
    _, a, b = np.intersect1d(
        earlier.observations.ids[~earlier.rejected],
        now.observations.ids[~now.rejected],
        return_indices=True,
    )
    return np.flatnonzero(~earlier.rejected)[a], np.flatnonzero(~now.rejected)[b]


def _title(outputs: RunOutputs, what: str) -> str:
    return f"{outputs.config.name}: {what}{_SYNTHETIC if outputs.remark else ''}"
