"""What a page of results shows, whichever task made it; colours and geometry of what is drawn.

Also the files of numbers in a run folder: metrics.json, timing.csv, any other table.
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import DatasetError
from fgslam.core.files import read_text, replacing, write_text
from fgslam.core.geometry import congruence
from fgslam.core.types import Remark
from fgslam.evaluation.statistics import EstimatorMetrics, JsonValue

if TYPE_CHECKING:
    from plotly import graph_objects as go


UNKNOWN = "-"
"""In the cell of a table whose value is not known."""


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a table: heading with unit, and what it means."""

    name: str
    meaning: str


@dataclass(frozen=True, slots=True)
class TextTable:
    """A table as it is read: values as text, their units in the headings.

    Attributes:
        key: unique in the page.
        heading: its title.
        first: heading of the rows' names.
        columns: m headings with their meanings.
        rows: name of each row and its m values; `-` where a value is not known.
    """

    key: str
    heading: str
    first: str
    columns: tuple[Column, ...] = ()
    rows: tuple[tuple[str, tuple[str, ...]], ...] = ()

    def __post_init__(self) -> None:
        for title, values in self.rows:
            if len(values) != len(self.columns):
                raise ValueError(
                    f"{title}: {len(values)} values in a table of {len(self.columns)} columns"
                )


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture next to the figures: PNG or JPEG, with a caption."""

    caption: str
    content: bytes = field(repr=False)


@dataclass(frozen=True, slots=True, eq=False)
class Figure:
    """A figure of the page.

    Attributes:
        key: unique in the page.
        heading: its title.
        description: what it shows, for those who see it and those who do not.
        drawing: Plotly's; its legend hides and shows what is drawn.
        note: what is not drawn, in words.
        missing: why it has no numbers, should it have none.
    """

    key: str
    heading: str
    description: str
    drawing: go.Figure
    note: str = ""
    missing: str = "nothing was recorded"

    @property
    def has_numbers(self) -> bool:
        """Whether anything but bands is drawn in it."""
        return any(trace.to_plotly_json().get("fill") != "toself" for trace in self.drawing.data)

    @property
    def is_tall(self) -> bool:
        """Whether it needs height: a plane of equal axes, panels over each other, or space."""
        layout = self.drawing.layout.to_plotly_json()
        return "scene" in layout or "yaxis3" in layout or "scaleanchor" in layout.get("yaxis", {})


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A drive that a slider moves along, in k steps.

    Attributes:
        colours: of the m paths.
        seconds: (k,) since the start.
        places: (m, k, 3) to the right, ahead and up, metres; NaN where not known.
        views: small JPEG images of the reference camera, by the step from which they are shown.
    """

    colours: tuple[str, ...]
    seconds: FloatArray
    places: FloatArray
    views: Mapping[int, bytes]


@dataclass(frozen=True, slots=True, eq=False)
class Page:
    """All that one page shows.

    Attributes:
        title, subtitle: headings.
        headline: sentences with the main results, most important first.
        notes: what was tolerated in the recording, warnings, in words.
        tables, figures, pictures: in the order of the page.
        failed: rows of the tables, and sentences of the headline, that are of what failed.
        remarks: of the estimators, in words; None where the page has no section for them.
        config_yaml: the resolved configuration, as text.
        versions: of the program and its libraries; None where one is not installed.
        about: names of what is compared, and what each is.
        commands: what one may type next.
        drive: moves the figures along; None where there is no path.
    """

    title: str
    subtitle: str
    headline: tuple[str, ...] = ()
    tables: tuple[TextTable, ...] = ()
    figures: tuple[Figure, ...] = ()
    pictures: tuple[Picture, ...] = ()
    failed: frozenset[str] = frozenset()
    notes: tuple[str, ...] = ()
    remarks: tuple[str, ...] | None = None
    config_yaml: str = ""
    versions: Mapping[str, str | None] = field(default_factory=dict)
    about: tuple[tuple[str, str], ...] = ()
    commands: tuple[str, ...] = ()
    drive: Drive | None = None


# --------------------------------------------------------------------------------------------
# Colours: Okabe and Ito's hues, which the colour-blind can tell apart. On white they are darker, on
# black lighter than the originals, for a contrast of at least 3 to 1 (WCAG 2.2, 1.4.11).

ON_LIGHT = (
    "#0072b2", "#c64f00", "#00805e", "#a8457f", "#8f6b00",
    "#5b4bb5", "#7a3e12", "#1f86bf", "#5f6b00", "#6a7480",
)  # fmt: skip
ON_DARK = (
    "#4aa8e8", "#f5803e", "#22c79a", "#e28cc0", "#e6b52e",
    "#a99cf2", "#d0966a", "#9bd6f7", "#b9c84a", "#b4bcc6",
)  # fmt: skip
COLOURS = len(ON_LIGHT)
"""How many series have a colour of their own; more share them."""

INK = "#1b1f24"
"""Of the truth and of text."""

GREY = "#a3abb4"
"""Of walls and landmarks."""

# --------------------------------------------------------------------------------------------
# Geometry of what is drawn

SIGMAS = 3.0
"""How many standard deviations an ellipse reaches."""

_CORNERS = 33
_FACTORS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
_BULK = (1.5, 98.5)


def level_axes(up: FloatArray) -> FloatArray:
    """Rotation (3, 3) from the world to (right, ahead, up)."""
    vertical = up / np.linalg.norm(up)
    # A camera whose x axis is near the vertical has no level x: then its z serves.
    first = np.array([1.0, 0.0, 0.0] if abs(vertical[0]) < 0.9 else [0.0, 0.0, 1.0])
    right = first - vertical * (vertical @ first)
    right /= np.linalg.norm(right)
    return np.array([right, np.cross(vertical, right), vertical])


def bulk_limits(path: FloatArray, *maps: FloatArray) -> list[list[float]]:
    """Limits along each of d axes: all of the path (n, d) and the bulk of every map (m, d).

    A few far landmarks of tiny disparity must not shrink the rest to a dot.
    """
    corners = [np.percentile(points, _BULK, axis=0) for points in maps if len(points)]
    everything = np.concatenate([path[np.isfinite(path).all(axis=1)], *corners])
    low, high = everything.min(axis=0), everything.max(axis=0)
    centre, half = 0.5 * (low + high), 0.53 * np.maximum(high - low, 0.2)
    limits: list[list[float]] = np.column_stack([centre - half, centre + half]).tolist()
    return limits


def peaks(values: FloatArray, limit: int) -> IntArray:
    """Rows of values (n,) so thinned that the largest of each part stays; NaN only if alone."""
    if len(values) <= limit:
        return np.arange(len(values))
    known = np.where(np.isnan(values), -np.inf, values)
    parts = np.array_split(known, limit)
    starts = np.cumsum([0, *(len(part) for part in parts[:-1])])
    return np.asarray(starts + np.array([int(np.argmax(part)) for part in parts]), np.int64)


def joined(polylines: FloatArray) -> FloatArray:
    """Polylines (k, m, d) as one (k (m + 1), d) with a gap (NaN) after each."""
    k, _, d = polylines.shape
    return np.concatenate([polylines, np.full((k, 1, d), np.nan)], axis=1).reshape(-1, d)


def world_position_covariances(poses: FloatArray, covariances: FloatArray) -> FloatArray:
    """Position covariances (k, 3, 3) in the world of poses with tangent covariances (k, 6, 6)."""
    return congruence(poses[:, :3, :3], covariances[:, 3:, 3:])


def in_plane(covariances: FloatArray, plane: FloatArray) -> FloatArray:
    """Covariances (k, 2, 2) in the plane whose axes are the rows of ``plane`` (2, 3)."""
    return congruence(np.broadcast_to(plane, (len(covariances), 2, 3)), covariances)


def outlines(centres: FloatArray, covariances: FloatArray, scale: float = 1.0) -> FloatArray:
    """Closed polylines (k, corners, 2) of SIGMAS standard deviations about centres (k, 2).

    Args:
        centres: (k, 2).
        covariances: (k, 2, 2); where one is not finite, its polyline is NaN.
        scale: enlarges all of them.
    """
    known = np.asarray(np.isfinite(covariances).all(axis=(1, 2)))
    variances, directions = np.linalg.eigh(np.where(known[:, None, None], covariances, 0.0))
    radii = SIGMAS * np.sqrt(np.maximum(variances, 0.0))
    angle = np.linspace(0.0, 2.0 * np.pi, _CORNERS)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    around = np.einsum("kij,kj,mj->kmi", directions, radii, circle)
    around[~known] = np.nan
    return np.asarray(centres[:, None] + scale * around)


def exaggeration(covariances: FloatArray, span: float) -> int:
    """Factor that makes the larger half of the ellipses at least 2 % of ``span`` wide."""
    if not len(covariances):
        return 1
    width = 2.0 * SIGMAS * np.sqrt(np.maximum(np.linalg.eigvalsh(covariances)[:, -1], 0.0))
    typical = float(np.percentile(width, 75.0))
    for factor in _FACTORS:
        if factor * typical >= 0.02 * span:
            return factor
    return 1 if typical == 0.0 else _FACTORS[-1]


# --------------------------------------------------------------------------------------------
# Files of numbers

Cell: TypeAlias = "str | bool | int | float | np.generic | None"


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Cell]]) -> None:
    """Writes a table: ten significant digits; empty where a value is None or not finite.

    Raises:
        ValueError: a row has not as many cells as there are columns.
        OutputError: the file cannot be written.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        if len(row) != len(columns):
            raise ValueError(f"{len(row)} cells in a table of {len(columns)} columns")
        writer.writerow([_text(cell) for cell in row])
    write_text(path, out.getvalue())


def write_parquet(
    path: Path, columns: Mapping[str, Sequence[Cell]], about: Mapping[str, str]
) -> None:
    """Writes a table as Parquet, atomically; equal values give equal bytes.

    Args:
        path: the file; `pandas.read_parquet` opens it.
        columns: n cells each, of one type; None where a value is not known.
        about: texts for the file's own metadata.

    Raises:
        OutputError: the file cannot be written.
    """
    import pyarrow
    from pyarrow import parquet

    table = pyarrow.table({name: pyarrow.array(cells) for name, cells in columns.items()})
    with replacing(path) as partial:
        parquet.write_table(table.replace_schema_metadata(about), partial, compression="zstd")


def read_table(
    path: Path,
    numbers: Iterable[str] | None = None,
    texts: Iterable[str] = (),
    *,
    known: Iterable[str] = (),
    whole: Iterable[str] = (),
    again: str = "run the experiment again",
) -> dict[str, npt.NDArray[Any]]:
    """Columns of a table that a run wrote: numbers as floats, NaN where not known, and texts.

    Args:
        path: the .csv file.
        numbers: columns of numbers that must be there; None: all of the file.
        texts: columns of texts that must be there.
        known: columns whose numbers must all be known.
        whole: columns of whole numbers.
        again: what to do where it is damaged.

    Raises:
        DatasetError: the file cannot be read, lacks a column, or has a cell that is no number.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            header, *rows = [row for row in csv.reader(file) if row] or [[]]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DatasetError(f"{path}: cannot be read ({error}); {again}") from error
    numbers = list(header if numbers is None else numbers)
    table: dict[str, npt.NDArray[Any]] = {}
    for column in (*numbers, *texts):
        if column not in header:
            raise DatasetError(f"{path}: lacks column {column}; {again}")
        at = header.index(column)
        short = next((k for k, row in enumerate(rows) if len(row) <= at), None)
        if short is not None:
            raise DatasetError(f"{path}, line {short + 2}: ends before column {column}; {again}")
        cells = np.array([row[at] for row in rows], np.object_)
        table[column] = cells
        if column not in numbers:
            continue
        values = np.array([_parsed(cell) for cell in cells], np.float64)
        wrong = np.isinf(values) | (np.isnan(values) & ((cells != "") | (column in known)))
        if column in whole:
            wrong |= values % 1.0 > 0.0
        if wrong.any():
            row = int(np.argmax(wrong))
            raise DatasetError(
                f"{path}, line {row + 2}: {column} is {cells[row][:40]!r}, not a number; {again}"
            )
        table[column] = values
    return table


def records(table: Mapping[str, npt.NDArray[Any]]) -> list[dict[str, Any]]:
    """The rows of a table: its columns' values by name."""
    return [dict(zip(table, row, strict=True)) for row in zip(*table.values(), strict=True)]


def _parsed(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return math.nan


def write_json(path: Path, document: Mapping[str, JsonValue]) -> None:
    """Writes a document; what is not finite becomes null. Raises OutputError."""
    write_text(path, json.dumps(plain(document), indent=2, allow_nan=False) + "\n")


def _text(cell: Cell) -> str:
    if isinstance(cell, np.generic):
        cell = cell.item()
    if cell is None or (isinstance(cell, float) and not math.isfinite(cell)):
        return ""
    if isinstance(cell, bool):
        return "true" if cell else "false"
    return f"{cell:.10g}" if isinstance(cell, float) else str(cell)


def write_metrics(
    path: Path,
    frames: int,
    estimators: Mapping[str, EstimatorMetrics],
    more: Mapping[str, JsonValue] | None = None,
) -> None:
    """Write metrics.json atomically; NaN and infinities become null, never a missing name.

    Args:
        path: the file.
        frames: number of frames processed.
        estimators: metrics by the estimator's kind.
        more: further values of the run as a whole.

    Raises:
        OutputError: the file cannot be written.
    """
    numbers = {kind: metrics.as_json() for kind, metrics in estimators.items()}
    write_json(path, {"frames": frames, **(more or {}), "estimators": numbers})


def read_metrics(path: Path) -> dict[str, Any]:
    """The metrics.json of a run of any task: :func:`write_metrics` wrote those of SLAM.

    Raises:
        DatasetError: the file is missing or is not one.
    """
    try:
        document = json.loads(read_text(path, remedy="check the path"))
    except ValueError as error:
        raise DatasetError(f"{path} is not JSON ({error}); run the experiment again") from error
    if isinstance(document, dict) and document.keys() & {"estimators", "task"}:
        estimators = document.get("estimators", {})
        if isinstance(estimators, dict) and all(isinstance(v, dict) for v in estimators.values()):
            return document
    raise DatasetError(f"{path} holds no metrics; give the metrics.json of a run folder")


def write_timing(path: Path, times: Iterable[tuple[int, float, str, float]]) -> None:
    """timing.csv: frame, timestamp (s), stage (`sift`, ...), milliseconds. Raises OutputError."""
    columns = ("frame", "timestamp", "stage", "milliseconds")
    rows = ((frame, f"{stamp:.9f}", stage, f"{ms:.4f}") for frame, stamp, stage, ms in times)
    write_csv(path, columns, rows)


def plain(value: Any) -> Any:
    """Plain JSON types: NumPy numbers unwrapped, what is not finite as None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def metres(value: float | None) -> str:
    """A length to be read: centimetres below a metre."""
    if value is None:
        return "unknown"
    return f"{100.0 * value:.2f} cm" if abs(value) < 1.0 else f"{value:.3f} m"


# --------------------------------------------------------------------------------------------
# Sentences of remarks: all of their words stand here

_BODY = (
    "something else moves in {count} frames, {span}: {percent:.0f} % of the matches there, between "
    "{low:.0f} and {high:.0f} % of the width, contradict the odometry; "
)
_ODOMETRY = "the odometry is wrong in {count} frames, {span}, which are located without it: "
_ERRS = {
    "odometry_reversed": "it is the motion backwards ({ratio:.2f} of the way that images show): "
    "give the pose now in the frame before, not its inverse",
    "odometry_scaled": "its ways are {ratio:.2f} +- {scatter:.2f} of those that images show "
    "(wheel radius, unit; or the rig's baseline is not as stated)",
    "odometry_slips": "images show other ways, by no factor that stays (the wheels slip, its "
    "clock (odometry.time_offset_s), or where the camera sits: dataset.camera_yaw_deg, "
    "dataset.lever_arm_m)",
    "odometry_stuck": "it states no motion while images show one",
    "odometry_turned": "its ways are {degrees:.0f} degrees off the direction in which images "
    "show them (the axes of its frame, or dataset.camera_yaw_deg)",
    "odometry_turns": "its turns are {ratio:.2f} +- {scatter:.2f} of those that images show "
    "(degrees or radians, the sign of the yaw, wheels that slip in turns; or the rig's focal "
    "length is not as stated)",
}
"""How odometry errs, by the code of a remark on it."""
_PREDICTED = "{fault}: {count} of {all} frames, {span}, are not used; their poses are predicted "
_WATCH = "--set frontend.watch_cameras=false uses them all"
_FASTEN = (
    "as points off their lines show: fasten it and calibrate the rig again; what is measured from "
    "there on may be wrong"
)
_NO_MATCHES = (
    "no stereo matches in the first {count} frames: {features:.0f} features in the right image, "
    "{matched:.0f} of them matched"
)
SENTENCES = {
    "body_fills_view": _BODY + "nothing else is in view there: the pose is by odometry alone",
    "body_moves": _BODY + "the pose follows odometry and the rest of the view",
    "bridged": "{named}: not located in the first map; in the final trajectory interpolated "
    "between the located frames around, where that is more certain than what the estimator knows",
    "camera_fault": _PREDICTED + "(mend the camera; " + _WATCH + ")",
    "camera_loose": "the {camera} camera is loose: it turned {count} times, by up to "
    "{degrees:.2f} degrees{against}, from about frame {first} to {last} of the run, " + _FASTEN,
    "camera_turned": "the {camera} camera was turned by {turns}{against} at about frame {first} "
    "of the run, " + _FASTEN,
    "cameras_swapped": _PREDICTED + "(swap their images; " + _WATCH + ")",
    "images_doubled": "{count} times all images are those of the frame before, to the bit, and "
    "then others: the recording has frames twice, whose poses are late (leave them out: --stride)",
    "images_out_of_order": "the images of {count} frames, {span}, are out of order: they jump to "
    "and fro, and fit the motion in another order (sort them by the time at which they were "
    "taken)",
    "left_out": "the first {count} frames could not be located: left out",
    "lost_bits": "{fault}",
    "no_features": _NO_MATCHES + "{left}; are the images dark, or 12-bit values in 16-bit images?",
    "no_matches": _NO_MATCHES + "{left}; are left and right swapped, or the images not rectified?",
    "no_matches_fault": _NO_MATCHES + "; {fault}",
    "one_image": "{fault}: {count} of {all} frames, {span}, are located by that image and begin no "
    "landmark (mend the camera; " + _WATCH + ")",
    **{code: _ODOMETRY + errs for code, errs in _ERRS.items()},
    "other_motion": "in {count} frames, {span}, something else moves rigidly, with up to "
    "{percent:.0f} % as many matches as the pose follows: something large passes. Without odometry "
    "the pose is uncertain where that fills more of the view than the scene, for it may follow "
    "what passes (leave these frames out: --start, --stop)",
    "pairs_unmatched": "right and left image have next to nothing in common in {count} frames, "
    "{span}: {features:.0f} features in the right image, {matched:.0f} of them matched; is one of "
    "them dark, covered, turned, mirrored, moved off its lines, or of another place or moment?",
    "rig_doubted": "the cameras seem to have moved against each other at about frame {first} of "
    "the run; too few frames have followed to decide it",
    "rig_loose": "the cameras move against each other, {count} times from about frame {first} of "
    "the run on: what is measured from there on may be wrong; fasten them and calibrate again",
    "rig_moved": "the cameras moved against each other at about frame {first} of the run: "
    "corrected from there on; fasten them and calibrate the rig again",
    "scale_doubted": "the odometry's ways are {ratio:.2f} of those that images show, and nothing "
    "in view shows which errs (wheel radius or unit; baseline or focal length of the rig): the "
    "covariances hold both",
    "scene_repeats": "the scene repeats itself in {count} frames, {span}: images fit several "
    "places alike, the pose is by odometry",
    "unconnected": "{named}: located relative to each other only, not in the first map; before is "
    "a gap that neither landmarks nor odometry bridge; {known} of {all} frames ({percent:.0f} %) "
    "are located in the first map",
    "unequal_exposure": "the {camera} images were darker or brighter than the right ones by more "
    "than a third of a stop in {count} of {all} frames; give all cameras one exposure time and "
    "gain",
    "witnesses_undecided": "odometry and images contradict each other in {count} frames, {span}, "
    "and nothing in view shows which errs; the pose follows the images, its covariance holds both",
}
"""By the code of a :class:`~fgslam.core.types.Remark`."""


def sentence(remark: Remark | str) -> str:
    """A remark in words; what is in words already, as it is."""
    if isinstance(remark, str):
        return remark
    of_frames: dict[str, float | str] = {}
    if frames := remark.frames:
        n, first, last = len(frames), frames[0], frames[-1]
        span = f"from {first} to {last}" if n > 1 else f"frame {first}"
        of_frames = {"count": n, "first": first, "last": last, "span": span}
        of_frames["named"] = f"{n} frames {span}" if n > 1 else span
    text = SENTENCES[remark.code]
    if errs := remark.values.get("errs"):  # which of the two errs is open
        text += "; if the odometry errs, " + _ERRS[str(errs)]
    return text.format(**of_frames, **remark.values)
