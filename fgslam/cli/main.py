"""The command line: thin commands, heavy imports inside them, errors and Ctrl-C caught once."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fgslam.cli import options, signals
from fgslam.cli.calibrate import calibrate_app
from fgslam.cli.calibrate import camera as camera_app
from fgslam.cli.signals import Tell, stop_flag, stoppable
from fgslam.core.errors import FgslamError, one_line
from fgslam.core.memory import ShortageTold
from fgslam.runs.named_experiments import experiment_names, find_experiment

if TYPE_CHECKING:
    from pathlib import Path

    from fgslam.runs.config import Experiment
    from fgslam.runs.engine import RunResult
    from fgslam.runs.folder import ExistingFolder
    from fgslam.runs.tasks.slam import Watch


# ------------------------------------------------------------------------------------------
# The command `fgslam film`


def film(
    run_folder: options.RunToView,
    out: Annotated[Path, typer.Argument(metavar="FILE", help="the film, .mp4 or .gif")],
    estimator: Annotated[
        str | None, typer.Option(help="whose path and map; default the one that steered")
    ] = None,
    taught: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="of a route that was followed: the run folder of fgslam teach (its --report), for "
            "the pictures of path images",
        ),
    ] = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Make a film of a run: images with their matches, next to the map as it grows.

    Of what fgslam follow wrote: images with the path image, its probability, the way home as an
    arrow, and the command or why there is none.
    """
    from fgslam.cli.console import progress_bar
    from fgslam.runs.view import film_of_run

    with progress_bar() as progress:
        line = film_of_run(run_folder, out, estimator, taught, progress, overwrite)
    typer.echo(line)


# ------------------------------------------------------------------------------------------
# What the commands that run something share: progress and stop flag, results, exit status

EXIT_FAULT = 1
EXIT_NOT_LOCATED = 3


@contextmanager
def under_way() -> Iterator[tuple[Tell, Callable[[], bool]]]:
    """Progress bar and stop flag while something is under way."""
    from fgslam.cli.console import progress_bar

    with stop_flag() as stopped, progress_bar() as progress:
        yield stoppable(progress, stopped), stopped


@contextmanager
def watched_by(config: Experiment, live: bool, file: Path | None) -> Iterator[Watch | None]:
    """What shows a run in the viewer, frame by frame; None without a viewer."""
    if not live and file is None:
        yield None
        return
    from fgslam.runs.view import watched

    with watched(config, live, file) as watch:
        yield watch


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
    from fgslam.core.errors import ConfigError

    if overwrite and resume:
        raise ConfigError("--overwrite and --resume exclude each other; give one of them")
    return "resume" if resume else "overwrite" if overwrite else "refuse"


# ------------------------------------------------------------------------------------------
# Commands of routes: teach one from a recording, follow it with another, join several

Recording = Annotated[
    Path,
    typer.Argument(
        metavar="RECORDING",
        help="a film, or a folder of pictures, of an omnidirectional camera",
    ),
]
OmniCamera = Annotated[
    str | None,
    typer.Option(
        "--camera",
        metavar="FILE",
        help="calibration of its camera: OCamCalib, BloggieUnwarp, YAML; or `equirectangular` "
        "for whole panoramas",
    ),
]
Report = Annotated[
    Path | None, typer.Option(metavar="DIR", help="the run folder itself; default runs/NAME")
]


def teach(  # noqa: PLR0913 - each option is a parameter
    recording: Recording,
    out: Annotated[Path, typer.Option(metavar="ROUTE", help="the file to write, .fgpath")],
    camera: OmniCamera = None,
    poses: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="RUN/ESTIMATOR/final.tum of stereo SLAM on this drive: metres"
        ),
    ] = None,
    report: Report = None,
    start: options.Start = None,
    stop: options.Stop = None,
    stride: options.Stride = None,
    overrides: options.Overrides = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Choose the path images of a drive, and write what is to be remembered of them.

    Few images are chosen, each seen well from the one before; a table and the page say why each.
    """
    from fgslam.runs.bare import teaching

    chosen = options.of_recording(start=start, stop=stop, stride=stride)
    chosen += options.as_overrides({"poses": poses})
    config = teaching(recording, camera, out, [*(overrides or ()), *chosen])
    _perform(config, report, overwrite)


def follow(  # noqa: PLR0913 - each option is a parameter
    route: Annotated[
        Path, typer.Argument(metavar="ROUTE", help="a route, as fgslam teach writes it")
    ],
    recording: Recording,
    camera: OmniCamera = None,
    out: Report = None,
    start: options.Start = None,
    stop: options.Stop = None,
    stride: options.Stride = None,
    overrides: options.Overrides = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Follow a route with another recording of the way: place, homing vector and command.

    What a robot would be commanded at each image, by the same follower; refusals with their reason.
    Exits with 1 where no image is recognised. Without --camera it is the route's own.
    """
    from fgslam.runs.bare import following

    chosen = options.of_recording(start=start, stop=stop, stride=stride)
    config = following(route, recording, camera, [*(overrides or ()), *chosen])
    _perform(config, out, overwrite)


def join(
    routes: Annotated[
        list[Path], typer.Argument(metavar="ROUTE...", help="routes, as fgslam teach writes them")
    ],
    out: Annotated[Path, typer.Option(metavar="MAP", help="the file to write, .fgmap")],
    report: Report = None,
    overrides: options.Overrides = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Join routes where their views match: one map, with crossroads.

    A place is called after its route's file and its image: monday/12. Routes may have been taught
    on different days; where they have nothing in common they stay apart, and that is reported.
    """
    from fgslam.runs.bare import joining

    config = joining(routes, out, overrides or ())
    _perform(config, report, overwrite)


def route(
    stored: Annotated[
        Path, typer.Argument(metavar="MAP", help="routes, as fgslam join writes them")
    ],
    start: Annotated[
        str,
        typer.Option(
            "--from", metavar="IMAGE", help="a picture from where the robot is, or a place's name"
        ),
    ],
    goal: Annotated[
        str, typer.Option("--to", metavar="PLACE", help="a place's name; of a route: its end")
    ],
    camera: OmniCamera = None,
    out: Annotated[
        Path | None, typer.Option(metavar="ROUTE", help="write the way as a route, to be followed")
    ] = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Say the shortest way on a map of routes, and write it as a route of its own.

    Without --camera the picture is of the routes' own. Exits with 2 where there is no way.
    """
    from fgslam.runs.bare import way_said

    for line in way_said(stored, start, goal, camera, out, overwrite):
        typer.echo(line)


def _perform(config: Experiment, folder: Path | None, overwrite: bool) -> None:
    from fgslam.runs.run import require_outputs, run_experiment

    place, existing = folder or Path("runs") / config.name, existing_folder(overwrite)
    require_outputs(config, place, existing)
    with under_way() as (progress, stopped):
        result = run_experiment(config, place, existing, progress, stopped)
    show_all([result], "the same command with --overwrite")
    exit_as([result])


# ------------------------------------------------------------------------------------------
# The command `fgslam sweep`


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
    from fgslam.runs.sweep import make_plan, run_sweep, workers_of

    existing = existing_folder(overwrite, resume)
    plan = make_plan(experiments, axes or (), None if estimators is None else estimators.split(","))
    folder = out or plan.default_folder
    with stop_flag() as stopped, progress_with_table() as (progress, shown):
        tell, pool = stoppable(progress, stopped), workers_of(jobs, scheduler)
        result = run_sweep(plan, folder, pool, existing, metric, (tell, stopped, shown))
    show_all([result], same_with_resume())
    exit_as([result])


EXIT_USER = 2
# Typer exports only the child; its parent's home differs from one Typer to the next.
_UsageError: type[typer.BadParameter] = typer.BadParameter.__bases__[0]
_OF_TYPER = 130  # what it makes of any KeyboardInterrupt; no command of ours returns it
_CLOSE_OPTIONS = 0.6  # typer offers --out for --foo

app = typer.Typer(
    name="fgslam",
    help="Stereo, trinocular and omnidirectional SLAM: filters and smoothers on one log.",
    pretty_exceptions_enable=False,
)


app.add_typer(camera_app, name="camera")
app.add_typer(calibrate_app, name="calibrate")


@app.callback()
def _root(version: options.Version = False) -> None:
    """Filters and smoothers on one measurement log."""


@app.command(epilog=f"Experiments that come with fgslam: {', '.join(experiment_names())}.")
def run(  # noqa: PLR0913 - each option is a parameter
    config: options.Experiment,
    out: options.RunFolder = None,
    camera: options.Camera = None,
    start: options.Start = None,
    stop: options.Stop = None,
    stride: options.Stride = None,
    fps: options.Fps = None,
    scale: options.Scale = None,
    unit: options.Unit = None,
    topics: options.Topics = None,
    estimator: options.Estimator = None,
    overrides: options.Overrides = None,
    overwrite: options.Overwrite = False,
    resume: options.Resume = False,
    map_in: options.MapIn = None,
    map_out: options.MapOut = None,
    camera_out: options.CameraOut = None,
    live: options.Live = False,
    save_rrd: options.SaveRrd = None,
) -> None:
    """Map a recording, or run an experiment: images in, run folder out.

    Of a recording the layout is recognised and printed; its odometry is used where it has some, and
    what is known of the truth only to judge. fgslam init prints the configuration that repeats it.

    With --map-in it begins in a saved map: map.start is where, map.extend whether it changes it.

    Ctrl-C ends it early with all files valid; --resume goes on from there.
    """
    from fgslam.runs.bare import experiment_of

    existing = existing_folder(overwrite, resume)
    chosen = options.of_recording(
        topics, start=start, stop=stop, stride=stride, fps=fps, scale=scale, unit_m=unit
    )
    steered = {"estimator.kind": estimator, "map.load": map_in, "map.save": map_out}
    chosen += options.as_overrides(steered)
    settings, about = experiment_of(config, camera, [*(overrides or ()), *chosen])
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
    with watched_by(settings, live, save_rrd) as watch, under_way() as (progress, stopped):
        result = run_experiment(settings, folder, existing, progress, stopped, watch)
    show_all([result], resume_command(folder))
    if camera_out is not None:
        typer.echo(corrected_camera(folder, camera_out))
    exit_as([result])


@app.command()
def init(  # noqa: PLR0913 - each option is a parameter
    recording: options.BareRecording,
    camera: options.Camera = None,
    start: options.Start = None,
    stop: options.Stop = None,
    stride: options.Stride = None,
    fps: options.Fps = None,
    scale: options.Scale = None,
    unit: options.Unit = None,
    topics: options.Topics = None,
    estimator: options.Estimator = None,
    overrides: options.Overrides = None,
) -> None:
    """Print the short configuration that repeats `fgslam run RECORDING`, as YAML."""
    from fgslam.runs.bare import short_config

    chosen = options.of_recording(
        topics, start=start, stop=stop, stride=stride, fps=fps, scale=scale, unit_m=unit
    )
    chosen += options.as_overrides({"estimator.kind": estimator})
    typer.echo(short_config(recording, camera, [*(overrides or ()), *chosen]), nl=False)


@app.command()
def demo(
    out: Annotated[
        Path, typer.Option(help="the run folder; replaced where it is there already")
    ] = Path("runs/demo"),
) -> None:
    """Drive the paper's loop through the rendered lab: the experiment lab_loop, in a minute.

    Needs no recording. The page it ends with, report.html, shows path, map and numbers.
    """
    run(find_experiment(Path("lab_loop")), out, overwrite=True)


@app.command()
def compare(  # noqa: PLR0913 - each option is a parameter
    runs: options.Runs,
    estimators: options.Estimators = None,
    overrides: options.EstimatorOverrides = None,
    out: options.Out = None,
    overwrite: options.OverwriteResults = False,
    resume: options.ResumeResults = False,
    jobs: options.Jobs = 1,
    trials: options.TrialCount = None,
    seed: options.FirstSeed = None,
) -> None:
    """Replay runs' measurements through estimators and set them side by side.

    Every estimator gets exactly the measurements that the run has logged. One that fails reports
    where and why; the others go on. With --trials the experiment is repeated with new noise, and
    paired tests say whether the smoothers beat the filters.

    Ctrl-C ends it early; the same command with --resume does what is left.
    """
    from fgslam.cli.console import show_parts
    from fgslam.core.errors import ConfigError
    from fgslam.runs.compare import Choice, ate_tables, compare_runs
    from fgslam.runs.trials import run_trials

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


app.command()(sweep)
app.command()(teach)
app.command()(follow)
app.command()(join)
app.command()(route)


@app.command()
def localize(  # noqa: PLR0913 - each option is a parameter
    map_file: options.SavedMap,
    recording: options.Recording,
    camera: options.Camera = None,
    start: options.Start = None,
    stop: options.Stop = None,
    stride: options.Stride = None,
    fps: options.Fps = None,
    scale: options.Scale = None,
    unit: options.Unit = None,
    topics: options.Topics = None,
    frame: Annotated[
        int | None,
        typer.Option(min=0, help="the recording's frame to locate; default all, one by one"),
    ] = None,
    frames: Annotated[
        int, typer.Option(min=1, max=100, help="locate a submap of so many frames, ending there")
    ] = 1,
    overrides: options.Overrides = None,
    out: Annotated[
        Path | None, typer.Option(help="folder for table, numbers, picture and page; default none")
    ] = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Where in a map were these frames taken? Without any prior.

    A pose is given only where it is certain, with the reasons. Exits with 3 where fewer than
    half of the queries were answered, with 2 where map or recording cannot be used.
    """
    from fgslam.runs.tasks.localisation import Wanted
    from fgslam.runs.tasks.localisation import localize as locate

    chosen = options.of_recording(
        topics, start=start, stop=stop, stride=stride, fps=fps, scale=scale, unit_m=unit
    )
    wanted = Wanted(
        map_file, recording, (*(overrides or ()), *chosen), frame, frames, out,
        existing_folder(overwrite), camera,
    )  # fmt: skip
    with under_way() as (progress, stopped):
        result = locate(wanted, progress, stopped)
    show_all([result])
    exit_as([result])


@app.command()
def export(  # noqa: PLR0913 - each option is a parameter
    run_folder: options.RunOrMap,
    map_file: Annotated[
        Path | None, typer.Option("--map", help="landmarks as .ply or .pcd")
    ] = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(help="camera poses as .tum, .kitti, .csv (EuRoC) or .mcap (ROS 2)"),
    ] = None,
    graph: Annotated[
        Path | None,
        typer.Option(help="measurements, poses and landmarks as .g2o, for other solvers"),
    ] = None,
    images: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="images, poses and points, for COLMAP"),
    ] = None,
    estimator: Annotated[
        str | None, typer.Option(help="which estimator's; default the one that steered")
    ] = None,
    valid_only: Annotated[
        bool, typer.Option("--valid-only", help="landmarks seen in at least three frames")
    ] = False,
    colour: Annotated[
        bool, typer.Option("--colour", help="--map in the images' colours, with normals")
    ] = False,
    overwrite: options.Overwrite = False,
) -> None:
    """Hand a run's map, trajectory and measurements to other tools; or those of a saved map.

    Of a saved map alone it lists what is in it.
    """
    from fgslam.runs.export import Wanted, export_run

    wanted = Wanted(
        map=map_file,
        trajectory=trajectory,
        graph=graph,
        images=images,
        estimator=estimator,
        valid_only=valid_only,
        colour=colour,
        overwrite=overwrite,
    )
    for line in export_run(run_folder, wanted):
        typer.echo(line)


app.command()(film)


@app.command()
def merge(
    first: options.FirstMap,
    second: options.SecondMap,
    out: Annotated[Path, typer.Option(metavar="MAP", help="where to write both as one")],
    overwrite: options.Overwrite = False,
) -> None:
    """Make two saved maps of one place into one; refuses what does not surely overlap."""
    from fgslam.runs.session import merge_files

    for line in merge_files(first, second, out, overwrite):
        typer.echo(line)


@app.command()
def view(
    run_folder: options.RunToView,
    save: Annotated[
        Path | None, typer.Option(help="write an .rrd file for the viewer instead of a window")
    ] = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Open a run in the rerun viewer, where that extra is installed."""
    from fgslam.runs.view import view_run

    typer.echo(view_run(run_folder, save, overwrite))


@app.command()
def inspect(  # noqa: PLR0913 - each option is a parameter
    recording: options.Recording,
    camera: options.Camera = None,
    start: options.Start = None,
    stop: options.Stop = None,
    stride: options.Stride = None,
    fps: options.Fps = None,
    scale: options.Scale = None,
    unit: options.Unit = None,
    topics: options.Topics = None,
    overrides: options.Overrides = None,
    frames: Annotated[
        int, typer.Option(min=1, help="in how many frames, evenly spread, features are matched")
    ] = 12,
) -> None:
    """Say what is in a recording, and what is wrong with it, in words.

    Exits with 0 whatever the report finds, with 2 where the recording cannot be opened at all.
    """
    from fgslam.cli.console import progress_bar
    from fgslam.runs.inspect import inspect_recording

    chosen = options.of_recording(
        topics, start=start, stop=stop, stride=stride, fps=fps, scale=scale, unit_m=unit
    )
    given = [*(overrides or ()), *chosen]
    with stop_flag() as stopped, progress_bar() as progress:
        watched = stoppable(progress, stopped)
        report = inspect_recording(recording, given, frames, watched, camera)
    typer.echo(report)


def _keep_close_options(error: Exception) -> None:
    """Of the options that are offered for an unknown one, keeps those that are spelled alike."""
    offered, given = getattr(error, "possibilities", None), getattr(error, "option_name", "")
    if offered:
        # Without dashes, which make any two options similar.
        names = {name.lstrip("-"): name for name in offered}
        close = get_close_matches(given.lstrip("-"), names, cutoff=_CLOSE_OPTIONS)
        error.possibilities = [names[name] for name in close]  # type: ignore[attr-defined]


def _performed(arguments: list[str]) -> int:
    """Exit status of a command. Raises what it raised, an interruption as KeyboardInterrupt."""
    with ShortageTold():
        status = int(app(arguments, prog_name="fgslam", standalone_mode=False) or 0)
    if status == _OF_TYPER and signals.was_asked():
        raise KeyboardInterrupt
    return status


def main() -> None:
    """Entry point: runs a command, turns a user's mistake into one line and exit status 2."""
    # None is used, and the search through all installed packages is a tenth of reading settings.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    # What is wrong with an image is reported here; what its header claims is not trusted.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", "100000000")
    arguments = sys.argv[1:] or ["--help"]
    signals.forget()
    try:
        raise SystemExit(_performed(arguments))
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
