"""Settings of the estimators: filters, smoothers, and their union over ``kind``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, TypeAlias, get_args

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT, Count, Index, NonNegative, Positive

FloorMode: TypeAlias = Literal["auto", "none", "soft", "hard"]
OnFloor: TypeAlias = Annotated[
    FloorMode,
    Field(
        description="the floor under the robot: `auto` as frontend.ego_motion.dof; `none`; `hard` "
        "exact; `soft` up to 5 mm and 0.2 degrees a frame"
    ),
]
Family: TypeAlias = Literal["filter", "smoother", "other"]
"""Whether past poses are revised; paired tests compare smoothers with filters, and no others.

An `other` corrects nothing by landmarks seen again: dead reckoning.
"""


@dataclass(frozen=True, config=STRICT)
class KernelSettings:
    """Robust loss over a whitened residual, so that single wrong matches lose their pull."""

    name: Literal["none", "huber", "cauchy", "geman_mcclure", "tukey"] = Field(
        default="cauchy", description="the M-estimator; `none` is least squares"
    )
    width: Positive = Field(
        default=3.0, description="its scale, in standard deviations of the whole measurement"
    )


@dataclass(frozen=True, config=STRICT)
class NamedSettings:
    """What every estimator has."""

    family: ClassVar[Family] = "other"
    label: str | None = Field(
        default=None,
        pattern=r"^[A-Za-z0-9][\w.+-]*$",
        description="name of its folder and row; null: its kind",
    )

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

    family: ClassVar[Family] = "filter"
    pose_covariance: bool = Field(
        default=True, description="add the pose's covariance to the observation's"
    )
    update: Literal["pixel", "world", "running_mean", "half"] = Field(
        default="pixel",
        description="`pixel` Kalman on (c, r, d); `world` on positions (6.4); averages of 4.1",
    )
    miss_growth_m: NonNegative = Field(
        default=1e-4,
        description="added to a landmark's deviation on a miss, in quadrature (6.4)",
    )


@dataclass(frozen=True, config=STRICT)
class LandmarkKalmanSettings(PerLandmarkSettings):
    """Se, Lowe and Little (2001): least-squares pose, one 3x3 filter a landmark."""

    kind: Literal["landmark_kalman"] = "landmark_kalman"


@dataclass(frozen=True, config=STRICT)
class LandmarkKalmanGraphSettings(PerLandmarkSettings):
    """The same estimator as factor graphs: equal to ``landmark_kalman`` up to rounding."""

    kind: Literal["landmark_kalman_graph"] = "landmark_kalman_graph"


@dataclass(frozen=True, config=STRICT)
class JointFilterSettings(NamedSettings):
    """What filters with one joint covariance of pose and landmarks share."""

    family: ClassVar[Family] = "filter"
    floor: OnFloor = "auto"
    gate_sigmas: NonNegative = Field(
        default=5.0, description="gate on a match's innovation, standard deviations; 0: none"
    )
    max_landmarks: Count = Field(
        default=4000,
        description="more are refused; memory 72 n^2 bytes, up to half more in reserve",
    )


@dataclass(frozen=True, config=STRICT)
class EkfSettings(JointFilterSettings):
    """Full stochastic mapping: one joint covariance of pose and landmarks, no relinearisation."""

    kind: Literal["ekf"] = "ekf"


@dataclass(frozen=True, config=STRICT)
class InvariantEkfSettings(JointFilterSettings):
    """The same filter with errors that a turn of the whole world leaves as they are."""

    kind: Literal["invariant_ekf"] = "invariant_ekf"


@dataclass(frozen=True, config=STRICT)
class FastSlamSettings(NamedSettings):
    """FastSLAM 2.0: particles of paths, in each the paper's filter a landmark."""

    family: ClassVar[Family] = "filter"
    kind: Literal["fast_slam"] = "fast_slam"
    particles: Count = Field(default=30, description="paths; time and memory are in proportion")
    seed: Index = Field(default=0, description="of the draws; not the run's seed")
    floor: OnFloor = "auto"


@dataclass(frozen=True, config=STRICT)
class GraphSettings(NamedSettings):
    """What all smoothers share: how measurements become a graph that can be solved."""

    family: ClassVar[Family] = "smoother"
    floor: OnFloor = "auto"
    kernel: KernelSettings = KernelSettings()
    noise_factor: Positive | None = Field(
        default=None,
        description="factor on the stated deviations of landmarks; null: estimated from the "
        "residuals",
    )
    gate_px: NonNegative = Field(
        default=12.0,
        description="leave out matches the frame rejected above this residual, px; 0: none",
    )


@dataclass(frozen=True, config=STRICT)
class FixedLagSettings(GraphSettings):
    """Incremental fixed-lag smoother: what is older than the lag is marginalised."""

    kind: Literal["fixed_lag"] = "fixed_lag"
    kernel: KernelSettings = KernelSettings("huber", 4.0)
    lag_frames: Count = Field(default=10, description="lag in frames")


@dataclass(frozen=True, config=STRICT)
class Isam2Settings(GraphSettings):
    """iSAM2: all poses and landmarks in one graph; each frame, the part that changed is solved."""

    kind: Literal["isam2"] = "isam2"
    update_every: Count = Field(
        default=5, description="frames between updates; a tracker answers in between"
    )
    ordering_window: Index = Field(
        default=30, description="last poses kept at the root of the Bayes tree; 0: GTSAM's order"
    )
    keyframe_every: Count = Field(
        default=1, description="frames to a keyframe; 1: every frame is a variable"
    )


@dataclass(frozen=True, config=STRICT)
class SlidingWindowSettings(GraphSettings):
    """Sliding window online, old landmarks taken back into it; in the end everything at once."""

    kind: Literal["sliding_window"] = "sliding_window"
    window: int = Field(default=20, ge=2, description="frames that are solved together online")
    update_every: Count = Field(
        default=5, description="frames between solutions; a tracker answers in between"
    )


@dataclass(frozen=True, config=STRICT)
class BatchSettings(GraphSettings):
    """Everything at once in one least-squares problem: what all others are compared with."""

    kind: Literal["batch"] = "batch"
    gate_px: NonNegative = Field(
        default=0.0, description="as isam2's; 0: the whole problem decides what fits"
    )
    trim: bool = Field(
        default=True,
        description="at the end drop observations beyond the 99.9 % quantile and solve without "
        "kernel",
    )
    method: Literal["levenberg_marquardt", "gnc"] = Field(
        default="levenberg_marquardt",
        description="Levenberg-Marquardt with the kernel, or graduated non-convexity "
        "(truncated least squares) without",
    )


EstimatorSettings: TypeAlias = Annotated[
    DeadReckoningSettings
    | LandmarkKalmanSettings
    | LandmarkKalmanGraphSettings
    | EkfSettings
    | InvariantEkfSettings
    | FastSlamSettings
    | FixedLagSettings
    | Isam2Settings
    | SlidingWindowSettings
    | BatchSettings,
    Field(discriminator="kind"),
]
ESTIMATORS: Mapping[str, type[Any]] = {
    one.kind: one for one in get_args(get_args(EstimatorSettings)[0])
}
"""Settings of the estimators of SLAM by kind."""

DEFAULT_ESTIMATOR = SlidingWindowSettings.kind
"""Of a recording that comes without a configuration, and of a session; why: the table in
docs/howto/your_recording.md."""


def family_of(kind: str) -> Family:
    """Whether estimators of a kind are filters, smoothers or neither."""
    return getattr(ESTIMATORS.get(kind), "family", "other")


# ------------------------------------------------------------------------------------------
# Settings of the homing estimators, as a tagged union over ``kind``


@dataclass(frozen=True, config=STRICT)
class HomingEkfSettings(NamedSettings):
    """One filter of robot, target and features (section IV, its errors corrected)."""

    kind: Literal["homing_ekf"] = "homing_ekf"
    gate_sigmas: NonNegative = Field(
        default=3.0, description="gate on the innovation of a bearing; 0: none"
    )


@dataclass(frozen=True, config=STRICT)
class PaperEkfSettings(NamedSettings):
    """The two filters of section IV as printed, the model corrected."""

    kind: Literal["paper_ekf"] = "paper_ekf"
    gate_sigmas: NonNegative = Field(
        default=0.0, description="gate on the innovation of a bearing; 0: none, as printed"
    )


@dataclass(frozen=True, config=STRICT)
class HomingGraphSettings(NamedSettings):
    """The same problem as one graph of bearings."""

    kind: Literal["homing_graph"] = "homing_graph"
    solver: Literal["schur", "isam2", "batch"] = Field(
        default="schur", description="`schur` exact, all images; `isam2`, `batch` by GTSAM"
    )


@dataclass(frozen=True, config=STRICT)
class AverageLandmarkVectorSettings(NamedSettings):
    """Average landmark vector (Lambrinos et al. 2000): direction alone, no distance."""

    kind: Literal["alv"] = "alv"


@dataclass(frozen=True, config=STRICT)
class SnapshotSettings(NamedSettings):
    """Average displacement of the bearings against the target's snapshot: no distance."""

    kind: Literal["snapshot"] = "snapshot"


HomingEstimatorKind: TypeAlias = (
    HomingEkfSettings
    | PaperEkfSettings
    | HomingGraphSettings
    | AverageLandmarkVectorSettings
    | SnapshotSettings
)
HomingEstimatorSettings: TypeAlias = Annotated[HomingEstimatorKind, Field(discriminator="kind")]
