"""What maps that last are made of: how landmarks look, and poses found without a prior."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
import numpy.typing as npt

from fgslam.core.types import ByteArray, FloatArray, IntArray

Words = npt.NDArray[np.int16]
"""(v,) the cell of the vocabulary (``frontend.features.vocabulary``) of each descriptor."""


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkAppearances:
    """How landmarks look, one row a stored view; a landmark may have several (Se et al. 6.3).

    Attributes:
        ids: (v,) identity of the landmark that each view belongs to, ascending.
        descriptors: (v, 128) uint8.
        size: (v,) physical size, scale times depth: pixels times metres.
        orientation: (v,) radians, as in the image.
        direction: (v, 3) unit vector from the camera to the landmark, world; NaN where unknown.
        words: (v,) of the descriptors, where they are at hand; None where they must be found. No
            part of what is known: they follow from the descriptors.
    """

    ids: IntArray
    descriptors: ByteArray
    size: FloatArray
    orientation: FloatArray
    direction: FloatArray
    words: Words | None = None

    def __len__(self) -> int:
        return len(self.ids)

    def of(self, ids: IntArray) -> LandmarkAppearances:
        """Only the views of the named landmarks (any order; unknown ones give none)."""
        keep = np.isin(self.ids, ids)
        return LandmarkAppearances(
            self.ids[keep],
            self.descriptors[keep],
            self.size[keep],
            self.orientation[keep],
            self.direction[keep],
            None if self.words is None else self.words[keep],
        )


class Verdict(str, Enum):
    """How a search for a pose without a prior ended."""

    FOUND = "found"
    TOO_FEW_MATCHES = "too_few_matches"
    TOO_FEW_INLIERS = "too_few_inliers"
    AMBIGUOUS = "ambiguous"
    CONTRADICTED = "contradicted"
    INACCURATE = "inaccurate"


@dataclass(frozen=True, slots=True, eq=False)
class Relocalisation:
    """The pose of a frame in a map, found without a prior, and why it is believed or refused.

    Attributes:
        verdict: FOUND, or why the best pose is refused.
        wTc: (4, 4) best pose; the identity where there is none.
        covariance: (6, 6) of it, in the tangent space at ``wTc``; NaN where there is none.
        features: (k,) indices of the frame's features that agree with the pose.
        ids: (k,) the landmarks that they match, unique.
        candidates: tentative matches by appearance.
        expected: landmarks that the pose should see.
        residual_px: root mean square image residual of the inliers; NaN where there are none.
        second: inliers of the second-best pose elsewhere in the map, 0 where there is none.
        why: the verdict in words with its numbers.
    """

    verdict: Verdict
    wTc: FloatArray
    covariance: FloatArray
    features: IntArray
    ids: IntArray
    candidates: int
    expected: int
    residual_px: float
    second: int
    why: str

    @property
    def found(self) -> bool:
        """Whether the pose is to be believed."""
        return self.verdict is Verdict.FOUND
