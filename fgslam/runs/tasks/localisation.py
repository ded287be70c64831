"""Task `localisation` and `fgslam localize`: a recording's frames are sought in a map.

Units: queries, one frame or a short submap each. Files: localisation.csv, timing.csv, metrics.json,
a picture, the page. Numbers: queries answered, right, inexact and false ones, errors, NEES, times.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.core.errors import ConfigError, FgslamError, OutputError
from fgslam.core.geometry import yaw_pitch_roll
from fgslam.core.recordings import Sequence
from fgslam.core.saved_map import SavedMap, require_rig
from fgslam.core.threads import one_blas_thread
from fgslam.evaluation.localisation import localisation_errors
from fgslam.runs.bare_recording import dataset_of, require_no_camera
from fgslam.runs.config import (
    ExperimentConfig,
    as_task,
    load_config,
    load_experiment,
    make_experiment,
)
from fgslam.runs.config_models import LocalisationConfig
from fgslam.runs.engine import Context, LocatedShare, Opening, Task, provenance_of
from fgslam.runs.folder import ExistingFolder, begin_run_folder, is_run_folder, write_config
from fgslam.runs.opening import open_sequence
from fgslam.runs.owner import Owner
from fgslam.runs.tasks.localisation_queries import Attempt, ask_all, nothing_asked
from fgslam.runs.tasks.localisation_results import (
    LocalisationResult,
    answers_of,
    in_frames,
    result_of,
    sigmas_of,
    status_of,
    write_results,
)
from fgslam.runs.tasks.slam import drive_first
from fgslam.runs.tasks.slam_map_entry import FIRST_FOLDER, MAP_FILE, GivenMap, open_map
from fgslam.runs.units import Progress, UnitStore
from fgslam.runs.workers import InProcess


def open_localisation(config: LocalisationConfig, opening: Opening) -> Task[LocalisationResult]:
    """Opens the recording, and the map where it is there already. Raises FgslamError."""
    given = None if config.map.load is None else open_map(Path(config.map.load))
    sequence = open_queries(config, opening.progress)
    if given is not None:
        require_rig(given.saved, sequence.rig, str(given.path))
    provenance = _provenance(given, sequence)
    return Task(provenance, lambda context: _run(config, given, sequence, context))


def _run(
    config: LocalisationConfig, given: GivenMap | None, sequence: Sequence, context: Context
) -> LocalisationResult:
    """The drive that makes the map, where the run asks for one, and all queries."""
    folder = context.folder
    if given is None:
        ended = drive_first(config.as_experiment(), context)
        if ended is not None and ended.status == "interrupted":
            nothing = nothing_asked("the map was not finished")
            return result_of(config, folder, nothing, sequence.notes)
        given = open_map(folder / FIRST_FOLDER / MAP_FILE)
        write_config(folder, config, _provenance(given, sequence))
    asked = ask_all(config, given, sequence, context)
    result = result_of(config, folder, asked, sequence.notes)
    subtitle = f"{sequence.name}, in a map of {len(asked.landmarks)} landmarks"
    write_results(result, given, subtitle)
    return result


def open_queries(config: LocalisationConfig, progress: Progress) -> Sequence:
    """Opens the recording whose frames are sought. Raises FgslamError."""
    return open_sequence(
        config.as_experiment(), lambda done, total: progress("rendering", done, total)
    )


def _provenance(given: GivenMap | None, sequence: Sequence) -> dict[str, Any]:
    """What it takes to repeat the run, beside its configuration."""
    out = provenance_of(sequence)
    if given is not None:
        out["map"] = {"path": str(given.path), "sha256": given.identity}
    return out


_YAML = (".yaml", ".yml")
_NAME_WIDTH = 18


@dataclasses.dataclass(frozen=True, slots=True)
class Wanted:
    """What is asked.

    Attributes:
        map_file: the saved map.
        recording: a recording's folder, or an experiment's .yaml for its data set.
        overrides: ``a.b=value`` of the experiment.
        frame: number of the one frame to locate; None: all of them, one by one.
        frames: of a query: 1, or a short submap of so many.
        out: folder of the results; None: none are written.
        existing: what to do where it holds a run already.
        camera: calibration of a recording, in place of its own.
    """

    map_file: Path
    recording: Path
    overrides: tuple[str, ...] = ()
    frame: int | None = None
    frames: int = 1
    out: Path | None = None
    existing: ExistingFolder = "refuse"
    camera: Path | None = None


@one_blas_thread()
def localize(wanted: Wanted, progress: Progress, stopped: Callable[[], bool]) -> LocalisationResult:
    """Locates frames of a recording in a map without any prior.

    Raises:
        FgslamError: map, recording, frame or configuration cannot be used.
    """
    out = wanted.out
    if out is not None and wanted.existing == "refuse" and is_run_folder(out):
        raise OutputError(f"{out} holds a run already; choose another --out, or add --overwrite")
    given = open_map(wanted.map_file)
    config = _config(wanted, given.saved)
    sequence = _open(wanted, config, progress)
    require_rig(given.saved, sequence.rig, str(given.path))
    with ExitStack() as stack:
        if out is not None:
            begin_run_folder(out, wanted.existing, stack.enter_context(Owner(out)))
            write_config(out, config, _provenance(given, sequence))
        loop = (1, progress, stopped, InProcess())
        context = Context(out or Path(), False, UnitStore(None), *loop)
        asked = ask_all(config, given, sequence, context)
        result = result_of(config, out, asked, sequence.notes)
        notes = (*_other_frontend(config, given), *result.notes)
        result = dataclasses.replace(result, notes=notes)
        write_results(result, given, f"{sequence.name}, in the map {given.path}")
        return dataclasses.replace(_one_by_one(result), located=_share(asked.attempts))


def _share(attempts: Collection[Attempt]) -> LocatedShare:
    found = [one for one in attempts if one.found is not None and one.found.found]
    return LocatedShare(len(found), len(attempts))


def _one_by_one(result: LocalisationResult) -> LocalisationResult:
    """The result with a line for each query, or with a single one in full."""
    attempts = result.asked.attempts
    if len(attempts) == 1:
        lines = tuple(f"{name:<{_NAME_WIDTH}}{value}" for name, value in _details(attempts[0]))
        return dataclasses.replace(result, lines=lines, tables=())
    lines = tuple(_answer_line(attempt) for attempt in attempts)
    return dataclasses.replace(result, lines=(*lines, *result.lines))


def _config(wanted: Wanted, saved: SavedMap) -> LocalisationConfig:
    """The experiment's settings for queries in this map; of a folder those that made the map."""
    where = str(wanted.recording)
    if wanted.recording.suffix.lower() in _YAML:
        require_no_camera(wanted.recording, wanted.camera)
        given = load_experiment(wanted.recording, wanted.overrides)
        if not isinstance(given, ExperimentConfig | LocalisationConfig):
            load_config(wanted.recording)  # says which task this cannot do
            raise ConfigError(f"{where}: holds no recording of stereo images; give another")
        values = given.as_values()
        overrides: tuple[str, ...] = ()
    else:
        values = {
            "name": "localize",
            "dataset": dataset_of(wanted.recording, wanted.camera, wanted.overrides),
            "odometry": {"kind": "recorded"},
            "frontend": settings_of_map(saved).get("frontend", {}),
        }
        overrides = wanted.overrides
    known = LocalisationConfig.model_fields
    kept = {name: value for name, value in values.items() if name in known}
    queries = {**kept.get("localisation", {}), "frames": [wanted.frames], "every": 1}
    kept |= {"task": "localisation", "localisation": queries, "map": {"load": str(wanted.map_file)}}
    config = as_task(LocalisationConfig, make_experiment(kept, where, overrides), where)
    return _of_one_frame(config, wanted)


def _answer_line(attempt: Attempt) -> str:
    """One query in a line, for the terminal."""
    start = f"frame {attempt.frame:>5}  {status_of(attempt):<16}"
    found = attempt.found
    if found is None:
        return f"{start}{attempt.problem}"
    if not found.found:
        return f"{start}{found.why}"
    x, y, z = found.wTc[:3, 3]
    yaw = np.rad2deg(yaw_pitch_roll(found.wTc)[0])
    metres, degrees = sigmas_of(found)
    where = f"({x:7.3f}, {y:6.3f}, {z:7.3f}) m  heading {yaw:7.2f} deg"
    return (
        f"{start}{where}  sigma {100 * metres:4.1f} cm {degrees:4.2f} deg  "
        f"inliers {len(found.ids)} of {found.candidates}"
    )


def _details(attempt: Attempt) -> Iterator[tuple[str, str]]:
    """One query in full: name and value of what there is to know."""
    yield "frame", f"{attempt.frame}, from {in_frames(attempt.frames)}"
    yield "verdict", status_of(attempt)
    found = attempt.found
    if found is None:
        yield "why", attempt.problem
        return
    if np.isfinite(found.covariance).all():
        x, y, z = found.wTc[:3, 3]
        yaw, pitch, roll = np.rad2deg(yaw_pitch_roll(found.wTc))
        metres, degrees = sigmas_of(found)
        doubt = "" if found.found else ", not to be believed"
        yield "position", f"{x:.3f} {y:.3f} {z:.3f} m (right, down, ahead){doubt}"
        yield "yaw, pitch, roll", f"{yaw:.2f} {pitch:.2f} {roll:.2f} deg"
        yield "sigma", f"{100 * metres:.1f} cm, {degrees:.2f} deg"
    yield "features", str(attempt.features)
    yield "candidates", f"{found.candidates} tentative matches by appearance"
    yield "inliers", f"{len(found.ids)} matches that agree with the pose"
    yield "expected", f"{found.expected} landmarks that should be recognised from there"
    yield "residual", f"{found.residual_px:.2f} px" if len(found.ids) else "-"
    yield "second-best place", f"{found.second} inliers"
    yield "why", found.why
    if np.isfinite(attempt.truth).all():
        errors = localisation_errors(answers_of([attempt]))
        if attempt.accepted:
            error = f"{100 * errors.metres[0]:.1f} cm, {np.rad2deg(errors.radians[0]):.2f} deg"
            yield "error", error


def settings_of_map(saved: SavedMap) -> dict[str, Any]:
    """Settings of the last drive that made the map; empty where it holds none."""
    drives = saved.about.get("drives")
    last = drives[-1] if isinstance(drives, list) and drives else {}
    settings = last.get("settings") if isinstance(last, dict) else None
    return settings if isinstance(settings, dict) else {}


def _of_one_frame(config: LocalisationConfig, wanted: Wanted) -> LocalisationConfig:
    """The configuration of one query alone, where only one is asked for."""
    frame, dataset = wanted.frame, config.dataset
    if frame is None:
        return config
    first = frame - (wanted.frames - 1) * dataset.stride
    selected = (frame - dataset.start) % dataset.stride == 0
    if frame < dataset.start or not selected or (dataset.stop or frame + 1) <= frame:
        raise ConfigError(
            f"--frame {frame}: not among the frames selected (start {dataset.start}, stop "
            f"{dataset.stop}, stride {dataset.stride}); choose another, or other --start, ..."
        )
    if first < dataset.start:
        raise ConfigError(
            f"--frame {frame}: too few frames before it for a submap of {wanted.frames}; lower "
            "--frames"
        )
    one = dataclasses.replace(dataset, start=first, stop=frame + 1)
    return config.model_copy(update={"dataset": one})


def _open(wanted: Wanted, config: LocalisationConfig, progress: Progress) -> Sequence:
    frame = wanted.frame
    if frame is None:
        return open_queries(config, progress)
    try:
        sequence = open_queries(config, progress)
    except FgslamError as error:
        raise type(error)(f"--frame {frame}: {error}") from None
    if len(sequence) < wanted.frames:
        last = config.dataset.start + (len(sequence) - 1) * config.dataset.stride
        raise ConfigError(
            f"--frame {frame}: {sequence.name} ends with frame {last}; choose a smaller one"
        )
    return sequence


def _other_frontend(config: LocalisationConfig, given: GivenMap) -> tuple[str, ...]:
    """A note where features are looked for otherwise than when the map was made."""
    made, now = settings_of_map(given.saved).get("frontend"), config.as_values()["frontend"]
    if not isinstance(made, dict):
        return ()
    other = settings_that_differ(made, now)
    if not other:
        return ()
    keys = " and ".join(f"frontend.{name}" for name in other)
    return (f"{keys} differs from that of the map's drive: fewer features will be recognised",)


def settings_that_differ(made: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Groups of the front-end by which features are recognised, where they differ.

    Only what both know counts: maps of other versions have fewer settings or more.
    """
    groups = ("sift", "appearance", "stereo")
    then = {name: made.get(name) or {} for name in groups}
    return [
        name
        for name in groups
        if any(then[name][key] != now[name][key] for key in then[name].keys() & now[name].keys())
    ]
