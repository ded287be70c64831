"""Settings of recordings for homing; of an omnidirectional camera a tagged union over ``kind``."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.cameras.settings import (
    BloggieSettings,
    EquirectangularSettings,
    HyperbolicMirrorSettings,
    OmniCameraSettings,
)
from fgslam.core.settings import STRICT
from fgslam.datasets.settings import RecordingSettings
from fgslam.worlds.settings import OmniHouseSettings as OmniHouseSettings
from fgslam.worlds.settings import SimulatedBearingsSettings as SimulatedBearingsSettings


@dataclass(frozen=True, config=STRICT)
class PanoramasSettings(RecordingSettings):
    """A folder of panoramas, with or without ``poses.csv`` (docs/datasets/panoramas.md)."""

    kind: Literal["panoramas"] = "panoramas"
    camera: EquirectangularSettings = EquirectangularSettings()
    width: int | None = Field(
        default=None,
        ge=64,
        le=16384,
        description="pictures are reduced to this width; null: as they are",
    )


@dataclass(frozen=True, config=STRICT)
class OmniPathSettings(RecordingSettings):
    """A folder of a mirror camera's pictures along a path (docs/datasets/mirror_images.md)."""

    kind: Literal["omni_path"] = "omni_path"
    camera: OmniCameraSettings = HyperbolicMirrorSettings()
    pattern: str = Field(
        default="*",
        min_length=1,
        pattern=r"^[^/\\]+$",
        description="names of the pictures, ordered by the numbers in them",
    )


@dataclass(frozen=True, config=STRICT)
class OmniVideoSettings(RecordingSettings):
    """A mirror camera's video file; ``path`` is the file (docs/datasets/mirror_images.md)."""

    kind: Literal["omni_video"] = "omni_video"
    camera: OmniCameraSettings = BloggieSettings()
    frame_rate_hz: float | None = Field(
        default=None, gt=0.0, le=1000.0, description="frames a second; null: as the file says"
    )


OmniDatasetSettings: TypeAlias = Annotated[
    PanoramasSettings | OmniPathSettings | OmniVideoSettings, Field(discriminator="kind")
]
