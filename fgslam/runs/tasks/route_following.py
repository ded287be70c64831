"""Task `follow`: a recording along a taught route, image by image as a robot would be told.

Files: follow.csv (place, homing vector, command or refusal of each image), metrics.json, the page.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace

import numpy as np

from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import CalibrationError, FrameError
from fgslam.core.planar import wrap
from fgslam.datasets.omni import OmniRecording
from fgslam.datasets.omni_checks import camera_notes
from fgslam.datasets.opening import open_omni
from fgslam.evaluation.statistics import JsonValue
from fgslam.homing.api import PathFollower
from fgslam.homing.places import PictureSides
from fgslam.homing.route import PathMemory
from fgslam.homing.settings import DRIVING, HomingBehaviourSettings
from fgslam.homing.steering import SURE, DriveCommand, MetricPlace
from fgslam.report.content import Cell, Column, Figure, TextTable, write_csv
from fgslam.report.homing_figures import Line, curve_figure
from fgslam.runs.config_models import FollowConfig
from fgslam.runs.engine import (
    Context,
    Opening,
    RunResult,
    Task,
    provenance_of,
    write_document,
    write_page,
)

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
