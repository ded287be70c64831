"""Landmarks that last (docs/results): blocked cameras, who is permanent, who is demoted."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from benchmarks.evidence.person import position_errors
from benchmarks.runs import (
    EVERY_FRAME,
    FoundFeatures,
    ate_m,
    experiment,
    find_features,
    make_system,
    process,
)
from benchmarks.tables import Cell, Table
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.log import ImageSequence
from fgslam.core.saved_map import SavedMap
from fgslam.frontend.settings import PermanenceSettings
from fgslam.frontend.tracking.landmarks import reliable, seen_past
from fgslam.slam.pipeline import FrameReport, SlamPipeline

COVER = (110, 140)
VARIANTS: dict[str, tuple[str, ...]] = {
    "as committed": (),
    "permanent, blocked frames believed": ("frontend.database.permanence={blind_below: 0.0}",),
    "without permanence": ("frontend.database.permanence=null",),
}
# Nothing is pruned, so that every landmark's whole life is seen.
_KEEP_ALL = (*EVERY_FRAME, "frontend.database.prune_after_misses=1000000")
_ENOUGH = 10  # times expected, before its absence says anything
_LIMITS = (5, 10, 15, 20, 25)
_HITS = (3, 5, 10)


# --------------------------------------------------------------------------------------------
# Blocked cameras


@dataclass(frozen=True)
class BlockedRun:
    """The drive with covered cameras.

    Attributes:
        before, after: landmarks when the cover comes and when it goes.
        kept: of those before, how many the map still has after.
        found_at: first frame after the cover whose landmarks give the pose.
        drift_m: position error of the last blocked frame.
        error_m: position error ten frames after the cover is gone.
        ate_m, end_m: of the whole drive, first pose aligned for the latter.
    """

    before: int
    after: int
    kept: int
    found_at: int
    drift_m: float
    error_m: float
    ate_m: float
    end_m: float


def run_blocked(found: FoundFeatures, overrides: Iterable[str]) -> BlockedRun:
    """Runs `experiments/blocked_view.yaml` over features found before."""
    pipeline = make_system(experiment("blocked_view", overrides), found.sequence)
    maps: dict[int, IntArray] = {}
    measured: list[int] = []
    for k, report in enumerate(process(found, pipeline)):
        if k in (COVER[0] - 1, COVER[1] - 1):
            maps[k] = pipeline.tracker.database.ids.copy()
        if k >= COVER[1] and report.tracking.status.measured:
            measured.append(k)
    before, after = maps[COVER[0] - 1], maps[COVER[1] - 1]
    errors = np.linalg.norm(position_errors(pipeline, found.sequence), axis=1)
    return BlockedRun(
        before=len(before),
        after=len(after),
        kept=int(np.isin(before, after).sum()),
        found_at=measured[0],
        drift_m=float(errors[COVER[1] - 1]),
        error_m=float(errors[COVER[1] + 9]),
        ate_m=ate_m(pipeline, found.sequence),
        end_m=float(errors[-1]),
    )


def blocked_features() -> FoundFeatures:
    """Of the drive with the cover."""
    return find_features(experiment("blocked_view"))


def blocked_table() -> Table:
    """The committed experiment beside others."""
    found = blocked_features()
    rows: list[tuple[Cell, ...]] = []
    for name, overrides in VARIANTS.items():
        run = run_blocked(found, overrides)
        cells = (run.before - run.kept, run.found_at, 100.0 * run.drift_m, 100.0 * run.error_m)
        rows.append((name, run.before, *cells, 100.0 * run.ate_m, 100.0 * run.end_m))
    columns = (
        "", "landmarks when the cover comes", "of them lost under it", "located again at frame",
        "error when it goes, cm", "ten frames on, cm", "ATE cm", "end error cm",
    )  # fmt: skip
    note = f"the cover is on the cameras in frames {COVER[0]} to {COVER[1] - 1}"
    return Table("Cameras blocked for 30 frames", columns, rows, (note,))


# --------------------------------------------------------------------------------------------
# Two visits: what is known of landmarks after the first, and what the second makes of it


@dataclass(eq=False)
class Lives:
    """Hits, misses and contradictions of the landmarks of the first visit, in one visit.

    Attributes:
        hits, misses: (n,) by identity.
        missed: (n,) longest row of misses.
        contradicted: (n,) most contradictions without a hit between.
        best: for each number of hits, the best n/(n+m) (n,) at a hit from that number on.
    """

    count: int
    settings: PermanenceSettings = field(default_factory=PermanenceSettings)

    def __post_init__(self) -> None:
        """All counts start at zero."""
        zeros = np.zeros(self.count, np.int64)
        self.hits, self.misses = zeros.copy(), zeros.copy()
        self.missed, self.contradicted = zeros.copy(), zeros.copy()
        self._missed, self._contradicted = zeros.copy(), zeros.copy()
        self.best = {hits: np.zeros(self.count) for hits in _HITS}

    def follow(self, report: FrameReport, places: FloatArray) -> None:
        """One frame; ``places`` (m, 3) are where the missed ones were expected."""
        increment = report.increment
        ids = increment.missed_ids
        against = seen_past(places, report.stereo.measurement)
        against |= np.isin(ids, increment.observations.ids[increment.rejected])
        known = ids < self.count
        self.misses[ids[known]] += 1
        self._missed[ids[known]] += 1
        self._contradicted[ids[known & against]] += 1
        hits = increment.observations.ids[~increment.rejected]
        hits = hits[hits < self.count]
        self.hits[hits] += 1
        self._missed[hits] = self._contradicted[hits] = 0
        share = self.hits[hits] / (self.hits[hits] + self.misses[hits])
        for least, best in self.best.items():
            enough = self.hits[hits] >= least
            best[hits[enough]] = np.maximum(best[hits[enough]], share[enough])
        np.maximum(self.missed, self._missed, out=self.missed)
        np.maximum(self.contradicted, self._contradicted, out=self.contradicted)


@dataclass(frozen=True, eq=False)
class Visits:
    """The first visit, and two second ones: to the same room, and to one rearranged."""

    first: Lives
    same: Lives
    moved: Lives


def visit_twice() -> Visits:
    """Drives three times; the latter two in the map of the first."""
    found = find_features(experiment("lab_loop", EVERY_FRAME))
    pipeline = make_system(experiment("lab_loop", _KEEP_ALL), found.sequence)
    reports = list(_with_places(found, pipeline))
    lives = Lives(int(pipeline.tracker.database.next_id))
    for report, places in reports:
        lives.follow(report, places)
    saved = _map_of(pipeline, found.sequence)
    del reports
    again = [_second(saved, lives.count, ("seed=1", *more)) for more in ((), ("dataset.visit=2",))]
    return Visits(lives, *again)


def _second(saved: SavedMap, count: int, overrides: tuple[str, ...]) -> Lives:
    found = find_features(experiment("lab_loop", overrides))
    pipeline = make_system(experiment("lab_loop", (*_KEEP_ALL, *overrides)), found.sequence)
    pipeline.tracker.database.load(saved)
    pipeline.estimator.begin_in(saved.landmarks, saved.hits, fixed=False)  # type: ignore[attr-defined]
    lives = Lives(count)
    for report, places in _with_places(found, pipeline):
        lives.follow(report, places)
    return lives


def _with_places(
    found: FoundFeatures, pipeline: SlamPipeline
) -> Iterator[tuple[FrameReport, FloatArray]]:
    """Reports, with the predicted (column, row, disparity) (m, 3) of the missed landmarks."""
    database = pipeline.tracker.database
    for report in process(found, pipeline):
        expected = database.expected(pipeline.estimator.landmarks(), report.tracking.wTc)
        at = np.searchsorted(expected.ids, report.increment.missed_ids)
        # The pose has moved on by the tracking since they were expected: some left the view.
        at = np.minimum(at, len(expected) - 1)
        still = expected.ids[at] == report.increment.missed_ids
        yield report, np.where(still[:, None], expected.measurement[at], np.nan)


def _map_of(pipeline: SlamPipeline, sequence: ImageSequence) -> SavedMap:
    database, estimate = pipeline.tracker.database, pipeline.estimator.estimate()
    return SavedMap(
        sequence.rig, estimate.landmarks, database.appearances(), database.hits.copy(),
        database.misses.copy(), database.farthest.copy(), database.permanent.copy(),
        database.colour.copy(),
        estimate.trajectory, {}, np.empty(0, np.int64),
    )  # fmt: skip


def permanence_table(visits: Visits) -> Table:
    """How many landmarks each threshold makes permanent, and how they do in the second visit."""
    first, again = visits.first, visits.same
    rows: list[tuple[Cell, ...]] = []
    for hits in _HITS:
        for ratio in (0.2, 0.3, 0.4, 0.5, 0.6):
            settings = PermanenceSettings(ratio=ratio, hits=hits)
            at_the_end = reliable(first.hits, first.misses, settings)
            underway = first.best[hits] > ratio
            rows.append(
                (hits, ratio, *_found_again(at_the_end, again), *_found_again(underway, again))
            )
    columns = (
        "hits", "ratio", "permanent at the end", "never found again", "median n/(n+m)",
        "permanent underway", "never found again ", "median n/(n+m) ",
    )  # fmt: skip
    return Table("Permanence: thresholds, in a second visit to the same room", columns, rows)


def _found_again(chosen: BoolArray, again: Lives) -> tuple[int, float, float]:
    """How many were chosen; of those expected again, share never found, and median n/(n+m)."""
    expected = again.hits + again.misses
    judged = chosen & (expected >= 5)
    share = again.hits[judged] / expected[judged]
    return int(chosen.sum()), float((share == 0.0).mean()), float(np.median(share))


def demotion_table(visits: Visits) -> Table:
    """How often true landmarks, and those that are gone, are contradicted."""
    chosen = reliable(visits.first.hits, visits.first.misses, PermanenceSettings())
    gone = chosen & (visits.same.hits > 0) & (visits.moved.hits == 0)
    gone &= visits.moved.misses >= _ENOUGH
    rows: list[tuple[Cell, ...]] = []
    for name, which, lives in (
        ("same room", chosen, visits.same),
        ("rearranged room, found again", chosen & (visits.moved.hits > 0), visits.moved),
        ("rearranged room, never found again", gone, visits.moved),
    ):
        rows.append(_shares(name, which, lives))
    columns = (
        "landmarks that last", "how many",
        *(f"contradicted {limit} times" for limit in _LIMITS), "missed 20 times in a row",
    )  # fmt: skip
    notes = (
        "contradicted or missed without a hit between",
        "of those never found again many are hidden by what now stands before them",
    )
    return Table("Demotion: share of permanent landmarks", columns, rows, notes)


def _shares(name: str, which: BoolArray, lives: Lives) -> tuple[Cell, ...]:
    shares = [float((lives.contradicted[which] >= limit).mean()) for limit in _LIMITS]
    return (name, int(which.sum()), *shares, float((lives.missed[which] >= 20).mean()))


def tables() -> list[Table]:
    """All of them."""
    visits = visit_twice()
    return [blocked_table(), permanence_table(visits), demotion_table(visits)]
