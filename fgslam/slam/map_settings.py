"""Settings of maps that outlive their run: where one comes from, what becomes of it."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT
from fgslam.datasets.settings import DatasetSettings, OdometrySettings, RecordedOdometrySettings


@dataclass(frozen=True, config=STRICT)
class FirstDriveSettings:
    """A drive that makes the map, with the run's own front-end and estimator."""

    dataset: Annotated[DatasetSettings, Field(description="keys as under `dataset`")]
    odometry: Annotated[OdometrySettings, Field(description="keys as under `odometry`")] = (
        RecordedOdometrySettings()
    )
    seed: Annotated[
        Annotated[int, Field(ge=0)] | None,
        Field(description="of everything random in it; null: the run's own"),
    ] = None


@dataclass(frozen=True, config=STRICT)
class MapStartSettings:
    """How a run finds its place in the map that it is given."""

    within: Annotated[
        int,
        Field(
            ge=1,
            description="frames searched for the first located one; those before are left out",
        ),
    ] = 30
    sigma_m: Annotated[
        float,
        Field(
            gt=0.0,
            description="sigma of the first pose per axis, as put back by hand",
        ),
    ] = 0.1
    sigma_deg: Annotated[
        float, Field(gt=0.0, lt=90.0, description="the same of its rotation, degrees")
    ] = 3.0


@dataclass(frozen=True, config=STRICT)
class MapSettings:
    """The map that a run is given, and the one that it leaves."""

    load: Annotated[str | None, Field(description="map file to begin in; null: an empty map")] = (
        None
    )
    save: Annotated[
        str | None, Field(description="map file to write when the run has finished")
    ] = None
    made_from: Annotated[
        FirstDriveSettings | None,
        Field(description="drive this first, into RUN/first, and go on with its map"),
    ] = None
    start: Annotated[
        Literal["relocalise", "origin", "last", "continue"],
        Field(description="first pose: found, the map's first or last, or the same run goes on"),
    ] = "relocalise"
    extend: Annotated[bool, Field(description="false: only localise, the map stays as it is")] = (
        True
    )
    session: Annotated[
        bool,
        Field(description="save also what `start: continue` needs"),
    ] = True
    begin: MapStartSettings = MapStartSettings()
    active_radius_m: Annotated[
        float | None,
        Field(gt=0.0, description="landmarks farther away go to disk until needed; null: none"),
    ] = None

    @property
    def given(self) -> bool:
        """True if the run continues with a map."""
        return self.load is not None or self.made_from is not None

    @property
    def saves_session(self) -> bool:
        """True if the map that the run leaves holds all that it takes to go on."""
        return self.save is not None and self.session
