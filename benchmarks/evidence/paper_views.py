"""Tables of Sections 2 and 3 of the paper beside ours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.evidence.views import LabViews, View, ViewPair, make_pair
from benchmarks.runs import EVERY_FRAME, experiment, say
from benchmarks.tables import Cell, Table
from fgslam.core.arrays import FloatArray
from fgslam.core.types import EgoMotion, Trajectory
from fgslam.evaluation.statistics import end_pose
from fgslam.frontend.stereo import StereoMatcher
from fgslam.runs.config import ExperimentConfig
from fgslam.slam.build import make_pipeline
from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.motion import body_motion
from fgslam.slam.pipeline import FrameReport

STARTS = range(0, 250, 10)
"""Frames of the drive from which the two small motions start; the first one is the example."""

PAPER_EGO_MOTION = (
    "frontend.ego_motion.dof=6",
    "frontend.ego_motion.residuals=image",
    "frontend.ego_motion.weighting=uniform",
    "frontend.ego_motion.prior=false",
    "frontend.ego_motion.kernel=none",
    "frontend.ego_motion.outlier_sigmas=0",
)
PAPER_MATCHING = (
    "frontend.appearance.mode=paper",
    "frontend.stereo.measurement=paper",
    "frontend.matching.widen_sigmas=0",
)
_MODES = {
    "`descriptor` (default)": ("frontend.ego_motion.dof=6",),
    "as the paper": (*PAPER_MATCHING, *PAPER_EGO_MOTION),
}
_PAPER_STEREO: dict[str, Cell] = {
    "right-left, initial view": 106,
    "all three images, initial view": 59,
    "after 10 cm forward": 66,
    "then 5 deg clockwise": 60,
    "right-left / fewest features": 106 / 166,
    "three images / right-left": 59 / 106,
}
_COMPONENTS = ("X cm", "Y cm", "Z cm", "yaw deg", "pitch deg", "roll deg")

Triple = tuple[View, View, View]


def tables() -> list[Table]:
    """All of them, from the same rendered views."""
    say(f"rendering {3 * len(STARTS)} views")
    lab = LabViews(experiment("lab_loop", EVERY_FRAME))
    triples = [lab.triple(i) for i in STARTS if i < len(lab.sequence)]
    moves = {name: _moves(lab, triples, options) for name, options in _MODES.items()}
    return [
        features_table([triple[0] for triple in triples]),
        matches_table(lab, triples),
        frames_table(moves),
        *(estimates_table(name, both) for name, both in moves.items()),
    ]


def default_moves() -> BothMoves:
    """Both small motions from every place of the drive, matched and tracked by defaults."""
    lab = LabViews(experiment("lab_loop", EVERY_FRAME))
    triples = [lab.triple(i) for i in STARTS if i < len(lab.sequence)]
    return _moves(lab, triples, _MODES["`descriptor` (default)"])


# ----------------------------------------------------------------------------------------------
# One view


def features_table(views: list[View]) -> Table:
    """How many features the three images have."""
    counts = np.array([[len(f) for f in view.features] for view in views])
    spread = counts.max(axis=1) / counts.min(axis=1)
    columns = ("image", "paper", "start of the drive", "drive: median", "least", "most")
    rows: list[tuple[Cell, ...]] = []
    for name, paper, camera in (("top", 193, 2), ("left", 166, 1), ("right", 189, 0)):
        n = counts[:, camera]
        rows.append((name, paper, int(n[0]), float(np.median(n)), int(n.min()), int(n.max())))
    note = (
        f"most over least of the three counts: paper {193 / 166:.2f}, ours "
        f"{np.median(spread):.2f} (median of {len(views)} places), at worst {spread.max():.2f}"
    )
    return Table("SIFT features of one frame", columns, rows, (note,))


def matches_table(lab: LabViews, triples: list[Triple]) -> Table:
    """Matches right-left, then confirmed by the top image, in three neighbouring views."""
    modes = ("descriptor", "paper")
    columns = (
        "",
        "paper",
        *(f"`{mode}`: {what}" for mode in modes for what in ("start", "median")),
    )
    found = [_quantities(_stereo_counts(lab, triples, mode)) for mode in modes]
    rows: list[tuple[Cell, ...]] = []
    for name, paper in _PAPER_STEREO.items():
        cells: list[Cell] = [name, paper]
        for values in found:
            cells += [_number(values[name][0]), float(np.median(values[name]))]
        rows.append(tuple(cells))
    return Table("Stereo matches, three views at small motions", columns, rows)


def _quantities(counts: FloatArray) -> dict[str, FloatArray]:
    """What the paper reports of the three views, (n,) each, under the names of _PAPER_STEREO."""
    pairs, final, features = np.moveaxis(counts, 2, 0)
    values = (
        pairs[:, 0],
        final[:, 0],
        final[:, 1],
        final[:, 2],
        pairs[:, 0] / features[:, 0],
        final[:, 0] / pairs[:, 0],
    )
    return dict(zip(_PAPER_STEREO, values, strict=True))


def _number(value: float) -> Cell:
    return int(value) if float(value).is_integer() else float(value)


def _stereo_counts(lab: LabViews, triples: list[Triple], mode: str) -> FloatArray:
    """(n, 3, 3) per triple and view: right-left matches, final ones, fewest features."""
    settings = experiment("lab_loop", [*EVERY_FRAME, f"frontend.appearance.mode={mode}"]).frontend
    matcher = StereoMatcher(lab.rig, settings.stereo, settings.appearance)
    counts = [[_counts(matcher, view) for view in triple] for triple in triples]
    return np.array(counts, np.float64)


def _counts(matcher: StereoMatcher, view: View) -> tuple[int, int, int]:
    pairs, _ = matcher.match_left(view.features[0], view.features[1])
    return len(pairs), len(matcher.match(view.features)), min(len(f) for f in view.features)


# ----------------------------------------------------------------------------------------------
# Two views


@dataclass(frozen=True, eq=False)
class Move:
    """One of the two small motions, tracked."""

    pair: ViewPair
    reports: tuple[FrameReport, FrameReport]

    @property
    def tracking(self) -> EgoMotion:
        """The least-squares pose of the second view."""
        return self.reports[1].tracking

    @property
    def matches(self) -> int:
        """Features of the second view matched to those of the first, before outliers go."""
        return len(self.tracking.inliers)

    @property
    def measured(self) -> bool:
        """Whether the matches sufficed for a least-squares motion."""
        return self.tracking.status.measured

    @property
    def share(self) -> float:
        """Matches over the lesser of both views' stereo features."""
        return self.matches / min(len(report.stereo) for report in self.reports)

    @property
    def mean_residual_px(self) -> float:
        """The paper's mean E."""
        used = self.tracking.residuals[self.tracking.inliers]
        return float(used.mean()) if len(used) else float("nan")


@dataclass(frozen=True, eq=False)
class BothMoves:
    """The two motions from many places."""

    forward: list[Move]
    clockwise: list[Move]


def _moves(lab: LabViews, triples: list[Triple], options: tuple[str, ...]) -> BothMoves:
    config = experiment("lab_loop", [*EVERY_FRAME, *options])
    forward, clockwise = [], []
    for number, (start, ahead, turned) in enumerate(triples):
        rng = np.random.default_rng([lab.seed, number])
        forward.append(_move(config, make_pair(lab, (start, ahead), rng)))
        clockwise.append(_move(config, make_pair(lab, (ahead, turned), rng)))
    return BothMoves(forward, clockwise)


def _move(config: ExperimentConfig, pair: ViewPair) -> Move:
    pipeline = make_pipeline(pair.rig, config.frontend, config.odometry, config.estimator)
    reports = [
        pipeline.process(
            FeatureFrame(i, view.frame, view.features, "", 0.0, 0.0),
            i,
            float(i),
            body_motion(pair, i, pipeline.motion),
        )
        for i, view in enumerate(pair.views)
    ]
    return Move(pair, (reports[0], reports[1]))


def frames_table(moves: dict[str, BothMoves]) -> Table:
    """How many features are found again after each motion."""
    columns = ("motion", "mode", "matches", "% of the lesser view", "median matches", "median %")
    rows: list[tuple[Cell, ...]] = [
        ("10 cm forward", "paper", 43, 73.0, None, None),
        ("5 deg clockwise", "paper", 41, 68.0, None, None),
    ]
    for name, both in moves.items():
        for motion, found in (("10 cm forward", both.forward), ("5 deg clockwise", both.clockwise)):
            matches = float(np.median([move.matches for move in found]))
            share = 100.0 * float(np.median([move.share for move in found]))
            first = found[0]
            rows.append((motion, name, first.matches, 100.0 * first.share, matches, share))
    return Table("Matches between those views", columns, rows)


def estimates_table(name: str, both: BothMoves) -> Table:
    """Least-squares motion of both moves, its 1 sigma and its error."""
    columns = ("", *_COMPONENTS, "mean E px")
    paper_forward = (1.353, -0.534, 11.136, 0.059, -0.055, -0.029, 1.328)
    rows: list[tuple[Cell, ...]] = [("paper, 10 cm forward", *paper_forward)]
    rows += _motion_rows("10 cm forward", both.forward)
    rows.append(("paper, 5 deg clockwise", *[None] * 6, 1.693))
    rows += _motion_rows("5 deg clockwise", both.clockwise)
    moves = [*both.forward, *both.clockwise]
    lost = sum(not move.measured for move in moves)
    notes = (
        f"{lost} of {len(moves)} motions had too few matches in the search window around the "
        "odometry's prediction and are left out of the statistics",
    )
    return Table(f"Ego-motion of the two small motions, {name}", columns, rows, notes)


def _motion_rows(motion: str, moves: list[Move]) -> list[tuple[Cell, ...]]:
    first, found = moves[0], [move for move in moves if move.measured]
    errors = np.array([_components(m.tracking.wTc) - _components(m.pair.motion) for m in found])
    wheels = np.array(
        [_components(_camera_odometry(m)) - _components(m.pair.motion) for m in found]
    )
    sigmas = np.array([_sigmas(m.tracking) for m in found])
    residual = float(np.mean([m.mean_residual_px for m in found]))
    known = first.measured
    estimate = _components(first.tracking.wTc).tolist() if known else [None] * 6
    places = f"{len(found)} places"
    return [
        (f"truth, {motion}", *_components(first.pair.motion).tolist(), None),
        ("ours at the start", *estimate, first.mean_residual_px),
        ("its 1 sigma", *(_sigmas(first.tracking).tolist() if known else [None] * 6), None),
        (f"our rms error, {places}", *_rms(errors), residual),
        (f"our median 1 sigma, {places}", *np.median(sigmas, axis=0).tolist(), None),
        ("largest error over its sigma", *np.abs(errors / sigmas).max(axis=0).tolist(), None),
        ("rms error of the odometry", *_rms(wheels), None),
    ]


def _camera_odometry(move: Move) -> FloatArray:
    odometry = move.reports[1].increment.odometry
    if odometry is None:
        raise ValueError("the second view has odometry by construction")
    return odometry.motion


def _components(motion: FloatArray) -> FloatArray:
    """(6,) X, Y, Z in cm, yaw, pitch and roll in degrees, as the paper gives them."""
    end = end_pose(Trajectory(np.array([0.0, 1.0]), np.array([np.eye(4), motion])))
    if end is None:
        raise ValueError("a trajectory of two poses has an end")
    names = ("x_cm", "y_cm", "z_cm", "yaw_deg", "pitch_deg", "roll_deg")
    return np.array([end[name] for name in names])


def _sigmas(tracking: EgoMotion) -> FloatArray:
    """(6,) standard deviations in the units and order of :func:`_components`."""
    rotation = tracking.wTc[:3, :3]
    translation = np.diagonal(rotation @ tracking.covariance[3:, 3:] @ rotation.T)
    pitch, yaw, roll = np.degrees(np.sqrt(np.diagonal(tracking.covariance)[:3]))
    return np.array([*(100.0 * np.sqrt(translation)), yaw, pitch, roll])


def _rms(errors: FloatArray) -> list[float]:
    return [float(value) for value in np.sqrt(np.mean(errors**2, axis=0))]
