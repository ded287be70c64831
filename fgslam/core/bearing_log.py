"""The bearing log: all that a homing estimator consumes, replayable without images.

One uncompressed ``.npz`` (:mod:`fgslam.core.store`), like the measurement log. Rows of image
``k`` are ``image_start[k]:image_start[k + 1]``.
"""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.core.arrays import StateArrays
from fgslam.core.errors import MeasurementLogError
from fgslam.core.homing import (
    BearingMatches,
    HomingStart,
    HomingTruth,
    LocalMap,
    TrackedBearings,
    TwoViewVector,
)
from fgslam.core.store import (
    ArrayFile,
    Items,
    by_field,
    fields_from,
    joined,
    of_rows,
    offsets,
    require_covariances,
    require_finite,
    require_single,
    rows_of,
    write_arrays,
)

LOG = ArrayFile(
    name="fgslam bearing log",
    versions=(1,),
    error=MeasurementLogError,
    give="give a run folder's bearings.npz",
    again="run again",
)

# Arrays by the count that their first axis has, with type and the shape of an item.
_FEATURE: Items = {
    "map_ids": ("i", ()),
    "map_bearing": ("f", ()),
    "map_distance": ("f", ()),
    "map_covariance": ("f", (2, 2)),
    "match_kind": ("i", ()),
    "match_index_a": ("i", ()),
    "match_index_b": ("i", ()),
    "match_bearing_a": ("f", ()),
    "match_elevation_a": ("f", ()),
    "match_bearing_b": ("f", ()),
    "match_elevation_b": ("f", ()),
    "match_sigma": ("f", (4,)),
    "match_quality": ("f", ()),
}
_SIGHTING: Items = {
    "image_ids": ("i", ()),
    "image_bearing": ("f", ()),
    "image_sigma_bearing": ("f", ()),
    "image_elevation": ("f", ()),
    "image_sigma_elevation": ("f", ()),
}
_WHOLE: Items = {
    "start_time": ("f", ()),
    "vector": ("f", (2,)),
    "vector_covariance": ("f", (2, 2)),
    "vector_rival_support": ("i", ()),
}


_TRACKED = [field.name for field in dataclasses.fields(TrackedBearings)][1:]
"""What an image holds of its features; its time comes first."""


@dataclass(slots=True, eq=False)
class BearingLog:
    """One homing.

    Attributes:
        start: what the estimator was made with.
        images: what it was given, time increasing.
        truth: of a simulated homing; its robots are those of the images.
        provenance: where all this comes from; plain JSON values.
    """

    start: HomingStart
    images: list[TrackedBearings] = field(default_factory=list)
    truth: HomingTruth | None = None
    provenance: dict[str, Any] = field(default_factory=dict)

    def to_arrays(self) -> StateArrays:
        """The log as the arrays of its file."""
        vector, start = self.start.vector, self.start
        out = LOG.header(provenance=self.provenance) | {
            "start_time": np.array(start.time, np.float64),
            "vector": np.array([vector.direction, vector.rotation]),
            "vector_covariance": vector.covariance,
            "vector_inliers": vector.inliers,
            "vector_rival_support": np.array(vector.competing_support, np.int64),
            "image_time": np.array([image.time for image in self.images], np.float64),
            "image_start": offsets([len(image) for image in self.images]),
        }
        out |= by_field(start.local_map, "map_") | by_field(start.matches, "match_")
        for name in _TRACKED:
            parts = [getattr(image, name) for image in self.images]
            out[f"image_{name}"] = joined(parts, (), np.int64 if name == "ids" else np.float64)
        if self.truth is not None:
            out |= by_field(self.truth, "truth_")
        return out

    @staticmethod
    def from_arrays(arrays: StateArrays, where: str) -> BearingLog:
        """The log back from its arrays; ``where`` names the source in messages.

        Raises:
            MeasurementLogError: foreign, of an unknown version, or damaged.
        """
        provenance = _read_provenance(arrays, where)
        _require_consistent(arrays, where)
        vector = TwoViewVector(
            direction=float(arrays["vector"][0]),
            rotation=float(arrays["vector"][1]),
            covariance=arrays["vector_covariance"],
            inliers=arrays["vector_inliers"],
            competing_support=int(arrays["vector_rival_support"]),
        )
        local_map = LocalMap(**fields_from(LocalMap, arrays, "map_"))
        matches = BearingMatches(**fields_from(BearingMatches, arrays, "match_"))
        truth = None
        if "truth_target" in arrays:
            truth = HomingTruth(**fields_from(HomingTruth, arrays, "truth_"))
        start = HomingStart(float(arrays["start_time"]), vector, local_map, matches)
        return BearingLog(start, _images(arrays), truth, provenance)

    def save(self, path: Path) -> None:
        """Writes the log, whole or not at all. Raises OutputError when it cannot be written."""
        write_arrays(path, self.to_arrays())

    @staticmethod
    def load(path: Path) -> BearingLog:
        """Reads a log. Raises MeasurementLogError for a missing, truncated or foreign file."""
        return BearingLog.from_arrays(LOG.load(path), str(path))


def _images(arrays: StateArrays) -> list[TrackedBearings]:
    out = []
    for k, (low, high) in enumerate(itertools.pairwise(arrays["image_start"])):
        parts = (arrays[f"image_{name}"][low:high] for name in _TRACKED)
        out.append(TrackedBearings(float(arrays["image_time"][k]), *parts))
    return out


def _read_provenance(arrays: StateArrays, where: str) -> dict[str, Any]:
    provenance = LOG.read_header(arrays, where).get("provenance")
    if not isinstance(provenance, dict):
        raise MeasurementLogError(f"{where}: the log's header has no provenance; run again")
    return provenance


def _require_consistent(arrays: StateArrays, where: str) -> None:
    """Raises MeasurementLogError unless all arrays are there, of the right type and size."""
    features, images = rows_of(arrays, "map_ids"), rows_of(arrays, "image_time")
    seen = LOG.require_offsets(arrays, "image_start", images, where)
    found = rows_of(arrays, "vector_inliers")
    expected = dict(_WHOLE) | of_rows(features, _FEATURE) | of_rows(seen, _SIGHTING)
    expected |= {"vector_inliers": ("b", (found,)), "image_time": ("f", (images,))}
    if any(name.startswith("truth_") for name in arrays):
        expected["truth_target"] = ("f", (3,))
        expected["truth_robots"] = ("f", (images, 3))
        expected["truth_landmarks"] = ("f", (features, 2))
    LOG.require(arrays, expected, where)
    known = ("start_time", "image_time", "vector", "map_bearing", "image_bearing")
    require_finite(LOG, arrays, (*known, "image_sigma_bearing"), where)
    vector = arrays["vector_covariance"][None]
    require_covariances(LOG, "vector_covariance", vector, where, definite=False)
    require_single(LOG, "map_ids", arrays["map_ids"], offsets([features]), where)
    require_single(LOG, "image_ids", arrays["image_ids"], arrays["image_start"], where)
    if not (arrays["image_sigma_bearing"] > 0.0).all():
        raise MeasurementLogError(f"{where}: a deviation of a bearing is not positive; run again")
    times = np.append(arrays["start_time"], arrays["image_time"])
    if not (np.diff(times) > 0.0).all():
        raise MeasurementLogError(f"{where}: times of the images do not increase; run again")
