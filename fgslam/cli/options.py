"""Commands made of functions, and the options that several have; paths are checked at once.

Nothing slow is imported: a wrong path is answered within a moment.
"""

from __future__ import annotations

import copy
import inspect
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, TypeAlias, TypeVar, get_args, get_origin, get_type_hints

import typer

from fgslam.core.errors import ConfigError, DatasetError
from fgslam.core.files import require_file
from fgslam.datasets.layouts import fitting_layouts, is_recording
from fgslam.runs.folder import RUN_MARKER, is_run_folder
from fgslam.runs.named_experiments import experiment_names, find_experiment, suggestion

# --------------------------------------------------------------------------------------------
# A command is a function: its help is the docstring

Function = TypeVar("Function", bound=Callable[..., None])
_ITEM = re.compile(r"    (\w+)(?: \((.+?)\))?: (.*)")


def command(app: typer.Typer, epilog: str | None = None) -> Callable[[Function], Function]:
    """Makes a function a command of an app; it can still be called as it is.

    Its docstring is the help of the command and, below `Args:`, of the parameters, one a line:
    `name (METAVAR): help`, or `name (--flag METAVAR): help` for another name at the command line.
    A parameter without a default is an argument, unless it has a flag. One whose type is a
    dataclass stands for all options that are its fields, described below its `Attributes:`.
    """

    def add(function: Function) -> Function:
        groups: dict[str, Any] = {}
        shown: list[inspect.Parameter] = []
        about, described = _read_help(function, "Args")
        hints = get_type_hints(function, include_extras=True)
        for name, parameter in inspect.signature(function).parameters.items():
            if not is_dataclass(hints[name]):
                shown.append(_declare(name, hints[name], parameter.default, described[name]))
                continue
            groups[name] = kind = hints[name]
            _, own = _read_help(kind, "Attributes")
            types = get_type_hints(kind, include_extras=True)
            for field in fields(kind):
                default = getattr(kind, field.name, inspect.Parameter.empty)
                shown.append(_declare(field.name, types[field.name], default, own[field.name]))

        def called(**given: Any) -> None:
            for name, kind in groups.items():
                own = {field.name: given.pop(field.name) for field in fields(kind)}
                given[name] = kind(**own)
            function(**given)

        called.__signature__ = inspect.Signature(shown)  # type: ignore[attr-defined]
        app.command(function.__name__, help=about, epilog=epilog)(called)
        return function

    return add


def _read_help(thing: object, heading: str) -> tuple[str, dict[str, tuple[str, str]]]:
    """The text of a docstring before a heading, and below it notation and text of each name."""
    about, _, rest = (inspect.getdoc(thing) or "").partition(f"\n{heading}:\n")
    found: dict[str, tuple[str, str]] = {}
    name = ""
    for line in rest.splitlines():
        if item := _ITEM.match(line):
            name, notation, text = item.groups("")
            found[name] = notation, text
        elif line.strip():
            notation, text = found[name]
            found[name] = notation, f"{text} {line.strip()}"
    return about.strip(), found


def _declare(name: str, hint: Any, default: Any, described: tuple[str, str]) -> inspect.Parameter:
    """The parameter as Typer reads it: with flags, placeholder and help."""
    notation, text = described
    flags = [word for word in notation.split() if word.startswith("--")]
    kind, *declared = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    is_option = flags or default is not inspect.Parameter.empty
    info = copy.copy(declared[0]) if declared else typer.Option() if is_option else typer.Argument()
    if kind is bool and not flags:  # Typer would offer the contrary as well
        flags = [f"--{name.replace('_', '-')}"]
    if flags:
        info.param_decls = tuple(flags)
    info.metavar = " ".join(word for word in notation.split() if word not in flags) or None
    info.help = re.sub(r"\[(?=[a-z])", r"\\[", text)  # of an extra: rich would take it for a style
    own = Annotated[kind, info]  # type: ignore[valid-type]
    only = inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(name, only, default=default, annotation=own)


# --------------------------------------------------------------------------------------------
# Paths of arguments, checked

YAML_ENDINGS = (".yaml", ".yml")


def _complete(incomplete: str) -> list[str]:
    """Experiments of the package; files the shell completes by itself."""
    return [name for name in experiment_names() if name.startswith(incomplete)]


def _experiment(given: str) -> Path:
    """An experiment's file, given as a path or by name, or a recording's folder."""
    path = find_experiment(Path(given))
    if path.suffix.lower() not in YAML_ENDINGS and (path.exists() or is_recording(path)):
        fitting_layouts(path)
    elif not path.exists():
        raise ConfigError(f"{path}: no such file or folder; {suggestion(path)}")
    return path


def _bare_recording(given: str) -> Path:
    fitting_layouts(Path(given))
    return Path(given)


def _folder_or_experiment(given: str) -> Path:
    """A folder of that name goes before the experiment of that name."""
    return Path(given) if Path(given).exists() else find_experiment(Path(given))


def _recording(given: str) -> Path:
    path = _folder_or_experiment(given)
    if path.suffix.lower() not in YAML_ENDINGS:
        fitting_layouts(path)
    return path


def _run_folder(given: str) -> Path:
    path = Path(given)
    if not path.exists():
        raise DatasetError(f"{path}: no such folder; give a run folder, as fgslam run writes it")
    if not is_run_folder(path):
        raise DatasetError(
            f"{path}: not a run folder (no {RUN_MARKER}); give what fgslam run wrote"
        )
    return path


def _run_folder_or_map(given: str) -> Path:
    return Path(given) if Path(given).is_file() else _run_folder(given)


def _run_folder_or_experiment(given: str) -> Path:
    path = _folder_or_experiment(given)
    return path if path.is_file() else _run_folder(given)


def saved_map(given: str) -> Path:
    """An existing file. Raises DatasetError."""
    path, remedy = Path(given), "give a file that fgslam run --map-out wrote"
    if not path.exists():
        raise DatasetError(f"{path}: no such file; {remedy}")
    require_file(path, DatasetError, remedy)
    return path


Experiment = Annotated[Path, typer.Argument(parser=_experiment, autocompletion=_complete)]
Experiments = Annotated[list[Path], typer.Argument(parser=_experiment, autocompletion=_complete)]
BareRecording = Annotated[Path, typer.Argument(parser=_bare_recording)]
Recording = Annotated[Path, typer.Argument(parser=_recording, autocompletion=_complete)]
RunFolder = Annotated[Path, typer.Argument(parser=_run_folder)]
RunFolderOrMap = Annotated[Path, typer.Argument(parser=_run_folder_or_map)]
Runs = Annotated[list[Path], typer.Argument(parser=_run_folder_or_experiment)]
SavedMap = Annotated[Path, typer.Argument(parser=saved_map)]
AtLeast0: TypeAlias = Annotated[int | None, typer.Option(min=0)]
AtLeast1: TypeAlias = Annotated[int | None, typer.Option(min=1)]

# --------------------------------------------------------------------------------------------
# Options of a recording

_KEYS = {"unit": "unit_m"}


@dataclass(frozen=True)
class FrameOptions:
    """Which frames of a recording are used.

    Attributes:
        start: first frame used, from 0; sets dataset.start
        stop: frame before which to stop; sets dataset.stop
        stride: use every n-th; sets dataset.stride
        overrides (--set A.B=VALUE): override one key of the experiment; may be repeated
    """

    start: AtLeast0 = None
    stop: AtLeast1 = None
    stride: AtLeast1 = None
    overrides: list[str] | None = None

    def as_overrides(self, others: Mapping[str, str | Path | None] | None = None) -> list[str]:
        """``a.b=value`` of --set, then of the options, and of ``others`` by the key of each."""
        values: dict[str, Any] = {
            f"dataset.{_KEYS.get(name, name)}": value
            for name, value in vars(self).items()
            if name not in ("camera", "overrides")
        }
        if (topics := values.get("dataset.topics")) is not None:
            values["dataset.topics"] = [name.strip() for name in topics.split(",")]
        texts = [
            f"{key}={value if isinstance(value, int | float) else json.dumps(value, default=str)}"
            for key, value in (values | dict(others or {})).items()
            if value is not None
        ]
        return [*(self.overrides or ()), *texts]


@dataclass(frozen=True)
class RecordingOptions(FrameOptions):
    """Which frames of a recording are used, and how it is read.

    Attributes:
        start: first frame used, from 0; sets dataset.start
        stop: frame before which to stop; sets dataset.stop
        stride: use every n-th; sets dataset.stride
        overrides (--set A.B=VALUE): override one key of the experiment; may be repeated
        camera (FILE): calibration of a recording, in place of its own
        fps (RATE): frames a second of images or a film that state no times; sets dataset.fps
        scale (FACTOR): make the images smaller, 0.5 by half, and the calibration with them; sets
            dataset.scale
        unit (METRES): one unit of the calibration's lengths, 0.001: millimetres; sets
            dataset.unit_m
        topics (LEFT,RIGHT[,ODOMETRY]): of a ROS bag: which topics, where their names do not tell;
            of three cameras in the order of --camera FILE; sets dataset.topics
    """

    camera: Path | None = None
    fps: float | None = None
    scale: float | None = None
    unit: float | None = None
    topics: str | None = None
