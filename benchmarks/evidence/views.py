"""The rendered lab from exact poses: the paper's two small motions (Se et al. 2.3, 3.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import inverse, pose, so3_exp
from fgslam.core.log import Frame
from fgslam.core.sensors import CameraRig, Odometry, PoseFrame
from fgslam.core.types import Features, Trajectory
from fgslam.datasets.rendered import RenderedLabSequence
from fgslam.frontend.features.sift import SiftExtractor
from fgslam.runs.config import ExperimentConfig
from fgslam.worlds.driving import simulate_wheels
from fgslam.worlds.lab import PlaceChoice, World, open_room
from fgslam.worlds.renderer import apply_effects
from fgslam.worlds.settings import RenderedLabSettings

FORWARD_M = 0.10
CLOCKWISE_DEG = 5.0


@dataclass(frozen=True, eq=False)
class View:
    """One look of the rig: images and features of right, left and top; ``wTc`` in the room."""

    wTc: FloatArray
    frame: Frame
    features: tuple[Features, ...]


class LabViews:
    """The lab of an experiment, looked at from anywhere."""

    def __init__(self, config: ExperimentConfig) -> None:
        """Raises ValueError where the experiment's recording is not the rendered lab."""
        if not isinstance(config.dataset, RenderedLabSettings):
            raise ValueError(f"{config.name} is not an experiment in the rendered lab")
        self.settings, self.seed = config.dataset, config.seed
        self.sequence = RenderedLabSequence(self.settings, self.seed)
        self.rig = self.sequence.rig
        self._world = World(self.rig, open_room(PlaceChoice.of(self.settings)))
        sift = SiftExtractor(config.frontend.sift, config.frontend.appearance.mode)
        self._extract = sift.extract

    def look(self, wTc: FloatArray, number: int) -> View:
        """Renders and finds features; ``number`` selects the image noise."""
        clean = np.array([self._world.image(wTc @ offset, []) for offset in self.rig.camera_poses])
        rounded = np.clip(np.rint(clean), 0, 255).astype(np.uint8)
        images = apply_effects(rounded, self.settings.effects, number, self.seed)
        frame = Frame(number, float(number), images)
        return View(wTc, frame, tuple(self._extract(image) for image in images))

    def triple(self, i: int) -> tuple[View, View, View]:
        """From frame ``i`` of the drive: there, 10 cm forward, then 5 degrees clockwise."""
        seconds = self.sequence.timestamps[i : i + 1]
        start = self.sequence.room_from_camera(seconds)[0]
        forward = start @ pose(np.eye(3), np.array([0.0, 0.0, FORWARD_M]))
        turned = forward @ pose(
            so3_exp(np.array([0.0, np.deg2rad(CLOCKWISE_DEG), 0.0])), np.zeros(3)
        )
        # Numbers beyond the drive's own frames: noise of their own.
        first = 100_000 + 3 * i
        return (
            self.look(start, first),
            self.look(forward, first + 1),
            self.look(turned, first + 2),
        )


@dataclass(frozen=True, eq=False)
class ViewPair:
    """Two views as a recording of two frames; implements ``Sequence``."""

    rig: CameraRig
    views: tuple[View, View]
    step: Odometry

    @property
    def name(self) -> str:
        """Short name for titles."""
        return "two views"

    @property
    def timestamps(self) -> FloatArray:
        """One second apart."""
        return np.array([0.0, 1.0])

    @property
    def identity(self) -> str:
        """None is needed: nothing is saved."""
        return ""

    def __len__(self) -> int:
        """Two."""
        return 2

    def frame(self, i: int) -> Frame:
        """Images of one of the views."""
        return self.views[i].frame

    def odometry(self, i: int) -> Odometry | None:
        """What the wheels report of the motion of the robot's body."""
        return self.step if i == 1 else None

    @property
    def truth_frame(self) -> PoseFrame:
        """The right camera."""
        return "right"

    @property
    def ground_truth(self) -> Trajectory:
        """Exact poses, the first one at the origin."""
        return Trajectory(self.timestamps, np.array([np.eye(4), self.motion]))

    @property
    def notes(self) -> tuple[str, ...]:
        """No remarks."""
        return ()

    @property
    def motion(self) -> FloatArray:
        """The true motion (4, 4) of the reference camera."""
        return np.asarray(inverse(self.views[0].wTc) @ self.views[1].wTc)


def make_pair(lab: LabViews, views: tuple[View, View], rng: np.random.Generator) -> ViewPair:
    """Two views with wheel odometry of the lab's own drift model between them."""
    bodies = np.array([view.wTc @ inverse(lab.rig.bTc) for view in views])
    return ViewPair(lab.rig, views, simulate_wheels(lab.settings.odometry, bodies, rng)[0])
