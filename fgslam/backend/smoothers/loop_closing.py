"""Loops in a smoother's graph: a first guess that keeps every place as it is, then the solution.

The graph as solved before the loop and as it must be with it lie far apart. Linearised in between,
landmarks would fly and kernels drop what is right: so poses and landmarks are first brought to
where backward correction (:mod:`fgslam.backend.filters.submaps`) has them, each landmark along
with the frame that saw it first. There every observation fits as before, and what is left is small.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import gtsam
import numpy as np

from fgslam.backend.filters.submaps import Chain, Constraint, changes, corrected
from fgslam.backend.smoothers.graph_builder import GraphBuilder
from fgslam.backend.smoothers.graph_solution import poses_of_frame
from fgslam.backend.smoothers.outliers import solver_parameters
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.estimates import EgoMotion
from fgslam.core.geometry import adjoint, congruence, inverse, transform_to_world
from fgslam.core.measurements import LoopClosure
from fgslam.factors.keys import landmark_key, pose_key

_ITERATIONS = 20
_ENOUGH = 2.0  # the last iteration's gain, half squared deviations: far below the gate's square
_TOLERANCE = 1e-6  # of the cost, where that is small


def misfit(factor: Any, values: Any) -> float:
    """Squared residual of a factor, in its deviations."""
    return 2.0 * float(factor.error(values))


def carried_to(frame: int, loop: LoopClosure, trackings: list[EgoMotion], last: int) -> Constraint:
    """The closure as one to a neighbour of the earlier frame, by how both were tracked.

    Args:
        frame: of the neighbour, tracked against the same map; may be the earlier frame itself.
        loop: the closure.
        trackings: of all frames.
        last: the present frame.
    """
    if frame == loop.frame:
        return Constraint(frame, last, loop.oTc, loop.covariance)
    neighbour, earlier = trackings[frame], trackings[loop.frame]
    kTo = inverse(neighbour.wTc) @ earlier.wTc
    own = earlier.covariance + congruence(adjoint(inverse(kTo)), neighbour.covariance)
    covariance = loop.covariance + congruence(adjoint(inverse(loop.oTc)), own)
    return Constraint(frame, last, kTo @ loop.oTc, covariance)


def first_guess(
    builder: GraphBuilder, values: Any, chain: Chain, loops: list[Constraint], every: int
) -> Any:
    """Values of all variables with the last of ``loops`` closed, each place moved as a whole.

    Args:
        builder: the graph so far.
        values: its solution without that loop.
        chain: the drive as tracked, for the uncertainty of its steps and for what ties it.
        loops: all that are closed; those before the last are held as the values have them.
        every: poses to a submap.
    """
    frames = np.array(builder.frames)
    poses = np.array([poses_of_frame(values, frame) for frame in builder.frames])
    held = [_as_solved(known, frames, poses) for known in (*chain.constraints, *loops[:-1])]
    ends = [_row(frames, loops[-1].before), _row(frames, loops[-1].after)]
    new = dataclasses.replace(loops[-1], before=ends[0], after=ends[1])
    constraints = [known for known in held if known.before != known.after]
    found = corrected(poses, chain.steps_between(frames), [*constraints, new], every).poses
    return _moved(builder, values, frames, found, changes(poses, found))


def solved(graph: Any, values: Any) -> Any:
    """Values at the minimum of a graph with its kernels."""
    params = solver_parameters(_ITERATIONS, _TOLERANCE)
    params.setAbsoluteErrorTol(_ENOUGH)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()


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
