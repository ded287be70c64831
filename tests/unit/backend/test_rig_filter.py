"""A filter over a rig's correction whose windows all lean with the same field."""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag

from fgslam.backend.self_calibration import RigEvidence, RigFilter
from fgslam.core.arrays import FloatArray
from fgslam.core.correction import field_modes, prior_information
from fgslam.core.sensors import CameraRig

PAIR = CameraRig(620, 190, 360.0, 360.0, 310.0, 92.0, 0.54, None, np.eye(4))
FIELD_PX = 0.3
TERMS, MODES = len(prior_information(PAIR)), field_modes(PAIR)


def window(rng: np.random.Generator) -> tuple[RigEvidence, FloatArray, FloatArray]:
    """What it says, as half a Hessian of terms and modes, and where it would go."""
    root = rng.standard_normal((TERMS + MODES, TERMS + MODES))
    root[:, :TERMS] *= 3.0 * np.sqrt(np.diagonal(prior_information(PAIR)))
    hessian, best = root.T @ root, rng.standard_normal(TERMS + MODES)
    at = np.concatenate([1e-3 * rng.standard_normal(TERMS), np.zeros(MODES)])
    score, t = hessian @ (best - at), slice(TERMS)
    m = slice(TERMS, None)
    said = RigEvidence(hessian[t, t], score[t], at[t], 50, hessian[t, m], hessian[m, m], score[m])
    return said, hessian, hessian @ best


def test_windows_and_drift_are_those_of_terms_and_modes_estimated_together() -> None:
    rng, share = np.random.default_rng(0), 0.05
    filtered = RigFilter.of(PAIR, np.ones(TERMS, np.bool_))
    factor = filtered.noise_factor
    prior = block_diag(prior_information(PAIR), np.eye(MODES) / FIELD_PX**2)
    drift = block_diag(share * np.linalg.inv(prior_information(PAIR)), np.zeros((MODES, MODES)))
    values, covariance = np.zeros(len(prior)), np.linalg.inv(prior)
    for _ in range(4):
        said, hessian, score = window(rng)
        filtered = filtered.grown(share).after(said)
        information = np.linalg.inv(covariance + drift)
        pull = information @ values + score / factor
        covariance = np.linalg.inv(information + hessian / factor)
        values = covariance @ pull
    found = filtered.under(FIELD_PX)
    unit = found.sigmas
    together = covariance[:TERMS, :TERMS]
    np.testing.assert_allclose(found.values / unit, values[:TERMS] / unit, atol=1e-5)
    np.testing.assert_allclose(
        found.covariance / np.outer(unit, unit), together / np.outer(unit, unit), atol=1e-6
    )
    assert (found.sigmas > 1.05 * filtered.known.sigmas).any()
    assert filtered.under(0.0) is filtered.known
