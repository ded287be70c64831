"""The rendered lab through lenses: raw cameras with distortion, turned a little against the rig.

Rays are rendered through each lens directly, so no image is resampled but by the rectification
under test. The same rectified view, rendered as ideal pinhole cameras, is what it is held against.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from fgslam.cameras.calib_json import raw_values
from fgslam.cameras.lenses import Calibration, RawCamera
from fgslam.cameras.rig import StereoRig, load_rig
from fgslam.cameras.write_formats import write_calibration
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import FrameError
from fgslam.core.geometry import inverse, pose, so3_exp
from fgslam.core.log import Frame
from fgslam.core.sensors import CameraRig, Odometry, PoseFrame
from fgslam.core.types import Trajectory
from fgslam.datasets.rendered import RENDER_VERSION, RenderedLabSequence
from fgslam.worlds.lab import PlaceChoice, Room, World, open_room
from fgslam.worlds.renderer import RenderCache, Renderer, apply_effects, content_hash, omni_view
from fgslam.worlds.settings import RenderedLabSettings

_THREADS = 2


@dataclass(frozen=True)
class LensSettings:
    """A real camera beside the ideal one that it was meant to be.

    Attributes:
        focal: over the ideal focal length.
        centre_px: principal point against the image's middle.
        radtan: k1, k2, p1, p2.
        turn_deg: about the camera's x, y and z axes.
    """

    focal: float
    centre_px: tuple[float, float]
    radtan: tuple[float, float, float, float]
    turn_deg: tuple[float, float, float]


LENSES = (
    LensSettings(1.000, (3.1, -2.2), (-0.284, 0.075, 2e-4, -3e-4), (0.6, -0.9, 0.5)),
    LensSettings(1.010, (-2.4, 1.7), (-0.279, 0.070, -4e-4, 1e-4), (-0.8, 0.7, -0.9)),
    LensSettings(0.995, (1.2, 2.9), (-0.291, 0.081, 3e-4, 2e-4), (0.4, 0.8, 1.1)),
)
"""Of right, left and top camera: distortion as EuRoC's cameras have it (Burri et al. 2016)."""


def raw_cameras(rig: CameraRig, lenses: Sequence[LensSettings] = LENSES) -> tuple[RawCamera, ...]:
    """Right, left[, top] camera where an ideal rig has its own, each with its lens and turn."""
    names = ("right", "left", "top")
    return tuple(
        _raw_camera(rig, offset, lens, name)
        for offset, lens, name in zip(rig.camera_poses, lenses, names, strict=False)
    )


def _raw_camera(rig: CameraRig, offset: FloatArray, lens: LensSettings, name: str) -> RawCamera:
    focal, (column, row) = lens.focal * rig.fx, lens.centre_px
    matrix = np.array([[focal, 0.0, rig.cx + column], [0.0, focal, rig.cy + row], [0.0, 0.0, 1.0]])
    turn = pose(so3_exp(np.deg2rad(lens.turn_deg)), np.zeros(3))
    bTc = rig.bTc @ offset @ turn
    return RawCamera(rig.width, rig.height, matrix, np.array(lens.radtan), bTc, name)


def loaded(cameras: Sequence[RawCamera]) -> StereoRig:
    """The rig as a user loads it: true calibration in a file, left camera first."""
    right, left, *top = cameras
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cameras.json"
        write_calibration(Calibration("lab", "", (left, right, *top), sided=True), path)
        return load_rig(path)


# --------------------------------------------------------------------------------------------
# Recordings


class _Shots(Protocol):
    """What one frame's cameras see."""

    def images(self, wTb: FloatArray) -> FloatArray:
        """Grey levels (cameras, h, w) of a body's pose (4, 4) in the room."""


class _ThroughLenses:
    """Raw images."""

    def __init__(self, cameras: Sequence[RawCamera], room: Room) -> None:
        self._room, self._cameras = room, cameras
        views = [omni_view(_Rays(camera)) for camera in cameras]
        self._renderers = [Renderer(view, room.bank) for view in views]

    def images(self, wTb: FloatArray) -> FloatArray:
        """Grey levels (cameras, h, w)."""
        return np.array(
            [
                renderer.image(self._room.layer, wTb @ camera.bTc)[..., 0]
                for renderer, camera in zip(self._renderers, self._cameras, strict=True)
            ]
        )


class _ThroughPinholes:
    """Images that are rectified as they are."""

    def __init__(self, rig: CameraRig, room: Room) -> None:
        self._world, self._poses = World(rig, room), [rig.bTc @ o for o in rig.camera_poses]

    def images(self, wTb: FloatArray) -> FloatArray:
        """Grey levels (cameras, h, w)."""
        return np.array([self._world.image(wTb @ bTc, []) for bTc in self._poses])


@dataclass(frozen=True)
class _Rays:
    """A raw camera as the renderer takes any camera; rays in the camera's own axes."""

    camera: RawCamera

    @property
    def width(self) -> int:
        """Pixels."""
        return self.camera.width

    @property
    def height(self) -> int:
        """Pixels."""
        return self.camera.height

    def rays(self, pixels: FloatArray) -> FloatArray:
        """Unit rays (n, 3) of pixels (n, 2)."""
        return self.camera.unproject(pixels)

    def pixels(self, rays: FloatArray) -> FloatArray:
        """Pixels (n, 2) of rays (n, 3)."""
        return self.camera.project(rays)


class RigInTheLab:
    """The lab's drive seen by another rig; implements ``Sequence``.

    Drive, odometry and noise are those of the lab at the same seed. Noise is added to what the
    cameras deliver, before the rig rectifies it.
    """

    def __init__(
        self,
        settings: RenderedLabSettings,
        seed: int,
        rig: CameraRig,
        raw: Sequence[RawCamera] = (),
    ) -> None:
        """Renders what the cache lacks.

        Args:
            settings: the lab; its own rig gives drive and odometry.
            seed: of noise and odometry.
            rig: what sees the lab, rectified; a StereoRig rectifies the images of ``raw``.
            raw: right, left[, top] camera, of which the rig may use the first two; none: ideal
                pinhole cameras.
        """
        frames = (settings.start, settings.stop, settings.stride)
        self._lab = RenderedLabSequence(settings, seed, *frames)
        self._rig, self._seed, self._effects = rig, seed, settings.effects
        self._numbers = settings.start + settings.stride * np.arange(len(self._lab))
        in_room = self._lab.room_from_camera(self._lab.timestamps)
        self._body = in_room @ inverse(self._lab.rig.bTc)
        description = _description(settings, rig, raw)
        width, height = raw[0].size if raw else (rig.width, rig.height)
        shape = (len(raw) or rig.cameras, height, width)
        self._cache = RenderCache(content_hash(description), description, shape)
        self._render(PlaceChoice.of(settings), raw)

    def _render(self, place: PlaceChoice, raw: Sequence[RawCamera]) -> None:
        missing = [i for i, n in enumerate(self._numbers) if not self._cache.present(int(n))]
        if not missing:
            return
        room = open_room(place)
        shots: _Shots = _ThroughLenses(raw, room) if raw else _ThroughPinholes(self._rig, room)

        def one(i: int) -> None:
            levels = np.clip(np.rint(shots.images(self._body[i])), 0, 255)
            self._cache.write(int(self._numbers[i]), levels.astype(np.uint8))

        with ThreadPoolExecutor(_THREADS) as pool:
            list(pool.map(one, missing))

    @property
    def name(self) -> str:
        """Short name for titles."""
        return f"{self._lab.name}, another rig"

    @property
    def rig(self) -> CameraRig:
        """The rectified rig."""
        return self._rig

    @property
    def timestamps(self) -> FloatArray:
        """(n,) seconds, the lab's."""
        return self._lab.timestamps

    @property
    def identity(self) -> str:
        """The lab's and the rig's."""
        return content_hash({"lab": self._lab.identity, "folder": self._cache.folder.name})

    @property
    def notes(self) -> tuple[str, ...]:
        """What the calibration gave rise to say."""
        return self._rig.remarks if isinstance(self._rig, StereoRig) else ()

    def __len__(self) -> int:
        """Frames."""
        return len(self._lab)

    def frame(self, i: int) -> Frame:
        """Rectified images of frame ``i``."""
        number = int(self._numbers[i])
        clean = self._cache.read(number)
        if clean is None:
            raise FrameError(f"frame {number} has gone from {self._cache.folder}; run it again")
        clean = clean[: self._rig.cameras]
        images = apply_effects(clean, self._effects, number, self._seed)
        margins: tuple[npt.NDArray[np.float32], ...] = ()
        if isinstance(self._rig, StereoRig):
            images, margins = self._rig.rectified(images), self._rig.margins
        return Frame(number, float(self.timestamps[i]), images, margins)

    def odometry(self, i: int) -> Odometry | None:
        """The lab's."""
        return self._lab.odometry(i)

    @property
    def truth_frame(self) -> PoseFrame:
        """The right camera."""
        return "right"

    @property
    def ground_truth(self) -> Trajectory:
        """Exact poses of the rectified right camera, the first one at the origin."""
        poses = self._body @ self._rig.bTc
        return Trajectory(self.timestamps, inverse(poses[0]) @ poses)


def _description(
    settings: RenderedLabSettings, rig: CameraRig, raw: Sequence[RawCamera]
) -> dict[str, Any]:
    """What shapes the clean images."""
    lab = {name: asdict(settings)[name] for name in ("drive", "room_seed", "visit", "place")}
    if raw:
        seen = raw_values(Calibration("", "", tuple(raw)))
    else:
        numbers = (rig.width, rig.height, rig.fx, rig.cx, rig.cy, rig.baseline)
        seen = {"rig": [*numbers, rig.vertical_baseline], "bTc": rig.bTc.tolist()}
    return {"lab": lab, "cameras": seen, "render_version": RENDER_VERSION}
