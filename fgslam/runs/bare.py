"""A recording as an experiment; routes to teach, follow and join; the shortest way on a map."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from itertools import pairwise
from math import degrees, isnan
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import yaml

from fgslam.backend.settings import DEFAULT_ESTIMATOR
from fgslam.core.errors import CalibrationError, ConfigError, DatasetError, StoredMapError
from fgslam.core.files import require_output
from fgslam.datasets.layouts import LAYOUTS, is_recording, recognise_layout
from fgslam.datasets.settings import CalibratedSettings, FileRecordingSettings
from fgslam.runs.config import (
    Experiment,
    ExperimentConfig,
    apply_overrides,
    load_experiment,
    make_config,
    make_experiment,
)
from fgslam.runs.named_experiments import find_experiment, suggestion

if TYPE_CHECKING:
    from fgslam.homing.topological_map import MapPlace, RouteMap


# ------------------------------------------------------------------------------------------
# The experiment that a recording alone is: everything else is recognised, or the default

_SETTINGS = {each.kind: each for each in get_args(FileRecordingSettings)}

_NOT_IN_NAMES = re.compile(r"[^\w.-]+")


@dataclass(frozen=True, slots=True)
class Bare:
    """A recording as an experiment.

    Attributes:
        values: the short configuration.
        config: the same, checked, with overrides.
        description: what the recording is and how it is taken, in one line; then a line for each
            thing that was tolerated.
    """

    values: dict[str, Any]
    config: ExperimentConfig
    description: str


def bare_experiment(
    folder: Path, camera: Path | None = None, overrides: Iterable[str] = ()
) -> Bare:
    """Opens a recording and describes it.

    Its odometry is used where it has some, else the motion is predicted by constant velocity.

    Args:
        folder: a recording in any known layout.
        camera: calibration in place of the folder's own.
        overrides: ``a.b=value``.

    Raises:
        FgslamError: the layout is not known, or the recording cannot be opened.
    """
    from fgslam.datasets.clock import Judged, judged_turns
    from fgslam.datasets.recording import Recording
    from fgslam.runs.opening import open_sequence  # loads arrays; a configuration needs none

    overrides, where = tuple(overrides), str(folder)
    values: dict[str, Any] = {
        "name": _name(folder),
        "dataset": dataset_of(folder, camera, overrides),
        "odometry": {"kind": "recorded"},
        "estimator": {"kind": DEFAULT_ESTIMATOR},
    }
    sequence = open_sequence(make_config(values, where, overrides))
    asked = any(each.partition("=")[0].strip().startswith("odometry.") for each in overrides)
    # What the images show of the odometry; an override knows better.
    judged = Judged()
    if isinstance(sequence, Recording) and not asked:
        judged = judged_turns(sequence)
    steps = [sequence.odometry(i) for i in range(1, len(sequence))]
    known = [step for step in steps if step is not None]
    if judged.fault or not known:
        values["odometry"] = {"kind": "constant_velocity"}
    elif judged.time_offset_s:
        values["odometry"]["time_offset_s"] = judged.time_offset_s
    if (noise := getattr(sequence, "disparity_sigma_px", None)) is not None:
        values["frontend"] = {"stereo": {"disparity_sigma_px": noise}}
    config = make_config(values, where, overrides)
    rig, stamps = sequence.rig, sequence.timestamps
    duration = float(stamps[-1] - stamps[0])
    rate = f" at {(len(stamps) - 1) / duration:.3g} Hz" if duration > 0.0 else ""
    rectifier = getattr(sequence, "rectifier", None)
    lenses = ", unrectified" if rectifier is not None and rectifier.maps else ""
    motion = {
        "recorded": "a gyroscope, no odometry" if known and known[0].turned else "odometry",
        "constant_velocity": "no odometry",
    }.get(config.odometry.kind, config.odometry.kind)
    truth = "" if sequence.ground_truth is None else "; truth, for evaluation only"
    line = (
        f"{sequence.name}: {LAYOUTS[config.dataset.kind].name}, {rig.cameras} cameras "
        f"{rig.width}x{rig.height}{lenses}; {len(stamps)} frames{rate}; {motion}{truth}; "
        f"estimator {config.estimator.kind}"
    )
    notes = [f"note: {note}" for note in (*sequence.notes, judged.note) if note]
    return Bare(values, config, "\n".join([line, *notes]))


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
        # Experiments do not depend on what other runs have left; a recording alone may.
        bare = bare_experiment(path, camera, ("rig_memory=auto", *overrides))
        return bare.config, bare.description
    require_no_camera(path, camera)
    if not path.exists():
        raise ConfigError(f"{path}: no such file or folder; {suggestion(path)}")
    return load_experiment(path, overrides), ""


def require_no_camera(experiment: Path, camera: Path | None) -> None:
    """Raises ConfigError where an experiment, which names its own, is given a calibration."""
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
    comment = bare.description.replace("\n", "\n# ")
    return f"# {comment}\n{yaml.safe_dump(values, sort_keys=False)}"


def _name(recording: Path) -> str:
    """Of a folder its name, of a file its name without ending."""
    path = recording.resolve()
    stem = path.name if path.is_dir() else path.stem
    return _NOT_IN_NAMES.sub("_", stem).strip("_") or "recording"


def dataset_of(folder: Path, camera: Path | None, overrides: tuple[str, ...]) -> dict[str, str]:
    """The keys of ``dataset`` that open a bare recording; overrides are regarded, not applied.

    Raises:
        FgslamError: the layout is not known, or cannot take that calibration or rate.
    """
    asked = {key.strip(): value.strip() for key, _, value in (o.partition("=") for o in overrides)}
    kind = asked.get("dataset.kind")
    if kind is not None and kind not in LAYOUTS:
        raise ConfigError(
            f"dataset.kind={kind} is no layout of a folder of images; use one of "
            f"{', '.join(LAYOUTS)}"
        )
    dataset = recognise_layout(folder, kind)
    name, settings = LAYOUTS[dataset["kind"]].name, _SETTINGS[dataset["kind"]]
    if "dataset.fps" in asked and "fps" not in settings.__dataclass_fields__:
        raise ConfigError(
            f"{folder}: {name} states its own times; leave --fps out, --stride uses fewer frames"
        )
    if camera is None:
        return dataset
    if not issubclass(settings, CalibratedSettings):
        raise ConfigError(f"{folder}: {name} holds its own calibration; leave --camera out")
    if not camera.exists():
        raise DatasetError(f"{camera}: no such calibration file; check --camera")
    return {**dataset, "camera_file": str(camera)}


# ------------------------------------------------------------------------------------------
# Routes


def teaching(
    recording: Path, camera: str | None, route: Path, overrides: Iterable[str] = ()
) -> Experiment:
    """The experiment that teaches a route.

    Args:
        recording: a film, or a folder of pictures.
        camera: calibration file, or the kind of camera; of a mirror it must be given.
        route: the file to write.
        overrides: ``a.b=value``.

    Raises:
        FgslamError: recording or camera cannot be used.
    """
    if camera is None:
        raise CalibrationError(
            f"{recording}: no camera is given; add --camera FILE, its calibration, or --camera "
            "equirectangular for whole panoramas"
        )
    values = {
        "task": "teach",
        "name": f"teach_{_name(recording)}",
        "dataset": _dataset(recording, camera),
        "route": str(route),
    }
    return make_experiment(values, str(recording), overrides)


def following(
    route: Path, recording: Path, camera: str | None = None, overrides: Iterable[str] = ()
) -> Experiment:
    """The experiment that follows a route; ``camera`` None is the one that it was taught with.

    Raises:
        FgslamError: recording or camera cannot be used.
    """
    values = {
        "task": "follow",
        "name": f"follow_{_name(recording)}",
        "dataset": _dataset(recording, camera or "equirectangular"),
        "route": str(route),
        "taught_camera": camera is None,
    }
    return make_experiment(values, str(recording), overrides)


def joining(routes: Sequence[Path], out: Path, overrides: Iterable[str] = ()) -> Experiment:
    """The experiment that joins routes into the map ``out``. Raises ConfigError."""
    values = {
        "task": "join",
        "name": f"join_{_name(out)}",
        "routes": [str(route) for route in routes],
        "map": str(out),
    }
    return make_experiment(values, "join", overrides)


def way_said(
    stored: Path,
    start: str,
    goal: str,
    camera: str | None = None,
    out: Path | None = None,
    overwrite: bool = False,
) -> list[str]:
    """The shortest way on a map, in lines.

    Args:
        stored: the map's file.
        start: a picture from where the robot is, or the name of a place.
        goal: name of a place or a route.
        camera: of the picture; None: the routes' own.
        out: where the way is written as a route; None: nowhere.
        overwrite: replace a file that is there.

    Raises:
        FgslamError: file, picture or place cannot be used, or there is no way.
    """
    from fgslam.homing.topological_map import RouteMap  # loads arrays

    if out is not None:
        require_output(out, overwrite, (stored, Path(start)))
    joined = RouteMap.load(stored)
    lines = []
    if joined.knows(start):
        way = joined.way(start, goal)
    else:
        place = _place(joined, Path(start), camera)
        near = f"near {place.name}, {place.inliers} features in common"
        lines.append(f"{start}: {f'at {place.name}' if place.at else near}")
        way = joined.way(place, goal)
    lines += [f"{len(way)} path images:", f"  {way.names[0]}"]
    for before, name in pairwise(way.names):
        link = joined.link(before, name)
        if not link.support:
            seen = "driven before, but without a homing vector"
        elif isnan(link.direction):
            seen = "the same place"
        else:
            at = round(degrees(link.direction))
            seen = f"at {at} degrees, {link.support} features in common"
        lines.append(f"  {name}: {seen}")
    if out is not None:
        way.save(out)
        lines.append(f"written as a route: {out}")
    return lines


def _place(joined: RouteMap, picture: Path, camera: str | None) -> MapPlace:
    from fgslam.cameras.omni_files import load_camera
    from fgslam.core.bearings import Refusal
    from fgslam.datasets.images import read_colour_image

    if not picture.is_file():
        raise StoredMapError(
            f"{picture}: neither a picture nor a place of the map; its places are "
            f"{joined.names[0]} to {joined.names[-1]}"
        )
    image = read_colour_image(picture)
    size = (image.shape[1], image.shape[0])
    place = joined.locate(image, None if camera is None else load_camera(camera, size))
    if isinstance(place, Refusal):
        raise StoredMapError(f"{picture}: {place.details}; go on a little, and take another one")
    return place


def _dataset(recording: Path, camera: str) -> dict[str, Any]:
    from fgslam.cameras.omni_files import camera_keys  # loads arrays

    if not recording.exists():
        raise DatasetError(f"{recording}: no such film or folder; check the path")
    keys = camera_keys(camera)
    panoramas = "panoramas" if keys["kind"] == "equirectangular" else "omni_path"
    kind = "omni_video" if recording.is_file() else panoramas
    return {"kind": kind, "path": str(recording), "camera": keys}
