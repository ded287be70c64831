"""How much of an estimated correction is believed: models of what is wrong with a rig, weighed.

A correction of many values always fits a little better than none. Each model frees some terms and
holds the others at zero; its evidence charges it for what it frees (MacKay 2003, ch. 28). All are
equally likely before the drive. An exact rig is thereby left alone, without a threshold.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.rig_correction import RigCorrection, term_names

MODELS: dict[str, frozenset[str]] = {
    "exact": frozenset(),
    "bent": frozenset({"yaw", "pitch"}),
    "turned": frozenset({"yaw", "pitch", "roll", "focal"}),
}
"""Terms of the other cameras that are free, by name of the model; in `lens` all of them are."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class WeighedCorrection:
    """An estimate, and what of it is worth applying.

    Attributes:
        estimated: with all terms free; its sigmas are the honest ones.
        applied: the mean over the models, or an older one that lies within the noise of it; with
            the covariance of the above.
        probabilities: of each model.
    """

    estimated: RigCorrection
    applied: RigCorrection
    probabilities: dict[str, float]


def weighed(estimated: RigCorrection, prior: FloatArray) -> WeighedCorrection:
    """The estimate averaged over MODELS.

    Args:
        estimated: with all terms free.
        prior: (p, p) information before the drive, about zero.
    """
    information = np.linalg.inv(estimated.covariance)
    pull = information @ estimated.values
    models = _free_terms(estimated)
    means, evidence = [], []
    for free in models.values():
        inner = np.ix_(free, free)
        mean = np.zeros(len(pull))
        mean[free] = np.linalg.solve(information[inner], pull[free])
        gain = np.linalg.slogdet(information[inner])[1] - np.linalg.slogdet(prior[inner])[1]
        means.append(mean)
        evidence.append(0.5 * (pull @ mean - gain))
    weight = np.exp(np.array(evidence) - max(evidence))
    weight /= weight.sum()
    applied = dataclasses.replace(estimated, values=weight @ np.array(means))
    shares = dict(zip(models, weight.tolist(), strict=True))
    return WeighedCorrection(estimated, applied, shares)


def _free_terms(correction: RigCorrection) -> dict[str, BoolArray]:
    """Which values (p,) are free, by name of the model."""
    names = [name.split(".")[-1] for name in term_names(correction.rig)]
    out = {
        model: np.array([name in terms for name in names], np.bool_)
        for model, terms in MODELS.items()
    }
    return out | {"lens": np.ones(len(names), np.bool_)}
