"""Settings of the smoothers."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.backend.common_settings import Family, FloorSettings, KernelSettings, NamedSettings
from fgslam.backend.filters.settings import LoopCorrectionSettings
from fgslam.core.settings import STRICT


@dataclass(frozen=True, config=STRICT)
class GraphSettings(NamedSettings):
    """What all smoothers share: how measurements become a graph that can be solved."""

    family: ClassVar[Family] = "smoother"
    floor: FloorSettings = FloorSettings()
    kernel: KernelSettings = KernelSettings()
    noise_factor: Annotated[
        float,
        Field(
            gt=0.0,
            description="standard deviations of landmark measurements are multiplied by this when "
            "they are weighed; kernel and trim judge by the stated ones. Above 1 where errors of a "
            "landmark persist from frame to frame, which a graph of independent measurements "
            "would average away",
        ),
    ] = 1.0
    gate_px: Annotated[
        float,
        Field(
            ge=0.0,
            description="matches that the frame's own least squares rejected are left out where "
            "their image residual exceeds this; nearer ones may be right, and the map have "
            "drifted: the kernel deals with them. A range sensor's are all left out. 0: none is",
        ),
    ] = 12.0
    least_sightings: Annotated[
        int,
        Field(ge=1, description="frames in which a landmark is seen before it enters the graph"),
    ] = 2
    least_parallax: Annotated[
        float,
        Field(
            ge=0.0,
            description="disparity over its standard deviation below which a landmark waits; of a "
            "range sensor, range over its deviation",
        ),
    ] = 3.0
    weak_parallax: Annotated[
        float,
        Field(
            ge=0.0,
            description="below this a landmark in the graph gets a weak prior, so that a far point "
            "cannot be thrown behind the camera",
        ),
    ] = 8.0
    contradicted_after: Annotated[
        int,
        Field(
            ge=0,
            description="left out in so many frames in a row, which agree on another place, a "
            "landmark counts as moved and starts anew; 0: never",
        ),
    ] = 3
    loops: LoopCorrectionSettings = LoopCorrectionSettings()


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
    relinearize_threshold: Annotated[
        float, Field(gt=0.0, description="change (radians, metres) that relinearises a variable")
    ] = 0.01


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
    relinearize_threshold: Annotated[
        float,
        Field(
            gt=0.0,
            description="change (radians, metres) that relinearises a variable; 0.1, GTSAM's own, "
            "leaves a drive of 50 m twice as far off as 0.01",
        ),
    ] = 0.01
    keyframe_every: Annotated[
        int,
        Field(
            ge=1,
            description="frames to a keyframe; what the frames between measured is summarised in "
            "factors of the keyframe. 1: every frame is a variable",
        ),
    ] = 1
    final_iterations: Annotated[
        int,
        Field(
            ge=0,
            description="further updates without measurements, relinearising everything that "
            "moved, before the estimate is reported",
        ),
    ] = 5


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
