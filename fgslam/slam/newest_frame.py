"""Between a camera that delivers at its own pace and a session that takes what it can keep up with.

A frame that comes while the last one is still waiting replaces it: a robot needs where it is, not
where it was. The odometry of what was dropped is kept, as part of the next frame's.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from threading import Condition
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import SessionError
from fgslam.core.geometry import compose_odometry
from fgslam.core.measurements import Odometry
from fgslam.slam.inputs import Images

BodyMotion: TypeAlias = Odometry | FloatArray | npt.ArrayLike | None
LiveFrame: TypeAlias = tuple[float, Images | None, BodyMotion]


class NewestFrame:
    """Holds one frame, the newest that has not been taken; safe between threads.

    ::

        frames = fgslam.NewestFrame()
        threading.Thread(target=read_camera, args=(frames,)).start()  # puts, then closes
        for t, images, odometry in frames:
            slam.track(t, images, odometry)
    """

    def __init__(self) -> None:
        self._changed = Condition()
        self._waiting: LiveFrame | None = None
        self._closed = False
        self._dropped = 0

    @property
    def dropped(self) -> int:
        """Frames that were replaced before they were taken."""
        return self._dropped

    def put(self, t: float, images: Images | None, odometry: BodyMotion = None) -> None:
        """Hands a frame over; never waits. Arguments as of :meth:`fgslam.Slam.track`.

        They are copied: a camera loop may fill the same arrays again.

        Raises:
            SessionError: closed already.
        """
        images, odometry = deepcopy((images, odometry))
        with self._changed:
            if self._closed:
                raise SessionError("the frames are closed; make a new NewestFrame")
            if self._waiting is not None:
                self._dropped += 1
                odometry = _joined(self._waiting[2], odometry)
            self._waiting = (t, images, odometry)
            self._changed.notify()

    def take(self, timeout: float | None = None) -> LiveFrame | None:
        """Waits for a frame and takes it; None after ``timeout`` seconds or :meth:`close`."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting is not None or self._closed, timeout)
            frame, self._waiting = self._waiting, None
            return frame

    def close(self) -> None:
        """No frame will come any more; one that waits can still be taken. May be called twice."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def __iter__(self) -> Iterator[LiveFrame]:
        """Frames as they come, until :meth:`close`."""
        while (frame := self.take()) is not None:
            yield frame


def _joined(first: BodyMotion, second: BodyMotion) -> BodyMotion:
    """Two motions as one: with covariance where both have one; None where one was not measured."""
    if first is None or second is None:
        return None
    if isinstance(first, Odometry) and isinstance(second, Odometry):
        return compose_odometry((first, second))
    return np.asarray(_motion(first) @ _motion(second))


def _motion(odometry: BodyMotion) -> FloatArray:
    return np.asarray(odometry.motion if isinstance(odometry, Odometry) else odometry, np.float64)
