"""Makes the fixed vocabulary of the appearance index: cells of the space of SIFT descriptors.

Trained on the rendered lab alone, so that no recording's licence is touched and every map is
measured on images that it has not seen. Run `python -m scripts.make_vocabulary` from the root; the
result is part of the package and changes only on purpose: other cells find other neighbours.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.frontend.features.matching import VOCABULARY_FILE
from fgslam.frontend.features.sift import SiftExtractor
from fgslam.runs.config import load_config
from fgslam.runs.opening import open_sequence

_WORDS = 256
_ROUNDS = 25
_EVERY = 3  # frames; neighbours look alike


def main() -> None:
    """Extracts descriptors, clusters them and writes the file."""
    config = load_config(Path("experiments/lab_loop.yaml"))
    sequence = open_sequence(config)
    extractor = SiftExtractor(config.frontend.sift, config.frontend.appearance.mode)
    found = [
        extractor.extract(sequence.frame(i).images[0]).descriptors
        for i in range(0, len(sequence), _EVERY)
    ]
    words = cluster(np.concatenate(found).astype(np.float64), np.random.default_rng(0))
    np.savez_compressed(VOCABULARY_FILE, words=np.rint(words).astype(np.uint8))


def cluster(values: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Lloyd's k-means; a word left without descriptors takes the one farthest from its own."""
    words = values[rng.choice(len(values), _WORDS, replace=False)]
    for _ in range(_ROUNDS):
        squared = np.sum(words**2, axis=1) - 2.0 * values @ words.T
        own = np.argmin(squared, axis=1)
        sums = np.zeros_like(words)
        np.add.at(sums, own, values)
        counts = np.bincount(own, minlength=_WORDS)
        words = sums / np.maximum(counts, 1)[:, None]
        loose = np.flatnonzero(counts == 0)
        error = np.sum((values - words[own]) ** 2, axis=1)
        words[loose] = values[np.argsort(-error, kind="stable")[: len(loose)]]
    return np.asarray(words)


if __name__ == "__main__":
    main()
