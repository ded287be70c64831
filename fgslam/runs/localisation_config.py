"""Configuration of the task `localisation`: frames of a recording sought in a saved map.

:func:`load_experiment` reads experiments of all kinds and tells them apart.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from fgslam.backend.filters.settings import LandmarkKalmanSettings
from fgslam.backend.settings import EstimatorSettings
from fgslam.core.errors import ConfigError
from fgslam.datasets.odometry_settings import OdometrySettings, RecordedOdometrySettings
from fgslam.datasets.settings import DatasetSettings, MeasurementDatasetSettings
from fgslam.runs.config import ExperimentConfig
from fgslam.runs.config_reading import Reader, apply_overrides, read_mapping, with_default_kind
from fgslam.runs.homing_config import HomingExperiment, make_experiment
from fgslam.runs.localisation_settings import KnownMapSettings, QuerySettings
from fgslam.runs.output_settings import OutputSettings
from fgslam.slam.frontend_settings import FrontendSettings
from fgslam.slam.map_settings import MapSettings

TASK = "localisation"
_GROUPS_OF_KINDS = ("dataset", "odometry", "estimator")


class LocalisationConfig(BaseModel):
    """Frames of a recording, sought in a map without any prior."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    task: Annotated[Literal["localisation"], Field(description="SLAM has no such key")]
    name: Annotated[
        str, Field(pattern=r"^[\w.-]+$", description="short name; the default run folder's")
    ]
    seed: Annotated[int, Field(ge=0, description="of everything random in the run")] = 0
    map: KnownMapSettings
    dataset: DatasetSettings
    odometry: OdometrySettings = RecordedOdometrySettings()
    frontend: FrontendSettings = FrontendSettings()
    estimator: Annotated[
        EstimatorSettings, BeforeValidator(with_default_kind(LandmarkKalmanSettings.kind))
    ] = LandmarkKalmanSettings()
    localisation: QuerySettings = QuerySettings()
    output: OutputSettings = OutputSettings()
    provenance: Annotated[
        dict[str, Any] | None,
        Field(description="written into a run's own config.yaml: versions and data; not read"),
    ] = None

    def as_values(self) -> dict[str, Any]:
        """Plain values for YAML or JSON, every default filled in."""
        return self.model_dump(mode="json", exclude={"provenance"})

    def as_experiment(self) -> ExperimentConfig:
        """The run that would drive the queries' recording in the map: of its parts some are used.

        The front-end looks for no loops and recovers from nothing: a submap is a few frames long.
        """
        return ExperimentConfig(
            name=self.name,
            seed=self.seed,
            dataset=self.dataset,
            odometry=self.odometry,
            frontend=self.frontend,
            estimator=self.estimator,
            map=MapSettings(load=self.map.load, made_from=self.map.made_from),
            output=self.output,
        )


_READER = Reader(LocalisationConfig, _GROUPS_OF_KINDS)


def make_localisation(
    values: dict[str, Any], overrides: Iterable[str], where: str
) -> LocalisationConfig:
    """Plain values with ``a.b=value`` overrides applied, checked; ``where`` names their source.

    Raises:
        ConfigError: a key or value is wrong, or there is no map, or there are two.
    """
    return _checked(_READER.make(values, overrides, where), where)


def parse_localisation(values: Mapping[str, Any], where: str) -> LocalisationConfig:
    """Checks plain values against the schema; ``where`` names their source in messages."""
    return _checked(_READER.parse(values, where), where)


def load_experiment(
    path: Path, overrides: Iterable[str] = ()
) -> ExperimentConfig | HomingExperiment | LocalisationConfig:
    """Reads an experiment of SLAM, of localisation or of homing, with ``a.b=value`` overrides.

    Raises:
        ConfigError: the file is missing or no YAML mapping, or a key or value is wrong.
    """
    values, overrides = read_mapping(path), tuple(overrides)
    asked: dict[str, Any] = {"task": values.get("task")}
    apply_overrides(asked, [o for o in overrides if o.partition("=")[0].strip() == "task"])
    if asked["task"] == TASK:
        return make_localisation(values, overrides, str(path))
    return make_experiment(values, overrides, str(path))


def _checked(config: LocalisationConfig, where: str) -> LocalisationConfig:
    given = config.map
    if (given.load is None) == (given.made_from is None):
        raise ConfigError(f"{where}: map needs either load or made_from; give one of them")
    datasets = (config.dataset, *(() if given.made_from is None else (given.made_from.dataset,)))
    if any(isinstance(one, MeasurementDatasetSettings) for one in datasets):
        raise ConfigError(
            f"{where}: measurements have no appearance to be recognised by; give recordings of "
            "images"
        )
    return config
