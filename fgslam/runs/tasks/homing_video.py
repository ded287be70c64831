"""Task `omni_video`: points tracked through a mirror camera's recording.

Units: none; the tracker's state is kept now and then. Files: frames.csv, tracks.csv, metrics.json,
pictures of the tracks, the page.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from time import perf_counter

import numpy as np

from fgslam.core.arrays import FloatArray, StateArrays
from fgslam.core.store import restore, state_of
from fgslam.datasets.omni import OmniRecording
from fgslam.datasets.opening import open_checked
from fgslam.evaluation.statistics import JsonValue, UpdateTime
from fgslam.frontend.homing.tracking import ReplenishedTracker
from fgslam.report.content import Picture, write_csv
from fgslam.report.homing_figures import Line, curve_figure
from fgslam.runs.config import OmniVideoConfig
from fgslam.runs.engine import Context, Opening, RunResult, Task, provenance_of
from fgslam.runs.results import draw_picture, finish, median, numbers_table
from fgslam.runs.tasks.homing_drives import trails_after

SAVE_EVERY_S = 2.0
_STATE = "state"
# New points are added where fewer than the first are left, up to the second.
_POINTS = (110, 160)


@dataclass(slots=True, eq=False)
class _Tracks:
    """What is recorded, frame by frame (rows of frames.csv) and point by point."""

    frames: list[tuple[str, float, int, int, int]] = field(default_factory=list)
    first: dict[int, int] = field(default_factory=dict)
    last: dict[int, int] = field(default_factory=dict)
    track_ms: list[float] = field(default_factory=list)
    read_ms: list[float] = field(default_factory=list)
    trails: dict[int, FloatArray] = field(default_factory=dict)
    pictures: list[Picture] = field(default_factory=list)


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
    """Tracks from the first frame, or after the last saved one, to the last.

    Stopped early, the frames so far count.
    """
    folder = context.folder
    tracker = ReplenishedTracker(recording.camera, *_POINTS)
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
            tracks.pictures.append(_draw(tracks, tracker, recording, folder))
        context.progress("tracking", i + 1, len(recording))
    write_csv(folder / "frames.csv", ("frame", "time", "points", "added", "lost"), tracks.frames)
    rows = [(i, first, tracks.last[i]) for i, first in sorted(tracks.first.items())]
    write_csv(folder / "tracks.csv", ("id", "first_frame", "last_frame"), rows)
    numbers = _numbers(tracks)
    names = {
        "frames": "frames",
        "points a frame, median": "points_median",
        "points a frame, least": "points_least",
        "tracks": "tracks",
        "life of a track, median, frames": "track_life_median_frames",
        "the same of those that ended": "ended_track_life_median_frames",
        "frames a second, unwrapping and tracking": "frames_a_second",
    }
    frames = np.arange(len(tracks.frames), dtype=np.float64)
    counts = np.array([frame[2] for frame in tracks.frames], np.float64)
    words = ("points", "Points followed", "In each frame, new ones included.")
    figure = curve_figure(
        words, [Line("points", 0, frames, counts)], ("frame", "points"), y={"rangemode": "tozero"}
    )
    sentence = (
        f"{len(counts)} frames: {numbers['points_median']} points in each (median), each followed "
        f"through {numbers['track_life_median_frames']} frames (median)."
    )
    return finish(
        RunResult(
            config,
            folder,
            "finished" if len(tracks.frames) == len(recording) else "interrupted",
            (sentence if len(counts) else "No frame was tracked.",),
            (numbers_table("video", "The tracks", numbers, names),),
            recording.notes,
        ),
        numbers,
        f"{len(tracks.frames)} frames of {recording.name}",
        figures=(figure,),
        pictures=tuple(tracks.pictures),
    )


def _take(tracks: _Tracks, tracker: ReplenishedTracker, recording: OmniRecording, i: int) -> None:
    """Tracks into frame i and records it."""
    start = perf_counter()
    image = recording.image(i)
    read = perf_counter()
    stamp = float(recording.timestamps[i])
    time = stamp if np.isfinite(stamp) else float(i)
    found = tracker.take(image, time)
    tracks.track_ms.append(1e3 * (perf_counter() - read))
    tracks.read_ms.append(1e3 * (read - start))
    ids = found.tracked.ids.tolist()
    lost = (tracks.frames[-1][2] if tracks.frames else 0) - found.survivors
    tracks.frames.append((recording.names[i], time, len(ids), len(found.added), lost))
    for identity in ids:
        tracks.first.setdefault(identity, i)
        tracks.last[identity] = i
    tracks.trails = trails_after(tracks.trails, ids, tracker.pixels())


def _draw(
    tracks: _Tracks, tracker: ReplenishedTracker, recording: OmniRecording, folder: Path
) -> Picture:
    """The last frame with the paths of its points."""
    from fgslam.report.pictures import draw_view_tracks  # Matplotlib takes a second

    i = len(tracks.frames) - 1
    name, _, points, added, _ = tracks.frames[i]
    caption = f"{name}: {points} points, {added} of them new"
    view, trails = tracker.view(recording.image(i)), list(tracks.trails.values())
    draw = partial(draw_view_tracks, view=view, trails=trails, title=caption)
    return draw_picture(folder, f"tracks_{i:06d}.png", caption, draw)


def _numbers(tracks: _Tracks) -> dict[str, JsonValue]:
    lives = np.array([tracks.last[i] - first + 1 for i, first in tracks.first.items()], np.int64)
    counts = np.array([frame[2] for frame in tracks.frames])
    last = len(tracks.frames) - 1
    ended = np.array([tracks.last[i] < last for i in tracks.first], np.bool_)
    spent = float(np.sum(tracks.track_ms))
    return {
        "frames": len(tracks.frames),
        "points_median": median(counts),
        "points_least": int(counts.min()) if len(counts) else None,
        "tracks": len(lives),
        "track_life_median_frames": median(lives),
        "ended_track_life_median_frames": median(lives[ended]),
        "alive_at_the_end": int(np.count_nonzero(~ended)),
        "frames_a_second": 1e3 * len(tracks.frames) / spent if spent else None,
        "track_ms": asdict(UpdateTime.of(np.array(tracks.track_ms))),
        "read_ms": asdict(UpdateTime.of(np.array(tracks.read_ms))),
    }
