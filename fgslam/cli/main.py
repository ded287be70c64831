"""The command line: thin commands, heavy imports inside them, errors and Ctrl-C caught once."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fgslam.cli import options, signals
from fgslam.cli.calibrate import calibrate_app, camera_app
from fgslam.cli.options import FrameOptions, RecordingOptions, command
from fgslam.cli.signals import Tell, stop_flag, stoppable
from fgslam.core.errors import ConfigError, FgslamError, one_line
from fgslam.core.memory import ShortageTold
from fgslam.runs.named_experiments import find_experiment, list_experiments
from fgslam.runs.wanted import Filmed, Wanted

if TYPE_CHECKING:
    from fgslam.runs.config import Experiment
    from fgslam.runs.engine import RunResult
    from fgslam.runs.folder import ExistingFolder

EXIT_FAULT = 1
EXIT_USER = 2
EXIT_NOT_LOCATED = 3

app = typer.Typer(
    name="fgslam",
    help="Stereo, trinocular and omnidirectional SLAM: filters and smoothers on one log.",
    pretty_exceptions_enable=False,
)
app.add_typer(camera_app, name="camera")
app.add_typer(calibrate_app, name="calibrate")


def _version(wanted: bool) -> None:
    if wanted:
        from fgslam.core import __version__

        typer.echo(f"fgslam {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="print it and exit")
    ] = False,
) -> None:
    """Filters and smoothers on one measurement log."""


# ------------------------------------------------------------------------------------------
# What the commands that run something share: progress and stop flag, results, exit status


@contextmanager
def under_way() -> Iterator[tuple[Tell, Callable[[], bool]]]:
    """Progress bar and stop flag while something is under way."""
    from fgslam.cli.console import progress_bar

    with stop_flag() as stopped, progress_bar() as progress:
        yield stoppable(progress, stopped), stopped


def show_all(results: Sequence[RunResult], resume: str = "") -> None:
    """Prints what the results say; ``resume`` is the command that goes on with the rest."""
    from fgslam.cli.console import show

    for result in results:
        show(result, resume)


def exit_as(results: Sequence[RunResult]) -> None:
    """Exits as the results ended: done, interrupted, an estimator in vain, or hardly located."""
    if any(result.status == "interrupted" for result in results):
        raise SystemExit(signals.status())
    if any(result.failed for result in results):
        raise typer.Exit(EXIT_FAULT)
    if any(result.located is not None and not result.located.enough for result in results):
        raise typer.Exit(EXIT_NOT_LOCATED)


def same_with_resume() -> str:
    """This command once more, to go on with what it left."""
    given = [word for word in sys.argv[1:] if word not in ("--overwrite", "--resume")]
    return shlex.join(["fgslam", *given, "--resume"])


def existing_folder(overwrite: bool, resume: bool = False) -> ExistingFolder:
    """What to do with results that are there. Raises ConfigError where both were asked for."""
    if overwrite and resume:
        raise ConfigError("--overwrite and --resume exclude each other; give one of them")
    return "resume" if resume else "overwrite" if overwrite else "refuse"


# ------------------------------------------------------------------------------------------
# Recordings and experiments


@command(app, list_experiments())
def run(  # noqa: PLR0913 - each option is a parameter
    config: options.Experiment,
    recording: RecordingOptions,
    out: Path | None = None,
    estimator: str | None = None,
    overwrite: bool = False,
    resume: bool = False,
    map_in: Path | None = None,
    map_out: Path | None = None,
    camera_out: Path | None = None,
    rig_memory: str | None = None,
    live: bool = False,
    save_rrd: Path | None = None,
) -> None:
    """Map a recording, or run an experiment: images in, run folder out.

    Of a recording the layout is recognised and printed; its odometry is used where it has some, and
    what is known of the truth only to judge. fgslam init prints the configuration that repeats it.

    With --map-in it begins in a saved map: map.start is where, map.extend whether it changes it.

    Ctrl-C ends it early with all files valid; --resume goes on from there.

    Args:
        config (RECORDING|EXPERIMENT): a recording: its folder, file or a pattern of files; or an
            experiment: a .yaml file, or the name of one that comes with fgslam, e.g. lab_loop
        out: the run folder itself; default runs/NAME
        estimator (KIND): which estimator steers; sets estimator.kind
        overwrite: replace an earlier one
        resume: continue an interrupted run to the same bytes
        map_in (MAP): saved map to go on with; sets map.load
        map_out (MAP): where to save the map; sets map.save
        camera_out (FILE): where to save the calibration as the drive corrected it, for --camera
        rig_memory (off|FILE): where to keep what drives show of this calibration, with which the
            next one begins; default: next to it, of an experiment off; sets rig_memory
        live: show the run in the rerun viewer; pip install 'fgslam[viewer]' provides it
        save_rrd (FILE.rrd): write what --live shows; needs no screen
        recording: of a recording: which frames, and how it is read
    """
    from fgslam.runs.bare import experiment_of

    existing = existing_folder(overwrite, resume)
    steered = {"estimator.kind": estimator, "map.load": map_in, "map.save": map_out}
    steered["rig_memory"] = rig_memory
    settings, about = experiment_of(config, recording.camera, recording.as_overrides(steered))
    if about:
        typer.echo(about)
    folder = out or Path("runs") / settings.name

    # Not before: a wrong key is answered before any library of numbers is loaded.
    from fgslam.runs.engine import resume_command
    from fgslam.runs.run import require_outputs, run_experiment
    from fgslam.runs.tasks.slam_results import corrected_camera, require_self_calibration

    require_outputs(settings, folder, existing, (camera_out, save_rrd), config)
    if camera_out is not None:
        require_self_calibration(settings)
    with ExitStack() as stack:
        watch = None
        if live or save_rrd is not None:
            from fgslam.runs.view import watched

            watch = stack.enter_context(watched(settings, live, save_rrd))
        progress, stopped = stack.enter_context(under_way())
        result = run_experiment(settings, folder, existing, progress, stopped, watch)
    show_all([result], resume_command(folder))
    if camera_out is not None:
        typer.echo(corrected_camera(folder, camera_out))
    exit_as([result])


@command(app)
def init(
    recording: options.BareRecording,
    chosen: RecordingOptions,
    estimator: str | None = None,
) -> None:
    """Print the short configuration that repeats `fgslam run RECORDING`, as YAML.

    Args:
        recording (RECORDING): its folder, file or a pattern of files
        estimator (KIND): which estimator steers; sets estimator.kind
        chosen: which frames, and how they are read
    """
    from fgslam.runs.bare import short_config

    overrides = chosen.as_overrides({"estimator.kind": estimator})
    typer.echo(short_config(recording, chosen.camera, overrides), nl=False)


@command(app)
def demo(out: Path = Path("runs/demo")) -> None:
    """Drive the paper's loop through the rendered lab: the experiment lab_loop, in a minute.

    Needs no recording. The page it ends with, report.html, shows path, map and numbers.

    Args:
        out: the run folder; replaced where it is there already
    """
    run(find_experiment(Path("lab_loop")), RecordingOptions(), out, overwrite=True)


@command(app)
def data(name: Annotated[str | None, typer.Argument()] = None, out: Path | None = None) -> None:
    """List recordings to try, or write one that is made here as a folder of images.

    Args:
        name (NAME): which one; without it all are listed
        out (DIR): a new folder for it; default its name
    """
    from fgslam.datasets.offers import offered, write_recording

    if name is None:
        typer.echo("\n".join(offered()))
        return
    with under_way() as (progress, _):
        then = write_recording(name, out or Path(name), progress)
    typer.echo(f"next: {then}")


@command(app)
def inspect(
    recording: options.Recording,
    chosen: RecordingOptions,
    frames: Annotated[int, typer.Option(min=1)] = 12,
) -> None:
    """Say what is in a recording, and what is wrong with it, in words.

    Exits with 0 whatever the report finds, with 2 where the recording cannot be opened at all.

    Args:
        recording (RECORDING): a recording: its folder, file or a pattern of files; or an
            experiment, .yaml or name, for its data set
        frames: in how many frames, evenly spread, features are matched
        chosen: which frames, and how they are read
    """
    from fgslam.runs.inspect import inspect_recording

    with under_way() as (progress, _):
        report = inspect_recording(
            recording, chosen.as_overrides(), frames, progress, chosen.camera
        )
    typer.echo(report)


# ------------------------------------------------------------------------------------------
# Estimators side by side, and many runs


@command(app)
def compare(  # noqa: PLR0913 - each option is a parameter
    runs: options.Runs,
    estimators: str | None = None,
    overrides: list[str] | None = None,
    out: Path | None = None,
    overwrite: bool = False,
    resume: bool = False,
    jobs: Annotated[int, typer.Option(min=1)] = 1,
    trials: options.AtLeast1 = None,
    seed: options.AtLeast0 = None,
) -> None:
    """Replay runs' measurements through estimators and set them side by side.

    Every estimator gets exactly the measurements that the run has logged. One that fails reports
    where and why; the others go on. With --trials the experiment is repeated with new noise, and
    paired tests say whether the smoothers beat the filters.

    Ctrl-C ends it early; the same command with --resume does what is left.

    Args:
        runs (RUN...): run folders; with --trials one run or experiment; or graphs, .g2o
        estimators (A,B,C): which ones: kinds, or labels of the run's configuration; default those
            that it compares, else every kind
        overrides (--set A.B=VALUE): override one key of one estimator, estimators.NAME.KEY; with
            --trials also any key of the experiment, e.g. dataset.stop; may be repeated
        out: folder of the results; default RUN/compare or RUN/trials
        overwrite: replace an earlier comparison
        resume: go on with an interrupted one, to the same bytes
        jobs: processes at a time, at most 4 a core; more than 1 disturbs times
        trials: repeat over so many worlds of noise
        seed: of the first trial; default the configuration's
    """
    if any(run.suffix == ".g2o" for run in runs):
        given = (("--set", overrides), ("--out", out), ("--overwrite", overwrite),
                 ("--resume", resume), ("--jobs", jobs > 1), ("--trials", trials),
                 ("--seed", seed is not None))  # fmt: skip
        if ignored := next((option for option, value in given if value), ""):
            raise ConfigError(f"{ignored} means nothing for graphs, .g2o; leave it out")
        _solve_graphs([str(run) for run in runs], None, 1, estimators)
        return
    from fgslam.cli.console import show_parts
    from fgslam.runs.compare import Choice, ate_tables, compare_runs
    from fgslam.runs.library import run_trials

    names = None if estimators is None else tuple(estimators.split(","))
    choice, existing = Choice(names, tuple(overrides or ())), existing_folder(overwrite, resume)
    if trials is None and seed is not None:
        raise ConfigError("--seed means nothing without --trials; give both or none")
    if trials is not None and len(runs) != 1:
        raise ConfigError("--trials takes one run or experiment at a time; give one")
    with under_way() as (progress, stopped):
        if trials is None:
            results = compare_runs(runs, choice, out, existing, jobs, progress, stopped)
        else:
            seeds = trials if seed is None else range(seed, seed + trials)
            tried = run_trials(runs[0], seeds, choice, out, existing, jobs, progress, stopped)
            results = [tried]
    show_all(results, same_with_resume())
    show_parts((), ate_tables(results))
    exit_as(results)


def _solve_graphs(
    names: Sequence[str], steps: int | None, jobs: int | None, estimators: str | None = None
) -> None:
    from fgslam.cli.console import show_parts
    from fgslam.runs.classics import (
        GRAPH_KINDS,
        NO_GRAPH,
        classics_notes,
        classics_table,
        require_classics,
        run_classics,
    )

    kinds = GRAPH_KINDS if estimators is None else estimators.split(",")
    if refused := sorted(set(kinds) - set(GRAPH_KINDS)):
        raise ConfigError(f"{refused[0]}: {NO_GRAPH}; give --estimators {','.join(GRAPH_KINDS)}")
    require_classics(names)
    with under_way() as (progress, stopped):
        rows = run_classics(names, steps, kinds, jobs, progress, stopped)
    tables = [classics_table(rows)] if rows else []
    show_parts((), tables, [("note", note) for note in classics_notes(rows)])
    if stopped():
        raise SystemExit(signals.status())


@command(app)
def classics(
    names: Annotated[list[str] | None, typer.Argument()] = None,
    steps: options.AtLeast1 = None,
    jobs: options.AtLeast1 = None,
) -> None:
    """Run well-known data sets, which come with GTSAM, through the estimators that fit.

    victoria_park, sphere2500, city10000, w10000 by iSAM2 and at once: filters and windows keep no
    old pose on which an edge could close a loop; victoria_park, which has no such edge, by three of
    them, too; kitti00, stereo tracks, by five; plaza1 and plaza2, ranges, and robots of UTIAS
    MRCLAM by six. ATE and NEES where truth is known, chi-square, time of a step. All of them take
    some minutes.

    Args:
        names (NAME...): which, or graphs, .g2o, or Robot1_Measurement.dat of UTIAS; default all
        steps: only so many steps of each drive
        jobs: drives at a time; default one a core
    """
    from fgslam.runs.classics import CLASSICS

    _solve_graphs(names or CLASSICS, steps, jobs)


@command(app)
def judge(
    estimates: list[str],
    truth: str | None = None,
    covariance: Path | None = None,
    tangent: str = "",
    out: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Hold the covariances of trajectories against their errors, whichever program made them.

    Reads TUM, EuRoC, OpenVINS and cnspy files, topics of ROS bags (BAG:/topic) and run folders.
    NEES is 1 where covariances are right; the last column is what mends them. What no file states
    of a covariance is found from the errors, and marked as a guess. Without --truth a run of fgslam
    is judged by two halves of its landmarks.

    Args:
        estimates (ESTIMATE...): files of poses, BAG:/topic, run folders or estimators' in them
        truth (FILE): true poses, of the same kinds of files
        covariance (FILE): covariances of the one estimate, a row a pose, in a file of their own
        tangent (WORDS): what they are of: rotation_first or translation_first, local, global,
            split_local or split_global, degrees; with commas; what is left out is guessed
        out (--run OUT): folder for the numbers and the page with figures; default none
        overwrite: replace an earlier one
    """
    from fgslam.cli.console import show_parts
    from fgslam.core.files import require_output
    from fgslam.runs.judge import judge as judged, write_judged

    if out is not None:
        files = [truth, covariance, *estimates]
        require_output(out, overwrite, [Path(f) for f in files if f is not None], folder=True)
    found = judged(estimates, truth, covariance, tangent)
    written = [("page", str(write_judged(found, out)))] if out is not None else []
    show_parts((), found.text_tables(), [*(("note", n) for n in found.notes), *written])


@command(app)
def sweep(  # noqa: PLR0913 - each option is a parameter
    experiments: options.Experiments,
    axes: list[str] | None = None,
    estimators: str | None = None,
    metric: str | None = None,
    jobs: options.AtLeast1 = None,
    scheduler: str | None = None,
    out: Path | None = None,
    overwrite: bool = False,
    resume: bool = False,
) -> None:
    """Run experiments over settings, recordings, estimators and seeds, on many workers.

    One Parquet table holds every case, a page curves and paired tests over the seeds. Ctrl-C ends
    it early with the table so far; the same command with --resume does what is missing.

    Args:
        experiments (RECORDING|EXPERIMENT...): experiments, .yaml or names, and recordings
        axes (--set A.B=VALUES): values of one key, with commas, or FIRST:END[:STEP] without END;
            every combination of several is a case. estimators.NAME.KEY is of one estimator
        estimators (A,B,C): kinds, or labels of the configuration; default those of the
            configuration
        metric: column that curves and tests are of; default ate_final_m, where it is known
        jobs: workers of this machine, at most 4 a core; default one a core
        scheduler (ADDRESS): of a Dask scheduler whose workers do it, tcp://HOST:PORT; anyone who
            reaches that address runs code as its workers' user
        out: folder of the results; default runs/NAME_sweep
        overwrite: replace an earlier one
        resume: do what has no result yet; axes may have become longer
    """
    from fgslam.cli.console import progress_bar
    from fgslam.runs.sweep import make_plan, run_sweep
    from fgslam.runs.workers import Pool

    existing = existing_folder(overwrite, resume)
    plan = make_plan(experiments, axes or (), None if estimators is None else estimators.split(","))
    folder = out or plan.default_folder
    pool = Pool(jobs, scheduler)
    with stop_flag() as stopped, progress_bar() as bar:
        progress = stoppable(bar, stopped)
        result = run_sweep(plan, folder, pool, existing, metric, progress, stopped)
    show_all([result], same_with_resume())
    exit_as([result])


# ------------------------------------------------------------------------------------------
# Maps and runs: locate, merge, hand over, look at


@command(app)
def localize(
    map_file: options.SavedMap,
    recording: options.Recording,
    chosen: RecordingOptions,
    frame: options.AtLeast0 = None,
    frames: Annotated[int, typer.Option(min=1, max=100)] = 1,
    out: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Where in a map were these frames taken? Without any prior.

    A pose is given only where it is certain, with the reasons. Exits with 3 where fewer than
    half of the queries were answered, with 2 where map or recording cannot be used.

    Args:
        map_file (MAP): a saved map
        recording (RECORDING): a recording: its folder, file or a pattern of files; or an
            experiment, .yaml or name, for its data set
        frame: the recording's frame to locate; default all, one by one
        frames: locate a submap of so many frames, ending there
        out: folder for table, numbers, picture and page; default none
        overwrite: replace an earlier one
        chosen: which frames, and how they are read
    """
    from fgslam.runs.tasks.localisation import Wanted, localize as locate

    overrides, existing = tuple(chosen.as_overrides()), existing_folder(overwrite)
    wanted = Wanted(map_file, recording, overrides, frame, frames, out, existing, chosen.camera)
    with under_way() as (progress, stopped):
        result = locate(wanted, progress, stopped)
    show_all([result])
    exit_as([result])


@command(app)
def export(run_folder: options.RunFolderOrMap, wanted: Wanted) -> None:
    """Hand a run's map, trajectory and measurements to other tools; or those of a saved map.

    Of a saved map alone it lists what is in it. --dense, --mesh and --grid match every pixel of the
    recording's images.

    Args:
        run_folder (RUN|MAP): a run folder, or a saved map
        wanted: what to hand over
    """
    from fgslam.cli.console import progress_bar
    from fgslam.runs.export import export_run

    with progress_bar() as progress:
        lines = export_run(run_folder, wanted, progress)
    for line in lines:
        typer.echo(line)


@command(app)
def pictures(run_folder: options.RunFolder) -> None:
    """Draw a run's map and errors as pictures, for print: RUN/pictures/*.png.

    The map from above with its ellipses and in perspective, errors along the axes, matches over
    time; report.html shows the same as figures.

    Args:
        run_folder (RUN): a run folder
    """
    from fgslam.runs.report import draw_run

    for path in draw_run(run_folder):
        typer.echo(str(path))


@command(app)
def film(
    run_folder: options.RunFolder,
    out: Annotated[Path, typer.Argument()],
    shown: Filmed,
    speed: Annotated[float, typer.Option(min=0.01, max=1000.0)] = 1.0,
    width: Annotated[int, typer.Option(min=320, max=3840)] = 1280,
    overwrite: bool = False,
) -> None:
    """Make a film of a run: images with their matches, next to the map as it grows.

    Of what fgslam follow wrote: images with the path image, its probability, the way home as an
    arrow, and the command or why there is none.

    Args:
        run_folder (RUN): a run folder
        out (FILE): the film, .mp4 or .gif
        shown: what it shows
        speed (FACTOR): over the recording's
        width (PIXELS): of its frames
        overwrite: replace an earlier one
    """
    from fgslam.cli.console import progress_bar
    from fgslam.runs.view import film_of_run

    with progress_bar() as progress:
        line = film_of_run(run_folder, out, shown, progress, overwrite, speed, width)
    typer.echo(line)


@command(app)
def merge(
    first: options.SavedMap, second: options.SavedMap, out: Path, overwrite: bool = False
) -> None:
    """Make two saved maps of one place into one; refuses what does not surely overlap.

    Args:
        first (MAP): the map whose world it will be
        second (MAP): the map to lay onto it
        out (--out MAP): where to write both as one
        overwrite: replace an earlier one
    """
    from fgslam.runs.session import merge_files

    for line in merge_files(first, second, out, overwrite):
        typer.echo(line)


@command(app)
def view(run_folder: options.RunFolder, save: Path | None = None, overwrite: bool = False) -> None:
    """Open a run in the rerun viewer, where that extra is installed.

    Args:
        run_folder (RUN): a run folder
        save: write an .rrd file for the viewer instead of a window
        overwrite: replace an earlier one
    """
    from fgslam.runs.view import view_run

    typer.echo(view_run(run_folder, save, overwrite))


# ------------------------------------------------------------------------------------------
# Routes: teach one from a recording, follow it with another, join several


def _perform(config: Experiment, folder: Path | None, overwrite: bool) -> None:
    from fgslam.runs.run import require_outputs, run_experiment

    place, existing = folder or Path("runs") / config.name, existing_folder(overwrite)
    require_outputs(config, place, existing)
    with under_way() as (progress, stopped):
        result = run_experiment(config, place, existing, progress, stopped)
    show_all([result], "the same command with --overwrite")
    exit_as([result])


@command(app)
def teach(
    recording: Path,
    out: Path,
    frames: FrameOptions,
    camera: str | None = None,
    poses: Path | None = None,
    report: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Choose the path images of a drive, and write what is to be remembered of them.

    Few images are chosen, each seen well from the one before; a table and the page say why each.

    Args:
        recording (RECORDING): a film, or a folder of pictures, of an omnidirectional camera
        out (--out ROUTE): the file to write, .fgpath
        camera (FILE): calibration of its camera: OCamCalib, BloggieUnwarp, YAML; or
            `equirectangular` for whole panoramas
        poses (FILE): RUN/ESTIMATOR/final.tum of stereo SLAM on this drive: metres
        report (DIR): the run folder itself; default runs/NAME
        overwrite: replace an earlier one
        frames: which are used
    """
    from fgslam.runs.bare import teaching

    config = teaching(recording, camera, out, frames.as_overrides({"poses": poses}))
    _perform(config, report, overwrite)


@command(app)
def follow(
    route: Path,
    recording: Path,
    frames: FrameOptions,
    camera: str | None = None,
    out: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Follow a route with another recording of the way: place, homing vector and command.

    What a robot would be commanded at each image, by the same follower; refusals with their reason.
    Exits with 1 where no image is recognised. Without --camera it is the route's own.

    Args:
        route (ROUTE): a route, as fgslam teach writes it
        recording (RECORDING): a film, or a folder of pictures, of an omnidirectional camera
        camera (FILE): calibration of its camera: OCamCalib, BloggieUnwarp, YAML; or
            `equirectangular` for whole panoramas
        out (DIR): the run folder itself; default runs/NAME
        overwrite: replace an earlier one
        frames: which are used
    """
    from fgslam.runs.bare import following

    _perform(following(route, recording, camera, frames.as_overrides()), out, overwrite)


@command(app)
def join(
    routes: list[Path],
    out: Path,
    report: Path | None = None,
    overrides: list[str] | None = None,
    overwrite: bool = False,
) -> None:
    """Join routes where their views match: one map, with crossroads.

    A place is called after its route's file and its image: monday/12. Routes may have been taught
    on different days; where they have nothing in common they stay apart, and that is reported.

    Args:
        routes (ROUTE...): routes, as fgslam teach writes them
        out (--out MAP): the file to write, .fgmap
        report (DIR): the run folder itself; default runs/NAME
        overrides (--set A.B=VALUE): override one key of the experiment; may be repeated
        overwrite: replace an earlier one
    """
    from fgslam.runs.bare import joining

    _perform(joining(routes, out, overrides or ()), report, overwrite)


@command(app)
def route(
    stored: Path,
    start: str,
    goal: str,
    camera: str | None = None,
    out: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Say the shortest way on a map of routes, and write it as a route of its own.

    Without --camera the picture is of the routes' own. Exits with 2 where there is no way.

    Args:
        stored (MAP): routes, as fgslam join writes them
        start (--from IMAGE): a picture from where the robot is, or a place's name
        goal (--to PLACE): a place's name; of a route: its end
        camera (FILE): calibration of its camera: OCamCalib, BloggieUnwarp, YAML; or
            `equirectangular` for whole panoramas
        out (ROUTE): write the way as a route, to be followed
        overwrite: replace an earlier one
    """
    from fgslam.runs.bare import way_said

    for line in way_said(stored, start, goal, camera, out, overwrite):
        typer.echo(line)


# ------------------------------------------------------------------------------------------
# The entry point

# Typer exports only the child; its parent's home differs from one Typer to the next.
_UsageError: type[typer.BadParameter] = typer.BadParameter.__bases__[0]
_OF_TYPER = 130  # what it makes of any KeyboardInterrupt; no command of ours returns it
_CLOSE_OPTIONS = 0.6  # typer offers --out for --foo


def _keep_close_options(error: Exception) -> None:
    """Of the options that are offered for an unknown one, keeps those that are spelled alike."""
    offered, given = getattr(error, "possibilities", None), getattr(error, "option_name", "")
    if offered:
        # Without dashes, which make any two options similar.
        names = {name.lstrip("-"): name for name in offered}
        close = get_close_matches(given.lstrip("-"), names, cutoff=_CLOSE_OPTIONS)
        error.possibilities = [names[name] for name in close]  # type: ignore[attr-defined]


def main() -> None:
    """Entry point: runs a command, turns a user's mistake into one line and exit status 2."""
    # None is used, and the search through all installed packages is a tenth of reading settings.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    # What is wrong with an image is reported here; what its header claims is not trusted.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", "100000000")
    arguments = sys.argv[1:] or ["--help"]
    signals.forget()
    try:
        with ShortageTold():
            status = int(app(arguments, prog_name="fgslam", standalone_mode=False) or 0)
        if status == _OF_TYPER and signals.was_asked():
            raise KeyboardInterrupt
        raise SystemExit(status)
    except _UsageError as error:
        command = error.ctx.command_path if error.ctx else "fgslam"
        _keep_close_options(error)
        message = one_line(" ".join(error.format_message().split()).rstrip("."))
        print(f"{command}: {message}; see {command} --help", file=sys.stderr)
        raise SystemExit(EXIT_USER) from None
    except FgslamError as error:
        print(f"fgslam: {error}", file=sys.stderr)
        raise SystemExit(EXIT_USER) from None
    except (KeyboardInterrupt, typer.Abort):  # the first becomes the second on its way
        print("fgslam: interrupted", file=sys.stderr)
        raise SystemExit(signals.status()) from None
    except BrokenPipeError:
        raise SystemExit(EXIT_FAULT) from None
    except OSError as error:
        # Of files of this program FgslamErrors tell; this is the terminal's, or a library's own.
        where = one_line(str(error.filename or "standard output"))
        print(f"fgslam: {where}: {error.strerror or error}; mend that and repeat", file=sys.stderr)
        raise SystemExit(EXIT_USER) from None
