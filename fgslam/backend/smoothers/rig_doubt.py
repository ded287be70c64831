"""What the doubt about a rig's calibration adds to the covariances of a solved graph.

A rig that calibrates itself is not known exactly, and what is left shifts all measurements
together: no average over landmarks and frames takes it out. The graph holds the correction as it is
(Schmidt 1966: a parameter that is considered, not estimated); here its covariance is carried to
first order into poses and landmarks. It is that of the correction given the prior of any
calibration and the graph's own measurements, so the sum is the marginal of a graph that had the
correction as a variable. What all cameras share (focal length, lens, baseline) is considered too,
with a prior alone: each image is as far off as any calibration is taken to leave it, or as the
images are found to be off against each other, if that is more. So is the field that no term
follows, as large as it is found to be. A rendered rig is exact.
docs/derivations/measurement_noise.md.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag

from fgslam.backend.considered import fused, pixels_of, shared_covariance
from fgslam.backend.smoothers.border import Bordered
from fgslam.backend.smoothers.marginals import reduced
from fgslam.backend.smoothers.whole_graph import State, WholeGraph
from fgslam.core.arrays import FloatArray
from fgslam.core.rig_correction import (
    RigCorrection,
    displacements,
    prior_information,
    shared_displacements,
)
from fgslam.core.rig_field import field_displacements, field_modes
from fgslam.core.sensors import CameraRig


def doubted(graph: WholeGraph, state: State, rig: RigCorrection) -> Bordered:
    """Marginals at a solution, with the doubt about its rig.

    Its border are the correction's terms, those that all cameras share, and the field's modes.

    Args:
        graph: the factors.
        state: its minimum.
        rig: with the correction that was applied to it.

    Raises:
        EstimatorError: the measurements do not determine all variables.
    """
    held, prior, shared = (
        reduced(graph.linear(state)),
        prior_information(rig.rig),
        shared_covariance(rig),
    )
    modes = field_modes(rig.rig) if rig.field_px and not rig.rig.exact else 0
    p, terms = len(prior), slice(len(prior) + len(shared) + modes)
    pull, own = graph.pulled(
        state, lambda measured: shifts(rig.rig, measured, modes > 0)[..., terms]
    )
    gain = held.solve(pull)
    information = own + pull.T @ gain[: len(pull)]
    of_terms = information[:p, :p] + prior
    correction = np.linalg.inv(0.5 * (of_terms + of_terms.T))
    # What was applied leant with the field, too: as much, but by other frames, as a graph's would.
    lean = rig.field_px * correction @ information[:p, p + len(shared) :]
    correction = correction + lean @ lean.T
    covariance = np.asarray(block_diag(correction, shared, rig.field_px**2 * np.eye(modes)))
    return Bordered(held, gain, covariance, np.zeros(len(covariance)))


def shifts(rig: CameraRig, measured: FloatArray, field: bool = False) -> FloatArray:
    """(k, 3, p + q) by which a unit of each term displaces measurements (k, 3): TERMS, SHARED.

    Then, with ``field``, by its modes.
    """
    pixels = pixels_of(rig, measured)
    of_pixels = [displacements(rig, pixels), shared_displacements(rig, pixels)]
    if field:
        of_pixels.append(field_displacements(rig, pixels))
    return fused(rig, np.concatenate(of_pixels, axis=2))
