"""Task `homing_trials`: simulated homings of bearings, many estimators on the same ones."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from fgslam.core.arrays import IntArray
from fgslam.core.bearing_log import BearingLog
from fgslam.core.homing import BearingMatches, HomingStart, Refusal
from fgslam.datasets.simulated_homing import open_simulated_homing
from fgslam.evaluation.homing import homing_errors
from fgslam.frontend.homing.homing_vector import estimate_homing_vector
from fgslam.frontend.homing.settings import HomingVectorSettings
from fgslam.frontend.homing.two_view_geometry import make_local_map
from fgslam.runs.config_models import HomingTrialsConfig
from fgslam.runs.engine import Context, Opening, RunResult, Status, Task
from fgslam.runs.homing_replay import replay_homing, save_bearing_logs
from fgslam.runs.tasks.homing_trial_results import HomingTrial, TriedEstimator, finish_trials
from fgslam.runs.units import Stage, in_blocks

Unit: TypeAlias = tuple[int, int]
"""Number of the share of outliers, and of the trial."""

_BLOCK = 20  # trials a process: starting one takes as long as some trials


def open_trials(config: HomingTrialsConfig, opening: Opening) -> Task[RunResult]:
    """Simulated homings need no data."""
    provenance = {"dataset": {"name": "simulated bearings"}}
    return Task(provenance, lambda context: _run(config, context))


def _run(config: HomingTrialsConfig, context: Context) -> RunResult:
    """Runs all trials; stopped early, those finished count."""
    units = _units(config)
    stage = Stage(
        name="trials",
        label="trials",
        count=len(units),
        work=perform_block,
        argument=lambda block: (config, [units[k] for k in block]),
        kind=HomingTrial,
        blocks=in_blocks(_BLOCK),
    )
    done = context.perform(stage)
    trials = sorted(done.results.values(), key=lambda trial: (trial.share, trial.trial))
    failures = sorted(_failure([units[k] for k in block], why) for block, why in done.ended)
    logs = {trial_name(trial): trial.log for trial in trials if trial.log is not None}
    save_bearing_logs(context.folder, logs)
    status: Status = "finished" if len(trials) == len(units) else "interrupted"
    return finish_trials(config, context.folder, status, trials, failures)


def _failure(units: Sequence[Unit], why: str) -> str:
    share, first = units[0]
    return f"{len(units)} trials, from trial {first} of share {share} on: {why}"


def trial_name(trial: HomingTrial) -> str:
    """Of a trial's log: share of outliers in percent, and number."""
    return f"outliers_{100.0 * trial.share:02.0f}_trial_{trial.trial:04d}"


def perform_block(block: tuple[HomingTrialsConfig, Sequence[Unit]]) -> list[HomingTrial]:
    """Some trials, one after the other."""
    config, units = block
    return [perform_trial(config, share, trial) for share, trial in units]


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


def _units(config: HomingTrialsConfig) -> list[Unit]:
    """All trials; those of one block are of one share, and the shares take turns."""
    return [
        (share, trial)
        for first in range(0, config.trials, _BLOCK)
        for share in range(len(config.outliers))
        for trial in range(first, min(first + _BLOCK, config.trials))
    ]


def start_from_matches(
    time: float,
    matches: BearingMatches,
    settings: HomingVectorSettings,
    rng: np.random.Generator,
) -> tuple[HomingStart, IntArray] | Refusal:
    """Homing vector and local map of the matches that support it.

    Returns:
        The start, whose features are numbered from 0, and the rows (n,) of ``matches`` that they
        were; or why there is none.
    """
    vector = estimate_homing_vector(matches, settings, rng)
    if isinstance(vector, Refusal):
        return vector
    rows = np.flatnonzero(vector.inliers)
    kept = matches.select(rows)
    of_kept = dataclasses.replace(vector, inliers=np.ones(len(rows), np.bool_))
    return HomingStart(time, of_kept, make_local_map(of_kept, kept), kept), rows
