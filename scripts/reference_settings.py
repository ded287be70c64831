"""The page of settings, made from the schema: one line a key, with default, range and meaning.

What several groups have alike, as `start` and `stop` of every recording, is described once.
"""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Iterator
from typing import Any, TypeAlias

from fgslam.runs.config import HOMING_TASKS, TASKS, ExperimentConfig, LocalisationConfig

WIDTH = 118

Node: TypeAlias = dict[str, Any]
_UNITS = {"_m": "metres", "_deg": "degrees", "_s": "seconds", "_px": "pixels", "_deg_s": "degrees"}
Known: TypeAlias = set[str | tuple[str, str]]
"""Lines of keys, and titles of groups with their classes, that stand on the page already."""

_UNWRITTEN = ("kind", "task", "provenance")
_EVERYWHERE = ("name", "seed", "start", "stop", "stride", "label")
_DESCRIBED_ELSEWHERE = ("map.made_from.dataset", "map.made_from.odometry")
FIRST = {
    "dataset.kind, dataset.path, dataset.start, dataset.stop": "the recording: its layout, its "
    "folder, and which part of it",
    "odometry.kind": "`recorded`, `constant_velocity`, or `synthetic` (truth plus stated noise)",
    "estimator.kind, compare": "the estimator that steers the run, and those that replay its "
    "measurements",
    "seed": "of everything random in the run",
    "frontend.ego_motion.dof": "3 on a flat floor, 5 at a fixed height, 6 for a rig in the hand",
    "frontend.stereo.pixel_sigma": "standard deviation of a feature's place in the image",
    "estimator.noise_factor": "a number in place of the estimate",
    "estimator.lag_frames, estimator.keyframe_every": "how far back `fixed_lag` looks; every how "
    "many frames `isam2` keeps one",
    "frontend.loops": "`true` switches loop closing on",
    "map.load, map.save": "saved maps: begin in one, write one",
}
"""What a user sets first, by key."""

_INTRODUCTION = """# Settings

<!-- Made by `python -m scripts.make_reference`: edit the settings' descriptions, not this page. -->

Every key of an experiment, which is one YAML file (examples in `experiments/`). Any key can be set
from the command line: `fgslam run CONFIG.yaml --set frontend.sift.max_features=500`. The last value
of a key wins; choosing another `kind` drops the file's keys of the old one. Unknown keys, keys
given twice, NaN and infinity are refused. `RUN/config.yaml` holds every key with its value.

A line gives the key, its default, then other choices or the range (a bracket includes the limit),
and its meaning. A default without decimal point takes integers. Units are those of the key's name.
`null` is off, `{}` switches a group on with its defaults. Keys described further up are named as
*alike*; `start`, `stop` and `stride` are keys of every recording, `label` of every estimator,
`name` and `seed` of every task.
"""

_LOCALISATION = """## Task `localisation`

{described}
Other groups have the keys above; `estimator` is that of the drive that makes the map.
"""

_HOMING = """## Homing experiments

Keys of each task, then the groups that they share.
"""


def settings_page() -> str:
    """The whole page, in Markdown."""
    schema, known = ExperimentConfig.model_json_schema(), set[str | tuple[str, str]]()
    first = [line for key, described in FIRST.items() for line in item(f"`{key}`: {described}")]
    sections = [_INTRODUCTION, "## The ten that matter first\n\n" + "\n".join(first)]
    sections += ["## The experiment\n\n" + "\n".join(_keys(schema, schema, known))]
    for name, node in schema["properties"].items():
        if name not in _UNWRITTEN:
            sections += _sections(schema, node, name, 2, known)
    sections += _localisation(known)
    sections += _homing(known)
    return "\n".join(section.rstrip() + "\n" for section in sections)


def _localisation(known: Known) -> Iterator[str]:
    """The keys that only this task has; the others are those of the experiments above."""
    schema = LocalisationConfig.model_json_schema()
    described = " ".join(schema.get("description", "").split())
    yield (
        _LOCALISATION.format(described="\n".join(paragraph(described)))
        + "\n"
        + "\n".join(_keys(schema, schema, known))
    )
    for name in ("map", "localisation"):
        for section in _sections(schema, schema["properties"][name], name, 3, known):
            yield section.replace("`map`", "`map` of the task `localisation`", 1)


def _homing(known: Known) -> Iterator[str]:
    """The keys of each task, then the groups of all of them, each once."""
    yield _HOMING
    groups: list[str] = []
    for task in HOMING_TASKS:
        schema = TASKS[task].model_json_schema()
        described = " ".join(schema.get("description", "").split())
        keys = _keys(schema, schema, known)
        yield "\n".join([f"### Task `{task}`", "", *paragraph(described), "", *keys])
        for name, node in schema["properties"].items():
            if name not in _UNWRITTEN:
                groups += _sections(schema, node, name, 3, known)
    yield from dict.fromkeys(groups)


def _sections(schema: Node, node: Node, dotted: str, level: int, known: Known) -> Iterator[str]:
    """One section for each group of keys below a node, one for each kind of a union."""
    for group in (_resolve(schema, part) for part in _alternatives(node)):
        if "properties" not in group:
            continue
        kind = group["properties"].get("kind", {}).get("const")
        lines = _keys(schema, group, known)
        inner = [
            section
            for name, below in group["properties"].items()
            if name not in _UNWRITTEN and f"{dotted}.{name}" not in _DESCRIBED_ELSEWHERE
            for section in _sections(schema, below, f"{dotted}.{name}", min(level + 1, 4), known)
        ]
        title = f"`{dotted}`" + (f", kind `{kind}`" if kind else "")
        if (title, group["title"]) not in known:
            known.add((title, group["title"]))
            about = [*paragraph(_summary(group)), ""] if kind or not lines else []
            yield "\n".join([f"{'#' * level} {title}", "", *about, *lines]).rstrip()
        yield from inner


def _keys(schema: Node, group: Node, known: Known) -> list[str]:
    """Items of the keys that hold a value or may be switched on; those on the page by name."""
    lines: list[str] = []
    alike: list[str] = []
    for name, node in group["properties"].items():
        if name in _UNWRITTEN or _is_plain_group(schema, node):
            continue
        line = _line(schema, name, node, required=name in group.get("required", ()))
        if line in known:
            alike += [f"`{name}`"] if name not in _EVERYWHERE else []
        else:
            known.add(line)
            lines += item(line)
    return [*lines, *(item(f"alike: {', '.join(alike)}") if alike else ())]


def _line(schema: Node, name: str, node: Node, required: bool) -> str:
    """Key, default, range and meaning; of a long meaning as many clauses as fit on the line."""
    default = "required" if required else f"`{_default(node)}`"
    choices = [f"`{json.dumps(value)}`" for value in _choices(schema, node)]
    others = [choice for choice in choices if choice != default]
    limits = "" if set(choices) - {"`null`"} else _range(schema, node)
    facts = ", ".join(filter(None, (", ".join([default, *others]), limits)))
    head, meaning = f"`{name}` ({facts}): ", _without_unit(name, _meaning(schema, node))
    clauses = re.split(r"(?<=[;.]) ", meaning)
    fitting = [
        found
        for k in range(len(clauses), 0, -1)
        if len(head + (found := " ".join(clauses[:k]).rstrip(";."))) <= WIDTH - 2
    ]
    return head + (fitting[0] if fitting else clauses[0].rstrip(";."))


def _without_unit(name: str, meaning: str) -> str:
    """The meaning without a unit at its end that the key's name ends with."""
    for suffix, unit in _UNITS.items():
        if name.endswith(suffix):
            return meaning.removesuffix(f", {unit}")
    return meaning


def _summary(group: Node) -> str:
    """First sentence of what a group is."""
    said = " ".join(group.get("description", "").split())
    return re.split(r"(?<=\.) (?=[A-Z:])", said)[0]


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
        return f"`kind`: {', '.join(f'`{kind}`' for kind in kinds)}"
    return "group below"


def _default(node: Node) -> str:
    value = node.get("default")
    if isinstance(value, dict):
        return f"kind: {value['kind']}" if "kind" in value else "{...}"
    return json.dumps(value)


def _choices(schema: Node, node: Node) -> list[Any]:
    """Values of which one is given; none where any of a type may be."""
    parts = [_resolve(schema, part) for part in _alternatives(node)]
    chosen = [value for part in parts for value in part.get("enum", ())]
    null = any(part.get("type") == "null" for part in parts)
    return [*chosen, None] if null else chosen


def _range(schema: Node, node: Node) -> str:
    """Limits of a number or of those in a list."""
    parts = [_resolve(schema, part) for part in _alternatives(node)]
    whole = any(part.get("type") == "integer" for part in parts)
    shown = "integer " if whole and not isinstance(node.get("default"), int) else ""
    return shown + " or ".join(dict.fromkeys(filter(None, map(_limits, parts))))


def _limits(node: Node) -> str:
    if node.get("type") == "array":
        items = node.get("prefixItems", [node.get("items", {})])
        inner = _limits(items[0])
        count = f"{len(items)} of" if "prefixItems" in node else "list of"
        return f"{count} {inner}" if inner else ""
    low, above = node.get("minimum"), node.get("exclusiveMinimum")
    high, below = node.get("maximum"), node.get("exclusiveMaximum")
    least, most = low if above is None else above, high if below is None else below
    left, right = "[" if above is None else "(", "]" if below is None else ")"
    if least is not None and most is not None:
        return f"{left}{least:g}, {most:g}{right}"
    if least is not None:
        return f"{'>=' if above is None else '>'} {least:g}"
    return f"{'<=' if below is None else '<'} {most:g}" if most is not None else ""


def paragraph(text: str) -> list[str]:
    """Lines of a paragraph; code in backticks stays on one line."""
    return _wrapped(text, "", "")


def item(text: str) -> list[str]:
    """Lines of a list item."""
    return _wrapped(text, "- ", "  ")


def _wrapped(text: str, first: str, rest: str) -> list[str]:
    words = " ".join(text.split())
    whole = re.sub(r"(`+).+?\1", lambda code: code.group().replace(" ", "\0"), words)
    lines = textwrap.wrap(
        whole,
        WIDTH,
        initial_indent=first,
        subsequent_indent=rest,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return [line.replace("\0", " ") for line in lines]
