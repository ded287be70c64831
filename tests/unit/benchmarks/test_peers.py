"""What fgslam is compared with: plain odometry finds a known motion, a vocabulary is a tree."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.evidence import peer
from benchmarks.evidence.vocabulary import train_vocabulary
from fgslam.core.types import Trajectory

WIDTH, HEIGHT, FX, BASELINE, DEPTH = 320, 240, 200.0, 0.2, 4.0
STEP = 0.06
"""Metres to the right from frame to frame, 3 px."""


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of five pairs along a wall."""
    folder = tmp_path_factory.mktemp("wall")
    rng = np.random.default_rng(0)
    coarse = rng.uniform(0, 255, (HEIGHT // 4, (WIDTH + 100) // 4)).astype(np.float32)
    texture = cv2.resize(coarse, (WIDTH + 100, HEIGHT), interpolation=cv2.INTER_CUBIC)
    disparity = round(FX * BASELINE / DEPTH)
    for side, shift in (("left", 0), ("right", disparity)):
        (folder / side).mkdir()
        for k in range(5):
            first = shift + k * round(FX * STEP / DEPTH)
            image = np.clip(texture[:, first : first + WIDTH], 0, 255).astype(np.uint8)
            cv2.imwrite(str(folder / side / f"{k:06d}.png"), image)
    rig = {"width": WIDTH, "height": HEIGHT, "fx": FX, "fy": FX, "cx": 160.0, "cy": 120.0}
    (folder / "calib.json").write_text(json.dumps(rig | {"baseline_m": BASELINE}))
    (folder / "times.txt").write_text("".join(f"{k:06d} {0.1 * k:.3f}\n" for k in range(5)))
    return folder


@pytest.mark.parametrize("method", sorted(peer.PLAIN))
def test_plain_odometry_finds_the_way_along_a_wall(
    method: str, wall: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["peer", method, str(wall)])
    peer.main()
    found = Trajectory.load(wall / "live.tum").poses[:, :3, 3]
    assert found[:, 0] == pytest.approx(STEP * np.arange(5), abs=5e-3)
    assert np.abs(found[:, 1:]).max() < 2e-2
    told = json.loads((wall / "loop.json").read_text())
    assert told["located"] == 5
    assert told["loop_s"] > 0.0


def test_a_vocabulary_is_a_tree_whose_words_are_leaves(wall: Path, tmp_path: Path) -> None:
    path = tmp_path / "words.txt"
    images = [cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in sorted(wall.rglob("*.png"))]
    train_vocabulary((np.asarray(one, np.uint8) for one in images), path)
    head, *lines = path.read_text().splitlines()
    assert head == "10 5 0 0"
    parents, leaf = np.array([line.split()[:2] for line in lines], int).T
    assert (parents <= np.arange(len(lines))).all()  # a node comes after its parent, 0 is the root
    inner = np.unique(parents[parents > 0]) - 1
    assert not leaf[inner].any()
    assert leaf.sum() == len(lines) - len(inner)
