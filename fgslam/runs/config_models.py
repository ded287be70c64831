"""What an experiment's configuration may say: one strict model for each task.

Each field has its unit and meaning. A file without the key `task` is one of SLAM.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeAlias

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from fgslam.backend.homing.settings import HomingEstimatorSettings, HomingGraphSettings
from fgslam.backend.settings import EstimatorSettings, LandmarkKalmanSettings
from fgslam.core.settings import Count, Index, NonNegative
from fgslam.datasets.settings import (
    DatasetSettings,
    MeasurementDatasetSettings,
    OdometrySettings,
    OmniDatasetSettings,
    OmniHouseSettings,
    RecordedOdometrySettings,
    SimulatedBearingsSettings,
)
from fgslam.frontend.features.settings import OmniFeatureSettings
from fgslam.frontend.homing.settings import HomingVectorSettings
from fgslam.frontend.settings import FrontendSettings
from fgslam.homing.settings import (
    HomingBehaviourSettings,
    LocalisationSettings,
    SteeringSettings,
    TopologicalMapSettings,
)
from fgslam.runs.config_reading import kind_as_settings, with_default_kind
from fgslam.runs.settings import (
    HomingOutputSettings,
    KnownMapSettings,
    OutputSettings,
    QuerySettings,
)
from fgslam.slam.map_settings import MapSettings

LiveEstimator: TypeAlias = Annotated[
    EstimatorSettings, BeforeValidator(with_default_kind(LandmarkKalmanSettings.kind))
]
ComparedEstimator: TypeAlias = Annotated[EstimatorSettings, BeforeValidator(kind_as_settings)]
LiveHoming: TypeAlias = Annotated[
    HomingEstimatorSettings, BeforeValidator(with_default_kind(HomingGraphSettings.kind))
]
ComparedHoming: TypeAlias = Annotated[HomingEstimatorSettings, BeforeValidator(kind_as_settings)]
ComparedList: TypeAlias = Annotated[
    tuple[ComparedHoming, ...],
    Field(description="further estimators on the same bearings, as under `estimator`"),
]
ViewName: TypeAlias = Annotated[
    str, BeforeValidator(lambda value: str(value) if type(value) is int else value)
]


SYNTHETIC_REMARK = "odometry: SYNTHETIC (ground truth plus stated noise, see config.yaml)"


class Experiment(BaseModel):
    """What the experiments of all tasks have."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        allow_inf_nan=False,
        defer_build=True,  # of eight models a command needs one
    )
    taken_folders: ClassVar[tuple[str, ...]] = ("pictures", "compare", "trials", "first", "units")
    """Folders of a run that no estimator may be called."""

    name: str = Field(
        pattern=r"^[.-]*\w[\w.-]*$", description="short name; the default run folder's"
    )
    seed: Index = Field(default=0, description="of everything random in the run")
    provenance: dict[str, Any] | None = Field(
        default=None,
        description="written into a run's own config.yaml: versions and data; not read",
    )

    def as_values(self) -> dict[str, Any]:
        """Plain values for YAML or JSON, every default filled in."""
        return self.model_dump(mode="json", exclude={"provenance"})

    @property
    def estimators(self) -> tuple[Any, ...]:
        """Settings of the live estimator, then of those of `compare`; each once."""
        live, others = getattr(self, "estimator", None), getattr(self, "compare", ())
        return tuple(dict.fromkeys((*([] if live is None else [live]), *others)))

    @property
    def task_name(self) -> str | None:
        """Value of the key `task`; None for SLAM, which has no such key."""
        return getattr(self, "task", None)

    @property
    def wants_report(self) -> bool:
        """Whether report.html is to be written."""
        return bool(getattr(self, "output", OutputSettings()).report)

    @property
    def outputs(self) -> tuple[Path, ...]:
        """Files that it writes outside the run folder."""
        return ()

    @property
    def inputs(self) -> tuple[Path, ...]:
        """Files and folders that it reads, of a pattern of names the folder."""
        found = map(Path, _paths_in(self.as_values()))
        return tuple(path.parent if "*" in path.name else path for path in found)

    def resolved(self) -> Experiment:
        """What the run's own config.yaml says: all that the task settles by itself filled in."""
        return self

    def problem(self) -> str:
        """What is contradictory, with its fix; empty where nothing is."""
        titles = [settings.title for settings in self.estimators]
        for title in titles:
            if title in self.taken_folders:
                return (
                    f"an estimator cannot be called {title}, a folder of the run; choose another "
                    "label"
                )
            if titles.count(title) > 1:
                return f"two different estimators are called {title}; give one of them a label"
        return ""


_PATHS = ("path", "file", "camera_file", "odometry_file", "load", "poses", "routes")
"""Keys of files and folders that are read, in the experiments of all tasks."""


def _paths_in(values: Any, key: str = "") -> Iterator[str]:
    if isinstance(values, dict):
        for name, value in values.items():
            yield from _paths_in(value, name)
    elif isinstance(values, list):
        for value in values:
            yield from _paths_in(value, key)
    elif isinstance(values, str) and key in _PATHS:
        yield values


# --------------------------------------------------------------------------------------------
# SLAM


class ExperimentConfig(Experiment):
    """One experiment."""

    dataset: DatasetSettings
    odometry: OdometrySettings = RecordedOdometrySettings()
    frontend: FrontendSettings = FrontendSettings()
    estimator: LiveEstimator = LandmarkKalmanSettings()
    compare: tuple[ComparedEstimator, ...] = Field(
        default=(),
        description="estimators that replay the run's log: kinds, or groups as under `estimator`",
    )
    map: MapSettings = MapSettings()
    output: OutputSettings = OutputSettings()

    @property
    def outputs(self) -> tuple[Path, ...]:
        """The map, where a name is given."""
        return () if self.map.save is None else (Path(self.map.save),)

    @property
    def on_measurements(self) -> bool:
        """Whether the data set holds measurements instead of images."""
        return isinstance(self.dataset, MeasurementDatasetSettings)

    @property
    def remark(self) -> str:
        """Marks results whose odometry was made from ground truth; empty otherwise."""
        return SYNTHETIC_REMARK if self.odometry.kind == "synthetic" else ""

    def problem(self) -> str:
        """Also contradictions about the map."""
        return super().problem() or _map_problem(self)


def _map_problem(config: ExperimentConfig) -> str:
    """What is contradictory about the map, with its fix; empty where nothing is."""
    given, first = config.map, config.map.made_from
    datasets = (config.dataset, *(() if first is None else (first.dataset,)))
    measurements = any(isinstance(one, MeasurementDatasetSettings) for one in datasets)
    as_default = (given.start, given.extend) == ("relocalise", True)
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
    }
    return next((words for words, wrong in problems.items() if wrong), "")


class LocalisationConfig(Experiment):
    """Frames of a recording, sought in a map without any prior."""

    task: Literal["localisation"] = Field(description="SLAM has no such key")
    map: KnownMapSettings
    dataset: DatasetSettings
    odometry: OdometrySettings = RecordedOdometrySettings()
    frontend: FrontendSettings = FrontendSettings()
    estimator: LiveEstimator = LandmarkKalmanSettings()
    localisation: QuerySettings = QuerySettings()
    output: OutputSettings = OutputSettings()

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

    def problem(self) -> str:
        """Also a map that is missing or given twice, and data without images."""
        given = self.map
        if (given.load is None) == (given.made_from is None):
            return "map needs either load or made_from; give one of them"
        first = () if given.made_from is None else (given.made_from.dataset,)
        if any(isinstance(one, MeasurementDatasetSettings) for one in (self.dataset, *first)):
            return "measurements have no appearance to be recognised by; give recordings of images"
        return super().problem()


# --------------------------------------------------------------------------------------------
# Homing

_TASK = Field(description="which kind of homing experiment; SLAM has no such key")


class HomingExperiment(Experiment):
    """What the experiments of all homing tasks have."""

    taken_folders: ClassVar[tuple[str, ...]] = ("pictures", "compare", "logs", "runs", "units")

    task: str = Field(description="which kind of homing experiment")
    output: HomingOutputSettings = HomingOutputSettings()
    jobs: Count | None = Field(default=None, description="processes at a time; null: one a core")


class HomingPairsConfig(HomingExperiment):
    """The homing vector between every two views of a recording."""

    task: Annotated[Literal["homing_pairs"], _TASK]
    dataset: OmniDatasetSettings
    features: OmniFeatureSettings = OmniFeatureSettings()
    homing_vector: HomingVectorSettings = HomingVectorSettings()
    reference: bool = Field(
        default=True, description="plain SIFT and two-point RANSAC beside it, for comparison"
    )


class TopologicalMapConfig(HomingExperiment):
    """A topological map of a recording's views, routes on it, and localisation."""

    task: Annotated[Literal["topological_map"], _TASK]
    dataset: OmniDatasetSettings
    features: OmniFeatureSettings = OmniFeatureSettings()
    homing_vector: HomingVectorSettings = HomingVectorSettings()
    map: TopologicalMapSettings = TopologicalMapSettings()
    localisation: LocalisationSettings = LocalisationSettings()
    ordered: bool = Field(default=False, description="views follow each other on a way")
    routes: tuple[Annotated[tuple[ViewName, ...], Field(min_length=2)], ...] = Field(
        default=(),
        description="ways to find, by the views' numbers: start and goal, or a chain of nodes",
    )
    held_out_every: int | None = Field(
        default=None, ge=2, description="localise every so many views on a map of the others"
    )


class OmniVideoConfig(HomingExperiment):
    """Points tracked through a recording of a mirror camera."""

    task: Annotated[Literal["omni_video"], _TASK]
    dataset: OmniDatasetSettings
    least_points: Count = Field(
        default=110, description="with fewer points left, new ones are added"
    )
    most_points: Count = Field(default=160, description="up to so many")


class TeachConfig(HomingExperiment):
    """A route chosen from a recording of an omnidirectional camera."""

    task: Annotated[Literal["teach"], _TASK]
    dataset: OmniDatasetSettings
    route: str | None = Field(
        default=None, description="file to write; null: RUN/route.fgpath alone"
    )
    poses: str | None = Field(
        default=None,
        description="trajectory of SLAM on the same drive, by the same clock: a TUM file; a "
        "covariance.csv beside it is taken, too; null: a route without metres",
    )

    @property
    def outputs(self) -> tuple[Path, ...]:
        """The route, where a name is given."""
        return () if self.route is None else (Path(self.route),)


class FollowConfig(HomingExperiment):
    """A recording along a taught route: place, homing vector and command of each image."""

    task: Annotated[Literal["follow"], _TASK]
    dataset: OmniDatasetSettings
    route: str = Field(description="file that a route was taught into")
    taught_camera: bool = Field(
        default=True, description="use the route's camera in place of `dataset.camera`"
    )
    steering: SteeringSettings = SteeringSettings()

    @property
    def inputs(self) -> tuple[Path, ...]:
        """Also the route."""
        return (*super().inputs, Path(self.route))


class JoinConfig(HomingExperiment):
    """Taught routes as one map, joined where their views match."""

    task: Annotated[Literal["join"], _TASK]
    routes: tuple[str, ...] = Field(
        min_length=1, description="files that routes were taught into; named after them"
    )
    map: str | None = Field(default=None, description="file to write; null: RUN/routes.fgmap alone")

    @property
    def outputs(self) -> tuple[Path, ...]:
        """The map, where a name is given."""
        return () if self.map is None else (Path(self.map),)


class HomingTrialsConfig(HomingExperiment):
    """Simulated homings of bearings alone: estimators against outliers."""

    task: Annotated[Literal["homing_trials"], _TASK]
    dataset: SimulatedBearingsSettings = SimulatedBearingsSettings()
    outliers: tuple[Annotated[float, Field(ge=0.0, lt=1.0)], ...] = Field(
        default=(0.0, 0.1, 0.2, 0.3),
        min_length=1,
        description="shares of outliers, each with its own trials",
    )
    trials: Count = Field(default=200, description="homings for each share")
    homing_vector: HomingVectorSettings = HomingVectorSettings()
    estimator: LiveHoming = HomingGraphSettings()
    compare: ComparedList = ()


class DrivingConfig(HomingExperiment):
    """Closed loop in a rendered house: what homing and path following share."""

    dataset: OmniHouseSettings = OmniHouseSettings()
    features: OmniFeatureSettings = OmniFeatureSettings()
    homing_vector: HomingVectorSettings = HomingVectorSettings()
    behaviour: HomingBehaviourSettings = HomingBehaviourSettings()
    estimator: LiveHoming = HomingGraphSettings()
    compare: ComparedList = ()
    trials: Count = Field(
        default=1, description="drives, each with a seed of its own: path, noise, people"
    )
    start_offset_m: NonNegative = Field(
        default=0.0,
        description="largest distance of the start from the path's start, turned at random",
    )
    wrong_matches: float = Field(
        default=0.0,
        ge=0.0,
        lt=0.9,
        description="share of wrong matches mixed in, to test robustness",
    )


class HomingConfig(DrivingConfig):
    """One homing in closed loop: the path's first leg alone."""

    task: Annotated[Literal["homing"], _TASK]

    def resolved(self) -> HomingConfig:
        """A path of one leg: a single homing."""
        path = dataclasses.replace(self.dataset.path, legs=1)
        dataset = dataclasses.replace(self.dataset, path=path)
        return self.model_copy(update={"dataset": dataset})


class PathFollowingConfig(DrivingConfig):
    """A path of many target images, followed in closed loop."""

    task: Annotated[Literal["path_following"], _TASK]


class CrossroadsConfig(DrivingConfig):
    """Two routes taught on their own, joined, and a way over both driven in closed loop."""

    task: Annotated[Literal["crossroads"], _TASK]
    back: bool = Field(
        default=False, description="from the second route's end to where the first one begins"
    )


TASKS: dict[str | None, type[Experiment]] = {
    None: ExperimentConfig,
    "localisation": LocalisationConfig,
    "homing_pairs": HomingPairsConfig,
    "topological_map": TopologicalMapConfig,
    "omni_video": OmniVideoConfig,
    "teach": TeachConfig,
    "follow": FollowConfig,
    "join": JoinConfig,
    "homing_trials": HomingTrialsConfig,
    "homing": HomingConfig,
    "path_following": PathFollowingConfig,
    "crossroads": CrossroadsConfig,
}
"""The model of each value of the key `task`; None where a file has no such key."""

HOMING_TASKS = tuple(
    task
    for task, model in TASKS.items()
    if task is not None and issubclass(model, HomingExperiment)
)
