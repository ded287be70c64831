"""What `import fgslam` offers of recordings, runs and replays; each a few lines over the rooms."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias, cast, get_args

from fgslam.backend.protocol import Estimator
from fgslam.backend.settings import EstimatorSettings
from fgslam.backend.smoothers.graph import FactorGraph
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import (
    ConfigError,
    DatasetError,
    EstimatorError,
    FrameError,
    MeasurementLogError,
)
from fgslam.core.files import as_path
from fgslam.core.log import ImageSequence, MeasurementLog
from fgslam.core.sensors import CameraRig, Odometry
from fgslam.core.types import Trajectory
from fgslam.datasets.layouts import is_recording, recognise_layout
from fgslam.datasets.settings import RenderedLabSettings, SimulatedMeasurementsSettings
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.runs.bare import experiment_of
from fgslam.runs.compare import EVERY, Choice, choose, with_estimators
from fgslam.runs.config import ExperimentConfig, HomingTrialsConfig, load_experiment, make_config
from fgslam.runs.engine import RunResult, run_task
from fgslam.runs.folder import RUN_MARKER, ExistingFolder, is_run_folder
from fgslam.runs.named_experiments import find_experiment, suggestion
from fgslam.runs.opening import open_sequence
from fgslam.runs.run import require_outputs, run_experiment
from fgslam.runs.session import Overrides, override_texts, slam_config
from fgslam.runs.sweep import SEED, Axis, Plan, SweepResult, make_plan, read_source, run_sweep
from fgslam.runs.units import Progress, Stopped
from fgslam.runs.workers import Pool
from fgslam.slam.build import chosen_estimator, is_settings
from fgslam.slam.replay import Replay, replay as replay_log

RecordedFrame: TypeAlias = tuple[float, tuple[Image, ...] | None, Odometry | None]
"""Time in seconds, images (left, right[, top]) or None, odometry of the body or None."""

_WORLDS = {"lab": "lab_loop"}
"""Worlds that are rendered, and the experiment that describes each."""


@dataclass(frozen=True, eq=False, repr=False)
class RecordedFrames:
    """A recording as frames to track: ``for t, images, odometry in recording``.

    Attributes:
        sequence: the recording as its reader gives it.
    """

    sequence: ImageSequence

    def __repr__(self) -> str:
        return f"<recording {self.name}: {len(self)} frames, {self.rig}>"

    @property
    def name(self) -> str:
        """Short name for titles."""
        return self.sequence.name

    @property
    def rig(self) -> CameraRig:
        """The rectified cameras."""
        return self.sequence.rig

    @property
    def timestamps(self) -> FloatArray:
        """(n,) seconds, increasing."""
        return self.sequence.timestamps

    @property
    def ground_truth(self) -> Trajectory | None:
        """True poses of the right camera, n of them or fewer; None where they are not known."""
        return self.sequence.ground_truth

    @property
    def notes(self) -> tuple[str, ...]:
        """What was tolerated when opening, in words: missing frames and the like."""
        return self.sequence.notes

    def __len__(self) -> int:
        return len(self.sequence)

    def __getitem__(self, i: int) -> RecordedFrame:
        """Frame ``i``: time in seconds, images and odometry, as :meth:`fgslam.Slam.track` wants.

        The images are (left, right[, top]), (height, width) uint8; None where one of them cannot be
        read. The odometry is the body's motion since frame ``i - 1``; None for the first, and where
        none was recorded.

        Raises:
            IndexError: there is no such frame.
            OdometryError: the recording's odometry is malformed.
        """
        if not -len(self) <= i < len(self):
            raise IndexError(f"frame {i}: the recording has {len(self)} frames")
        i = range(len(self))[i]
        images: tuple[Image, ...] | None
        try:
            right, left, *top = self.sequence.frame(i).images
            images = (left, right, *top)
        except FrameError:
            images = None
        odometry = self.sequence.odometry(i) if i else None
        return float(self.timestamps[i]), images, odometry

    def __iter__(self) -> Iterator[RecordedFrame]:
        return (self[i] for i in range(len(self)))


def open_recording(path: str | Path, overrides: Overrides = ()) -> RecordedFrames:
    """Opens a recording: a folder of any known layout, or that of an experiment.

    Args:
        path: folder of an image folder, KITTI or EuRoC recording; or the name or file
            of an experiment, whose selection of frames and odometry then hold.
        overrides: settings that differ, by dotted key: ``{"dataset.stop": 100}``.

    Raises:
        DatasetError: no such folder, none of the known layouts, or the recording is malformed.
        CalibrationError: its calibration is missing or impossible.
        ConfigError: no such experiment, or a key or value is wrong.
    """
    found = as_path(path, DatasetError, "recording")
    if is_recording(found):
        values = {"name": "recording", "dataset": dict(recognise_layout(found))}
        config = make_config(values, str(found), override_texts(overrides))
    elif find_experiment(found).is_file():
        config = slam_config(found, overrides)
    else:
        raise DatasetError(
            f"{found}: no such folder of a recording; check the path, or {suggestion(found)}"
        )
    return RecordedFrames(open_sequence(config))


def rendered_recording(world: str = "lab", frames: int | None = None) -> RecordedFrames:
    """A drive through a rendered world with exact truth: data for examples and tests.

    Three cameras of 320 x 240 pixels, wheel odometry with noise; always the same. Rendered images
    are kept in the user's cache folder.

    Args:
        world: `lab`.
        frames: only so many of the drive's frames; None for all.

    Raises:
        ConfigError: no such world, or not so many frames.
        MissingDependencyError: a library that rendering needs is absent.
    """
    if not isinstance(world, str) or world not in _WORLDS:
        raise ConfigError(f"no rendered world {world!r}; known: {', '.join(_WORLDS)}")
    if frames is not None and frames < 1:
        raise ConfigError(f"frames is {frames}; give at least 1, or None for all")
    overrides = {} if frames is None else {"dataset.stop": frames}
    return open_recording(_WORLDS[world], overrides)


def _checked_existing(existing: ExistingFolder) -> ExistingFolder:
    """The same. Raises ConfigError where it is no such word."""
    known = get_args(ExistingFolder)
    if existing not in known:
        raise ConfigError(f"existing is {existing!r}; use one of {', '.join(known)}")
    return existing


def run(
    experiment: str | Path,
    overrides: Overrides = (),
    out: str | Path | None = None,
    existing: ExistingFolder = "refuse",
    progress: Progress = lambda what, done, total: None,
    camera: str | Path | None = None,
) -> RunResult:
    """Runs a recording, or an experiment of any task, into a run folder, as ``fgslam run`` does.

    Args:
        experiment: a recording's folder, the name of an experiment that comes with fgslam, or a
            YAML file.
        overrides: settings that differ, by dotted key: ``{"seed": 3}``; or texts: ``["seed=3"]``.
        out: the run folder; None for runs/NAME.
        existing: what to do where the folder holds a run: `refuse`, `overwrite` or `resume`.
        progress: called with what is under way, how much of it is done, and of how much.
        camera: of a recording: calibration file in place of its own.

    Returns:
        How it ended: `folder`, `status` (`finished` or `interrupted`), `metrics` (the document of
        metrics.json), and what `fgslam run` would print.

    Raises:
        FgslamError: of any kind, with one line that states what to do.
    """
    calibration = None if camera is None else Path(camera)
    config, _ = experiment_of(
        as_path(experiment, DatasetError, "experiment"), calibration, override_texts(overrides)
    )
    folder = Path("runs") / config.name if out is None else Path(out)
    require_outputs(config, folder, _checked_existing(existing), source=Path(experiment))
    return run_experiment(config, folder, existing, progress)


def sweep(  # noqa: PLR0913 - each is an option of the command
    experiments: str | Path | Iterable[str | Path],
    settings: Mapping[str, Any] | Iterable[str] = (),
    out: str | Path | None = None,
    *,
    estimators: Iterable[str] | None = None,
    metric: str | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    existing: ExistingFolder = "refuse",
    progress: Progress = lambda what, done, total: None,
) -> SweepResult:
    """Runs experiments over settings, recordings, estimators and seeds, as ``fgslam sweep`` does.

    ::

        result = fgslam.sweep("lab_trials", {"seed": range(100), "dataset.stop": [50, 100]}, jobs=2)
        result.table().groupby("estimator").ate_final_m.mean()

    Args:
        experiments: names of experiments, YAML files, folders of recordings; one or several.
        settings: by dotted key a value, or several in a list, a range or an array; or texts as the
            command takes them: ``["seed=0:100"]``. Every combination is a case.
        out: folder of the results; None for runs/NAME_sweep.
        estimators: which; None for those of each configuration.
        metric: column that curves and tests are of; None for ate_final_m where it is known.
        jobs: workers of this machine; None for one a core.
        scheduler: address of a Dask scheduler whose workers do it instead. Whoever reaches that
            address runs code as the workers' user.
        existing: what to do where the folder holds a sweep: `refuse`, `overwrite` or `resume`.
        progress: called with what is under way, how much of it is done, and of how much.

    Returns:
        How it ended: `status`, `table()` as a data frame, `failures` by number of the case.

    Raises:
        FgslamError: of any kind, with one line that states what to do.
    """
    given = [experiments] if isinstance(experiments, str | Path) else list(experiments)
    plan = make_plan(
        [as_path(one, DatasetError, "experiment") for one in given], settings, estimators
    )
    folder = plan.default_folder if out is None else Path(out)
    existing = _checked_existing(existing)
    return run_sweep(plan, folder, Pool(jobs, scheduler), existing, metric, progress)


def run_trials(
    source: Path,
    seeds: int | range,
    choice: Choice = EVERY,
    out: Path | None = None,
    existing: ExistingFolder = "refuse",
    jobs: int = 1,
    progress: Progress = lambda what, done, total: None,
    stopped: Stopped = lambda: False,
) -> RunResult:
    """Runs an experiment with several seeds in a row and compares the estimators on each.

    Args:
        source: an experiment's .yaml, or the run folder of one.
        seeds: of the trials; or how many, the first one being the configuration's.
        choice: which estimators, and overrides of theirs and of the experiment.
        out: folder of the results; None: `trials` in the run folder, or `runs/NAME_trials`.
        existing: what to do where results are already; `resume` goes on with the trials left.
        jobs: workers at a time, each with linear algebra on one thread.
        progress: called after each trial that is done.
        stopped: True ends the trials; those finished are kept.

    Raises:
        FgslamError: the experiment has one world of noise only, or cannot be run.
    """
    of_run = is_run_folder(source)
    file = source / RUN_MARKER if of_run else source
    config = load_experiment(file, choice.of_experiment)
    worlds = RenderedLabSettings | SimulatedMeasurementsSettings
    if not isinstance(config, ExperimentConfig | HomingTrialsConfig) or (
        isinstance(config, ExperimentConfig) and not isinstance(config.dataset, worlds)
    ):
        raise ConfigError(
            f"{source}: has one world of noise alone; --trials needs the dataset.kind rendered_lab "
            "or simulated_measurements, or the task homing_trials"
        )
    estimators = choose(config, choice.of_estimators)
    folder = out or (source / "trials" if of_run else Path("runs") / f"{config.name}_trials")
    if isinstance(seeds, int):
        seeds = range(config.seed, config.seed + seeds)
    if isinstance(config, HomingTrialsConfig):
        from fgslam.runs.tasks.homing_replay import open_trials  # loads Plotly

        chosen = with_estimators(config, estimators)
        chosen = chosen.model_copy(update={"trials": len(seeds), "seed": seeds.start})
        return run_task(open_trials, chosen, folder, existing, progress, stopped, jobs)
    settings = {
        key.strip(): (text,) for key, _, text in (one.partition("=") for one in choice.overrides)
    }
    if config.map.save is not None:
        settings["map.save"] = ("null",)
    axes = (settings | {SEED: tuple(map(str, seeds))}).items()
    titles = tuple(one.title for one in estimators)
    plan = Plan((read_source(file),), tuple(Axis(key, texts) for key, texts in axes), titles)
    return run_sweep(plan, folder, Pool(jobs), existing, None, progress, stopped)


def replay(
    log: MeasurementLog,
    estimator: str | EstimatorSettings | Estimator,
    ego_motion: EgoMotionSettings | None = None,
) -> Replay:
    """Gives every frame of a log to an estimator, as the live loop would have done.

    Args:
        log: the measurements; not changed.
        estimator: a kind, settings, or a new object with the members of :class:`fgslam.Estimator`.
        ego_motion: of the least squares that finds each frame's pose against the estimator's map;
            None for the defaults.

    Returns:
        ``trajectory``, ``covariances``, ``map`` and ``graph()``, as a session's result has them,
        with numbers of every frame. An estimator that fails ends its replay, not the program:
        ``failure`` states where and why.

    Raises:
        ConfigError: no such estimator.
        MeasurementLogError: ``log`` is none, or begins in a saved map, which it does not hold.
    """
    if not isinstance(log, MeasurementLog):
        raise MeasurementLogError(
            f"replay: the log is a {type(log).__name__}; give that of a session, slam.log, or load "
            "one by fgslam.MeasurementLog.load(file)"
        )
    if len(log) and not log.increments[0].observations.is_new.all():
        raise MeasurementLogError(
            "replay: this log begins in a saved map, which it does not hold; compare estimators on "
            "it by a run: fgslam run with map.load, then fgslam compare RUN"
        )
    if not isinstance(ego_motion, EgoMotionSettings | None):
        raise ConfigError(
            f"replay: ego_motion is a {type(ego_motion).__name__}; give settings of it, or None"
        )
    chosen = chosen_estimator(estimator)
    if not is_settings(chosen) and len(cast("Estimator", chosen).landmarks()):
        raise ConfigError(
            f"estimator: this {type(chosen).__name__} has taken in frames already; give a new one"
        )
    return replay_log(log, chosen, ego_motion or EgoMotionSettings())


def graph(
    log: MeasurementLog,
    estimator: str | EstimatorSettings = "batch",
    ego_motion: EgoMotionSettings | None = None,
) -> FactorGraph:
    """A log as a factor graph of GTSAM's at an estimator's solution, to add factors of your own.

    A key is ``gtsam.symbol("x", frame)``, or ``"l"`` with the number of a landmark variable.

    Args:
        log: the measurements; not changed.
        estimator: `batch`, `isam2` or `sliding_window`, or settings of them.
        ego_motion: as of :func:`replay`.

    Returns:
        gtsam.NonlinearFactorGraph, gtsam.Values, and the keys of poses and landmarks.

    Raises:
        ConfigError: no such estimator, or one that keeps no whole graph.
        EstimatorError: it fails on this log.
        MeasurementLogError: as of :func:`replay`.
    """
    found = replay(log, estimator, ego_motion)
    if found.failure:
        raise EstimatorError(f"{found.kind}: {found.failure}")
    return found.graph()
