"""The command `fgslam sweep`."""

from __future__ import annotations

from fgslam.cli import options
from fgslam.cli.performing import existing_folder, exit_as, same_with_resume, show_all
from fgslam.cli.signals import stop_flag, stoppable


def sweep(  # noqa: PLR0913 - each option is a parameter
    experiments: options.Sources,
    axes: options.Axes = None,
    estimators: options.SweptEstimators = None,
    metric: options.Metric = None,
    jobs: options.Workers = None,
    scheduler: options.Scheduler = None,
    out: options.SweepFolder = None,
    overwrite: options.Overwrite = False,
    resume: options.ResumeSweep = False,
) -> None:
    """Run experiments over settings, recordings, estimators and seeds, on many workers.

    One Parquet table holds every case, a page curves and paired tests over the seeds. Ctrl-C ends
    it early with the table so far; the same command with --resume does what is missing.
    """
    from fgslam.cli.console import progress_with_table
    from fgslam.runs.sweeps.sweep import make_plan, run_sweep, workers_of

    existing = existing_folder(overwrite, resume)
    plan = make_plan(experiments, axes or (), None if estimators is None else estimators.split(","))
    folder = out or plan.default_folder
    with stop_flag() as stopped, progress_with_table() as (progress, shown):
        tell, pool = stoppable(progress, stopped), workers_of(jobs, scheduler)
        result = run_sweep(plan, folder, pool, existing, metric, (tell, stopped, shown))
    show_all([result], same_with_resume())
    exit_as([result])
