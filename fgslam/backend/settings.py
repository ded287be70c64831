"""Settings of the estimators: filters, smoothers, and their union over ``kind``."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT

Family: TypeAlias = Literal["filter", "smoother", "other"]
"""Whether past poses are revised; paired tests compare smoothers with filters, and no others.

An `other` corrects nothing by landmarks seen again: dead reckoning.
"""
_FAMILIES: dict[str, Family] = {
    "landmark_kalman": "filter",
    "landmark_kalman_graph": "filter",
    "ekf": "filter",
    "fixed_lag": "smoother",
    "isam2": "smoother",
    "batch": "smoother",
}


@dataclass(frozen=True, config=STRICT)
class FloorSettings:
    """How an estimator uses the floor under the robot."""

    mode: Annotated[
        Literal["auto", "none", "soft", "hard"],
        Field(
            description="`auto` the degrees of freedom of frontend.ego_motion.dof, exactly; `none` "
            "all six; `hard` and `soft` those of dof (height, pitch and roll where it is 6), "
            "exactly or up to the deviations below"
        ),
    ] = "auto"
    height_sigma_m: Annotated[
        float, Field(gt=0.0, description="soft: deviation of the camera's height a frame, metres")
    ] = 0.005
    tilt_sigma_deg: Annotated[
        float, Field(gt=0.0, description="soft: deviation of pitch and of roll a frame, degrees")
    ] = 0.2


@dataclass(frozen=True, config=STRICT)
class KernelSettings:
    """Robust loss over a whitened residual, so that single wrong matches lose their pull."""

    name: Annotated[
        Literal["none", "huber", "cauchy", "geman_mcclure", "tukey"],
        Field(description="the M-estimator; `none` is least squares"),
    ] = "cauchy"
    width: Annotated[
        float,
        Field(gt=0.0, description="its scale, in standard deviations of the whole measurement"),
    ] = 3.0


@dataclass(frozen=True, config=STRICT)
class NamedSettings:
    """What every estimator has."""

    label: Annotated[
        str | None,
        Field(
            pattern=r"^[A-Za-z0-9][\w.+-]*$",
            description="name of its folder and of its row in tables; null: its kind",
        ),
    ] = None

    @property
    def title(self) -> str:
        """The label, or the kind where there is none."""
        return self.label or str(getattr(self, "kind", ""))


@dataclass(frozen=True, config=STRICT)
class DeadReckoningSettings(NamedSettings):
    """Odometry alone: poses are never corrected, landmarks stay where they were first seen."""

    kind: Literal["odometry"] = "odometry"


@dataclass(frozen=True, config=STRICT)
class PerLandmarkSettings(NamedSettings):
    """What the paper's filter and the same filter as factor graphs share."""

    pose_covariance: Annotated[
        bool,
        Field(
            description="add the pose's covariance to the observation's (6.4 read with IJRR 2002)"
        ),
    ] = True


@dataclass(frozen=True, config=STRICT)
class LandmarkKalmanSettings(PerLandmarkSettings):
    """The paper's estimator: least-squares pose, one 3x3 filter per landmark (6.4)."""

    kind: Literal["landmark_kalman"] = "landmark_kalman"
    update: Annotated[
        Literal["pixel", "world", "running_mean", "half"],
        Field(
            description="how a matched landmark moves: `pixel` Kalman update on (column, row, "
            "disparity), the most accurate measured; `world` Kalman fusion of 3-D positions "
            "(6.4); `running_mean` and `half` the plain averaging of 4.1 (with and without a count)"
        ),
    ] = "pixel"


@dataclass(frozen=True, config=STRICT)
class LandmarkKalmanGraphSettings(PerLandmarkSettings):
    """The same estimator as factor graphs: equal to ``landmark_kalman`` up to rounding."""

    kind: Literal["landmark_kalman_graph"] = "landmark_kalman_graph"
    update: Annotated[
        Literal["pixel", "world", "running_mean", "half"],
        Field(description="as landmark_kalman's; the averaging of 4.1 by factors of equal weight"),
    ] = "pixel"


@dataclass(frozen=True, config=STRICT)
class EkfSettings(NamedSettings):
    """Full stochastic mapping: one joint covariance of pose and landmarks, no relinearisation."""

    kind: Literal["ekf"] = "ekf"
    floor: FloorSettings = FloorSettings()
    gate_sigmas: Annotated[
        float,
        Field(
            ge=0.0,
            description="a match is left out when its own innovation exceeds this many standard "
            "deviations (Mahalanobis distance); 0: no gate",
        ),
    ] = 5.0
    max_landmarks: Annotated[
        int,
        Field(
            ge=1,
            description="refuse to hold more: the joint covariance takes 72 n^2 bytes, 1.2 GB for "
            "4000 landmarks, and up to half as much again in reserve",
        ),
    ] = 4000


@dataclass(frozen=True, config=STRICT)
class GraphSettings(NamedSettings):
    """What all smoothers share: how measurements become a graph that can be solved."""

    floor: FloorSettings = FloorSettings()
    kernel: KernelSettings = KernelSettings()
    noise_factor: Annotated[
        Annotated[float, Field(gt=0.0)] | None,
        Field(
            description="standard deviations of landmark measurements are multiplied by this when "
            "they are weighed; kernel and trim judge by the stated ones. null: estimated from "
            "the residuals, since errors of a landmark persist from frame to frame, which a graph "
            "of independent measurements would average away",
        ),
    ] = None
    gate_px: Annotated[
        float,
        Field(
            ge=0.0,
            description="matches that the frame's own least squares rejected are left out where "
            "their image residual exceeds this; nearer ones may be right, and the map have "
            "drifted: the kernel deals with them. A range sensor's are all left out. 0: none is",
        ),
    ] = 12.0


@dataclass(frozen=True, config=STRICT)
class FixedLagSettings(GraphSettings):
    """Incremental fixed-lag smoother: what is older than the lag is marginalised."""

    kind: Literal["fixed_lag"] = "fixed_lag"
    kernel: KernelSettings = KernelSettings("huber", 4.0)
    lag_frames: Annotated[
        int | None, Field(ge=1, description="lag in frames; null: the lag is given in seconds")
    ] = 10
    lag_s: Annotated[
        float | None, Field(gt=0.0, description="lag in seconds; used where lag_frames is null")
    ] = None


@dataclass(frozen=True, config=STRICT)
class Isam2Settings(GraphSettings):
    """iSAM2 over all poses and landmarks."""

    kind: Literal["isam2"] = "isam2"
    update_every: Annotated[
        int,
        Field(
            ge=1,
            description="frames between updates of the graph; a tracker (the paper's filter, "
            "on the smoothed map) answers in between",
        ),
    ] = 5
    ordering_window: Annotated[
        int,
        Field(
            ge=0,
            description="so many last poses are kept at the root of the Bayes tree; 0: GTSAM's own "
            "choice, all variables of the update",
        ),
    ] = 30
    keyframe_every: Annotated[
        int,
        Field(
            ge=1,
            description="frames to a keyframe; what the frames between measured is summarised in "
            "factors of the keyframe. 1: every frame is a variable",
        ),
    ] = 1


@dataclass(frozen=True, config=STRICT)
class BatchSettings(GraphSettings):
    """Everything at once, the reference of the comparison."""

    kind: Literal["batch"] = "batch"
    gate_px: Annotated[
        float,
        Field(ge=0.0, description="as isam2's; 0: the whole problem decides what fits"),
    ] = 0.0
    trim: Annotated[
        bool,
        Field(
            description="after the minimum with the kernel, leave out observations beyond the "
            "99.9 % quantile of chi-square and solve the rest without it: its covariances are "
            "those of least squares"
        ),
    ] = True
    method: Annotated[
        Literal["levenberg_marquardt", "gnc"],
        Field(
            description="Levenberg-Marquardt with the kernel, or graduated non-convexity "
            "(truncated least squares) without"
        ),
    ] = "levenberg_marquardt"
    solve_every: Annotated[
        int,
        Field(
            ge=0,
            description="live: solve anew after so many frames and track against the result; 0: "
            "the tracker alone steers, the solution comes with the estimate",
        ),
    ] = 0


EstimatorSettings: TypeAlias = Annotated[
    DeadReckoningSettings
    | LandmarkKalmanSettings
    | LandmarkKalmanGraphSettings
    | EkfSettings
    | FixedLagSettings
    | Isam2Settings
    | BatchSettings,
    Field(discriminator="kind"),
]


DEFAULT_ESTIMATOR = Isam2Settings.kind
"""Of a recording that comes without a configuration, and of a session; why: the table in
docs/howto/your_recording.md."""


def family_of(kind: str) -> Family:
    """Whether estimators of a kind are filters, smoothers or neither."""
    return _FAMILIES.get(kind, "other")
