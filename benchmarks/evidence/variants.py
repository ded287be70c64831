"""Variants of the system against each other (docs/results), on equal features."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.runs import (
    DATA,
    FoundFeatures,
    ate_m,
    experiment,
    find_features,
    make_system,
    process,
    say,
)
from benchmarks.tables import Cell, Table

PAPER_LITERALLY = (
    "frontend.tracking=sift",
    "frontend.appearance.mode=paper",
    "frontend.stereo.measurement=paper",
    "frontend.matching.widen_sigmas=0",
    "frontend.matching.refine=false",
    "frontend.matching.rescue=false",
    "frontend.database.field_of_view=cone",
    "frontend.ego_motion.residuals=image",
    "frontend.ego_motion.weighting=uniform",
    "frontend.ego_motion.prior=false",
    "frontend.ego_motion.kernel=none",
    "frontend.ego_motion.outlier_sigmas=0",
)
"""Sections 2 to 4 as printed; averaging and degrees of freedom are added where they are used."""

VARIANTS: dict[str, tuple[str, ...]] = {
    "default": (),
    "`appearance: paper`": ("frontend.appearance.mode=paper",),
    "`update: world`": ("estimator.update=world",),
    "`update: running_mean`": ("estimator.update=running_mean",),
    "`update: half`": ("estimator.update=half",),
    "`pose_covariance: false`": ("estimator.pose_covariance=false",),
    "`weighting: measurement`": ("frontend.ego_motion.weighting=measurement",),
    "`weighting: uniform`": ("frontend.ego_motion.weighting=uniform",),
    "`residuals: image`": ("frontend.ego_motion.residuals=image",),
    "`prior: false`": ("frontend.ego_motion.prior=false",),
    "`kernel: none`": ("frontend.ego_motion.kernel=none",),
    "`measurement: paper`": ("frontend.stereo.measurement=paper",),
    "`widen_sigmas: 0`": ("frontend.matching.widen_sigmas=0",),
    "`field_of_view: cone`": ("frontend.database.field_of_view=cone",),
    "the paper literally, `running_mean`": (*PAPER_LITERALLY, "estimator.update=running_mean"),
    "the paper literally, `half`": (*PAPER_LITERALLY, "estimator.update=half"),
}
_PAIRED = (
    "default",
    "`appearance: paper`",
    "`update: world`",
    "`update: running_mean`",
    "`update: half`",
    "`field_of_view: cone`",
)
_FIXED_HEIGHT = "frontend.ego_motion.dof=5"
_NO_ODOMETRY = "odometry.kind=constant_velocity"


@dataclass(frozen=True)
class Course:
    """A recording on which the variants run, once a seed."""

    title: str
    experiment: str
    overrides: tuple[str, ...] = ()
    seeds: tuple[int, ...] = (0,)


COURSES = (
    Course("lab, 3 dof", "lab_loop", (), (0, 1, 2)),
    Course("lab, 5 dof", "lab_loop", (_FIXED_HEIGHT,), (0, 1, 2)),
    Course("euroc_v101", "euroc_v101", (), (0,)),
    Course("kitti_raw_0926, no odometry", "kitti_raw_0926", (_NO_ODOMETRY,)),
    Course("kitti06", "kitti06"),
)


@dataclass(frozen=True)
class Outcome:
    """ATE in metres and the share of frames tracked, means over the seeds."""

    ate_m: float
    tracked: float

    def shown(self) -> str:
        """In centimetres, with the share of frames tracked where it is not all."""
        lost = "" if self.tracked > 0.9999 else f" ({100.0 * self.tracked:.0f} %)"
        return f"{100.0 * self.ate_m:.2f}{lost}"


def table(data: Path = DATA) -> Table:
    """One row a variant, one column a course: ATE in centimetres."""
    results = [_on_course(course, data) for course in COURSES]
    rows: list[tuple[Cell, ...]] = [
        (name, *(result[name].shown() for result in results)) for name in VARIANTS
    ]
    notes = (
        "in brackets: share of frames whose pose was measured, where it is not all of them; the "
        "other poses are the prediction",
        "lab: mean of seeds 0, 1 and 2; ATE after SE3 alignment",
    )
    columns = ("variant, ATE cm", *(course.title for course in COURSES))
    return Table("One change at a time", columns, rows, notes)


def paired_table(seeds: Iterable[int] = range(1, 11)) -> Table:
    """Are the differences in the lab more than chance? The same ten seeds for each variant."""
    ates: dict[str, list[float]] = {name: [] for name in _PAIRED}
    for seed in seeds:
        base = [f"seed={seed}"]
        found = find_features(experiment("lab_loop", base))
        for name in _PAIRED:
            changes = [*base, *VARIANTS[name]]
            ates[name].append(100.0 * outcome("lab_loop", changes, found).ate_m)
    default = np.array(ates["default"])
    rows: list[tuple[Cell, ...]] = []
    for name, values in ates.items():
        less = np.array(values) - default
        error = float(less.std(ddof=1) / np.sqrt(len(less)))
        rows.append((name, float(np.mean(values)), float(max(values)), float(less.mean()), error))
    columns = ("variant", "mean ATE cm", "worst", "less the default's", "its standard error")
    return Table("Ten seeds, paired", columns, rows)


def _on_course(course: Course, data: Path) -> dict[str, Outcome]:
    outcomes: dict[str, list[Outcome]] = {name: [] for name in VARIANTS}
    for seed in course.seeds:
        base = (*course.overrides, f"seed={seed}")
        found = find_features(experiment(course.experiment, base, data))
        for name, changes in VARIANTS.items():
            outcomes[name].append(outcome(course.experiment, [*base, *changes], found, data))
        say(f"{course.title}, seed {seed}: done")
    return {name: _mean(of_seeds) for name, of_seeds in outcomes.items()}


def outcome(
    name: str, overrides: Iterable[str], found: FoundFeatures, data: Path = DATA
) -> Outcome:
    """Runs one variant of an experiment on features found before.

    The features must have been found with the same SIFT settings, descriptors included.
    """
    config = experiment(name, overrides, data)
    pipeline = make_system(config, found.sequence)
    measured = [report.tracking.status.measured for report in process(found, pipeline)][1:]
    return Outcome(ate_m(pipeline, found.sequence), float(np.mean(measured)))


def _mean(outcomes: list[Outcome]) -> Outcome:
    return Outcome(
        float(np.mean([o.ate_m for o in outcomes])), float(np.mean([o.tracked for o in outcomes]))
    )
