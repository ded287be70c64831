"""Ground truth plus stated noise, standing in for odometry where a recording has none."""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import DatasetError
from fgslam.core.estimates import Trajectory
from fgslam.core.geometry import inverse, se3_exp
from fgslam.core.measurements import Odometry
from fgslam.core.recordings import Frame, Sequence
from fgslam.core.sensors import CameraRig
from fgslam.datasets.odometry_settings import SyntheticOdometrySettings
from fgslam.datasets.trajectories import rows_at

_STAMP_TOLERANCE_S = 1e-6
# Least noise per axis and step: a covariance of a standing robot must be invertible.
_TRANSLATION_FLOOR_M, _ROTATION_FLOOR_DEG = 0.001, 0.01


class SyntheticOdometry:
    """A recording whose odometry is its ground truth with noise drawn from a seed.

    The motion of step ``i`` is ``M = M_true * Exp(xi)``, ``xi`` normal with the covariance that is
    reported with it, independent per body axis and step. Each step has its own generator, seeded
    from (seed, numbers of its two frames), so that any part of a recording repeats the same noise.
    """

    def __init__(self, sequence: Sequence, settings: SyntheticOdometrySettings, seed: int) -> None:
        """Wrap ``sequence``.

        Raises:
            DatasetError: the recording has no ground truth.
        """
        if sequence.ground_truth is None or len(sequence.ground_truth) == 0:
            raise DatasetError(
                f"odometry.kind is synthetic but {sequence.name} has no ground truth to make it "
                "from; choose recorded or constant_velocity"
            )
        self._sequence = sequence
        self._settings = settings
        self._seed = seed
        self._truth = sequence.ground_truth
        # Row of the truth at each frame, -1 where there is none.
        self._rows = rows_at(
            sequence.ground_truth.timestamps, sequence.timestamps, _STAMP_TOLERANCE_S
        )

    @property
    def name(self) -> str:
        """Name of the wrapped recording."""
        return self._sequence.name

    @property
    def rig(self) -> CameraRig:
        """Cameras of the wrapped recording."""
        return self._sequence.rig

    @property
    def timestamps(self) -> FloatArray:
        """(n,) seconds."""
        return self._sequence.timestamps

    @property
    def identity(self) -> str:
        """Digest of the wrapped recording; the noise is set by the configuration and its seed."""
        return self._sequence.identity

    def __len__(self) -> int:
        return len(self._sequence)

    def frame(self, i: int) -> Frame:
        """Images of frame ``i``, as recorded."""
        return self._sequence.frame(i)

    @property
    def ground_truth(self) -> Trajectory | None:
        """True poses, as recorded."""
        return self._truth

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes of the recording, and that the odometry is synthetic, with its noise."""
        note = (
            "the odometry is synthetic: ground truth plus noise of "
            f"{100.0 * self._settings.translation_sigma_fraction:g} % of the step and "
            f"{self._settings.rotation_sigma_deg:g} degrees per axis (seed {self._seed})"
        )
        without = int((self._rows < 0).sum())
        partial = (f"{without} frames have no ground truth, so no odometry",) if without else ()
        return (*self._sequence.notes, note, *partial)

    def odometry(self, i: int) -> Odometry | None:
        """Noisy body motion from frame ``i - 1`` to ``i``; None where truth has a gap."""
        if not 1 <= i < len(self):
            raise IndexError(f"step {i} of {self.name}: expected 1 to {len(self) - 1}")
        before, after = self._rows[i - 1], self._rows[i]
        if before < 0 or after < 0:
            return None
        bTc = self.rig.bTc
        camera = inverse(self._truth.poses[before]) @ self._truth.poses[after]
        motion = bTc @ camera @ inverse(bTc)
        sigmas = self._sigmas(float(np.linalg.norm(motion[:3, 3])))
        noise = self._generator(i).standard_normal(6) * sigmas
        return Odometry(motion @ se3_exp(noise), np.diag(sigmas**2))

    def _sigmas(self, length: float) -> FloatArray:
        """Standard deviations (6,) [rotation, translation] for a step of this length in metres."""
        s = self._settings
        rotation = np.radians(max(s.rotation_sigma_deg, _ROTATION_FLOOR_DEG))
        translation = max(s.translation_sigma_fraction * length, _TRANSLATION_FLOOR_M)
        return np.repeat([rotation, translation], 3)

    def _generator(self, i: int) -> np.random.Generator:
        # Stamps identify frames whatever the selection; microseconds are what files keep.
        pair = np.round(self.timestamps[i - 1 : i + 1] * 1e6).astype(np.int64)
        return np.random.default_rng([self._seed, *(int(t) % 2**63 for t in pair)])
