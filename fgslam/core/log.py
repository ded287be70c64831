"""Recordings: of images, as a sequence of frames, and of measurements, as a finished log."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, get_args, runtime_checkable

import numpy as np

from fgslam.core.arrays import Brief, Float32, FloatArray, Image, IntArray, Rows
from fgslam.core.checks import is_finite_number
from fgslam.core.correction import term_names
from fgslam.core.errors import DatasetError, MeasurementLogError
from fgslam.core.files import read_text, write_text
from fgslam.core.geometry import is_rigid
from fgslam.core.sensors import (
    NO_CAMERA,
    CameraRig,
    Increment,
    LoopClosure,
    Odometry,
    PoseFrame,
)
from fgslam.core.settings import RigPlaces
from fgslam.core.store import FileKind, require_ascending, require_covariances, require_finite
from fgslam.core.types import Trajectory, parse_rows


@dataclass(slots=True, eq=False, repr=False)
class MeasurementLog(Brief):
    """Measurements of a run, frame by frame.

    Attributes:
        rig: the cameras, with the lever arm; left out for a robot without.
        motion_model: how odometry came about, plain JSON values; where there was none, replays
            predict by constant velocity as the live run did.
        increments: one a frame, time increasing.
    """

    rig: CameraRig = NO_CAMERA
    motion_model: dict[str, Any] = field(default_factory=dict)
    increments: list[Increment] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.increments)

    def __iter__(self) -> Iterator[Increment]:
        return iter(self.increments)

    def append(self, increment: Increment) -> None:
        """Adds one frame without a motion model's stand-in: a replay derives its own.

        Raises MeasurementLogError where its time does not come after the last one's.
        """
        if self.increments and not increment.timestamp > self.increments[-1].timestamp:
            raise MeasurementLogError(
                f"frame {increment.index}: time stamp {increment.timestamp:.9f} s does not come "
                f"after {self.increments[-1].timestamp:.9f} s; sort the measurements by time"
            )
        increment = replace(increment, odometry=_without_stand_in(increment.odometry))
        self.increments.append(increment)

    @property
    def timestamps(self) -> FloatArray:
        """(n,) seconds."""
        return np.array([s.timestamp for s in self], np.float64)

    @property
    def numbers(self) -> IntArray:
        """(n,) the frames' numbers in their recording."""
        return np.array([s.index for s in self], np.int64)

    @property
    def relocalised(self) -> int:
        """How many frames were placed without a prior."""
        return sum(s.relocalised for s in self)

    @property
    def closures(self) -> list[tuple[int, LoopClosure]]:
        """All loop closures, with the position of the frame that offered each."""
        return [(k, loop) for k, step in enumerate(self) for loop in step.loops]

    def save(self, path: str | Path) -> None:
        """Writes the log, whole or not at all. Raises OutputError when it cannot be written."""
        LOG.save(path, self)

    @staticmethod
    def load(path: str | Path, models: Iterable[Any] = ()) -> MeasurementLog:
        """Reads a log; ``models`` are those of its other sensors, by kind, which files do not hold.

        Raises MeasurementLogError for a missing, truncated or foreign file.
        """
        log, of_kind = LOG.load(path), {model.kind: model for model in models}
        for k, step in enumerate(log.increments):
            if step.measured:
                every = [replace(one, model=of_kind.get(one.kind)) for one in step.measured]
                log.increments[k] = replace(step, measured=tuple(every))
        return log


def _without_stand_in(odometry: Odometry | None) -> Odometry | None:
    """What of a step was measured: all of it, its turn, or nothing."""
    if odometry is None or odometry.measured:
        return odometry
    if odometry.turned:
        turn = odometry.motion[:3, :3], odometry.covariance[:3, :3]
        return Odometry.turn(*turn, odometry.bias)
    return None


def _require_measured(log: MeasurementLog) -> None:
    """Raises ValueError for what no run measures: a log may be made by anyone."""
    if fault := rig_fault(log.rig):
        raise ValueError(f"the log's rig cannot be one: {fault}")
    terms = len(term_names(log.rig))
    for k, step in enumerate(log):
        seen, n = step.observations, len(step.observations.ids)
        arrays = (seen.ids, seen.measurement, seen.covariance, seen.pixels, seen.is_new)
        shapes = [array.shape for array in (*arrays, step.rejected)]
        if shapes != [(n,), (n, 3), (n, 3, 3), (n, 3, 2), (n,), (n,)]:
            raise ValueError(f"frame {step.index}: arrays of its observations differ in length")
        if len(np.unique(seen.ids)) < n:
            raise ValueError(f"frame {step.index} observes a landmark twice")
        if forward := [loop.frame for loop in step.loops if not 0 <= loop.frame < k]:
            raise ValueError(
                f"a loop closure of frame {k} leads to frame {forward[0]}, which does not come "
                "before it"
            )
        for one in step.measured:
            require_finite(one.kind, one.values)
            require_covariances(one.kind, one.covariance)
        if step.rig_correction is not None and step.rig_correction.shape != (terms,):
            raise ValueError(f"frame {step.index}: rig_correction has not {terms} terms")
        field_px = 0.0 if step.settled_rig is None else step.settled_rig.field_px
        if not 0.0 <= field_px < np.inf:
            raise ValueError(f"frame {step.index}: field_px is {field_px}")
    require_finite("timestamp", log.timestamps)
    require_ascending("timestamp", log.timestamps)
    steps = [step.odometry for step in log if step.odometry is not None]
    wrong = [not is_rigid(step.motion) for step in steps]
    if any(wrong):
        raise ValueError(f"odometry: number {wrong.index(True)} is no rigid motion")
    covariances = np.array([step.covariance for step in steps]).reshape(-1, 6, 6)
    require_covariances("odometry", covariances, definite=False)
    for bias in (step.bias for step in steps if step.bias is not None):
        require_finite("gyroscope", bias.jacobian)
        require_finite("gyroscope", bias.applied)
        require_covariances("gyroscope", bias.left[None], definite=False)
        require_covariances("gyroscope", np.array([[[bias.start_variance]]]))
        require_covariances("gyroscope", np.array([[[bias.walk]]]), definite=False)
    if len(log):
        measured = np.concatenate([step.observations.measurement for step in log])
        covariances = np.concatenate([step.observations.covariance for step in log])
        require_finite("measurement", measured)
        require_covariances("measurement", covariances)
        disparities = measured[:, 2]  # single ones are noise about what is far away
        if len(measured) and not np.median(disparities) > 0.0:
            raise ValueError(
                f"{int((disparities <= 0.0).sum())} of {len(measured)} disparities are not "
                "positive: left and right are swapped, or it is damaged"
            )


LOG = FileKind(
    MeasurementLog,
    "fgslam measurement log",
    version=9,
    error=MeasurementLogError,
    give="give a run folder's measurements.npz",
    again="run again",
    check=_require_measured,
)


# ------------------------------------------------------------------------------------------
# Recordings of images


@runtime_checkable
class ImageSequence(Protocol):
    """A recording: calibrated frames in time order, perhaps with odometry and ground truth.

    Indices ``i`` run over the *selected* frames (after start, stop and stride), from 0.
    """

    @property
    def name(self) -> str:
        """Short name for titles."""
        ...

    @property
    def rig(self) -> CameraRig:
        """The calibrated cameras, rectified."""
        ...

    @property
    def timestamps(self) -> FloatArray:
        """(n,) seconds, strictly increasing."""
        ...

    @property
    def identity(self) -> str:
        """Hexadecimal digest of what defines the recording, for the run folder."""
        ...

    def __len__(self) -> int: ...

    def frame(self, i: int) -> Frame:
        """Images of frame ``i``. Raises FrameError when they are missing or corrupt."""
        ...

    def odometry(self, i: int) -> Odometry | None:
        """Body motion from frame ``i - 1`` to ``i``, or None where none was recorded."""
        ...

    @property
    def ground_truth(self) -> Trajectory | None:
        """True poses ``wTc`` of the reference camera in a world of the recording's choice."""
        ...

    @property
    def truth_frame(self) -> PoseFrame:
        """What the recording states its truth of, in which files of trajectories are, too."""
        ...

    @property
    def notes(self) -> tuple[str, ...]:
        """What was tolerated when opening the recording, in words (missing frames and the like)."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """The images of one instant, in the order right, left[, top]; grey, uint8, (height, width).

    ``index`` counts the recording's own frames (before ``start``/``stop``/``stride``). ``margins``
    are (height, width) of each camera: how far a pixel is from what shows nothing, a black border
    or what a mask hides, in pixels; empty where all images are full. ``alone`` is
    the one camera whose image is to be used, 0 right, 1 left, 2 top; None where all are.
    """

    index: int
    timestamp: float
    images: tuple[Image, ...]
    margins: tuple[Float32, ...] = ()
    alone: int | None = None

    def digest(self) -> int:
        """64 bits of the images' contents: by them a frame is known again in any recording."""
        content = hashlib.blake2b(digest_size=8)
        for image in self.images:
            content.update(np.ascontiguousarray(image).data)
        return int.from_bytes(content.digest(), "little", signed=True)


def clearance(margin: Float32, places: FloatArray) -> FloatArray:
    """How far (n,) places (n, 2) (column, row) are from what shows nothing, pixels.

    Args:
        margin: (height, width) of the image, as in :class:`Frame`.
        places: those outside the image are judged by its nearest pixel.
    """
    height, width = margin.shape
    column, row = np.rint(places).astype(np.int64).T
    return np.asarray(margin[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)])


# ------------------------------------------------------------------------------------------
# Recordings of measurements


@dataclass(frozen=True, eq=False)
class MeasurementRecording:
    """Measurements with identities, replayable by any estimator without a front-end.

    Attributes:
        name: short name for titles.
        identity: hexadecimal digest of what defines the recording.
        log: sensor, motion model and one increment a frame.
        ground_truth: true ``wTc`` of the reference camera or sensor, in a world of the
            recording's choice; None where there is none.
        landmark_truth: true landmark positions in that same world, or None. A landmark that moves
            during the recording is not in it.
        notes: what was tolerated, left out or simulated, in words.
        truth_frame: what the recording states its truth of.
    """

    name: str
    identity: str
    log: MeasurementLog
    ground_truth: Trajectory | None
    landmark_truth: LandmarkTruth | None
    notes: tuple[str, ...]
    truth_frame: PoseFrame = "right"


@dataclass(frozen=True, eq=False)
class LandmarkTruth(Rows):
    """True landmark positions, in the frame of the ground-truth trajectory.

    Attributes:
        ids: (n,) identities as in the log, ascending.
        positions: (n, 3) metres.
    """

    ids: IntArray
    positions: FloatArray


LANDMARK_TRUTH_FILE = "ground_truth_landmarks.csv"
_HEADER = "id,x,y,z,sigma_m"


def write_landmark_truth(path: Path, truth: LandmarkTruth, sigma_m: FloatArray) -> None:
    """Write id, x, y, z (m, the world of ground_truth.tum) and sigma_m: the truth's own error.

    Args:
        path: the file, written atomically.
        truth: n positions.
        sigma_m: (n,) standard error of each; 0 where it is exact.

    Raises:
        OutputError: the file cannot be written.
    """
    lines = [_HEADER]
    for landmark, (x, y, z), sigma in zip(truth.ids, truth.positions + 0.0, sigma_m, strict=True):
        lines.append(f"{landmark},{x:.9f},{y:.9f},{z:.9f},{sigma:.9f}")
    write_text(path, "\n".join(lines) + "\n")


def read_landmark_truth(path: Path) -> tuple[LandmarkTruth, FloatArray]:
    """The positions, ids ascending, and their own standard errors (n,).

    Raises:
        DatasetError: the file is missing or is no such table; the message names the line.
    """
    header, _, rows = read_text(path, remedy="run the experiment again").partition("\n")
    if header != _HEADER:
        raise DatasetError(f"{path}, line 1: not '{_HEADER}'; run the experiment again")
    expected = f"{_HEADER}, as the experiment writes it again"
    values, _ = parse_rows(path, "\n" + rows.replace(",", " "), 5, expected)
    ids = values[:, 0]
    ordered = (np.diff(ids) > 0.0).all() and (ids == np.rint(ids)).all()
    if not (ordered and np.isfinite(values).all()):
        raise DatasetError(
            f"{path}: ids do not increase by whole numbers, or a number is not finite; run the "
            "experiment again"
        )
    truth = LandmarkTruth(ids.astype(np.int64), values[:, 1:4].copy())
    return truth, values[:, 4].copy()


# ------------------------------------------------------------------------------------------
# Whether numbers can be those of a camera rig, wherever they come from

_FOCAL_RANGE = 1000.0
"""Of focal length and image size: at one end a telescope, at the other no picture."""

_LENGTHS = dict.fromkeys(("fx", "fy"), "the focal length in pixels") | dict.fromkeys(
    ("baseline", "vertical_baseline"),
    "the distance between the cameras in metres; one camera alone cannot measure depth, "
    "and a negative one means that left and right are swapped",
)
"""What must be positive, and what it is."""


def rig_fault(rig: CameraRig) -> str:
    """Why the numbers cannot be those of a rig, and what to give; empty where they can."""
    for name in ("width", "height"):
        value = getattr(rig, name)
        if not isinstance(value, int | np.integer) or isinstance(value, bool) or value <= 0:
            return f"{name} is {value!r}; give the images' size in pixels"
    for name, what in _LENGTHS.items():
        value = getattr(rig, name)
        absent = name == "vertical_baseline" and value is None
        if not absent and not (is_finite_number(value) and value > 0.0):
            return f"{name} is {value!r}, not a positive number; give {what}"
    for name in ("fx", "fy"):
        value, size = getattr(rig, name), max(rig.width, rig.height)
        if not size / _FOCAL_RANGE <= value <= size * _FOCAL_RANGE:
            return (
                f"{name} is {value!r} for images of {rig.width}x{rig.height} pixels; give the "
                "focal length in pixels of these images"
            )
    for name, extent in (("cx", rig.width), ("cy", rig.height)):
        value = getattr(rig, name)
        # Cropped images may have it outside, but hardly by more than their own size.
        if not is_finite_number(value) or not -extent <= value <= 2 * extent:
            return (
                f"{name} is {value!r}, far from the image of {rig.width}x{rig.height} pixels; "
                "give the principal point (column, row) in pixels of these images"
            )
    if not isinstance(rig.exact, bool | np.bool_):
        return f"exact is {rig.exact!r}; give True for a rig known without error, as a rendered one"
    if rig.places not in get_args(RigPlaces):
        return f"places is {rig.places!r}; give {' or '.join(get_args(RigPlaces))}"
    if not is_rigid(np.asarray(rig.bTc, np.float64)):
        return (
            "bTc must be a rigid motion (4, 4), the pose of the right camera in the body; "
            "correct it, or leave it out"
        )
    return ""
