"""Turns a run's measurements into a factor graph, frame by frame; every smoother starts from it."""

from __future__ import annotations

import dataclasses
from array import array
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np

from fgslam.backend.persistence import MeasurementNoise, Persistence, StatedNoise
from fgslam.backend.self_calibration import KnownCorrections, RigChange
from fgslam.backend.settings import GraphSettings, KernelSettings
from fgslam.backend.smoothers.admission import LandmarkAdmission, Sighting, Track
from fgslam.backend.smoothers.turns import Turn, TurnedStep
from fgslam.backend.smoothers.whole_graph import State, WholeGraph
from fgslam.core.arrays import FloatArray, GrowingColumns, IntArray
from fgslam.core.estimates import LandmarkMap, Prediction
from fgslam.core.floor import Floor
from fgslam.core.geometry import triangulate
from fgslam.core.measurements import Observations, Odometry
from fgslam.core.rig_correction import RigCorrection
from fgslam.core.sensors import CameraRig
from fgslam.factors.graphs import landmark_key, pose_key
from fgslam.factors.landmark import StereoFactors, whitening
from fgslam.factors.motion import floor_factors, point_prior, pose_prior, step_factor
from fgslam.factors.noise import Whitening, scaled

WEAK_PARALLAX = 8.0  # range over its deviation below which a landmark gets a weak prior
_WEAK_PRIOR_RANGES = 2.0  # keeps a first step before the camera: docs/derivations/smoothers.md


@dataclass(frozen=True, slots=True, eq=False)
class TrackedFrame:
    """A frame as the tracker has it.

    Attributes:
        frame: counted from 0.
        wTc: (4, 4) its pose.
        motion: from the frame before; None for the first.
        accepted: observations that fit.
        turn: what the bias of a gyroscope does to the motion.
        located: (6, 6) covariance with which it was found in the map without a prior; else None.
    """

    frame: int
    wTc: FloatArray
    motion: Odometry | None
    accepted: Observations
    turn: Turn | None = None
    located: FloatArray | None = None


@dataclass(slots=True, eq=False)
class NewFactors:
    """What one frame adds.

    Attributes:
        frame: counted from 0.
        graph: the factors, but for observations.
        values: initial values of the new variables.
        priors: landmark variables, mean (3,) and covariance (3, 3) of what is known of them
            beforehand; where no factors are made of it.
        sightings: landmark variables and what was seen of them.
    """

    frame: int
    graph: Any
    values: Any
    priors: list[tuple[int, FloatArray, FloatArray]] = field(default_factory=list)
    sightings: list[tuple[int, Sighting]] = field(default_factory=list)


class GraphBuilder:
    """Poses, landmarks and factors of a run so far.

    Attributes:
        graph: all factors but observations; one taken out leaves an empty slot.
        observed: the observations: frame, variable, measurement, covariance, whether taken out.
        admission: the landmarks, and which of them the graph holds.
        frames: those whose poses are in the graph, in time order.
        noise: of its landmark observations.
    """

    def __init__(
        self,
        sensor: CameraRig,
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
        given = settings.noise_factor
        self.noise: MeasurementNoise = Persistence(sensor) if given is None else StatedNoise(given)
        self.corrections = KnownCorrections()
        self._variance_of: dict[int, float] = {}
        self._turned: dict[int, TurnedStep] = {}
        self._weigh()
        self._rows: dict[int, list[int]] = {}
        self.identities = array("q")  # of variables: all that a bounded lag keeps of one
        self.observed = GrowingColumns(
            frame=np.empty(0, np.int64),
            variable=np.empty(0, np.int64),
            measurement=np.empty((0, 3)),
            covariance=np.empty((0, 3, 3)),
            gone=np.empty(0, np.bool_),
        )
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

    def recalibrate(self, change: RigChange) -> None:
        """Corrects all observations so far anew."""
        self.observed["measurement"][:] = change.measured(self.observed["measurement"])
        self.corrections.recalibrate(change)
        self.admission.recalibrate(change)

    @property
    def doubted(self) -> RigCorrection | None:
        """A rig that calibrates itself, with the correction applied last; None for a known one."""
        applied = self.corrections.applied
        if not applied:
            return None
        none, px = RigCorrection.none(self._sensor), self.corrections.field_px
        return dataclasses.replace(none, values=applied[-1], field_px=px)

    @property
    def variables(self) -> int:
        """Number of landmark variables made so far."""
        return len(self.identities)

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
        if self._remember:
            self._remember_observed(new.sightings)
        return new

    def take_out(self, variable: int) -> str:
        """Removes a landmark from the graph; it waits until it is known twice as well.

        Returns:
            Its identity and sightings, in words.
        """
        for row in self._rows.pop(variable, []):
            self.graph.remove(row)
        self.observed["gone"][self.observed["variable"] == variable] = True
        words = self.describe(variable)
        self.admission.taken_out(self.identities[variable], variable)
        return words

    def describe(self, variable: int) -> str:
        """A landmark variable's identity and sightings, in words."""
        return self.admission.describe(self.identities[variable], variable)

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
        np.minimum.at(first, self.observed["variable"], self.observed["frame"])
        return np.where(first < np.iinfo(np.int64).max, first, 0)

    def add_factor(self, factor: Any) -> int:
        """Adds a factor between variables of the graph, as of a loop; returns its row."""
        self.graph.add(factor)
        return int(self.graph.size()) - 1

    def of_saved_map(self, variable: int) -> bool:
        """Whether a landmark variable is on the prior of a saved map's landmark."""
        return self.admission.saved(self.identities[variable]) is not None

    def in_graph(self, variable: int) -> bool:
        """Whether a landmark variable still has its factors."""
        return variable in self._rows

    def behind(self, poses: FloatArray, points: dict[int, FloatArray]) -> list[int]:
        """Variables that lie behind a camera that saw them, where a stereo factor says nothing.

        Args:
            poses: (n, 4, 4) ``wTc`` by frame, those of the graph at least.
            points: positions (3,) by variable.
        """
        if not points:
            return []
        frames, seen = self.observed["frame"], self.observed["variable"]
        position = np.full((self.variables, 3), np.nan)
        position[list(points)] = list(points.values())
        offset = position[seen] - poses[frames, :3, 3]
        depth = np.einsum("ki,ki->k", offset, poses[frames, :3, 2])
        # A variable that was taken out has no position, and NaN is not below zero.
        return [int(variable) for variable in np.unique(seen[depth <= 0.0])]

    def seen_last(self, poses: FloatArray) -> dict[int, FloatArray]:
        """Places (3,) of the graph's landmark variables as each was seen last, from such poses."""
        tracks = [t for _, t in self.admission.in_graph() if np.isfinite(poses[t.last.frame, 0, 0])]
        if not tracks:
            return {}
        seen = np.array([track.last.measurement for track in tracks])
        wTc = poses[[track.last.frame for track in tracks]]
        local = triangulate(self._sensor, seen)
        places = np.einsum("kij,kj->ki", wTc[:, :3, :3], local) + wTc[:, :3, 3]
        return {track.variable: place for track, place in zip(tracks, places, strict=True)}

    def kept_factors(self) -> Any:
        """All factors as one graph of GTSAM's, weighed as is known now, observations last."""
        out = self._other_factors()
        seen = self.kept_observed()
        for frame, variable, measurement, covariance in zip(*seen, strict=True):
            out.add(self._observation(int(variable), Sighting(int(frame), measurement, covariance)))
        return out

    def observation_factors(self, sightings: list[tuple[int, Sighting]]) -> Any:
        """Factors of observations of landmark variables, weighed as is known now."""
        out = gtsam.NonlinearFactorGraph()
        for variable, sighting in sightings:
            out.add(self._observation(variable, sighting))
        return out

    def whole_graph(
        self, values: Any, kernel: KernelSettings | None = None, settled: bool = False
    ) -> tuple[WholeGraph, State]:
        """The same in arrays, at values of all variables; with another kernel where given.

        With ``settled`` all measurements are corrected by what was known last of the rig.
        """
        graph, state = self._whole_graph(values, kernel or self.kernel, settled)
        return graph.with_turns(list(self._turned.values()), state, self._persistence)

    def _whole_graph(
        self, values: Any, kernel: KernelSettings, settled: bool
    ) -> tuple[WholeGraph, State]:
        """Without turns of a gyroscope."""
        others = self._other_factors(turned=False)
        frames, variables, measured, covariances = self.kept_observed()
        if settled:
            measured = self.corrections.settle(self._sensor, frames, measured)
        return WholeGraph.of_rig(
            others,
            values,
            kernel,
            (pose_key(0) + frames, landmark_key(0) + variables),
            (measured, whitening(self._power * covariances)),
            self._sensor,
        )

    def kept_observed(self) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
        """Frames (k,), variables (k,), measurements and covariances of what was not taken out."""
        kept, seen = ~self.observed["gone"], self.observed
        return (
            seen["frame"][kept],
            seen["variable"][kept],
            seen["measurement"][kept],
            seen["covariance"][kept],
        )

    def _other_factors(self, turned: bool = True) -> Any:
        """Those that are no observations, without empty slots, weighed as is known now.

        Steps of a gyroscope whose bias is of account are among them where ``turned``.
        """
        self._weigh()
        out = gtsam.NonlinearFactorGraph()
        for row in range(self.graph.size()):
            if self.graph.exists(row) and (turned or row not in self._turned):
                factor, then = self.graph.at(row), self._variance_of.get(row)
                out.add(factor if then is None else self._weighed(factor, then))
        return out

    # ----------------------------------------------------------------------------------------

    def _weigh(self) -> None:
        """New factors weigh what depends on the noise as is known now."""
        kernel = self.kernel
        self._power, self._persistence = self.noise.power, self.noise_factor**2
        self._factors = StereoFactors(self._sensor, Whitening(kernel.name, kernel.width))

    def _weighed(self, step: Any, then: float) -> Any:
        """A guessed step as is known now; ``then`` multiplied its variance when it was made."""
        return step if self._persistence == then else scaled(step, self._persistence / then)

    def _add_pose(self, new: NewFactors, tracked: TrackedFrame) -> None:
        key = pose_key(new.frame)
        new.values.insert(key, gtsam.Pose3(tracked.wTc))
        if not self.frames:
            self._push(new, pose_prior(key, self._prior))
        elif tracked.motion is None:
            raise ValueError(f"frame {new.frame}: no motion from the frame before")
        else:
            self._add_step(new, tracked.motion, tracked.turn)
            if tracked.located is not None and not self._remember:
                # The map it was found in has left the lag: nothing else holds it there.
                self._push(new, pose_prior(key, Prediction(tracked.wTc, tracked.located)))
        for factor in floor_factors(key, self._floor, tracked.wTc):
            self._push(new, factor)

    def _add_step(self, new: NewFactors, motion: Odometry, turn: Turn | None) -> None:
        """From the frame before; the errors of one that goes on as before persist like images'.

        Its velocity comes from nothing but matches, and its noise from how far they scatter.
        """
        stated = motion
        if not motion.measured:
            covariance = self._persistence * motion.covariance
            motion = dataclasses.replace(motion, covariance=covariance)
        before, after = pose_key(self.frames[-1]), pose_key(new.frame)
        row = self._push(new, step_factor(before, after, motion))
        if not motion.measured:
            self._variance_of[row] = self._persistence
        if turn is not None and self._remember:
            self._turned[row] = TurnedStep(self.frames[-1], new.frame, stated, turn)

    def _add_observations(
        self, new: NewFactors, tracked: TrackedFrame, landmarks: LandmarkMap
    ) -> None:
        accepted, wTc = tracked.accepted, tracked.wTc
        rows = landmarks.rows(accepted.ids)
        positions = landmarks.positions[rows]
        known = parallax(positions - wTc[:3, 3], landmarks.covariances[rows])
        for i, identity in enumerate(accepted.ids.tolist()):
            sighting = Sighting(new.frame, accepted.measurement[i], accepted.covariance[i])
            track = self.admission.sighted(identity, sighting)
            if track.variable >= 0:
                new.sightings.append((track.variable, sighting))
            else:
                track.waiting.append(sighting)
                if self.admission.admits(identity, float(known[i])):
                    self._enter(new, identity, positions[i], wTc, float(known[i]))

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
        track.variable = len(self.identities)
        self.identities.append(identity)
        self._rows[track.variable] = []
        key = landmark_key(track.variable)
        new.values.insert(key, position)
        saved = self.admission.saved(identity)
        if saved is not None:
            self._add_prior(new, track.variable, *saved)
        elif parallax < WEAK_PARALLAX:
            sigma = _WEAK_PRIOR_RANGES * float(np.linalg.norm(position - wTc[:3, 3]))
            self._add_prior(new, track.variable, position, sigma**2 * np.eye(3))
        new.sightings += [(track.variable, sighting) for sighting in track.waiting]
        track.waiting = []

    def _add_prior(
        self, new: NewFactors, variable: int, mean: FloatArray, covariance: FloatArray
    ) -> None:
        if self._remember:
            factor = point_prior(landmark_key(variable), mean, covariance)
            self._rows[variable].append(self._push(new, factor))
        else:
            new.priors.append((variable, mean, covariance))

    def _observation(self, variable: int, sighting: Sighting) -> Any:
        return self._factors.factor(
            pose_key(sighting.frame),
            landmark_key(variable),
            sighting.measurement,
            self._power * sighting.covariance,
        )

    def _remember_observed(self, sightings: list[tuple[int, Sighting]]) -> None:
        if not sightings:
            return
        self.observed.append(
            {
                "frame": np.array([s.frame for _, s in sightings]),
                "variable": np.array([variable for variable, _ in sightings]),
                "measurement": np.array([s.measurement for _, s in sightings]),
                "covariance": np.array([s.covariance for _, s in sightings]),
                "gone": np.zeros(len(sightings), np.bool_),
            }
        )

    def _push(self, new: NewFactors, factor: Any) -> int:
        new.graph.add(factor)
        if self._remember:
            self.graph.add(factor)
        return int(self.graph.size()) - 1


def parallax(rays: FloatArray, covariances: FloatArray) -> FloatArray:
    """Range over its standard deviation (k,), of points at ``rays`` (k, 3) from the camera."""
    distance = np.linalg.norm(rays, axis=1)
    directions = rays / np.maximum(distance, 1e-12)[:, None]
    variance = np.einsum("ki,kij,kj->k", directions, covariances, directions)
    return np.asarray(distance / np.sqrt(np.maximum(variance, 1e-300)))
