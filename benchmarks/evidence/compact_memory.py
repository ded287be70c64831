"""What compact memory of path images costs: homing vectors to targets that are kept whole or not.

Rendered house, mirror camera of 320x240; paths of ten legs of 2 m. From where a target was, with a
fresh image, to the next target and to the one after it.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.runs import say
from benchmarks.tables import Cell, Table
from fgslam.core.arrays import FloatArray
from fgslam.core.bearings import OmniFeatures, TwoViewVector
from fgslam.core.geometry import between, wrap
from fgslam.datasets.opening import open_house
from fgslam.frontend.features.omni import OmniFeatureExtractor
from fgslam.frontend.homing.vector import pair_generator
from fgslam.homing.front_end import compare_views
from fgslam.homing.route import PathMemory, with_neighbours_votes
from fgslam.homing.settings import DRIVING
from fgslam.worlds.settings import HousePathSettings, OmniHouseSettings

LEGS, SPACING_M = 10, 2.0
_WRONG_DEG = 30.0
_COLUMNS = ("target's memory", "kB a target", "pairs", "answered", "direction off deg, median",
            "off by more than 30 degrees")  # fmt: skip


def tables(seeds: Sequence[int] = range(4)) -> list[Table]:
    """Two rows: whole memory and compact, over the same pairs of images."""
    judged = [_path(seed) for seed in seeds]
    rows = [_row(name, [each[k] for each in judged]) for k, name in enumerate(("whole", "compact"))]
    return [Table(f"Compact memory, {len(seeds)} paths of {LEGS} legs", _COLUMNS, rows)]


@dataclass(frozen=True)
class _Judged:
    """One path with one kind of memory: kB a target, pairs, and errors (n,) of those answered."""

    kilobytes: float
    pairs: int
    errors_deg: FloatArray


def _row(name: str, paths: Sequence[_Judged]) -> tuple[Cell, ...]:
    errors = np.concatenate([path.errors_deg for path in paths])
    return (
        name,
        float(np.mean([path.kilobytes for path in paths])),
        sum(path.pairs for path in paths),
        len(errors),
        float(np.median(errors)) if len(errors) else None,
        int(np.sum(errors > _WRONG_DEG)),
    )


def _path(seed: int) -> tuple[_Judged, _Judged]:
    """The pairs of one path with whole memory, and with compact one."""
    say(f"path {seed}")
    world = open_house(
        OmniHouseSettings(path=HousePathSettings(legs=LEGS, spacing_m=SPACING_M)), seed
    )
    extractor = OmniFeatureExtractor(world.calibration, DRIVING.features)
    whole = [extractor.extract(image) for image in world.targets]
    present = []
    for k, pose in enumerate(world.reference_poses[:-1]):
        world.put(pose)
        present.append(extractor.extract(world.image(float(k))))
    memories = (whole, with_neighbours_votes(whole, DRIVING, seed))
    first, second = (_judged(present, targets, world.reference_poses, seed) for targets in memories)
    return first, second


def _judged(
    present: Sequence[OmniFeatures], targets: Sequence[OmniFeatures], poses: FloatArray, seed: int
) -> _Judged:
    """Target k is at pose k + 1; as it is read from a file."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "path"
        kilobytes = PathMemory.of(targets).save(file)
        kept = PathMemory.load(file).images
    pairs = [(k, k + step) for step in (0, 1) for k in range(len(present)) if k + step < len(kept)]
    errors = []
    for here, there in pairs:
        rng = pair_generator(seed, here, there)
        vector, _ = compare_views(present[here], kept[there], DRIVING, rng)
        if isinstance(vector, TwoViewVector):
            x, y, _ = between(poses[here], poses[there + 1])
            errors.append(abs(float(wrap(np.asarray(vector.direction - np.arctan2(y, x))))))
    return _Judged(kilobytes, len(pairs), np.degrees(errors))
