"""Turns a run's measurements into a factor graph, frame by frame; every smoother starts from it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any, Protocol

import gtsam
import numpy as np

from fgslam.backend.settings import GraphSettings, KernelSettings
from fgslam.backend.smoothers.admission import LandmarkAdmission, Sighting, Track
from fgslam.backend.smoothers.persistence import MeasurementNoise, Persistence, StatedNoise
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.estimates import LandmarkMap, Prediction
from fgslam.core.floor import Floor
from fgslam.core.geometry import triangulate
from fgslam.core.measurements import Observations, Odometry
from fgslam.core.sensors import CameraRig, Sensor
from fgslam.factors.graphs import landmark_key, pose_key
from fgslam.factors.landmark import RangeBearingFactors, StereoFactors
from fgslam.factors.motion import (
    floor_factors,
    odometry_factor,
    point_prior,
    pose_prior,
)
from fgslam.factors.noise import Whitening, plain

WEAK_PARALLAX = 8.0  # range over its deviation below which a landmark gets a weak prior
_WEAK_PRIOR_RANGES = 2.0  # keeps a first step before the camera: docs/derivations/smoothers.md


class LandmarkFactors(Protocol):
    """Makes the factor of one landmark observation."""

    def factor(
        self, pose: int, landmark: int, measurement: FloatArray, covariance: FloatArray
    ) -> Any:
        """Factor between a pose and a landmark, by key."""
        ...


def landmark_factors(sensor: Sensor, whitening: Whitening) -> LandmarkFactors:
    """The factors of a sensor."""
    if isinstance(sensor, CameraRig):
        return StereoFactors(sensor, whitening)
    return RangeBearingFactors(whitening)


@dataclass(frozen=True, slots=True, eq=False)
class TrackedFrame:
    """A frame as the tracker has it.

    Attributes:
        frame: counted from 0.
        wTc: (4, 4) its pose.
        motion: from the frame before; None for the first.
        accepted: observations that fit.
    """

    frame: int
    wTc: FloatArray
    motion: Odometry | None
    accepted: Observations


@dataclass(slots=True, eq=False)
class NewFactors:
    """What one frame adds.

    Attributes:
        frame: counted from 0.
        graph: the factors.
        values: initial values of the new variables.
        priors: landmark variables, mean (3,) and covariance (3, 3) of what is known of them
            beforehand; where no factors are made of it.
        sightings: landmark variables and what was seen of them, for the same case.
    """

    frame: int
    graph: Any
    values: Any
    priors: list[tuple[int, FloatArray, FloatArray]] = field(default_factory=list)
    sightings: list[tuple[int, Sighting]] = field(default_factory=list)


class GraphBuilder:
    """Poses, landmarks and factors of a run so far.

    Attributes:
        graph: all factors; one taken out leaves an empty slot.
        admission: the landmarks, and which of them the graph holds.
        frames: those whose poses are in the graph, in time order.
        noise: of its landmark observations.
        doubted: the rig, where it calibrates itself.
    """

    def __init__(
        self,
        sensor: Sensor,
        settings: GraphSettings,
        floor: Floor,
        prior: Prediction,
        remember: bool = True,
    ) -> None:
        """An empty graph; ``prior`` will be that of the first pose.

        With ``remember`` off, for a bounded lag, nothing is kept: factors of poses are handed out,
        and observations as they are.
        """
        self._remember = remember
        self._sensor = sensor
        self._settings = settings
        self._floor = floor
        self._prior = prior
        factor = settings.noise_factor
        self.noise: MeasurementNoise = (
            Persistence(sensor) if factor is None else StatedNoise(factor)
        )
        self.doubted: CameraRig | None = None
        self._variance_of: dict[int, float] = {}
        self._weigh()
        self._rows: dict[int, list[int]] = {}
        self._id_of: list[int] = []
        self._seen_frame: list[int] = []
        self._seen_variable: list[int] = []
        self.graph = gtsam.NonlinearFactorGraph()
        self.admission = LandmarkAdmission(sensor, settings)
        self.frames: list[int] = []

    @property
    def kernel(self) -> KernelSettings:
        """Around each observation, its width in the factors' deviations."""
        kernel = self._settings.kernel
        return KernelSettings(kernel.name, kernel.width / self.noise_factor)

    @property
    def noise_factor(self) -> float:
        """By which the factors' deviations exceed those by which wrong matches are judged."""
        return float(np.sqrt(self.noise.power / self.noise.spread))

    def corrects(self, correction: FloatArray | None) -> None:
        """Takes note of what a frame's measurements were corrected by; None: they were not."""
        if correction is not None and isinstance(self._sensor, CameraRig):
            self.doubted = self._sensor

    @property
    def variables(self) -> int:
        """Number of landmark variables made so far."""
        return len(self._id_of)

    def add(self, tracked: TrackedFrame, landmarks: LandmarkMap) -> NewFactors:
        """Adds a frame's pose and observations.

        Args:
            tracked: initial value of the pose, motion from the graph's last frame, observations.
            landmarks: the tracker's map after this frame: initial values, and how well each
                landmark is known given the poses.
        """
        self._weigh()
        new = NewFactors(tracked.frame, gtsam.NonlinearFactorGraph(), gtsam.Values())
        self._add_pose(new, tracked)
        self.frames.append(tracked.frame)
        self._add_observations(new, tracked, landmarks)
        return new

    def start_at(self, prior: Prediction) -> None:
        """Replaces the prior of the first pose, which is not there yet."""
        self._prior = prior

    def take_out(self, variable: int) -> str:
        """Removes a landmark from the graph; it waits until it is known twice as well.

        Returns:
            Its identity and sightings, in words.
        """
        for row in self._rows.pop(variable, []):
            if self._remember:
                self.graph.remove(row)
        words = self.describe(variable)
        self.admission.taken_out(self._id_of[variable], variable)
        return words

    def describe(self, variable: int) -> str:
        """A landmark variable's identity and sightings, in words."""
        return self.admission.describe(self._id_of[variable], variable)

    def forget_before(self, frame: int) -> list[tuple[int, Track]]:
        """For a bounded lag: earlier frames, and landmarks last seen in them, have left the graph.

        Returns:
            Identity and track of those landmarks; their next sighting begins a new variable.
        """
        left = self.admission.leave_before(frame)
        for _, track in left:
            self._rows.pop(track.variable, None)
            track.variable = -1
        return left

    def first_frames(self) -> IntArray:
        """(variables,) the first frame that saw each landmark variable; 0 where none is kept."""
        first = np.full(self.variables, np.iinfo(np.int64).max)
        np.minimum.at(first, self._seen_variable, self._seen_frame)
        return np.where(first < np.iinfo(np.int64).max, first, 0)

    def add_factor(self, factor: Any) -> int:
        """Adds a factor between variables of the graph, as of a loop; returns its row."""
        self.graph.add(factor)
        return int(self.graph.size()) - 1

    def in_graph(self, variable: int) -> bool:
        """Whether a landmark variable still has its factors."""
        return variable in self._rows

    def behind(self, poses: FloatArray, points: dict[int, FloatArray]) -> list[int]:
        """Variables that lie behind a camera that saw them, where a stereo factor says nothing.

        Args:
            poses: (n, 4, 4) ``wTc`` by frame, those of the graph at least.
            points: positions (3,) by variable.
        """
        if not points or not isinstance(self._sensor, CameraRig):
            return []
        frames, seen = np.array(self._seen_frame), np.array(self._seen_variable)
        position = np.full((self.variables, 3), np.nan)
        position[list(points)] = list(points.values())
        offset = position[seen] - poses[frames, :3, 3]
        depth = np.einsum("ki,ki->k", offset, poses[frames, :3, 2])
        # A variable that was taken out has no position, and NaN is not below zero.
        return [int(variable) for variable in np.unique(seen[depth <= 0.0])]

    def seen_last(self, poses: FloatArray) -> dict[int, FloatArray]:
        """Places (3,) of the graph's landmark variables, each from its last sighting alone.

        Args:
            poses: (n, 4, 4) ``wTc`` by frame, those of the graph at least.
        """
        tracks = [t for _, t in self.admission.in_graph() if np.isfinite(poses[t.last.frame, 0, 0])]
        if not tracks:
            return {}
        seen = np.array([track.last.measurement for track in tracks])
        wTc = poses[[track.last.frame for track in tracks]]
        local = triangulate(self._sensor, seen)
        places = np.einsum("kij,kj->ki", wTc[:, :3, :3], local) + wTc[:, :3, 3]
        return {track.variable: place for track, place in zip(tracks, places, strict=True)}

    def kept_factors(self) -> Any:
        """The graph without its empty slots, weighed as is known now what depends on the noise."""
        self._weigh()
        models: dict[tuple[bytes, float], Any] = {}
        out = gtsam.NonlinearFactorGraph()
        for row in range(self.graph.size()):
            if self.graph.exists(row):
                factor, then = self.graph.at(row), self._variance_of.get(row)
                out.add(factor if then is None else self._weighed(factor, then, models))
        return out

    # ----------------------------------------------------------------------------------------

    def _weigh(self) -> None:
        """New factors weigh what depends on the noise as is known now."""
        kernel = self.kernel
        self._power, self._persistence = self.noise.power, self.noise_factor**2
        self._whitening = Whitening(kernel.name, kernel.width)
        self._factors = landmark_factors(self._sensor, self._whitening)

    def _weighed(self, factor: Any, then: float, models: dict[tuple[bytes, float], Any]) -> Any:
        """An observation (with the kernel of now) or a guessed step, as is known now.

        ``then`` is by what its variance was multiplied when it was made.
        """
        now = self._power if factor.dim() == 3 else self._persistence
        if now == then:
            return factor
        covariance = plain(factor).noiseModel().covariance()
        name = covariance.tobytes(), now / then
        if name not in models:
            scaled = now / then * covariance
            gaussian = gtsam.noiseModel.Gaussian.Covariance
            models[name] = (self._whitening.model if factor.dim() == 3 else gaussian)(scaled)
        return factor.cloneWithNewNoiseModel(models[name])

    def _add_pose(self, new: NewFactors, tracked: TrackedFrame) -> None:
        key = pose_key(new.frame)
        new.values.insert(key, gtsam.Pose3(tracked.wTc))
        if not self.frames:
            self._push(new, pose_prior(key, self._prior))
        elif tracked.motion is None:
            raise ValueError(f"frame {new.frame}: no motion from the frame before")
        else:
            self._add_step(new, tracked.motion)
        for factor in floor_factors(key, self._floor, tracked.wTc):
            self._push(new, factor)

    def _add_step(self, new: NewFactors, motion: Odometry) -> None:
        """From the frame before; the errors of one that goes on as before persist like images'.

        Its velocity comes from nothing but matches, and its noise from how far they scatter.
        """
        if not motion.measured:
            covariance = self._persistence * motion.covariance
            motion = dataclasses.replace(motion, covariance=covariance)
        row = self._push(
            new, odometry_factor(pose_key(self.frames[-1]), pose_key(new.frame), motion)
        )
        if not motion.measured:
            self._variance_of[row] = self._persistence

    def _add_observations(
        self, new: NewFactors, tracked: TrackedFrame, landmarks: LandmarkMap
    ) -> None:
        accepted, wTc = tracked.accepted, tracked.wTc
        rows = landmarks.rows(accepted.ids)
        positions = landmarks.positions[rows]
        parallax = _parallax(positions - wTc[:3, 3], landmarks.covariances[rows])
        for i, identity in enumerate(accepted.ids.tolist()):
            sighting = Sighting(new.frame, accepted.measurement[i], accepted.covariance[i])
            track = self.admission.sighted(identity, sighting)
            if track.variable >= 0:
                self._observe(new, track, sighting)
            else:
                track.waiting.append(sighting)
                if self.admission.admits(identity, float(parallax[i])):
                    self._enter(new, identity, positions[i], wTc, float(parallax[i]))

    def _enter(
        self,
        new: NewFactors,
        identity: int,
        position: FloatArray,
        wTc: FloatArray,
        parallax: float,
    ) -> None:
        """A landmark's variable, its prior if it needs one, and all its sightings so far."""
        track = self.admission.tracks[identity]
        track.variable = len(self._id_of)
        self._id_of.append(identity)
        self._rows[track.variable] = []
        key = landmark_key(track.variable)
        new.values.insert(key, position)
        saved = self.admission.saved(identity)
        if saved is not None:
            self._add_prior(new, track.variable, *saved)
        elif parallax < WEAK_PARALLAX:
            sigma = _WEAK_PRIOR_RANGES * float(np.linalg.norm(position - wTc[:3, 3]))
            self._add_prior(new, track.variable, position, sigma**2 * np.eye(3))
        for sighting in track.waiting:
            self._observe(new, track, sighting)
        track.waiting = []

    def _add_prior(
        self, new: NewFactors, variable: int, mean: FloatArray, covariance: FloatArray
    ) -> None:
        if self._remember:
            factor = point_prior(landmark_key(variable), mean, covariance)
            self._rows[variable].append(self._push(new, factor))
        else:
            new.priors.append((variable, mean, covariance))

    def _observe(self, new: NewFactors, track: Track, sighting: Sighting) -> None:
        if not self._remember:
            new.sightings.append((track.variable, sighting))
            return
        factor = self._factors.factor(
            pose_key(sighting.frame),
            landmark_key(track.variable),
            sighting.measurement,
            self._power * sighting.covariance,
        )
        row = self._push(new, factor)
        self._rows[track.variable].append(row)
        self._variance_of[row] = self._power
        self._seen_frame.append(sighting.frame)
        self._seen_variable.append(track.variable)

    def _push(self, new: NewFactors, factor: Any) -> int:
        new.graph.add(factor)
        if self._remember:
            self.graph.add(factor)
        return int(self.graph.size()) - 1


def _parallax(rays: FloatArray, covariances: FloatArray) -> FloatArray:
    """Range over its standard deviation (k,), of points at ``rays`` (k, 3) from the camera."""
    distance = np.linalg.norm(rays, axis=1)
    directions = rays / np.maximum(distance, 1e-12)[:, None]
    variance = np.einsum("ki,kij,kj->k", directions, covariances, directions)
    return np.asarray(distance / np.sqrt(np.maximum(variance, 1e-300)))
