"""Writes docs/reference/settings.md from the schema: every key, its default, range and meaning.

``python scripts/make_configuration_docs.py`` rewrites the page; a test fails while it is stale.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeAlias

from fgslam.runs.config import ExperimentConfig
from fgslam.runs.config_models import HOMING_TASKS, TASKS, LocalisationConfig

Node: TypeAlias = dict[str, Any]

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "settings.md"
_UNWRITTEN = ("kind", "task", "provenance")
_TOLD_ELSEWHERE = ("map.made_from.dataset", "map.made_from.odometry")
_INTRODUCTION = """# Configuration

<!-- Made by scripts/make_configuration_docs.py: edit the settings' descriptions, not this page. -->

An experiment is one YAML file; `experiments/` has examples. Any key can be set from the command
line, too: `fgslam run CONFIG.yaml --set frontend.sift.octave_layers=3 --set dataset.stop=null`.
Values are YAML; the last one wins. An override that chooses another `kind` drops the file's keys of
the old one. Unknown keys, keys given twice, NaN and infinity are refused. A run writes the resolved
configuration, every default filled in, to `RUN/config.yaml`; that file is itself a configuration
and repeats the run.

Experiments of homing have a key `task`; theirs is the [second part](#homing-experiments).

Keys without a default must be given. Units are metres, seconds and pixels, angles in degrees,
unless the key's name or meaning says otherwise.
"""

_LOCALISATION = """## Task `localisation`

{told}
`dataset`, `odometry`, `frontend`, `estimator` and `output` have the keys that they have above;
`estimator` is that of the drive that makes the map.
"""

_HOMING = """## Homing experiments

Each task has its own keys; the groups of keys that they share are described once, below all of
them.
"""


def configuration_page() -> str:
    """The whole page, in Markdown."""
    schema = ExperimentConfig.model_json_schema()
    sections = [_INTRODUCTION, "## The experiment\n\n" + "\n".join(_table(schema, schema))]
    for name, node in schema["properties"].items():
        if name not in _UNWRITTEN:
            sections += _sections(schema, node, name, 2)
    sections += _localisation()
    sections += _homing()
    return "\n".join(section.rstrip() + "\n" for section in sections)


def _localisation() -> Iterator[str]:
    """The keys that only this task has; the others are those of the experiments above."""
    schema = LocalisationConfig.model_json_schema()
    told = " ".join(schema.get("description", "").split())
    yield _LOCALISATION.format(told=told) + "\n" + "\n".join(_table(schema, schema))
    for name in ("map", "localisation"):
        for section in _sections(schema, schema["properties"][name], name, 3):
            yield section.replace("`map`", "`map` of the task `localisation`", 1)


def _homing() -> Iterator[str]:
    """The keys of each task, then the groups of all of them, each once."""
    yield _HOMING
    groups: dict[str, None] = {}
    for task in HOMING_TASKS:
        schema = TASKS[task].model_json_schema()
        told = " ".join(schema.get("description", "").split())
        yield "\n".join([f"### Task `{task}`", "", told, "", *_table(schema, schema)])
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
        told = " ".join(group.get("description", "").split())
        lines = [f"{'#' * level} {title}", "", *([told, ""] if told else [])]
        table = _table(schema, group)
        yield "\n".join([*lines, *(table or ["Groups of keys:"])])
        for name, inner in group["properties"].items():
            below = f"{dotted}.{name}"
            if name not in _UNWRITTEN and below not in _TOLD_ELSEWHERE:
                yield from _sections(schema, inner, below, min(level + 1, 4))


def _table(schema: Node, group: Node) -> list[str]:
    """Rows of the keys that hold a value or may be switched on; nothing where there are none."""
    rows = []
    for name, node in group["properties"].items():
        if name in _UNWRITTEN or _is_plain_group(schema, node):
            continue
        required = name in group.get("required", ())
        default = "" if required else f"`{_default(node)}`"
        meaning = _meaning(schema, node).replace("|", "\\|")
        rows.append(f"| `{name}` | {_kind(schema, node)} | {default} | {meaning} |")
    header = ["| key | value | default | meaning |", "|---|---|---|---|"]
    return [*header, *rows] if rows else []


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
    return "null is off; a group, `{}` for its defaults, switches it on: its keys are below"


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


if __name__ == "__main__":
    PAGE.write_text(configuration_page(), encoding="utf-8")
