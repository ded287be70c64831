"""When a recognised place is believed: it agrees with itself, and with how far one can drift.

Corridors that look alike match as well as a true return does. But the offset between map and
estimate that a true return shows stays the same from frame to frame, and is no larger than drift.
"""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import inverse, se3_log
from fgslam.frontend.places.settings import LoopSettings


class Confirmation:
    """Counts frames in a row that find the same offset."""

    def __init__(self, settings: LoopSettings) -> None:
        """Has seen nothing yet."""
        self._settings = settings
        self.count = 0
        self.offset: FloatArray = np.eye(4)

    @property
    def hopeful(self) -> bool:
        """Whether a place was recognised by the last look: the next frame shall look again."""
        return self.count > 0

    def offer(self, recognised: FloatArray, estimated: FloatArray) -> bool:
        """Takes a look's result; whether enough of them agree by now.

        Args:
            recognised: (4, 4) ``wTc`` by the landmarks of the place.
            estimated: (4, 4) ``wTc`` as estimated along the way.
        """
        if self.hopeful and self._agrees(recognised, estimated):
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
        return metres <= self._settings.agreement_m and degrees <= self._settings.agreement_deg


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
    """Whether the offset is that of a drift: worth mending, and possible after ``way_m`` metres."""
    metres, degrees = difference(estimated, recognised)
    worth = metres > settings.least_offset_m or degrees > settings.least_offset_deg
    return worth and (
        metres <= settings.max_drift_m + settings.max_drift_share * way_m
        and degrees <= settings.max_drift_deg + settings.max_drift_deg_m * way_m
    )
