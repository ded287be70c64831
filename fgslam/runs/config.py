"""Reads the configuration of an experiment: one YAML file and dotted overrides, strictly.

The key `task` states which model of :mod:`fgslam.runs.config` it is; without it, SLAM's.
Unknown keys are refused with the nearest known one suggested.
"""

from __future__ import annotations

import copy
import dataclasses
import difflib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, TypeAlias, TypeVar, get_args

import yaml
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic.dataclasses import dataclass as settings
from pydantic_core import ErrorDetails

from fgslam.backend.settings import (
    EstimatorSettings,
    HomingEstimatorSettings,
    HomingGraphSettings,
    LandmarkKalmanSettings,
)
from fgslam.core.errors import ConfigError, shortened
from fgslam.core.settings import STRICT, Count, Degrees, Index, NonNegative, Positive
from fgslam.core.yaml_text import plain_values, read_yaml
from fgslam.datasets.settings import (
    DatasetSettings,
    MeasurementDatasetSettings,
    OdometrySettings,
    OmniDatasetSettings,
    OmniHouseSettings,
    RecordedOdometrySettings,
    SimulatedBearingsSettings,
)
from fgslam.frontend.settings import FrontendSettings, HomingVectorSettings, OmniFeatureSettings
from fgslam.homing.settings import (
    HomingBehaviourSettings,
    LocalisationSettings,
    SteeringSettings,
    TopologicalMapSettings,
)
from fgslam.runs.named_experiments import suggestion
from fgslam.slam.settings import FirstDriveSettings, MapSettings

# ------------------------------------------------------------------------------------------
# Strict reading of configurations: YAML and dotted overrides into a pydantic model

Model = TypeVar("Model", bound=BaseModel)

_GROUPS_OF_KINDS = ("dataset", "odometry", "estimator")
"""Groups distinguished by `kind`: an override of it drops the file's keys of the kind before."""


def read_mapping(path: Path) -> dict[str, Any]:
    """The `key: value` pairs of a YAML file. Raises ConfigError, naming it."""
    if not path.exists():
        raise ConfigError(f"{path}: no such file; {suggestion(path)}")
    values = read_yaml(path, ConfigError)
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: holds no `key: value` pairs; see experiments/ for examples")
    for key in values:
        if not isinstance(key, str):
            raise ConfigError(f"{path}: key {key!r} is no text; correct it")
    return values


def parse(
    model: type[Model], values: Mapping[str, Any], where: str, overrides: Iterable[str] = ()
) -> Model:
    """The checked configuration of plain values with ``a.b=value`` overrides applied.

    The value of an override is YAML, but the text as typed where the setting is text: 01, no, a: b.

    Args:
        model: its class.
        values: plain values, as of a YAML file; they stay as they are.
        where: their source, for messages.
        overrides: the last one of a key wins.

    Raises:
        ConfigError: an override is malformed, or a key or value is wrong.
    """
    model.model_rebuild()
    plain = copy.deepcopy(dict(values))
    before = {group: _kind(plain, group) for group in _GROUPS_OF_KINDS}
    given = apply_overrides(plain, overrides)
    for group, kind in before.items():
        if _kind(plain, group) != kind and isinstance(plain[group], dict):
            known = _known_keys(model, [group, str(_kind(plain, group))])
            known |= {o.keys[1] for o in given if len(o.keys) > 1 and o.keys[0] == group}
            plain[group] = {key: value for key, value in plain[group].items() if key in known}
    try:
        return model.model_validate(plain)
    except ValidationError as error:
        wrong = error.errors()
    texts = {
        tuple(_followed(model, e["loc"])[0])
        for e in wrong
        if e["type"] == "string_type"
        or (e["type"] == "literal_error" and isinstance(e["input"], bool | None))
    }
    for override in given:
        override.apply(plain, override.text if override.keys in texts else override.value)
    try:
        return model.model_validate(plain)
    except ValidationError as error:
        raise ConfigError(_describe(model, error.errors(), where)) from None


def kind_as_settings(value: Any) -> Any:
    """A bare kind stands for that component with its defaults."""
    return {"kind": value} if isinstance(value, str) else value


def with_default_kind(kind: str) -> Callable[[Any], Any]:
    """Makes keys without a kind mean this one."""

    def given(value: Any) -> Any:
        if isinstance(value, dict) and "kind" not in value:
            return {"kind": kind, **value}
        return value

    return given


class Override(NamedTuple):
    """One dotted key and its value as typed, e.g. ``frontend.sift.max_features=500``.

    Attributes:
        given: all of it.
        keys: from the top down.
        text: the value.
        value: of the text as YAML; the text itself where it is none, or plain text.
    """

    given: str
    keys: tuple[str, ...]
    text: str
    value: Any

    @staticmethod
    def of(given: str) -> Override:
        """Reads one. Raises ConfigError where it is not of the form a.b=value."""
        dotted, separator, text = given.partition("=")
        keys, text = tuple(dotted.strip().split(".")), text.strip()
        if not separator or not all(keys):
            raise ConfigError(f"--set {given}: not of the form a.b=value; e.g. --set seed=3")
        try:
            value = plain_values(text)
        except yaml.YAMLError:
            value = text
        plain = isinstance(value, str) and text[:1] not in ("'", '"')  # with any comment behind it
        # A kind is a text, whatever YAML makes of it.
        as_typed = plain or (keys[-1] in ("kind", "task") and not isinstance(value, str))
        return Override(given, keys, text, text if as_typed else value)

    def apply(self, values: dict[str, Any], value: Any) -> None:
        """Sets the key in place. Raises ConfigError where it leads through a value."""
        for key in self.keys[:-1]:
            values = values.setdefault(key, {})
            if not isinstance(values, dict):
                raise ConfigError(f"--set {self.given}: {key} holds a value, not a group of keys")
        values[self.keys[-1]] = value


def apply_overrides(values: dict[str, Any], overrides: Iterable[str]) -> list[Override]:
    """Sets dotted keys in place to what their texts mean as YAML. Raises ConfigError."""
    given = [Override.of(override) for override in overrides]
    for override in given:
        override.apply(values, override.value)
    return given


def _kind(values: Mapping[str, Any], group: str) -> Any:
    inner = values.get(group)
    return inner.get("kind") if isinstance(inner, dict) else None


# --------------------------------------------------------------------------------------------
# Keys and messages

_UNKNOWN = ("extra_forbidden", "unexpected_keyword_argument")

_NO_GROUP = "model_attributes_type"
_PLAIN_WORDS = {
    "tuple_type": "give a list, e.g. [a, b]",
    "list_type": "give a list, e.g. [a, b]",
    "dict_type": "give a group of keys",
    "dataclass_type": "give a group of keys",
    _NO_GROUP: "give a group of keys, or the name of a kind where one will do",
    "int_type": "give a whole number",
    "int_parsing": "give a whole number",
    "int_from_float": "give a whole number",
    "float_type": "give a number",
    "float_parsing": "give a number",
    "bool_type": "give true or false",
    "bool_parsing": "give true or false",
    "string_type": "give text, in quotes where it reads as a number",
    "finite_number": "give a finite number",
    "string_unicode": "it has bytes that are no UTF-8; give the file or folder another name (or, "
    "where the locale is at fault: export LC_ALL=C.UTF-8)",
}
"""What a value must be, by pydantic's type of error; others speak for themselves."""


def _describe(model: type[BaseModel], errors: list[ErrorDetails], where: str) -> str:
    # A misspelt key also leaves the right one missing; the misspelling is the cause.
    first = sorted(errors, key=lambda e: e["type"] not in _UNKNOWN)[0]
    keys, groups = _followed(model, first["loc"])
    key, kinds = ".".join(keys), ", ".join(kind for g in groups if (kind := _kind_of(g)))
    more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
    if first["type"] in _UNKNOWN:
        known = sorted(_known_keys(model, first["loc"][:-1]))
        close = difflib.get_close_matches(str(first["loc"][-1]), known, n=1, cutoff=0.5)
        meant = [".".join([*keys[:-1], *close])] if close else _within(model, key)
        hint = f"did you mean {meant[0]}?" if meant else f"known here: {', '.join(known)}"
        return f"{where}: unknown key {key}; {hint}{more}"
    if first["type"] in ("missing", "missing_argument"):
        return f"{where}: key {key} is missing; add it{more}"
    if first["type"] == "union_tag_not_found":
        return f"{where}: {key}.kind is missing; add one of {kinds}{more}"
    if first["type"] == "union_tag_invalid":
        tag = shortened(repr(first["ctx"]["tag"]))
        return f"{where}: {key}.kind is {tag}; use one of {kinds}{more}"
    words = _PLAIN_WORDS.get(first["type"], first["msg"])
    if first["type"] == _NO_GROUP and kinds:
        words += f"; kinds: {kinds}"
    return f"{where}: {key} = {shortened(repr(first['input']))} is not usable: {words}{more}"


def _known_keys(model: type[BaseModel], place: Sequence[str | int]) -> set[str]:
    return {key for group in _followed(model, place)[1] for key in _fields(group)}


def _within(model: type, key: str) -> list[str]:
    """The key as it stands in groups of the model."""
    groups = ((name, group) for name, kind in _fields(model).items() for group in _groups(kind))
    return [f"{name}.{key}" for name, group in groups if key in _fields(group)]


def _followed(model: type, place: Sequence[str | int]) -> tuple[list[str], list[type]]:
    """Keys of a place that pydantic names, without tags of unions; the groups that stand there.

    Items of lists are written `key[3]`.
    """
    groups: list[type] = [model]
    keys: list[str] = []
    for k, part in enumerate(place):
        found = [_fields(group)[part] for group in groups if part in _fields(group)]
        tagged = [group for group in groups if _kind_of(group) == part]
        if isinstance(part, int):
            keys[-1] += f"[{part}]"
        elif found:
            keys.append(part)
            groups = [inner for annotation in found for inner in _groups(annotation)]
        elif tagged:
            groups = tagged
        elif k == len(place) - 1:
            keys.append(part)
    return keys, groups


def _fields(group: type) -> dict[Any, Any]:
    """Annotations of a group's fields, by key."""
    fields = getattr(group, "__pydantic_fields__", {})
    return {name: field.annotation for name, field in fields.items()}


def _groups(annotation: Any) -> list[type]:
    """Groups of keys that a value of this type may be; of a list those of its items."""
    if isinstance(annotation, type) and hasattr(annotation, "__pydantic_fields__"):
        return [annotation]
    return [group for inner in get_args(annotation) for group in _groups(inner)]


def _kind_of(group: type) -> str | None:
    """The value of a group's key `kind`; None where it has none."""
    kinds = get_args(_fields(group).get("kind"))
    return kinds[0] if kinds else None


# ------------------------------------------------------------------------------------------
# Settings of a run itself: what it writes, and what is asked of a saved map


@settings(frozen=True, config=STRICT)
class OutputSettings:
    """Pictures, the page and checkpoints."""

    pictures: bool = Field(default=True, description="draw the pictures of the run folder")
    report: bool = Field(default=True, description="write report.html")
    checkpoint_seconds: NonNegative = Field(
        default=30.0, description="interval of checkpoints for --resume; 0: each frame"
    )


@settings(frozen=True, config=STRICT)
class HomingOutputSettings:
    """Pictures, the page and bearing logs."""

    pictures: Index = Field(
        default=8, description="at most so many pictures of pairs, links or frames"
    )
    report: bool = Field(default=True, description="write report.html")
    logs: Index = Field(default=4, description="bearing logs kept of the first trials or runs")


@settings(frozen=True, config=STRICT)
class KnownMapSettings:
    """The map in which frames are sought: a file, or one that is made first."""

    load: str | None = Field(default=None, description="map file")
    made_from: FirstDriveSettings | None = Field(
        default=None, description="drive this first, into RUN/first, with the same settings"
    )


@settings(frozen=True, config=STRICT)
class QuerySettings:
    """What is asked of the map, and when an answer is right."""

    frames: tuple[Annotated[int, Field(ge=1, le=100)], ...] = Field(
        default=(1,), min_length=1, description="frames of a query: 1, or a submap of so many"
    )
    every: Count = Field(
        default=1, description="frames from query to query; of bursts their length"
    )
    within_m: Positive = Field(
        default=0.05, description="largest error of a right position, metres"
    )
    within_deg: Degrees = Field(
        default=1.0, description="largest error of a right rotation, degrees"
    )


# ------------------------------------------------------------------------------------------
# What an experiment's configuration may say: one strict model for each task

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
    written: ClassVar[tuple[str, ...]] = ()
    """Keys of files that it writes outside the run folder, where they have a name."""

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
        named = (attrgetter(key)(self) for key in self.written)
        return tuple(Path(one) for one in named if one is not None)

    @property
    def inputs(self) -> tuple[Path, ...]:
        """Files and folders that it reads, of a pattern of names the folder."""
        found = map(Path, _paths_in(self.as_values()))
        return tuple(path.parent if "*" in path.name else path for path in found)

    def resolved(self) -> Experiment:
        """What the run's own config.yaml states: all that the task settles by itself filled in."""
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


_PATHS = ("path", "file", "camera_file", "load", "poses", "routes")
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

    written: ClassVar[tuple[str, ...]] = ("map.save",)

    dataset: DatasetSettings
    odometry: OdometrySettings = RecordedOdometrySettings()
    frontend: FrontendSettings = FrontendSettings()
    estimator: LiveEstimator = LandmarkKalmanSettings()
    compare: tuple[ComparedEstimator, ...] = Field(
        default=(),
        description="estimators that replay the run's log: kinds, or groups as under `estimator`",
    )
    map: MapSettings = MapSettings()
    rig_memory: str = Field(
        default="off",
        min_length=1,
        description="what earlier drives have shown of the rig's calibration, which this one "
        "begins with and adds to: `off`, a file, or `auto`: a file next to the calibration's",
    )
    output: OutputSettings = OutputSettings()

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
        given, first = self.map, self.map.made_from
        datasets = (self.dataset, *(() if first is None else (first.dataset,)))
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
        found = next((words for words, wrong in problems.items() if wrong), "")
        return super().problem() or found


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

        The front-end seeks no loops and recovers from nothing: a submap is a few frames long.
        """
        shared = ("name", "seed", "dataset", "odometry", "frontend", "estimator", "output")
        given = MapSettings(load=self.map.load, made_from=self.map.made_from)
        return ExperimentConfig(map=given, **{name: getattr(self, name) for name in shared})

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
        default=True, description="plain SIFT and two-point RANSAC next to it, for comparison"
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


class TeachConfig(HomingExperiment):
    """A route chosen from a recording of an omnidirectional camera."""

    written: ClassVar[tuple[str, ...]] = ("route",)

    task: Annotated[Literal["teach"], _TASK]
    dataset: OmniDatasetSettings
    route: str | None = Field(
        default=None, description="file to write; null: RUN/route.fgpath alone"
    )
    poses: str | None = Field(
        default=None,
        description="trajectory of SLAM on the same drive, by the same clock: a TUM file; a "
        "covariance.csv next to it is taken, too; null: a route without metres",
    )


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

    written: ClassVar[tuple[str, ...]] = ("map",)

    task: Annotated[Literal["join"], _TASK]
    routes: tuple[str, ...] = Field(
        min_length=1, description="files that routes were taught into; named after them"
    )
    map: str | None = Field(default=None, description="file to write; null: RUN/routes.fgmap alone")


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


_Model = TypeVar("_Model", bound=Experiment)


def load_experiment(path: Path, overrides: Iterable[str] = ()) -> Experiment:
    """Reads an experiment of any task and applies ``a.b=value`` overrides.

    Raises:
        ConfigError: the file is missing or no YAML mapping, or a key or value is wrong.
    """
    return make_experiment(_from_anywhere(read_mapping(path), path), str(path), overrides)


_FILES = ("path", "camera_file", "file")


def _from_anywhere(values: dict[str, Any], where: Path) -> dict[str, Any]:
    """The values with files of the data that are not here where the run was started, if there.

    Else above the run's own folder, as where both were moved.
    """
    dataset, known = values.get("dataset"), values.get("provenance")
    started = known.get("directory") if isinstance(known, dict) else None
    if not isinstance(dataset, dict) or not isinstance(started, str):
        return values
    moved: dict[str, str] = {}
    for key in _FILES:
        given = dataset.get(key)
        if not isinstance(given, str) or Path(given).exists():
            continue
        names = (given, Path(given).name)
        places = [place / name for place in where.resolve().parents[1:] for name in names]
        found = [place for place in (Path(started) / given, *places) if place.exists()]
        if found:
            moved[key] = str(found[0])
    return {**values, "dataset": {**dataset, **moved}}


def make_experiment(
    values: Mapping[str, Any], where: str, overrides: Iterable[str] = ()
) -> Experiment:
    """Plain values of any task with overrides applied, checked; ``where`` names their source.

    Raises:
        ConfigError: an override is malformed, or a key or value is wrong.
    """
    overrides = tuple(overrides)
    chosen = [o.value for o in map(Override.of, overrides) if o.keys == ("task",)]
    asked = {"task": chosen[-1]} if chosen else values
    task = asked.get("task")
    model = TASKS.get(task if isinstance(task, str) else "")
    if "task" not in asked:
        model = TASKS[None]
    if model is None:
        known = [name for name in TASKS if name is not None]
        close = get_close_matches(str(task), known, n=1, cutoff=0.5)
        hint = f"did you mean {close[0]}?" if close else f"use one of {', '.join(known)}"
        raise ConfigError(f"{where}: task is {task!r}; {hint} (SLAM has no key task)")
    config = parse(model, values, where, overrides)
    problem = config.problem()
    if problem:
        raise ConfigError(f"{where}: {problem}")
    return config


def load_config(path: Path, overrides: Iterable[str] = ()) -> ExperimentConfig:
    """Reads an experiment of SLAM. Raises ConfigError, also where it is of another task."""
    return make_config(_from_anywhere(read_mapping(path), path), str(path), overrides)


def make_config(
    values: Mapping[str, Any], where: str, overrides: Iterable[str] = ()
) -> ExperimentConfig:
    """As :func:`make_experiment`, of SLAM alone."""
    if "task" in values:  # before its keys are refused, which SLAM would not know
        overrides = ()
    return as_task(ExperimentConfig, make_experiment(values, where, overrides), where)


def as_task(model: type[_Model], config: Experiment, where: str) -> _Model:
    """The experiment itself, if it is of this model. Raises ConfigError where it is not."""
    if isinstance(config, model):
        return config
    if config.task_name is None:
        raise ConfigError(f"{where}: has no task, so it is an experiment of SLAM; give another")
    what = "is a homing experiment" if isinstance(config, HomingExperiment) else "drives nothing"
    needed = "SLAM" if model is ExperimentConfig else "another task"
    raise ConfigError(
        f"{where}: task {config.task_name} {what}, and this needs an experiment of {needed}"
    )
