"""A dense map of a run: depth of its images, fused along its trajectory, as surface and grid."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import Float32, FloatArray, Image
from fgslam.core.correction import EXPECTED_PX, FIELD_PX, SHARED, shared_information
from fgslam.core.errors import ConfigError, DatasetError, FrameError
from fgslam.core.log import ImageSequence, MeasurementLog
from fgslam.core.sensors import CameraRig, body_is_camera, vertical_of
from fgslam.core.types import Estimate, Trajectory
from fgslam.datasets.depth import DEPTH_SIGMA_M
from fgslam.datasets.images import Depth
from fgslam.datasets.odometry import STAMP_TOLERANCE_S
from fgslam.datasets.recording import Recording
from fgslam.datasets.times import rows_at
from fgslam.frontend.dense_stereo import MIN_DISPARITY_PX, DenseStereo
from fgslam.report.surface import (
    KEPT_SIGMA_VOXELS,
    TRUNCATION_VOXELS,
    DepthFrame,
    Fusion,
    Grid,
    Surface,
    find_up,
    make_grid,
)
from fgslam.runs.units import Progress

Float16: TypeAlias = npt.NDArray[np.float16]
Pictures: TypeAlias = Callable[[int], tuple[Image, ...]]
"""Images (right, left[, top]) of a selected frame, grey or in red, green, blue; or FrameError."""

_VOXEL_PX, _FINEST_PX = 3.0, 0.5  # of the image, at the median depth
_TYPICAL_PX = 0.1  # deviation of a disparity, which bounds how far it is worth to look
_SAMPLES = 3  # frames from which the median depth is learnt
_LENGTH = SHARED.index("baseline")
_LEVEL = np.cos(np.deg2rad(2.5))


@dataclass(frozen=True, slots=True)
class DenseSettings:
    """How a dense map is made.

    Attributes:
        voxel_m: side of a voxel and of the grid's cells; None: three pixels at the median depth.
        range_m: farthest depth; None: where four pixels of disparity are, or a deviation of a tenth
            of a pixel is four voxels.
        cameras: 2 leaves the top camera out.
        every: of the frames that have a pose, every so many are used.
        sigma_m: what is known less well to its neighbours is left out; None: two voxels.
    """

    voxel_m: float | None = None
    range_m: float | None = None
    cameras: int | None = None
    every: int = 2
    sigma_m: float | None = None

    def __post_init__(self) -> None:
        lengths = {"voxel": self.voxel_m, "range": self.range_m, "sigma": self.sigma_m}
        for name, value in lengths.items():
            if value is not None and not 0.0 < value < np.inf:
                raise ConfigError(f"--{name} is {value:g}; give metres above 0, or leave it out")
        if self.every < 1:
            raise ConfigError(f"--every is {self.every}; give 1 for all frames, 2 for every second")


@dataclass(frozen=True, eq=False)
class DenseMap:
    """A run's surface, and what its grid is made from.

    Attributes:
        surface: vertices, triangles, colours, deviations.
        voxel_m: side of a voxel, and of the grid's cells.
        range_m: farthest depth that was used.
        frames: how many depth images were fused.
        scans: of each every second row and column, metres, and the pose (4, 4) of its camera.
        rays: (r, c, 3) of theirs, of depth one.
        up: (3,) upward direction in the map: of a body that keeps to it, else of the floor.
    """

    surface: Surface
    voxel_m: float
    range_m: float
    frames: int
    scans: tuple[tuple[Float16, FloatArray], ...]
    rays: Float32
    up: FloatArray

    @cached_property
    def grid(self) -> Grid:
        """Free, occupied and unknown cells of the floor."""
        return make_grid(self.surface, self.scans, self.rays, self.up, self.voxel_m)


Measured: TypeAlias = Callable[[int], tuple[Depth, Float32, Image]]
"""Of a frame the depth, the deviation of its inverse in 1/m, and the reference image."""


def _by_matching(log: MeasurementLog, pictures: Pictures, cameras: int | None) -> Measured:
    """Depth by matching the images, the rig's correction taken off them."""
    corrections = [step.rig_correction for step in log if step.rig_correction is not None]
    matcher = DenseStereo(log.rig, cameras, corrections[-1] if corrections else None)
    product = np.float32(log.rig.fx * log.rig.baseline)

    def measure(row: int) -> tuple[Depth, Float32, Image]:
        images = matcher.corrected(pictures(row))
        disparity, sigma = matcher.measure(images)
        known = disparity > 0.0
        depth = np.where(known, product / np.where(known, disparity, np.float32(1.0)), 0.0)
        return depth.astype(np.float32), sigma / product, images[0]

    return measure


def _by_camera(depths: Callable[[int], Depth], pictures: Pictures) -> Measured:
    """Depth as a depth camera gives it, with the deviation of such cameras."""

    def measure(row: int) -> tuple[Depth, Float32, Image]:
        depth = depths(row)
        depth = np.where(np.isfinite(depth), depth, np.float32(0.0))
        return depth, np.full_like(depth, DEPTH_SIGMA_M), pictures(row)[0]

    return measure


def fuse(
    log: MeasurementLog,
    estimate: Estimate,
    rows: Sequence[int],
    pictures: Pictures,
    depths: Callable[[int], Depth] | None = None,
    settings: DenseSettings | None = None,
    progress: Progress = lambda what, done, total: None,
) -> DenseMap:
    """The dense map of frames along a trajectory.

    Args:
        log: of the run, for the rig and its correction.
        estimate: poses of the right camera, with covariances.
        rows: of each pose the frame that ``pictures`` and ``depths`` take.
        pictures: images; frames that cannot be read are passed over.
        depths: of a depth camera; None: from the images.
        settings: None for the defaults.
        progress: called with what is under way, how much of it is done, and of how much.

    Raises:
        DatasetError: no image can be read, or none shows any depth.
    """
    settings, rig = settings or DenseSettings(), log.rig
    if settings.cameras not in (None, *range(2, rig.cameras + 1)):
        raise ConfigError(f"--cameras {settings.cameras}: the rig has {rig.cameras}; leave it out")
    used = list(range(0, len(rows), settings.every))
    if depths is None:
        measured = _by_matching(log, pictures, settings.cameras)
        farthest = rig.fx * rig.baseline / MIN_DISPARITY_PX
        noise = _TYPICAL_PX / (rig.fx * rig.baseline)
    else:
        measured, farthest, noise = _by_camera(depths, pictures), np.inf, DEPTH_SIGMA_M

    def readable(row: int) -> tuple[Depth, Float32, Image] | None:
        with suppress(FrameError):
            return measured(row)
        return None

    some = np.unique(np.linspace(0, len(used) - 1, _SAMPLES).astype(int))
    found = [each[0] for k in some if (each := readable(rows[used[k]]))]
    seen = np.concatenate([np.empty(0, np.float32), *(depth[depth > 0.0] for depth in found)])
    if not len(seen):
        raise DatasetError(
            "the images of this recording show no depth: no pair agrees anywhere; check the "
            "calibration by fgslam inspect RECORDING"
        )
    pixel = float(np.median(seen)) / rig.fx
    voxel = settings.voxel_m or _VOXEL_PX * pixel
    if voxel < _FINEST_PX * pixel:
        raise ConfigError(
            f"--voxel is {voxel:g}, finer than the images show anything: a pixel is "
            f"{100.0 * pixel:.2g} cm wide at the median depth; use --voxel {pixel:.2g}, or leave "
            "it out"
        )
    most = settings.range_m or min(farthest, float(np.sqrt(TRUNCATION_VOXELS * voxel / noise)))
    fusion, scans = Fusion(rig.matrix, voxel, most), []
    for done, k in enumerate(used):
        progress("fusing", done, len(used))
        if not (each := readable(rows[k])):
            continue
        depth, sigma, image = each
        wTc = estimate.trajectory.poses[k]
        shared = _shared(log, estimate.covariances[k], depth)
        used_depth = fusion.add(DepthFrame(depth, sigma, image, wTc, shared))
        scans.append((used_depth[::2, ::2].astype(np.float16), wTc))
    progress("fusing", len(used), len(used))
    kept = settings.sigma_m or KEPT_SIGMA_VOXELS * voxel
    surface = fusion.surface(kept)
    if not len(surface.positions):
        raise DatasetError(
            f"nothing was seen as well as {100.0 * kept:.3g} cm within {most:.3g} m; use a larger "
            f"--sigma ({max(3.0 * kept, KEPT_SIGMA_VOXELS * voxel):.2g}) or a larger --range"
        )
    up = (estimate.trajectory.poses[:, :3, :3] @ vertical_of(rig.bTc)).mean(axis=0)
    length = float(np.linalg.norm(up))
    up = up / length
    if body_is_camera(rig.bTc) or length < _LEVEL:  # what keeps to its vertical is on wheels
        up = find_up(surface, up, 2.0 * voxel)
    return DenseMap(surface, voxel, most, len(scans), tuple(scans), _rays(rig), up)


def rows_along(
    trajectory: Trajectory, stamps: FloatArray, name: str = "this recording"
) -> list[int]:
    """Frame of a recording for each pose. Raises DatasetError where it is another recording."""
    rows = rows_at(stamps, trajectory.timestamps, STAMP_TOLERANCE_S)
    if (rows < 0).any():
        raise DatasetError(f"{name} has other times than the run; give the run's own recording")
    return [int(row) for row in rows]


def readers_of(sequence: ImageSequence) -> tuple[Pictures, Callable[[int], Depth] | None]:
    """Images of a recording's frames, and their depth where a camera gives it."""
    if not isinstance(sequence, Recording):
        return lambda i: sequence.frame(i).images, None
    load, numbers = sequence.load_depth, sequence.indices.tolist()
    return sequence.colour, None if load is None else lambda i: load(numbers[i])


def _rays(rig: CameraRig) -> Float32:
    """Of every second row and column, of depth one."""
    rows, columns = np.indices((rig.height, rig.width), np.float32)[:, ::2, ::2]
    rays = [(columns - rig.cx) / rig.fx, (rows - rig.cy) / rig.fy, np.ones_like(rows)]
    return np.stack(rays, axis=-1).astype(np.float32)


def _shared(log: MeasurementLog, covariance: FloatArray, depth: Depth) -> Float32:
    """Variance (height, width), of one axis, of what all pixels have in common, m^2.

    The pose's, whose rotation moves what is far away more; and of the calibration the baseline's
    length and what no term of the correction follows.
    """
    turn, move = np.trace(covariance[:3, :3]), np.trace(covariance[3:, 3:])
    at = move / 3.0 + 2.0 / 9.0 * turn * depth**2
    rig, settled = log.rig, log.increments[-1].settled_rig
    if not rig.exact:
        field = FIELD_PX if settled is None else settled.field_px
        length = shared_information(rig, EXPECTED_PX)[_LENGTH, _LENGTH]
        product = rig.fx * rig.baseline
        at = at + depth**2 / length + 2.0 * (field * depth**2 / product) ** 2
    return np.asarray(at, np.float32)
