"""How much of an estimated correction is believed: models of what is wrong with a rig, weighed.

A correction of many values always fits a little better than none. Each model frees some terms and
holds the others at zero; its evidence charges it for what it frees (MacKay 2003, ch. 28). All are
equally likely before the drive. An exact rig is thereby left alone, without a threshold.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.rig_correction import RigCorrection, early_terms, term_names

MODELS: dict[str, frozenset[str]] = {
    "exact": frozenset(),
    "bent": frozenset({"yaw", "pitch"}),
    "turned": frozenset({"yaw", "pitch", "roll", "focal"}),
}
"""Terms of the other cameras that are free, by name of the model; in `lens` all early ones are
(:func:`fgslam.core.rig_correction.early_terms`), in `whole` every term is."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class WeighedCorrection:
    """An estimate, and what of it is worth applying.

    Attributes:
        estimated: with all terms free; its sigmas are the honest ones.
        applied: what is taken off the next frames: the mean over models of the early terms, or an
            older one that lies within the noise of it.
        settled: what the frames so far are best corrected by, all alike: the mean over all models.
            None where `whole` is not the likeliest: then each frame's own is no worse.
        probabilities: of each model.
    """

    estimated: RigCorrection
    applied: RigCorrection
    settled: RigCorrection | None
    probabilities: dict[str, float]

    @property
    def best(self) -> RigCorrection:
        """The one settled, else the one applied."""
        return self.applied if self.settled is None else self.settled


def weighed(
    estimated: RigCorrection, early: RigCorrection, priors: tuple[FloatArray, FloatArray]
) -> WeighedCorrection:
    """Both estimates averaged over models.

    Args:
        estimated: with all terms free.
        early: with the early ones free, the others held at zero.
        priors: (p, p) information of each before the drive, about zero.
    """
    models = _free_terms(estimated)
    names = list(models)
    applied, _ = _mean(early, [models[name] for name in names[:-1]], priors[1])
    settled, shares = _mean(estimated, list(models.values()), priors[0])
    whole = bool(shares.argmax() == len(shares) - 1)
    return WeighedCorrection(
        estimated,
        applied,
        settled if whole else None,
        dict(zip(names, shares.tolist(), strict=True)),
    )


def _mean(
    known: RigCorrection, models: list[BoolArray], prior: FloatArray
) -> tuple[RigCorrection, FloatArray]:
    """The mean over models, by which terms (p,) each frees, and their probabilities (n,)."""
    information = np.linalg.inv(known.covariance)
    pull = information @ known.values
    means, evidence = [], []
    for free in models:
        inner = np.ix_(free, free)
        mean = np.zeros(len(pull))
        mean[free] = np.linalg.solve(information[inner], pull[free])
        gain = np.linalg.slogdet(information[inner])[1] - np.linalg.slogdet(prior[inner])[1]
        means.append(mean)
        evidence.append(0.5 * (pull @ mean - gain))
    weight = np.exp(np.array(evidence) - max(evidence))
    weight /= weight.sum()
    return dataclasses.replace(known, values=weight @ np.array(means)), weight


def _free_terms(correction: RigCorrection) -> dict[str, BoolArray]:
    """Which values (p,) are free, by name of the model."""
    names, early = term_names(correction.rig), early_terms(correction.rig)
    out = {
        model: early & np.array([name.split(".")[-1] in terms for name in names], np.bool_)
        for model, terms in MODELS.items()
    }
    return out | {"lens": early, "whole": np.ones(len(names), np.bool_)}
