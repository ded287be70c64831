"""`fgslam classics`: well-known data sets, out of the installed GTSAM, through estimators.

Nothing is downloaded; UTIAS MRCLAM is read where it lies. Graphs, in files of g2o too, are solved
by iSAM2 and at once; stereo tracks are replayed.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from itertools import chain
from pathlib import Path

import numpy as np

from fgslam.backend.step_graph import (
    SolvedGraph,
    log_of,
    motions_chained,
    range_in_plane,
    read_graph,
    seen_in_plane,
    solve_at_once,
    solve_by_steps,
)
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import ConfigError, DatasetError
from fgslam.core.geometry import inverse, pose, so3_exp, wrap
from fgslam.core.log import MeasurementLog
from fgslam.core.sensors import Increment, Odometry
from fgslam.core.types import Trajectory
from fgslam.datasets.measured import open_stereo_tracks
from fgslam.datasets.odometry import pose_noise
from fgslam.datasets.settings import (
    ConstantVelocitySettings,
    RecordedOdometrySettings,
    StereoTracksSettings,
)
from fgslam.datasets.times import read_table
from fgslam.evaluation.judging import Truth, judge_answer, judge_replay, lone_answer
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.report.content import Column, TextTable
from fgslam.runs.compare import all_kinds
from fgslam.runs.results import number_text
from fgslam.runs.units import Progress, Stopped
from fgslam.runs.workers import NOT_BEGUN, Executor, Failed, Pool
from fgslam.slam.replay import replay

GRAPH_KINDS = ("isam2", "batch")
NO_GRAPH = "filters and windows keep no old pose on which an edge of a graph could close a loop"
_ON_LANDMARKS = ("ekf", "landmark_kalman", "sliding_window")
_BY_RANGE = ("odometry", "ekf", "landmark_kalman", "fixed_lag", "isam2", "batch")
_TRACKED = ("landmark_kalman", "fixed_lag", "sliding_window", "isam2", "batch")


@dataclass(frozen=True, slots=True)
class ClassicRow:
    """An estimator on a data set; None where a number cannot be known.

    Attributes:
        classic, estimator: their names.
        poses, measurements: how many.
        ate_m: after SE3 alignment.
        nees: of the poses, per degree of freedom.
        chi_square: twice the graph's error.
        step_ms, worst_ms: CPU of a step, mean and longest; of `batch` of the whole.
        why: what the truth is, or why it failed.
    """

    classic: str
    estimator: str
    poses: int
    measurements: int
    ate_m: float | None = None
    nees: float | None = None
    chi_square: float | None = None
    step_ms: float | None = None
    worst_ms: float | None = None
    why: str = ""


def _data(name: str) -> Path:
    found = find_spec("gtsam")
    if found is None or found.origin is None:
        raise DatasetError("gtsam is not installed, and the data sets lie inside it; install it")
    return Path(found.origin).parent / "Data" / name


def _sphere() -> FloatArray:
    return motions_chained(_data("sphere2500_groundtruth.txt"))


def _city() -> FloatArray:
    rows = read_table(_data("ISAM2_GT_city10000.txt"), ("x", "y", "turn")).values
    return np.array([_in_plane(*row) for row in rows])


def _in_plane(x: float, y: float, turn: float) -> FloatArray:
    return pose(so3_exp(np.array([0.0, 0.0, turn])), np.array([x, y, 0.0]))


def _poses_at(stamps: FloatArray, times: FloatArray, course: Sequence[FloatArray]) -> FloatArray:
    """Poses (n, 4, 4) at some times, of a course (x, y, turn) that is known at others."""
    at = np.column_stack([np.interp(stamps, times, one) for one in course])
    return np.array([_in_plane(*one) for one in at])


def _by_wheels(motion: FloatArray) -> Odometry:
    noise = pose_noise(motion, RecordedOdometrySettings())
    noise[_OUT_OF_PLANE, _OUT_OF_PLANE] = _STIFF
    return Odometry(motion, noise)


def _ranges(name: str) -> tuple[MeasurementLog, Trajectory]:
    """A mower's ranges to radios (Djugash and others 2009), a frame each, and where it was."""
    from scipy.io import loadmat

    file = loadmat(_data(f"{name.capitalize()}_.mat"))
    steps, (seconds, *course) = file["DR"], file["GT"].T
    ranges = file["TD"][np.unique(file["TD"][:, 0], return_index=True)[1]]  # some are out of order
    course[2] = np.unwrap(course[2]) + _HEADING[name]
    log, ends = MeasurementLog(), np.searchsorted(steps[:, 0], ranges[:, 0], "right")
    for k, (stamp, _, radio, distance) in enumerate(ranges):
        motion = np.eye(4)
        for _, ahead, turn in steps[ends[k - 1] if k else 0 : ends[k]]:
            motion = motion @ _in_plane(ahead, 0.0, turn)
        seen = range_in_plane(distance, _RANGE_SIGMA_M, int(radio))
        log.append(Increment.of(k, stamp, _by_wheels(motion) if k else None, seen))
    return log, Trajectory(ranges[:, 0], _poses_at(ranges[:, 0], seconds, course))


def _barcodes(path: Path) -> tuple[MeasurementLog, Trajectory]:
    """A robot's ranges and bearings of barcodes (UTIAS MRCLAM, Leung and others 2011), and truth.

    Their deviations, which no file states, are those against the truth, by the median.
    """
    robot = path.name.removesuffix(_MRCLAM)

    def rows(name: str, *columns: str) -> FloatArray:
        return read_table(path.parent / name, columns).values

    subjects = {code: one for one, code in rows("Barcodes.dat", "subject", "barcode").tolist()}
    known = rows("Landmark_Groundtruth.dat", "subject", "x", "y").tolist()
    places = {subject: (x, y, 0.0, 1.0) for subject, x, y in known}
    times, speed, rate = rows(f"{robot}_Odometry.dat", "time", "velocity", "turn rate").T
    seconds, *course = rows(f"{robot}_Groundtruth.dat", "time", "x", "y", "heading").T
    seen = rows(path.name, "time", "barcode", "range", "bearing")
    seen[:, 1] = [subjects.get(code, -1.0) for code in seen[:, 1].tolist()]  # robots have some, too
    known_at = (seen[:, 0] > max(seconds[0], times[0])) & (seen[:, 0] < min(seconds[-1], times[-1]))
    seen = seen[known_at & np.isin(seen[:, 1], list(places))]
    if not len(seen):
        raise DatasetError(
            f"{path}: sees no landmark of Landmark_Groundtruth.dat while odometry and truth last; "
            "take all five files from one folder of UTIAS"
        )
    seen = seen[np.unique(seen[:, :2], axis=0, return_index=True)[1]]
    stamps, frames = np.unique(seen[:, 0], return_inverse=True)
    course[2] = np.unwrap(course[2])
    poses = _poses_at(stamps, seconds, course)
    turned = np.append(0.0, np.cumsum(rate[:-1] * np.diff(times)))
    way = speed[:-1] * np.diff(times) * np.exp(0.5j * (turned[1:] + turned[:-1]))
    at = np.append(0.0, np.cumsum(way))
    driven = _poses_at(stamps, times, (at.real, at.imag, turned))
    points = np.array([places[one] for one in seen[:, 1]])
    x, y = (inverse(poses[frames]) @ points[:, :, None])[:, :2, 0].T
    off = seen[:, 2:] - np.column_stack([np.hypot(x, y), np.arctan2(y, x)])
    off[:, 1] = wrap(off[:, 1])
    sigmas = np.tile(_OF_MEDIAN * np.median(np.abs(off), axis=0), (len(seen), 1))
    log = MeasurementLog()
    for k, stamp in enumerate(stamps.tolist()):
        step = _by_wheels(inverse(driven[k - 1]) @ driven[k]) if k else None
        own, ids = seen[frames == k, 2:], seen[frames == k, 1].astype(np.int64)
        log.append(Increment.of(k, stamp, step, [seen_in_plane(own, sigmas[: len(own)], ids)]))
    return log, Trajectory(stamps, poses)


_MRCLAM = "_Measurement.dat"  # of a robot, by which it is named
_OF_MEDIAN = 1.4826  # deviation over the median size of normally distributed errors

_RANGE_SIGMA_M = 0.5  # against the truth, once scaled: white
_HEADING = {"plaza1": 0.0, "plaza2": np.pi}  # of the course against what the file calls heading
_STIFF, _OUT_OF_PLANE = 1e-8, np.array([0, 1, 5])  # of [rotation, translation]

_GRAPHS: dict[str, tuple[str, Callable[[], FloatArray] | None]] = {
    "victoria_park": ("victoria_park.txt", None),
    "sphere2500": ("sphere2500.txt", _sphere),
    "city10000": ("T1_city10000_04.txt", _city),
    "w10000": ("w10000.graph", None),
}
CLASSICS = (*_GRAPHS, "kitti00", *_HEADING)
"""Their names."""


def require_classics(names: Sequence[str]) -> None:
    """Raises ConfigError for a name that is neither a classic nor a file."""
    for name in names:
        if name not in CLASSICS and not Path(name).is_file():
            if Path(name).suffix:
                raise ConfigError(f"{name}: no such file; give the path of one that is there")
            raise ConfigError(
                f"no classic {name!r}; give {', '.join(CLASSICS)}, a .g2o file, or "
                f"Robot1{_MRCLAM} of UTIAS MRCLAM"
            )


def run_classics(
    names: Sequence[str],
    steps: int | None,
    kinds: Collection[str],
    jobs: int | None,
    progress: Progress,
    stopped: Stopped,
) -> list[ClassicRow]:
    """The rows of several, in their order, each in a process of its own where ``jobs`` allows it.

    Arguments are those of :func:`run_classic` and of :class:`~fgslam.runs.workers.Pool`; a bar of
    progress for each drive that runs. What a stop ended has no rows.
    """
    rows: list[list[ClassicRow]] = [[] for _ in names]
    jobs, left = min(len(names), jobs or os.cpu_count() or 1), [Path(name).name for name in names]
    with Pool(jobs) if jobs > 1 else nullcontext(Executor()) as pool:
        for name in left[:jobs]:  # they begin in their order
            progress(name, 0, 1)
        for k, found in pool.run(partial(run_classic, steps=steps, kinds=kinds), names, stopped):
            if found == Failed(NOT_BEGUN):
                break
            name = Path(names[k]).name
            left.remove(name)
            if isinstance(found, Failed):
                found = [ClassicRow(name, "all", 0, 0, why=found.why)]
            rows[k] = found
            progress(name, 1, 1)
            for name in left[:jobs]:
                progress(name, 0, 1)
    return list(chain(*rows))


def run_classic(
    name: str, steps: int | None = None, kinds: Collection[str] = GRAPH_KINDS
) -> list[ClassicRow]:
    """Every estimator that fits.

    Args:
        name: of :data:`CLASSICS`, or the path of a graph: `.g2o`, `.graph`, or of a robot of UTIAS
            MRCLAM: `Robot1_Measurement.dat`, next to the other files of its folder.
        steps: only so many steps of the drive.
        kinds: which solvers of a graph.

    Raises:
        DatasetError: a file cannot be read.
    """
    if name == "kitti00":
        opened = open_stereo_tracks(StereoTracksSettings(stop=steps), ConstantVelocitySettings())
        count = sum(len(one.observations) for one in opened.log)
        return _replayed(name, opened.log, opened.ground_truth, count, _TRACKED)
    if name in _HEADING or name.endswith(_MRCLAM):
        log, where = _ranges(name) if name in _HEADING else _barcodes(Path(name))
        log = MeasurementLog(increments=log.increments[:steps])
        count = sum(len(one.measured[0]) for one in log)
        return _replayed(Path(name).name, log, where, count, _BY_RANGE)
    file, make_truth = _GRAPHS.get(name, (name, None))
    graph = read_graph(_data(file) if name in _GRAPHS else Path(file)).first(steps)
    poses = None if make_truth is None else make_truth()
    truth = None if poses is None else Trajectory(np.arange(len(poses), dtype=np.float64), poses)
    solved = {"isam2": solve_by_steps(graph)}
    if "batch" in kinds:
        solved["batch"] = solve_at_once(graph, solved["isam2"].values)
    rows = [
        _row(Path(name).name, kind, graph.size, found, truth)
        for kind, found in solved.items()
        if kind in kinds
    ]
    if name == "victoria_park":
        best = solved["batch"].estimate.trajectory
        others = _replayed(name, log_of(graph), best, graph.size, _ON_LANDMARKS)
        rows += [replace(row, nees=None) for row in others]
    return rows


def _row(
    name: str, kind: str, measurements: int, solved: SolvedGraph, truth: Trajectory | None
) -> ClassicRow:
    metrics = judge_answer(lone_answer(solved.estimate), Truth(truth)).metrics
    times = 1e3 * solved.step_s
    count = len(solved.estimate.trajectory)
    return ClassicRow(name, kind, count, measurements, metrics.ate_rmse_m,
                      metrics.nees_pose_per_dof, solved.chi_square, float(times.mean()),
                      float(times.max()))  # fmt: skip


def _replayed(
    name: str, log: MeasurementLog, truth: Trajectory | None, count: int, kinds: Sequence[str]
) -> list[ClassicRow]:
    rows = []
    for kind in kinds:
        found = replay(log, all_kinds()[kind], EgoMotionSettings())
        metrics = judge_replay(found, Truth(truth)).metrics
        times = found.column("update_ms") + found.column("solve_ms")
        known = metrics.ate_rmse_m, metrics.nees_pose_per_dof, None
        ms = float(times.mean()), float(times.max())
        rows.append(ClassicRow(name, kind, len(log), count, *known, *ms, found.failure))
    return rows


def classics_table(rows: Sequence[ClassicRow]) -> TextTable:
    """The rows to be read."""
    columns = (
        Column("poses", "of the drive"),
        Column("measure-\nments", "edges, sightings"),
        Column("ATE m", "root mean square position error, SE3 aligned, where truth is known"),
        Column("NEES", "of the poses per degree of freedom: 1 is right"),
        Column("chi-square", "of the whole graph at the answer"),
        Column("ms a step\nmean longest", "CPU, of replays time; of batch of the whole"),
    )
    shown = tuple(
        (
            f"{one.classic} {one.estimator}",
            (
                f"{one.poses:,}",
                f"{one.measurements:,}",
                number_text(one.ate_m, ".3f"),
                number_text(one.nees),
                number_text(one.chi_square, ",.2f"),
                f"{number_text(one.step_ms, ',.2f')} {number_text(one.worst_ms, ',.1f')}",
            ),
        )
        for one in rows
    )
    return TextTable("classics", "classic data sets", "data set, estimator", columns, shown)


def classics_notes(rows: Sequence[ClassicRow]) -> tuple[str, ...]:
    """What a reader of the rows must know."""
    notes = [f"{one.classic} {one.estimator} failed: {one.why}" for one in rows if one.why]
    if any(one.classic == "kitti00" for one in rows):
        notes.append("kitti00: the reference poses are estimates from the same images, no truth")
    if any(one.classic == "victoria_park" for one in rows):
        notes.append("victoria_park: there is no truth; ATE of the last three is against batch")
    if any(one.estimator == "batch" and one.chi_square is not None for one in rows):
        notes.append(f"graphs: batch begins where isam2 ended; {NO_GRAPH}")
    return tuple(notes)
