"""Task `homing_trials`: simulated homings of bearings, many estimators on the same ones."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgslam.core.bearing_log import BearingLog
from fgslam.core.homing import Refusal
from fgslam.datasets.simulated_homing import open_simulated_homing
from fgslam.evaluation.homing import homing_errors
from fgslam.runs.config_models import HomingTrialsConfig
from fgslam.runs.folder import ExistingFolder
from fgslam.runs.homing_logs import save_bearing_logs
from fgslam.runs.homing_replay import replay_homing
from fgslam.runs.homing_results import HomingResult, Progress, Stopped, begin, jobs_of
from fgslam.runs.processes import WorkerEnded, run_apart
from fgslam.runs.tasks.homing_start import start_from_matches
from fgslam.runs.tasks.homing_trial_data import HomingTrial, TriedEstimator
from fgslam.runs.tasks.homing_trial_results import finish_trials

_BLOCK = 20  # trials a process: starting one takes as long as some trials


@dataclass(frozen=True, slots=True)
class TrialBlock:
    """Some trials for one process.

    Attributes:
        config: the experiment.
        share: number of the share of outliers.
        first, count: which trials.
    """

    config: HomingTrialsConfig
    share: int
    first: int
    count: int


def run_homing_trials(
    config: HomingTrialsConfig,
    folder: Path,
    existing: ExistingFolder,
    progress: Progress,
    stopped: Stopped,
) -> HomingResult:
    """Runs all trials; stopped early, those finished count."""
    begin(config, folder, existing, {"dataset": {"name": "simulated bearings"}})
    trials, failures = _perform_all(_blocks(config), jobs_of(config), progress, stopped)
    logs = {trial_name(trial): trial.log for trial in trials if trial.log is not None}
    save_bearing_logs(folder, logs)
    done = len(trials) == config.trials * len(config.outliers)
    return finish_trials(config, folder, "finished" if done else "interrupted", trials, failures)


def trial_name(trial: HomingTrial) -> str:
    """Of a trial's log: share of outliers in percent, and number."""
    return f"outliers_{100.0 * trial.share:02.0f}_trial_{trial.trial:04d}"


def perform_block(block: TrialBlock) -> list[HomingTrial]:
    """Some trials, one after the other."""
    numbers = range(block.first, block.first + block.count)
    return [perform_trial(block.config, block.share, trial) for trial in numbers]


def perform_trial(config: HomingTrialsConfig, share: int, trial: int) -> HomingTrial:
    """One trial; its noise depends on the seed, the share's number and its own number alone."""
    rng = np.random.default_rng((config.seed, share, trial))
    part = config.outliers[share]
    simulated = open_simulated_homing(config.dataset, part, rng)
    begun = start_from_matches(simulated.time, simulated.matches, config.homing_vector, rng)
    if isinstance(begun, Refusal):
        return HomingTrial(part, trial, begun.reason.value, 0, 0, {})
    start, rows = begun
    tracks, truth = simulated.followed(rows)
    tried = {}
    for settings in config.estimators:
        replayed = replay_homing(start, tracks, settings)
        errors = None
        if replayed.estimates:
            seen = dataclasses.replace(truth, robots=truth.robots[: len(replayed.estimates)])
            errors = homing_errors(replayed.estimates, seen)
        tried[settings.title] = TriedEstimator(errors, replayed.update_ms, replayed.failure)
    wrong = int(np.count_nonzero(~simulated.correct[rows]))
    log = BearingLog(start, list(tracks), truth) if trial < config.output.logs else None
    return HomingTrial(part, trial, "", len(rows), wrong, tried, log)


def _blocks(config: HomingTrialsConfig) -> list[TrialBlock]:
    return [
        TrialBlock(config, share, first, min(_BLOCK, config.trials - first))
        for first in range(0, config.trials, _BLOCK)
        for share in range(len(config.outliers))
    ]


def _perform_all(
    blocks: Sequence[TrialBlock], jobs: int, progress: Progress, stopped: Callable[[], bool]
) -> tuple[list[HomingTrial], list[str]]:
    """Finished trials in order, and a line for each block that ended without a result."""
    trials: list[HomingTrial] = []
    failures: list[str] = []
    total = sum(block.count for block in blocks)
    progress("trials", 0, total)
    for _, result in run_apart(perform_block, blocks, jobs, stopped, single_threaded=True):
        if isinstance(result, WorkerEnded):
            block = result.argument
            last = block.first + block.count - 1
            failures.append(f"trials {block.first} to {last}, share {block.share}: {result.why}")
        else:
            trials += result
        progress("trials", len(trials), total)
    return sorted(trials, key=lambda trial: (trial.share, trial.trial)), sorted(failures)
