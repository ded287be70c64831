"""Settings of maps that outlive their run: where one comes from, what becomes of it (S41)."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT
from fgslam.settings.datasets import OdometrySettings, RecordedOdometrySettings
from fgslam.settings.recordings import DatasetSettings


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
            description="frames searched for the first that can be located; those before it are "
            "left out of the run",
        ),
    ] = 30
    sigma_m: Annotated[
        float,
        Field(
            gt=0.0,
            description="standard deviation of the first pose before its landmarks are seen, per "
            "axis, metres: how well a robot is put back by hand",
        ),
    ] = 0.1
    sigma_deg: Annotated[
        float, Field(gt=0.0, lt=90.0, description="the same of its rotation, degrees")
    ] = 3.0


@dataclass(frozen=True, config=STRICT)
class MapSettings:
    """The map that a run is given, and the one that it leaves."""

    load: Annotated[
        str | None, Field(description="map file to go on with; null starts with an empty map")
    ] = None
    save: Annotated[
        str | None, Field(description="map file to write when the run has finished")
    ] = None
    made_from: Annotated[
        FirstDriveSettings | None,
        Field(description="drive this first, into RUN/first, and go on with its map"),
    ] = None
    start: Annotated[
        Literal["relocalise", "origin", "last", "continue"],
        Field(
            description="`relocalise`: found in the map without a prior; `origin`, `last`: put "
            "back where the map's drive began, or stopped; `continue`: the same run goes on"
        ),
    ] = "relocalise"
    extend: Annotated[
        bool, Field(description="false leaves the map as it is: the run only localises in it")
    ] = True
    session: Annotated[
        bool,
        Field(description="save what `start: continue` needs as well; without it a map is smaller"),
    ] = True
    begin: MapStartSettings = MapStartSettings()

    @property
    def given(self) -> bool:
        """Whether the run goes on with a map."""
        return self.load is not None or self.made_from is not None


@dataclass(frozen=True, config=STRICT)
class MergeSettings:
    """How two maps are laid onto each other, and when they are refused (design B4)."""

    max_distance: Annotated[
        float, Field(gt=0.0, description="largest distance of descriptors, of norm 512")
    ] = 250.0
    ratio: Annotated[
        float,
        Field(gt=0.0, le=1.0, description="nearest place's distance over the next one's, at most"),
    ] = 0.8
    same_place_m: Annotated[
        float, Field(gt=0.0, description="landmarks this near to one another are one place")
    ] = 0.3
    size_ratio: Annotated[
        float, Field(gt=1.0, description="largest ratio of two landmarks' physical sizes")
    ] = 1.6
    slack_m: Annotated[
        float,
        Field(
            ge=0.0,
            description="by how much maps bend, per axis: their covariances do not know it",
        ),
    ] = 0.03
    gate_sigmas: Annotated[
        float, Field(gt=0.0, description="largest normalised distance of two sights of a landmark")
    ] = 3.4
    samples: Annotated[int, Field(ge=100, description="triples of matches drawn")] = 60_000
    min_pairs: Annotated[
        int, Field(ge=4, description="fewer landmarks in common are no overlap")
    ] = 20
    elsewhere_m: Annotated[
        float, Field(gt=0.0, description="alignments farther apart than this are different ones")
    ] = 0.5
    elsewhere_deg: Annotated[
        float, Field(gt=0.0, description="alignments turned by more than this are different ones")
    ] = 15.0
    ambiguous_share: Annotated[
        float,
        Field(
            gt=0.0,
            le=1.0,
            description="the second-best alignment may have this share of the best one's matches",
        ),
    ] = 0.5
    overlap_share: Annotated[
        float,
        Field(
            ge=0.0,
            le=1.0,
            description="of the second map's landmarks that lie among the first one's, at least "
            "this share must be found there: one poster in common does not make a place one",
        ),
    ] = 0.15
