"""The experiment that a recording alone is: everything else is recognised, or the default.

Truth that a recording has is for evaluation; nothing here looks at it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from copy import deepcopy
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import yaml

from fgslam.backend.settings import DEFAULT_ESTIMATOR
from fgslam.core.errors import ConfigError, DatasetError
from fgslam.datasets.layouts import LAYOUTS, is_recording, recognise_layout
from fgslam.datasets.settings import CalibratedSettings, FileRecordingSettings
from fgslam.runs.config import Experiment, ExperimentConfig, load_experiment, make_config
from fgslam.runs.config_reading import apply_overrides
from fgslam.runs.named_experiments import find_experiment, suggestion

if TYPE_CHECKING:
    from fgslam.core.recordings import Sequence
    from fgslam.datasets.clock import Judged

_SETTINGS = {each.kind: each for each in get_args(FileRecordingSettings)}

_NOT_IN_NAMES = re.compile(r"[^\w.-]+")


@dataclass(frozen=True, slots=True)
class Bare:
    """A recording as an experiment.

    Attributes:
        values: the short configuration.
        config: the same, checked, with overrides.
        said: what the recording is and how it is taken, in one line; then a line for each thing
            that was tolerated.
    """

    values: dict[str, Any]
    config: ExperimentConfig
    said: str


def bare_experiment(
    folder: Path, camera: Path | None = None, overrides: Iterable[str] = ()
) -> Bare:
    """Opens a recording and says what it is.

    Its odometry is used where it has some, else the motion is predicted by constant velocity.

    Args:
        folder: a recording in any known layout.
        camera: calibration in place of the folder's own.
        overrides: ``a.b=value``.

    Raises:
        FgslamError: the layout is not known, or the recording cannot be opened.
    """
    from fgslam.runs.opening import open_sequence  # loads arrays; a configuration needs none

    overrides = tuple(overrides)
    values: dict[str, Any] = {
        "name": _name(folder),
        "dataset": dataset_of(folder, camera, overrides),
        "odometry": {"kind": "recorded"},
        "estimator": {"kind": DEFAULT_ESTIMATOR},
    }
    where = str(folder)
    sequence = open_sequence(make_config(values, where, overrides))
    judged = _judged_odometry(sequence, overrides)
    if judged.fault or not has_odometry(sequence):
        values["odometry"] = {"kind": "constant_velocity"}
    elif judged.time_offset_s:
        values["odometry"]["time_offset_s"] = judged.time_offset_s
    if (noise := getattr(sequence, "disparity_sigma_px", None)) is not None:
        values["frontend"] = {"stereo": {"disparity_sigma_px": noise}}
    config = make_config(values, where, overrides)
    return Bare(values, config, _said(config, sequence, judged.note))


def experiment_of(
    given: Path, camera: Path | None = None, overrides: Iterable[str] = ()
) -> tuple[Experiment, str]:
    """The experiment that is meant, and, for a recording, what it is in a line or a few.

    Args:
        given: a configuration, the name of a shipped one, or else a recording's folder.
        camera: of a recording: calibration in place of its own.
        overrides: ``a.b=value``.

    Raises:
        FgslamError: it is none of these, or cannot be used.
    """
    path = find_experiment(given)
    if is_recording(path):
        bare = bare_experiment(path, camera, overrides)
        return bare.config, bare.said
    require_no_camera(path, camera)
    if not path.exists():
        raise ConfigError(f"{path}: no such file or folder; {suggestion(path)}")
    return load_experiment(path, overrides), ""


def require_no_camera(experiment: Path, camera: Path | None) -> None:
    """Raises ConfigError where an experiment, which says its own, is given a calibration."""
    if camera is not None:
        raise ConfigError(
            f"{experiment}: --camera is for a recording; in an experiment it is dataset.camera_file"
        )


def short_config(folder: Path, camera: Path | None = None, overrides: Iterable[str] = ()) -> str:
    """YAML of the configuration that repeats the run of a bare recording. Raises FgslamError."""
    overrides = tuple(overrides)
    bare = bare_experiment(folder, camera, overrides)
    values = deepcopy(bare.values)
    apply_overrides(values, overrides)
    said = bare.said.replace("\n", "\n# ")
    return f"# {said}\n{yaml.safe_dump(values, sort_keys=False)}"


def has_odometry(sequence: Sequence) -> bool:
    """Whether any step of the recording has odometry. Raises OdometryError where it is damaged."""
    return any(sequence.odometry(i) is not None for i in range(1, len(sequence)))


def _judged_odometry(sequence: Sequence, overrides: tuple[str, ...]) -> Judged:
    """What the images say of the odometry; nothing where an override says more."""
    from fgslam.datasets.clock import Judged, judged_turns
    from fgslam.datasets.recording import Recording

    asked = any(each.partition("=")[0].strip().startswith("odometry.") for each in overrides)
    if asked or not isinstance(sequence, Recording):
        return Judged()
    return judged_turns(sequence)


def _odometry_in_words(sequence: Sequence) -> str:
    steps = (sequence.odometry(i) for i in range(1, len(sequence)))
    known = [step for step in steps if step is not None]
    return "a gyroscope, no odometry" if known and known[0].turned else "odometry"


def _name(recording: Path) -> str:
    """Of a folder its name, of a file its name without ending."""
    path = recording.resolve()
    return (
        _NOT_IN_NAMES.sub("_", path.name if path.is_dir() else path.stem).strip("_") or "recording"
    )


def dataset_of(folder: Path, camera: Path | None, overrides: tuple[str, ...]) -> dict[str, str]:
    """The keys of ``dataset`` that open a bare recording; overrides are regarded, not applied.

    Raises:
        FgslamError: the layout is not known, or cannot take that calibration or rate.
    """
    dataset = recognise_layout(folder, _asked_kind(overrides))
    if _asked(overrides, "dataset.fps") and "fps" not in _fields(dataset["kind"]):
        raise ConfigError(
            f"{folder}: {LAYOUTS[dataset['kind']].name} states its own times; leave --fps out, "
            "--stride uses fewer frames"
        )
    if camera is None:
        return dataset
    if not issubclass(_SETTINGS[dataset["kind"]], CalibratedSettings):
        raise ConfigError(
            f"{folder}: {LAYOUTS[dataset['kind']].name} holds its own calibration; leave --camera "
            "out"
        )
    if not camera.exists():
        raise DatasetError(f"{camera}: no such calibration file; check --camera")
    return {**dataset, "camera_file": str(camera)}


def _asked_kind(overrides: tuple[str, ...]) -> str | None:
    """The layout that an override names; None where none does."""
    asked = _asked(overrides, "dataset.kind")
    if asked and asked[-1] not in LAYOUTS:
        raise ConfigError(
            f"dataset.kind={asked[-1]} is no layout of a folder of images; use one of "
            f"{', '.join(LAYOUTS)}"
        )
    return asked[-1] if asked else None


def _fields(kind: str) -> set[str]:
    return {field.name for field in fields(_SETTINGS[kind])}


def _asked(overrides: tuple[str, ...], key: str) -> list[str]:
    """Values that overrides give to a key."""
    pairs = [override.partition("=") for override in overrides]
    return [value.strip() for name, _, value in pairs if name.strip() == key]


def _said(config: ExperimentConfig, sequence: Sequence, more: str) -> str:
    rig, stamps = sequence.rig, sequence.timestamps
    duration = float(stamps[-1] - stamps[0])
    rate = f" at {(len(stamps) - 1) / duration:.3g} Hz" if duration > 0.0 else ""
    lenses = ", unrectified" if getattr(sequence, "unrectified", False) else ""
    motion = {"recorded": _odometry_in_words(sequence), "constant_velocity": "no odometry"}
    truth = "" if sequence.ground_truth is None else "; truth, for evaluation only"
    line = (
        f"{sequence.name}: {LAYOUTS[config.dataset.kind].name}, {rig.cameras} cameras "
        f"{rig.width}x{rig.height}{lenses}; {len(stamps)} frames{rate}; "
        f"{motion.get(config.odometry.kind, config.odometry.kind)}{truth}; estimator "
        f"{config.estimator.kind}"
    )
    return "\n".join(
        (line, *(f"note: {note}" for note in (*sequence.notes, *filter(None, [more]))))
    )
