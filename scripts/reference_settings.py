"""The page of settings, made from the schema: every key, its default, range and meaning."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any, TypeAlias

from fgslam.runs.config import ExperimentConfig
from fgslam.runs.config_models import HOMING_TASKS, TASKS, LocalisationConfig
from scripts.markdown import item, paragraph

Node: TypeAlias = dict[str, Any]

_UNWRITTEN = ("kind", "task", "provenance")
_DESCRIBED_ELSEWHERE = ("map.made_from.dataset", "map.made_from.odometry")
FIRST = {
    "dataset.kind, dataset.path, dataset.start, dataset.stop": "the recording: its layout, its "
    "folder, and which part of it",
    "odometry.kind": "`recorded`, `constant_velocity`, or `synthetic` (truth plus stated noise)",
    "estimator.kind, compare": "the estimator that steers the run, and those that replay its "
    "measurements",
    "seed": "of everything random in the run",
    "frontend.ego_motion.dof": "3 on a flat floor, 5 at a fixed height, 6 for a rig in the hand",
    "frontend.stereo.pixel_sigma, frontend.stereo.max_disparity_px": "standard deviation of a "
    "feature's place in the image; what is nearer than this disparity is not matched",
    "estimator.noise_factor": "above 1 on images, whose errors persist from frame to frame",
    "estimator.lag_frames, estimator.keyframe_every": "how far back `fixed_lag` looks; every how "
    "many frames `isam2` keeps one",
    "frontend.loops": "`{}` switches loop closing on",
    "map.load, map.save": "saved maps: begin in one, write one",
}
"""What a user sets first, by key."""

_INTRODUCTION = """# Settings

<!-- Made by `python -m scripts.make_reference`: edit the settings' descriptions, not this page. -->

An experiment is one YAML file; `experiments/` has examples. Any key can be set from the command
line, too: `fgslam run CONFIG.yaml --set frontend.sift.octave_layers=3 --set dataset.stop=null`. The
last value of a key wins. An override that chooses another `kind` drops the file's keys of the old
one. Unknown keys, keys given twice, NaN and infinity are refused. A run writes the resolved
configuration, every default filled in, to `RUN/config.yaml`; that file is itself a configuration
and repeats the run.

Keys without a default must be given. Units are metres, seconds and pixels, angles in degrees,
unless the key's name or meaning says otherwise. Experiments of homing have a key `task`: see
[homing experiments](#homing-experiments).
"""

_LOCALISATION = """## Task `localisation`

{described}
`dataset`, `odometry`, `frontend`, `estimator` and `output` have the keys that they have above;
`estimator` is that of the drive that makes the map.
"""

_HOMING = """## Homing experiments

Each task has its own keys; the groups of keys that they share are described once, below all of
them.
"""


def settings_page() -> str:
    """The whole page, in Markdown."""
    schema = ExperimentConfig.model_json_schema()
    first = [line for key, described in FIRST.items() for line in item(f"`{key}`: {described}")]
    sections = [_INTRODUCTION, "## The ten that matter first\n\n" + "\n".join(first)]
    sections += ["## The experiment\n\n" + "\n".join(_keys(schema, schema))]
    for name, node in schema["properties"].items():
        if name not in _UNWRITTEN:
            sections += _sections(schema, node, name, 2)
    sections += _localisation()
    sections += _homing()
    return "\n".join(section.rstrip() + "\n" for section in sections)


def _localisation() -> Iterator[str]:
    """The keys that only this task has; the others are those of the experiments above."""
    schema = LocalisationConfig.model_json_schema()
    described = " ".join(schema.get("description", "").split())
    yield (
        _LOCALISATION.format(described="\n".join(paragraph(described)))
        + "\n"
        + "\n".join(_keys(schema, schema))
    )
    for name in ("map", "localisation"):
        for section in _sections(schema, schema["properties"][name], name, 3):
            yield section.replace("`map`", "`map` of the task `localisation`", 1)


def _homing() -> Iterator[str]:
    """The keys of each task, then the groups of all of them, each once."""
    yield _HOMING
    groups: dict[str, None] = {}
    for task in HOMING_TASKS:
        schema = TASKS[task].model_json_schema()
        described = " ".join(schema.get("description", "").split())
        yield "\n".join(
            [f"### Task `{task}`", "", *paragraph(described), "", *_keys(schema, schema)]
        )
        for name, node in schema["properties"].items():
            if name not in _UNWRITTEN:
                groups |= dict.fromkeys(_sections(schema, node, name, 3))
    yield from groups


def _sections(schema: Node, node: Node, dotted: str, level: int) -> Iterator[str]:
    """One section for each group of keys below a node, one for each kind of a union."""
    groups = [_resolve(schema, part) for part in _alternatives(node)]
    for group in (g for g in groups if "properties" in g):
        kind = group["properties"].get("kind", {}).get("const")
        title = f"`{dotted}`" + (f", kind `{kind}`" if kind else "")
        described = " ".join(group.get("description", "").split())
        lines = [f"{'#' * level} {title}", "", *([*paragraph(described), ""] if described else [])]
        keys = _keys(schema, group)
        yield "\n".join([*lines, *(keys or ["Groups of keys:"])])
        for name, inner in group["properties"].items():
            below = f"{dotted}.{name}"
            if name not in _UNWRITTEN and below not in _DESCRIBED_ELSEWHERE:
                yield from _sections(schema, inner, below, min(level + 1, 4))


def _keys(schema: Node, group: Node) -> list[str]:
    """Items of the keys that hold a value or may be switched on; nothing where there are none."""
    lines: list[str] = []
    for name, node in group["properties"].items():
        if name in _UNWRITTEN or _is_plain_group(schema, node):
            continue
        required = name in group.get("required", ())
        default = "must be given" if required else f"default `{_default(node)}`"
        kind, meaning = _kind(schema, node), _meaning(schema, node)
        lines += item(f"`{name}` ({kind}; {default}): {meaning}")
    return lines


def _alternatives(node: Node) -> list[Node]:
    inner = [*node.get("oneOf", ()), *node.get("anyOf", ()), *node.get("allOf", ())]
    return [found for part in inner for found in _alternatives(part)] if inner else [node]


def _resolve(schema: Node, node: Node) -> Node:
    if "$ref" not in node:
        return node
    return dict(schema["$defs"][node["$ref"].rsplit("/", 1)[-1]])


def _is_plain_group(schema: Node, node: Node) -> bool:
    """A group that is always there: its keys have a section, it needs no row."""
    parts = [_resolve(schema, part) for part in _alternatives(node)]
    return len(parts) == 1 and "properties" in parts[0]


def _meaning(schema: Node, node: Node) -> str:
    if "description" in node:
        return " ".join(str(node["description"]).split())
    kinds = [
        part["properties"]["kind"]["const"]
        for part in (_resolve(schema, p) for p in _alternatives(node))
        if "kind" in part.get("properties", {})
    ]
    if kinds:
        return f"`kind`: {', '.join(f'`{kind}`' for kind in kinds)}; its keys are below"
    return "null is off; a group, `{}` for its defaults, switches it on"


def _default(node: Node) -> str:
    value = node.get("default")
    if isinstance(value, dict):
        return f"kind: {value['kind']}" if "kind" in value else "{...}"
    return json.dumps(value)


def _kind(schema: Node, node: Node) -> str:
    """Type and range of a value, in words."""
    parts = [_resolve(schema, part) for part in _alternatives(node)]
    return " or ".join(dict.fromkeys(_type(part) for part in parts))


def _type(node: Node) -> str:
    if "enum" in node:
        return " or ".join(f"`{value}`" for value in node["enum"])
    if "const" in node:
        return f"`{node['const']}`"
    if "properties" in node:
        return "group"
    if node.get("type") == "array":
        items = node.get("prefixItems")
        if items:
            return f"{len(items)} of: {_type(items[0])}"
        return f"list of: {_type(node.get('items', {}))}"
    name = {"integer": "whole number", "number": "number", "boolean": "true or false"}
    limits = [
        f"{sign} {node[key]:g}"
        for key, sign in (
            ("minimum", ">="),
            ("exclusiveMinimum", ">"),
            ("maximum", "<="),
            ("exclusiveMaximum", "<"),
        )
        if key in node
    ]
    kind = str(node.get("type", "value"))
    return " ".join(
        [name.get(kind, "text" if kind == "string" else kind), ", ".join(limits)]
    ).strip()
