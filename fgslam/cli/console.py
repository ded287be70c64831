"""What a person sees in the terminal: progress and the summary of a run."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from fgslam.runs.tasks.slam_summary import frame_problems, run_numbers

if TYPE_CHECKING:
    from fgslam.runs.tasks.slam import RunResult
    from fgslam.runs.tasks.slam_beginning import Progress as Tell

_PROBLEMS_SHOWN = 5


@contextmanager
def progress_bar() -> Iterator[Tell]:
    """A bar on standard error for each stage of the work."""
    columns = (
        TextColumn("{task.description:>10}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    bars = Progress(*columns, console=Console(stderr=True))
    tasks: dict[str, int] = {}

    def tell(what: str, done: int, total: int) -> None:
        if not tasks:
            bars.start()  # not before: a mistake found at once shall be all there is to read
        if what not in tasks:
            tasks[what] = int(bars.add_task(what, total=total))
        bars.update(tasks[what], completed=done, total=total)  # type: ignore[arg-type]

    try:
        yield tell
    finally:
        if tasks:
            bars.stop()


def show_result(result: RunResult, resume: str) -> None:
    """Summary table and where everything is; ``resume`` is what to type where it is unfinished."""
    console = Console()
    console.print(_table(result))
    for line in _remarks(result):
        console.out(line)
    folder = result.folder
    title = result.outputs.title
    # Paths are printed plain, so that they can be copied whatever the terminal's width.
    console.out(f"trajectory  {folder / title / 'final.tum'}")
    console.out(f"map         {folder / title / 'map.ply'}")
    if result.about_map:
        console.out(f"saved map   {result.about_map}")
    if result.pictures:
        console.out(f"pictures    {result.pictures[0].parent}{'/'}")
    console.out(f"metrics     {folder / 'metrics.json'}")
    compared = bool(result.outputs.config.compare)  # then named below the comparison
    if not compared and (folder / "report.html").is_file():
        console.out(f"report      {folder / 'report.html'}  (open it in a browser)")
    if result.status == "interrupted":
        console.out(f"interrupted after {len(result.outputs.recorder)} frames; go on: {resume}")


def _table(result: RunResult) -> Table:
    outputs, metrics = result.outputs, result.metrics
    numbers = run_numbers(outputs.recorder)
    remark = f"\n{outputs.remark}" if outputs.remark else ""
    table = Table(title=f"{outputs.config.name}: {outputs.title}{remark}", show_header=False)
    matches = numbers["landmark_matches"]
    rows: list[tuple[str, object]] = [
        ("frames", f"{len(outputs.recorder)} of {len(outputs.sequence)}"),
        ("pose found from", _counts(numbers["status_counts"])),
        ("landmarks", metrics.landmarks),
        ("landmarks matched, median (5 %)", _spread(matches)),
        ("ATE rms, SE3 aligned", _metres(metrics.ate_rmse_m)),
        ("RPE a frame", f"{_metres(metrics.rpe_trans_m)}, {_degrees(metrics.rpe_rot_deg)}"),
        ("end error, first pose aligned", _end(result)),
        ("end against start", _start(result)),
        ("drift", "unknown" if metrics.drift_percent is None else f"{metrics.drift_percent:.2f} %"),
        ("pose NEES per dof", _nees(result)),
        ("loop without SIFT, median", _milliseconds(numbers["loop_ms"])),
    ]
    for name, value in rows:
        table.add_row(name, str(value))
    return table


def _remarks(result: RunResult) -> list[str]:
    """What was tolerated: notes on the recording, and frames that could not be used."""
    problems = frame_problems(result.outputs.recorder)
    outputs = result.outputs
    lines = [*outputs.sequence.notes, *outputs.notes, *problems[:_PROBLEMS_SHOWN]]
    if len(problems) > _PROBLEMS_SHOWN:
        lines.append(f"and {len(problems) - _PROBLEMS_SHOWN} more such frames, see metrics.json")
    if not result.metrics.landmarks:
        lines.append("there is no landmark in the map; fgslam inspect says what ails the recording")
    return [f"note        {line}" for line in lines]


def _metres(value: float | None) -> str:
    if value is None:
        return "unknown"
    return f"{100.0 * value:.2f} cm" if value < 1.0 else f"{value:.3f} m"


def _degrees(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3f} deg"


def _counts(counts: object) -> str:
    if not isinstance(counts, dict):
        return "unknown"
    return ", ".join(f"{name} {count}" for name, count in counts.items())


def _spread(spread: object) -> str:
    if not isinstance(spread, dict):
        return "none"
    return f"{spread['median']:.0f} ({spread['p05']:.0f})"


def _milliseconds(times: object) -> str:
    known = isinstance(times, dict) and times["median"] is not None
    return f"{times['median']:.1f} ms" if known and isinstance(times, dict) else "unknown"


def _end(result: RunResult) -> str:
    metrics = result.metrics
    if metrics.end_error_m is None or len(result.outputs.recorder) < 2:
        return "unknown"
    return f"{_metres(metrics.end_error_m)}, {_degrees(metrics.end_error_deg)}"


def _start(result: RunResult) -> str:
    end = result.metrics.more.get("end_against_start")
    if not isinstance(end, dict) or len(result.outputs.recorder) < 2:
        return "unknown"
    # Adding zero turns -0.00 into 0.00.
    x, y, z = (f"{round(end[name], 2) + 0.0:.2f}" for name in ("x_cm", "y_cm", "z_cm"))
    yaw, pitch, roll = (
        f"{round(end[name], 2) + 0.0:.2f}" for name in ("yaw_deg", "pitch_deg", "roll_deg")
    )
    return f"{x}, {y}, {z} cm\nyaw {yaw}, pitch {pitch}, roll {roll} deg"


def _nees(result: RunResult) -> str:
    found = result.metrics.more.get("nees_pose")
    if not isinstance(found, dict):
        return "unknown"
    band = f"{found['lower']:.2f}-{found['upper']:.2f}"
    return f"{found['per_dof']:.1f}: {found['verdict']} (band {band})"
