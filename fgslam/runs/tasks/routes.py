"""Task `teach`: path images are chosen from a recording and written as a route.

Files: route.fgpath, path_images.csv (which images, how far apart, and why), metrics.json, a sheet
of the path images, the page.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fgslam.core.arrays import FloatArray, Image
from fgslam.core.bearings import OmniFeatures
from fgslam.core.errors import CalibrationError, ConfigError, DatasetError, FrameError
from fgslam.core.files import make_subfolder
from fgslam.core.geometry import wrap
from fgslam.core.types import Trajectory, read_covariances
from fgslam.datasets.omni import OmniRecording
from fgslam.datasets.omni_checks import camera_notes, open_checked
from fgslam.datasets.opening import open_omni
from fgslam.datasets.times import covered, interpolate_poses, nearest_rows
from fgslam.evaluation.statistics import JsonValue
from fgslam.homing.api import PathFollower
from fgslam.homing.links import Pair
from fgslam.homing.places import PictureSides
from fgslam.homing.route import FULL, GAP, MetricPoses, PathMemory, Taught, TaughtImage, Teacher
from fgslam.homing.settings import DRIVING, HomingBehaviourSettings
from fgslam.homing.steering import SURE, DriveCommand, MetricPlace
from fgslam.homing.topological_map import FEATURES, VECTOR, Answered, Asker, RouteMap, route_of
from fgslam.report.content import Cell, Column, Figure, Picture, TextTable, write_csv
from fgslam.report.homing_figures import Line, curve_figure
from fgslam.runs.config import FollowConfig, JoinConfig, TeachConfig
from fgslam.runs.engine import (
    Context,
    Opening,
    RunResult,
    Task,
    provenance_of,
    write_document,
    write_page,
)
from fgslam.runs.tasks.homing_views import PairSearch, answer_pairs, map_figure, write_links

# ------------------------------------------------------------------------------------------
# Task `follow`: a recording along a taught route, image by image as a robot would be told

FOLLOW_FILE = "follow.csv"
COLUMNS = (
    "image",
    "name",
    "time_s",
    "path_image",
    "path_image_name",
    "probability",
    "target",
    "direction_deg",
    "sigma_direction_deg",
    "rotation_deg",
    "sigma_rotation_deg",
    "correlation",
    "inliers",
    "remaining",
    "v_mps",
    "omega_deg_s",
    "state",
    "refusal",
    "x_m",
    "y_m",
    "z_m",
    "sigma_position_m",
    "to_target_m",
)
_RATE_HZ = 10.0  # of images without times
_JUMP_DEG = 30.0
_SIDES_ASKED = 12  # pictures of a recording, at most, that are looked at from all sides
_NUMBER = re.compile(r"-?\d+(\.\d+)?(e-?\d+(\.\d+)?)?")


def open_following(config: FollowConfig, opening: Opening) -> Task[RunResult]:
    """Opens route and recording. Raises StoredMapError, DatasetError or CalibrationError."""
    path = PathMemory.load(config.route)
    recording = recording_along(config, path)
    notes = camera_notes(recording, stated=not config.taught_camera)
    recording = replace(recording, notes=recording.notes + notes)
    ground = provenance_of(recording) | {"log": {"route": config.route, "images": len(path)}}
    return Task(ground, lambda context: _run(config, path, recording, context))


def recording_along(config: FollowConfig, path: PathMemory) -> OmniRecording:
    """The recording, of its own camera or of the one that the route was taught with.

    Raises:
        DatasetError: it cannot be opened.
        CalibrationError: the route holds no camera, or one of another size.
    """
    recording = open_omni(config.dataset)
    if not config.taught_camera:
        return recording
    camera, given = path.camera, recording.camera
    if camera is None:
        raise CalibrationError(
            f"{config.route}: holds no camera; give the recording's own, --camera FILE"
        )
    if (camera.width, camera.height) != (given.width, given.height):
        raise CalibrationError(
            f"{recording.name}: pictures have {given.width}x{given.height} pixels, but the route "
            f"was taught with {camera.width}x{camera.height}; give their own camera, --camera FILE"
        )
    return replace(recording, camera=camera)


def _run(
    config: FollowConfig, path: PathMemory, recording: OmniRecording, context: Context
) -> RunResult:
    """Stopped early, the images so far count."""
    folder = context.folder
    commands, left_out = _follow(config, path, recording, context)
    whole = len(commands) + len(left_out) == len(recording)
    rows = {i: _row(i, recording, path, command) for i, command in commands.items()}
    rows |= {i: _row_left_out(i, recording, why) for i, why in left_out.items()}
    write_csv(folder / FOLLOW_FILE, COLUMNS, [rows[i] for i in sorted(rows)])
    numbers = _numbers(list(commands.values()), len(recording))
    result = RunResult(
        config, folder, "finished" if whole else "interrupted", _sentences(numbers, path),
        (_table(numbers), *_refusals(list(commands.values()), len(left_out))),
        (*recording.notes, *left_out.values()),
        (("table", str(folder / FOLLOW_FILE)),), failed=not numbers["sure"],
    )  # fmt: skip
    write_document(result, numbers)
    write_page(
        result,
        f"{len(commands)} images of {recording.name} along {len(path)} path images",
        figures=tuple(_figures(commands)),
    )
    return result


def _follow(
    config: FollowConfig, path: PathMemory, recording: OmniRecording, context: Context
) -> tuple[dict[int, DriveCommand], dict[int, str]]:
    """Commands by image, and by image why it was left out: damaged, or of another size."""
    behaviour = HomingBehaviourSettings(steering=config.steering)
    commands: dict[int, DriveCommand] = {}
    left_out: dict[int, str] = {}
    sides = PictureSides(recording.camera, path, DRIVING, config.seed)
    with PathFollower(
        recording.camera, path, behaviour=behaviour, seed=config.seed, by="looks"
    ) as follower:
        for i in range(len(recording)):
            if context.stopped():
                break
            try:
                image = recording.image(i)
                _require_right_side(sides, i, image, recording)
                commands[i] = follower.step(image, _time(recording, i))
            except FrameError as error:
                left_out[i] = str(error)
            context.progress("following", i + 1, len(recording))
    return commands, left_out


def _require_right_side(
    sides: PictureSides, i: int, image: Image, recording: OmniRecording
) -> None:
    """Raises CalibrationError where pictures, some all along, fit the route only otherwise."""
    if sides.settled or i % max(1, len(recording) // _SIDES_ASKED):
        return
    mistake = sides.look(image)
    if mistake is not None:
        raise CalibrationError(
            f"{recording.name}: the pictures fit the route only as if they were {mistake}"
        )


def _time(recording: OmniRecording, i: int) -> float:
    seconds = float(recording.timestamps[i])
    return seconds if np.isfinite(seconds) else i / _RATE_HZ


def _stamp(seconds: float) -> str:
    """The time as a cell: an epoch's has more digits than a table's numbers."""
    return f"{seconds:.9f}"


def _row(i: int, recording: OmniRecording, path: PathMemory, command: DriveCommand) -> list[Cell]:
    place, homing = command.place, command.homing
    sigma = np.sqrt(np.diag(homing.covariance)[1:])
    known = bool(np.isfinite(sigma).all())
    nearest = None if place is None else place.nearest
    return [
        int(recording.ids[i]),
        recording.names[i],
        _stamp(command.time),
        nearest,
        None if nearest is None else path.names[nearest],
        None if place is None else place.probability,
        None if place is None else place.target,
        np.rad2deg(command.heading) if known else None,
        np.rad2deg(sigma[0]),
        np.rad2deg(homing.rotation),
        np.rad2deg(sigma[1]),
        homing.covariance[1, 2] / (sigma[0] * sigma[1]) if known else None,
        None if place is None or place.vector is None else place.vector.support,
        command.remaining if known else None,
        command.v,
        np.rad2deg(command.omega),
        command.state.value,
        "" if known else command.reason,
        *_metres(None if place is None else place.metric),
    ]


def _row_left_out(i: int, recording: OmniRecording, why: str) -> list[Cell]:
    """Nothing is told to the robot after such an image."""
    cells: dict[str, Cell] = {
        "image": int(recording.ids[i]),
        "name": recording.names[i],
        "time_s": _stamp(_time(recording, i)),
        "refusal": why,
    }
    return [cells.get(column) for column in COLUMNS]


def _metres(metric: MetricPlace | None) -> list[Cell]:
    if metric is None:
        return [None] * 5
    return [*metric.position.tolist(), metric.sigma, metric.to_target]


# --------------------------------------------------------------------------------------------
# What is said


def _numbers(commands: list[DriveCommand], recorded: int) -> dict[str, JsonValue]:
    places = [c.place for c in commands if c.place is not None]
    sure = [p for p in places if p.sure]
    directions = _directions(commands)
    jumps = np.abs(np.rad2deg(wrap(np.diff(directions[np.isfinite(directions)]))))
    return {
        "images": len(commands),
        "recorded_images": recorded,
        "sure": len(sure),
        "in_metres": sum(p.metric is not None for p in places),
        "with_vector": int(np.isfinite(directions).sum()),
        "first_path_image": sure[0].nearest if sure else None,
        "last_path_image": sure[-1].nearest if sure else None,
        "end_reached": any(p.reached for p in places),
        "jumps": int((jumps > _JUMP_DEG).sum()),
        "steps": len(jumps),
        "inliers_median": _median([p.vector.support for p in places if p.vector]),
    }


def _directions(commands: list[DriveCommand]) -> FloatArray:
    """(n,) to the next path image, radians; NaN where it is refused."""
    known = [bool(np.isfinite(c.homing.covariance[1, 1])) for c in commands]
    return np.array([c.heading if k else np.nan for c, k in zip(commands, known, strict=True)])


def _median(values: list[int]) -> float | None:
    return float(np.median(values)) if values else None


def _sentences(numbers: dict[str, JsonValue], path: PathMemory) -> tuple[str, ...]:
    if not numbers["sure"]:
        return (
            f"Not one of {numbers['images']} images is recognised on the route: is it the way that "
            "was taught, and the right camera?",
        )
    end = "is reached" if numbers["end_reached"] else "is not reached"
    return (
        f"The place is known (probability {SURE:g}) in {numbers['sure']} of {numbers['images']} "
        f"images, from path image {numbers['first_path_image']} to {numbers['last_path_image']} of "
        f"0 to {len(path) - 1}; the end {end}.",
        f"{numbers['with_vector']} images have a homing vector to the next path image; it turns by "
        f"more than {_JUMP_DEG:g} degrees from one to the next {numbers['jumps']} times.",
        *([] if path.metric is None else [f"{numbers['in_metres']} have a place in metres."]),
    )


def _table(numbers: dict[str, JsonValue]) -> TextTable:
    rows = (
        ("images", "images"),
        ("place known", "sure"),
        ("homing vector", "with_vector"),
        ("features of it, median", "inliers_median"),
        ("turns by more than 30 degrees", "jumps"),
    )
    cells = tuple((name, ("-" if numbers[k] is None else f"{numbers[k]:g}",)) for name, k in rows)
    return TextTable("follow", "The recording on the route", "", (Column("", "number"),), cells)


def _refusals(commands: list[DriveCommand], left_out: int) -> tuple[TextTable, ...]:
    """Why images have no homing vector, numbers in the reasons as n; none where all have."""
    unknown = [c for c in commands if not np.isfinite(c.homing.covariance[1, 1])]
    kinds = Counter(_NUMBER.sub("n", c.reason.split(":")[0]) for c in unknown)
    kinds += Counter({"damaged or of another size": left_out})
    if not kinds:
        return ()
    rows = tuple((kind, (str(count),)) for kind, count in kinds.most_common())
    columns = (Column("images", "refused for it"),)
    return (TextTable("refusals", "Images without a homing vector", "reason", columns, rows),)


def _figures(commands: dict[int, DriveCommand]) -> list[Figure]:
    placed = {i: c.place for i, c in commands.items() if c.place is not None}
    images = np.array(list(placed), np.float64)
    nearest = np.array([p.nearest if p.sure else np.nan for p in placed.values()])
    target = np.array([p.target if p.sure else np.nan for p in placed.values()], np.float64)
    chance = np.array([100.0 * p.probability for p in placed.values()])
    every = np.array(list(commands), np.float64)
    direction = np.rad2deg(_directions(list(commands.values())))
    where = ("place", "Place on the route", "Nearest path image and the next one to go to, where "
             "the place is known.")  # fmt: skip
    sure = ("probability", "Probability of the place", "That the path image, or the one before or "
            "after it, is the nearest one.")  # fmt: skip
    to = ("direction", "Direction to the next path image", "From the robot's heading, to the left "
          "positive; a gap is a refusal.")  # fmt: skip
    two = [Line("nearest", 0, images, nearest), Line("next", 1, images, target, "dot")]
    return [
        curve_figure(where, two, ("image", "path image")),
        curve_figure(sure, [Line("probability", 0, images, chance)], ("image", "percent")),
        curve_figure(to, [Line("direction", 0, every, direction)], ("image", "degrees")),
    ]


# ------------------------------------------------------------------------------------------
# Task `join`: taught routes become one map, joined where their views match

MAP_FILE = "routes.fgmap"


def open_joining(config: JoinConfig, opening: Opening) -> Task[RunResult]:
    """Opens the routes. Raises StoredMapError or ConfigError."""
    routes = {Path(one).stem: PathMemory.load(one) for one in config.routes}
    if len(routes) < len(config.routes):
        name, _ = Counter(Path(one).stem for one in config.routes).most_common(1)[0]
        raise ConfigError(f"routes: two files are called {name}, as their routes; rename one")
    ground = {"log": {name: len(path) for name, path in routes.items()}}
    return Task(ground, lambda context: _join_run(config, routes, context))


def _join_run(config: JoinConfig, routes: Mapping[str, PathMemory], context: Context) -> RunResult:
    """Stopped early there is no map: what is missing might be the crossroads."""
    folder, failures = context.folder, list[str]()
    joined = RouteMap.join(routes, seed=config.seed, ask=_asker(config.seed, context, failures))
    if context.stopped():
        result = RunResult(config, folder, "interrupted", ("There is no map yet.",))
        write_document(result, {})
        return result
    joined.save(folder / MAP_FILE)
    written = folder / MAP_FILE if config.map is None else Path(config.map)
    if config.map is not None:
        joined.save(written)
    write_links(folder, joined.topology)
    meetings = _meetings(joined)
    numbers = _join_numbers(joined, meetings)
    result = RunResult(
        config, folder, "finished", _join_sentences(joined, numbers), (_join_table(meetings),),
        tuple(failures), (("map", str(written)),),
    )  # fmt: skip
    write_document(result, numbers)
    figures = (map_figure(joined.topology),)
    write_page(result, f"{len(joined)} path images of {len(routes)} routes", figures=figures)
    return result


def _asker(seed: int, context: Context, failures: list[str]) -> Asker:
    """Homing vectors found in processes; what went wrong there is added to ``failures``."""
    names = iter(("pairs", "ways back"))

    def ask(images: tuple[OmniFeatures, ...], pairs: Sequence[Pair]) -> Mapping[Pair, Answered]:
        search = PairSearch(images, tuple(pairs), FEATURES.matching, VECTOR, seed)
        found, failed = answer_pairs(search, context, next(names))
        failures.extend(failed)
        return {(one.a, one.b): (one.found, one.rows) for one in found}

    return ask


def _meetings(joined: RouteMap) -> dict[tuple[str, str], int]:
    """Links between images that do not follow each other on a route, by the routes' names."""
    counts: Counter[tuple[str, str]] = Counter()
    for link in joined.topology.links:
        first, second = (route_of(joined.names[k]) for k in (link.a, link.b))
        if first != second:
            counts[first, second] += 1
    return dict(counts)


def _join_numbers(
    joined: RouteMap, meetings: Mapping[tuple[str, str], int]
) -> dict[str, JsonValue]:
    parts = joined.topology.components()
    return {
        "nodes": len(joined),
        "links": len(joined.topology.links),
        "links_between_routes": sum(meetings.values()),
        "crossroads": len(joined.crossroads),
        "components": len(parts),
        "largest_component": len(parts[0]),
    }


def _join_sentences(joined: RouteMap, numbers: Mapping[str, JsonValue]) -> tuple[str, ...]:
    said = (
        f"{len(joined)} path images are joined by {numbers['links_between_routes']} links between "
        f"routes; {numbers['crossroads']} are linked with more than two others.",
    )
    if numbers["components"] == 1:
        return (*said, "Every place can be reached from every other one.")
    return (
        *said,
        f"There are {numbers['components']} parts without a way between them: teach a route that "
        "meets both.",
    )


def _join_table(meetings: Mapping[tuple[str, str], int]) -> TextTable:
    rows = tuple((f"{a} and {b}", (str(count),)) for (a, b), count in meetings.items())
    column = Column("links", "whose homing vectors agree, and that third views confirm")
    return TextTable("meetings", "Where routes meet", "routes", (column,), rows)


# ------------------------------------------------------------------------------------------
# Poses of a SLAM run for the path images of the same drive, by the same clock

COVARIANCES = "covariance.csv"
_LONGEST_GAP_S = 1.0  # between two frames: beyond, the way between them is not a straight line
_SAME_TIME_S = 0.05  # beyond the first or last frame: half the time between two images


@dataclass(frozen=True, slots=True, eq=False)
class MetricDrive:
    """Where a drive's SLAM was when.

    Attributes:
        trajectory: of the reference camera.
        covariances: (n, 6, 6) of its poses; NaN where not known.
        where: the file.
    """

    trajectory: Trajectory
    covariances: FloatArray
    where: str

    @staticmethod
    def load(path: Path) -> MetricDrive:
        """A TUM file, and the covariance.csv of its run beside it if there is one.

        Raises:
            DatasetError: a file is missing or malformed, or they are not of one run.
        """
        trajectory = Trajectory.load(path)
        beside = path.parent / COVARIANCES
        if not beside.is_file():
            return MetricDrive(trajectory, np.full((len(trajectory), 6, 6), np.nan), str(path))
        stamps, covariances = read_covariances(beside)
        if len(stamps) != len(trajectory) or not np.allclose(
            stamps, trajectory.timestamps, rtol=0, atol=1e-6
        ):
            raise DatasetError(
                f"{beside}: not the poses' of {path.name}; give the run's final.tum, or a copy of "
                "the trajectory in a folder of its own"
            )
        return MetricDrive(trajectory, covariances, str(path))

    def require(self, recording: OmniRecording) -> None:
        """Raises DatasetError where the recording was not taken during the drive."""
        times = recording.timestamps
        if not np.isfinite(times).all():
            raise DatasetError(
                f"{recording.name}: its images have no times, which poses are found by; put a list "
                "times.txt beside them: name, seconds"
            )
        if not self._covered(times).any():
            first, last = self.trajectory.timestamps[[0, -1]]
            raise DatasetError(
                f"{self.where}: from {first:.3f} to {last:.3f} s, but {recording.name} from "
                f"{times[0]:.3f} to {times[-1]:.3f} s; both need times of one clock"
            )

    def at(self, times: FloatArray) -> MetricPoses:
        """Poses at times (n,), with the covariance of the nearest frame; NaN beyond the drive."""
        known = self._covered(times)
        poses, covariances = (
            np.full((len(times), 4, 4), np.nan),
            np.full((len(times), 6, 6), np.nan),
        )
        poses[known] = interpolate_poses(self.trajectory, times[known])
        rows = nearest_rows(self.trajectory.timestamps, times[known])
        covariances[known] = self.covariances[rows]
        return MetricPoses(poses, covariances)

    def _covered(self, times: FloatArray) -> np.typing.NDArray[np.bool_]:
        return covered(self.trajectory.timestamps, times, _LONGEST_GAP_S, _SAME_TIME_S)


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
    return Task(
        provenance_of(recording), lambda context: _teach_run(config, recording, drive, context)
    )


def _teach_run(
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
    said = _teach_numbers(taught, len(recording), kilobytes)
    gaps = sum(row.reason == GAP for row in taught.rows)
    lines = _teach_sentences(taught, len(recording), kilobytes, gaps)
    notes = (*recording.notes, *taught.unusable)
    result = RunResult(
        config, folder, "finished" if whole else "interrupted", lines, (_teach_table(taught),),
        notes, (("route", str(written)),),
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
    return [_teach_row(k, row, row.number - before[k]) for k, row in enumerate(taught.rows)]


def _teach_row(k: int, row: TaughtImage, since: int) -> _Row:
    common = row.common if k else None
    return _Row(
        k, row.number, row.name, since, row.reason, common, row.parallax_deg, row.direction_deg,
        row.sigma_deg, row.refusal,
    )  # fmt: skip


def _teach_numbers(taught: Taught, recorded: int, kilobytes: float) -> dict[str, JsonValue]:
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


def _teach_sentences(taught: Taught, recorded: int, kilobytes: float, gaps: int) -> tuple[str, ...]:
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


def _teach_table(taught: Taught) -> TextTable:
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
