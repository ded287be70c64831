"""Every kind of recording that an experiment may be made on."""

from __future__ import annotations

from typing import Annotated, TypeAlias

from pydantic import Field

from fgslam.datasets.measurements.settings import MeasurementDatasetSettings
from fgslam.datasets.recording_settings import (
    EurocSettings,
    ImageFolderSettings,
    KittiSettings,
    LightFieldSettings,
)
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
