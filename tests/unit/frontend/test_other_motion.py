"""A second rigid motion in the view: something large that passes, or nothing but the scene."""

from __future__ import annotations

import time
from typing import Any

import cv2
import numpy as np
import pytest
from textured_room import TEXTURE

from fgslam.core.arrays import Image
from fgslam.core.sensors import CameraRig
from fgslam.core.store import restore, state_of
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver
from fgslam.frontend.tracking.tracker import OtherMotion
from fgslam.slam.results import STAGES
from fgslam.slam.session import Session

RIG = CameraRig(240, 180, 180.0, 180.0, 119.5, 89.5, 0.12, None, np.eye(4))
SCENE = ((5.0, -9.0, 9.0), (3.0, -1.6, -0.9), (2.5, 0.7, 1.5))
"""Planes that face the camera: depth, left and right edge in metres."""
BOARD_M = 0.5
FRAMES = 6
_SLOW_S = 0.05


def seen(planes: list[tuple[float, float, float]], x: float, z: float) -> Image:
    """What a camera at (x, 0, z) sees of planes, far ones first."""
    size = (RIG.width, RIG.height)
    image = np.zeros(size[::-1], np.float32)
    for k, (depth, left, right) in enumerate(planes):
        texels = 70.0 if k < len(SCENE) else 200.0  # of a metre
        texture = np.asarray(np.roll(TEXTURE, 97 * k, axis=1)[:, : int(texels * (right - left))])
        scale = RIG.fx / (depth - z)
        of_texel = scale / texels
        affine = np.array(
            [[of_texel, 0.0, scale * (left - x) + RIG.cx], [0.0, of_texel, RIG.cy - 200 * of_texel]]
        )
        warped = cv2.warpAffine(texture.astype(np.float32), affine, size, flags=cv2.INTER_AREA)
        there = cv2.warpAffine(np.ones(texture.shape, np.float32), affine, size)
        image = np.where(there > 0.5, warped, image)
    return np.asarray(np.clip(np.round(image), 0, 255), np.uint8)


def drive(board_m: float, step_m: float) -> Session:
    """4 cm a frame ahead; a board, at first ``board_m`` away, goes to the right before the camera.

    With a step of none it stands in the room.
    """
    session = Session(RIG)
    for k in range(FRAMES):
        ahead, left = 0.04 * k, -0.6 + step_m * k
        depth = board_m + (ahead if step_m else 0.0)
        planes = [*SCENE, (depth, left, left + BOARD_M)]
        session.track(0.1 * k, tuple(seen(planes, x, ahead) for x in (-RIG.baseline, 0.0)))
    return session


def test_something_large_that_passes_is_told() -> None:
    with drive(1.2, 0.1) as session:
        told = [note for note in session.result().notes if "something else moves" in note]
        assert len(told) == 1, session.result().notes
        watch = session.pipeline.tracker.other_motion
        other = OtherMotion(RIG, EgoMotionSolver(RIG, EgoMotionSettings()))
        restore(other, state_of(watch))
        assert other.remarks() == watch.remarks() == (told[0],)
        for name, array in state_of(watch).items():
            np.testing.assert_array_equal(state_of(other)[name], array)


def test_a_scene_that_stands_has_one_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    look = OtherMotion.look

    def slowly(*arguments: Any) -> None:
        time.sleep(_SLOW_S)
        look(*arguments)

    monkeypatch.setattr(OtherMotion, "look", slowly)
    with drive(1.6, 0.0) as session:
        assert session.result().notes == ()
        assert session.pipeline.tracker.other_motion.remarks() == ()
        watching = session.recorder.stage_ms[0][STAGES.index("watch")]  # a key frame
        assert watching >= 1e3 * _SLOW_S, "the time is not the estimator's"
