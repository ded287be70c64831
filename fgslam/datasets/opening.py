"""Functions that open any recording by its settings: of images, of measurements, for homing.

A reader is imported when its kind is opened: what one needs takes others a second to load.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from fgslam.cameras.rectify import Rectifier
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import DatasetError
from fgslam.core.log import MeasurementRecording
from fgslam.core.sensors import body_is_camera
from fgslam.datasets.images import Depth, DepthLoader, readable
from fgslam.datasets.layouts import files_of
from fgslam.datasets.ledger import DEPTH, LENGTH, LENS, ODOMETRY, Entry
from fgslam.datasets.recording import MOUNTING, Recording
from fgslam.datasets.settings import (
    FileRecordingSettings,
    MeasurementDatasetSettings,
    OdometrySettings,
    OmniDatasetSettings,
    OmniHouseSettings,
    RecordedOdometrySettings,
    SimulatedBearingsSettings,
)

if TYPE_CHECKING:
    from fgslam.datasets.omni import OmniRecording
    from fgslam.worlds.house import OmniWorld as OmniWorld
    from fgslam.worlds.simulated_bearings import SimulatedHoming

READERS: Mapping[str, Callable[[], Any]] = {
    "image_folder": lambda: import_module("fgslam.datasets.folders").open_image_folder,
    "loose_images": lambda: import_module("fgslam.datasets.folders").open_loose_images,
    "video": lambda: import_module("fgslam.datasets.video").open_video,
    "rgbd": lambda: import_module("fgslam.datasets.depth").open_rgbd,
    "bag": lambda: import_module("fgslam.datasets.bags").open_bag,
    "kitti": lambda: import_module("fgslam.datasets.published").open_kitti,
    "kitti_raw": lambda: import_module("fgslam.datasets.published").open_kitti_raw,
    "euroc": lambda: import_module("fgslam.datasets.published").open_euroc,
    "stereo_tracks": lambda: import_module("fgslam.datasets.measured").open_stereo_tracks,
    "measurements": lambda: import_module("fgslam.datasets.measured").open_measurement_files,
    "simulated_measurements": lambda: import_module("fgslam.datasets.measured").open_simulation,
    "panoramas": lambda: import_module("fgslam.datasets.omni").open_pictures,
    "omni_path": lambda: import_module("fgslam.datasets.omni").open_pictures,
    "omni_video": lambda: import_module("fgslam.datasets.omni").open_omni_video,
}
"""By kind of the settings what opens a recording."""


def _reader(settings: Any) -> Callable[..., Any]:
    """What opens the recording. Raises DatasetError unless it is there; a simulation always is."""
    if (path := getattr(settings, "path", None)) and not any(
        map(Path.exists, files_of(Path(path)))
    ):
        raise DatasetError(
            f"the recording {path} does not exist; say where it is: --set dataset.path=PATH, for "
            "export and film --recording PATH (fgslam data: where to get some)"
        )
    read: Callable[..., Any] = READERS[settings.kind]()
    return read


def open_recording(
    settings: FileRecordingSettings, odometry: RecordedOdometrySettings | None = None
) -> Recording:
    """Open the recording that the settings describe.

    Args:
        settings: one of the readers' settings.
        odometry: noise and limits of recorded odometry; None for the defaults.

    Raises:
        DatasetError: the recording is missing, malformed or empty.
        CalibrationError: its calibration is missing or impossible.
    """
    read, odometry = _reader(settings), odometry or RecordedOdometrySettings()
    found: Recording = read(settings, odometry)
    known = None if found.rectifier is None else found.rectifier.calibration
    if known is not None and known.guessed_lens:
        found = _by_lens(found, known.guessed_lens, lambda s: read(s, odometry), settings)
    if found.rectifier is not None and found.rectifier.maps:
        misfit = fit_notes(lambda i: found.frame(i).images, len(found), found.rectifier)
        found = replace(found, notes=(*misfit, *found.notes))
    found = replace(found, ledger=ledger_of(found, settings))
    return found if settings.scale == 1.0 else smaller(found, settings.scale)


def ledger_of(recording: Recording, settings: Any) -> tuple[Entry, ...]:
    """All entries of a recording that is opened by these settings."""
    known = None if recording.rectifier is None else recording.rectifier.calibration
    given = getattr(settings, "camera_file", None)
    source = str(given or settings.path) if known is None else known.source
    entries = {entry.what: entry for entry in recording.ledger}
    if (unit := float(getattr(settings, "unit_m", 1.0))) != 1.0:
        entries[LENGTH] = Entry(LENGTH, f"{unit:g} m", "--unit", "--unit")
    elif not {DEPTH, LENGTH} & entries.keys():
        entries[LENGTH] = Entry(LENGTH, "1 m", f"the format of {source}", "--unit")
    lens = Entry(LENS, "none, images are rectified", source)
    if known is not None:
        models = ", ".join(sorted({camera.model for camera in known.cameras}))
        asked = known.guessed_lens or getattr(settings, "lens", None)
        option = "dataset.lens" if asked else ""
        lens = Entry(LENS, models, source, option, bool(known.guessed_lens))
    entries.setdefault(LENS, lens)
    stamps, truth = recording.timestamps, recording.ground_truth
    span = f"{stamps[0]:.3f} to {stamps[-1]:.3f} s"
    rate = (len(stamps) - 1) / float(stamps[-1] - stamps[0]) if len(stamps) > 1 else np.nan
    entries["rate and span"] = Entry("rate and span", f"{rate:.3g} Hz, {span}", "the stamps")
    if truth is not None:
        its = f", {truth.timestamps[0]:.3f} to {truth.timestamps[-1]:.3f} s" if len(truth) else ""
        value = f"{len(truth)} of {len(stamps)} frames{its}"
        entries["truth"] = Entry("truth", value, settings.path)
    if recording.odometry_source is not None:
        frame = "of the camera" if body_is_camera(recording.rig.bTc) else "of the robot's body"
        stated = Entry(ODOMETRY, f"its frame is {frame}", settings.path, MOUNTING)
        entries.setdefault(ODOMETRY, stated)
    return tuple(entries.values())


def _by_lens(
    found: Recording,
    guessed: str,
    read: Callable[[Any], Recording],
    settings: FileRecordingSettings,
) -> Recording:
    """The recording by that lens model by which the rows of its first pairs agree best."""
    other = "equidistant" if guessed == "radtan" else "radtan"
    both = {guessed: found, other: read(replace(settings, lens=other))}  # type: ignore[arg-type]
    offsets = {name: _first_rows(each) for name, each in both.items()}
    if max(map(len, offsets.values())) < _FEWEST_MATCHES:
        return found
    rows = {n: float(np.median(np.abs(its))) if len(its) else np.inf for n, its in offsets.items()}
    best, worse = sorted(rows, key=lambda name: rows[name])
    chosen = both[best] if best == other else read(replace(settings, lens=best))  # type: ignore[arg-type]
    note = (
        f"nothing states the lens model of the calibration: taken as {best}, by which the rows of "
        f"the first pairs agree to {rows[best]:.2g} px, by {worse} to {rows[worse]:.2g} "
        f"(dataset.lens={worse} states otherwise)"
    )
    entry = Entry(LENS, best, note, "dataset.lens", guessed=True)
    return replace(chosen, notes=(note, *chosen.notes), ledger=(*chosen.ledger, entry))


_SMALLEST_PX = 8  # SIFT finds nothing in less


def smaller(recording: Recording, scale: float) -> Recording:
    """The recording with rectified images smaller by a factor ``scale``, the calibration with them.

    Pixels are averaged over what they cover. Noise that the recording states is in pixels of the
    images it gives.

    Raises:
        DatasetError: nothing would be left of the images.
    """
    rig = recording.rig
    size = (max(round(scale * rig.width), 1), max(round(scale * rig.height), 1))
    if min(size) < _SMALLEST_PX:
        raise DatasetError(
            f"dataset.scale {scale:g} makes images of {size[0]}x{size[1]} pixels of "
            f"{rig.width}x{rig.height}; choose a larger one"
        )
    x, y = size[0] / rig.width, size[1] / rig.height
    margins = () if recording.rectifier is None else recording.rectifier.margins

    def load(index: int, colour: bool) -> tuple[Image, ...]:
        return tuple(
            np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
            for image in recording.load_images(index, colour)
        )

    def resized(read: DepthLoader, index: int) -> Depth:
        return np.asarray(cv2.resize(read(index), size, interpolation=cv2.INTER_NEAREST))

    # Whole pixels are at their centres: the image reaches from -0.5.
    cx, cy = x * (rig.cx + 0.5) - 0.5, y * (rig.cy + 0.5) - 0.5
    note = f"images of {rig.width}x{rig.height} are made {size[0]}x{size[1]}"
    smaller_margins = (cv2.resize(m, size, interpolation=cv2.INTER_NEAREST) for m in margins)
    return replace(
        recording,
        rig=replace(rig, width=size[0], height=size[1], fx=x * rig.fx, fy=y * rig.fy, cx=cx, cy=cy),
        margins=tuple(scale * each for each in smaller_margins),
        load_images=load,
        load_depth=recording.load_depth and partial(resized, recording.load_depth),
        notes=(note, *recording.notes),
    )


def open_measurements(
    settings: MeasurementDatasetSettings, seed: int, odometry: OdometrySettings | None = None
) -> MeasurementRecording:
    """Open or simulate the measurements that the settings describe.

    Args:
        settings: one of the kinds without images.
        seed: of what is simulated; real measurements do not depend on it.
        odometry: what predicts the motion; None for the recording's own, with the default
            constant velocity over its gaps.

    Raises:
        DatasetError: the recording is missing, malformed or empty.
        ConfigError: a simulated drive cannot be driven, or synthetic odometry is asked for.
    """
    found: MeasurementRecording = _reader(settings)(
        settings, odometry or RecordedOdometrySettings(), seed
    )
    return found


def open_omni(settings: OmniDatasetSettings) -> OmniRecording:
    """Open the recording of an omnidirectional camera that the settings describe.

    Raises:
        DatasetError: it is missing, malformed or empty; of these CalibrationError, where the
            camera is concerned, and FrameError, where the first picture cannot be read.
    """
    found: OmniRecording = _reader(settings)(settings)
    return found


def open_checked(settings: OmniDatasetSettings) -> OmniRecording:
    """The same, with a note where its pictures cannot be of the stated camera."""
    from fgslam.datasets.omni import camera_notes

    recording = open_omni(settings)
    return replace(recording, notes=recording.notes + camera_notes(recording))


def open_simulated_homing(
    settings: SimulatedBearingsSettings, outliers: float, rng: np.random.Generator
) -> SimulatedHoming:
    """Matches, tracks and truth of one homing.

    Args:
        settings: the room, the drive and the noise.
        outliers: part of the matches, and of the bearings tracked at the drive's end, that is
            wrong.
        rng: source of everything random.
    """
    from fgslam.worlds.simulated_bearings import HomingOutliers, simulate_homing

    return simulate_homing(settings, rng, HomingOutliers.of_all(outliers))


def open_house(settings: OmniHouseSettings, seed: int) -> OmniWorld:
    """The house as a world to act in, with the wheelchair at the start of its reference path.

    Raises:
        DatasetError: no reference path of that kind is found.
        MissingDependencyError: Open3D cannot be loaded.
    """
    from fgslam.worlds.house import OmniWorld

    return OmniWorld(settings, seed)


# --------------------------------------------------------------------------------------------
# Whether a calibration fits the images that it rectifies, by matches in the first pairs


_PAIRS = 3  # that are looked at
_TRIED = 12  # frames, until so many could be read
_FEATURES = 800
_WIDE_PX = 400  # wider images are made smaller: a misfit is large
_RATIO = 0.8
_FEWEST_MATCHES = 60
"""In all pairs; below, nothing is reported."""
_ROW_PX = 2.0  # at 640 columns: rows of a sound pair agree within half a pixel
_LEAST_SHARE = 1.0 / 3.0
"""Of matches whose rows agree, wrong matches included. Real pairs by their own calibration: 0.74 to
0.96 (chessboards whose pattern repeats, a room); by another's: 0.01 to 0.16."""
_BETTER = 0.8
"""Of the rows' median difference in rectified images: what raw ones have less of, they fit better.
The noise of matching is in both."""
_OFF_PX = 0.5  # at 640 columns: less is noise of matching in images made smaller
_MOST_NEGATIVE = 0.5
"""Of disparities: wrong matches make a tenth so."""


def fit_notes(
    load: Callable[[int], tuple[Image, ...]], count: int, rectifier: Rectifier
) -> tuple[str, ...]:
    """What rectified pairs say against their calibration, in one line; empty where it fits.

    It fits neither where rows disagree, nor where they agree better in the images as they are.

    Args:
        load: rectified images (right, left[, top]) of a frame, 0 <= index < count; may raise
            FrameError.
        count: how many frames there are.
        rectifier: what rectified them.
    """
    pairs = _first_pairs(load, count)
    found = [_matched(*pair) for pair in pairs]
    if sum(map(len, found)) < _FEWEST_MATCHES:
        return ()
    right, left = np.split(np.concatenate(found), 2, axis=1)
    offsets, raw = left - right, _raw_rows(rectifier, right, left)
    scale = max(1.0, pairs[0][0].shape[1] / 640.0)
    share = float(np.mean(np.abs(offsets[:, 1]) < _ROW_PX * scale))
    rows_px, raw_px = (float(np.median(np.abs(rows))) for rows in (offsets[:, 1], raw))
    negative = float(np.mean(offsets[:, 0] < 0.0))
    swapped = "; left and right look swapped" if negative > _MOST_NEGATIVE else ""
    raw_is_better = rows_px > _OFF_PX * scale and raw_px < _BETTER * rows_px
    if share < _LEAST_SHARE or raw_is_better:
        source = "" if rectifier.calibration is None else f" {rectifier.calibration.source}"
        return (
            f"the calibration{source} does not fit these images: in the first {len(found)} pairs "
            f"the rows of {len(offsets)} matches differ by {rows_px:.1f} px once rectified "
            f"(median; {100.0 * share:.0f} % by less than {_ROW_PX * scale:.0f} px), by "
            f"{raw_px:.1f} px as they are{swapped}; give the calibration of these cameras as they "
            "are now, or swap left and right",
        )
    if swapped:
        return (
            f"left and right are swapped: {100.0 * negative:.0f} % of {len(offsets)} matches in "
            f"the first {len(found)} pairs have negative disparity; swap the images",
        )
    return ()


def _first_pairs(load: Callable[[int], tuple[Image, ...]], count: int) -> list[tuple[Image, ...]]:
    return [images[:2] for images in islice(readable(load, range(min(count, _TRIED))), _PAIRS)]


def _first_rows(recording: Recording) -> FloatArray:
    """(n,) rows in the left minus those in the right image, of matches in the first pairs."""
    pairs = _first_pairs(lambda i: recording.frame(i).images, len(recording))
    found = np.concatenate([np.empty((0, 4)), *(_matched(*pair) for pair in pairs)])
    return np.asarray(found[:, 3] - found[:, 1])


def _raw_rows(rectifier: Rectifier, right: FloatArray, left: FloatArray) -> FloatArray:
    """(n,) how far pixels (n, 2) of the view lie apart across its rows in the raw images.

    In pixels of the view, whose resolution and quarter turns the raw images need not have.
    """
    width, height = rectifier.rig.width, rectifier.rig.height
    column = np.array([[0.5 * width, 0.25 * height], [0.5 * width, 0.75 * height]])
    above, below = rectifier.raw_pixels(0, column)
    down = (below - above) / (0.5 * height)
    apart = rectifier.raw_pixels(1, left) - rectifier.raw_pixels(0, right)
    return np.asarray(apart @ down / (down @ down))


def _matched(right: Image, left: Image) -> FloatArray:
    """(n, 4) column and row in the right, then in the left image, of features that match."""
    detector = cv2.SIFT.create(_FEATURES)
    factor = max(1, math.ceil(right.shape[1] / _WIDE_PX))
    size = (right.shape[1] // factor, right.shape[0] // factor)
    (there, a), (here, b) = (
        detector.detectAndCompute(cv2.resize(image, size, interpolation=cv2.INTER_AREA), None)
        for image in (left, right)
    )
    if a is None or b is None or len(a) < 2 or len(b) < 2:
        return np.empty((0, 4))
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    back = {pair[0].queryIdx: pair[0].trainIdx for pair in matcher.knnMatch(a, b, 1)}
    kept = [
        (first.queryIdx, first.trainIdx)
        for first, second in matcher.knnMatch(b, a, 2)
        if first.distance < _RATIO * second.distance and back[first.trainIdx] == first.queryIdx
    ]
    places = [(*here[i].pt, *there[j].pt) for i, j in kept]
    return np.asarray(factor * np.array(places, np.float64).reshape(-1, 4))
