"""Remarks on frames that a guess alone places relative to the rest, or that contradict odometry."""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import BoolArray, IntArray
from fgslam.core.estimates import EgoMotionStatus
from fgslam.frontend.tracking.landmarks import MapParts
from fgslam.slam.bridging import bridged_frames
from fgslam.slam.results import RunRecorder


def located_frames(recorder: RunRecorder) -> BoolArray:
    """(n,) frames that landmarks gave a pose; the first one, which the world is, among them."""
    statuses = [EgoMotionStatus(status) for status in recorder.column("status").tolist()]
    return np.array([one.measured or one is EgoMotionStatus.FIRST for one in statuses], np.bool_)


def connected_frames(recorder: RunRecorder, parts: MapParts) -> BoolArray:
    """(n,) frames that measurements tie to the first one; of a frame that failed, nothing."""
    return parts.connected[: len(recorder)]


def in_first_map(recorder: RunRecorder, parts: MapParts) -> int:
    """How many frames are located in what measurements connect with the first one."""
    return int((located_frames(recorder) & connected_frames(recorder, parts)).sum())


def left_out_note(count: int) -> str:
    """That a drive begins after its first ``count`` frames."""
    return f"the first {count} frames could not be located: left out"


def part_remarks(recorder: RunRecorder, parts: MapParts) -> tuple[str, ...]:
    """Lines on frames that nothing measured, that lie in parts of their own, or off odometry."""
    return (
        *_of_bridged(recorder, parts),
        *_of_unconnected(recorder, parts),
        *_of_contradicted(recorder),
    )


def _of_bridged(recorder: RunRecorder, parts: MapParts) -> tuple[str, ...]:
    """A line where final poses may be interpolated."""
    frames = bridged_frames(parts)
    frames = frames[frames < len(recorder)]
    if not len(frames):
        return ()
    numbers = recorder.log.numbers[frames]
    return (
        f"{_named(numbers)}: not located in the first map; in the final trajectory interpolated "
        "between the located frames around, where that is more certain than what the estimator "
        "knows",
    )


def _of_unconnected(recorder: RunRecorder, parts: MapParts) -> tuple[str, ...]:
    """A line where frames are located in parts that a guess alone joins to the first."""
    apart = located_frames(recorder) & ~connected_frames(recorder, parts)
    if not apart.any():
        return ()
    numbers = recorder.log.numbers[apart]
    known, n = in_first_map(recorder, parts), len(recorder)
    return (
        f"{_named(numbers)}: located relative to each other only, not in the first map; before is "
        f"a gap that neither landmarks nor odometry bridge; {known} of {n} frames "
        f"({100.0 * known / n:.0f} %) are located in the first map",
    )


def _of_contradicted(recorder: RunRecorder) -> tuple[str, ...]:
    """A line where landmarks place most frames elsewhere than odometry does."""
    again = recorder.column("status") == EgoMotionStatus.RELOCALISED.value
    if 2 * int(again.sum()) <= len(recorder):  # the log is read only where it may be so
        return ()
    steps = [one.odometry for one in recorder.log]
    moved = np.array([step is not None and step.measured for step in steps], np.bool_)
    contradicted = int((again & moved).sum())
    if 2 * contradicted <= int(moved.sum()):
        return ()
    return (
        f"the odometry contradicts the images in {contradicted} of {int(moved.sum())} frames, "
        "which are located without it: check its unit, its clock and where the camera sits on the "
        "robot (dataset.camera_yaw_deg, dataset.lever_arm_m)",
    )


def _named(numbers: IntArray) -> str:
    """Frames by how many they are and the first and last of them."""
    if len(numbers) == 1:
        return f"frame {numbers[0]}"
    return f"{len(numbers)} frames from {numbers[0]} to {numbers[-1]}"
