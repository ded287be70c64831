"""A recording of images: its rig, which of its frames are used, and what all its readers return."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from fgslam.cameras.lenses import Calibration
from fgslam.cameras.rectify import Rectifier
from fgslam.cameras.rig import StereoRig, at_size, in_metres, load_rig, rig_of
from fgslam.core.arrays import Brief, Float32, FloatArray, Image, IntArray
from fgslam.core.errors import CalibrationError, DatasetError, OneImageError
from fgslam.core.geometry import BODY_FORWARD_LEFT_UP_FROM_CAMERA, pose, so3_exp
from fgslam.core.log import Frame
from fgslam.core.sensors import CameraRig, Odometry, PoseFrame, body_is_camera
from fgslam.core.settings import FrameSelection
from fgslam.core.types import Trajectory
from fgslam.datasets.images import DepthLoader, ImageLoader, shown_together
from fgslam.datasets.ledger import IMAGES, LENGTH, ODOMETRY, PAIRING, TIMES, Entry
from fgslam.datasets.odometry import (
    STAMP_TOLERANCE_S,
    OdometrySource,
    file_odometry,
    find_odometry,
    is_of_gyroscope,
    synthetic_motions,
)
from fgslam.datasets.settings import (
    CalibratedSettings,
    RecordedOdometrySettings,
    RecordingSettings,
    SyntheticOdometrySettings,
)
from fgslam.datasets.times import read_tum, rows_at, time_unit, trajectory_at_frames

Rig = TypeVar("Rig", bound=CameraRig)
MOUNTING = "dataset.camera_yaw_deg, dataset.lever_arm_m"
"""Settings that put the camera on the body of odometry."""


@dataclass(frozen=True, eq=False, repr=False)
class Recording(Brief):
    """Selected frames of a recording on disk; images are read when asked for.

    Attributes:
        name: short name for titles.
        rig: the rectified cameras.
        timestamps: (n,) seconds of the selected frames, strictly increasing.
        identity: hexadecimal digest of the recording.
        notes: what was tolerated when opening.
        indices: (n,) the recording's own numbers of the selected frames.
        load_images: reads the images of one of the recording's own frames.
        ground_truth: true poses of the reference camera at the selected frames, or None.
        truth_frame: what the recording states them of; without truth the left camera, as data sets
            do.
        odometry_source: where the body's motions come from, or None. Asked once, when first
            needed, so that a bad odometry file hurts only its user.
        rectifier: what makes the images its own that the cameras gave; None where they are stored
            rectified.
        margins: of frames, in place of the rectifier's.
        disparity_sigma_px: noise of the disparity where a depth camera gives it, or None.
        ledger: what is taken to be so, with its source.
        calibration: file of the rig's; empty where there is none.
        load_depth: reads the depth of one of the recording's own frames, where a camera gives it.
    """

    name: str
    rig: CameraRig
    timestamps: FloatArray
    identity: str
    notes: tuple[str, ...]
    indices: IntArray
    load_images: ImageLoader
    ground_truth: Trajectory | None = None
    truth_frame: PoseFrame = "left"
    odometry_source: OdometrySource | None = None
    rectifier: Rectifier | None = None
    margins: tuple[Float32, ...] = ()
    disparity_sigma_px: float | None = None
    ledger: tuple[Entry, ...] = ()
    calibration: str = ""
    load_depth: DepthLoader | None = None

    def __len__(self) -> int:
        return len(self.indices)

    def frame(self, i: int) -> Frame:
        """Images of frame ``i``, 0 <= i < len. Raises FrameError when missing or corrupt."""
        self._check_index(i, 0)
        index = int(self.indices[i])
        margins = self.margins
        if self.rectifier is not None:
            margins = margins or self.rectifier.margins
        try:
            images = self.load_images(index, False)
        except OneImageError as error:
            images, alone = error.frame
            error.frame = Frame(index, float(self.timestamps[i]), images, margins, alone)
            raise
        return Frame(index, float(self.timestamps[i]), images, margins)

    def colour(self, i: int) -> tuple[Image, ...]:
        """Images of frame ``i`` in red, green, blue, or grey where the recording is. FrameError."""
        self._check_index(i, 0)
        return self.load_images(int(self.indices[i]), True)

    def odometry(self, i: int) -> Odometry | None:
        """Body motion from frame ``i - 1`` to ``i``, 1 <= i < len; None where none was recorded.

        Raises:
            OdometryError: the recording's odometry is malformed.
        """
        self._check_index(i, 1)
        steps = self._steps
        return None if steps is None else steps[i - 1]

    @cached_property
    def _steps(self) -> tuple[Odometry | None, ...] | None:
        return None if self.odometry_source is None else self.odometry_source(self.timestamps)

    def _check_index(self, i: int, least: int) -> None:
        if not least <= i < len(self):
            raise IndexError(f"frame {i} of {self.name}: expected {least} to {len(self) - 1}")


def image_recording(
    settings: RecordingSettings,
    name: str,
    rig: CameraRig,
    stamps: FloatArray,
    load_images: ImageLoader,
    files: tuple[Iterable[Path], Iterable[Path]],
    notes: tuple[str, ...],
    ledger: tuple[Entry, ...] = (),
    **more: Any,
) -> Recording:
    """Recording of those frames that the settings select; what all readers of images end in.

    Args:
        settings: which frames are used.
        name: short name for titles.
        rig: of the cameras, on the body that odometry moves.
        stamps: (n,) seconds of all frames, increasing.
        load_images: reads the images of a frame by its number among all.
        files: that identify it: by their content, and by their names (:func:`recording_identity`).
        notes: what was tolerated; the rig's own remarks are put before them.
        ledger: what the reader alone knows.
        more: further attributes of a :class:`Recording`.

    Raises:
        DatasetError: no frame is selected.
    """
    indices = select_frames(len(stamps), settings, settings.path)
    plain, rectifier = rig, None
    if isinstance(rig, StereoRig):
        if rig.format.startswith("OpenCV"):
            entry = Entry(LENGTH, "1 m", f"{rig.format} states none", "--unit", guessed=True)
            ledger = (entry, *ledger)
        plain, rectifier, notes = rig.plain(), rig.rectifier, (*rig.remarks, *notes)
    more |= {"rectifier": rectifier, "ledger": ledger, "calibration": getattr(rig, "file", "")}
    identity = recording_identity(*files)
    return Recording(name, plain, stamps[indices], identity, notes, indices, load_images, **more)


def numbered_frames(
    cameras: Mapping[Path, Mapping[int, Path]], numbers: Iterable[int], times: Path
) -> tuple[list[tuple[Path, ...]], list[Path], tuple[Entry, ...]]:
    """Files of each frame, all files, and what is taken to be so, where numbers name images.

    Args:
        cameras: by folder the images by number; an absent one gets the name that it should have.
        numbers: of the frames.
        times: the file that lists them.
    """
    suffixes = [next((p.suffix for p in found.values()), ".png") for found in cameras.values()]
    named = list(zip(cameras.items(), suffixes, strict=True))
    files = [
        tuple(found.get(k, folder / f"{k:06d}{suffix}") for (folder, found), suffix in named)
        for k in numbers
    ]
    ledger = (
        Entry(IMAGES, ", ".join(f"{folder.name}/" for folder in cameras), "names of folders"),
        Entry(TIMES, "stamps", str(times)),
        Entry(PAIRING, "by number", "names of the images"),
    )
    return files, [path for found in cameras.values() for path in found.values()], ledger


TRUTH_RIGHT, TRUTH_LEFT = "gt_right_cam.txt", "gt_left_cam.txt"
_TRUTHS: Mapping[str, PoseFrame | None] = {
    TRUTH_RIGHT: "right",
    TRUTH_LEFT: "left",
    "groundtruth.txt": None,
}
"""Files of true poses in a folder, and of which camera; None: as data sets give them."""


def folder_recording(
    settings: CalibratedSettings,
    odometry: RecordedOdometrySettings,
    root: Path,
    rig: StereoRig,
    stamps: FloatArray,
    load_images: ImageLoader,
    files: tuple[Sequence[Path], Iterable[Path]],
    notes: tuple[str, ...],
    **more: Any,
) -> Recording:
    """As :func:`image_recording`, with the odometry and the truth that lie in a folder.

    Where odometry is another body's and the calibration is of the cameras alone, these look
    straight ahead from its origin.

    Raises:
        DatasetError: as there, or there are several files of odometry, or the truth is malformed.
    """
    contents, listed = files
    if (file := find_odometry(root)) is not None:
        more["odometry_source"], contents = file_odometry(file, odometry), (*contents, file)
        stated = settings.camera_yaw_deg is not None or settings.lever_arm_m is not None
        # A gyroscope is in the camera's own box, wheels turn about another axis.
        if not stated and not is_of_gyroscope(file) and body_is_camera(rig.bTc):
            guess = looks_ahead(f"the body of {file}")
            rig = replace(rig, bTc=BODY_FORWARD_LEFT_UP_FROM_CAMERA)
            notes, more["ledger"] = (guess.source, *notes), (*more["ledger"], guess)
    name, files = root.resolve().name, (contents, listed)
    found = image_recording(settings, name, rig, stamps, load_images, files, notes, **more)
    if (path := next((root / n for n in _TRUTHS if (root / n).is_file()), None)) is None:
        return found
    truth = replace(read_tum(path), frame=_TRUTHS[path.name] or found.truth_frame)
    return with_truth(found, truth, path, stamps)


def with_truth(
    recording: Recording, truth: Trajectory, path: Path, stamps: FloatArray, max_gap_s: float = 0.1
) -> Recording:
    """The recording with true poses of its frames.

    Args:
        recording: its selected frames.
        truth: of any frame of the rig; in seconds, or in the unit in which it covers the recording.
        path: of its file.
        stamps: (n,) seconds of all frames, selected or not.
        max_gap_s: between poses that are interpolated.

    Raises:
        DatasetError: the truth covers none of the recording's frames.
    """
    unit, seconds = time_unit(truth.timestamps)
    for scale, notes in ((1.0, ()), (seconds, (f"times of {path} are read as {unit}",))):
        scaled = replace(truth, timestamps=scale * truth.timestamps)
        if len(trajectory_at_frames(scaled, stamps, max_gap_s)) > min(1, len(stamps) - 1):
            found = trajectory_at_frames(scaled, recording.timestamps, max_gap_s)
            return replace(
                recording,
                ground_truth=found.of("right", recording.rig),
                truth_frame=truth.frame,
                notes=(*recording.notes, *notes),
            )
    spans = [f"{s[0]:.3f} to {s[-1]:.3f} s" if len(s) else "empty"
             for s in (truth.timestamps, stamps)]  # fmt: skip
    raise DatasetError(
        f"{path}: the truth is from {spans[0]}, the recording from {spans[1]}: it has next to no "
        f"pose at a frame, or two at most {max_gap_s:g} s apart around one; give both the times of "
        "one clock, in seconds, or move the file elsewhere"
    )


def with_synthetic_odometry(
    recording: Recording, settings: SyntheticOdometrySettings, seed: int
) -> Recording:
    """The recording with its ground truth and noise in place of odometry, which a note states.

    Raises:
        DatasetError: the recording has no ground truth.
    """
    truth = recording.ground_truth
    if truth is None or len(truth) == 0:
        raise DatasetError(
            f"odometry.kind is synthetic but {recording.name} has no ground truth to make it "
            "from; choose recorded or constant_velocity"
        )
    notes = [
        "the odometry is synthetic: ground truth plus noise of "
        f"{100.0 * settings.translation_sigma_fraction:g} % of the step and "
        f"{settings.rotation_sigma_deg:g} degrees per axis (seed {seed})"
    ]
    rows = rows_at(truth.timestamps, recording.timestamps, STAMP_TOLERANCE_S)
    if without := int((rows < 0).sum()):
        notes.append(f"{without} frames have no ground truth, so no odometry")
    source = partial(synthetic_motions, truth, recording.rig.bTc, settings, seed)
    return replace(recording, odometry_source=source, notes=(*recording.notes, *notes))


def recording_identity(contents: Iterable[Path], listed: Iterable[Path]) -> str:
    """SHA-256 over the bytes of ``contents`` and the names and sizes of ``listed`` files."""
    digest = hashlib.sha256()
    for path in contents:
        digest.update(f"{path.name}\0".encode())
        digest.update(path.read_bytes())
    for path in sorted(listed):
        size = path.stat().st_size if path.exists() else 0  # a link to nothing is a damaged image
        digest.update(f"{path.parent.name}/{path.name}\0{size}\0".encode())
    return digest.hexdigest()


def select_frames(count: int, settings: FrameSelection, name: str) -> IntArray:
    """Indices (m,) of the chosen ones of ``count`` frames, increasing, at least one.

    ``name`` is what messages call the recording.

    Raises:
        DatasetError: the recording is empty, or the range leaves no frame.
    """
    if count == 0:
        raise DatasetError(
            f"{name} has no frame at all: check that the path is the recording's folder "
            "and that its list of times is not empty"
        )
    if settings.start >= count:
        raise DatasetError(
            f"dataset.start is {settings.start} but {name} has frames 0 to {count - 1}: choose less"
        )
    if settings.stop is not None and settings.stop <= settings.start:
        raise DatasetError(
            f"dataset.stop ({settings.stop}) is not beyond dataset.start ({settings.start}), which "
            f"leaves no frame of {name}: choose a larger stop"
        )
    stop = count if settings.stop is None else min(settings.stop, count)
    return np.arange(settings.start, stop, settings.stride, dtype=np.int64)


# --------------------------------------------------------------------------------------------
# The rig: the recording's own calibration or the one that is given in its place, mounted


def calibrated_rig(
    settings: CalibratedSettings, own: Path, size: tuple[int, int] | None, pair: bool = True
) -> StereoRig:
    """The rig by the file that the settings name, else by the recording's own file or folder.

    Args:
        settings: of the recording.
        own: the recording's file or folder of calibration.
        size: width and height of the images, for formats that do not state it.
        pair: whether they are of two cameras; else of three.

    Raises:
        CalibrationError: there is no calibration, or it cannot be used.
    """
    file = own if settings.camera_file is None else Path(settings.camera_file)
    try:
        return mounted(loaded_rig(settings, file, size=size, pair=pair), settings)
    except CalibrationError as fault:
        # Of a file in the folder the message is enough: that is there, and at fault.
        if settings.camera_file is not None or not str(fault).startswith(f"{own}:"):
            raise
        raise CalibrationError(
            f"{fault}; give a calibration: {own / 'calib.json'}, or another one by --camera FILE"
        ) from None


T = TypeVar("T")


def rig_of_views(
    whole: tuple[int, int], rig_of: Callable[[tuple[int, int], tuple[int, int]], T]
) -> tuple[T, str]:
    """The rig of images of a size that show both views, and in words how they show them.

    Args:
        whole: width and height of the images.
        rig_of: the rig of views of a size, so many next to and above each other; CalibrationError
            where the calibration is of other ones.

    Raises:
        CalibrationError: it is of no part of the images.
    """
    fault = None
    for name, columns, rows in shown_together(whole):
        try:
            return rig_of((whole[0] // columns, whole[1] // rows), (columns, rows)), name
        except CalibrationError as error:
            fault = fault or error
    raise fault or CalibrationError("no views")


def loaded_rig(
    settings: CalibratedSettings,
    *files: Path,
    size: tuple[int, int] | None,
    cameras: Sequence[int] | None = None,
    pair: bool = True,
) -> StereoRig:
    """:func:`fgslam.load_rig` of one file or two, in the unit, scaled, as wide as is asked for.

    Where the images are of a ``pair`` and the file has three cameras, those of its first two.
    """
    asked: dict[str, Any] = {key: getattr(settings, key) for key in ("unit_m", "fov_deg", "lens")}
    load = partial(load_rig, *files, size=size, scale=settings.resized, **asked)
    rig = load(cameras=cameras)
    if not pair or max(rig.sources) < 2:
        return rig
    text = f"{files[0]} holds three cameras, the images are of two: the first two are taken"
    two = load(cameras=(0, 1))
    return replace(two, remarks=(text, *two.remarks))


def read_rig(
    settings: CalibratedSettings, calibration: Calibration, size: tuple[int, int] | None
) -> StereoRig:
    """The same of a calibration that is read."""
    found = in_metres(calibration, settings.unit_m)
    return rig_of(at_size(found, size, settings.resized), settings.fov_deg)


def numbered(rig: StereoRig) -> StereoRig:
    """The rig of images that are given as those of a file's second and first camera.

    So do names with numbers, cam1 and cam0, whichever of them is the right one.
    """
    if rig.sources[:2] != (0, 1):
        return rig
    kept = rig.rectifier or Rectifier(rig.plain(), ())
    text = "the camera of the lower number is the right one by its calibration, and is taken so"
    return replace(rig, rectifier=replace(kept, order=(1, 0)), remarks=(*rig.remarks, text))


def in_order(rig: StereoRig) -> StereoRig:
    """The rig of images that are given as right, left[, top], whatever the file calls them."""
    if rig.rectifier is None:
        return rig
    order = tuple(range(rig.cameras))
    return replace(rig, rectifier=replace(rig.rectifier, order=order))


def mounted(rig: Rig, settings: CalibratedSettings) -> Rig:
    """The rig where the settings put it; as it is, where they name no place."""
    if settings.camera_yaw_deg is None and settings.lever_arm_m is None:
        return rig
    lever_arm = settings.lever_arm_m or (0.0, 0.0, 0.0)
    heading = so3_exp(np.array([0.0, 0.0, np.radians(settings.camera_yaw_deg or 0.0)]))
    level = heading @ BODY_FORWARD_LEFT_UP_FROM_CAMERA[:3, :3]
    return replace(rig, bTc=pose(level, np.array(lever_arm, np.float64)))


def looks_ahead(body: str) -> Entry:
    """What is assumed of a camera where nothing states how it sits on the body of odometry."""
    return Entry(
        ODOMETRY,
        "its frame is of the robot's body",
        f"nothing states where the camera sits on {body}: it is taken to look straight ahead from "
        "there (dataset.camera_yaw_deg and dataset.lever_arm_m say otherwise)",
        MOUNTING,
        guessed=True,
    )
