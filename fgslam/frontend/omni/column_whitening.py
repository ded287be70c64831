"""The measured spread of a column segment's descriptor between two views of one thing."""

from __future__ import annotations

import numpy as np

DEVIATIONS = np.array([0.15, 0.05, 0.05, 0.05, 0.25, 0.2, 0.2, 0.2, 0.15, 0.15, 0.15])
WHITENING = np.diag(1.0 / DEVIATIONS)
