"""One program over a folder of rectified pairs: ORB-SLAM3, plain frame-to-frame PnP, or fgslam.

Run as `python -m benchmarks.evidence.peer METHOD FOLDER`, in a process of its own: what the method
does not use is not imported, so that its processor time is its own. FOLDER is a recording in the
simple layout (`left/`, `right/`, `times.txt`, `calib.json`); `live.tum` and, of ORB-SLAM3,
`end.tum` are written into it (poses of the left camera), and `loop.json`.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]
Grey: TypeAlias = NDArray[np.uint8]
Step: TypeAlias = Callable[[Grey, Grey, float], Floats | None]
"""Pose (4, 4) of the left camera for a pair at a time; None where it is not located."""

VOCABULARY = "PEERS_VOCABULARY"
"""Environment variable with the path of ORB-SLAM3's vocabulary."""
_ROW_PX, _RATIO, _REPROJECTION_PX = 1.5, 0.8, 1.5
_CORNERS, _BACK_PX = 1500, 0.7
_MAPPING_S = 0.15  # ORB-SLAM3 maps in threads, which need the time between two frames


def main() -> None:
    """Runs the method, writes what it found beside the images."""
    method, folder = sys.argv[1], Path(sys.argv[2])
    rig = json.loads((folder / "calib.json").read_text())
    times = np.loadtxt(folder / "times.txt", ndmin=2)[:, 1]
    shots = ((t, *_pair(folder, k)) for k, t in enumerate(times))
    if method == "orb_slam3":
        poses, spent = _orb_slam3(folder, rig, shots)
    else:
        step = PLAIN[method](rig) if method in PLAIN else _fgslam(method, rig)
        poses, spent = _drive(step, shots)
    write_tum(folder / "live.tum", times, poses)
    located = sum(pose is not None for pose in poses)
    status = Path("/proc/self/status").read_text()
    memory = float(status.split("VmHWM:")[1].split()[0]) / 1024.0
    told = {"loop_s": spent, "located": located, "memory_mb": memory}
    (folder / "loop.json").write_text(json.dumps(told), encoding="utf-8")


def _pair(folder: Path, k: int) -> tuple[Grey, Grey]:
    left, right = (
        cv2.imread(str(folder / side / f"{k:06d}.png"), cv2.IMREAD_GRAYSCALE)
        for side in ("left", "right")
    )
    return np.asarray(left, np.uint8), np.asarray(right, np.uint8)


def _drive(
    step: Step, shots: Iterator[tuple[float, Grey, Grey]], pause: float = 0.0
) -> tuple[list[Floats | None], float]:
    """Poses, and the process' CPU seconds from image to pose."""
    poses, spent = [], 0.0
    for t, left, right in shots:
        start = time.process_time()
        poses.append(step(left, right, t))
        if pause:
            time.sleep(pause)
        spent += time.process_time() - start
    return poses, spent


def write_tum(path: Path, times: Floats, poses: list[Floats | None]) -> None:
    """Located poses as TUM lines: t x y z qx qy qz qw."""
    from scipy.spatial.transform import Rotation

    with path.open("w", encoding="utf-8") as out:
        for t, pose in zip(times, poses, strict=True):
            if pose is not None:
                q = Rotation.from_matrix(pose[:3, :3]).as_quat()
                out.write(" ".join(f"{v:.9f}" for v in (t, *pose[:3, 3], *q)) + "\n")


def _orb_slam3(
    folder: Path, rig: dict[str, Any], shots: Iterator[tuple[float, Grey, Grey]]
) -> tuple[list[Floats | None], float]:
    import pyorbslam3  # GPL: used here and nowhere else

    settings = folder / "orb_slam3.yaml"
    settings.write_text(
        _ORB_SETTINGS.format(**rig, bf=rig["fx"] * rig["baseline_m"]), encoding="utf-8"
    )
    slam = pyorbslam3.Slam(os.environ[VOCABULARY], settings, pyorbslam3.Sensor.STEREO)

    def step(left: Grey, right: Grey, t: float) -> Floats | None:
        found = slam.track_stereo(left, right, t)
        return np.asarray(found.pose_wc, np.float64) if found.ok and found.pose_valid else None

    out = _drive(step, shots, _MAPPING_S)
    slam.shutdown()
    end = folder / "end.tum"
    slam.save_trajectory_tum(str(end))
    # It writes frames of several maps one after the other, some of them twice: the last counts.
    lines = {float(line.split()[0]): line for line in end.read_text().splitlines()}
    end.write_text("".join(f"{lines[t]}\n" for t in sorted(lines)), encoding="utf-8")
    return out


_ORB_SETTINGS = """%YAML:1.0
Camera.type: "PinHole"
Camera.fx: {fx:.9f}
Camera.fy: {fy:.9f}
Camera.cx: {cx:.9f}
Camera.cy: {cy:.9f}
Camera.k1: 0.0
Camera.k2: 0.0
Camera.p1: 0.0
Camera.p2: 0.0
Camera.bf: {bf:.9f}
ThDepth: 40.0
Camera.width: {width}
Camera.height: {height}
Camera.fps: 10.0
Camera.RGB: 1
ORBextractor.nFeatures: 2000
ORBextractor.scaleFactor: 1.2
ORBextractor.nLevels: 8
ORBextractor.iniThFAST: 20
ORBextractor.minThFAST: 7
Viewer.KeyFrameSize: 0.05
Viewer.KeyFrameLineWidth: 1.0
Viewer.GraphLineWidth: 0.9
Viewer.PointSize: 2.0
Viewer.CameraSize: 0.08
Viewer.CameraLineWidth: 3.0
Viewer.ViewpointX: 0.0
Viewer.ViewpointY: -0.7
Viewer.ViewpointZ: -1.8
Viewer.ViewpointF: 500.0
"""
"""Its own settings for KITTI and EuRoC, but for the camera."""


def _fgslam(estimator: str, rig: dict[str, Any]) -> Step:
    """The library, frame by frame."""
    import fgslam as fg
    from fgslam.core.sensors import CameraRig

    w, h, fx, fy, cx, cy = (rig[name] for name in ("width", "height", "fx", "fy", "cx", "cy"))
    slam: Any = fg.Slam(
        CameraRig(w, h, fx, fy, cx, cy, rig["baseline_m"], None, np.eye(4)), estimator
    )

    def step(left: Grey, right: Grey, t: float) -> Floats | None:
        return np.asarray(slam.track(t, (left, right)).wTc, np.float64)

    return step


def _sift(rig: dict[str, Any]) -> Step:
    """SIFT in both images, matched by rows, then to the frame before; PnP on what agrees."""
    detector = cv2.SIFT.create(2000)
    before: list[tuple[Floats, Grey]] = []
    wTl = np.eye(4)

    def step(left: Grey, right: Grey, t: float) -> Floats | None:
        nonlocal wTl
        (at, words), (at_right, words_right) = (_features(detector, one) for one in (left, right))
        pairs = _matched(words, words_right)
        disparity = at[pairs[:, 0], 0] - at_right[pairs[:, 1], 0]
        rows = np.abs(at[pairs[:, 0], 1] - at_right[pairs[:, 1], 1])
        good = pairs[(rows < _ROW_PX) & (disparity > 0.5), 0]
        disparity = disparity[(rows < _ROW_PX) & (disparity > 0.5)]
        points = _points(rig, at[good], disparity)
        found: Floats | None = wTl
        if before:
            known, their_words = before[0]
            links = _matched(their_words, words)
            found = _moved(rig, known[links[:, 0]], at[links[:, 1]], wTl)
        before[:] = [(points, words[good])]
        wTl = wTl if found is None else found
        return found

    return step


def _klt(rig: dict[str, Any]) -> Step:
    """Corners followed by KLT into the other image and into the next frame; PnP on both."""
    before: list[tuple[Grey, Grey]] = []
    wTl = np.eye(4)

    def step(left: Grey, right: Grey, t: float) -> Floats | None:
        nonlocal wTl
        found: Floats | None = wTl
        if before:
            last, last_right = before[0]
            corners = cv2.goodFeaturesToTrack(last, _CORNERS, 0.01, 7.0)
            at = np.empty((0, 1, 2), np.float32) if corners is None else corners
            beside, seen = _followed(last, last_right, at)
            now, kept = _followed(last, left, at)
            disparity, rows = (at - beside)[:, 0].T
            good = seen & kept & (np.abs(rows) < _ROW_PX) & (disparity > 0.5)
            points = _points(rig, at[good, 0], disparity[good])
            found = _moved(rig, points, now[good, 0], wTl)
        before[:] = [(left, right)]
        wTl = wTl if found is None else found
        return found

    return step


PLAIN: dict[str, Callable[[dict[str, Any]], Step]] = {"sift_pnp": _sift, "klt_pnp": _klt}
"""Frame-to-frame odometry by name, made for a rig."""


def _features(detector: Any, image: Grey) -> tuple[Floats, Any]:
    keypoints, words = detector.detectAndCompute(image, None)
    at = np.array([one.pt for one in keypoints], np.float64).reshape(-1, 2)
    return at, np.empty((0, 128), np.float32) if words is None else words


def _matched(words: Any, others: Any) -> NDArray[np.int64]:
    """(n, 2) indices of each word and its nearest, far nearer than the second."""
    if len(words) < 2 or len(others) < 2:
        return np.empty((0, 2), np.int64)
    two = cv2.BFMatcher().knnMatch(words, others, k=2)
    good = [(a.queryIdx, a.trainIdx) for a, b in two if a.distance < _RATIO * b.distance]
    return np.array(good, np.int64).reshape(-1, 2)


def _followed(first: Grey, second: Grey, at: Any) -> tuple[Any, NDArray[np.bool_]]:
    """Corners in the second image, and which come back to where they began."""
    if not len(at):
        return at, np.empty(0, np.bool_)
    there, _, _ = cv2.calcOpticalFlowPyrLK(first, second, at, np.empty(0, np.float32))
    back, status, _ = cv2.calcOpticalFlowPyrLK(second, first, there, np.empty(0, np.float32))
    near = np.linalg.norm((back - at)[:, 0], axis=1) < _BACK_PX
    return there, near & (status[:, 0] == 1)


def _points(rig: dict[str, Any], at: Any, disparity: Any) -> Floats:
    """(n, 3) points in the left camera's frame."""
    z = rig["fx"] * rig["baseline_m"] / disparity
    x = (at[:, 0] - rig["cx"]) * z / rig["fx"]
    return np.stack([x, (at[:, 1] - rig["cy"]) * z / rig["fy"], z], axis=1).astype(np.float64)


def _moved(rig: dict[str, Any], points: Floats, at: Any, wTl: Floats) -> Floats | None:
    """The new pose from points of the frame before and where they are now."""
    if len(points) < 6:
        return None
    K = np.array([[rig["fx"], 0, rig["cx"]], [0, rig["fy"], rig["cy"]], [0, 0, 1.0]])
    at = np.asarray(at, np.float64)
    ok, turn, shift, inliers = cv2.solvePnPRansac(
        points, at, K, None, reprojectionError=_REPROJECTION_PX, iterationsCount=300
    )
    if not ok or inliers is None or len(inliers) < 6:
        return None
    some = inliers[:, 0]
    turn, shift = cv2.solvePnPRefineLM(points[some], at[some], K, None, turn, shift)
    nTp = np.eye(4)
    nTp[:3, :3], nTp[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
    return np.asarray(wTl @ np.linalg.inv(nTp), np.float64)


if __name__ == "__main__":
    main()
