"""Confirmation of a recognised place: over several frames, and by the drift that is possible.

Corridors that look alike match as well as a true return does. But the offset between map and
estimate that a true return shows stays the same from frame to frame, and is no larger than drift.
"""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import inverse, se3_log
from fgslam.frontend.places.settings import LoopSettings

_AGREEMENT = 0.15, 2.0  # metres and degrees by which the offsets of two frames may differ
_WORTH = 0.03, 0.3  # metres and degrees: below both the tracker finds the old landmarks by itself


class Confirmation:
    """Counts frames in a row that find the same offset."""

    def __init__(self, settings: LoopSettings) -> None:
        """Has seen nothing yet."""
        self._settings = settings
        self.count = 0
        self.offset: FloatArray = np.eye(4)

    @property
    def begun(self) -> bool:
        """Whether a place was recognised by the last look: the next frame shall look again."""
        return self.count > 0

    def offer(self, recognised: FloatArray, estimated: FloatArray) -> bool:
        """Takes a look's result; whether enough of them agree by now.

        Args:
            recognised: (4, 4) ``wTc`` by the landmarks of the place.
            estimated: (4, 4) ``wTc`` as estimated along the way.
        """
        if self.begun and self._agrees(recognised, estimated):
            self.count += 1
        else:
            self.count = 1
        self.offset = recognised @ inverse(estimated)
        return self.count >= self._settings.confirm

    def forget(self) -> None:
        """Begins anew: a look that found nothing, or a closure."""
        self.count, self.offset = 0, np.eye(4)

    def _agrees(self, recognised: FloatArray, estimated: FloatArray) -> bool:
        """Whether the last offset leads to this pose, too."""
        expected = self.offset @ estimated
        metres, degrees = difference(expected, recognised)
        return metres <= _AGREEMENT[0] and degrees <= _AGREEMENT[1]


def difference(a: FloatArray, b: FloatArray) -> tuple[float, float]:
    """Distance in metres and angle in degrees between two poses (4, 4)."""
    apart = se3_log(inverse(a) @ b)
    return (
        float(np.linalg.norm(b[:3, 3] - a[:3, 3])),
        float(np.rad2deg(np.linalg.norm(apart[:3]))),
    )


def drift_allows(
    recognised: FloatArray, estimated: FloatArray, way_m: float, settings: LoopSettings
) -> bool:
    """True if the offset is worth a correction, and a drift that ``way_m`` metres allow."""
    metres, degrees = difference(estimated, recognised)
    worth = metres > _WORTH[0] or degrees > _WORTH[1]
    return worth and (
        metres <= settings.max_drift_m + settings.max_drift_share * way_m
        and degrees <= settings.max_drift_deg + settings.max_drift_deg_m * way_m
    )
