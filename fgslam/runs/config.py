"""The experiment's configuration: strict, each field with its unit and meaning.

Values come from one YAML file and dotted overrides. Unknown keys are refused with the nearest
known one suggested.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeAlias, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from fgslam.backend.filters.settings import LandmarkKalmanSettings
from fgslam.backend.settings import EstimatorSettings
from fgslam.core.errors import ConfigError
from fgslam.datasets.odometry_settings import OdometrySettings, RecordedOdometrySettings
from fgslam.datasets.settings import DatasetSettings, MeasurementDatasetSettings
from fgslam.runs.config_reading import Reader, kind_as_settings, read_mapping, with_default_kind
from fgslam.runs.output_settings import OutputSettings
from fgslam.slam.frontend_settings import FrontendSettings
from fgslam.slam.map_settings import MapSettings

ComparedEstimator: TypeAlias = Annotated[EstimatorSettings, BeforeValidator(kind_as_settings)]

_Values = TypeVar("_Values", bound=Mapping[str, Any])

_TAKEN_FOLDERS = ("pictures", "compare", "trials", "first")
_GROUPS_OF_KINDS = ("dataset", "odometry", "estimator")


class ExperimentConfig(BaseModel):
    """One experiment."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    name: Annotated[
        str, Field(pattern=r"^[\w.-]+$", description="short name; the default run folder's")
    ]
    seed: Annotated[int, Field(ge=0, description="of everything random in the run")] = 0
    dataset: DatasetSettings
    odometry: OdometrySettings = RecordedOdometrySettings()
    frontend: FrontendSettings = FrontendSettings()
    estimator: Annotated[
        EstimatorSettings, BeforeValidator(with_default_kind(LandmarkKalmanSettings.kind))
    ] = LandmarkKalmanSettings()
    compare: Annotated[
        tuple[ComparedEstimator, ...],
        Field(
            description="estimators that replay the run's own log beside the live one: kinds, or "
            "groups of keys as under `estimator`"
        ),
    ] = ()
    map: MapSettings = MapSettings()
    output: OutputSettings = OutputSettings()
    provenance: Annotated[
        dict[str, Any] | None,
        Field(description="written into a run's own config.yaml: versions and data; not read"),
    ] = None

    def as_values(self) -> dict[str, Any]:
        """Plain values for YAML or JSON, every default filled in."""
        return self.model_dump(mode="json", exclude={"provenance"})


_READER = Reader(ExperimentConfig, _GROUPS_OF_KINDS)


def load_config(path: Path, overrides: Iterable[str] = ()) -> ExperimentConfig:
    """Reads a configuration file and applies ``a.b=value`` overrides.

    Raises:
        ConfigError: the file is missing or no YAML mapping, a key or value is wrong, or it is
            about homing (:func:`fgslam.runs.homing_config.load_experiment` reads both).
    """
    return make_config(read_mapping(path), overrides, str(path))


def make_config(values: dict[str, Any], overrides: Iterable[str], where: str) -> ExperimentConfig:
    """Plain values with ``a.b=value`` overrides applied, checked; ``where`` as in parse_config."""
    return _checked(_READER.make(_of_slam(values, where), overrides, where), where)


def parse_config(values: Mapping[str, Any], where: str) -> ExperimentConfig:
    """Checks plain values against the schema; ``where`` names their source in messages."""
    return _checked(_READER.parse(_of_slam(values, where), where), where)


def _of_slam(values: _Values, where: str) -> _Values:
    """The values themselves, unless they are of a homing experiment."""
    task = values.get("task")
    if task == "localisation":
        raise ConfigError(
            f"{where}: task localisation drives nothing, and this needs an experiment of SLAM; "
            "`fgslam run` takes both"
        )
    if task is not None:
        raise ConfigError(
            f"{where}: task {task} is a homing experiment, and this needs one of SLAM; `fgslam "
            "run` and `fgslam compare` take both"
        )
    return values


def _checked(config: ExperimentConfig, where: str) -> ExperimentConfig:
    _require_own_folders(config, where)
    problem = _map_problem(config)
    if problem:
        raise ConfigError(f"{where}: {problem}")
    return config


def _map_problem(config: ExperimentConfig) -> str:
    """What is contradictory about the map, with its mend; empty where nothing is."""
    given, first = config.map, config.map.made_from
    datasets = (config.dataset, *(() if first is None else (first.dataset,)))
    measurements = any(isinstance(one, MeasurementDatasetSettings) for one in datasets)
    as_default = (given.start, given.extend) == ("relocalise", True)
    goes_on = given.start == "continue"
    problems = {
        "map: measurements have no appearance to keep; give recordings of images": (
            measurements and given != MapSettings()
        ),
        "map.load and map.made_from exclude each other; give one of them": (
            first is not None and given.load is not None
        ),
        "map.start and map.extend mean nothing without a map; give map.load (--map-in)": (
            not given.given and not as_default
        ),
        "map.extend is false, so there is no new map to save; leave map.save out": (
            not given.extend and given.save is not None
        ),
        "map.load and map.save are one file; save to another name": (
            given.load is not None
            and given.save is not None
            and Path(given.load).resolve() == Path(given.save).resolve()
        ),
        "map.start continue goes on with the run that was saved; it takes map.load alone": (
            goes_on and (first is not None or not given.extend)
        ),
    }
    return next((words for words, wrong in problems.items() if wrong), "")


def _require_own_folders(config: ExperimentConfig, where: str) -> None:
    """Each estimator needs a name of its own: that of its folder. The same one twice is one."""
    different = dict.fromkeys((config.estimator, *config.compare))
    titles = [settings.title for settings in different]
    for title in titles:
        if title in _TAKEN_FOLDERS:
            raise ConfigError(
                f"{where}: an estimator cannot be called {title}, a folder of the run; choose "
                "another label"
            )
        if titles.count(title) > 1:
            raise ConfigError(
                f"{where}: two different estimators are called {title}; give one of them a label"
            )
