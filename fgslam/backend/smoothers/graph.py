"""Loops in a smoother's graph: a first guess that keeps every place as it is, then the solution.

The graph as solved before the loop and as it must be with it lie far apart. Linearised in between,
landmarks would fly and kernels drop what is right: so poses and landmarks are first brought to
where backward correction (:mod:`fgslam.backend.loops`) has them, each landmark
along with the frame that saw it first. There every observation fits as before, and what is left is
small.
"""

from __future__ import annotations

import dataclasses
from array import array
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import gtsam
import numpy as np

from fgslam.backend.loops import (
    Chain,
    Constraint,
    changes,
    corrected,
    nearest_positive,
    refusal,
)
from fgslam.backend.measured import RelativePoint, prior_of, sensor_in_pose
from fgslam.backend.persistence import Persistence, StatedNoise
from fgslam.backend.self_calibration import RigChange
from fgslam.backend.settings import GraphSettings, KernelSettings
from fgslam.backend.smoothers.admission import LandmarkAdmission, Sighting, Track
from fgslam.backend.smoothers.bundle import (
    Sightings,
    State,
    Turn,
    TurnedStep,
    WholeGraph,
    by_kind,
)
from fgslam.core.arrays import BoolArray, FloatArray, GrowingColumns, IntArray
from fgslam.core.correction import FIELD_PX, RigCorrection
from fgslam.core.errors import EstimatorError
from fgslam.core.geometry import (
    adjoint,
    congruence,
    inverse,
    point_pose_jacobian,
    reorthonormalise,
    se3_exp,
    se3_log,
    transform_to_camera,
    transform_to_world,
)
from fgslam.core.sensors import (
    CameraRig,
    Increment,
    LoopClosure,
    Measured,
    Observations,
    Odometry,
)
from fgslam.core.types import EgoMotion, Floor, GyroscopeBias, LandmarkMap, Prediction
from fgslam.factors.graphs import landmark_key, nuisance_key, pose_key, poses_of_frame
from fgslam.factors.landmark import StereoFactors
from fgslam.factors.measurement import gtsam_factor, nuisance_prior, whitening
from fgslam.factors.motion import floor_factors, point_prior, pose_prior, step_factor
from fgslam.factors.noise import Whitening, scaled

# ------------------------------------------------------------------------------------------
# A loop closure in a window: what its last pose has drifted by, undone as far as is measured


def drift_undone(
    floor: Floor, before: Prediction, last: Prediction, known: Constraint, what: str
) -> tuple[Prediction | None, str]:
    """The last pose moved to where a loop has it, None where that is refused; and the remark.

    The earlier frame's pose is known as it was when it left. What the last pose is less certain
    by than that one is drift, and the loop measures the drift: a Kalman correction of one pose.

    Args:
        floor: on which nothing drifts, and nothing is measured, in the other directions.
        before: the earlier pose.
        last: the last one.
        known: the loop.
        what: begins the remark.
    """
    shared = congruence(adjoint(inverse(known.motion)), before.covariance)
    drift = nearest_positive(last.covariance - shared)
    basis = floor.basis(last.wTc) if floor.rigid_dof < 6 else np.eye(6)
    off = basis.T @ se3_log(inverse(last.wTc) @ before.wTc @ known.motion)
    drift = basis.T @ drift @ basis
    innovation = drift + basis.T @ known.covariance @ basis
    gain = np.linalg.solve(innovation, drift).T
    refused = refusal(what, float(off @ np.linalg.solve(innovation, off)))
    if refused:
        return None, refused
    target = last.wTc @ se3_exp(basis @ gain @ off)
    target = floor.constrain(target) if floor.rigid_dof < 6 else target
    covariance = shared + congruence(basis, nearest_positive(drift - gain @ drift))
    shift = float(np.linalg.norm(target[:3, 3] - last.wTc[:3, 3]))
    remark = f"{what}: the camera moved by {shift:.2f} m"
    return Prediction(target, floor.allowed_part(target, covariance)), remark


# ------------------------------------------------------------------------------------------
# Turns a run's measurements into a factor graph, frame by frame; every smoother starts from it

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
        measured: by other sensors than the camera.
        covariance: (6, 6) of the pose, which the tracker's new landmarks contain.
    """

    frame: int
    wTc: FloatArray
    motion: Odometry | None
    accepted: Observations
    turn: Turn | None = None
    located: FloatArray | None = None
    measured: tuple[Measured, ...] = ()
    covariance: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))


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
        measured: landmark variables by other sensors than the camera.
    """

    frame: int
    graph: Any
    values: Any
    priors: list[tuple[int, FloatArray, FloatArray]] = field(default_factory=list)
    sightings: list[tuple[int, Sighting]] = field(default_factory=list)
    measured: list[Sightings] = field(default_factory=list)


class GraphBuilder:
    """Poses, landmarks and factors of a run so far.

    Attributes:
        graph: all factors but observations; one taken out leaves an empty slot.
        observed: the observations: frame, variable, measurement, covariance, whether taken out.
        admission: the landmarks, and which of them the graph holds.
        measured: landmarks by other sensors, by kind.
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
        self.noise = Persistence(sensor) if given is None else StatedNoise(given)
        self._corrected: tuple[FloatArray, float] | None = None
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
        self.stamps: list[float] = []  # of all frames, seconds
        self.measured: dict[str, Sightings] = {}
        self._waiting: dict[int, list[tuple[int, Measured]]] = {}

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
        """Corrects the observations of the frames that the change is of again."""
        late = np.flatnonzero(self.observed["frame"] >= change.since)
        measured = self.observed["measurement"]
        measured[late] = change.measured(measured[late])
        self.admission.recalibrate(change)

    def note(self, increment: Increment) -> None:
        """Takes in what a frame was corrected by; one without a correction changes nothing."""
        self.stamps.append(increment.timestamp)
        if increment.rig_correction is not None:
            known = increment.settled_rig
            field_px = 0.0 if known is None else known.field_px
            self._corrected = increment.rig_correction, field_px

    @property
    def uncertain_rig(self) -> RigCorrection | None:
        """With the correction applied last, or as stated; None for a rig that is known."""
        none = RigCorrection.none(self._sensor)
        if self._corrected is None:
            stated = self._sensor.stated and not self._sensor.exact
            return dataclasses.replace(none, field_px=FIELD_PX) if stated else None
        values, field_px = self._corrected
        return dataclasses.replace(none, values=values, field_px=field_px)

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
        self._add_measured(new, tracked, landmarks)
        if self._remember:
            gone = np.zeros(len(new.sightings), np.bool_)
            self.observed.append(sighting_columns(new.sightings) | {"gone": gone})
            self.measured = by_kind([*self.measured.values(), *new.measured])
        return new

    def take_out(self, variable: int) -> str:
        """Removes a landmark from the graph; it waits until it is known twice as well.

        Returns:
            Its identity and sightings, in words.
        """
        for row in self._rows.pop(variable, []):
            self.graph.remove(row)
        self.observed["gone"][self.observed["variable"] == variable] = True
        key = landmark_key(variable)
        self.measured = {k: one.select(one.points != key) for k, one in self.measured.items()}
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
        for one in self.measured.values():
            np.minimum.at(first, one.points - landmark_key(0), one.poses - pose_key(0))
        return np.where(first < np.iinfo(np.int64).max, first, 0)

    def of_saved_map(self, variable: int) -> bool:
        """Whether a landmark variable is on the prior of a saved map's landmark."""
        return self.admission.saved(self.identities[variable]) is not None

    def in_graph(self, variable: int) -> bool:
        """Whether a landmark variable still has its factors."""
        return variable in self._rows

    def behind(self, poses: FloatArray, points: dict[int, FloatArray]) -> list[int]:
        """Variables behind a camera that saw them, where a stereo factor constrains nothing.

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
        local = self._sensor.triangulate(seen)
        places = np.einsum("kij,kj->ki", wTc[:, :3, :3], local) + wTc[:, :3, 3]
        return {track.variable: place for track, place in zip(tracks, places, strict=True)}

    def kept_factors(self, callbacks: bool = True) -> Any:
        """All factors as one graph of GTSAM's, weighed as is known now, observations last.

        ``callbacks``: those of models without a C++ factor, too.
        """
        out = self._other_factors()
        out.push_back(self._observation_factors(*self.kept_observed()))
        for one in self.measured.values():
            if one.model.nuisance.size:
                out.add(nuisance_prior(one.model))
            if callbacks or one.model.has_factor:
                out.push_back(one.factors())
        return out

    def observation_factors(self, new: NewFactors) -> Any:
        """C++ factors of a frame's observations of landmarks, weighed as is known now."""
        out = self._observation_factors(*sighting_columns(new.sightings).values())
        for one in new.measured:
            if one.model.has_factor:
                out.push_back(one.factors())
        return out

    def _observation_factors(
        self, frames: IntArray, variables: IntArray, measured: FloatArray, covariances: FloatArray
    ) -> Any:
        keys = pose_key(0) + frames, landmark_key(0) + variables
        return self._factors.graph(*keys, measured, self._power * covariances)

    def whole_graph(
        self, values: Any, kernel: KernelSettings | None = None
    ) -> tuple[WholeGraph, State]:
        """The same in arrays, at values of all variables; with another kernel where given."""
        graph, state = self._whole_graph(values, kernel or self.kernel)
        graph, state = graph.with_turns(list(self._turned.values()), state, self._persistence)
        keys = [nuisance_key(k) for k, one in self.measured.items() if one.model.nuisance.size]
        known = [values.atVector(key) if values.exists(key) else np.zeros(3) for key in keys]
        return graph, dataclasses.replace(state, bias=np.concatenate([state.bias, *known]))

    def _whole_graph(self, values: Any, kernel: KernelSettings) -> tuple[WholeGraph, State]:
        """Without turns of a gyroscope."""
        others = self._other_factors(turned=False)
        frames, variables, measured, covariances = self.kept_observed()
        keys = pose_key(0) + frames, landmark_key(0) + variables
        seen = Sightings(*keys, measured, whitening(self._power * covariances), self._sensor)
        return WholeGraph.of(others, values, kernel, seen, self.measured.values())

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
        ids, parallaxes = accepted.ids.tolist(), known.tolist()
        seen = zip(ids, accepted.measurement, accepted.covariance, strict=True)
        for i, (identity, measurement, covariance) in enumerate(seen):
            sighting = Sighting(new.frame, measurement, covariance)
            track = self.admission.sighted(identity, sighting)
            if track.variable >= 0:
                new.sightings.append((track.variable, sighting))
            else:
                track.waiting.append(sighting)
                if self.admission.admits(identity, parallaxes[i]):
                    self._enter(new, identity, positions[i], wTc, parallaxes[i])

    def _add_measured(self, new: NewFactors, tracked: TrackedFrame, landmarks: LandmarkMap) -> None:
        """What other sensors measured, of landmarks as soon as the tracker has a place for them."""
        frame, key = new.frame, pose_key(new.frame)
        ready: dict[str, list[tuple[int, int, Measured]]] = {}
        for one in tracked.measured:
            if one.of_pose:
                xTs = sensor_in_pose(self._sensor, one.model)
                for value, noise in zip(one.values, one.covariance, strict=True):
                    model = gtsam.noiseModel.Gaussian.Covariance(noise)
                    self._push(new, gtsam_factor(one.model, [key], value, model, xTs))
                continue
            first = [i not in self.admission.tracks and i not in self._waiting for i in one.ids]
            for each in (*prior_of(one.select(np.array(first, np.bool_))), one):
                for row, identity in enumerate(each.ids.tolist()):
                    self._waiting.setdefault(identity, []).append(
                        (frame, each.select(np.array([row])))
                    )
        waiting = np.array(sorted(self._waiting), np.int64)
        for identity in waiting[np.isin(waiting, landmarks.ids)].tolist():
            track = self.admission.tracks.get(identity)
            if track is None or not track.by_camera:
                track = self.admission.sighted(identity, Sighting.by_others(frame))
                if track.variable < 0:
                    at = landmarks.rows(np.array([identity]))
                    self._enter(new, identity, landmarks.positions[at[0]], tracked.wTc, np.inf)
                    if not self._remember and self._waiting[identity][0][0] < frame:
                        self._waiting[identity] = [(frame, self._found(tracked, landmarks, at))]
                    self.admission.staying.update(
                        track.variable
                        for _, one in self._waiting[identity]
                        if one.kind == RelativePoint.kind
                    )
            if track.variable >= 0:
                for seen, one in self._waiting.pop(identity):
                    if seen >= self.admission.first_frame:
                        ready.setdefault(one.kind, []).append((seen, track.variable, one))
        new.measured = [self._sightings(*zip(*known, strict=True)) for known in ready.values()]
        for model in (one.model for one in new.measured if one.model.nuisance.size):
            if model.kind not in self.measured:
                new.values.insert(nuisance_key(model.kind), np.zeros(3))

    def _found(self, tracked: TrackedFrame, landmarks: LandmarkMap, row: IntArray) -> Measured:
        """Where the tracker has just found a landmark, for a lag that does not reach back so far.

        One measurement in the frame's pose, which contains all by which it was found.
        """
        local = transform_to_camera(tracked.wTc, landmarks.positions[row])
        turned = congruence(tracked.wTc[:3, :3].T, landmarks.covariances[row])
        known = turned - congruence(point_pose_jacobian(local), tracked.covariance)
        return RelativePoint(self._sensor.bTc).measured(local, known, landmarks.ids[row])

    def _sightings(
        self, frames: Sequence[int], variables: Sequence[int], measured: Sequence[Measured]
    ) -> Sightings:
        """Of landmark variables from frames of the graph, by one model, one each."""
        model = measured[0].model
        return Sightings(
            pose_key(0) + np.array(frames),
            landmark_key(0) + np.array(variables),
            np.concatenate([one.values for one in measured]),
            whitening(np.concatenate([one.covariance for one in measured])),
            model,
            sensor_in_pose(self._sensor, model),
        )

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

    def _push(self, new: NewFactors, factor: Any) -> int:
        new.graph.add(factor)
        if self._remember:
            self.graph.add(factor)
        return int(self.graph.size()) - 1


def sighting_columns(sightings: list[tuple[int, Sighting]]) -> dict[str, Any]:
    """Frames (k,), variables (k,), measurements (k, 3) and covariances (k, 3, 3)."""
    return {
        "frame": np.array([s.frame for _, s in sightings], np.int64),
        "variable": np.array([variable for variable, _ in sightings], np.int64),
        "measurement": np.array([s.measurement for _, s in sightings]).reshape(-1, 3),
        "covariance": np.array([s.covariance for _, s in sightings]).reshape(-1, 3, 3),
    }


def parallax(rays: FloatArray, covariances: FloatArray) -> FloatArray:
    """Range over its standard deviation (k,), of points at ``rays`` (k, 3) from the camera."""
    distance = np.linalg.norm(rays, axis=1)
    directions = rays / np.maximum(distance, 1e-12)[:, None]
    variance = np.einsum("ki,kij,kj->k", directions, covariances, directions)
    return np.asarray(distance / np.sqrt(np.maximum(variance, 1e-300)))


# ------------------------------------------------------------------------------------------
# What a smoother asks of a solver: the part to write for another way of solving the graph


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The graph's answer.

    Attributes:
        poses: (n, 4, 4) by frame; NaN for those between keyframes.
        pose_covariances: (n, 6, 6); NaN where they cannot be had.
        points: positions (3,) of landmark variables.
        point_covariances: (3, 3) of the same.
        remarks: what was left out, why covariances are missing; in words.
        considers_rig: covariances contain what is open of the rig's calibration; else what was
            open when each frame came is added.
        noise_ratio: variance of the measurements over what the builder takes it to be.
        gyroscope: its bias, where it is a variable of the graph.
        relative: as of :class:`~fgslam.core.types.Estimate`, up to the graph's last frame.
        nuisance: parameters (3,) of the kinds of measurement that have any.
    """

    poses: FloatArray
    pose_covariances: FloatArray
    points: dict[int, FloatArray]
    point_covariances: dict[int, FloatArray]
    remarks: tuple[str, ...] = ()
    considers_rig: bool = False
    noise_ratio: float = 1.0
    gyroscope: GyroscopeBias | None = None
    relative: Mapping[int, FloatArray] = field(default_factory=dict)
    nuisance: Mapping[str, FloatArray] = field(default_factory=dict)


class FactorGraph(NamedTuple):
    """A drive as GTSAM has it, to go on with by its means.

    Attributes:
        graph: gtsam.NonlinearFactorGraph, of C++ factors where GTSAM has them.
        values: gtsam.Values at the estimator's solution.
        poses: keys of the poses ``wTc`` (gtsam.Pose3), by the frame's place in the log.
        landmarks: keys of the world points (gtsam.Point3), by identity.
    """

    graph: Any
    values: Any
    poses: dict[int, int]
    landmarks: dict[int, int]


def factor_graph(builder: GraphBuilder, found: Solution) -> FactorGraph:
    """All factors but those of landmarks that the solution left out."""
    poses = {frame: pose_key(frame) for frame in builder.frames}
    identities = ((builder.identities[variable], variable) for variable in found.points)
    landmarks = {identity: landmark_key(variable) for identity, variable in identities}
    values, graph = gtsam.Values(), gtsam.NonlinearFactorGraph()
    for frame, key in poses.items():
        values.insert(key, gtsam.Pose3(reorthonormalise(found.poses[frame])))
    for variable, point in found.points.items():
        values.insert(landmark_key(variable), point)
    for kind, parameters in found.nuisance.items():
        values.insert(nuisance_key(kind), parameters)
    every = builder.kept_factors()
    for factor in map(every.at, range(every.size())):
        if all(map(values.exists, factor.keys())):
            graph.add(factor)
    return FactorGraph(graph, values, poses, landmarks)


def poses_of(values: Any, frames: list[int]) -> FloatArray:
    """Poses (n, 4, 4) by frame, up to the last of ``frames``; NaN for those not among them."""
    out = np.full((frames[-1] + 1, 4, 4), np.nan)
    for frame in frames:
        out[frame] = values.atPose3(pose_key(frame)).matrix()
    return out


def points_of(values: Any, variables: list[int]) -> dict[int, FloatArray]:
    """Positions of landmark variables in GTSAM values."""
    return {v: np.asarray(values.atPoint3(landmark_key(v))) for v in variables}


def allowed_parts(floor: Floor, poses: FloatArray, covariances: FloatArray) -> FloatArray:
    """Covariances (n, 6, 6) without what a hard floor excludes, which the graph holds stiffly."""
    if floor.rigid_dof == 6:
        return covariances
    pairs = zip(poses, covariances, strict=True)
    return np.array([floor.allowed_part(pose, covariance) for pose, covariance in pairs])


def suspect(error: Exception) -> int | None:
    """Key of the variable near which GTSAM reports an indeterminate system, if it does."""
    words = str(error).split("variable", 1)
    digits = "".join(c for c in words[-1].strip().split(" ")[0] if c.isdigit())
    return int(digits) if len(words) == 2 and digits else None


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """A solution between two frames, for the tracker to go on from.

    Attributes:
        values: GTSAM values of the poses and landmarks that the solver holds.
        last: pose ``wTc`` (4, 4) and covariance (6, 6) of the frame that entered last.
        since: frame; the values hold no landmark that was seen last before it.
        earlier: by :data:`~fgslam.core.types.LAGS` joint covariances (12, 12) of the pose so many
            frames before the last one, and of that; of those that are known.
        by_loop: a loop moved the map: landmarks that the solver does not hold move with the camera.
    """

    values: Any
    last: Prediction
    since: int = 0
    by_loop: bool = False
    earlier: Mapping[int, FloatArray] = field(default_factory=dict)


class GraphSolver(Protocol):
    """Solves the growing graph of a :class:`~fgslam.backend.smoothers.smoother.Smoother`.

    A failure that taking a landmark out does not cure raises EstimatorError in any of these.
    """

    @property
    def kind(self) -> str:
        """Names the estimator in configurations, tables and messages."""
        ...

    @property
    def remarks(self) -> list[str]:
        """What became of loops, and which landmarks were taken out, in words."""
        ...

    def add(self, new: NewFactors, landmarks: LandmarkMap) -> None:
        """Takes in a frame's factors.

        Args:
            new: of the frame; the builder keeps them, too.
            landmarks: the tracker's map after that frame.
        """
        ...

    def recalibrate(self, change: RigChange) -> None:
        """The builder has corrected its observations again."""
        ...

    def solve_if_due(self, frame: int, closes_loop: bool) -> Smoothed | None:
        """The solution with all that was added, if it is time for one at this frame.

        ``closes_loop``: :meth:`close` follows, and may take all in at once.
        """
        ...

    def close(self, loop: Constraint, chain: Chain, wTc: FloatArray, what: str) -> Smoothed | bool:
        """Takes in a loop closure of the frame added last; False, and a remark, if it is refused.

        The solution that the tracker is to go on from; True where it goes on as it is.

        Args:
            loop: between two frames of the graph.
            chain: the drive's steps as tracked, without the loop.
            wTc: (4, 4) the present pose as tracked.
            what: begins the remark.
        """
        ...

    def solution(self) -> Solution:
        """All poses and landmarks of the graph, with marginal covariances; changes nothing."""
        ...


def solver_failed(kind: str, error: Exception, frame: int, when: str = "at") -> EstimatorError:
    """What to raise where a solver's failure cannot be repaired."""
    return EstimatorError(
        f"{kind}: the solver failed {when} frame {frame} "
        f"({' '.join(str(error).split())}); look at that frame with fgslam inspect"
    )


LONG_UNSEEN = 60  # frames, as the front-end's LoopGates.forgotten_after
_ITERATIONS = 20
_ENOUGH = 2.0  # the last iteration's gain, half squared deviations: far below the gate's square
_TOLERANCE = 1e-6  # of the cost, where that is small
_EXACT = 1e-4  # radians and metres: a pose that is given


def found_again(frames: IntArray, variables: IntArray) -> BoolArray:
    """(k,) which observations, by frame and landmark, are of landmarks that were long unseen."""
    order = np.lexsort((frames, variables))
    same = np.diff(variables[order], prepend=-1) == 0
    returns = np.cumsum(same & (np.diff(frames[order], prepend=0) >= LONG_UNSEEN))
    starts = np.flatnonzero(~same)
    before = np.repeat(returns[starts], np.diff(np.append(starts, len(returns))))
    out = np.zeros(len(frames), np.bool_)
    out[order] = returns > before
    return out


def misfit(factor: Any, values: Any) -> float:
    """Squared residual of a factor, in its deviations."""
    return 2.0 * float(factor.error(values))


def carried_to(
    frame: int, loop: LoopClosure, tracked: Callable[[int], Prediction | EgoMotion], last: int
) -> Constraint:
    """The closure as one to a neighbour of the earlier frame, by how both were tracked.

    Args:
        frame: of the neighbour, tracked against the same map; may be the earlier frame itself.
        loop: the closure.
        tracked: gives a frame's pose as it was tracked.
        last: the present frame.
    """
    matches = len(loop.observations)
    if frame == loop.frame:
        return Constraint(frame, last, loop.oTc, loop.covariance, matches=matches)
    neighbour, earlier = tracked(frame), tracked(loop.frame)
    kTo = inverse(neighbour.wTc) @ earlier.wTc
    own = earlier.covariance + congruence(adjoint(inverse(kTo)), neighbour.covariance)
    covariance = loop.covariance + congruence(adjoint(inverse(loop.oTc)), own)
    return Constraint(frame, last, kTo @ loop.oTc, covariance, matches=matches)


def first_guess(builder: GraphBuilder, values: Any, chain: Chain, loops: list[Constraint]) -> Any:
    """Values of all variables with the last of ``loops`` closed, each place moved as a whole.

    Args:
        builder: the graph so far.
        values: its solution without that loop.
        chain: the drive as tracked, for the uncertainty of its steps and for what ties it.
        loops: all that are closed; those before the last are held as the values have them.
    """
    frames = np.array(builder.frames)
    poses = np.array([poses_of_frame(values, frame) for frame in builder.frames])
    ends = [_row(frames, loops[-1].before), _row(frames, loops[-1].after)]
    new = dataclasses.replace(loops[-1], before=ends[0], after=ends[1])
    found = _closed(frames, poses, chain, loops[:-1], new)
    return _moved(builder, values, frames, found, changes(poses, found))


def closed_chain(
    poses: FloatArray, chain: Chain, loops: list[Constraint], last: FloatArray
) -> FloatArray:
    """Poses (n, 4, 4) of all frames where the last of ``loops`` has brought the last one.

    Args:
        poses: (n, 4, 4) before.
        chain: as for :func:`first_guess`, as is ``loops``.
        loops: all that are closed.
        last: (4, 4) where the last pose is now.
    """
    before = loops[-1].before
    motion = inverse(poses[before]) @ last
    new = Constraint(before, len(poses) - 1, motion, _EXACT**2 * np.eye(6))
    return _closed(np.arange(len(poses)), poses, chain, loops[:-1], new)


def _closed(
    frames: IntArray, poses: FloatArray, chain: Chain, loops: list[Constraint], new: Constraint
) -> FloatArray:
    held = [_as_solved(known, frames, poses) for known in (*chain.constraints, *loops)]
    constraints = [known for known in held if known.before != known.after]
    return corrected(poses, chain.steps_between(frames), [*constraints, new])[0]


def solved(graph: WholeGraph, state: State) -> State:
    """The minimum of a graph with its kernels."""
    return graph.minimum(state, _ITERATIONS, _TOLERANCE, _ENOUGH)


def _row(frames: IntArray, frame: int) -> int:
    """Row of the graph's frame that is nearest to a frame."""
    return int(np.argmin(np.abs(frames - frame)))


def _as_solved(known: Constraint, frames: IntArray, poses: FloatArray) -> Constraint:
    """A constraint between rows of the graph's frames, met as the solution meets it."""
    before, after = _row(frames, known.before), _row(frames, known.after)
    motion = inverse(poses[before]) @ poses[after]
    return Constraint(before, after, motion, known.covariance)


def _moved(
    builder: GraphBuilder, values: Any, frames: IntArray, poses: FloatArray, by: FloatArray
) -> Any:
    """Values with these poses (m, 4, 4), each landmark moved as the frame that saw it first."""
    out = gtsam.Values(values)
    for frame, pose in zip(frames.tolist(), poses, strict=True):
        out.update(pose_key(frame), gtsam.Pose3(pose))
    homes = np.searchsorted(frames, builder.first_frames())
    for variable, home in enumerate(homes.tolist()):
        key = landmark_key(variable)
        if out.exists(key):
            point = transform_to_world(by[home], out.atPoint3(key)[None])[0]
            out.update(key, point)
    return out
