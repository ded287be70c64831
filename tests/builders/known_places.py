"""Worlds of landmarks with looks, and what a rig sees of them: exact truth for relocalisation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core import geometry
from fgslam.core.arrays import ByteArray, FloatArray, IntArray
from fgslam.core.sensors import CameraRig
from fgslam.core.types import (
    DegreesOfFreedom,
    Floor,
    LandmarkAppearances,
    LandmarkMap,
    StereoFeatures,
)

RIG = CameraRig(
    320, 240, 277.0, 277.0, 159.5, 119.5, 0.1, 0.1, geometry.BODY_FORWARD_LEFT_UP_FROM_CAMERA
)
PIXEL_SIGMA = 0.2


def floor(dof: DegreesOfFreedom) -> Floor:
    """The floor under the rig."""
    return Floor.under(RIG, dof)


def random_descriptors(rng: np.random.Generator, count: int) -> ByteArray:
    """(count, 128) descriptors as SIFT's: sparse, of norm 512."""
    values = rng.gamma(0.5, 1.0, (count, 128))
    values *= 512.0 / np.linalg.norm(values, axis=1, keepdims=True)
    return np.asarray(np.minimum(np.rint(values), 255.0), np.uint8)


def blurred(descriptors: ByteArray, rng: np.random.Generator, sigma: float = 12.0) -> ByteArray:
    """The same looks seen again."""
    noisy = descriptors + rng.normal(0.0, sigma, descriptors.shape)
    return np.asarray(np.clip(np.rint(noisy), 0, 255), np.uint8)


@dataclass(frozen=True)
class Place:
    """Landmarks (n, 3) with looks (n, 128), sizes and orientations (n,)."""

    points: FloatArray
    descriptors: ByteArray
    size: FloatArray
    orientation: FloatArray

    def __len__(self) -> int:
        return len(self.points)

    def select(self, rows: IntArray) -> Place:
        return Place(
            self.points[rows], self.descriptors[rows], self.size[rows], self.orientation[rows]
        )

    def join(self, other: Place) -> Place:
        return Place(
            np.concatenate([self.points, other.points]),
            np.concatenate([self.descriptors, other.descriptors]),
            np.concatenate([self.size, other.size]),
            np.concatenate([self.orientation, other.orientation]),
        )

    def moved(self, by: FloatArray) -> Place:
        """The same things elsewhere."""
        return Place(self.points + by, self.descriptors, self.size, self.orientation)

    def map(self) -> tuple[LandmarkMap, LandmarkAppearances]:
        """As a map knows them: exact, one view each, from directions unknown."""
        ids = 10 + 3 * np.arange(len(self))
        landmarks = LandmarkMap(ids, self.points, np.tile(1e-4 * np.eye(3), (len(self), 1, 1)))
        directions = np.full((len(self), 3), np.nan)
        views = LandmarkAppearances(ids, self.descriptors, self.size, self.orientation, directions)
        return landmarks, views


def things(rng: np.random.Generator, low: FloatArray, high: FloatArray, count: int) -> Place:
    """Landmarks anywhere in a box."""
    return Place(
        rng.uniform(low, high, (count, 3)),
        random_descriptors(rng, count),
        rng.uniform(6.0, 20.0, count),
        rng.uniform(0.0, 2.0 * np.pi, count),
    )


def room(rng: np.random.Generator, count: int = 600) -> Place:
    """Landmarks on the four walls of a room of 10 m x 10 m around the origin."""
    found = things(rng, np.array([-5.0, -1.5, -5.0]), np.array([5.0, 1.0, 5.0]), count)
    wall = rng.integers(0, 4, count)
    axis = np.where(wall < 2, 0, 2)
    found.points[np.arange(count), axis] = np.where(wall % 2 == 0, -5.0, 5.0)
    return found


def planar(x: float, z: float, yaw: float) -> FloatArray:
    """A pose on the floor."""
    return geometry.pose(geometry.so3_exp(np.array([0.0, yaw, 0.0])), np.array([x, 0.0, z]))


def seen(
    place: Place, wTc: FloatArray, rng: np.random.Generator, clutter: int = 0, roll: float = 0.0
) -> StereoFeatures:
    """Features of the landmarks in all images, in random order, with noise, and of other things."""
    points = geometry.transform_to_camera(wTc, place.points)
    rows = np.flatnonzero(points[:, 2] > 0.5)
    measured = RIG.predict(points[rows])
    inside = (measured[:, :2] > 0.0).all(axis=1)
    inside &= measured[:, 0] + measured[:, 2] < RIG.width - 1
    inside &= measured[:, 1] + measured[:, 2] < RIG.height - 1
    own, measured = place.select(rows[inside]), measured[inside]
    strange = rng.uniform(
        [0.0, 0.0, 3.0], [RIG.width - 20.0, RIG.height - 20.0, 15.0], (clutter, 3)
    )
    scale = np.concatenate([own.size / points[rows[inside], 2], rng.uniform(1.5, 6.0, clutter)])
    turned = np.concatenate([own.orientation - roll, rng.uniform(0.0, 6.28, clutter)])
    exact = np.concatenate([measured, strange])
    descriptors = np.concatenate([blurred(own.descriptors, rng), random_descriptors(rng, clutter)])
    order = rng.permutation(len(exact))
    return features(
        exact[order] + rng.normal(0.0, PIXEL_SIGMA, exact.shape),
        scale[order],
        turned[order],
        descriptors[order],
    )


def features(
    measurement: FloatArray, scale: FloatArray, orientation: FloatArray, descriptors: ByteArray
) -> StereoFeatures:
    """Stereo features from their measurements."""
    count = len(measurement)
    measurement = np.maximum(measurement, [-np.inf, -np.inf, 0.5])
    noise = np.tile(PIXEL_SIGMA**2 * np.eye(3), (count, 1, 1))
    return StereoFeatures(
        measurement=measurement,
        measurement_covariance=noise,
        scale=scale,
        orientation=orientation,
        descriptors=descriptors,
        position=RIG.triangulate(measurement),
        position_covariance=RIG.triangulation_covariance(measurement, noise),
        pixels=np.full((count, 3, 2), np.nan),
    )


def error(found: FloatArray, truth: FloatArray) -> tuple[float, float]:
    """Metres and degrees between two poses."""
    between = geometry.inverse(truth) @ found
    turn = np.rad2deg(geometry.rotation_angle(between[:3, :3]))
    return float(np.linalg.norm(between[:3, 3])), float(turn)
