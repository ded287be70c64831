"""What is in a recording, and what is wrong with it, in words (docs/howto/inspect.md)."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from collections.abc import Sequence as Items
from pathlib import Path
from typing import TypeAlias

from fgslam.core.recordings import Sequence
from fgslam.datasets.checks.motion import (
    check_clock,
    check_odometry,
    check_odometry_against_truth,
    check_truth,
)
from fgslam.datasets.checks.recording import (
    Finding,
    Level,
    by_severity,
    check_calibration,
    check_images,
    check_timing,
    share,
)
from fgslam.datasets.layouts import kitti_drives
from fgslam.datasets.settings import KittiSettings, MeasurementDatasetSettings, RenderedLabSettings
from fgslam.runs.bare_recording import dataset_of, require_no_camera
from fgslam.runs.config import ExperimentConfig, load_config, make_config
from fgslam.runs.inspection_matches import judge_matches, look_at_frames, match_facts
from fgslam.runs.opening import open_sequence

Progress = Callable[[str, int, int], None]
"""Called with what is under way, how much is done, and of how much."""

Facts: TypeAlias = tuple[tuple[str, str], ...]
"""Labels and values."""

_READ_AT_LEAST = 300  # frames whose images are read; a few seconds
_YAML = (".yaml", ".yml")


def inspect_recording(
    dataset: Path,
    overrides: Items[str] = (),
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
    config = configure(dataset, overrides, camera)
    sequence = open_sequence(config, lambda done, total: progress("rendering", done, total))
    read = max(frames, _READ_AT_LEAST)
    general = check_sequence(sequence, read, lambda done, total: progress("reading", done, total))
    looks = look_at_frames(
        sequence, config.frontend, frames, lambda done, total: progress("matching", done, total)
    )
    stereo = config.frontend.stereo
    findings = by_severity((*general, *judge_matches(looks, sequence.rig, stereo)))
    seen: Facts = (
        ("images read", _images_read(min(read, len(sequence)), len(sequence))),
        *match_facts(looks, sequence.rig, stereo),
    )
    return render_report((*facts_of(sequence), *_opening_facts(config)), seen, findings)


def _images_read(read: int, frames: int) -> str:
    all_of_them = "" if read == frames else f", evenly spread; --frames {frames} reads all"
    return f"{share(read, frames)} frames{all_of_them}"


def check_sequence(
    sequence: Sequence,
    samples: int = 20,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[Finding, ...]:
    """Findings of all checks that need no features, the worst first.

    Args:
        sequence: the recording.
        samples: how many frames, spread over it, are read.
        progress: called with how many of these have been read, and how many there are.
    """
    return by_severity(
        (
            *(Finding(Level.WARNING, "recording", note) for note in sequence.notes),
            *check_calibration(sequence.rig),
            *check_timing(sequence.timestamps),
            *check_images(sequence, samples, progress),
            *check_odometry(sequence),
            *check_truth(sequence),
            *check_odometry_against_truth(sequence),
            *check_clock(sequence),
        )
    )


def facts_of(sequence: Sequence) -> Facts:
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


def configure(dataset: Path, overrides: Items[str], camera: Path | None = None) -> ExperimentConfig:
    """The experiment's configuration, or the default one for a folder in a known layout.

    Raises:
        FgslamError: the layout is not known, or the configuration is wrong.
    """
    if dataset.suffix.lower() in _YAML:
        require_no_camera(dataset, camera)
        return load_config(dataset, overrides)
    # The kind is named so that an override of one of its keys finds it.
    odometry = {"kind": "recorded"}
    keys = dataset_of(dataset, camera, tuple(overrides))
    values = {"name": "inspect", "dataset": keys, "odometry": odometry}
    return make_config(values, str(dataset), overrides)


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


_WIDTH = 100
_MOTION = ("ground truth", "odometry", "odometry against truth")


def render_report(recording: Facts, seen: Facts, findings: tuple[Finding, ...]) -> str:
    """Aligned facts, then the findings with their fixes, then the conclusion.

    Args:
        recording: what it is.
        seen: what its images show.
        findings: the worst first; those that only tell something stand among the facts.
    """
    information = [(f.subject, f.text) for f in findings if f.level is Level.INFO]
    moved = tuple(fact for fact in information if fact[0] in _MOTION)
    matched = tuple(fact for fact in information if fact[0] not in _MOTION)
    width = max(len(label) for label, _ in (*recording, *seen, *information))
    bad = tuple(
        (f.level.value.upper(), f"{f.subject}: {f.text}")
        for f in findings
        if f.level is not Level.INFO
    )
    blocks = [_aligned(facts, width) for facts in (recording, moved, (*seen, *matched))]
    blocks += [_aligned(bad, len(Level.PROBLEM.value)), _conclusion(findings)]
    return "\n\n".join(block for block in blocks if block)


def _conclusion(findings: tuple[Finding, ...]) -> str:
    problems = sum(f.level is Level.PROBLEM for f in findings)
    warnings = sum(f.level is Level.WARNING for f in findings)
    if problems:
        also = f" and {_counted(warnings, 'warning')}" if warnings else ""
        return f"{_counted(problems, 'problem')}{also}: problems spoil a run, or the frames named."
    if warnings:
        return f"No problem, {_counted(warnings, 'warning')}."
    return "No problem found."


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _aligned(rows: Facts, width: int) -> str:
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
