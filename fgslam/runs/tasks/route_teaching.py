"""Task `teach`: path images are chosen from a recording and written as a route.

Files: route.fgpath, path_images.csv (which images, how far apart, and why), metrics.json, a sheet
of the path images, the page.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fgslam.core.errors import FrameError
from fgslam.core.files import make_subfolder
from fgslam.datasets.omni import OmniRecording
from fgslam.datasets.omni_checks import open_checked
from fgslam.evaluation.statistics import JsonValue
from fgslam.homing.route import FULL, GAP, Taught, TaughtImage, Teacher
from fgslam.homing.settings import DRIVING
from fgslam.report.content import Column, Figure, Picture, TextTable, write_csv
from fgslam.report.homing_figures import Line, curve_figure
from fgslam.runs.config_models import TeachConfig
from fgslam.runs.engine import (
    Context,
    Opening,
    RunResult,
    Task,
    provenance_of,
    write_document,
    write_page,
)
from fgslam.runs.tasks.route_poses import MetricDrive

ROUTE_FILE = "route.fgpath"
IMAGES_FILE = "path_images.csv"
PICTURES = "pictures"
_COLUMNS = (
    "path_image",
    "image",
    "name",
    "images_since_last",
    "reason",
    "common_features",
    "parallax_deg",
    "direction_deg",
    "sigma_direction_deg",
    "refusal",
)


def open_teaching(config: TeachConfig, opening: Opening) -> Task[RunResult]:
    """Opens the recording and checks its mirror. Raises DatasetError, or OutputError."""
    recording = open_checked(config.dataset)
    drive = None if config.poses is None else MetricDrive.load(Path(config.poses))
    if drive is not None:
        drive.require(recording)
    return Task(provenance_of(recording), lambda context: _run(config, recording, drive, context))


def _run(
    config: TeachConfig, recording: OmniRecording, drive: MetricDrive | None, context: Context
) -> RunResult:
    """Stopped early, the route ends where the recording was read to."""
    folder = context.folder
    teacher = Teacher(recording.camera, DRIVING, config.seed)
    whole = _teach(teacher, recording, context)
    if not whole and not teacher.begun:
        result = RunResult(config, folder, "interrupted", ("There is no route yet.",))
        write_document(result, {})
        return result
    taught = teacher.finish()
    if drive is not None:
        numbers = [row.number for row in taught.rows]
        metric = drive.at(recording.timestamps[numbers])
        taught = replace(taught, memory=replace(taught.memory, metric=metric))
    kilobytes = taught.memory.save(folder / ROUTE_FILE)
    written = folder / ROUTE_FILE if config.route is None else Path(config.route)
    if config.route is not None:
        taught.memory.save(written)
    write_csv(folder / IMAGES_FILE, _COLUMNS, list(_rows(taught)))
    said = _numbers(taught, len(recording), kilobytes)
    gaps = sum(row.reason == GAP for row in taught.rows)
    lines = _sentences(taught, len(recording), kilobytes, gaps)
    notes = (*recording.notes, *taught.unusable)
    result = RunResult(
        config, folder, "finished" if whole else "interrupted", lines, (_table(taught),), notes,
        (("route", str(written)),),
    )  # fmt: skip
    write_document(result, said)
    write_page(
        result,
        f"{len(taught.memory)} path images of {recording.name}",
        figures=(_figure(taught),),
        pictures=_sheet(folder, recording, taught, config.output.pictures),
    )
    return result


def _teach(teacher: Teacher, recording: OmniRecording, context: Context) -> bool:
    """Whether the whole recording was read."""
    last = len(recording) - 1
    for i in range(len(recording)):
        if context.stopped():
            return False
        if i >= teacher.next or i == last:
            try:
                teacher.take(i, recording.names[i], recording.image(i))
            except FrameError as error:
                teacher.leave_out(i, str(error))
        context.progress("teaching", i + 1, len(recording))
    return True


class _Row(NamedTuple):
    """A row of path_images.csv."""

    path_image: int
    image: int
    name: str
    since: int
    reason: str
    common: int | None
    parallax: float
    direction: float
    sigma: float
    refusal: str


def _rows(taught: Taught) -> list[_Row]:
    before = [taught.rows[0].number, *(row.number for row in taught.rows)]
    return [_row(k, row, row.number - before[k]) for k, row in enumerate(taught.rows)]


def _row(k: int, row: TaughtImage, since: int) -> _Row:
    common = row.common if k else None
    return _Row(
        k, row.number, row.name, since, row.reason, common, row.parallax_deg, row.direction_deg,
        row.sigma_deg, row.refusal,
    )  # fmt: skip


def _numbers(taught: Taught, recorded: int, kilobytes: float) -> dict[str, JsonValue]:
    reasons = Counter(row.reason for row in taught.rows)
    return {
        "path_images": len(taught.memory),
        "recorded_images": recorded,
        "compared_images": taught.seen,
        "kilobytes_per_image": kilobytes,
        "reasons": dict(sorted(reasons.items())),
        "with_poses": _with_poses(taught),
        "common_features_least": min((r.common for r in taught.rows if r.common), default=None),
    }


def _with_poses(taught: Taught) -> int | None:
    """Path images that have one; None for a route without metres."""
    metric = taught.memory.metric
    return None if metric is None else int(np.isfinite(metric.poses[:, 0, 3]).sum())


def _sentences(taught: Taught, recorded: int, kilobytes: float, gaps: int) -> tuple[str, ...]:
    said: tuple[str, ...] = (
        f"{len(taught.memory)} of {recorded} images are path images, {kilobytes:.1f} kB each "
        f"({taught.seen} were compared).",
    )
    posed = _with_poses(taught)
    if posed is not None:
        said = (*said, f"{posed} have a pose in metres.")
    if not gaps:
        return (*said, "Each is seen well from the one before.")
    return (
        *said,
        f"{gaps} have too little in common with the one before: a robot may lose its way there; "
        "take more images in between.",
    )


def _table(taught: Taught) -> TextTable:
    columns = (
        Column("image", "in the recording"),
        Column("since last", "images since the path image before"),
        Column("reason", "why it was chosen"),
        Column("common", "features in common with the path image before"),
        Column("parallax (deg)", "median of theirs"),
        Column("direction (deg)", "as seen from the path image before"),
    )
    rows = tuple(
        (
            str(row.path_image),
            (
                row.name,
                str(row.since),
                row.reason,
                "-" if row.common is None else str(row.common),
                _text(row.parallax),
                f"{_text(row.direction)} ± {_text(row.sigma)}" if np.isfinite(row.sigma) else "-",
            ),
        )
        for row in _rows(taught)
    )
    return TextTable("path_images", "The path images", "path image", columns, rows)


def _text(value: float) -> str:
    return f"{value:.1f}" if np.isfinite(value) else "-"


def _figure(taught: Taught) -> Figure:
    numbers = np.array([row.number for row in taught.rows], np.float64)
    common = np.array([row.common for row in taught.rows], np.float64)
    words = (
        "common",
        "Features in common with the path image before",
        "Each path image at its place in the recording; the first has none before it.",
    )
    lines = [Line("common features", 0, numbers[1:], common[1:])]
    return curve_figure(words, lines, ("image", "features"), y={"rangemode": "tozero"})


def _sheet(
    folder: Path, recording: OmniRecording, taught: Taught, most: int
) -> tuple[Picture, ...]:
    """The path images side by side; none where pictures are not wanted."""
    if most == 0:
        return ()
    from fgslam.report.pictures import draw_sheet  # Matplotlib takes a second

    titles = [
        f"{k}: {row.name}" + ("" if row.reason == FULL else f" ({row.reason})")
        for k, row in enumerate(taught.rows)
    ]
    path = make_subfolder(folder, PICTURES) / "path_images.png"
    draw_sheet(path, [recording.image(row.number) for row in taught.rows], titles)
    return (Picture("The path images, in their order", path.read_bytes()),)
