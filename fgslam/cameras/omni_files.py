"""Omnidirectional cameras from calibration files and from settings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, TypeAlias, get_args

import numpy as np

from fgslam.cameras.formats import is_camchain, is_camodocal
from fgslam.cameras.lenses import RawCamera
from fgslam.cameras.omni import (
    Cylinder,
    Equirectangular,
    HyperbolicMirror,
    LensCamera,
    MirrorFrame,
    OmniCamera,
    RadialPolynomial,
    fit_radial_polynomial,
    read_ocamcalib,
)
from fgslam.cameras.rig import read_calibration_file
from fgslam.cameras.settings import (
    BloggieSettings,
    CylinderSettings,
    EquirectangularSettings,
    HyperbolicMirrorSettings,
    LensSettings,
    OCamCalibSettings,
    OmniCameraKind,
    PlacedMirrorSettings,
    RadialPolynomialSettings,
    VerticalSettings,
)
from fgslam.cameras.trees import flat_numbers, read_tree
from fgslam.core.errors import CalibrationError, shortened
from fgslam.core.files import as_path, read_lines, read_text
from fgslam.core.settings import make_settings
from fgslam.core.yaml_text import read_yaml

Size = tuple[int, int]


def load_camera(
    source: str | Path | Mapping[str, Any] | OmniCameraKind, size: tuple[int, int] | None = None
) -> OmniCamera:
    """An omnidirectional camera from a calibration file, or from the keys of its model.

    Args:
        source: the path of an OCamCalib result file (``calib_results.txt``), of a camera of
            camodocal (MEI) or Kalibr whose middle points down, of BloggieUnwarp's ``settings.txt``
            or of a YAML file of keys (of fgslam's .json, which does not say how the camera is
            mounted: ``kind: lens``, ``file``, ``middle``, ``clockwise``); or the keys themselves,
            as under ``dataset.camera`` of an experiment: ``{"kind": "mirror", "xi": 0.92}``; or the
            kind alone:
            ``"equirectangular"``, ``"cylinder"``, ``"mirror"``, ``"radial_polynomial"``.
        size: width and height of the images, pixels; None where the calibration states it.

    Raises:
        CalibrationError: the file is missing or malformed, its values are impossible, or it is for
            images of another size; no size is given and the calibration has none.
        ConfigError: a key or its value is wrong.
    """
    pair = size if isinstance(size, list | tuple) and len(size) == 2 else ()
    if size is not None and not (pair and all(isinstance(n, int | np.integer) for n in pair)):
        raise CalibrationError(
            f"camera: size is {size!r}; give (width, height) of the images in pixels"
        )
    if isinstance(source, str | Path):
        source, folder = _read(source)
        return make_camera(source, size, folder)
    return make_camera(_settings_of(source), size)


def camera_keys(source: str | Path) -> dict[str, Any]:
    """The keys that describe the camera of a file, or a kind alone, as under ``dataset.camera``.

    Raises:
        CalibrationError: the file is missing or malformed.
        ConfigError: a key or its value is wrong.
    """
    settings, folder = _read(source)
    keys = {name: value for name, value in asdict(settings).items() if value is not None}
    if folder is not None and "file" in keys:
        keys["file"] = str(folder / keys["file"])
    return keys


def make_camera(
    settings: OmniCameraKind, image_size: Size | None, folder: Path | None = None
) -> OmniCamera:
    """The camera that the settings describe, for images of a size (width, height).

    Args:
        settings: one kind of camera.
        image_size: width and height of the images; None where the calibration states it.
        folder: of the recording; calibration files are looked for there first.

    Raises:
        CalibrationError: the values are impossible, a file is missing or malformed, or the
            pictures have another size than was calibrated.
    """
    match settings:
        case EquirectangularSettings() | CylinderSettings():
            top, bottom = np.deg2rad([settings.top_elevation_deg, settings.bottom_elevation_deg])
            size = _stated_size(settings.kind, None, image_size)
            if isinstance(settings, EquirectangularSettings):
                return Equirectangular(*size, float(top), float(bottom))
            return Cylinder(*size, float(np.tan(bottom)), float(np.tan(top)))
        case HyperbolicMirrorSettings():
            frame = _frame(settings, _stated_size("mirror", settings.size, image_size))
            inner, outer = settings.inner_elevation_deg, settings.outer_elevation_deg
            view = math.radians(inner), math.radians(outer)
            given = settings.ring_px, settings.focal_px
            return HyperbolicMirror.with_view(frame, settings.xi, view, *given)
        case OCamCalibSettings():
            raw, ring = _ocamcalib(_find(settings.file, folder), image_size)
            return _vertical(raw, settings, ring)
        case LensSettings():
            path = _find(settings.file, folder)
            raw, *others = read_calibration_file(path).cameras
            if others:
                raise CalibrationError(
                    f"{path}: is of {1 + len(others)} cameras, an omnidirectional camera is one; "
                    "leave only that one in the file"
                )
            if image_size not in (None, raw.size):
                raise CalibrationError(
                    f"{path} calibrates pictures of {raw.width}x{raw.height}, but the pictures "
                    f"have {image_size[0]}x{image_size[1]} pixels; scale them, or calibrate again"
                )
            return _vertical(raw, settings)
        case RadialPolynomialSettings():
            size = _stated_size(settings.kind, settings.size, image_size)
            frame = _frame(settings, size)
            coefficients = tuple(np.deg2rad(settings.coefficients_deg).tolist())
            return RadialPolynomial(frame, *settings.ring_px, coefficients=coefficients)
        case BloggieSettings():
            return _bloggie(_find(settings.file, folder), image_size)


def _read(source: str | Path) -> tuple[OmniCameraKind, Path | None]:
    """Settings in or for a file, and its folder; of a bare kind its defaults."""
    path = as_path(source, CalibrationError, "camera")
    if str(source) in _KINDS and not path.is_file():
        return _KINDS[str(source)](), None
    if not path.is_file():
        raise CalibrationError(
            f"camera: there is no file {path}, and no such kind of camera; give a calibration "
            f"file, or one of {', '.join(_KINDS)}"
        )
    if path.suffix.lower() in (".yaml", ".yml"):
        tree = read_tree(path)
        if tree is not None and "kind" not in tree and (is_camodocal(tree) or is_camchain(tree)):
            return LensSettings(file=path.name), path.parent
        if read_text(path, CalibrationError).startswith("%YAML:"):
            raise CalibrationError(
                f"{path} is written by OpenCV, of no omnidirectional camera that is read; give "
                "OCamCalib's result, camodocal's of one camera (MEI), or a YAML file of keys with "
                f"a kind, one of {', '.join(_KINDS)}"
            )
        return _settings_of(read_yaml(path, CalibrationError), str(path)), path.parent
    if path.suffix.lower() == ".json":
        raise CalibrationError(
            f"{path} does not say how the camera is mounted; give the .yaml that names it, as "
            f"`fgslam calibrate omni` writes: kind: lens, file: {path.name}, middle: up or down, "
            "clockwise: true or false"
        )
    if any(line.startswith("INPUT_WIDTH") for _, line in read_lines(path, CalibrationError)):
        return BloggieSettings(file=path.name), path.parent
    return OCamCalibSettings(file=path.name), path.parent


def _settings_of(source: object, where: str = "camera") -> OmniCameraKind:
    if isinstance(source, OmniCameraKind):
        return source
    kind = _KINDS.get(str(source.get("kind"))) if isinstance(source, Mapping) else None
    if not isinstance(source, Mapping) or kind is None:
        raise CalibrationError(
            f"{where}: {shortened(repr(source))} describes no omnidirectional camera; give a "
            f"calibration file, or keys with a kind, one of {', '.join(_KINDS)}"
        )
    return make_settings(kind, {str(key): value for key, value in source.items()}, "camera")


_KINDS: dict[str, type[OmniCameraKind]] = {kind.kind: kind for kind in get_args(OmniCameraKind)}


def _frame(mirror: PlacedMirrorSettings, size: Size) -> MirrorFrame:
    centre = mirror.centre or ((size[0] - 1) / 2.0, (size[1] - 1) / 2.0)
    return MirrorFrame(*size, centre, math.radians(mirror.ahead_deg), mirror.clockwise)


def _vertical(
    raw: RawCamera, settings: VerticalSettings, ring: tuple[float, float] | None = None
) -> LensCamera:
    ahead, up = math.radians(settings.ahead_deg), settings.middle == "up"
    return LensCamera.of(raw, settings.ring_px or ring, up, ahead, settings.clockwise)


def _ocamcalib(path: Path, size: Size | None) -> tuple[RawCamera, tuple[float, float] | None]:
    """The camera for pictures cropped as calibrated, or not yet, and the ring of its mirror."""
    raw, ring, (left, right) = read_ocamcalib(path)
    wide = (raw.width + left + right, raw.height)
    if size not in (None, raw.size, wide):
        uncropped = f" (or {wide[0]}x{wide[1]} uncropped)" if left + right else ""
        raise CalibrationError(
            f"{path} calibrates pictures of {raw.width}x{raw.height}{uncropped}, but the picture "
            f"has {size[0]}x{size[1]} pixels; scale or crop it back, or calibrate again"
        )
    if size == wide:
        shift = np.array([[0.0, 0.0, left], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
        raw = replace(raw, width=wide[0], matrix=raw.matrix + shift)
    return raw, ring


def _stated_size(kind: str, calibrated: Size | None, size: Size | None) -> Size:
    stated = size or calibrated
    if stated is None:
        raise CalibrationError(
            f"camera ({kind}) states no size; give that of its images, size=(width, height)"
        )
    if calibrated not in (None, stated):
        raise CalibrationError(
            f"camera ({kind}) is calibrated for {calibrated[0]}x{calibrated[1]} pixels, but the "
            f"pictures have {stated[0]}x{stated[1]}; give the calibration at this size"
        )
    return stated


def _find(file: str, folder: Path | None) -> Path:
    local = None if folder is None else folder / file
    if local is not None and local.is_file():
        return local
    if not Path(file).is_file():
        also = "" if local is None else f", nor {local}"
        raise CalibrationError(f"camera.file: there is no calibration {file}{also}; give its path")
    return Path(file)


# --------------------------------------------------------------------------------------------
# Sony Bloggie with its 360 degree accessory

# Radius (0 at the inner, 1 at the outer rim) over the panorama's height (0 above), as measured on a
# grid by Golan Levin (BloggieUnwarp, 2010): 0.1850 y^2 + 0.8184 y - 0.0028.
_LEVIN = (-0.0028, 0.8184, 0.1850)
_BLOGGIE_VIEW_DEG, _ABOVE_HORIZON = 60.0, 0.8
"""Vertical field of view, and its part above the horizon: assumed, no calibration is published."""
_BLOGGIE_KEYS = (
    *("INPUT_WIDTH", "INPUT_HEIGHT", "OPTICAL_CENTER_X", "OPTICAL_CENTER_Y"),
    *("MAX_R_PERCENT", "MIN_R_PERCENT", "ANGLE_SHIFT"),
)


def _bloggie(path: Path, size: Size | None) -> RadialPolynomial:
    """The camera of a settings file of BloggieUnwarp: the panorama's middle is ahead."""
    values = _bloggie_values(path)
    width, height = values["INPUT_WIDTH"], values["INPUT_HEIGHT"]
    size = size or (int(width), int(height))
    if (width, height) != size:
        raise CalibrationError(
            f"{path} is for pictures of {width:g}x{height:g} pixels, but these have "
            f"{size[0]}x{size[1]}; give their own settings"
        )
    # Half a pixel: that tool counts from the corner, here the first pixel's centre is 0.
    column, row = (values[f"OPTICAL_CENTER_{axis}"] for axis in "XY")
    centre = width * column - 0.5, height * row - 0.5
    inner, outer = (0.5 * height * values[f"{end}_R_PERCENT"] for end in ("MIN", "MAX"))
    frame = MirrorFrame(*size, centre, math.radians(values["ANGLE_SHIFT"] - 180.0))
    down = np.linspace(0.0, 1.0, 50)
    fraction = np.clip(np.polynomial.polynomial.polyval(down, np.array(_LEVIN)), 0.0, 1.0)
    elevation = np.radians(_BLOGGIE_VIEW_DEG) * (_ABOVE_HORIZON - down)
    samples = (inner + fraction * (outer - inner), elevation)
    return fit_radial_polynomial(frame, (inner, outer), samples)[0]


def _bloggie_values(path: Path) -> dict[str, float]:
    values: dict[str, float] = {}
    for line, text in read_lines(path, CalibrationError):
        key, _, word = (part.strip() for part in text.partition(","))
        if key not in _BLOGGIE_KEYS:
            continue
        if (found := flat_numbers(word)) is None:
            raise CalibrationError(
                f"{path}, line {line}: {key} is {word!r}, not a finite number; correct it"
            )
        values[key] = float(found[0])
    absent = [key for key in _BLOGGIE_KEYS if key not in values]
    if absent:
        raise CalibrationError(f"{path} lacks {', '.join(absent)}; add `{absent[0]}, value`")
    return values


# --------------------------------------------------------------------------------------------
# Of files that hold the camera they were made with


KnownCamera: TypeAlias = (
    Equirectangular | Cylinder | HyperbolicMirror | RadialPolynomial | LensCamera
)
"""All models; a user may have one of his own."""


def storable(camera: OmniCamera | None) -> KnownCamera | None:
    """The camera itself. Raises CalibrationError for a model of the user's own."""
    if camera is None or isinstance(camera, KnownCamera):
        return camera
    names = ", ".join(model.__name__ for model in get_args(KnownCamera))
    raise CalibrationError(
        f"camera: a {type(camera).__name__} has no place in files; use one of {names}"
    )
