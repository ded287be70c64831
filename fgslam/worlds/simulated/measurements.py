"""A simulated drive without images: exact poses, noisy measurements with identities.

What the front-end would hand to the estimators, with noise of exactly the covariance that it
states: independent noise on the pixels of all images, fused as
docs/derivations/stereo_measurement.md derives. Everything follows from two seeds: the world's
(where landmarks are) and the run's (noise, detections, wrong matches).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core import geometry as g
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.errors import ConfigError
from fgslam.core.estimates import Trajectory
from fgslam.core.measurements import Increment, Observations, Odometry
from fgslam.core.sensors import CameraRig, measurement_map, pixel_model, vertical_to_horizontal
from fgslam.worlds.driving import wheel_odometry
from fgslam.worlds.lab import make_rig
from fgslam.worlds.settings import SimulatedMeasurementsSettings
from fgslam.worlds.simulated.drives import plan_measured_drive
from fgslam.worlds.simulated.landmarks import IdentityBook, LandmarkWorld, Sightings, build_world

# Streams of random numbers, apart so that one imperfection does not redraw another's.
_DETECTION, _PIXELS, _ODOMETRY, _WRONG = 1, 2, 3, 4
_MOVED = 5
_BORDER_PX = 8.0  # nearer to the edge a landmark may be seen, but is not missed
_STRENGTH_JITTER = 0.1
_LEAST_DISPARITY_PX = 0.5  # a fainter one cannot be triangulated
PIXEL_SIGMA = 0.2  # of a coordinate in each image: that of SIFT in rendered ones
LEAST_RANGE_M = 0.4  # nearer ones are in one image only, or out of focus
MOST_RANGE_M = 8.0  # farther ones are not in view
_MOVED_M = 0.5  # landmarks move so far, level, in any direction
OBLIQUE_DEG = 75.0  # off its surface's normal a landmark is foreshortened beyond recognition
PRUNE_AFTER = 20  # consecutive misses in view until an identity is dropped, as in Se et al. 4.3


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedMeasurements:
    """The measurements and the truth, in the frame of the reference camera's first pose.

    Attributes:
        rig: the cameras.
        increments: one a selected frame.
        truth: exact poses of the reference camera.
        landmark_ids: (n,) identities whose landmark stood still, ascending.
        landmark_positions: (n, 3) where they are, metres.
        wrong_matches: how many matched observations are wrong.
    """

    rig: CameraRig
    increments: tuple[Increment, ...]
    truth: Trajectory
    landmark_ids: IntArray
    landmark_positions: FloatArray
    wrong_matches: int


def simulate_measurements(
    settings: SimulatedMeasurementsSettings, seed: int
) -> SimulatedMeasurements:
    """Drives, measures, and keeps the books; the selected frames only.

    Raises:
        ConfigError: the drive does not exist in the place, or not in so few frames, the selection
            leaves none of them, or an imperfection would begin after the last.
    """
    drive = plan_measured_drive(settings.drive, settings.world.place)
    _require_effect(settings, len(drive.timestamps))
    rig = make_rig(settings.rig)
    world = build_world(settings.world, drive.corners)
    chosen = _selection(len(drive.timestamps), settings)
    steps = simulate_odometry(settings, drive.body, np.random.default_rng([seed, _ODOMETRY]))
    wTc = drive.body @ rig.bTc
    camera = _Camera(settings, rig, world, seed)
    increments = []
    for k, index in enumerate(chosen):
        since = steps[chosen[k - 1] : index] if k else []
        odometry = g.odometry_of_camera(g.compose_odometry(since), rig.bTc) if k else None
        stamp = float(drive.timestamps[index])
        increments.append(camera.increment(int(index), stamp, odometry, wTc[index]))
    first = g.inverse(wTc[chosen[0]])
    ids, positions = camera.landmark_truth(int(chosen[-1]))
    return SimulatedMeasurements(
        rig=rig,
        increments=tuple(increments),
        truth=Trajectory(drive.timestamps[chosen], first @ wTc[chosen]),
        landmark_ids=ids,
        landmark_positions=g.transform_to_world(first, positions),
        wrong_matches=camera.wrong_matches,
    )


def _selection(count: int, settings: SimulatedMeasurementsSettings) -> IntArray:
    chosen = np.arange(count)[settings.start : settings.stop : settings.stride]
    if not len(chosen):
        raise ConfigError(
            f"dataset.start {settings.start}, stop {settings.stop} leave none of the drive's "
            f"{count} frames; lower dataset.start or raise dataset.stop"
        )
    return chosen


def _require_effect(settings: SimulatedMeasurementsSettings, frames: int) -> None:
    """Refuses keys that would do nothing."""
    fault, blackout, moved = settings.odometry_fault, settings.blackout, settings.moved
    starts = {
        "odometry_fault.start": None if fault is None else fault.start,
        "blackout.start": None if blackout is None else blackout.start,
        "moved.frame": None if moved is None else moved.frame,
    }
    for key, start in starts.items():
        if start is not None and start >= frames:
            raise ConfigError(
                f"dataset.{key} is {start}, but the drive has the frames 0 to {frames - 1}; "
                "choose an earlier one"
            )


class _Camera:
    """The rig in the world: what it sees in a frame, and under which identities."""

    def __init__(
        self,
        settings: SimulatedMeasurementsSettings,
        rig: CameraRig,
        world: LandmarkWorld,
        seed: int,
    ) -> None:
        self._settings = settings
        self._rig = rig
        self._world = world
        self._detection = np.random.default_rng([seed, _DETECTION])
        self._pixel_noise = np.random.default_rng([seed, _PIXELS])
        self._wrong = np.random.default_rng([seed, _WRONG])
        self._after = _moved_points(settings, world)
        self._book = IdentityBook(len(world), PRUNE_AFTER)
        self._index_of_birth: list[int] = []
        ratio = vertical_to_horizontal(rig)
        self._model = pixel_model(rig.cameras, ratio)
        self._fuse = measurement_map("fused", rig.cameras, ratio)
        self._covariance = PIXEL_SIGMA**2 * (self._fuse @ self._fuse.T)
        self.wrong_matches = 0

    def increment(
        self, index: int, timestamp: float, odometry: Odometry | None, wTc: FloatArray
    ) -> Increment:
        """One frame at a true pose in the room."""
        if self._blocked(index):
            sightings = Sightings.nothing()
            pixels = np.empty((0, 2 * self._rig.cameras))
        else:
            sightings, pixels = self._look(wTc, g.transform_to_camera(wTc, self._points(index)))
        self._index_of_birth += [index] * len(sightings.new)
        observations = self._observe(sightings, pixels)
        return Increment(
            index=index,
            timestamp=timestamp,
            odometry=odometry,
            observations=observations,
            rejected=np.zeros(len(observations), np.bool_),
            missed_ids=sightings.missed_ids,
            pruned_ids=sightings.pruned_ids,
        )

    def landmark_truth(self, last_index: int) -> tuple[IntArray, FloatArray]:
        """Identities whose point has not moved since they were given, and where it is."""
        points = self._book.point_of_id
        final = self._points(last_index)[points]
        born = np.array(self._index_of_birth, np.int64)
        moved = self._settings.moved
        still = np.ones(len(points), np.bool_)
        if moved is not None and last_index >= moved.frame:
            still = (final == self._world.points[points]).all(axis=1) | (born >= moved.frame)
        return np.flatnonzero(still), final[still]

    # ----------------------------------------------------------------------------------------

    def _points(self, index: int) -> FloatArray:
        moved = self._settings.moved
        return self._world.points if moved is None or index < moved.frame else self._after

    def _blocked(self, index: int) -> bool:
        blackout = self._settings.blackout
        return blackout is not None and 0 <= index - blackout.start < blackout.frames

    def _look(self, wTc: FloatArray, local: FloatArray) -> tuple[Sightings, FloatArray]:
        """Who is seen, and the noisy pixels (k, 2 * cameras) of the matched, then the new."""
        view, exact, inner = self._in_view(wTc, local)
        detection = self._settings.detection
        sigma = PIXEL_SIGMA * detection.noise_scale
        noise = sigma * self._pixel_noise.standard_normal(exact.shape)
        found = self._detect(view, self._measurable(exact + noise))
        seen, expected = np.zeros((2, len(local)), np.bool_)
        seen[view[found]] = expected[view[inner]] = True
        sightings = self._book.take(seen, expected)
        rows = np.searchsorted(view, np.concatenate([sightings.matched, sightings.new]))
        pixels = exact[rows] + noise[rows]
        self._confuse(pixels[: len(sightings.matched)], exact, noise[rows])
        return sightings, pixels

    def _in_view(
        self, wTc: FloatArray, local: FloatArray
    ) -> tuple[IntArray, FloatArray, BoolArray]:
        """Points in view (v,) ascending, their exact pixels (v, 2 * cameras), and which are inner.

        Inner ones keep off the edges of all images.
        """
        rig = self._rig
        view = self._world.in_sight(wTc[:3, 3])
        seen_from = local[view]
        distance = np.linalg.norm(seen_from, axis=1)
        ray = seen_from @ wTc[:3, :3].T
        facing = -np.einsum("ni,ni->n", ray, self._world.normals[view])
        ok = (distance >= LEAST_RANGE_M) & (distance <= MOST_RANGE_M)
        ok &= facing >= np.cos(np.deg2rad(OBLIQUE_DEG)) * distance
        view = view[ok & g.in_front(seen_from, LEAST_RANGE_M)]
        pixels = g.project(rig, local[view]) @ self._model.T
        margin = np.min(
            [pixels, np.tile([rig.width - 1.0, rig.height - 1.0], rig.cameras) - pixels], axis=0
        ).min(axis=1)
        inside = margin >= 0.0
        return view[inside], pixels[inside], margin[inside] >= _BORDER_PX

    def _measurable(self, pixels: FloatArray) -> BoolArray:
        return np.asarray((pixels @ self._fuse.T)[:, 2] >= _LEAST_DISPARITY_PX)

    def _detect(self, view: IntArray, measurable: BoolArray) -> BoolArray:
        """Which of the points in view are found: by chance, and the strongest of too many."""
        detection = self._settings.detection
        lucky, jitter = self._detection.uniform(size=(2, len(view)))
        found: BoolArray = measurable & (lucky < detection.probability)
        if found.sum() > detection.features:
            strength = self._world.strength[view] + _STRENGTH_JITTER * jitter
            weakest = np.argsort(np.where(found, -strength, np.inf), kind="stable")
            found[weakest[detection.features :]] = False
        return found

    def _confuse(self, matched: FloatArray, in_view: FloatArray, noise: FloatArray) -> None:
        """Replaces some rows by another landmark's pixels or by anything in the image."""
        fraction, count = self._settings.outlier_fraction, len(matched)
        if fraction == 0.0 or not count:
            return
        draw = self._wrong.uniform(size=(count, 2))
        other = in_view[self._wrong.integers(len(in_view), size=count)]
        shown = np.where(draw[:, 1:] < 0.5, other, self._anywhere(count)) + noise[:count]
        wrong = (draw[:, 0] < fraction) & self._measurable(shown)
        matched[wrong] = shown[wrong]
        self.wrong_matches += int(wrong.sum())

    def _anywhere(self, count: int) -> FloatArray:
        """Pixels (count, 2 * cameras) of points anywhere in the reference image."""
        rig = self._rig
        size = np.array([rig.width - 1.0, rig.height - 1.0])
        least = rig.fx * rig.baseline / MOST_RANGE_M
        most = min(rig.fx * rig.baseline / LEAST_RANGE_M, rig.width / 2)
        uniform = self._wrong.uniform(size=(count, 3))
        measurement = np.column_stack(
            [uniform[:, :2] * size, least + uniform[:, 2] * (most - least)]
        )
        return np.asarray(measurement @ self._model.T)

    def _observe(self, sightings: Sightings, pixels: FloatArray) -> Observations:
        count = len(pixels)
        raw = np.full((count, 3, 2), np.nan)
        raw[:, : self._rig.cameras] = pixels.reshape(count, self._rig.cameras, 2)
        return Observations(
            ids=np.concatenate([sightings.matched_ids, sightings.new_ids]),
            measurement=pixels @ self._fuse.T,
            covariance=np.tile(self._covariance, (count, 1, 1)),
            pixels=raw,
            is_new=np.arange(count) >= len(sightings.matched),
        )


def _moved_points(settings: SimulatedMeasurementsSettings, world: LandmarkWorld) -> FloatArray:
    """Where the points are after some have moved; the world's seed chooses which."""
    moved = settings.moved
    if moved is None:
        return world.points
    rng = np.random.default_rng([settings.world.world_seed, _MOVED])
    gone = rng.uniform(size=len(world)) < moved.fraction
    angle = rng.uniform(0.0, 2.0 * np.pi, size=len(world))
    shift = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(world))])
    return np.asarray(world.points + _MOVED_M * gone[:, None] * shift)


# --------------------------------------------------------------------------------------------
# Wheel odometry


def simulate_odometry(
    settings: SimulatedMeasurementsSettings, body: FloatArray, rng: np.random.Generator
) -> list[Odometry]:
    """Body motions between consecutive true poses (n, 4, 4): n - 1 of them.

    Noise as stated times ``detection.noise_scale``; while ``odometry_fault`` lasts, true motions
    are reported scaled (along their screw) under the same covariance.
    """
    noise_scale, fault = settings.detection.noise_scale, settings.odometry_fault
    true = g.inverse(body[:-1]) @ body[1:]
    out = []
    for i, step in enumerate(wheel_odometry.simulate(settings.odometry, body, rng)):
        noise = g.inverse(true[i]) @ step.motion
        if noise_scale != 1.0:
            noise = g.se3_exp(noise_scale * g.se3_log(noise))
        motion = true[i]
        if fault is not None and 0 <= i + 1 - fault.start < fault.frames:
            motion = g.se3_exp(fault.scale * g.se3_log(motion))
        out.append(Odometry(np.asarray(motion @ noise), step.covariance))
    return out
