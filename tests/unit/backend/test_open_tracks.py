"""Tracks in arrays are those that lists of sightings by landmark would be."""

from __future__ import annotations

import numpy as np

from fgslam.backend.open_tracks import ENDED_AFTER, LEAST_SIGHTINGS, LONGEST, OpenTracks
from fgslam.core.sensors import Observations
from fgslam.core.store import state_of, unpack


def test_tracks_end_as_lists_of_their_sightings_would(rng: np.random.Generator) -> None:
    tracks, lists = OpenTracks(), dict[int, list[int]]()
    judged = longest = 0
    for frame in range(150):
        ids = rng.permutation(40)[: rng.integers(0, 12) if frame % 50 else 0]
        ids = np.append(ids, 99) if frame < 2 * LONGEST else ids  # one that does not end
        count, none = len(ids), np.zeros(len(ids), np.bool_)
        measured = np.column_stack([np.full(count, frame), ids, ids]).astype(float)
        covariance, pixels = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3, 2))
        tracks.add(frame, Observations(ids, measured, covariance, pixels, none))
        for identity in ids.tolist():
            lists.setdefault(identity, []).append(frame)
        if frame % 7 == 0:
            state = state_of(tracks)
            tracks = unpack(state, OpenTracks)
            assert list(dict.fromkeys(state["ids"].tolist())) == list(lists)
        assert tracks.first_frame(frame) == min((one[0] for one in lists.values()), default=frame)
        if frame % 5:
            continue
        whole = frame == 75
        over = [
            identity
            for identity, seen in lists.items()
            if whole or len(seen) >= LONGEST or frame - seen[-1] > ENDED_AFTER
        ]
        rows, counts = tracks.take_all() if whole else tracks.take_ended(frame)
        ended = [(identity, lists.pop(identity)) for identity in over]
        ended = [(identity, seen) for identity, seen in ended if len(seen) >= LEAST_SIGHTINGS]
        assert counts.tolist() == [len(seen) for _, seen in ended]
        expected = [(k, identity) for identity, seen in ended for k in seen]
        assert list(zip(rows["frame"].tolist(), rows["ids"].tolist(), strict=True)) == expected
        assert [(k, i) for k, i, _ in rows["measurement"].tolist()] == expected
        judged, longest = judged + len(ended), max(longest, *counts, 0)
    assert judged > 20
    assert longest >= LONGEST
