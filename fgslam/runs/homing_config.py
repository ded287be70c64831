"""Configurations of homing experiments: a file with a key `task`; strict as those of SLAM.

One model for each task. :func:`load_experiment` reads both worlds and tells them apart.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from fgslam.backend.homing.settings import HomingEstimatorSettings, HomingGraphSettings
from fgslam.core.errors import ConfigError
from fgslam.datasets.omni.settings import (
    OmniDatasetSettings,
    OmniHouseSettings,
    SimulatedBearingsSettings,
)
from fgslam.frontend.features.omni_settings import OmniFeatureSettings
from fgslam.frontend.homing.settings import HomingVectorSettings
from fgslam.frontend.homing.tracking_settings import OmniTrackingSettings
from fgslam.homing.settings import (
    HomingBehaviourSettings,
    LocalisationSettings,
    TopologicalMapSettings,
)
from fgslam.runs.config import ExperimentConfig, make_config
from fgslam.runs.config_reading import (
    Reader,
    apply_overrides,
    kind_as_settings,
    read_mapping,
    with_default_kind,
)
from fgslam.runs.homing_output_settings import HomingOutputSettings

_TAKEN_FOLDERS = ("pictures", "compare", "logs", "runs")
_GROUPS_OF_KINDS = ("dataset", "estimator")


ComparedHoming: TypeAlias = Annotated[HomingEstimatorSettings, BeforeValidator(kind_as_settings)]
LiveHoming: TypeAlias = Annotated[
    HomingEstimatorSettings, BeforeValidator(with_default_kind(HomingGraphSettings.kind))
]
ViewName: TypeAlias = Annotated[
    str, BeforeValidator(lambda value: str(value) if isinstance(value, int) else value)
]
ComparedList: TypeAlias = Annotated[
    tuple[ComparedHoming, ...],
    Field(
        description="estimators that are given the same bearings: kinds, or groups of keys as "
        "under `estimator`"
    ),
]


_TASK = Field(description="which kind of homing experiment; SLAM has no such key")


class HomingExperiment(BaseModel):
    """What the experiments of all tasks have."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    task: Annotated[str, Field(description="which kind of homing experiment")]
    name: Annotated[
        str, Field(pattern=r"^[\w.-]+$", description="short name; the default run folder's")
    ]
    seed: Annotated[int, Field(ge=0, description="of everything random in the run")] = 0
    output: HomingOutputSettings = HomingOutputSettings()
    jobs: Annotated[
        int | None,
        Field(
            ge=1, description="processes at a time; null: one a core. Results do not depend on it"
        ),
    ] = None
    provenance: Annotated[
        dict[str, Any] | None,
        Field(description="written into a run's own config.yaml: versions and data; not read"),
    ] = None

    def as_values(self) -> dict[str, Any]:
        """Plain values for YAML or JSON, every default filled in."""
        return self.model_dump(mode="json", exclude={"provenance"})

    @property
    def estimators(self) -> tuple[HomingEstimatorSettings, ...]:
        """The live estimator, then those of `compare`; the same one twice counts once."""
        live = getattr(self, "estimator", None)
        others: Sequence[HomingEstimatorSettings] = getattr(self, "compare", ())
        return tuple(dict.fromkeys((*([] if live is None else [live]), *others)))


class HomingPairsConfig(HomingExperiment):
    """The homing vector between every two views of a recording."""

    task: Annotated[Literal["homing_pairs"], _TASK]
    dataset: OmniDatasetSettings
    features: OmniFeatureSettings = OmniFeatureSettings()
    homing_vector: HomingVectorSettings = HomingVectorSettings()
    both_ways: Annotated[
        bool, Field(description="each pair in both directions; else from the earlier view only")
    ] = False
    reference: Annotated[
        bool, Field(description="plain SIFT and two-point RANSAC beside it, for comparison")
    ] = True


class TopologicalMapConfig(HomingExperiment):
    """A topological map of a recording's views, routes on it, and localisation."""

    task: Annotated[Literal["topological_map"], _TASK]
    dataset: OmniDatasetSettings
    features: OmniFeatureSettings = OmniFeatureSettings()
    homing_vector: HomingVectorSettings = HomingVectorSettings()
    map: TopologicalMapSettings = TopologicalMapSettings()
    localisation: LocalisationSettings = LocalisationSettings()
    ordered: Annotated[bool, Field(description="views follow each other on a way")] = False
    routes: Annotated[
        tuple[Annotated[tuple[ViewName, ...], Field(min_length=2)], ...],
        Field(
            description="ways to seek on the map, by the views' numbers: start and goal, or all "
            "nodes of a chain whose links shall be there"
        ),
    ] = ()
    held_out_every: Annotated[
        int | None,
        Field(
            ge=2,
            description="localisation is tried with every so many views, on a map of the others; "
            "null: not tried",
        ),
    ] = None


class OmniVideoConfig(HomingExperiment):
    """Points tracked through a recording of a mirror camera."""

    task: Annotated[Literal["omni_video"], _TASK]
    dataset: OmniDatasetSettings
    tracking: OmniTrackingSettings = OmniTrackingSettings()
    least_points: Annotated[
        int, Field(ge=1, description="with fewer points left, new ones are added")
    ] = 110
    most_points: Annotated[int, Field(ge=1, description="up to so many")] = 160


class HomingTrialsConfig(HomingExperiment):
    """Simulated homings of bearings alone: estimators against outliers."""

    task: Annotated[Literal["homing_trials"], _TASK]
    dataset: SimulatedBearingsSettings = SimulatedBearingsSettings()
    outliers: Annotated[
        tuple[Annotated[float, Field(ge=0.0, lt=1.0)], ...],
        Field(
            min_length=1,
            description="shares of outliers, each with its own trials: of wrong matches, and half "
            "each of jumping tracks and of gross bearings; they replace the dataset's own",
        ),
    ] = (0.0, 0.1, 0.2, 0.3)
    trials: Annotated[int, Field(ge=1, description="homings for each share")] = 200
    homing_vector: HomingVectorSettings = HomingVectorSettings()
    estimator: LiveHoming = HomingGraphSettings()
    compare: ComparedList = ()


class DrivingConfig(HomingExperiment):
    """Closed loop in a rendered house: what homing and path following share."""

    dataset: OmniHouseSettings = OmniHouseSettings()
    features: OmniFeatureSettings = OmniFeatureSettings()
    homing_vector: HomingVectorSettings = HomingVectorSettings()
    tracking: OmniTrackingSettings = OmniTrackingSettings()
    behaviour: HomingBehaviourSettings = HomingBehaviourSettings()
    estimator: LiveHoming = HomingGraphSettings()
    compare: ComparedList = ()
    trials: Annotated[
        int, Field(ge=1, description="drives, each with a seed of its own: path, noise, people")
    ] = 1
    start_offset_m: Annotated[
        float,
        Field(
            ge=0.0,
            description="the robot starts up to so far from the path's start, turned at random: "
            "from where homing succeeds",
        ),
    ] = 0.0
    wrong_matches: Annotated[
        float,
        Field(
            ge=0.0,
            lt=0.9,
            description="share of wrong matches mixed into those of start and target, to try how "
            "much homing bears",
        ),
    ] = 0.0


class HomingConfig(DrivingConfig):
    """One homing in closed loop: the path's first leg alone."""

    task: Annotated[Literal["homing"], _TASK]


class PathFollowingConfig(DrivingConfig):
    """A path of many target images, followed in closed loop."""

    task: Annotated[Literal["path_following"], _TASK]


TASKS: dict[str, type[HomingExperiment]] = {
    "homing_pairs": HomingPairsConfig,
    "topological_map": TopologicalMapConfig,
    "omni_video": OmniVideoConfig,
    "homing_trials": HomingTrialsConfig,
    "homing": HomingConfig,
    "path_following": PathFollowingConfig,
}
"""The model of each task."""


# --------------------------------------------------------------------------------------------
# Reading


def load_experiment(
    path: Path, overrides: Iterable[str] = ()
) -> ExperimentConfig | HomingExperiment:
    """Reads an experiment of SLAM or of homing and applies ``a.b=value`` overrides.

    Raises:
        ConfigError: the file is missing or no YAML mapping, or a key or value is wrong.
    """
    return make_experiment(read_mapping(path), tuple(overrides), str(path))


def make_experiment(
    values: dict[str, Any], overrides: Iterable[str], where: str
) -> ExperimentConfig | HomingExperiment:
    """Plain values with overrides applied, checked; ``where`` names their source in messages."""
    overrides = tuple(overrides)
    asked: dict[str, Any] = {"task": values.get("task")}
    apply_overrides(asked, [o for o in overrides if o.partition("=")[0].strip() == "task"])
    if asked["task"] is None and "task" not in values:
        return make_config(values, overrides, where)
    config = _reader(asked["task"], where).make(values, overrides, where)
    _require_own_names(config, where)
    return config


def parse_homing(values: Mapping[str, Any], where: str) -> HomingExperiment:
    """Checks plain values of a homing experiment; ``where`` names their source in messages."""
    config = _reader(values.get("task"), where).parse(values, where)
    _require_own_names(config, where)
    return config


def load_homing(path: Path, overrides: Iterable[str] = ()) -> HomingExperiment:
    """Reads a homing experiment. Raises ConfigError where it is one of SLAM, too."""
    config = load_experiment(path, overrides)
    if isinstance(config, ExperimentConfig):
        raise ConfigError(f"{path}: has no task, so it is no homing experiment; give one")
    return config


def is_homing(path: Path) -> bool:
    """Whether a configuration file is of a homing experiment. Raises ConfigError."""
    return "task" in read_mapping(path)


def _reader(task: Any, where: str) -> Reader[HomingExperiment]:
    model = TASKS.get(task) if isinstance(task, str) else None
    if model is None:
        close = get_close_matches(str(task), TASKS, n=1, cutoff=0.5)
        hint = f"did you mean {close[0]}?" if close else f"use one of {', '.join(TASKS)}"
        if task == "localisation":  # a task, but no homing
            hint = "fgslam run takes it, this does not"
        raise ConfigError(f"{where}: task is {task!r}; {hint} (SLAM has no key task)")
    return Reader(model, _GROUPS_OF_KINDS)


def _require_own_names(config: HomingExperiment, where: str) -> None:
    """Each estimator needs a name of its own in tables and files."""
    titles = [settings.title for settings in config.estimators]
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
