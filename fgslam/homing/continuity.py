"""Whether a robot went on from its last image or was carried off: what two images have in common.

Neighbouring images of one drive share most of their features, about as many each time; from one
place to another they share few. How many are usual, and how widely that varies, is learned from the
drive itself, so that images far apart or in dim light are no alarm where they are the rule, nor for
long where they become the rule.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from scipy.stats import t as student

from fgslam.core.homing import BearingMatches, RefusalReason
from fgslam.homing.links import Answer

_STEPS = 20
"""Last steps that tell what is usual. With the one of the prior they vary by a fifth at least: a
robot that stood and drives on (0.6 of the features left) is none that was carried off."""

_OFF = 0.5  # from this probability on a step does not count as usual
_AGAIN = 5
"""Steps within which nobody is carried off twice: what seems so is a drive that has changed, as it
went faster, in dimmer light, or on after a long stand."""

_SPREAD = 1.0  # prior, in one step's weight: of the logarithm, a factor e
_HERE = (RefusalReason.AT_TARGET, RefusalReason.AMBIGUOUS, RefusalReason.UNCERTAIN)


class Continuity:
    """What two neighbouring images of a drive had in common so far.

    Attributes:
        chance: to be carried off from one image to the next, before they are seen.
    """

    def __init__(self, chance: float) -> None:
        """Begins before the first step.

        Args:
            chance: to be carried off from one image to the next, before they are seen.
        """
        self.chance = chance
        self._logs: deque[float] = deque(maxlen=_STEPS)
        self._since: list[float] = []

    def carried_off(self, common: int, most: int) -> float:
        """Probability that the robot was carried off between two images.

        Where it went on, the logarithm of the common features is as in the steps before
        (Student's t, the prediction for unknown mean and variance); where it was carried off,
        anything from none to ``most`` is as likely. A second such step soon after the first is
        reported too, but what is usual is learned anew from the first one on.

        Args:
            common: features of both images that agree on one motion.
            most: that could have been.
        """
        log = float(np.log1p(common))
        off = self.chance / max(float(np.log1p(most)), log, 1.0)
        if not self._logs:
            self._logs.append(log)
            return self.chance
        usual = np.array(self._logs)
        n, mean = len(usual), float(usual.mean())
        scatter = (_SPREAD**2 + float(np.sum((usual - mean) ** 2))) / (n + 1.0)
        on = student.pdf(min(log - mean, 0.0), n, scale=np.sqrt(scatter * (1.0 + 1.0 / n)))
        probability = float(off / (off + (1.0 - self.chance) * on))
        self._learn(log, probability >= _OFF)
        return probability

    def _learn(self, log: float, off: bool) -> None:
        """Takes a step as usual; one that is not, from the second on."""
        if off and self._since:
            self._logs.clear()
            self._logs.extend([*self._since, log])
            self._since = []
            return
        if not off:
            self._logs.append(log)
        if off or self._since:
            self._since.append(log)
        if len(self._since) >= _AGAIN:
            self._since = []


def in_common(answer: Answer, matches: BearingMatches) -> int:
    """Features of two images that agree on one motion; all matches where there was next to none."""
    if answer:
        return answer.support
    return len(matches) if answer.reason in _HERE else 0
