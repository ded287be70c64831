"""Images against odometry (docs/results): faults of either, and what the default live run says."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from scipy import ndimage

import fgslam as fg
from benchmarks.runs import say
from benchmarks.tables import Cell, Table
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.geometry import inverse, pose, rotation_angle, se3_exp, so3_exp, so3_log
from fgslam.core.sensors import CameraRig, Odometry, compose_odometry
from fgslam.core.types import Remark
from fgslam.runs.report import located
from fgslam.slam.session import Session

BEGINS = 12
"""Frame from which on a fault that is not there from the start acts."""
LASTS = 20
"""Frames that something passes, or wheels slip (fifteen of them)."""
_SIGMAS = 3.0  # of the stated deviation, within which an error is honest


@dataclass(frozen=True, eq=False)
class Drive:
    """Frames of a drive, all in memory.

    Attributes:
        rig: the cameras as the run is told.
        stamps: (n,) seconds.
        images: (left, right) a frame.
        odometry: of the body to each frame; None to the first.
        truth: (n, 4, 4) poses of the right camera.
        scale: distance of what is near, metres: where bodies pass.
    """

    rig: CameraRig
    stamps: FloatArray
    images: list[tuple[Image, Image]]
    odometry: list[Odometry | None]
    truth: FloatArray
    scale: float

    def __len__(self) -> int:
        return len(self.images)

    def first(self, n: int) -> Drive:
        """The first frames of it."""
        return replace(self, stamps=self.stamps[:n], images=self.images[:n],
                       odometry=self.odometry[:n], truth=self.truth[:n])  # fmt: skip

    def every(self, stride: int) -> Drive:
        """Every so many frames of it, with odometry composed."""
        kept = range(0, len(self), stride)
        steps: list[Odometry | None] = [None]
        for k in kept[1:]:
            known = [one for one in self.odometry[k - stride + 1 : k + 1] if one is not None]
            steps.append(compose_odometry(known))
        images = [self.images[k] for k in kept]
        return replace(self, stamps=self.stamps[::stride], images=images, odometry=steps,
                       truth=self.truth[::stride])  # fmt: skip


# ------------------------------------------------------------------------------------------
# Rooms of textured rectangles


@dataclass(frozen=True, eq=False)
class Board:
    """A textured rectangle: its pose (the texture in x and y), size and grey values a metre."""

    wTb: FloatArray
    size: tuple[float, float]
    texture: FloatArray
    texels: float = 60.0


def texture(seed: int, size: tuple[float, float], period_m: float = 0.0) -> FloatArray:
    """Grey values of a board of this size, metres; repeated along x where there is a period."""
    width, height = (round(60.0 * side) for side in (period_m or size[0], size[1]))
    noise = np.random.default_rng(seed).normal(size=(height, width))
    levels = [ndimage.gaussian_filter(noise, s, mode="wrap") for s in (1.2, 3.0, 9.0)]
    return np.asarray(128.0 + 28.0 * sum(one / one.std() for one in levels))


def view(boards: Iterable[Board], rig: CameraRig, wTc: FloatArray, image: FloatArray) -> FloatArray:
    """The image (h, w) with the boards that a camera sees from its pose in front of it."""
    columns, rows = np.meshgrid(np.arange(rig.width), np.arange(rig.height))
    rays = np.stack([(columns - rig.cx) / rig.fx, (rows - rig.cy) / rig.fy, np.ones(rows.shape)])
    image, nearest = image.copy(), np.full(image.shape, np.inf)
    for board in boards:
        bTc = inverse(board.wTb) @ wTc
        along = np.tensordot(bTc[:3, :3], rays, 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = -bTc[2, 3] / along[2]
            x, y = bTc[0, 3] + depth * along[0], bTc[1, 3] + depth * along[1]
        seen = (depth > 0.05) & (depth < nearest)
        seen &= (np.abs(x) < 0.5 * board.size[0]) & (np.abs(y) < 0.5 * board.size[1])
        at = board.texels * np.stack([y[seen] + 0.5 * board.size[1], x[seen] + 0.5 * board.size[0]])
        image[seen] = ndimage.map_coordinates(board.texture, at, order=1, mode="grid-wrap")
        nearest[seen] = depth[seen]
    return image


def rendered(boards: list[Board], truth: FloatArray, seed: int = 0, scale: float = 1.5) -> Drive:
    """A drive past boards, with odometry of 1 % and 0.2 degrees a step."""
    rig = CameraRig(320, 240, 277.0, 277.0, 159.5, 119.5, 0.1, None, np.eye(4), exact=True)
    rng, images = np.random.default_rng(seed), []
    for wTc in truth:
        pair = [
            view(
                boards,
                rig,
                wTc @ pose(np.eye(3), np.array([-x, 0.0, 0.0])),
                np.full((240, 320), 90.0),
            )
            for x in (rig.baseline, 0.0)
        ]
        images.append(tuple(_grey(one + rng.normal(0.0, 1.5, one.shape)) for one in pair))
    stamps = 0.5 * np.arange(len(truth))
    return Drive(rig, stamps, images, _measured(truth, rig, seed), truth, scale)  # type: ignore[arg-type]


def _grey(levels: FloatArray) -> Image:
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


def _measured(truth: FloatArray, rig: CameraRig, seed: int) -> list[Odometry | None]:
    """The body's motions with noise as stated."""
    rng, out = np.random.default_rng([seed, 1]), [None]
    for before, after in pairwise(truth):
        motion = rig.bTc @ inverse(before) @ after @ inverse(rig.bTc)
        covariance = _noise(motion)
        drawn = rng.normal(size=6) * np.sqrt(np.diagonal(covariance))
        out.append(Odometry(motion @ se3_exp(drawn), covariance))  # type: ignore[arg-type]
    return out  # type: ignore[return-value]


def _noise(motion: FloatArray) -> FloatArray:
    length, turn = np.linalg.norm(motion[:3, 3]), rotation_angle(motion[:3, :3])
    sigmas = [np.radians(0.2) + 0.01 * turn] * 3 + [0.001 + 0.01 * length] * 3
    return np.diag(np.square(sigmas))


def _level(x: FloatArray, z: FloatArray, yaw: FloatArray) -> FloatArray:
    """Poses (n, 4, 4) of a level camera, turned to the right by ``yaw``."""
    return np.array([pose(so3_exp(np.array([0.0, t, 0.0])), np.array([a, 0.0, b]))
                     for a, b, t in zip(x, z, yaw, strict=True)])  # fmt: skip


def _walls(
    places: Iterable[tuple[float, float, float]], width: float, period: float, seed: int
) -> list[Board]:
    """Boards 3 m high at (x, z), facing into the direction that is turned by the third."""
    out = []
    for k, (x, z, yaw) in enumerate(places):
        wTb = pose(so3_exp(np.array([0.0, yaw, 0.0])), np.array([x, 0.0, z]))
        out.append(Board(wTb, (width, 3.0), texture(10 * seed + k, (width, 3.0), period)))
    return out


def _accelerating(n: int, step: float) -> FloatArray:
    """(n,) way of a robot that starts, and drives faster and slower."""
    return np.concatenate([[0.0], np.cumsum(step * (1.0 + 0.5 * np.sin(0.4 * np.arange(n - 1))))])


def room(period: float = 0.0, seed: int = 0) -> Drive:
    """Along a bend in a room of 8 by 8 m, whose walls repeat themselves after a period."""
    angle = _accelerating(46, 0.045)
    return _in_room(period, seed, 2.0 - 2.0 * np.cos(angle), 2.0 * np.sin(angle) - 1.0, angle)


def _in_room(period: float, seed: int, x: FloatArray, z: FloatArray, angle: FloatArray) -> Drive:
    quarter = np.pi / 2
    walls = [(0, 4, 0), (4, 0, quarter), (0, -4, 2 * quarter), (-4, 0, -quarter)]
    return rendered(_walls(walls, 8.0, period, seed), _level(x, z, angle), seed)


def periodic_wall(seed: int = 0) -> Drive:
    """Sideways before a wall of equal columns."""
    return _along_wall(0.3, _accelerating(40, 0.3), seed)


def _along_wall(period: float, way: FloatArray, seed: int) -> Drive:
    walls = _walls([(6.0, 3.0, 0.0)], 24.0, period, seed)
    return rendered(walls, _level(way, 0.0 * way, 0.0 * way), seed)


def equal_corridor(seed: int = 0) -> Drive:
    """Along a corridor, 2.4 m wide, of equal parts, 1.5 m long."""
    way, quarter = _accelerating(40, 0.6), np.pi / 2
    sides = _walls([(-1.2, 15.0, -quarter), (1.2, 15.0, quarter)], 42.0, 1.5, seed)
    return rendered(sides, _level(0.0 * way, way, 0.02 * np.sin(way)), seed)


def sideways(seed: int = 0) -> Drive:
    """Sideways before a wall, faster and slower."""
    return _along_wall(0.0, _accelerating(40, 0.12), seed)


def rotating(seed: int = 0) -> Drive:
    """On the spot in the middle of the room, once around."""
    angle = _accelerating(46, 0.14)
    return _in_room(0.0, seed, 0.0 * angle, 0.0 * angle, angle)


# ------------------------------------------------------------------------------------------
# Recordings


def lab(frames: int = 50) -> Drive:
    """The paper's drive in the rendered lab, by two of its three cameras."""
    return _recorded(
        fg.open_recording(
            "lab_loop", {"dataset.rig.vertical_baseline_m": "null", "dataset.stop": frames}
        ),
        1.2,
    )


def road(data: Path, frames: int = 50) -> Drive:
    """The suburb, with measured odometry."""
    return _recorded(fg.open_recording(data / "kitti_raw_0926_5hz", {"dataset.stop": frames}), 5.0)


def drone(data: Path, frames: int = 50) -> Drive:
    """The drone's key frames; odometry is made from the truth."""
    return _recorded(fg.open_recording(data / "euroc_v101_kf100", {"dataset.stop": frames}), 1.2)


def _recorded(recording: fg.Recording, scale: float) -> Drive:
    frames = list(recording)
    truth = recording.ground_truth
    if truth is None or any(images is None for _, images, _ in frames):
        raise ValueError(f"{recording.name}: every frame needs images and a true pose")
    steps = [odometry for _, _, odometry in frames]
    if steps[1] is None:
        steps = _measured(truth.poses, recording.rig, 0)
    images = [(one[0], one[1]) for _, one, _ in frames if one is not None]
    return Drive(recording.rig, recording.timestamps, images, steps, truth.poses, scale)


@cache
def recordings(data: Path) -> dict[str, Callable[[], Drive]]:
    """By name; each is read once."""
    return {
        "lab": cache(lab),
        "road": cache(lambda: road(data)),
        "drone": cache(lambda: drone(data)),
        "kitti06": cache(lambda: _recorded(fg.open_recording(data / "kitti06"), 5.0)),
        **{name: cache(make) for name, make in RENDERED.items()},
    }


RENDERED: dict[str, Callable[..., Drive]] = {
    "room": lambda seed=0: room(0.0, seed),
    "room of 4 m": lambda seed=0: room(4.0, seed),
    "wall": lambda seed=0: periodic_wall(seed),
    "corridor": lambda seed=0: equal_corridor(seed),
    "sideways": lambda seed=0: sideways(seed),
    "rotating": lambda seed=0: rotating(seed),
}
"""What is rendered by boards; a seed gives other textures and noise."""


# ------------------------------------------------------------------------------------------
# Faults

Fault = Callable[[Drive], Drive]


def wheels(scale: float, first: int = 1, frames: int = 1000) -> Fault:
    """Wheels that report so many times their way, from a frame on; -1: the motion reversed."""

    def wrong(step: Odometry) -> Odometry:
        motion = step.motion.copy()
        if scale < 0.0:
            motion = inverse(motion)
        elif scale == 0.0:
            motion = np.eye(4)
        else:
            motion[:3, 3] *= scale
        return Odometry(
            motion, _noise(motion) if scale <= 0.0 else max(scale, 1.0) * step.covariance
        )

    def act(drive: Drive) -> Drive:
        steps = [
            wrong(step) if step and first <= k < first + frames else step
            for k, step in enumerate(drive.odometry)
        ]
        return replace(drive, odometry=steps)

    return act


def images_of(change: Callable[[Drive, int], tuple[Image, Image]]) -> Fault:
    """Other images from the frame on at which faults begin."""
    return lambda drive: replace(drive, images=[
        change(drive, k) if k >= BEGINS else pair for k, pair in enumerate(drive.images)
    ])  # fmt: skip


def stated(fault: Fault) -> Fault:
    """A fault of the rig, whose calibration is then not exact, even of rendered images."""
    return lambda drive: fault(replace(drive, rig=replace(drive.rig, exact=False)))


def turned(yaw: float, pitch: float, roll: float, drifts: bool = False) -> Fault:
    """The left camera turned against the right one, degrees."""

    def change(drive: Drive, k: int) -> tuple[Image, Image]:
        share = (k - BEGINS) / (len(drive) - BEGINS) if drifts else 1.0
        rig, (left, right) = drive.rig, drive.images[k]
        camera = np.array([[rig.fx, 0.0, rig.cx], [0.0, rig.fy, rig.cy], [0.0, 0.0, 1.0]])
        warp = camera @ so3_exp(share * np.radians([pitch, yaw, roll])) @ np.linalg.inv(camera)
        size = (left.shape[1], left.shape[0])
        warped = cv2.warpPerspective(left, warp, size, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(warped, np.uint8), right

    return stated(images_of(change))


def body(
    speed: float,
    width: float,
    start: float,
    height: float = 1.0,
    lasts: int = 1000,
    first: int = BEGINS,
) -> Fault:
    """A textured body before the camera.

    Args:
        speed: to the left, metres a second for what is 5 m away, less for what is nearer.
        width: share of the view.
        start: its left edge at first, share of the view from the left.
        height: share of the view, from below.
        lasts: frames.
        first: frame.
    """

    def act(drive: Drive) -> Drive:
        rig, z, period = drive.rig, drive.scale, float(np.median(np.diff(drive.stamps)))
        across, down = z * rig.width / rig.fx, z * rig.height / rig.fy
        size, images = (width * across, height * down), list(drive.images)
        board = Board(np.eye(4), size, texture(77, size), 60.0)
        pixels = 0.5 * rig.fx / z  # a texel is two pixels
        grey = np.random.default_rng(5).normal(
            size=(round(pixels * size[1]), round(pixels * size[0]))
        )
        grey = sum(ndimage.gaussian_filter(grey, s) / s for s in (0.8, 2.0, 6.0))
        board = replace(
            board, texture=128.0 + 30.0 * (grey - grey.mean()) / grey.std(), texels=pixels
        )
        for k in range(first, min(first + lasts, len(drive))):
            x = (start - 0.5) * across + 0.5 * size[0] - speed * z / 5.0 * period * (k - first)
            y = 0.5 * down - 0.5 * size[1]
            placed = replace(board, wTb=pose(np.eye(3), np.array([x, y, z])))
            pair = [
                view(
                    [placed], rig, pose(np.eye(3), np.array([-b, 0.0, 0.0])), one.astype(np.float64)
                )
                for b, one in zip((rig.baseline, 0.0), images[k], strict=True)
            ]
            noise = np.random.default_rng([k, 3]).normal(0.0, 1.0, pair[0].shape)
            images[k] = _grey(pair[0] + noise), _grey(pair[1] + noise[::-1])
        return replace(drive, images=images)

    return act


def standing(drive: Drive) -> Drive:
    """The robot stands for twenty frames."""
    n, rng = len(drive), np.random.default_rng(8)
    rows = np.clip(
        np.arange(n + LASTS) - np.clip(np.arange(n + LASTS) - BEGINS, 0, LASTS), 0, n - 1
    )
    truth = drive.truth[rows]
    stands = np.append(False, np.diff(rows) == 0)
    images = [
        tuple(
            _grey(one + rng.normal(0.0, 1.5, one.shape)) if still else one
            for one in drive.images[row]
        )
        for row, still in zip(rows.tolist(), stands, strict=True)
    ]
    steps = [
        Odometry(se3_exp(rng.normal(size=6) * np.repeat([2e-4, 1e-3], 3)), _noise(np.eye(4)))
        if still else drive.odometry[row]
        for row, still in zip(rows.tolist(), stands, strict=True)
    ]  # fmt: skip
    stamps = drive.stamps[0] + np.median(np.diff(drive.stamps)) * np.arange(len(rows))
    return Drive(drive.rig, stamps, images, steps, truth, drive.scale)  # type: ignore[arg-type]


def train(drive: Drive) -> Drive:
    """Something passes a standing robot that fills its view."""
    return body(1.5, 6.0, -0.5, 1.2, LASTS - 4, BEGINS + 2)(standing(drive))


def off_centre(drive: Drive) -> Drive:
    """A calibration whose principal point is off by eight pixels."""
    return replace(drive, rig=replace(drive.rig, cx=drive.rig.cx + 8.0))


def _darker(drive: Drive, k: int) -> tuple[Image, Image]:
    left, right = drive.images[k]
    return (left // 2).astype(np.uint8), right


def _blurred(drive: Drive, k: int) -> tuple[Image, Image]:
    left, right = drive.images[k]
    return np.asarray(cv2.GaussianBlur(left, (0, 0), 3.0), np.uint8), right


def _torn(drive: Drive, k: int) -> tuple[Image, Image]:
    (left, right), (before, _) = drive.images[k], drive.images[k - 1]
    half = len(left) // 2
    return np.concatenate([before[:half], left[half:]]), right


def _reflecting(drive: Drive, k: int) -> tuple[Image, Image]:
    """A pane over the left half of the view, in which the right half is reflected."""
    left, right = drive.images[k]
    pane = np.arange(left.shape[1]) < left.shape[1] // 2
    return tuple(  # type: ignore[return-value]
        _grey(np.where(pane, 0.4 * one + 0.6 * other[:, ::-1], one))
        for one, other in ((left, right), (right, left))
    )


def _out_of_order(drive: Drive, k: int) -> tuple[Image, Image]:
    return drive.images[min(k + (1, 1, -2)[k % 3], len(drive) - 1)]


def _swapped(drive: Drive, k: int) -> tuple[Image, Image]:
    return drive.images[{LASTS: LASTS + 1, LASTS + 1: LASTS}.get(k, k)]


def _shuffled(drive: Drive, k: int) -> tuple[Image, Image]:
    order = np.random.default_rng(4).permutation(10)
    return drive.images[LASTS - 5 + order[k - LASTS + 5] if 0 <= k - LASTS + 5 < 10 else k]


def ending(fault: Fault) -> Fault:
    """A drive that ends eight frames after a fault begins, before windows of frames decide."""

    def act(drive: Drive) -> Drive:
        return fault(drive).first(BEGINS + 8)

    return act


def late(frames: int) -> Fault:
    """Odometry of so many steps before."""
    return lambda d: replace(d, odometry=[None, *d.odometry[1:2] * frames, *d.odometry[1:-frames]])


def axes(drive: Drive) -> Drive:
    """Odometry in axes of another convention: x where z should be, and so on."""
    turn = pose(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.zeros(3))
    steps = [s and replace(s, motion=turn @ s.motion @ inverse(turn)) for s in drive.odometry]
    return replace(drive, odometry=steps)


def alone(fault: Fault) -> Fault:
    """A fault of images, where nothing measures odometry."""
    return lambda drive: fault(replace(drive, odometry=[None] * len(drive)))


def calibrated(**factors: float) -> Fault:
    """Numbers of the rig, as stated, that are so many times the true ones."""

    def act(drive: Drive) -> Drive:
        numbers = {name: factor * getattr(drive.rig, name) for name, factor in factors.items()}
        return replace(drive, rig=replace(drive.rig, **numbers))

    return stated(act)


def _dark(drive: Drive, k: int) -> tuple[Image, Image]:
    if k >= BEGINS + LASTS:
        return drive.images[k]
    noise = np.random.default_rng(k).normal(0.0, 1.0, (2, *drive.images[k][0].shape))
    left, right = (_grey(0.02 * one + n) for one, n in zip(drive.images[k], noise, strict=True))
    return left, right


def turning(scale: float) -> Fault:
    """Odometry whose turns are so many times the true ones."""

    def wrong(step: Odometry) -> Odometry:
        motion = step.motion.copy()
        motion[:3, :3] = so3_exp(scale * so3_log(motion[:3, :3]))
        return replace(step, motion=motion)

    return lambda drive: replace(drive, odometry=[s and wrong(s) for s in drive.odometry])


def _jumping(*cameras: int) -> Fault:
    """Exposure that jumps from frame to frame, in these images."""

    def change(drive: Drive, k: int) -> tuple[Image, Image]:
        gain = (1.0, 0.6, 0.8)[k % 3]
        left, right = (
            _grey(gain * one.astype(np.float64)) if camera in cameras else one
            for camera, one in enumerate(drive.images[k])
        )
        return left, right

    return images_of(change)


FAULTS: dict[str, tuple[Fault, tuple[str, ...]]] = {
    "all cameras frozen": (images_of(lambda d, k: d.images[BEGINS]), ("road", "lab")),
    "left one frozen": (
        images_of(lambda d, k: (d.images[BEGINS][0], d.images[k][1])),
        ("road", "lab"),
    ),
    "left one late": (
        images_of(lambda d, k: (d.images[k - 1][0], d.images[k][1])),
        ("road", "lab"),
    ),
    "left one darker": (images_of(_darker), ("road", "lab")),
    "hood over a third": (body(0.0, 1.0, 0.0, 0.34, first=0), ("lab", "road", "drone")),
    "hood over half": (body(0.0, 1.0, 0.0, 0.5, first=0), ("lab", "road", "drone")),
    "bus, walking pace": (body(1.4, 0.75, 0.4, 0.9, LASTS), ("lab", "road", "drone")),
    "bus, fast": (body(5.6, 2.0, 0.4, 0.9, LASTS), ("lab", "road", "drone")),
    "train, robot stands": (train, ("lab", "room")),
    "shelf carried along": (body(0.0, 0.7, 0.15, 0.9, LASTS), ("lab", "room", "road")),
    "periodic wall": (lambda drive: drive, ("wall",)),
    "equal corridor": (lambda drive: drive, ("corridor",)),
    "wheels slip x 10": (wheels(10.0, BEGINS, 15), ("lab", "room", "road", "drone")),
    "wheels slip throughout": (wheels(10.0), ("lab", "room")),
    "wheels stuck": (wheels(0.0, BEGINS), ("lab", "room", "road")),
    "wheels x 1.5": (wheels(1.5), ("lab", "room", "road")),
    "wheels reversed": (wheels(-1.0), ("lab", "room of 4 m", "road")),
    "yaw knocked 0.25": (turned(0.25, 0.0, 0.0), ("road", "lab")),
    "yaw drifts 0.4": (turned(0.4, 0.0, 0.0, drifts=True), ("road", "lab")),
    "pitch, roll 0.3": (turned(0.0, 0.3, 0.3), ("road", "lab")),
    "principal point 8 px": (stated(off_centre), ("road", "lab")),
    "left one blurred": (images_of(_blurred), ("road", "lab")),
    "left one torn": (images_of(_torn), ("road", "lab")),
    "exchanged": (images_of(lambda d, k: (d.images[k][1], d.images[k][0])), ("road", "lab")),
    "mirrored": (
        images_of(lambda d, k: tuple(one[:, ::-1].copy() for one in d.images[k])),  # type: ignore[arg-type,return-value]
        ("road", "lab"),
    ),
    "every third repeated": (
        images_of(lambda d, k: d.images[k - (k % 3 == 0)]),
        ("road", "lab"),
    ),
    "yaw knocked, drive ends": (ending(turned(0.25, 0.0, 0.0)), ("road", "lab", "kitti06")),
    "out of order": (images_of(_out_of_order), ("road", "lab", "kitti06", "drone", "room")),
    "two images swapped": (images_of(_swapped), ("road", "lab", "kitti06", "room")),
    "ten images shuffled": (images_of(_shuffled), ("road", "lab", "kitti06", "room")),
    "reflection": (images_of(_reflecting), ("road", "lab", "kitti06")),
    "poster carried along": (body(0.0, 0.3, 0.6, 0.5), ("road", "lab")),
    "odometry late": (late(1), ("road", "lab")),
    "turns x 0.9": (turning(0.9), ("road", "lab", "room")),
    "wheels x 0.8": (wheels(0.8), ("road", "lab", "room")),
    "wheels in cm": (wheels(100.0), ("lab", "kitti06", "drone")),
    "wheels in km": (wheels(0.001), ("lab", "kitti06", "drone")),
    "turns in degrees": (turning(57.3), ("lab", "kitti06", "drone")),
    "turns reversed": (turning(-1.0), ("lab", "kitti06", "drone")),
    "axes swapped": (axes, ("lab", "kitti06", "drone")),
    "odometry late by 5": (late(5), ("lab", "kitti06", "drone")),
    "baseline x 1.2": (calibrated(baseline=1.2), ("lab", "kitti06", "drone")),
    "focal length x 1.1": (calibrated(fx=1.1, fy=1.1), ("lab", "kitti06", "drone")),
    "light off": (images_of(_dark), ("lab", "kitti06", "drone")),
    "left upside down": (
        images_of(lambda d, k: (d.images[k][0][::-1, ::-1].copy(), d.images[k][1])),
        ("lab", "kitti06", "drone"),
    ),
    "out of order, no odometry": (alone(images_of(_out_of_order)), ("lab", "kitti06")),
    "ten shuffled, no odometry": (alone(images_of(_shuffled)), ("lab", "kitti06")),
}
"""Faults, and the recordings that each is tried on."""

SOUND = dict.fromkeys(("lab", "road", "drone"), (1, 2, 3, 4, 5, 6)) | {
    "room": (1, 2), "room of 4 m": (1, 2)
}  # fmt: skip
"""Strides of sound recordings."""

HARMLESS: dict[str, tuple[Fault, tuple[str, ...]]] = {
    "brightness jumps": (_jumping(0, 1), ("lab", "road", "drone", "room")),
    "brightness jumps in one image": (_jumping(0), ("lab", "road", "drone", "room")),
    "sideways": (lambda drive: drive, ("sideways",)),
    "rotating": (lambda drive: drive, ("rotating",)),
    "standing": (standing, ("lab", "road", "drone", "room")),
}
"""What no cause may be named for but the exposure, and the recordings that each is tried on."""


# ------------------------------------------------------------------------------------------
# What the default live run makes of a drive


@dataclass(frozen=True)
class Outcome:
    """How a run ended: its end error and stated deviation, metres; what it says of itself."""

    error_m: float
    sigma_m: float
    statuses: Mapping[str, int]
    causes: tuple[str, ...]
    exits: int

    @property
    def sigmas(self) -> float:
        """The error over its stated deviation."""
        return self.error_m / max(self.sigma_m, 1e-9)

    @property
    def cells(self) -> tuple[Cell, ...]:
        """Of a table's row."""
        usual = ("first", "ok")
        odd = ", ".join(
            f"{n} {name}" for name, n in sorted(self.statuses.items()) if name not in usual
        )
        told = "; ".join(self.causes)
        return (self.error_m, self.sigma_m, self.sigmas, odd, told, self.exits,
                "yes" if self.honest else "NO")  # fmt: skip

    @property
    def honest(self) -> bool:
        """Whether the error is within what is stated, or the run names a cause and fails."""
        return self.sigmas <= _SIGMAS or bool(self.causes and self.exits)


def outcome(drive: Drive) -> Outcome:
    """Pushes the frames, as `fgslam run` does, and reads what it states at its end."""
    with Session(drive.rig) as slam:
        for t, images, odometry in zip(drive.stamps, drive.images, drive.odometry, strict=True):
            slam.track(float(t), images, odometry)
        found, parts = slam.result(), slam.pipeline.tracker.parts
        known, misplaced = slam.pipeline.calibration, slam.pipeline.witnesses.misplaced
        enough = located(slam.recorder, parts, known, misplaced).enough
    last = found.trajectory.poses[-1]
    n = len(drive) - len(found.trajectory.poses)
    true = inverse(drive.truth[n]) @ drive.truth[-1]
    sigma = float(np.sqrt(np.trace(found.covariances[-1][3:, 3:])))
    error = float(np.linalg.norm((inverse(found.trajectory.poses[0]) @ last)[:3, 3] - true[:3, 3]))
    causes = tuple(one.code for one in found.remarks if isinstance(one, Remark))
    statuses = Counter(str(status) for status in found.column("status"))
    return Outcome(error, sigma, statuses, causes, 0 if enough else 3)


_COLUMNS = ("error m", "sigma m", "error/sigma", "status", "cause", "exit", "honest")


def tables(data: Path) -> list[Table]:
    """Each fault on its recordings; sound recordings at several strides."""
    known, out = recordings(data), []
    for title, cases in (("Faults of images, odometry and rig", FAULTS), ("Harmless", HARMLESS)):
        rows: list[tuple[Cell, ...]] = []
        for what, (act, names) in cases.items():
            for name in names:
                say(f"{what}: {name}")
                rows.append((what, name, *outcome(act(known[name]())).cells))
        out.append(Table(title, ("what", "recording", *_COLUMNS), rows))
    rows = []
    for name, strides in SOUND.items():
        for stride in strides:
            say(f"sound: {name}, stride {stride}")
            rows.append((name, stride, *outcome(known[name]().every(stride)).cells))
    return [*out, Table("Sound recordings", ("recording", "stride", *_COLUMNS), rows)]


SEEDS = range(1, 21)
"""Of rendered rooms."""


def seeds_table() -> Table:
    """Each fault, and what is harmless, in rendered rooms over seeds."""
    cases: list[tuple[str, str, Fault]] = [
        (what, name, act)
        for what, (act, names) in {**FAULTS, **HARMLESS}.items()
        for name in names
        if name in RENDERED
    ]
    cases += [("sound", name, lambda drive: drive) for name in ("room", "room of 4 m")]
    found: dict[tuple[str, str], list[Outcome]] = {}
    for seed in SEEDS:
        drives = {name: make(seed) for name, make in RENDERED.items()}
        for what, name, act in cases:
            say(f"seed {seed}, {what}: {name}")
            found.setdefault((what, name), []).append(outcome(act(drives[name])))
    rows: list[tuple[Cell, ...]] = []
    for (what, name), outcomes in found.items():
        causes = Counter(code for one in outcomes for code in one.causes)
        told = ", ".join(f"{n} {code}" for code, n in sorted(causes.items()))
        honest, sigmas = [one.honest for one in outcomes], [one.sigmas for one in outcomes]
        exits = sum(one.exits > 0 for one in outcomes)
        rows.append((what, name, sum(honest), len(honest), float(np.median(sigmas)), max(sigmas),
                     told, exits))  # fmt: skip
    columns = ("what", "recording", "honest", "seeds", "median error/sigma", "largest", "causes",
               "exit 3")  # fmt: skip
    return Table("Rendered rooms over seeds", columns, rows)
