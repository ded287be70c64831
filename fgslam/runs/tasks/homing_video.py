"""Task `omni_video`: points tracked through a mirror camera's recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from time import perf_counter

import numpy as np

from fgslam.core.arrays import FloatArray, StateArrays
from fgslam.core.files import make_subfolder
from fgslam.core.store import restore, state_of
from fgslam.datasets.omni import OmniRecording
from fgslam.datasets.omni_checks import open_checked
from fgslam.evaluation.statistics import JsonValue, UpdateTime
from fgslam.frontend.homing.tracking import ReplenishedTracker, TrackedImage
from fgslam.report.content import Column, Picture, TextTable, write_csv
from fgslam.report.homing_figures import Line, curve_figure
from fgslam.runs.config import OmniVideoConfig
from fgslam.runs.engine import (
    Context,
    Opening,
    RunResult,
    Status,
    Task,
    provenance_of,
    write_document,
    write_page,
)

FRAMES_FILE = "frames.csv"
TRACKS_FILE = "tracks.csv"
PICTURES = "pictures"
_TRAIL = 15  # images
_STATE = "state"
SAVE_EVERY_S = 2.0


@dataclass(slots=True, eq=False)
class _Tracks:
    """What is booked, frame by frame and point by point."""

    frames: list[tuple[str, float, int, int, int]] = field(default_factory=list)
    first: dict[int, int] = field(default_factory=dict)
    last: dict[int, int] = field(default_factory=dict)
    track_ms: list[float] = field(default_factory=list)
    read_ms: list[float] = field(default_factory=list)
    trails: dict[int, FloatArray] = field(default_factory=dict)
    pictures: list[Picture] = field(default_factory=list)

    def note(self, name: str, time: float, found: TrackedImage) -> None:
        """Books a frame."""
        frame, ids = len(self.frames), found.tracked.ids.tolist()
        lost = (self.frames[-1][2] if self.frames else 0) - found.survivors
        self.frames.append((name, time, len(ids), len(found.added), lost))
        for identity in ids:
            self.first.setdefault(identity, frame)
            self.last[identity] = frame

    def follow(self, found: TrackedImage, pixels: FloatArray) -> None:
        """The last places of those points that are still there."""
        none = np.empty((0, 2))
        self.trails = {
            i: np.vstack([self.trails.get(i, none)[1 - _TRAIL :], place])
            for i, place in zip(found.tracked.ids.tolist(), pixels, strict=True)
        }

    def lives(self) -> np.ndarray:
        """(n,) frames in which each point was seen."""
        return np.array([self.last[i] - first + 1 for i, first in self.first.items()], np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class _Progress:
    """What the run goes on from: the tracks so far, and the tracker after the last frame."""

    tracks: _Tracks
    tracker: StateArrays


def open_video(config: OmniVideoConfig, opening: Opening) -> Task[RunResult]:
    """Opens the recording and checks its mirror. Raises DatasetError."""
    recording = open_checked(config.dataset)
    return Task(provenance_of(recording), lambda context: _run(config, recording, context))


def _run(config: OmniVideoConfig, recording: OmniRecording, context: Context) -> RunResult:
    """Tracks from the first frame to the last; stopped early, the frames so far count."""
    folder = context.folder
    tracks = _track(config, recording, context)
    status: Status = "finished" if len(tracks.frames) == len(recording) else "interrupted"
    columns = ("frame", "time", "points", "added", "lost")
    write_csv(folder / FRAMES_FILE, columns, tracks.frames)
    rows = [(i, first, tracks.last[i]) for i, first in sorted(tracks.first.items())]
    write_csv(folder / TRACKS_FILE, ("id", "first_frame", "last_frame"), rows)
    numbers = _numbers(tracks)
    result = RunResult(
        config, folder, status, _sentences(numbers), (_table(numbers),), recording.notes
    )
    write_document(result, numbers)
    frames = np.arange(len(tracks.frames), dtype=np.float64)
    counts = np.array([frame[2] for frame in tracks.frames], np.float64)
    words = ("points", "Points followed", "In each frame, new ones included.")
    figure = curve_figure(
        words, [Line("points", 0, frames, counts)], ("frame", "points"), y={"rangemode": "tozero"}
    )
    subtitle = f"{len(tracks.frames)} frames of {recording.name}"
    write_page(result, subtitle, figures=(figure,), pictures=tuple(tracks.pictures))
    return result


def _track(config: OmniVideoConfig, recording: OmniRecording, context: Context) -> _Tracks:
    """Goes on after the last frame that was saved."""
    tracker = ReplenishedTracker(recording.camera, config.least_points, config.most_points)
    tracks = _Tracks()
    if saved := context.store.load(_STATE, _Progress).get(0):
        tracks = saved.tracks
        restore(tracker, saved.tracker)
    shown = np.linspace(0, len(recording), config.output.pictures + 1).astype(int)[1:] - 1
    last_saved = perf_counter()
    for i in range(len(tracks.frames), len(recording)):
        stopped = context.stopped()
        if stopped or perf_counter() - last_saved >= SAVE_EVERY_S:
            context.store.add(_STATE, {0: _Progress(tracks, state_of(tracker))}, _Progress)
            last_saved = perf_counter()
        if stopped:
            break
        _take(tracks, tracker, recording, i)
        if i in shown:
            _draw(tracks, tracker, recording, context.folder)
        context.progress("tracking", i + 1, len(recording))
    return tracks


def _take(tracks: _Tracks, tracker: ReplenishedTracker, recording: OmniRecording, i: int) -> None:
    """Tracks into frame i and books it."""
    start = perf_counter()
    image = recording.image(i)
    read = perf_counter()
    time = float(recording.timestamps[i])
    found = tracker.take(image, time if np.isfinite(time) else float(i))
    tracks.track_ms.append(1e3 * (perf_counter() - read))
    tracks.read_ms.append(1e3 * (read - start))
    tracks.note(recording.names[i], time if np.isfinite(time) else float(i), found)
    tracks.follow(found, tracker.pixels())


def _draw(
    tracks: _Tracks, tracker: ReplenishedTracker, recording: OmniRecording, folder: Path
) -> None:
    """The last frame with the ways of its points."""
    from fgslam.report.pictures import draw_view_tracks  # Matplotlib takes a second

    i = len(tracks.frames) - 1
    name, _, points, added, _ = tracks.frames[i]
    caption = f"{name}: {points} points, {added} of them new"
    path = make_subfolder(folder, PICTURES) / f"tracks_{i:06d}.png"
    view = tracker.view(recording.image(i))
    draw_view_tracks(path, view, list(tracks.trails.values()), caption)
    tracks.pictures.append(Picture(caption, path.read_bytes()))


def _numbers(tracks: _Tracks) -> dict[str, JsonValue]:
    lives, counts = tracks.lives(), np.array([frame[2] for frame in tracks.frames])
    last = len(tracks.frames) - 1
    ended = np.array([tracks.last[i] < last for i in tracks.first], np.bool_)
    spent = float(np.sum(tracks.track_ms))
    return {
        "frames": len(tracks.frames),
        "points_median": _median(counts),
        "points_least": int(counts.min()) if len(counts) else None,
        "tracks": len(lives),
        "track_life_median_frames": _median(lives),
        "ended_track_life_median_frames": _median(lives[ended]),
        "alive_at_the_end": int(np.count_nonzero(~ended)),
        "frames_a_second": 1e3 * len(tracks.frames) / spent if spent else None,
        "track_ms": asdict(UpdateTime.of(np.array(tracks.track_ms))),
        "read_ms": asdict(UpdateTime.of(np.array(tracks.read_ms))),
    }


def _median(values: np.ndarray) -> float | None:
    return float(np.median(values)) if len(values) else None


def _sentences(numbers: dict[str, JsonValue]) -> tuple[str, ...]:
    rate, life = numbers["frames_a_second"], numbers["track_life_median_frames"]
    if not isinstance(rate, float):
        return ("No frame was tracked.",)
    return (
        f"{numbers['points_median']:.0f} points are followed in a frame (median, at least "
        f"{numbers['points_least']}), at {rate:.0f} frames a second without reading them.",
        f"A point is followed through {life:.0f} frames (median of all).",
    )


def _table(numbers: dict[str, JsonValue]) -> TextTable:
    rows: Sequence[tuple[str, str]] = (
        ("frames", "frames"),
        ("points a frame, median", "points_median"),
        ("points a frame, least", "points_least"),
        ("tracks", "tracks"),
        ("life of a track, median, frames", "track_life_median_frames"),
        ("the same of those that ended", "ended_track_life_median_frames"),
        ("frames a second, unwrapping and tracking", "frames_a_second"),
    )
    cells = tuple((name, (_text(numbers[key]),)) for name, key in rows)
    return TextTable("video", "The tracks", "quantity", (Column("value", "of the run"),), cells)


def _text(value: JsonValue) -> str:
    return "-" if value is None else f"{value:.1f}" if isinstance(value, float) else str(value)
