"""The page of what each experiment still sets beside its data, and why; one reason a setting."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from scripts.reference_settings import item, paragraph

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
_GROUPS = ("odometry", "frontend", "estimator", "compare")
_NAMES = ("kind", "label")
PAPER = "se_lowe_little_2001"
"""The experiment whose settings are its subject: the paper's own pipeline."""

REASONS = {
    "odometry.time_offset_s": "the robot: its odometry's clock, measured from the images",
    "odometry.translation_sigma_fraction": "the data: truth and stated noise stand in for odometry",
    "odometry.rotation_sigma_deg": "the data: as above",
    "frontend.ego_motion.dof": "the robot: it drives on a flat floor",
    "frontend.tracking": "the subject: how long landmarks last, which few key frames of `hybrid` "
    "would decide",
    "frontend.database.permanence": "the subject: landmarks that last",
    "frontend.database.viewpoints": "the subject: landmarks seen from several sides",
    "frontend.database.forget_unconfirmed_after": "the subject: a passer-by is forgotten",
    "frontend.loops": "the subject: loops are closed",
    "frontend.ego_motion.min_matches": "the data: few landmarks, each identified by its label",
    "frontend.ego_motion.outlier_px": "the data: its noise is 6 columns and 11 rows",
    "frontend.relocalisation.max_sigma_m": "the subject: how exact an answer is, truth judges",
    "frontend.relocalisation.max_sigma_deg": "the subject: as above",
    "frontend.database.least_scale_px": "cost on a map of 20,000 landmarks; loses no match",
    "compare.update": "the subject: the paper's update to the letter, beside ours",
    "compare.method": "the subject: another solver, beside the default",
    "compare.keyframe_every": "the subject: the cheap graph of keyframes, beside the others",
    "compare.update_every": "the subject: as above",
    "compare.ordering_window": "the subject: as above",
}
"""Why a setting may stand in an experiment; a setting without a reason fails the test."""

BY_HAND = {
    "frontend.stereo.pixel_sigma": "noise of SIFT, measured on rendered images against the truth",
    "estimator.noise_factor": "how long errors persist: an estimate by default, "
    "with which these are not measured",
    "compare.noise_factor": "as above; on EuRoC odometry is the truth with noise, and the less "
    "images count the better",
    "frontend.database.valid_hits": "frames half a metre apart: by the default 35 of 50 queries "
    "are found, by two hits 45",
}
"""Numbers that are still set by hand, to be replaced by estimates; no new one may be added."""

_HEAD = """# What each experiment still sets

<!-- Made by `python -m scripts.make_reference` from experiments/*.yaml: edit those. -->

Every experiment of SLAM, and a recording without any (`fgslam run RECORDING`), takes the same
defaults for features, matching, ego-motion and noise. Beside the data set the files set what
follows, for the reason given. A test fails where a setting has no reason here.
"""
_STILL = """## Still set by hand

Numbers of estimation that are to become estimates themselves; no other may be set:
"""


def experiments_page() -> str:
    """The whole page, in Markdown."""
    sets = {name: settings_of(values) for name, values in slam_experiments()}
    paper = "; ".join(f"`{key}: {_short(value)}`" for key, value in sets.pop(PAPER).items())
    nothing = ", ".join(f"`{name}`" for name, found in sets.items() if not found)
    lines = [_HEAD, *_settings(sets, REASONS), *item(f"nothing at all: {nothing}"), ""]
    lines += [*paragraph(f"`{PAPER}` is the paper's own pipeline, its settings its subject:"), ""]
    return "\n".join([*lines, *item(paper), "", _STILL, *_settings(sets, BY_HAND)]) + "\n"


def _settings(
    sets: Mapping[str, Mapping[str, object]], reasons: Mapping[str, str]
) -> Iterator[str]:
    """An item for each setting that has a reason: why, and which experiments set it to what."""
    for key, why in reasons.items():
        users: dict[str, list[str]] = {}
        for name, found in sets.items():
            if key in found:
                users.setdefault(_short(found[key]), []).append(f"`{name}`")
        for value, names in users.items():
            yield from item(f"`{key}: {value}`: {why} ({', '.join(names)})")


def slam_experiments() -> Iterator[tuple[str, dict[str, Any]]]:
    """Name and plain values of every experiment of SLAM and of localisation."""
    for path in sorted(EXPERIMENTS.glob("*.yaml")):
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
        if values.get("task") in (None, "localisation"):
            yield path.stem, values


def settings_of(values: Mapping[str, Any]) -> dict[str, Any]:
    """Dotted keys and values that a file sets beside its data, names of kinds apart."""
    out: dict[str, Any] = {}
    for group in _GROUPS:
        inner = values.get(group, {})
        listed = inner if isinstance(inner, list) else [inner]
        for one in listed:
            if isinstance(one, dict):
                out |= {f"{group}.{key}": value for key, value in _leaves(one)}
    return out


def unreasoned() -> list[str]:
    """Settings without a reason, as `experiment: key`; empty where all is well."""
    return [
        f"{name}: {key}"
        for name, values in slam_experiments()
        for key in settings_of(values)
        if name != PAPER and key not in REASONS and key not in BY_HAND
    ]


def _leaves(values: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, dict) and value:
            yield from _leaves(value, f"{above}{key}.")
        elif key not in _NAMES:
            yield f"{above}{key}", value


def _short(value: object) -> str:
    return yaml.safe_dump(value, default_flow_style=True).removesuffix("...\n").strip()
