"""The second visit in the first one's map: what moved leaves it, and the path is as good."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from benchmarks.runs import experiment, say
from benchmarks.tables import Table
from fgslam.core.arrays import BoolArray
from fgslam.core.saved_map import SavedMap, load_map
from fgslam.datasets.rendered import RenderedLabSequence
from fgslam.runs.engine import run_task
from fgslam.runs.tasks.slam import SlamResult, first_config, open_slam
from fgslam.runs.tasks.slam_map_entry import MAP_FILE
from fgslam.worlds.patches import Thing
from fgslam.worlds.places import build_lab

EXPERIMENT = "two_visits"
UNCHANGED = "nothing moved"
VISITS = {
    UNCHANGED: ("dataset.visit=1",),
    "chairs, cartons, plotter moved": ("dataset.visit=2",),
    "the same, demoted after 10": (
        "dataset.visit=2",
        "frontend.database.permanence.contradicted_after=10",
    ),
    "the same, map left as it is": ("dataset.visit=2", "map.extend=false"),
    "shelves and posters exchanged, too": ("dataset.visit=3",),
}


@dataclass(frozen=True, eq=False)
class FirstVisit:
    """The map of the first visit, and the thing that each of its landmarks is on."""

    path: Path
    saved: SavedMap
    things: npt.NDArray[np.str_]


@dataclass(frozen=True, eq=False)
class SecondVisit:
    """What became of the path and of the map.

    Attributes:
        ate_m: absolute trajectory error.
        moved: (n,) which landmarks of the first map are on things that were moved.
        there: (n,) which are still in the map.
        permanent: (n,) which are so, and still permanent.
    """

    ate_m: float
    moved: BoolArray
    there: BoolArray
    permanent: BoolArray


def first_visit(folder: Path) -> FirstVisit:
    """Drives the first visit into ``folder``, which must exist."""
    config = first_config(experiment(EXPERIMENT), folder)
    if config is None:
        raise ValueError(f"{EXPERIMENT} makes no map of its own")
    say("the first visit")
    result = run_task(open_slam, config, folder / "run")
    saved = load_map(folder / MAP_FILE)
    return FirstVisit(folder / MAP_FILE, saved, _things(result, saved))


def second_visit(first: FirstVisit, overrides: tuple[str, ...]) -> SecondVisit:
    """Drives a second visit in the map of the first."""
    given = ("map.made_from=null", f"map.load={first.path}")
    config = experiment(EXPERIMENT, [*given, *overrides])
    say(f"the second visit: {', '.join(overrides)}")
    with tempfile.TemporaryDirectory() as folder:
        result = run_task(open_slam, config, Path(folder) / "run")
    database = result.outputs.pipeline.tracker.database
    ids = first.saved.landmarks.ids
    there = np.isin(ids, database.ids)
    visit = getattr(config.dataset, "visit", 1)
    ate_m = result.live.ate_rmse_m
    return SecondVisit(
        ate_m=float("nan") if ate_m is None else ate_m,
        moved=np.isin(first.things, _moved_things(visit)),
        there=there,
        permanent=np.isin(ids, database.ids[database.permanent]) & first.saved.permanent,
    )


def tables() -> list[Table]:
    """One row a visit."""
    rows: list[tuple[str | int | float | None, ...]] = []
    with tempfile.TemporaryDirectory() as folder:
        first = first_visit(Path(folder))
        lasting = first.saved.permanent
        for name, overrides in VISITS.items():
            found = second_visit(first, overrides)
            moved, stayed = found.moved & lasting, ~found.moved & lasting
            rows.append(
                (
                    name,
                    100.0 * found.ate_m,
                    int(found.moved.sum()),
                    _percent(~found.there, found.moved),
                    int(moved.sum()),
                    _percent(~found.permanent, moved),
                    int(stayed.sum()),
                    _percent(~found.permanent, stayed),
                )
            )
    columns = (
        "second visit",
        "ATE cm",
        "on what moved",
        "of these gone %",
        "permanent on what moved",
        "of these gone or demoted %",
        "permanent elsewhere",
        "of these gone or demoted % ",
    )
    return [Table("Two visits", columns, rows)]


def _percent(which: BoolArray, among: BoolArray) -> float | None:
    return 100.0 * float(which[among].mean()) if among.any() else None


def _things(result: SlamResult, saved: SavedMap) -> npt.NDArray[np.str_]:
    """(n,) the thing under each landmark's first sighting."""
    sequence = result.outputs.sequence
    if not isinstance(sequence, RenderedLabSequence):
        raise TypeError(f"{EXPERIMENT} needs the rendered lab, which knows its things")
    names, found = sequence.object_names, dict.fromkeys(saved.landmarks.ids.tolist(), "")
    for i, increment in enumerate(result.outputs.recorder.log):
        new = increment.observations.select(increment.observations.is_new)
        new = new.select(np.isin(new.ids, saved.landmarks.ids))
        if len(new):
            under = sequence.object_ids(i)
            at = np.rint(new.measurement[:, :2]).astype(int)
            column = np.clip(at[:, 0], 0, under.shape[1] - 1)
            row = np.clip(at[:, 1], 0, under.shape[0] - 1)
            numbers = zip(new.ids.tolist(), under[row, column].tolist(), strict=True)
            found |= {identity: names[number] for identity, number in numbers}
    return np.array(list(found.values()))


def _moved_things(visit: int) -> list[str]:
    """Names of the things that stand elsewhere at this visit than at the first."""
    before, after = (
        {thing.name: thing for thing in build_lab(np.random.default_rng(0), v).things}
        for v in (1, visit)
    )
    return [name for name, thing in before.items() if not _same_place(thing, after[name])]


def _same_place(one: Thing, other: Thing) -> bool:
    corners = zip(one.patches, other.patches, strict=True)
    return all(np.allclose(a.corner, b.corner) for a, b in corners)
