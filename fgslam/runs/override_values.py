"""Values of ``--set a.b=VALUE``: a value takes the type of its setting.

Text is text as typed, whatever YAML would make of it (``01``, ``no``, ``a: b``); numbers, booleans,
lists, groups and null are YAML.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import yaml

Schema = Mapping[str, Any]
"""A node of a JSON schema, as pydantic makes it."""

_QUOTES = ("'", '"')


def typed_value(text: str, accepted: Sequence[Schema]) -> Any:
    """What ``text`` means for a setting.

    Args:
        text: as typed, without the key.
        accepted: what the setting may be (:func:`accepted_at`); empty where that is not known.

    Raises:
        yaml.YAMLError: the setting is no text, and this is not valid YAML.
    """
    try:
        node = yaml.SafeLoader(text).get_single_node()
    except yaml.YAMLError:
        if _is_text(accepted):
            return text.strip()
        raise
    if _is_text(accepted) and not isinstance(node, yaml.ScalarNode):
        return text.strip()  # a comment, a list, a group: not to a setting that is text
    value = _value(node, accepted)
    plain = isinstance(node, yaml.ScalarNode) and node.style not in _QUOTES
    return text.strip() if plain and isinstance(value, str) else value


def accepted_at(schema: Schema, keys: Sequence[str], values: Any) -> list[Schema]:
    """Alternatives that the setting at ``keys`` may be; empty for an unknown one.

    Args:
        schema: of the whole configuration.
        keys: from the top down.
        values: the configuration's plain values: where a group is a union, its `kind` chooses.
    """
    nodes = _alternatives(schema, schema)
    for key in keys:
        kind = values.get("kind") if isinstance(values, dict) else None
        chosen = [n for n in nodes if n.get("properties", {}).get("kind", {}).get("const") == kind]
        inner = [n["properties"][key] for n in chosen or nodes if key in n.get("properties", {})]
        nodes = [found for node in inner for found in _alternatives(schema, node)]
        values = values.get(key) if isinstance(values, dict) else None
    return [_with_items(schema, node) for node in nodes]


def _value(node: yaml.Node | None, accepted: Sequence[Schema]) -> Any:
    """Value of a YAML node; scalars where text alone is accepted stay text."""
    if node is None:
        return "" if _is_text(accepted) and "null" not in _types(accepted) else None
    if isinstance(node, yaml.SequenceNode):
        items = [item for one in accepted for item in one.get("items", ())]
        return [_value(item, items) for item in node.value]
    value = yaml.SafeLoader("").construct_object(node, deep=True)
    if not isinstance(node, yaml.ScalarNode) or not _is_text(accepted):
        return value
    return None if value is None and "null" in _types(accepted) else node.value


def _is_text(accepted: Sequence[Schema]) -> bool:
    """True if the setting is text, or text or null."""
    return _types(accepted) in ({"string"}, {"string", "null"})


def _types(accepted: Sequence[Schema]) -> set[Any]:
    return {node.get("type") for node in accepted}


def _alternatives(schema: Schema, node: Schema) -> list[Schema]:
    """What a schema node may stand for: references resolved, unions opened."""
    if "$ref" in node:
        return _alternatives(schema, schema["$defs"][node["$ref"].rsplit("/", 1)[-1]])
    inner = [*node.get("oneOf", ()), *node.get("anyOf", ()), *node.get("allOf", ())]
    return [found for part in inner for found in _alternatives(schema, part)] if inner else [node]


def _with_items(schema: Schema, node: Schema) -> Schema:
    """A list's node with the alternatives of its items in place of their schema."""
    items = [*node.get("prefixItems", ()), *([node["items"]] if "items" in node else ())]
    found = [_with_items(schema, one) for item in items for one in _alternatives(schema, item)]
    return {**node, "items": found}
