"""The whole graph beside what a user would write instead: forty lines of GTSAM, on KITTI's tracks.

Both get the same measurements, the same start, the same loss, and stop where the cost falls by less
than GTSAM's own 1e-5 of itself. Processor times in this process, taken in turns; medians.
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from benchmarks.gtsam_graphs import in_arrays
from benchmarks.speed.drives import MeasuredDrive, cpu_seconds, interleaved, open_drive, play
from fgslam.backend.settings import BatchSettings, FixedLagSettings, Isam2Settings, KernelSettings
from fgslam.backend.smoothers.smoother import Smoother
from fgslam.core.arrays import FloatArray
from fgslam.core.sensors import CameraRig
from fgslam.core.threads import one_blas_thread
from fgslam.factors.noise import KernelName

LIMITS = {
    "whole_graph_none_over_plain_gtsam": 0.5,
    "whole_graph_huber_over_plain_gtsam": 0.5,
    "whole_graph_cauchy_over_plain_gtsam": 0.5,
    "batch_estimate_over_plain_gtsam_huber": 0.5,
    "isam2_final_over_plain_gtsam_huber": 0.5,
    "fixed_lag_kitti00_ms_per_frame": 100.0,
}
WIDTHS: dict[KernelName, float] = {"none": 1.0, "huber": 1.345, "cauchy": 3.0}
_TOLERANCE = 1e-5  # GTSAM's own


class PlainGtsam:
    """The drive's graph as GTSAM's examples write it: left camera, no admission, no odometry."""

    def __init__(self, drive: MeasuredDrive, kernel: KernelName) -> None:
        """Builds graph and start from the log and what the paper's filter has tracked."""
        rig = drive.log.rig
        assert isinstance(rig, CameraRig)
        camera = gtsam.Cal3_S2Stereo(rig.fx, rig.fy, 0.0, rig.cx, rig.cy, rig.baseline)
        place = gtsam.Pose3(gtsam.Rot3(), np.array([-rig.baseline, 0.0, 0.0]))
        loss = _loss(kernel)
        start = play(drive, BatchSettings()).estimator
        assert isinstance(start, Smoother)
        self.graph, self.values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        tracked, points = [one.tracking for one in start.inputs], start.landmarks()
        stiff = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
        held = gtsam.PriorFactorPose3(gtsam.symbol("x", 0), gtsam.Pose3(tracked[0].wTc), stiff)
        self.graph.add(held)
        for k, increment in enumerate(drive.log.increments):
            pose = gtsam.symbol("x", k)
            self.values.insert(pose, gtsam.Pose3(tracked[k].wTc))
            seen = increment.observations
            for i, row in enumerate(points.rows(seen.ids).tolist()):
                point = gtsam.symbol("l", row)
                column, line, disparity = seen.measurement[i].tolist()
                model: Any = gtsam.noiseModel.Gaussian.Covariance(_in_both(seen.covariance[i]))
                if loss is not None:
                    model = gtsam.noiseModel.Robust.Create(loss, model)
                measured = gtsam.StereoPoint2(column + disparity, column, line)
                factor = gtsam.GenericStereoFactor3D(
                    measured, model, pose, point, camera, False, False, place
                )
                self.graph.add(factor)
                if not self.values.exists(point):
                    self.values.insert(point, points.positions[row])

    def minimum(self) -> Any:
        """By Levenberg and Marquardt with GTSAM's own parameters."""
        optimizer = gtsam.LevenbergMarquardtOptimizer(self.graph, self.values)
        self.found = optimizer.optimize()
        return self.found


def _loss(name: KernelName) -> Any:
    kinds = gtsam.noiseModel.mEstimator
    match name:
        case "huber":
            return kinds.Huber.Create(WIDTHS[name])
        case "cauchy":
            return kinds.Cauchy.Create(WIDTHS[name])
    return None


def _in_both(covariance: FloatArray) -> FloatArray:
    """Covariance of (left column, right column, row), of one of (column, row, disparity)."""
    both = np.array([[1.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    return np.asarray(both @ covariance @ both.T)


@one_blas_thread()
def ratios_of_smoothers(repeats: int = 3) -> dict[str, float]:
    """Of whole graphs with the same loss, and of the estimates with their treatment of outliers."""
    drive = open_drive("kitti00_tracks")
    found: dict[str, float] = {}
    plain = {kernel: PlainGtsam(drive, kernel) for kernel in WIDTHS}
    for kernel, width in WIDTHS.items():
        found |= _same_loss(plain[kernel], KernelSettings(kernel, width), repeats)
    huber = plain["huber"]
    s = interleaved(
        {
            "gtsam": lambda: cpu_seconds(huber.minimum),
            "batch": lambda: _estimate_s(drive, BatchSettings()),
            "isam2": lambda: _estimate_s(drive, Isam2Settings()),
        },
        repeats,
    )
    return found | {
        "batch_estimate_s": s["batch"],
        "isam2_final_s": s["isam2"],
        "batch_estimate_over_plain_gtsam_huber": s["batch"] / s["gtsam"],
        "isam2_final_over_plain_gtsam_huber": s["isam2"] / s["gtsam"],
    }


def _same_loss(plain: PlainGtsam, kernel: KernelSettings, repeats: int) -> dict[str, float]:
    """Time and cost over GTSAM's; taking the graph over into arrays counts."""
    costs: dict[str, float] = {}

    def ours() -> None:
        graph, state = in_arrays(plain.graph, plain.values, kernel)
        costs["ours"] = graph.cost(graph.minimum(state, 100, _TOLERANCE))

    def theirs() -> None:
        costs["gtsam"] = float(plain.graph.error(plain.minimum()))

    works = {"ours": lambda: cpu_seconds(ours), "gtsam": lambda: cpu_seconds(theirs)}
    s = interleaved(works, repeats)
    name = kernel.name
    return {
        f"plain_gtsam_{name}_s": s["gtsam"],
        f"whole_graph_{name}_s": s["ours"],
        f"whole_graph_{name}_over_plain_gtsam": s["ours"] / s["gtsam"],
        f"whole_graph_{name}_cost_over_gtsams": costs["ours"] / costs["gtsam"],
    }


def _estimate_s(drive: MeasuredDrive, settings: BatchSettings | Isam2Settings) -> float:
    """The answer for the whole drive: outliers, minimum, all covariances."""
    estimator = play(drive, settings).estimator
    return cpu_seconds(estimator.estimate)


@one_blas_thread()
def ratios_of_fixed_lag() -> dict[str, float]:
    """Of the fixed lag's frames where some 2,500 landmarks are within it: processor time."""
    ms = 1e3 * play(open_drive("kitti00_tracks"), FixedLagSettings()).cpu_s
    return {
        "fixed_lag_kitti00_ms_per_frame": float(ms.mean()),
        "fixed_lag_kitti00_ms_worst": float(ms.max()),
    }
