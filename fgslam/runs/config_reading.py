"""Strict reading of configurations: YAML and dotted overrides into a pydantic model.

Knows no key by heart: what may be in a file is the model's own schema, and so are the messages
about what may not.
"""

from __future__ import annotations

import copy
import difflib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Generic, TypeAlias, TypeVar

import yaml
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from fgslam.core.errors import ConfigError, shortened
from fgslam.core.yaml_text import PlainLoader, composed, read_yaml
from fgslam.runs.named_experiments import suggestion

Model = TypeVar("Model", bound=BaseModel)
Schema: TypeAlias = Mapping[str, Any]
"""A node of a JSON schema, as pydantic makes it."""


@cache
def _schema_of(model: type[BaseModel]) -> Schema:
    """JSON schema of a model, read only; it takes a tenth of a second to make."""
    return model.model_json_schema()


@dataclass(frozen=True, slots=True)
class Reader(Generic[Model]):
    """Reads one kind of configuration.

    Attributes:
        model: what comes out.
        groups: top-level groups told apart by `kind`: an override of it drops the file's keys of
            the kind before.
    """

    model: type[Model]
    groups: tuple[str, ...]

    def make(self, values: Mapping[str, Any], overrides: Iterable[str], where: str) -> Model:
        """Plain values with ``a.b=value`` overrides applied, checked; ``where`` as in parse.

        Raises:
            ConfigError: an override is malformed, or a key or value is wrong.
        """
        plain, overrides = copy.deepcopy(dict(values)), tuple(overrides)
        before = {group: _kind(plain, group) for group in self.groups}
        if overrides:
            apply_overrides(plain, overrides, _schema_of(self.model))
        given = {override.partition("=")[0].strip() for override in overrides}
        for group, kind in before.items():
            if _kind(plain, group) != kind:
                self._drop_unknown(plain[group], group, given)
        return self.parse(plain, where)

    def parse(self, values: Mapping[str, Any], where: str) -> Model:
        """Checks plain values against the schema; ``where`` names their source in messages."""
        try:
            return self.model.model_validate(values)
        except ValidationError as error:
            message = _describe(error.errors(), where, _schema_of(self.model))
            raise ConfigError(message) from None

    def _drop_unknown(self, inner: Any, group: str, given: set[str]) -> None:
        """Drops keys that meant something to the file's kind, not to the one an override chose.

        Keys that are overrides themselves (``given``, dotted) stay: a misspelt one is refused.
        """
        if not isinstance(inner, dict):
            return
        _, nodes = _descend(_schema_of(self.model), [group])
        for node in nodes:
            if _has_tag(node, str(inner.get("kind"))):
                for key in set(inner) - set(node["properties"]):
                    if f"{group}.{key}" not in given:
                        del inner[key]


def kind_as_settings(value: Any) -> Any:
    """A bare kind stands for that component with its defaults."""
    return {"kind": value} if isinstance(value, str) else value


def with_default_kind(kind: str) -> Callable[[Any], Any]:
    """Makes keys without a kind mean this one."""

    def given(value: Any) -> Any:
        if isinstance(value, dict) and "kind" not in value:
            return {"kind": kind, **value}
        return value

    return given


def apply_overrides(
    values: dict[str, Any], overrides: Iterable[str], schema: Schema | None = None
) -> None:
    """Sets dotted keys, in place, to values of the type that the schema has for them.

    Raises:
        ConfigError: an override is malformed.
    """
    split = [_Override.of(override) for override in overrides]
    after = copy.deepcopy(values)  # what a key means depends on the kinds in the end
    for override in split:
        override.apply(after, ())
    for override in split:
        override.apply(values, accepted_at(schema or {}, override.keys, after))


def _kind(values: Mapping[str, Any], group: str) -> Any:
    inner = values.get(group)
    return inner.get("kind") if isinstance(inner, dict) else None


def read_mapping(path: Path) -> dict[str, Any]:
    """The `key: value` pairs of a YAML file. Raises ConfigError, naming it."""
    if not path.exists():
        raise ConfigError(f"{path}: no such file; {suggestion(path)}")
    values = read_yaml(path, ConfigError)
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: holds no `key: value` pairs; see experiments/ for examples")
    return {_key(path, key): value for key, value in values.items()}


def _key(path: Path, key: object) -> str:
    if not isinstance(key, str):
        raise ConfigError(f"{path}: key {key!r} is no text; correct it")
    return key


@dataclass(frozen=True, slots=True)
class _Override:
    """One dotted key and its value as typed, e.g. ``frontend.sift.octave_layers=3``."""

    given: str
    keys: tuple[str, ...]
    text: str

    @staticmethod
    def of(given: str) -> _Override:
        dotted, separator, text = given.partition("=")
        keys = tuple(dotted.strip().split("."))
        if not separator or not all(keys):
            raise ConfigError(f"--set {given}: not of the form a.b=value; e.g. --set seed=3")
        return _Override(given, keys, text)

    def apply(self, values: dict[str, Any], accepted: Sequence[Schema]) -> None:
        """Sets the key; ``accepted`` empty: to plain YAML, or to text where it is none."""
        try:
            value = typed_value(self.text, accepted)
        except yaml.YAMLError:
            if accepted:
                raise ConfigError(
                    f"--set {self.given}: the value is not valid YAML; quote it"
                ) from None
            value = self.text
        at = values
        for key in self.keys[:-1]:
            inner = at.setdefault(key, {})
            if not isinstance(inner, dict):
                raise ConfigError(f"--set {self.given}: {key} holds a value, not a group of keys")
            at = inner
        at[self.keys[-1]] = value


# --------------------------------------------------------------------------------------------
# Messages

_UNKNOWN = ("extra_forbidden", "unexpected_keyword_argument")

_NO_GROUP = "model_attributes_type"
_PLAIN_WORDS = {
    "tuple_type": "give a list, e.g. [a, b]",
    "list_type": "give a list, e.g. [a, b]",
    "dict_type": "give a group of keys",
    "dataclass_type": "give a group of keys",
    _NO_GROUP: "give a group of keys, or the name of a kind where one will do",
    "int_type": "give a whole number",
    "int_parsing": "give a whole number",
    "int_from_float": "give a whole number",
    "float_type": "give a number",
    "float_parsing": "give a number",
    "bool_type": "give true or false",
    "bool_parsing": "give true or false",
    "string_type": "give text, in quotes where it looks like a number",
    "finite_number": "give a finite number",
    "string_unicode": "it has bytes that are no UTF-8; give the file or folder another name (or, "
    "where the locale is at fault: export LC_ALL=C.UTF-8)",
}
"""What a value must be, by pydantic's type of error; others speak for themselves."""


def _describe(errors: list[ErrorDetails], where: str, schema: Schema) -> str:
    # A misspelt key also leaves the right one missing; the misspelling is the cause.
    first = sorted(errors, key=lambda e: e["type"] not in _UNKNOWN)[0]
    names = [str(part) for part in first["loc"]]
    key = ".".join(_without_tags(schema, names))
    more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
    if first["type"] in _UNKNOWN:
        return f"{where}: unknown key {key}{_suggestion(schema, names)}{more}"
    if first["type"] in ("missing", "missing_argument"):
        return f"{where}: key {key} is missing; add it{more}"
    if first["type"] == "union_tag_not_found":
        return f"{where}: {key}.kind is missing; add one of {_kinds(schema, names)}{more}"
    if first["type"] == "union_tag_invalid":
        kinds, tag = _kinds(schema, names), first["ctx"]["tag"]
        return f"{where}: {key}.kind is {shortened(repr(tag))}; use one of {kinds}{more}"
    words = _PLAIN_WORDS.get(first["type"], first["msg"])
    if first["type"] == _NO_GROUP and (kinds := _kinds(schema, names)):
        words += f"; kinds: {kinds}"
    return f"{where}: {key} = {shortened(repr(first['input']))} is not usable: {words}{more}"


def _kinds(schema: Schema, names: list[str]) -> str:
    _, nodes = _descend(schema, names)
    kinds = [n.get("properties", {}).get("kind", {}).get("const") for n in nodes]
    return ", ".join(str(kind) for kind in kinds if kind is not None)


def _nodes(schema: Schema, node: Schema) -> list[Schema]:
    """The object schemas that a schema node may stand for; of a list those of its items."""
    return [
        inner
        for one in _alternatives(schema, node)
        for inner in (_nodes(schema, one["items"]) if _is_list(one) else [one])
    ]


def _is_list(node: Schema) -> bool:
    return isinstance(node.get("items"), Mapping)


def _descend(schema: Schema, names: list[str]) -> tuple[list[str], list[Schema]]:
    """Follows a location through the schema, dropping the tags of unions on the way.

    Items of lists are written `key[3]`.
    """
    nodes: list[Schema] = [schema]
    kept: list[str] = []
    for name in names:
        if name.isdigit() and kept:  # an item of a list; `_nodes` has looked inside already
            kept[-1] += f"[{name}]"
            continue
        found = [n["properties"][name] for n in nodes if name in n.get("properties", {})]
        if not found:
            tagged = [n for n in nodes if _has_tag(n, name)]
            if not tagged:
                break
            nodes = tagged
            continue
        kept.append(name)
        nodes = [inner for node in found for inner in _nodes(schema, node)]
    return kept, nodes


def _has_tag(node: Schema, tag: str) -> bool:
    kind = node.get("properties", {}).get("kind", {})
    return bool(kind.get("const") == tag)


def _without_tags(schema: Schema, names: list[str]) -> list[str]:
    kept, nodes = _descend(schema, names[:-1])
    if names and names[-1].isdigit():
        return _descend(schema, names)[0]
    return kept if any(_has_tag(n, names[-1]) for n in nodes) else [*kept, names[-1]]


def _suggestion(schema: Schema, names: list[str]) -> str:
    _, nodes = _descend(schema, names[:-1])
    known = sorted({key for node in nodes for key in node.get("properties", {})})
    close = difflib.get_close_matches(names[-1], known, n=1, cutoff=0.5)
    return f"; did you mean {close[0]}?" if close else f"; known here: {', '.join(known)}"


# --------------------------------------------------------------------------------------------
# Values of --set a.b=VALUE
#
# A value takes the type of its setting. Text is text as typed, whatever YAML would make of it (01,
# no, a: b); numbers, booleans, lists, groups and null are YAML.

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
        node = composed(text)
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
    value = PlainLoader("").construct_object(node, deep=True)
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
