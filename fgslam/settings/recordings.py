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
from fgslam.settings.measurements import MeasurementDatasetSettings
from fgslam.worlds.lab_settings import RenderedLabSettings

DatasetSettings: TypeAlias = Annotated[
    RenderedLabSettings
    | ImageFolderSettings
    | KittiSettings
    | EurocSettings
    | LightFieldSettings
    | MeasurementDatasetSettings,
    Field(discriminator="kind"),
]
