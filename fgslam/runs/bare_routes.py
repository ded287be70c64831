"""The experiments that `fgslam teach`, `follow` and `join` are; what `fgslam route` says."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from itertools import pairwise
from math import degrees, isnan
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fgslam.core.errors import CalibrationError, DatasetError, StoredMapError
from fgslam.core.files import require_output
from fgslam.runs.config import make_experiment
from fgslam.runs.config_models import Experiment

if TYPE_CHECKING:
    from fgslam.homing.links import Link
    from fgslam.homing.topological_map import MapPlace, RouteMap

_NOT_IN_NAMES = re.compile(r"[^\w.-]+")


def teaching(
    recording: Path, camera: str | None, route: Path, overrides: Iterable[str] = ()
) -> Experiment:
    """The experiment that teaches a route.

    Args:
        recording: a film, or a folder of pictures.
        camera: calibration file, or the kind of camera; of a mirror it must be given.
        route: the file to write.
        overrides: ``a.b=value``.

    Raises:
        FgslamError: recording or camera cannot be used.
    """
    if camera is None:
        raise CalibrationError(
            f"{recording}: no camera is given; add --camera FILE, its calibration, or --camera "
            "equirectangular for whole panoramas"
        )
    values = {
        "task": "teach",
        "name": f"teach_{_named(recording)}",
        "dataset": _dataset(recording, camera),
        "route": str(route),
    }
    return make_experiment(values, str(recording), overrides)


def following(
    route: Path, recording: Path, camera: str | None = None, overrides: Iterable[str] = ()
) -> Experiment:
    """The experiment that follows a route; ``camera`` None is the one that it was taught with.

    Raises:
        FgslamError: recording or camera cannot be used.
    """
    values = {
        "task": "follow",
        "name": f"follow_{_named(recording)}",
        "dataset": _dataset(recording, camera or "equirectangular"),
        "route": str(route),
        "taught_camera": camera is None,
    }
    return make_experiment(values, str(recording), overrides)


def joining(routes: Sequence[Path], out: Path, overrides: Iterable[str] = ()) -> Experiment:
    """The experiment that joins routes into the map ``out``. Raises ConfigError."""
    values = {
        "task": "join",
        "name": f"join_{_named(out)}",
        "routes": [str(route) for route in routes],
        "map": str(out),
    }
    return make_experiment(values, "join", overrides)


def way_said(
    stored: Path,
    start: str,
    goal: str,
    camera: str | None = None,
    out: Path | None = None,
    overwrite: bool = False,
) -> list[str]:
    """The shortest way on a map, in lines.

    Args:
        stored: the map's file.
        start: a picture from where the robot is, or the name of a place.
        goal: name of a place or a route.
        camera: of the picture; None: the routes' own.
        out: where the way is written as a route; None: nowhere.
        overwrite: replace a file that is there.

    Raises:
        FgslamError: file, picture or place cannot be used, or there is no way.
    """
    from fgslam.homing.topological_map import RouteMap  # loads arrays

    if out is not None:
        require_output(out, overwrite, (stored, Path(start)))
    joined = RouteMap.load(stored)
    lines = []
    if joined.knows(start):
        way = joined.way(start, goal)
    else:
        place = _place(joined, Path(start), camera)
        near = f"near {place.name}, {place.inliers} features in common"
        lines.append(f"{start}: {f'at {place.name}' if place.at else near}")
        way = joined.way(place, goal)
    lines += [f"{len(way)} path images:", *_legs(joined, way.names)]
    if out is not None:
        way.save(out)
        lines.append(f"written as a route: {out}")
    return lines


def _place(joined: RouteMap, picture: Path, camera: str | None) -> MapPlace:
    from fgslam.cameras.omni_files import load_camera
    from fgslam.core.homing import Refusal
    from fgslam.datasets.images import read_colour_image

    if not picture.is_file():
        raise StoredMapError(
            f"{picture}: neither a picture nor a place of the map; its places are "
            f"{joined.names[0]} to {joined.names[-1]}"
        )
    image = read_colour_image(picture)
    size = (image.shape[1], image.shape[0])
    place = joined.locate(image, None if camera is None else load_camera(camera, size))
    if isinstance(place, Refusal):
        raise StoredMapError(f"{picture}: {place.details}; go on a little, and take another one")
    return place


def _legs(joined: RouteMap, names: tuple[str, ...]) -> list[str]:
    """A line for each path image: its name, and where it lies as seen from the one before."""
    links = (joined.link(before, name) for before, name in pairwise(names))
    return [
        f"  {names[0]}",
        *(f"  {name}: {_seen(link)}" for name, link in zip(names[1:], links, strict=True)),
    ]


def _seen(link: Link) -> str:
    if not link.support:
        return "driven before, but without a homing vector"
    if isnan(link.direction):
        return "the same place"
    return f"at {round(degrees(link.direction))} degrees, {link.support} features in common"


def _named(recording: Path) -> str:
    return _NOT_IN_NAMES.sub("_", recording.resolve().stem).strip("_") or "recording"


def _dataset(recording: Path, camera: str) -> dict[str, Any]:
    from fgslam.cameras.omni_files import camera_keys  # loads arrays

    if not recording.exists():
        raise DatasetError(f"{recording}: no such film or folder; check the path")
    keys = camera_keys(camera)
    panoramas = keys["kind"] == "equirectangular"
    kind = "panoramas" if panoramas else "omni_path"
    if recording.is_file():
        kind = "omni_video"
    return {"kind": kind, "path": str(recording), "camera": keys}
