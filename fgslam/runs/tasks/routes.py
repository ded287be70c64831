"""Tasks `teach`, `follow` and `join`: routes of an omnidirectional camera.

`teach` chooses path images from a recording: route.fgpath, path_images.csv, a sheet of them.
`follow` takes a recording along a route, image by image as a robot would: follow.csv.
`join` makes routes one map where their views match: routes.fgmap, links.csv. Each of them writes
metrics.json and the page.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.core.arrays import FloatArray, nearest_rows
from fgslam.core.bearings import OmniFeatures
from fgslam.core.errors import CalibrationError, ConfigError, DatasetError, FrameError
from fgslam.core.geometry import wrap
from fgslam.core.types import Trajectory, read_covariances
from fgslam.datasets.omni import OmniRecording, camera_notes
from fgslam.datasets.opening import open_checked, open_omni
from fgslam.datasets.times import covered, interpolate_poses
from fgslam.evaluation.statistics import JsonValue
from fgslam.homing.api import PathFollower
from fgslam.homing.links import Pair
from fgslam.homing.places import PictureSides
from fgslam.homing.route import FULL, GAP, MetricPoses, PathMemory, Taught, Teacher
from fgslam.homing.settings import DRIVING, HomingBehaviourSettings
from fgslam.homing.steering import SURE, DriveCommand
from fgslam.homing.topological_map import FEATURES, VECTOR, Answered, RouteMap, route_of
from fgslam.report.content import Column, Figure, Picture, TextTable, write_csv
from fgslam.report.homing_figures import Line, curve_figure
from fgslam.runs.config import FollowConfig, JoinConfig, TeachConfig
from fgslam.runs.engine import Context, Opening, RunResult, Task, provenance_of
from fgslam.runs.results import (
    draw_picture,
    finish,
    median,
    number_text,
    numbers_table,
    write_document,
)
from fgslam.runs.tasks.homing_views import PairSearch, answer_pairs, map_figure, write_links

ROUTE_FILE = "route.fgpath"
FOLLOW_FILE = "follow.csv"
MAP_FILE = "routes.fgmap"
_LONGEST_GAP_S = 1.0  # between two frames: beyond, the path between them is not a straight line
_SAME_TIME_S = 0.05  # beyond the first or last frame: half the time between two images
_RATE_HZ = 10.0  # of images without times
_JUMP_DEG = 30.0
_SIDES_ASKED = 12  # pictures of a recording, at most, that are looked at from all sides
_NUMBER = re.compile(r"-?\d+(\.\d+)?(e-?\d+(\.\d+)?)?")

# --------------------------------------------------------------------------------------------
# Task `teach`


def open_teaching(config: TeachConfig, opening: Opening) -> Task[RunResult]:
    """Opens the recording and checks its mirror. Raises DatasetError, or OutputError."""
    recording = open_checked(config.dataset)
    metric = None if config.poses is None else metric_poses(Path(config.poses), recording)
    ground = provenance_of(recording)
    return Task(ground, lambda context: _run_teaching(config, recording, metric, context))


def _run_teaching(
    config: TeachConfig, recording: OmniRecording, metric: MetricPoses | None, context: Context
) -> RunResult:
    """Stopped early, the route ends where the recording was read to."""
    folder = context.folder
    teacher = Teacher(recording.camera, DRIVING, config.seed)
    done = 0
    for i in context.steps("teaching", range(len(recording))):
        done = i + 1
        if i >= teacher.next or i == len(recording) - 1:
            try:
                teacher.take(i, recording.names[i], recording.image(i))
            except FrameError as error:
                teacher.leave_out(i, str(error))
    whole = done == len(recording)
    if not whole and not teacher.begun:
        return _nothing_yet(config, folder, "There is no route yet.")
    taught = teacher.finish()
    if metric is not None:
        chosen = [row.number for row in taught.rows]
        metric = MetricPoses(metric.poses[chosen], metric.covariances[chosen])
        taught = replace(taught, memory=replace(taught.memory, metric=metric))
    kilobytes = taught.memory.save(folder / ROUTE_FILE)
    written = folder / ROUTE_FILE if config.route is None else Path(config.route)
    if config.route is not None:
        taught.memory.save(written)
    rows = _path_image_rows(taught)
    write_csv(folder / "path_images.csv", _PATH_IMAGE_COLUMNS, rows)
    numbers: dict[str, JsonValue] = {
        "path_images": len(taught.memory),
        "recorded_images": len(recording),
        "compared_images": taught.seen,
        "kilobytes_per_image": kilobytes,
        "reasons": dict(sorted(Counter(row.reason for row in taught.rows).items())),
        "with_poses": None if metric is None else int(np.isfinite(metric.poses[:, 0, 3]).sum()),
        "common_features_least": min((r.common for r in taught.rows if r.common), default=None),
    }
    lines = [
        f"{len(rows)} of {len(recording)} images are path images, {kilobytes:.1f} kB each "
        f"({taught.seen} were compared)."
    ]
    if metric is not None:
        lines.append(f"{numbers['with_poses']} have a pose in metres.")
    gaps = sum(row.reason == GAP for row in taught.rows)
    lines.append(
        f"{gaps} have too little in common with the one before: a robot may lose its way there; "
        "take more images in between."
        if gaps
        else "Each is seen well from the one before."
    )
    places = np.array([row.number for row in taught.rows], np.float64)
    common = np.array([row.common for row in taught.rows], np.float64)
    figure = curve_figure(
        (
            "common",
            "Features in common with the path image before",
            "Each path image at its place in the recording; the first has none before it.",
        ),
        [Line("common features", 0, places[1:], common[1:])],
        ("image", "features"),
        y={"rangemode": "tozero"},
    )
    return finish(
        config,
        folder,
        whole,
        numbers,
        f"{len(rows)} path images of {recording.name}",
        (figure,),
        _sheet(folder, recording, taught) if config.output.pictures else (),
        lines=tuple(lines),
        tables=(_path_image_table(rows),),
        notes=(*recording.notes, *taught.unusable),
        particulars=(("route", str(written)),),
    )


def _nothing_yet(config: TeachConfig | JoinConfig, folder: Path, why: str) -> RunResult:
    result = RunResult(config, folder, "interrupted", (why,))
    write_document(result, {})
    return result


_PATH_IMAGE_COLUMNS = (
    "path_image", "image", "name", "images_since_last", "reason", "common_features",
    "parallax_deg", "direction_deg", "sigma_direction_deg", "refusal",
)  # fmt: skip


def _path_image_rows(taught: Taught) -> list[tuple[Any, ...]]:
    numbers = [row.number for row in taught.rows]
    since = np.diff(numbers, prepend=numbers[0]).tolist()
    return [
        (
            k, row.number, row.name, since[k], row.reason, row.common if k else None,
            row.parallax_deg, row.direction_deg, row.sigma_deg, row.refusal,
        )
        for k, row in enumerate(taught.rows)
    ]  # fmt: skip


def _path_image_table(rows: Sequence[tuple[Any, ...]]) -> TextTable:
    columns = (
        Column("image", "in the recording"),
        Column("since last", "images since the path image before"),
        Column("reason", "why it was chosen"),
        Column("common", "features in common with the path image before"),
        Column("parallax (deg)", "median of theirs"),
        Column("direction (deg)", "as seen from the path image before"),
        Column("sigma (deg)", "its standard deviation"),
    )
    shown = tuple((str(row[0]), tuple(number_text(v, ".1f") for v in row[2:9])) for row in rows)
    return TextTable("path_images", "The path images", "path image", columns, shown)


def _sheet(folder: Path, recording: OmniRecording, taught: Taught) -> tuple[Picture, ...]:
    """The path images side by side."""
    from fgslam.report.overlays import draw_sheet

    titles = [
        f"{k}: {row.name}" + ("" if row.reason == FULL else f" ({row.reason})")
        for k, row in enumerate(taught.rows)
    ]
    images = [recording.image(row.number) for row in taught.rows]
    draw = partial(draw_sheet, images=images, titles=titles)
    caption = "The path images, in their order"
    return (draw_picture(folder, "path_images.png", caption, draw),)


def metric_poses(path: Path, recording: OmniRecording) -> MetricPoses:
    """Where the images of a recording were taken, by SLAM on the same drive and clock.

    Args:
        path: of a TUM file; the covariance.csv of its run next to it is read, too.
        recording: of the drive.

    Returns:
        Poses, with the covariance of the nearest frame; NaN beyond the drive, and where not known.

    Raises:
        DatasetError: a file is missing or malformed, they are not of one run, or the recording was
            not taken during the drive.
    """
    trajectory, times = Trajectory.load(path), recording.timestamps
    stamps, every = trajectory.timestamps, np.full((len(trajectory), 6, 6), np.nan)
    file = path.parent / "covariance.csv"
    if file.is_file():
        of_run, every = read_covariances(file)
        if len(of_run) != len(stamps) or not np.allclose(of_run, stamps, rtol=0, atol=1e-6):
            raise DatasetError(
                f"{file}: not the poses' of {path.name}; give the run's final.tum, or a copy of "
                "the trajectory in a folder of its own"
            )
    if trajectory.frame == "body":
        raise DatasetError(
            f"{path}: {trajectory.named}, whose axes are not known here; give a camera's, by "
            "fgslam export RUN --frame right --trajectory FILE into a folder of its own"
        )
    if not np.isfinite(times).all():
        raise DatasetError(
            f"{recording.name}: its images have no times, which poses are found by; put a list "
            "times.txt next to them: name, seconds"
        )
    known = covered(stamps, times, _LONGEST_GAP_S, _SAME_TIME_S)
    if not known.any():
        raise DatasetError(
            f"{path}: from {stamps[0]:.3f} to {stamps[-1]:.3f} s, but {recording.name} from "
            f"{times[0]:.3f} to {times[-1]:.3f} s; both need times of one clock"
        )
    poses, covariances = (np.full((len(times), n, n), np.nan) for n in (4, 6))
    poses[known] = interpolate_poses(trajectory, times[known])
    covariances[known] = every[nearest_rows(stamps, times[known])]
    return MetricPoses(poses, covariances)


# ------------------------------------------------------------------------------------------
# Task `follow`


def open_following(config: FollowConfig, opening: Opening) -> Task[RunResult]:
    """Opens route and recording. Raises StoredMapError, DatasetError or CalibrationError."""
    path = PathMemory.load(config.route)
    recording = recording_along(config, path)
    notes = camera_notes(recording, stated=not config.taught_camera)
    recording = replace(recording, notes=recording.notes + notes)
    ground = provenance_of(recording) | {"log": {"route": config.route, "images": len(path)}}
    return Task(ground, lambda context: _run_following(config, path, recording, context))


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


def _run_following(
    config: FollowConfig, path: PathMemory, recording: OmniRecording, context: Context
) -> RunResult:
    """Stopped early, the images so far count."""
    folder, count = context.folder, len(recording)
    behaviour = HomingBehaviourSettings(steering=config.steering)
    sides = PictureSides(recording.camera, path, DRIVING, config.seed)
    commands: dict[int, DriveCommand] = {}
    left_out: dict[int, str] = {}  # images that are damaged, or of another size, and why
    rows: list[list[Any]] = []
    with PathFollower(
        recording.camera, path, behaviour=behaviour, seed=config.seed, by="looks"
    ) as follower:
        for i in context.steps("following", range(count)):
            stamp = float(recording.timestamps[i])
            time = stamp if np.isfinite(stamp) else i / _RATE_HZ
            # An epoch's time has more digits than a table's numbers.
            row = [int(recording.ids[i]), recording.names[i], f"{time:.9f}"]
            try:
                image = recording.image(i)
                if not sides.settled and not i % max(1, count // _SIDES_ASKED):
                    mistake = sides.look(image)
                    if mistake is not None:
                        raise CalibrationError(
                            f"{recording.name}: the pictures fit the route only as if they were "
                            f"{mistake}"
                        )
                commands[i] = follower.step(image, time)
                rows.append([*row, *_cells(path, commands[i])])
            except FrameError as error:
                left_out[i] = str(error)
                cells = dict(zip(_FOLLOW_COLUMNS, row, strict=False), refusal=str(error))
                rows.append([cells.get(name) for name in _FOLLOW_COLUMNS])
    write_csv(folder / FOLLOW_FILE, _FOLLOW_COLUMNS, rows)
    numbers = _follow_numbers(list(commands.values()), count)
    names = {
        "images": "images",
        "place known": "sure",
        "homing vector": "with_vector",
        "features of it, median": "inliers_median",
        f"turns by more than {_JUMP_DEG:g} degrees": "jumps",
    }
    tables = [numbers_table("follow", "The recording on the route", numbers, names)]
    unknown = [c.reason for c in commands.values() if not _has_vector(c)]
    # Reasons with their numbers as n.
    kinds = Counter(_NUMBER.sub("n", reason.split(":")[0]) for reason in unknown)
    kinds += Counter({"damaged or of another size": len(left_out)})
    if kinds:
        refused = tuple((kind, (str(number),)) for kind, number in kinds.most_common())
        columns = (Column("images", "refused for it"),)
        heading = "Images without a homing vector"
        tables.append(TextTable("refusals", heading, "reason", columns, refused))
    return finish(
        config,
        folder,
        len(rows) == count,
        numbers,
        f"{len(commands)} images of {recording.name} along {len(path)} path images",
        _follow_figures(commands),
        lines=_follow_sentences(numbers, path),
        tables=tuple(tables),
        notes=(*recording.notes, *left_out.values()),
        particulars=(("table", str(folder / FOLLOW_FILE)),),
        failed=not numbers["sure"],
    )


_FOLLOW_COLUMNS = (
    "image", "name", "time_s", "path_image", "path_image_name", "probability", "target",
    "direction_deg", "sigma_direction_deg", "rotation_deg", "sigma_rotation_deg", "correlation",
    "inliers", "remaining", "v_mps", "omega_deg_s", "state", "refusal", "x_m", "y_m", "z_m",
    "sigma_position_m", "to_target_m",
)  # fmt: skip


def _cells(path: PathMemory, command: DriveCommand) -> list[Any]:
    """A row of follow.csv after image, name and time."""
    cells: list[Any] = [None] * 4
    metres: list[Any] = [None] * 5
    inliers = None
    if (place := command.place) is not None:
        cells = [place.nearest, None, place.probability, place.target]
        if place.nearest is not None:
            cells[1] = path.names[place.nearest]
        if place.vector is not None:
            inliers = place.vector.support
        if (metric := place.metric) is not None:
            metres = [*metric.position.tolist(), metric.sigma, metric.to_target]
    homing, known = command.homing, _has_vector(command)
    sigma = np.sqrt(np.diag(homing.covariance)[1:])
    return [
        *cells,
        np.rad2deg(command.heading) if known else None,
        np.rad2deg(sigma[0]),
        np.rad2deg(homing.rotation),
        np.rad2deg(sigma[1]),
        homing.covariance[1, 2] / (sigma[0] * sigma[1]) if known else None,
        inliers,
        command.remaining if known else None,
        command.v,
        np.rad2deg(command.omega),
        command.state.value,
        "" if known else command.reason,
        *metres,
    ]


def _has_vector(command: DriveCommand) -> bool:
    return bool(np.isfinite(np.diag(command.homing.covariance)[1:]).all())


def _directions(commands: Sequence[DriveCommand]) -> FloatArray:
    """(n,) to the next path image, radians; NaN where it is refused."""
    return np.array([c.heading if _has_vector(c) else np.nan for c in commands])


def _follow_numbers(commands: Sequence[DriveCommand], recorded: int) -> dict[str, Any]:
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
        "inliers_median": median([p.vector.support for p in places if p.vector]),
    }


def _follow_sentences(numbers: Mapping[str, Any], path: PathMemory) -> tuple[str, ...]:
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


def _follow_figures(commands: Mapping[int, DriveCommand]) -> list[Figure]:
    placed = {i: c.place for i, c in commands.items() if c.place is not None}
    images, every = (np.array(list(of), np.float64) for of in (placed, commands))
    nearest = np.array([p.nearest if p.sure else np.nan for p in placed.values()])
    target = np.array([p.target if p.sure else np.nan for p in placed.values()], np.float64)
    chance = np.array([100.0 * p.probability for p in placed.values()])
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
# Task `join`


def open_joining(config: JoinConfig, opening: Opening) -> Task[RunResult]:
    """Opens the routes. Raises StoredMapError or ConfigError."""
    routes = {Path(one).stem: PathMemory.load(one) for one in config.routes}
    if len(routes) < len(config.routes):
        name, _ = Counter(Path(one).stem for one in config.routes).most_common(1)[0]
        raise ConfigError(f"routes: two files are called {name}, as their routes; rename one")
    ground = {"log": {name: len(path) for name, path in routes.items()}}
    return Task(ground, lambda context: _run_joining(config, routes, context))


def _run_joining(
    config: JoinConfig, routes: Mapping[str, PathMemory], context: Context
) -> RunResult:
    """Stopped early there is no map: what is missing might be the crossroads."""
    folder, failures = context.folder, list[str]()
    stages = iter(("pairs", "ways back"))

    def ask(images: tuple[OmniFeatures, ...], pairs: Sequence[Pair]) -> Mapping[Pair, Answered]:
        search = PairSearch(images, tuple(pairs), FEATURES.matching, VECTOR, config.seed)
        found, failed = answer_pairs(search, context, next(stages))
        failures.extend(failed)
        return {(one.a, one.b): (one.found, one.rows) for one in found}

    joined = RouteMap.join(routes, seed=config.seed, ask=ask)
    if context.stopped():
        return _nothing_yet(config, folder, "There is no map yet.")
    joined.save(folder / MAP_FILE)
    written = folder / MAP_FILE if config.map is None else Path(config.map)
    if config.map is not None:
        joined.save(written)
    write_links(folder, joined)
    # Links between images of two routes, by the routes' names.
    ends = [[route_of(joined.names[k]) for k in (m.a, m.b)] for m in joined.links]
    meetings = Counter(f"{first} and {second}" for first, second in ends if first != second)
    parts = joined.components()
    numbers: dict[str, JsonValue] = {
        "nodes": len(joined),
        "links": len(joined.links),
        "links_between_routes": meetings.total(),
        "crossroads": len(joined.crossroads),
        "components": len(parts),
        "largest_component": len(parts[0]),
    }
    lines = (
        f"{len(joined)} path images are joined by {meetings.total()} links between routes; "
        f"{len(joined.crossroads)} are linked with more than two others.",
        "Every place can be reached from every other one."
        if len(parts) == 1
        else f"There are {len(parts)} parts without a way between them: teach a route that meets "
        "both.",
    )
    column = Column("links", "whose homing vectors agree, and that third views confirm")
    rows = tuple((names, (str(count),)) for names, count in meetings.items())
    table = TextTable("meetings", "Where routes meet", "routes", (column,), rows)
    return finish(
        config,
        folder,
        True,
        numbers,
        f"{len(joined)} path images of {len(routes)} routes",
        (map_figure(joined),),
        lines=lines,
        tables=(table,),
        notes=tuple(failures),
        particulars=(("map", str(written)),),
    )
