"""What the doubt about a rig's calibration adds to the covariances of a solved graph.

A rig that calibrates itself is not known exactly, and what is left shifts all measurements
together: no average over landmarks and frames takes it out. The graph holds the correction as it is
(Schmidt 1966: a parameter that is considered, not estimated); here its covariance is carried to
first order into poses and landmarks. It is that of the correction given the prior of any
calibration and the graph's own measurements, so the sum is the marginal of a graph that had the
correction as a variable. What all cameras share (focal length, lens, baseline) is considered too,
with a prior alone: each image is as far off as any calibration is taken to leave it, or as the
images are found to be off against each other, if that is more. A rendered rig is exact.
docs/derivations/measurement_noise.md.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from fgslam.backend.filters.online_doubt import fused, pixels_of, shared_covariance
from fgslam.backend.smoothers.marginals import (
    ChainMarginals,
    GraphMarginals,
    LinearSystem,
    reduced,
)
from fgslam.backend.smoothers.whole_graph import State, WholeGraph
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.cylindrical import as_perspective, from_perspective
from fgslam.core.rig_correction import (
    RigCorrection,
    displacements,
    prior_information,
    shared_displacements,
)
from fgslam.core.sensors import CameraRig


@dataclass(frozen=True, eq=False)
class DoubtedMarginals:
    """Marginals of a graph, as :class:`GraphMarginals`, with the doubt about its rig.

    Attributes:
        held: the same with the correction held as it is.
        gain: (3m + 6n, p + q) how landmarks and poses follow the correction's p terms and the q
            that all cameras share.
        correction: (p + q, p + q) their covariance.
    """

    held: GraphMarginals | ChainMarginals
    gain: FloatArray
    correction: FloatArray

    @staticmethod
    def of(graph: WholeGraph, state: State, rig: RigCorrection) -> DoubtedMarginals:
        """At a solution; ``rig`` with the correction that was applied to it.

        Raises:
            EstimatorError: the measurements do not determine all variables.
        """
        system = graph.linear(state)
        held, prior, shared = reduced(system), prior_information(rig.rig), shared_covariance(rig)
        p, terms = len(prior), slice(len(prior) + len(shared))
        pull, own = graph.pulled(state, lambda measured: shifts(rig.rig, measured)[..., terms])
        gain = np.column_stack([_step(held, system, one) for one in pull.T])
        information = (own + pull.T @ gain)[:p, :p] + prior
        correction = np.linalg.inv(0.5 * (information + information.T))
        return DoubtedMarginals(held, gain, np.asarray(block_diag(correction, shared)))

    def poses(self) -> FloatArray:
        """(n, 6, 6) marginals, in the order of ``pose_keys``."""
        columns = self.held.system.columns
        gain = self.gain[columns:].reshape(-1, 6, len(self.correction))
        return np.asarray(self.held.poses() + gain @ self.correction @ np.swapaxes(gain, 1, 2))

    def landmarks(self) -> FloatArray:
        """(m, 3, 3) marginals, in the order of ``landmark_keys``."""
        columns = self.held.system.columns
        gain = self.gain[:columns].reshape(-1, 3, len(self.correction))
        by_rig = gain @ self.correction @ np.swapaxes(gain, 1, 2)
        return np.asarray(self.held.landmarks() + by_rig)

    def joint(self, pose: int, landmarks: IntArray) -> FloatArray:
        """Joint covariance (6 + 3k, 6 + 3k) of one pose and landmarks, by row of the key lists."""
        at = self.held.system.columns + 6 * pose + np.arange(6)
        rows = np.concatenate([at, (3 * landmarks[:, None] + np.arange(3)).ravel()])
        gain = self.gain[rows]
        return np.asarray(self.held.joint(pose, landmarks) + gain @ self.correction @ gain.T)


def shifts(rig: CameraRig, measured: FloatArray) -> FloatArray:
    """(k, 3, p + q) by which a unit of each term displaces measurements (k, 3): TERMS, SHARED.

    Both as graphs have them: of a perspective view.
    """
    if rig.cylindrical:
        measured = from_perspective(rig, measured)
    pixels = pixels_of(rig, measured)
    of_pixels = [displacements(rig, pixels), shared_displacements(rig, pixels)]
    moved = fused(rig, np.concatenate(of_pixels, axis=2))
    return as_perspective(rig, measured)[1] @ moved if rig.cylindrical else moved


def _step(
    held: GraphMarginals | ChainMarginals, system: LinearSystem, gradient: FloatArray
) -> FloatArray:
    """(3m + 6n,) the graph's step for another gradient."""
    columns = system.columns
    other = dataclasses.replace(
        system, landmark_gradient=gradient[:columns], pose_gradient=gradient[columns:]
    )
    if isinstance(held, GraphMarginals):
        return dataclasses.replace(held, system=other).step()
    return ChainMarginals.of(other).step()
