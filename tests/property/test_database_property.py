"""The landmarks' state machine against a model in plain Python."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from hypothesis import given, strategies as st
from simulated import RIG

from fgslam.core.types import StereoFeatures
from fgslam.frontend.settings import DatabaseSettings, PermanenceSettings
from fgslam.frontend.tracking.landmarks import LandmarkDatabase

TYPES = st.sampled_from(["I", "II", "III"])
FRAMES = st.lists(
    st.tuples(st.lists(TYPES, min_size=12, max_size=12), st.integers(0, 2)), max_size=30
)


@dataclass
class Entry:
    hits: int = 1
    misses: int = 0
    missed: int = 0
    permanent: bool = False


def some_features(count: int, seed: int) -> StereoFeatures:
    rng = np.random.default_rng(seed)
    return StereoFeatures(
        measurement=rng.uniform(1, 200, (count, 3)),
        measurement_covariance=np.tile(np.eye(3), (count, 1, 1)),
        scale=rng.uniform(1, 5, count),
        orientation=rng.uniform(0, 6, count),
        descriptors=rng.integers(0, 256, (count, 128)).astype(np.uint8),
        position=rng.uniform(1, 5, (count, 3)),
        position_covariance=np.tile(np.eye(3), (count, 1, 1)),
        pixels=np.zeros((count, 3, 2)),
    )


def entry_bits(database: LandmarkDatabase, row: int) -> bytes:
    views = database.appearances()
    columns = (views.size, views.orientation, views.descriptors, database.hits)
    columns += (database.misses, database.missed, database.colour)
    return b"".join(column[row].tobytes() for column in columns)


@given(FRAMES, st.integers(1, 4), st.booleans())
def test_types_I_to_IV(frames, limit, lasting) -> None:
    permanence = PermanenceSettings(ratio=0.5, hits=3) if lasting else None
    settings = DatabaseSettings(prune_after_misses=limit, permanence=permanence)
    database = LandmarkDatabase(RIG, settings, 40.0)
    model: dict[int, Entry] = {}
    next_id = 0
    for k, (types, new) in enumerate(frames):
        alive = sorted(model)
        kind = {i: types[n % len(types)] for n, i in enumerate(alive)}
        before = {i: entry_bits(database, n) for n, i in enumerate(alive)}
        hit = np.array([i for i in alive if kind[i] == "III"], np.int64)
        missed = np.array([i for i in alive if kind[i] == "II"], np.int64)
        found = some_features(len(hit) + new, k)
        database.record_hits(hit, found, np.arange(len(hit)))
        database.record_misses(missed)
        fresh = database.add(found, len(hit) + np.arange(new), np.full(new, k, np.uint8))
        assert fresh.tolist() == list(range(next_id, next_id + new))
        for i in hit.tolist():
            entry = model[i]
            entry.hits, entry.missed = entry.hits + 1, 0
            share = entry.hits / (entry.hits + entry.misses)
            entry.permanent |= lasting and entry.hits >= 3 and share > 0.5
        for i in missed.tolist():
            model[i].misses, model[i].missed = model[i].misses + 1, model[i].missed + 1
        model |= {i: Entry() for i in fresh.tolist()}
        next_id += new
        gone = sorted(i for i, e in model.items() if e.missed >= limit and not e.permanent)
        assert database.prune().tolist() == gone
        for i in gone:
            del model[i]
        assert database.ids.tolist() == sorted(model)
        assert database.permanent.tolist() == [model[i].permanent for i in sorted(model)]
        for row, i in enumerate(database.ids.tolist()):
            counts = (database.hits[row], database.misses[row], database.missed[row])
            assert counts == (model[i].hits, model[i].misses, model[i].missed)
            if kind.get(i) == "I":
                assert entry_bits(database, row) == before[i]
