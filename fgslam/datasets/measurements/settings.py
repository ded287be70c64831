"""Settings of recordings of measurements without images, a tagged union over ``kind``."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT, MeasurementSelection
from fgslam.datasets.recording_settings import RecordingSettings
from fgslam.worlds.simulated.settings import Correlation, SimulatedMeasurementsSettings

# --------------------------------------------------------------------------------------------
# Real measurements


@dataclass(frozen=True, config=STRICT)
class StereoTracksSettings(MeasurementSelection):
    """Stereo feature tracks of KITTI drives, inside GTSAM (docs/datasets/stereo_tracks.md)."""

    kind: Literal["stereo_tracks"] = "stereo_tracks"
    file: Annotated[
        str,
        Field(
            min_length=1,
            description='"00s", "00" or "large": those inside the installed gtsam; or the path of '
            "a file VO_stereo_factors*.txt with its calibration beside it",
        ),
    ] = "00s"
    pixel_sigma: Annotated[
        float,
        Field(
            gt=0.0,
            description="noise of one image coordinate, pixels (measured: docs/datasets/"
            "stereo_tracks.md)",
        ),
    ] = 0.25
    frame_period_s: Annotated[
        float,
        Field(gt=0.0, description="time between frames, which the files lack; KITTI's is 0.1 s"),
    ] = 0.1


@dataclass(frozen=True, config=STRICT)
class UtiasStereoSettings(RecordingSettings):
    """UTIAS "Starry Night": stereo pixels, body rates, truth (docs/datasets/utias.md)."""

    path: Annotated[str, Field(min_length=1, description="the .mat file of dataset 3")]
    kind: Literal["utias_stereo"] = "utias_stereo"
    pixel_sigma_scale: Annotated[
        float, Field(gt=0.0, description="factor on the file's standard deviations of the pixels")
    ] = 1.0
    left_right_correlation: Annotated[
        tuple[Correlation, Correlation],
        Field(
            description="correlation of the noise of both images, in columns and in rows (measured "
            "against the truth); [0, 0]: independent, as the file's variances alone would have it"
        ),
    ] = (0.86, 0.99)
    rate_sigma_scale: Annotated[
        float, Field(gt=0.0, description="factor on the file's standard deviations of the rates")
    ] = 1.0


@dataclass(frozen=True, config=STRICT)
class UtiasRangeBearingSettings(RecordingSettings):
    """UTIAS "Lost in the Woods": laser ranges, wheel odometry, truth (docs/datasets/utias.md)."""

    path: Annotated[str, Field(min_length=1, description="the .mat file of dataset 2")]
    kind: Literal["utias_range_bearing"] = "utias_range_bearing"
    max_range_m: Annotated[
        float, Field(gt=0.0, description="readings farther than this are left out, metres")
    ] = 5.0
    rate_sigma_scale: Annotated[
        float, Field(gt=0.0, description="factor on the file's standard deviations of the rates")
    ] = 1.0
    lateral_sigma_mps: Annotated[
        float,
        Field(gt=0.0, description="sideways speed, which the wheels do not measure, m/s"),
    ] = 0.03


# --------------------------------------------------------------------------------------------
# Simulated measurements


MeasurementDatasetSettings: TypeAlias = (
    StereoTracksSettings
    | UtiasStereoSettings
    | UtiasRangeBearingSettings
    | SimulatedMeasurementsSettings
)
