"""Remarks of a session on its cameras: frames whose images could not be used, unequal exposure."""

from __future__ import annotations

from fgslam.core.estimates import EgoMotionStatus
from fgslam.frontend.camera_faults import CameraWatch
from fgslam.slam.results import RunRecorder


def camera_remarks(recorder: RunRecorder, watch: CameraWatch | None) -> tuple[str, ...]:
    """A line for each fault with its frames; none where the cameras are sound or not watched."""
    frames: dict[str, list[int]] = {}
    for number, row in zip(recorder.log.numbers.tolist(), recorder.rows, strict=True):
        if row.status == EgoMotionStatus.CAMERA_FAULT.value:
            frames.setdefault(row.problem, []).append(number)
    lines = [
        f"{fault}: {len(which)} of {len(recorder)} frames, {_between(which)}, are not used; their "
        f"poses are predicted ({'swap their images' if 'swapped' in fault else 'mend the camera'}; "
        "frontend.watch_cameras: false uses them all)"
        for fault, which in frames.items()
    ]
    return (*lines, *(() if watch is None else watch.remarks()))


def _between(frames: list[int]) -> str:
    """First and last of some frames in words."""
    if len(frames) == 1:
        return f"frame {frames[0]}"
    return f"from {frames[0]} to {frames[-1]}"
