"""A person in the lab (docs/results): does the pose jump, are they forgotten?"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from benchmarks.runs import (
    EVERY_FRAME,
    ate_m,
    experiment,
    find_features,
    make_system,
    process,
)
from benchmarks.tables import Cell, Table
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.log import ImageSequence
from fgslam.datasets.rendered import RenderedLabSequence
from fgslam.evaluation.statistics import to_estimate_world
from fgslam.slam.pipeline import FrameReport, SlamPipeline
from fgslam.worlds.people import WALK_FRAMES
from fgslam.worlds.settings import RenderedLabSettings

JUMP_BOUND_M = 0.05
_NAME = "person"


@dataclass(frozen=True)
class Life:
    """What became of one landmark that was initiated on the person.

    Attributes:
        born: frame of its first observation.
        died: frame at which it was pruned, or None.
        missed: consecutive misses so far (the frames that expected it in view).
        hit_after: matches after the person had left: something else taken for the person.
    """

    born: int
    died: int | None
    missed: int
    hit_after: int


@dataclass(frozen=True, eq=False)
class PersonRun:
    """The run with the person.

    Attributes:
        lives: of every landmark on the person.
        alive: (n,) how many of them the map held after each frame.
        errors: (n, 3) position errors in metres, first pose aligned.
        ate_m: after SE3 alignment.
        prune_after: the database's N.
        last: last frame in which a pixel shows the person.
    """

    lives: list[Life]
    alive: IntArray
    errors: FloatArray
    ate_m: float
    prune_after: int
    last: int

    @property
    def jumps_m(self) -> FloatArray:
        """(n - 1,) change of the position error between consecutive frames."""
        return np.asarray(np.linalg.norm(np.diff(self.errors, axis=0), axis=1))

    @property
    def survivors(self) -> list[Life]:
        """Landmarks that the map still held at the end."""
        return [life for life in self.lives if life.died is None]


SCENES: dict[str, tuple[str, ...]] = {
    "as committed": (),
    # At full speed the robot has passed the person's place before it could miss anything there
    # twenty times; at a twentieth it keeps looking.
    "at a twentieth of the speed": (
        "dataset.drive.frames=4980",
        "dataset.effects.person=400",
        "dataset.start=395",
        "dataset.stop=440",
    ),
}


def tables() -> list[Table]:
    """Jumps of the pose with and without the person, and the landmarks' lives."""
    runs = {name: run_person(options) for name, options in SCENES.items()}
    return [
        _jump_table(runs["as committed"], _errors_without()),
        _life_table(runs),
        _alive_table(runs),
    ]


def run_person(overrides: Iterable[str] = ()) -> PersonRun:
    """Runs `experiments/lab_person.yaml` and follows every landmark on the person."""
    config = experiment("lab_person", overrides)
    found = find_features(config)
    sequence, pipeline = found.sequence, make_system(config, found.sequence)
    if not isinstance(sequence, RenderedLabSequence):
        raise ValueError("lab_person is rendered")
    seen = _person_masks(sequence, config.dataset)
    follower = _Follower(max(seen))
    for report in process(found, pipeline):
        follower.follow(report, seen.get(report.found.i))
    return PersonRun(
        follower.lives(pipeline),
        np.array(follower.alive),
        position_errors(pipeline, sequence),
        ate_m(pipeline, sequence),
        config.frontend.database.prune_after_misses,
        max(seen),
    )


def position_errors(pipeline: SlamPipeline, sequence: ImageSequence) -> FloatArray:
    """(n, 3) metres, first pose aligned. Raises ValueError without ground truth."""
    estimate, truth = pipeline.estimator.estimate().trajectory, sequence.ground_truth
    matched = None if truth is None else to_estimate_world(estimate, truth)
    if matched is None:
        raise ValueError("position errors need ground truth")
    rows, poses = matched
    return np.asarray(estimate.poses[rows, :3, 3] - poses[:, :3, 3])


def _person_masks(sequence: RenderedLabSequence, settings: object) -> dict[int, BoolArray]:
    """Per frame in which the person is seen: where (height, width), as true object identities."""
    if not isinstance(settings, RenderedLabSettings) or settings.effects.person is None:
        raise ValueError("no person walks in this experiment")
    thing = sequence.object_names.index(_NAME)
    masks = {}
    first = settings.effects.person - settings.start
    for i in range(first, first + WALK_FRAMES):
        mask = sequence.object_ids(i) == thing
        if mask.any():
            masks[i] = mask
    return masks


class _Follower:
    """Books births, hits and deaths of the landmarks that were initiated on the person."""

    def __init__(self, last: int) -> None:
        self._last = last
        self._born: dict[int, int] = {}
        self._died: dict[int, int] = {}
        self._hit_after: dict[int, int] = {}
        self.alive: list[int] = []

    def follow(self, report: FrameReport, mask: BoolArray | None) -> None:
        frame, increment = report.found.i, report.increment
        observed = increment.observations
        if mask is not None:
            fresh = observed.select(observed.is_new)
            at = np.rint(fresh.measurement[:, :2]).astype(np.int64)
            on_person = mask[at[:, 1], at[:, 0]]
            self._born |= dict.fromkeys(fresh.ids[on_person].tolist(), frame)
        if frame > self._last:
            used = observed.ids[~observed.is_new & ~increment.rejected]
            for identity in self._born.keys() & set(used.tolist()):
                self._hit_after[identity] = self._hit_after.get(identity, 0) + 1
        pruned = self._born.keys() & set(increment.pruned_ids.tolist())
        self._died |= dict.fromkeys(pruned, frame)
        self.alive.append(len(self._born) - len(self._died))

    def lives(self, pipeline: SlamPipeline) -> list[Life]:
        database = pipeline.tracker.database
        missed = dict(zip(database.ids.tolist(), database.missed.tolist(), strict=True))
        return [
            Life(born, self._died.get(i), missed.get(i, 0), self._hit_after.get(i, 0))
            for i, born in self._born.items()
        ]


def _errors_without() -> tuple[FloatArray, float]:
    config = experiment("lab_loop", EVERY_FRAME)
    found = find_features(config)
    pipeline = make_system(config, found.sequence)
    for _ in process(found, pipeline):
        pass
    return position_errors(pipeline, found.sequence), ate_m(pipeline, found.sequence)


def _jump_table(run: PersonRun, without: tuple[FloatArray, float]) -> Table:
    errors, ate = without
    plain = np.linalg.norm(np.diff(errors, axis=0), axis=1)
    first = min(life.born for life in run.lives)
    walk = slice(max(first - 1, 0), run.last + 1)
    columns = ("", "with the person", "without")
    rows: list[tuple[Cell, ...]] = [
        _centimetres("largest jump, whole drive, cm", run.jumps_m, plain, slice(None)),
        _centimetres(
            f"largest jump, frames {first} to {run.last + 1}, cm", run.jumps_m, plain, walk
        ),
        ("ATE cm", 100.0 * run.ate_m, 100.0 * ate),
    ]
    note = "a jump is the change of the position error from one frame to the next"
    return Table("Pose while a person walks through the view", columns, rows, (note,))


def _centimetres(name: str, jumps: FloatArray, plain: FloatArray, part: slice) -> tuple[Cell, ...]:
    return (name, 100.0 * float(jumps[part].max()), 100.0 * float(plain[part].max()))


def _life_table(runs: dict[str, PersonRun]) -> Table:
    columns = [_life_column(run) for run in runs.values()]
    rows: list[tuple[Cell, ...]] = [
        (name, *(column[name] for column in columns)) for name in columns[0]
    ]
    return Table("Landmarks on the person", ("", *runs), rows)


def _life_column(run: PersonRun) -> dict[str, Cell]:
    died = np.array([life.died for life in run.lives if life.died is not None])
    n, stayed = run.prune_after, run.survivors
    left = sum(life.missed < n for life in stayed)
    frames = len(run.alive)
    return {
        "frames of the run": frames,
        "landmarks initiated on the person": len(run.lives),
        "last frame that shows the person": run.last,
        "dropped by the end": len(died),
        f"pruned at latest {n} frames after the person's last": int(np.sum(died <= run.last + n)),
        "frame of the last pruning": int(died.max()) if len(died) else None,
        "in the map at the end": len(stayed),
        f"... not expected in view {n} times in a row": left,
        "... matched to something else after the person": sum(x.hit_after > 0 for x in stayed),
        f"... expected and missed {n} times (must be 0)": sum(x.missed >= n for x in stayed),
    }


def _alive_table(runs: dict[str, PersonRun]) -> Table:
    after = (0, 5, 10, 15, 18, 19, 20, 25, 30, 50, 100, 200, 215)
    columns = ("frames after the person's last", *(str(k) for k in after))
    rows: list[tuple[Cell, ...]] = []
    for name, run in runs.items():
        known = [run.last + k for k in after]
        rows.append((name, *(int(run.alive[i]) if i < len(run.alive) else None for i in known)))
    return Table("The person's landmarks in the map", columns, rows)
