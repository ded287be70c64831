"""The bearing log: all that a homing estimator consumes, replayable without images.

One uncompressed ``.npz`` of plain arrays (no pickle), like the measurement log. Rows of image
``k`` are ``image_start[k]:image_start[k + 1]``.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
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
from fgslam.core.measurement_log import load_arrays

FORMAT = "fgslam bearing log"
VERSION = 1

# Arrays by the count that their first axis has, with type and the shape of an item.
_FEATURE: dict[str, tuple[str, tuple[int, ...]]] = {
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
_SIGHTING: dict[str, tuple[str, tuple[int, ...]]] = {
    "image_ids": ("i", ()),
    "image_bearing": ("f", ()),
    "image_sigma_bearing": ("f", ()),
    "image_elevation": ("f", ()),
    "image_sigma_elevation": ("f", ()),
}
_WHOLE: dict[str, tuple[str, tuple[int, ...]]] = {
    "start_time": ("f", ()),
    "vector": ("f", (2,)),
    "vector_covariance": ("f", (2, 2)),
    "vector_rival_support": ("i", ()),
}


@dataclass(slots=True, eq=False)
class BearingLog:
    """One homing.

    Attributes:
        start: what the estimator was made with.
        images: what it was told, time increasing.
        truth: of a simulated homing; its robots are those of the images.
        provenance: where all this comes from; plain JSON values.
    """

    start: HomingStart
    images: list[TrackedBearings] = field(default_factory=list)
    truth: HomingTruth | None = None
    provenance: dict[str, Any] = field(default_factory=dict)

    def to_arrays(self) -> StateArrays:
        """The log as the arrays of its file."""
        header = {"format": FORMAT, "version": VERSION, "provenance": self.provenance}
        vector, chart, matches = self.start.vector, self.start.local_map, self.start.matches
        sizes = np.array([0, *(len(image) for image in self.images)], np.int64)
        out: StateArrays = {
            "header": np.array(json.dumps(header, sort_keys=True)),
            "start_time": np.array(self.start.time, np.float64),
            "vector": np.array([vector.direction, vector.rotation]),
            "vector_covariance": vector.covariance,
            "vector_inliers": vector.inliers,
            "vector_rival_support": np.array(vector.competing_support, np.int64),
            "image_time": np.array([image.time for image in self.images], np.float64),
            "image_start": np.cumsum(sizes),
        }
        out |= {f"map_{name}": getattr(chart, name) for name in _names(LocalMap)}
        out |= {f"match_{name}": getattr(matches, name) for name in _names(BearingMatches)}
        for name in _names(TrackedBearings)[1:]:
            kind = np.int64 if name == "ids" else np.float64
            parts = [getattr(image, name) for image in self.images]
            out[f"image_{name}"] = np.concatenate([np.empty(0, kind), *parts])
        if self.truth is not None:
            out |= {f"truth_{n}": getattr(self.truth, n) for n in _names(HomingTruth)}
        return out

    @staticmethod
    def from_arrays(arrays: StateArrays, where: str) -> BearingLog:
        """The log back from its arrays; ``where`` names the source in messages.

        Raises:
            MeasurementLogError: foreign, of an unknown version, or damaged.
        """
        provenance = _read_header(arrays, where)
        _require_consistent(arrays, where)
        vector = TwoViewVector(
            direction=float(arrays["vector"][0]),
            rotation=float(arrays["vector"][1]),
            covariance=arrays["vector_covariance"],
            inliers=arrays["vector_inliers"],
            competing_support=int(arrays["vector_rival_support"]),
        )
        chart = LocalMap(*(arrays[f"map_{name}"] for name in _names(LocalMap)))
        matches = BearingMatches(*(arrays[f"match_{name}"] for name in _names(BearingMatches)))
        truth = None
        if "truth_target" in arrays:
            truth = HomingTruth(*(arrays[f"truth_{name}"] for name in _names(HomingTruth)))
        start = HomingStart(float(arrays["start_time"]), vector, chart, matches)
        return BearingLog(start, _images(arrays), truth, provenance)

    @staticmethod
    def load(path: Path) -> BearingLog:
        """Reads a log. Raises MeasurementLogError for a missing, truncated or foreign file."""
        return BearingLog.from_arrays(load_arrays(path), str(path))


def _names(kind: type) -> list[str]:
    return [f.name for f in dataclasses.fields(kind)]


def _images(arrays: StateArrays) -> list[TrackedBearings]:
    out = []
    for k, (low, high) in enumerate(itertools.pairwise(arrays["image_start"])):
        parts = (arrays[f"image_{name}"][low:high] for name in _names(TrackedBearings)[1:])
        out.append(TrackedBearings(float(arrays["image_time"][k]), *parts))
    return out


def _read_header(arrays: StateArrays, where: str) -> dict[str, Any]:
    try:
        header = json.loads(str(arrays["header"]))
    except (KeyError, json.JSONDecodeError):
        header = {}
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise MeasurementLogError(f"{where}: not an fgslam bearing log; give bearings.npz")
    if header.get("version") != VERSION:
        raise MeasurementLogError(
            f"{where}: bearing log of version {header.get('version')}, this fgslam reads version "
            f"{VERSION}; repeat the run or use the matching fgslam"
        )
    provenance = header.get("provenance")
    if not isinstance(provenance, dict):
        raise MeasurementLogError(f"{where}: the log's header has no provenance; run again")
    return provenance


def _require_consistent(arrays: StateArrays, where: str) -> None:
    """Raises MeasurementLogError unless all arrays are there, of the right type and size."""
    features, images = _length(arrays, "map_ids"), _length(arrays, "image_time")
    seen, found = _length(arrays, "image_ids"), _length(arrays, "vector_inliers")
    expected = dict(_WHOLE)
    expected |= {name: (kind, (features, *item)) for name, (kind, item) in _FEATURE.items()}
    expected |= {name: (kind, (seen, *item)) for name, (kind, item) in _SIGHTING.items()}
    expected |= {"vector_inliers": ("b", (found,)), "image_time": ("f", (images,))}
    expected["image_start"] = ("i", (images + 1,))
    if any(name.startswith("truth_") for name in arrays):
        expected["truth_target"] = ("f", (3,))
        expected["truth_robots"] = ("f", (images, 3))
        expected["truth_landmarks"] = ("f", (features, 2))
    for name, (kind, shape) in expected.items():
        array = arrays.get(name)
        if array is None or array.dtype.kind != kind or array.shape != shape:
            raise MeasurementLogError(f"{where}: array {name} is absent or damaged; run again")
    start = arrays["image_start"]
    if start[0] != 0 or start[-1] != seen or (np.diff(start) < 0).any():
        raise MeasurementLogError(f"{where}: array image_start is damaged; run again")
    times = np.append(arrays["start_time"], arrays["image_time"])
    if not (np.diff(times) > 0.0).all():
        raise MeasurementLogError(f"{where}: times of the images do not increase; run again")


def _length(arrays: StateArrays, name: str) -> int:
    array = arrays.get(name)
    return 0 if array is None or array.ndim == 0 else len(array)
