"""Arguments and options of the commands; paths are checked before anything slow is imported."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from fgslam.core.errors import ConfigError, DatasetError
from fgslam.core.files import require_file
from fgslam.datasets.layouts import fitting_layouts, is_recording
from fgslam.runs.folder import RUN_MARKER, is_run_folder
from fgslam.runs.named_experiments import experiment_names, find_experiment, suggestion

YAML_ENDINGS = (".yaml", ".yml")


def names_beginning_with(incomplete: str) -> list[str]:
    """For shell completion: experiments of the package; files the shell completes by itself."""
    return [name for name in experiment_names() if name.startswith(incomplete)]


def experiment(given: str) -> Path:
    """An experiment's file, given as a path or by name, or a recording's folder.

    Raises FgslamError.
    """
    path = find_experiment(Path(given))
    if path.suffix.lower() not in YAML_ENDINGS and (path.exists() or is_recording(path)):
        fitting_layouts(path)
    elif not path.exists():
        raise ConfigError(f"{path}: no such file or folder; {suggestion(path)}")
    return path


def bare_recording(given: str) -> Path:
    """Folder of a recording in a known layout. Raises DatasetError."""
    fitting_layouts(Path(given))
    return Path(given)


def recording(given: str) -> Path:
    """Folder of a recording in a known layout, or an experiment's file. Raises FgslamError."""
    path = _folder_or_experiment(given)
    if path.suffix.lower() not in YAML_ENDINGS:
        fitting_layouts(path)
    return path


def run_folder(given: str) -> Path:
    """Folder of a run. Raises DatasetError."""
    path = Path(given)
    if not path.exists():
        raise DatasetError(f"{path}: no such folder; give a run folder, as fgslam run writes it")
    if not is_run_folder(path):
        raise DatasetError(
            f"{path}: not a run folder (no {RUN_MARKER}); give what fgslam run wrote"
        )
    return path


def run_folder_or_map(given: str) -> Path:
    """Folder of a run, or a file. Raises DatasetError."""
    return Path(given) if Path(given).is_file() else run_folder(given)


def run_folder_or_experiment(given: str) -> Path:
    """Folder of a run, or an experiment's file. Raises DatasetError."""
    path = _folder_or_experiment(given)
    return path if path.is_file() else run_folder(given)


def saved_map(given: str) -> Path:
    """An existing file. Raises DatasetError."""
    path, remedy = Path(given), "save a map with fgslam run --map-out"
    if not path.exists():
        raise DatasetError(f"{path}: no such file; {remedy}")
    require_file(path, DatasetError, remedy)
    return path


def _folder_or_experiment(given: str) -> Path:
    """A folder of that name goes before the experiment of that name."""
    return Path(given) if Path(given).exists() else find_experiment(Path(given))


def _version(wanted: bool) -> None:
    if wanted:
        from fgslam.core import __version__

        typer.echo(f"fgslam {__version__}")
        raise typer.Exit


def as_overrides(given: Mapping[str, str | float | Path | None]) -> list[str]:
    """``a.b=value`` of the options that were given, by the key that each sets."""
    return [
        f"{key}={value if isinstance(value, int | float) else json.dumps(str(value))}"
        for key, value in given.items()
        if value is not None
    ]


def of_recording(topics: str | None = None, **given: str | float | None) -> list[str]:
    """Overrides of the options of a recording: which frames, how fast, how large, and so on.

    Args:
        topics: of a bag, names between commas.
        given: the other options, each by its name, which is the data set's key.
    """
    chosen = as_overrides({f"dataset.{key}": value for key, value in given.items()})
    if topics is None:
        return chosen
    names = [name.strip() for name in topics.split(",")]
    return [*chosen, f"dataset.topics={json.dumps(names)}"]


# --------------------------------------------------------------------------------------------
# All commands

Version = Annotated[
    bool, typer.Option("--version", callback=_version, is_eager=True, help="print it and exit")
]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="A.B=VALUE", help="override one key of the experiment; may be repeated"
    ),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="replace an earlier one")]

# --------------------------------------------------------------------------------------------
# run

Experiment = Annotated[
    Path,
    typer.Argument(
        metavar="RECORDING|EXPERIMENT",
        parser=experiment,
        autocompletion=names_beginning_with,
        help="a recording: its folder, file or a pattern of files; or an experiment: a .yaml file, "
        "or the name of one that comes with fgslam, e.g. lab_loop",
    ),
]
Camera = Annotated[
    Path | None,
    typer.Option(
        "--camera", metavar="FILE", help="calibration of a recording, in place of its own"
    ),
]
Start = Annotated[
    int | None, typer.Option(min=0, help="first frame used, from 0; sets dataset.start")
]
Stop = Annotated[
    int | None, typer.Option(min=1, help="frame before which to stop; sets dataset.stop")
]
Stride = Annotated[int | None, typer.Option(min=1, help="use every n-th; sets dataset.stride")]
Fps = Annotated[
    float | None,
    typer.Option(
        metavar="RATE",
        help="frames a second of images or a film that state no times; sets dataset.fps",
    ),
]
Scale = Annotated[
    float | None,
    typer.Option(
        metavar="FACTOR",
        help="make the images smaller, 0.5 by half, and the calibration with them; sets "
        "dataset.scale",
    ),
]
Unit = Annotated[
    float | None,
    typer.Option(
        metavar="METRES",
        help="one unit of the calibration's lengths, 0.001: millimetres; sets dataset.unit_m",
    ),
]
Topics = Annotated[
    str | None,
    typer.Option(
        metavar="LEFT,RIGHT[,ODOMETRY]",
        help="of a ROS bag: which topics, where their names do not tell; of three cameras in the "
        "order of --camera FILE; sets dataset.topics",
    ),
]
Estimator = Annotated[
    str | None, typer.Option(metavar="KIND", help="which estimator steers; sets estimator.kind")
]
RunFolder = Annotated[Path | None, typer.Option(help="the run folder itself; default runs/NAME")]
Resume = Annotated[
    bool, typer.Option("--resume", help="continue an interrupted run to the same bytes")
]
MapIn = Annotated[
    Path | None,
    typer.Option("--map-in", metavar="MAP", help="saved map to go on with; sets map.load"),
]
MapOut = Annotated[
    Path | None,
    typer.Option("--map-out", metavar="MAP", help="where to save the map; sets map.save"),
]
CameraOut = Annotated[
    Path | None,
    typer.Option(
        "--camera-out",
        metavar="FILE",
        help="where to save the calibration as the drive corrected it, for --camera",
    ),
]

Live = Annotated[
    bool,
    typer.Option(
        "--live",
        help="show the run in the rerun viewer; pip install 'fgslam\\[viewer]' provides it",
    ),
]
SaveRrd = Annotated[
    Path | None,
    typer.Option(metavar="FILE.rrd", help="write what --live shows; needs no screen"),
]

# --------------------------------------------------------------------------------------------
# inspect, localize, init

BareRecording = Annotated[
    Path,
    typer.Argument(
        metavar="RECORDING", parser=bare_recording, help="its folder, file or a pattern of files"
    ),
]
Recording = Annotated[
    Path,
    typer.Argument(
        metavar="RECORDING",
        parser=recording,
        autocompletion=names_beginning_with,
        help="a recording: its folder, file or a pattern of files; or an experiment, .yaml or "
        "name, for its data set",
    ),
]

# --------------------------------------------------------------------------------------------
# Runs and maps

RunToView = Annotated[Path, typer.Argument(metavar="RUN", parser=run_folder, help="a run folder")]
RunOrMap = Annotated[
    Path,
    typer.Argument(
        metavar="RUN|MAP",
        parser=run_folder_or_map,
        help="a run folder, or a saved map",
    ),
]
SavedMap = Annotated[Path, typer.Argument(metavar="MAP", parser=saved_map, help="a saved map")]
FirstMap = Annotated[
    Path,
    typer.Argument(metavar="MAP", parser=saved_map, help="the map whose world it will be"),
]
SecondMap = Annotated[
    Path,
    typer.Argument(metavar="MAP", parser=saved_map, help="the map to lay onto it"),
]

# --------------------------------------------------------------------------------------------
# compare

Runs = Annotated[
    list[Path],
    typer.Argument(
        metavar="RUN...",
        parser=run_folder_or_experiment,
        help="run folders; with --trials one run or experiment",
    ),
]
Estimators = Annotated[
    str | None,
    typer.Option(
        metavar="A,B,C",
        help="which ones: kinds, or labels of the run's configuration; default those that it "
        "compares, else every kind",
    ),
]
EstimatorOverrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="A.B=VALUE",
        help="override one key of one estimator, estimators.NAME.KEY; with --trials also any key "
        "of the experiment, e.g. dataset.stop; may be repeated",
    ),
]
Out = Annotated[
    Path | None, typer.Option(help="folder of the results; default RUN/compare or RUN/trials")
]
OverwriteResults = Annotated[
    bool, typer.Option("--overwrite", help="replace an earlier comparison")
]
ResumeResults = Annotated[
    bool, typer.Option("--resume", help="go on with an interrupted one, to the same bytes")
]
Jobs = Annotated[
    int,
    typer.Option(min=1, help="processes at a time, at most 4 a core; more than 1 disturbs times"),
]
TrialCount = Annotated[
    int | None, typer.Option("--trials", min=1, help="repeat over so many worlds of noise")
]
FirstSeed = Annotated[
    int | None, typer.Option(min=0, help="of the first trial; default the configuration's")
]
Sources = Annotated[
    list[Path],
    typer.Argument(
        metavar="RECORDING|EXPERIMENT...",
        parser=experiment,
        autocompletion=names_beginning_with,
        help="experiments, .yaml or names, and recordings' folders",
    ),
]
Axes = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="A.B=VALUES",
        help="values of one key, with commas, or FIRST:END[:STEP] without END; every combination "
        "of several is a case. estimators.NAME.KEY is of one estimator",
    ),
]
SweptEstimators = Annotated[
    str | None,
    typer.Option(
        "--estimators",
        metavar="A,B,C",
        help="kinds, or labels of the configuration; default those of the configuration",
    ),
]
Metric = Annotated[
    str | None,
    typer.Option(
        help="column that curves and tests are of; default ate_final_m, where it is known"
    ),
]
Workers = Annotated[
    int | None,
    typer.Option(
        "--jobs", min=1, help="workers of this machine, at most 4 a core; default one a core"
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="of a Dask scheduler whose workers do it, tcp://HOST:PORT; anyone who reaches that "
        "address runs code as its workers' user",
    ),
]
SweepFolder = Annotated[
    Path | None, typer.Option(help="folder of the results; default runs/NAME_sweep")
]
ResumeSweep = Annotated[
    bool, typer.Option("--resume", help="do what has no result yet; axes may have become longer")
]
