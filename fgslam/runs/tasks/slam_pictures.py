"""Chooses what of a run to draw: the paper's figures 1 to 6, and the curves over time.

What draws is imported when something is drawn: Matplotlib takes a second.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.estimates import Estimate, Trajectory
from fgslam.core.files import make_subfolder
from fgslam.core.measurements import Increment
from fgslam.report.figures.over_time import error_by_axis, matches_over_time
from fgslam.report.figures.trajectory import ON_PAPER, drive_from_above, map_to_turn
from fgslam.report.run_results import ReportData, judged_report, truth_in_their_world
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
    from fgslam.report.pictures.image_overlays import draw_disparities, draw_features, draw_flow

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
        up: (3,) the vertical in the first camera's frame.
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
    up: FloatArray

    def title(self, what: str) -> str:
        """Title of one picture."""
        return f"{self.name}: {what}{_SYNTHETIC if self.synthetic else ''}"


def figures_of(outputs: RunOutputs) -> RunFigures:
    """A live run's figures."""
    # Once for all pictures: a smoother's estimate may take long.
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
        up=outputs.sequence.rig.bTc[2, :3],
    )


def draw_run(run: Path, figures: RunFigures) -> list[Path]:
    """Map from above (Fig. 5), in perspective (Fig. 6), errors and matches over time."""
    from fgslam.report.pictures.on_paper import draw_figure, draw_views

    folder = make_subfolder(run, FOLDER)
    results = _results(figures)
    kind = "valid landmarks" if figures.valid.any() else "landmarks"
    what = figures.title(f"{len(results.estimators[0].landmarks):,} {kind}")
    above, ellipses = drive_from_above(results, ON_PAPER), {"landmark-ellipses": True}
    draw_figure(folder / "map_from_above.png", above, what, ellipses)
    draw_views(folder / "map_views.png", map_to_turn(results, ON_PAPER), what)
    # The first frame has no landmarks to match.
    counts = (figures.frames, figures.matched, figures.inliers, figures.landmarks)
    matches = matches_over_time(*(values[1:] for values in counts))
    draw_figure(folder / "matches.png", matches, figures.title("landmark matches"))
    if results.truth is not None:
        title = figures.title("position error, first pose aligned")
        draw_figure(folder / "position_error.png", error_by_axis(results), title)
    return sorted(folder.glob("*.png"))


def _results(figures: RunFigures) -> ReportData:
    """Valid landmarks only (6.1), as in the paper's Figure 6; all while the run is too short."""
    estimate, valid = figures.estimate, figures.valid
    if valid.any():
        estimate = replace(estimate, landmarks=estimate.landmarks.select(valid))
    report = judged_report("estimate", "", estimate, None, figures.truth)
    truth = truth_in_their_world((report,), figures.truth)
    return ReportData(
        title=figures.name, subtitle="", estimators=(report,), truth=truth, up=figures.up
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
