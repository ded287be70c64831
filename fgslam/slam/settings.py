"""Settings of maps that outlive their run: where one comes from, what becomes of it."""

from __future__ import annotations

from typing import Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT, Count, Index, Positive
from fgslam.datasets.settings import DatasetSettings, OdometrySettings, RecordedOdometrySettings


@dataclass(frozen=True, config=STRICT)
class FirstDriveSettings:
    """A drive that makes the map, with the run's own front-end and estimator."""

    dataset: DatasetSettings = Field(description="keys as under `dataset`")
    odometry: OdometrySettings = Field(
        default=RecordedOdometrySettings(), description="keys as under `odometry`"
    )
    seed: Index | None = Field(
        default=None, description="of everything random in it; null: the run's own"
    )


@dataclass(frozen=True, config=STRICT)
class MapStartSettings:
    """How a run finds its place in the map that it is given."""

    within: Count = Field(
        default=30,
        description="frames searched for the first located one; those before are left out",
    )
    sigma_m: Positive = Field(
        default=0.1, description="sigma of the first pose per axis, as put back by hand"
    )
    sigma_deg: float = Field(
        default=3.0, gt=0.0, lt=90.0, description="the same of its rotation, degrees"
    )


@dataclass(frozen=True, config=STRICT)
class MapSettings:
    """The map that a run is given, and the one that it leaves."""

    load: str | None = Field(default=None, description="map file to begin in; null: an empty map")
    save: str | None = Field(
        default=None, description="map file to write when the run has finished"
    )
    made_from: FirstDriveSettings | None = Field(
        default=None, description="drive this first, into RUN/first, and go on with its map"
    )
    start: Literal["relocalise", "origin", "last"] = Field(
        default="relocalise",
        description="first pose: found, the map's first or last, or the same run goes on",
    )
    extend: bool = Field(default=True, description="false: only localise, the map stays as it is")
    begin: MapStartSettings = MapStartSettings()

    @property
    def given(self) -> bool:
        """True if the run continues with a map."""
        return self.load is not None or self.made_from is not None
