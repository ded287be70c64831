"""What is in a recording, and what is wrong with it (docs/howto/your_recording.md).

A check returns findings as data: a code, and the values of its sentence (:mod:`findings`).
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.lib.stride_tricks import sliding_window_view

from fgslam.core.arrays import FloatArray, Image, thinned
from fgslam.core.errors import DatasetError, FrameError, OdometryError
from fgslam.core.geometry import inverse, se3_log, so3_log
from fgslam.core.log import ImageSequence
from fgslam.core.sensors import CAMERA_NAMES, CameraRig
from fgslam.core.types import Trajectory
from fgslam.datasets.clock import SeenTurns, judged
from fgslam.datasets.layouts import kitti_drives
from fgslam.datasets.recording import Recording
from fgslam.datasets.settings import KittiSettings, MeasurementDatasetSettings, RenderedLabSettings
from fgslam.datasets.times import rows_at
from fgslam.evaluation.statistics import path_length
from fgslam.runs.bare import dataset_of, require_no_camera
from fgslam.runs.config import ExperimentConfig, load_config, make_config
from fgslam.runs.findings import (
    AGAINST_TRUTH,
    ODOMETRY,
    TRUTH,
    Finding,
    Level,
    by_severity,
    finding,
    first_of,
    share,
)
from fgslam.runs.inspect_matches import Facts, check_matches, match_facts, match_frames
from fgslam.runs.opening import open_sequence
from fgslam.runs.units import Progress

_READ_AT_LEAST = 300  # frames whose images are read; a few seconds


def inspect_recording(
    dataset: Path,
    overrides: Sequence[str] = (),
    frames: int = 12,
    progress: Progress = lambda what, done, total: None,
    camera: Path | None = None,
) -> str:
    """The report on a recording, as text.

    Args:
        dataset: folder of a recording in any known layout, or an experiment's .yaml.
        overrides: ``a.b=value`` for the configuration, that of the file or the default one.
        frames: in how many frames, spread over the recording, features are matched.
        progress: called after each frame.
        camera: calibration of a folder's recording, in place of its own.

    Raises:
        FgslamError: the recording cannot be opened at all, or the configuration is wrong.
    """
    if dataset.suffix.lower() in (".yaml", ".yml"):
        require_no_camera(dataset, camera)
        config = load_config(dataset, overrides)
    else:  # the kind is named so that an override of one of its keys finds it
        keys = dataset_of(dataset, camera, tuple(overrides))
        values = {"name": "inspect", "dataset": keys, "odometry": {"kind": "recorded"}}
        config = make_config(values, str(dataset), overrides)
    sequence = open_sequence(config, progress)
    read = max(frames, _READ_AT_LEAST)
    general = check_sequence(sequence, read, progress)
    matched = match_frames(sequence, config.frontend, frames, progress)
    stereo = config.frontend.stereo
    findings = by_severity((*general, *check_matches(matched, sequence.rig, stereo)))
    count = min(read, len(sequence))
    more = "" if count == len(sequence) else f", evenly spread; --frames {len(sequence)} reads all"
    seen: Facts = (
        ("images read", f"{share(count, len(sequence))} frames{more}"),
        *match_facts(matched, sequence.rig, stereo),
    )
    ledger = [(entry.what, entry.shown) for entry in getattr(sequence, "ledger", ())]
    facts = (*facts_of(sequence), *ledger, *_opening_facts(config))
    return render_report(facts, seen, findings)


def check_sequence(
    sequence: ImageSequence,
    samples: int = 20,
    progress: Progress = lambda what, done, total: None,
) -> tuple[Finding, ...]:
    """Findings of all checks that need no features, the worst first.

    Args:
        sequence: the recording.
        samples: how many frames, spread over it, are read.
        progress: called after each of these.
    """
    return by_severity(
        (
            *(finding("note", text=note) for note in sequence.notes),
            *check_calibration(sequence.rig),
            *check_timing(sequence.timestamps),
            *check_images(sequence, samples, progress),
            *check_odometry(sequence),
            *check_truth(sequence),
            *check_odometry_against_truth(sequence),
            *check_clock(sequence),
        )
    )


# --------------------------------------------------------------------------------------------
# Images, calibration, time


_DARK, _BRIGHT, _FLAT_SIGMA = 8.0, 247.0, 2.0
_MAX_BRIGHTNESS_RATIO = 1.5
_KINDS = {"black": "too dark", "white": "over-exposed", "flat": "without any structure"}
_WIDEST_DEG = 140.0  # of usual fields of view
_GAP_FACTOR = 1.8


def _kind(image: Image) -> str:
    """``black``, ``white``, ``flat`` or ``good``."""
    low, high = np.percentile(image, [1.0, 99.0])
    if high < _DARK:
        return "black"
    if low > _BRIGHT:
        return "white"
    return "flat" if float(image.std()) < _FLAT_SIGMA else "good"


def check_images(
    sequence: ImageSequence,
    samples: int = 20,
    progress: Progress = lambda what, done, total: None,
) -> tuple[Finding, ...]:
    """Unreadable, black, white and flat images, cameras of unequal brightness, copies.

    Reads up to ``samples`` frames, evenly spread, with the first and the last.
    """
    chosen = thinned(len(sequence), samples).tolist()
    unreadable: list[str] = []
    # Of every image frame, camera, kind, mean grey value, and equality to the right one: the images
    # of a long recording would fill the memory.
    rows: list[tuple[int, int, str, float, bool]] = []
    for done, i in enumerate(chosen, 1):
        try:
            frame = sequence.frame(i)
        except FrameError as error:
            unreadable.append(str(error))
        else:
            for c, image in enumerate(frame.images):
                same = np.array_equal(frame.images[0], image)
                rows.append((frame.index, c, _kind(image), float(image.mean()), same))
        progress("reading", done, len(chosen))
    found: list[Finding] = []
    if unreadable:
        part = share(len(unreadable), len(chosen))
        found.append(finding("unreadable", share=part, first=unreadable[0]))
    seen = pd.DataFrame(rows, columns=["frame", "camera", "kind", "mean", "same"])
    right = seen[seen.camera == 0]
    for kind, meaning in _KINDS.items():
        for c, camera in enumerate(CAMERA_NAMES):
            bad = seen[(seen.kind == kind) & (seen.camera == c)].frame.tolist()
            values = {"camera": camera, "kind": kind, "meaning": meaning}
            values |= {"share": share(len(bad), len(right)), "frames": first_of(bad)}
            found += [finding("uninformative", **values)] if bad else []
    for c, camera in enumerate(CAMERA_NAMES[1:], 1):
        both = seen[seen.camera == c].merge(right, on="frame", suffixes=("", "_right"))
        # Images without content are reported already; they are all equal.
        both = both[(both.kind == "good") & (both.kind_right == "good")]
        if both.empty:
            continue
        if copies := int(both.same.sum()):
            part = share(copies, len(both))
            found.append(finding("copies", camera=camera, share=part))
        ratio = float(np.median((both.mean_right + 1.0) / (both["mean"] + 1.0)))
        if max(ratio, 1.0 / ratio) > _MAX_BRIGHTNESS_RATIO:
            found.append(finding("brightness", camera=camera, ratio=ratio))
    return tuple(found)


def check_calibration(rig: CameraRig) -> tuple[Finding, ...]:
    """Values that a calibration may have but hardly ever does."""
    found = []
    if not (0.0 < rig.cx < rig.width and 0.0 < rig.cy < rig.height):
        found.append(finding("principal_point", rig=rig))
    if not 0.95 < rig.fx / rig.fy < 1.05:
        found.append(finding("focal_lengths", rig=rig))
    view = rig.angles_deg[0]
    if not 15.0 < view < _WIDEST_DEG:
        found.append(finding("field_of_view", view=view))
    baselines = {"baseline": rig.baseline, "vertical baseline": rig.vertical_baseline}
    for name, value in baselines.items():
        if value is not None and not 0.002 < value < 3.0:
            found.append(finding("baseline", name=name, value=value))
    return tuple(found)


def check_timing(stamps: FloatArray) -> tuple[Finding, ...]:
    """Gaps between frames: steps longer than 1.8 median ones. Stamps (n,) in seconds."""
    if len(stamps) < 3:
        return (finding("few_frames", count=len(stamps)),)
    steps = np.diff(stamps)
    median = float(np.median(steps))
    long = np.flatnonzero(steps > _GAP_FACTOR * median)
    if len(long) == 0:
        return ()
    worst = int(long[np.argmax(steps[long])])
    values = {"long": len(long), "steps": len(steps), "factor": _GAP_FACTOR, "median": median}
    return (finding("gaps", **values, longest=steps[worst], worst=worst),)


# --------------------------------------------------------------------------------------------
# Odometry and ground truth: coverage, jumps, agreement, and the odometry's clock


_STAMP_TOLERANCE_S = 1e-3
_NO_MOTION = 1e-9  # metres, and of a rotation: rounding
_MAX_JUMP = 8.0
_STEPS_AROUND = 3
_SMALLEST_JUMP_M = 0.05  # below it a standing camera's truth trembles, whatever its rate
_MAX_NOISE_RATIO = 3.0
_TANGENT_NAMES = (
    *("roll", "pitch", "yaw"),
    *("forward motion", "sideways motion", "vertical motion"),
)


def check_odometry(sequence: ImageSequence) -> tuple[Finding, ...]:
    """Whether motions are recorded, where they are missing, and whether they are all none."""
    try:
        given = [sequence.odometry(i) for i in range(1, len(sequence))]
    except DatasetError as error:
        return (finding("odometry_malformed", text=str(error)),)
    missing = [i for i, step in enumerate(given, 1) if step is None]
    if len(missing) == len(given):
        return (finding("no_odometry"),)
    covers = finding("odometry_covers", share=share(len(given) - len(missing), len(given)))
    if missing:
        return covers, finding("odometry_gaps", frames=first_of(missing))
    if all(s is not None and np.abs(s.motion - np.eye(4)).max() <= _NO_MOTION for s in given):
        return covers, finding("odometry_frozen", steps=len(given))
    return (covers,)


def check_truth(sequence: ImageSequence) -> tuple[Finding, ...]:
    """Whether ground truth covers the frames, its length, and jumps in it."""
    truth = sequence.ground_truth
    if truth is None or len(truth) == 0:
        return (finding("no_truth"),)
    matched = int((rows_at(truth.timestamps, sequence.timestamps, _STAMP_TOLERANCE_S) >= 0).sum())
    covered = {"share": share(matched, len(sequence)), "length": path_length(truth.poses)}
    covers = finding("truth_covers", **covered)
    jumps = _jumps(truth)
    if not jumps:
        return (covers,)
    return covers, finding("truth_jumps", poses=first_of(jumps), factor=_MAX_JUMP)


def _jumps(truth: Trajectory) -> list[int]:
    """Rows that are reached many times faster than the rows around them, and than most others.

    A robot that stands for long and then drives is fast against the median, yet not against the
    steps that follow. A jump is one step, of one bad pose two.
    """
    if len(truth) < _STEPS_AROUND + 2:
        return []
    step = np.linalg.norm(np.diff(truth.poses[:, :3, 3], axis=0), axis=1)
    speed = step / np.diff(truth.timestamps)
    around = sliding_window_view(np.pad(speed, _STEPS_AROUND, mode="reflect"), _STEPS_AROUND)
    local = np.median(around, axis=1)
    before, after = local[: len(speed)], local[_STEPS_AROUND + 1 :]
    usual = np.maximum(np.maximum(before, after), np.quantile(speed, 0.9))
    jumps = (speed > _MAX_JUMP * usual) & (step > _SMALLEST_JUMP_M)
    return [int(k) + 1 for k in np.flatnonzero(jumps)]


def check_odometry_against_truth(sequence: ImageSequence) -> tuple[Finding, ...]:
    """Errors of the odometry's steps against the truth's, and against the stated noise.

    The spread is the median absolute error, scaled to a normal distribution's standard deviation,
    so that a few bad poses of the truth do not decide.
    """
    true = _true_motions(sequence)
    try:
        steps = [sequence.odometry(i + 1) for i in range(len(true))]
    except DatasetError:
        return ()  # check_odometry has reported it.
    known = [
        (step, motion)
        for step, motion in zip(steps, true, strict=True)
        if step is not None and np.isfinite(motion[0, 0])
    ]
    if len(known) < 5:
        return ()
    errors = np.array([se3_log(inverse(step.motion) @ motion) for step, motion in known])
    sigmas = np.array([np.sqrt(np.diag(step.covariance)) for step, _ in known])
    spread = 1.4826 * np.median(np.abs(errors), axis=0)
    ratio = spread / np.median(sigmas, axis=0)
    values = {"yaw_deg": np.degrees(spread[2]), "forward_cm": 100.0 * spread[3]}
    found = [finding("odometry_error", **values, steps=len(errors))]
    for k in np.flatnonzero(ratio > _MAX_NOISE_RATIO):
        found.append(finding("odometry_noise", name=_TANGENT_NAMES[k], ratio=ratio[k]))
    return tuple(found)


def _true_motions(sequence: ImageSequence) -> FloatArray:
    """Motions (n - 1, 4, 4) of the body between frames by the truth; NaN where it has gaps."""
    truth = sequence.ground_truth
    out = np.full((max(len(sequence) - 1, 0), 4, 4), np.nan)
    if truth is not None and len(truth):
        rows = rows_at(truth.timestamps, sequence.timestamps, _STAMP_TOLERANCE_S)
        body = truth.poses @ inverse(sequence.rig.bTc)
        known = (rows[:-1] >= 0) & (rows[1:] >= 0)
        out[known] = inverse(body[rows[:-1][known]]) @ body[rows[1:][known]]
    return out


def check_clock(sequence: ImageSequence) -> tuple[Finding, ...]:
    """Odometry's clock and unit by the truth's turns, judged as by those that images show."""
    if not isinstance(sequence, Recording) or sequence.odometry_source is None:
        return ()
    true = _true_motions(sequence)[:, :3, :3]
    known = np.flatnonzero(np.isfinite(true[:, 0, 0]))
    turns = np.array([so3_log(turn) for turn in true[known]]).reshape(-1, 3)
    try:
        seen = SeenTurns.of(sequence, known + 1, turns)
    except DatasetError:
        return ()  # check_odometry has reported it.
    try:
        shift = judged(seen).time_offset_s
    except OdometryError as error:
        return (finding("odometry_malformed", text=str(error)),)
    return (finding("odometry_clock", shift=shift),) if shift else ()


# --------------------------------------------------------------------------------------------
# Facts


def facts_of(sequence: ImageSequence) -> Facts:
    """Label and value of what the recording is."""
    rig, stamps = sequence.rig, sequence.timestamps
    duration = float(stamps[-1] - stamps[0])
    rate = f"{(len(stamps) - 1) / duration:.3g} Hz" if duration > 0.0 else "single frame"
    view = rig.angles_deg
    vertical = "" if rig.vertical_baseline is None else f", {rig.vertical_baseline:.4g} m vertical"
    place = ", ".join(f"{x + 0.0:.3g}" for x in rig.bTc[:3, 3])
    return (
        ("recording", sequence.name),
        ("frames", f"{len(stamps)} over {duration:.4g} s"),
        ("rate", rate),
        ("cameras", f"{rig.cameras}, {rig.width}x{rig.height}"),
        ("focal length", f"{rig.fx:.5g} x {rig.fy:.5g} px, view {view[0]:.0f} x {view[1]:.0f} deg"),
        ("principal point", f"{rig.cx:.5g}, {rig.cy:.5g} px"),
        ("baseline", f"{rig.baseline:.4g} m{vertical}"),
        ("camera's place", f"({place}) m in the robot's body"),
        ("one pixel of disparity", f"is {rig.fx * rig.baseline:.3g} m away"),
        ("identity", sequence.identity[:16]),
    )


def _opening_facts(config: ExperimentConfig) -> Facts:
    """What to write into an experiment's configuration to use this recording."""
    dataset = config.dataset
    if isinstance(dataset, RenderedLabSettings | MeasurementDatasetSettings):
        return (("opened as", f"{dataset.kind}, seed {config.seed}"),)
    opened = f"dataset.kind {dataset.kind}, dataset.path {dataset.path}"
    if not isinstance(dataset, KittiSettings):
        return (("opened as", opened),)
    facts = [("opened as", f'{opened}, dataset.sequence "{dataset.sequence}"')]
    others = [d for d in kitti_drives(Path(dataset.path)) if d != dataset.sequence]
    if others:
        folder = Path(dataset.path) / "sequences"
        facts.append(("other drives", f"{', '.join(others)}: inspect {folder}/NN"))
    return tuple(facts)


# --------------------------------------------------------------------------------------------
# The report


_WIDTH = 100


def render_report(recording: Facts, seen: Facts, findings: tuple[Finding, ...]) -> str:
    """Aligned facts, then the findings with their fixes, then the conclusion.

    Args:
        recording: what it is.
        seen: what its images show.
        findings: the worst first; those that only inform stand among the facts.
    """
    information = [(f.subject, f.text) for f in findings if f.level is Level.INFO]
    motion = (TRUTH, ODOMETRY, AGAINST_TRUTH)
    moved = [fact for fact in information if fact[0] in motion]
    matched = [fact for fact in information if fact[0] not in motion]
    bad = [f for f in findings if f.level is not Level.INFO]
    width = max(len(label) for label, _ in (*recording, *seen, *information))
    blocks = [_aligned(facts, width) for facts in (recording, moved, (*seen, *matched))]
    rows = [(f.level.value.upper(), f"{f.subject}: {f.text}") for f in bad]
    blocks.append(_aligned(rows, len(Level.PROBLEM.value)))
    problems, warnings = (
        sum(f.level is level for f in bad) for level in (Level.PROBLEM, Level.WARNING)
    )
    conclusion = "No problem found."
    if warnings:
        conclusion = f"No problem, {_counted(warnings, 'warning')}."
    if problems:
        also = f" and {_counted(warnings, 'warning')}" if warnings else ""
        bad_frames = "problems spoil a run, or the frames named."
        conclusion = f"{_counted(problems, 'problem')}{also}: {bad_frames}"
    return "\n\n".join(block for block in (*blocks, conclusion) if block)


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _aligned(rows: Iterable[tuple[str, str]], width: int) -> str:
    """Two columns, the first ``width`` wide, the second wrapped under itself; no word is broken."""
    indent = width + 2
    return "\n".join(
        textwrap.fill(
            value,
            _WIDTH,
            initial_indent=label.ljust(indent),
            subsequent_indent=" " * indent,
            break_long_words=False,
            break_on_hyphens=False,
        )
        for label, value in rows
    )
