"""A vocabulary of ORB words for ORB-SLAM3, trained on images at hand where its own is not."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.runs import say
from fgslam.core.arrays import Image

_BRANCHES, _LEVELS, _ROUNDS = 10, 5, 6
_WORDS_OF_AN_IMAGE = 1000


def train_vocabulary(images: Iterable[Image], path: Path) -> None:
    """Writes the text file of DBoW2 (Galvez-Lopez and Tardos 2012): a tree of at most 10^5 words.

    k-medians of bits, level by level, seeded; weights are the logarithms of images over images
    that hold the word.
    """
    orb = cv2.ORB.create(_WORDS_OF_AN_IMAGE)
    found = [orb.detectAndCompute(image, None)[1] for image in images]
    per_image = [words for words in found if words is not None]
    say(f"training a vocabulary on {len(per_image)} images")
    bits = 2.0 * np.unpackbits(np.concatenate(per_image), axis=1).astype(np.float32) - 1.0
    owner = np.repeat(np.arange(len(per_image)), [len(words) for words in per_image])
    lines: list[str] = []
    _grow(bits, np.arange(len(bits)), owner, 0, 1, lines, np.random.default_rng(0))
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    part.write_text(f"{_BRANCHES} {_LEVELS} 0 0\n" + "\n".join(lines) + "\n", encoding="utf-8")
    part.replace(path)
    say(f"{len(lines)} nodes in {path}")


def _grow(
    bits: NDArray[np.float32], members: NDArray[np.int64], owner: NDArray[np.int64],
    parent: int, level: int, lines: list[str], rng: np.random.Generator,
) -> None:  # fmt: skip
    """Appends the children of a node; a node's number is its line's."""
    centres = bits[rng.permutation(members)[:_BRANCHES]]
    for _ in range(_ROUNDS):
        nearest = np.argmax(bits[members] @ centres.T, axis=1)
        sums = np.stack([bits[members[nearest == k]].sum(axis=0) for k in range(len(centres))])
        centres = np.where(sums >= 0.0, 1.0, -1.0).astype(np.float32)
    nearest = np.argmax(bits[members] @ centres.T, axis=1)
    for k, centre in enumerate(centres):
        mine = members[nearest == k]
        if not len(mine):
            continue
        leaf = level == _LEVELS or len(mine) <= _BRANCHES
        weight = np.log((owner[-1] + 1) / len(np.unique(owner[mine]))) if leaf else 0.0
        text = " ".join(map(str, np.packbits(centre > 0.0)))
        lines.append(f"{parent} {int(leaf)} {text} {weight:.6f}")
        if not leaf:
            _grow(bits, mine, owner, len(lines), level + 1, lines, rng)
