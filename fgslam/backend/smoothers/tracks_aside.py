"""Tracks of landmarks that have left a bounded lag as plain arrays, and back: out of memory."""

from __future__ import annotations

import numpy as np

from fgslam.backend.smoothers.admission import (
    CONTRADICTED_AFTER,
    LandmarkAdmission,
    Sighting,
    Track,
)
from fgslam.core.arrays import FloatArray, IntArray, StateArrays

_BEFORE = CONTRADICTED_AFTER - 1  # rejected sightings that the next one is compared with


def arrays_of(admission: LandmarkAdmission, ids: IntArray) -> StateArrays:
    """Tracks of landmarks (n,) that wait outside the graph and have left the lag.

    The sightings while they wait are left out: they would not count any more.
    """
    tracks = [admission.tracks.get(identity) for identity in ids.tolist()]
    known = np.array([track is not None for track in tracks], np.bool_)
    of = [track for track in tracks if track is not None]
    left = [track.left_at for track in of]
    elsewhere = [track.elsewhere[-_BEFORE:] for track in of]
    against = [one for each in elsewhere for one in each]
    return {
        "known": known,
        "least_parallax": np.array([t.least_parallax for t in of], np.float64),
        "sightings": np.array([t.sightings for t in of], np.int64),
        "last_frame": np.array([t.last.frame for t in of], np.int64),
        "last_measurement": _stacked([t.last.measurement for t in of], (3,)),
        "last_covariance": _stacked([t.last.covariance for t in of], (3, 3)),
        "left": np.array([one is not None for one in left], np.bool_),
        "left_place": _stacked([one[0] for one in left if one is not None], (3,)),
        "left_covariance": _stacked([one[1] for one in left if one is not None], (3, 3)),
        "against": np.array([len(each) for each in elsewhere], np.int64),
        "against_place": _stacked([one[0] for one in against], (3,)),
        "against_covariance": _stacked([one[1] for one in against], (3, 3)),
    }


def tracks_of(arrays: StateArrays, ids: IntArray) -> dict[int, Track]:
    """Tracks back from :func:`arrays_of`, by identity."""
    found = ids[arrays["known"]]
    left = iter(zip(arrays["left_place"], arrays["left_covariance"], strict=True))
    against = iter(zip(arrays["against_place"], arrays["against_covariance"], strict=True))
    out = {}
    for row, identity in enumerate(found.tolist()):
        last = Sighting(
            int(arrays["last_frame"][row]),
            arrays["last_measurement"][row],
            arrays["last_covariance"][row],
        )
        out[identity] = Track(
            float(arrays["least_parallax"][row]),
            last,
            sightings=int(arrays["sightings"][row]),
            elsewhere=[next(against) for _ in range(int(arrays["against"][row]))],
            left_at=next(left) if arrays["left"][row] else None,
        )
    return out


def _stacked(rows: list[FloatArray], shape: tuple[int, ...]) -> FloatArray:
    return np.array(rows, np.float64).reshape(len(rows), *shape)
