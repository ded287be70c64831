"""Every kind of recording that an experiment may be made on."""

from __future__ import annotations

from typing import Annotated, TypeAlias

from pydantic import Field

from fgslam.settings.datasets import (
    EurocSettings,
    ImageFolderSettings,
    KittiSettings,
    LightFieldSettings,
)
from fgslam.settings.lab import RenderedLabSettings
from fgslam.settings.measurements import MeasurementDatasetSettings

DatasetSettings: TypeAlias = Annotated[
    RenderedLabSettings
    | ImageFolderSettings
    | KittiSettings
    | EurocSettings
    | LightFieldSettings
    | MeasurementDatasetSettings,
    Field(discriminator="kind"),
]
