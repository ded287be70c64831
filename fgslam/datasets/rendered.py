"""The rendered lab as a recording with exact ground truth (docs/datasets/rendered.md).

Images are rendered once, cached by the content of the settings that shape them, and get their
noise when they are read. Poses, depths and object identities are exact.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from typing import Any

import numpy as np

from fgslam.core import geometry
from fgslam.core.arrays import FloatArray, Image, IntArray
from fgslam.core.errors import ConfigError, FrameError
from fgslam.core.log import Frame
from fgslam.core.sensors import Odometry, PoseFrame, compose_odometry
from fgslam.core.settings import FrameSelection
from fgslam.core.types import Trajectory
from fgslam.datasets.recording import select_frames
from fgslam.worlds.driving import simulate_wheels
from fgslam.worlds.lab import (
    PlaceChoice,
    Room,
    World,
    first_pose,
    make_rig,
    open_room,
    plan_in_place,
)
from fgslam.worlds.people import make_walk
from fgslam.worlds.renderer import Body, RenderCache, apply_effects, content_hash, is_blocked
from fgslam.worlds.settings import LabSettings, RenderedLabSettings

RENDER_VERSION = 7
"""Part of the cache's key: raised whenever the same settings give other pixels."""

_SHAPING_KEYS = ("rig", "drive", "room_seed", "visit", "place", "posters")
_SELECTION = ("start", "stop", "stride")
_THREADS = 2
_CLEARANCE_M = 0.12
Progress = Callable[[int, int], None]


class RenderedLabSequence:
    """A drive through a rendered place; implements :class:`fgslam.core.log.ImageSequence`.

    The world frame of the ground truth is the reference camera's pose at the first frame of the
    drive; of random poses, at that of the place's own drive.

    Attributes:
        name: short name for titles.
        rig: the exact calibration of the rendered cameras.
        timestamps: (n,) seconds since the drive's first frame.
        identity: SHA-256 of the seed, the renderer's version and all settings but which frames to
            use: that of the whole recording, as those on disk have it, so that a run may go on.
        notes: which effects are on.
        room_from_world: (4, 4) from the trajectory's world to the room (origin on the floor, z up).
        ground_truth: exact poses of the reference camera at the selected frames.
    """

    truth_frame: PoseFrame = "right"

    def __init__(
        self,
        settings: LabSettings,
        seed: int,
        start: int = 0,
        stop: int | None = None,
        stride: int = 1,
        progress: Progress | None = None,
    ) -> None:
        """Plans the drive and renders the selected frames that the cache lacks.

        Args:
            settings: world, rig, drive, odometry and effects.
            seed: of image noise and odometry; renders are shared between seeds.
            start: first of the drive's frames to use.
            stop: the frame after the last one; None for the drive's end.
            stride: use every so many frames.
            progress: called with (frames rendered so far, frames to render).

        Raises:
            ConfigError: the path cannot be driven, or leads through furniture.
            DatasetError: no frame is left, or the cache's folder cannot be written.
            MissingDependencyError: frames must be rendered and Open3D cannot be loaded.
        """
        self._settings = settings
        self._seed = seed
        self.rig = make_rig(settings.rig)
        self._place = PlaceChoice.of(settings)
        self._drive = plan_in_place(self._place, settings.drive, self.rig)
        chosen = FrameSelection(start=start, stop=stop, stride=stride)
        self._indices = select_frames(len(self._drive.timestamps), chosen, "the drive")
        self._body = self._drive.body_poses(self._drive.timestamps)
        self.name = f"rendered {self._place.name}, {settings.drive.path.replace('_', ' ')}"
        self.timestamps: FloatArray = self._drive.timestamps[self._indices]
        effects = {
            "person": settings.effects.person,
            "blocked frames": settings.effects.blocked_frames,
        }
        self.notes = tuple(f"effect: {k}" for k, value in effects.items() if value is not None)
        start_pose = self._body[0]
        if settings.drive.path == "random_poses":
            start_pose = first_pose(settings.place, settings.drive)
        self.room_from_world: FloatArray = start_pose @ self.rig.bTc
        poses = geometry.inverse(self.room_from_world) @ self.room_from_camera(self.timestamps)
        self.ground_truth = Trajectory(self.timestamps, poses)
        self._odometry = simulate_wheels(
            settings.odometry, self._body, np.random.default_rng([seed, 1])
        )
        self._walk = make_walk(settings, self._drive, self.rig)
        self._world: World | None = None
        self._world_lock = threading.Lock()
        # Exactly what shapes the clean images: neither noise, cover, odometry nor seed.
        everything = asdict(settings)
        description = {key: everything[key] for key in _SHAPING_KEYS}
        description |= {"person": settings.effects.person, "render_version": RENDER_VERSION}
        whole = {key: value for key, value in everything.items() if key not in _SELECTION}
        self.identity = content_hash({"settings": whole, "seed": seed, "render": RENDER_VERSION})
        shape = (self.rig.cameras, self.rig.height, self.rig.width)
        self._cache = RenderCache(content_hash(description), description, shape)
        self._render_missing(progress)

    def __len__(self) -> int:
        """Number of selected frames."""
        return len(self._indices)

    def frame(self, i: int) -> Frame:
        """Images of frame ``i`` with their noise; a damaged cached file is rendered again.

        Raises:
            FrameError: there is no frame ``i``.
        """
        index = self._index(i)
        clean = self._cache.read(index)
        if clean is None:
            clean = self._render(index)
            self._cache.write(index, clean)
        images = apply_effects(clean, self._settings.effects, index, self._seed)
        return Frame(index, float(self._drive.timestamps[index]), images)

    def odometry(self, i: int) -> Odometry | None:
        """Wheel odometry from selected frame ``i - 1`` to ``i``; None for the first.

        With a stride the increments between are composed, and so are their covariances. None too
        where the robot was carried.
        """
        last = self._index(i)
        if i == 0:
            return None
        first = self._index(i - 1)
        if not self._drive.driven[first:last].all():
            return None
        return compose_odometry(self._odometry[first:last])

    # ---------------------------------------------------------------- exact truth

    def room_from_camera(self, seconds: FloatArray) -> FloatArray:
        """(n, 4, 4) poses of the reference camera in the room at any times of the drive."""
        return np.asarray(self._drive.body_poses(np.atleast_1d(seconds)) @ self.rig.bTc)

    @property
    def object_names(self) -> tuple[str, ...]:
        """Name of each object identity."""
        return self._open_world().room.things

    def depth(self, i: int) -> FloatArray:
        """(height, width) depth Z in metres of the reference camera's pixels; NaN when blocked."""
        return np.asarray(self._true_pixels(i, World.depth, np.nan), np.float64)

    def object_ids(self, i: int) -> IntArray:
        """(height, width) index into ``object_names`` of the reference camera's pixels.

        -1 where the cover blocks the view.
        """
        return np.asarray(self._true_pixels(i, World.object_ids, -1), np.int64)

    def _true_pixels(self, i: int, seen: Callable[..., Any], blocked: float) -> Any:
        index = self._index(i)
        if is_blocked(self._settings.effects, index):
            return np.full((self.rig.height, self.rig.width), blocked)
        world = self._open_world()
        return seen(world, self._body[index] @ self.rig.bTc, self._bodies(world, index))

    # ---------------------------------------------------------------- rendering

    def _index(self, i: int) -> int:
        if not 0 <= i < len(self._indices):
            raise FrameError(f"frame {i} is outside the recording of {len(self._indices)} frames")
        return int(self._indices[i])

    def _open_world(self) -> World:
        with self._world_lock:
            if self._world is None:
                self._world = World(self.rig, open_room(self._place))
                self._require_clearance(self._world.room)
            return self._world

    def _require_clearance(self, room: Room) -> None:
        """Refuses a drive whose cameras come too near to a surface."""
        cameras = self.room_from_camera(self._drive.timestamps)
        distance, xy = room.caster.distance(cameras[:, :3, 3]), cameras[:, :2, 3]
        outside = np.any((xy < room.low) | (xy > room.high), axis=1)
        bad = np.flatnonzero((distance < _CLEARANCE_M) | outside)
        if len(bad):
            x, y = xy[bad[0]]
            raise ConfigError(
                f"the drive's frame {bad[0]} puts the camera at ({x:.2f}, {y:.2f}) m, into a wall "
                "or furniture; move the points of dataset.drive.waypoints_m"
            )

    def _render_missing(self, progress: Progress | None) -> None:
        missing = [int(i) for i in self._indices if not self._cache.present(int(i))]
        if not missing:
            return
        self._open_world()

        def store(index: int) -> None:
            self._cache.write(index, self._render(index))

        pool = ThreadPoolExecutor(_THREADS)
        try:
            for done, _ in enumerate(pool.map(store, missing), start=1):
                if progress is not None:
                    progress(done, len(missing))
        finally:
            pool.shutdown(wait=True, cancel_futures=True)  # Ctrl-C waits for two frames alone

    def _render(self, index: int) -> Image:
        """Clean images (cameras, height, width) of one of the drive's frames."""
        world = self._open_world()
        pose = self._body[index] @ self.rig.bTc
        bodies = self._bodies(world, index)
        images = [world.image(pose @ offset, bodies) for offset in self.rig.camera_poses]
        return np.clip(np.rint(images), 0, 255).astype(np.uint8)

    def _bodies(self, world: World, index: int) -> list[Body]:
        seconds = float(self._drive.timestamps[index])
        return world.bodies(None if self._walk is None else self._walk.stance(seconds))


def first_camera_pose(settings: RenderedLabSettings) -> FloatArray:
    """(4, 4) pose in the room of the reference camera at the first frame that is used.

    Raises:
        ConfigError: the path cannot be driven.
    """
    rig = make_rig(settings.rig)
    drive = plan_in_place(PlaceChoice.of(settings), settings.drive, rig)
    first = drive.timestamps[settings.start : settings.start + 1]
    return np.asarray(drive.body_poses(first)[0] @ rig.bTc)
