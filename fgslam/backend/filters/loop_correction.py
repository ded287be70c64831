"""The chain of steps that a filter keeps of its drive, and the acceptance of loop closures by it.

The filter's own covariance of a pose says how well it is known relative to the map around it, and
never grows: drift is not in it. What drifts is the chain of steps, each as uncertain as its frame
was tracked; where no landmark was matched, as uncertain as the odometry; where the robot was
carried off, unknown. Derivation: docs/derivations/submaps.md.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from fgslam.backend.filters.settings import LoopCorrectionSettings
from fgslam.backend.filters.submaps import CLOSURE_FACTOR, FREE, SUBMAP_FRAMES, Chain, Constraint
from fgslam.core.arrays import FloatArray, IntArray, StateArrays
from fgslam.core.errors import EstimatorError
from fgslam.core.estimates import EgoMotion
from fgslam.core.geometry import inverse
from fgslam.core.measurements import LoopClosure, Odometry

_TIED_BY = 10  # landmarks of an old place that hold a frame there
_OLD = 5  # submaps
_TIE_FACTOR = 5.0
"""On the deviations of a pose tracked by old landmarks, which lie about their homes as the drift
has bent them. Measured on four rounds of the lab: up to 20 the corrected drive is as accurate,
below 5 true closures are taken for impossible (docs/results)."""


def refusal(what: str, squared: float, gate_sigmas: float) -> str:
    """Why a loop closure is refused, beginning with ``what``; empty where it is accepted.

    Args:
        what: names the closure.
        squared: the rise of the cost by it, or its innovation squared.
        gate_sigmas: the root of the largest that is accepted; 0: any.
    """
    if gate_sigmas == 0.0 or squared <= gate_sigmas**2:
        return ""
    off = np.sqrt(max(squared, 0.0))
    return f"{what} refused: {off:.1f} standard deviations off, {gate_sigmas:g} allowed"


class DriveRecord:
    """The chain of steps of a drive, the constraints on it, and which loops were accepted."""

    def __init__(self, settings: LoopCorrectionSettings) -> None:
        """An empty drive."""
        self._settings = settings
        self._chain = Chain()
        self._tied = -1
        self._coherent = True
        self.remarks: list[str] = []

    @property
    def chain(self) -> Chain:
        """The steps, and the constraints between frames that are no neighbours."""
        return self._chain

    def step(
        self, motion: FloatArray, tracking: EgoMotion, known: Odometry | None, free: bool
    ) -> None:
        """Adds the step (4, 4) to a frame.

        Two frames that were tracked well lie beside the same landmarks. Where most of what a frame
        matched contradicts its pose, as at a return to places that the drift has displaced, old
        landmarks and new ones pull apart: nothing measures the step to that pose, nor the one back
        from it, but the odometry.

        Args:
            motion: the frame's pose as tracked, in the last one's.
            tracking: how the frame was tracked.
            known: what the frame was predicted with.
            free: nobody knows the step: the frame was found without a prior.
        """
        before, self._coherent = self._coherent, tracking.coherent
        if free:
            covariance = FREE
        elif known is None or (before and self._coherent and tracking.status.measured):
            covariance = tracking.covariance
        else:
            motion, covariance = known.motion, known.covariance
        self._chain.append(motion, covariance)

    def tie(
        self, homes: IntArray, poses: list[FloatArray], tracking: EgoMotion, free: bool
    ) -> None:
        """Adds a constraint if the last frame was placed by landmarks of an old part of the drive.

        Once a submap; a frame found without a prior hangs on nothing else.

        Args:
            homes: (k,) home frames of the landmarks that placed it; -1 of those that never move.
            poses: of all frames before, as they are now.
            tracking: how it was tracked.
            free: it was found without a prior.
        """
        frame, every = len(self._chain) - 1, SUBMAP_FRAMES
        homes = np.maximum(homes, 0)  # a saved map's landmarks stay, and so does the first pose
        old = homes[homes < (frame if free else frame - _OLD * every)]
        due = self._coherent and (self._tied < 0 or frame - self._tied >= every)
        # A few old ones among many new, far ones as a rule, do not say where the frame is.
        if len(old) < _TIED_BY or 2 * len(old) < len(homes) or not (free or due):
            return
        self._tied = frame
        home = int(np.sort(old)[len(old) // 2])
        covariance = _TIE_FACTOR**2 * tracking.covariance
        motion = inverse(poses[home]) @ tracking.wTc
        self._chain.constraints.append(Constraint(home, frame, motion, covariance, doubted=True))

    def close(self, loop: LoopClosure, here: FloatArray, where: str) -> FloatArray | None:
        """All poses (n, 4, 4) with the loop closed; None, and a remark, where it is refused.

        It is refused where it would cost more than the drive's own uncertainty explains: the rise
        of the cost is chi-square with six degrees of freedom for a true one.

        Args:
            loop: the closure, of the last frame.
            here: (4, 4) that frame's pose without it.
            where: names the frame.

        Raises:
            EstimatorError: it leads to no earlier frame.
        """
        last = len(self._chain) - 1
        what = f"{where}: loop closure to frame {loop.frame} of the log"
        if not 0 <= loop.frame < last:
            raise EstimatorError(f"{what}, which does not come before it; correct the log")
        covariance = CLOSURE_FACTOR**2 * loop.covariance
        known = Constraint(loop.frame, last, loop.oTc, covariance)
        every, gate = SUBMAP_FRAMES, self._settings.gate_sigmas
        before = self._chain.cost(self._chain.constraints, every)
        found = self._chain.solve([*self._chain.constraints, known], every)
        rise = found.cost - before
        refused = refusal(what, rise, gate)
        if refused:
            self.remarks.append(refused)
            return None
        self._chain.constraints.append(dataclasses.replace(known, doubted=True))
        shift = found.poses[-1, :3, 3] - here[:3, 3]
        self.remarks.append(
            f"{what}: the camera moved by {np.linalg.norm(shift):.2f} m, the drive with it"
        )
        return found.poses

    def state(self) -> StateArrays:
        """All of it as plain arrays."""
        return self._chain.state() | {
            "chain_tied": np.array(self._tied),
            "chain_sound": np.array(self._coherent),
            "chain_remarks": np.array(self.remarks, np.str_),
        }

    def restore(self, state: StateArrays) -> None:
        """Continues from :meth:`state`."""
        self._chain = Chain.restored(state)
        self._tied = int(state["chain_tied"])
        self._coherent = bool(state["chain_sound"])
        self.remarks = [str(words) for words in state["chain_remarks"]]
