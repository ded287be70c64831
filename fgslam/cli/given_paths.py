"""Checks of the paths on the command line, before anything is imported that takes time."""

from __future__ import annotations

from pathlib import Path

from fgslam.core.errors import ConfigError, DatasetError
from fgslam.datasets.layouts import recognise_layout
from fgslam.runs.folder import RUN_MARKER, is_run_folder
from fgslam.runs.named_experiments import experiment_names, find_experiment, suggestion

YAML_ENDINGS = (".yaml", ".yml")


def names_beginning_with(incomplete: str) -> list[str]:
    """For shell completion: experiments of the package; files the shell completes by itself."""
    return [name for name in experiment_names() if name.startswith(incomplete)]


def experiment(given: str) -> Path:
    """Path of an experiment's file, given as a path or by name. Raises ConfigError."""
    path = find_experiment(Path(given))
    if path.is_dir():
        inside = path / RUN_MARKER
        instead = f"{inside} to repeat that run" if inside.is_file() else "an experiment's .yaml"
        raise ConfigError(f"{path}: is a folder; give {instead}")
    if not path.exists():
        raise ConfigError(f"{path}: no such file; {suggestion(path)}")
    return path


def recording(given: str) -> Path:
    """Folder of a recording in a known layout, or an experiment's file. Raises FgslamError."""
    path = _folder_or_experiment(given)
    if path.suffix.lower() not in YAML_ENDINGS:
        recognise_layout(path)
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
    path = Path(given)
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "no such file"
        raise DatasetError(f"{path}: {what}; save a map with fgslam run --map-out")
    return path


def _folder_or_experiment(given: str) -> Path:
    """A folder of that name goes before the experiment of that name."""
    return Path(given) if Path(given).exists() else find_experiment(Path(given))
