"""Strict reading of configurations: YAML and dotted overrides into a pydantic model.

What may be in a file is the model's own fields, and so are the messages about what may not.
"""

from __future__ import annotations

import copy
import difflib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from fgslam.core.errors import ConfigError, shortened
from fgslam.core.yaml_text import composed, plain_values, read_yaml
from fgslam.runs.named_experiments import suggestion

Model = TypeVar("Model", bound=BaseModel)

_GROUPS_OF_KINDS = ("dataset", "odometry", "estimator")
"""Groups told apart by `kind`: an override of it drops the file's keys of the kind before."""


def read_mapping(path: Path) -> dict[str, Any]:
    """The `key: value` pairs of a YAML file. Raises ConfigError, naming it."""
    if not path.exists():
        raise ConfigError(f"{path}: no such file; {suggestion(path)}")
    values = read_yaml(path, ConfigError)
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: holds no `key: value` pairs; see experiments/ for examples")
    for key in values:
        if not isinstance(key, str):
            raise ConfigError(f"{path}: key {key!r} is no text; correct it")
    return values


def parse(
    model: type[Model], values: Mapping[str, Any], where: str, overrides: Iterable[str] = ()
) -> Model:
    """The checked configuration of plain values with ``a.b=value`` overrides applied.

    The value of an override is YAML, but the text as typed where the setting is text: 01, no, a: b.

    Args:
        model: its class.
        values: plain values, as of a YAML file; they stay as they are.
        where: their source, for messages.
        overrides: the last one of a key wins.

    Raises:
        ConfigError: an override is malformed, or a key or value is wrong.
    """
    model.model_rebuild()
    plain = copy.deepcopy(dict(values))
    before = {group: _kind(plain, group) for group in _GROUPS_OF_KINDS}
    given = apply_overrides(plain, overrides)
    for group, kind in before.items():
        if _kind(plain, group) != kind and isinstance(plain[group], dict):
            known = _known_keys(model, [group, str(_kind(plain, group))])
            kept = known.union(o.keys[1] for o in given if len(o.keys) > 1 and o.keys[0] == group)
            plain[group] = {key: value for key, value in plain[group].items() if key in kept}
    try:
        return model.model_validate(plain)
    except ValidationError as error:
        wrong = {tuple(_followed(model, e["loc"])[0]): e for e in error.errors()}
    for override in given:
        at = {k: e for k, e in wrong.items() if _names(k, override.keys)}
        if override.broken and any(not _wants_text(e) for e in at.values()):
            raise ConfigError(f"--set {override.given}: the value is not valid YAML; quote it")
        if override.keys in at and _wants_text(at[override.keys]):
            override.apply(plain, override.text)
        elif any(map(_wants_text, at.values())):
            override.apply(plain, _texts(composed(override.text)))
        else:
            override.apply(plain, override.value)
    try:
        return model.model_validate(plain)
    except ValidationError as error:
        raise ConfigError(_describe(model, error.errors(), where)) from None


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


@dataclass(frozen=True, slots=True)
class Override:
    """One dotted key and its value as typed, e.g. ``frontend.sift.max_features=500``.

    Attributes:
        given: all of it.
        keys: from the top down.
        text: the value.
        value: of the text as YAML; the text itself where it is none, or plain text.
        broken: whether it is no YAML.
    """

    given: str
    keys: tuple[str, ...]
    text: str
    value: Any
    broken: bool

    @staticmethod
    def of(given: str) -> Override:
        """Reads one. Raises ConfigError where it is not of the form a.b=value."""
        dotted, separator, text = given.partition("=")
        keys, text = tuple(dotted.strip().split(".")), text.strip()
        if not separator or not all(keys):
            raise ConfigError(f"--set {given}: not of the form a.b=value; e.g. --set seed=3")
        try:
            value, broken = plain_values(text), False
        except yaml.YAMLError:
            value, broken = text, True
        if isinstance(value, str) and text[:1] not in ("'", '"'):
            value = text  # a comment behind it belongs to it
        return Override(given, keys, text, text if keys[-1] in ("kind", "task") else value, broken)

    def apply(self, values: dict[str, Any], value: Any) -> None:
        """Sets the key in place. Raises ConfigError where it leads through a value."""
        for key in self.keys[:-1]:
            values = values.setdefault(key, {})
            if not isinstance(values, dict):
                raise ConfigError(f"--set {self.given}: {key} holds a value, not a group of keys")
        values[self.keys[-1]] = value


def apply_overrides(values: dict[str, Any], overrides: Iterable[str]) -> list[Override]:
    """Sets dotted keys in place to what their texts mean as YAML. Raises ConfigError."""
    given = [Override.of(override) for override in overrides]
    for override in given:
        override.apply(values, override.value)
    return given


def _texts(node: yaml.Node) -> Any:
    """A YAML list's items as the texts that they are."""
    if isinstance(node, yaml.SequenceNode):
        return [_texts(item) for item in node.value]
    return node.value


def _kind(values: Mapping[str, Any], group: str) -> Any:
    inner = values.get(group)
    return inner.get("kind") if isinstance(inner, dict) else None


def _names(keys: Sequence[str], given: Sequence[str]) -> bool:
    """Whether a place in the configuration is a given key, or an item of it."""
    return len(keys) == len(given) and ".".join(keys).partition("[")[0] == ".".join(given)


def _wants_text(error: ErrorDetails) -> bool:
    return error["type"] == "string_type" or (
        error["type"] == "literal_error" and isinstance(error["input"], bool | None)
    )


# --------------------------------------------------------------------------------------------
# Keys and messages

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


def _describe(model: type[BaseModel], errors: list[ErrorDetails], where: str) -> str:
    # A misspelt key also leaves the right one missing; the misspelling is the cause.
    first = sorted(errors, key=lambda e: e["type"] not in _UNKNOWN)[0]
    keys, groups = _followed(model, first["loc"])
    key, kinds = ".".join(keys), ", ".join(kind for g in groups if (kind := _kind_of(g)))
    more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
    if first["type"] in _UNKNOWN:
        known = sorted(_known_keys(model, first["loc"][:-1]))
        close = difflib.get_close_matches(str(first["loc"][-1]), known, n=1, cutoff=0.5)
        hint = f"did you mean {close[0]}?" if close else f"known here: {', '.join(known)}"
        return f"{where}: unknown key {key}; {hint}{more}"
    if first["type"] in ("missing", "missing_argument"):
        return f"{where}: key {key} is missing; add it{more}"
    if first["type"] == "union_tag_not_found":
        return f"{where}: {key}.kind is missing; add one of {kinds}{more}"
    if first["type"] == "union_tag_invalid":
        tag = shortened(repr(first["ctx"]["tag"]))
        return f"{where}: {key}.kind is {tag}; use one of {kinds}{more}"
    words = _PLAIN_WORDS.get(first["type"], first["msg"])
    if first["type"] == _NO_GROUP and kinds:
        words += f"; kinds: {kinds}"
    return f"{where}: {key} = {shortened(repr(first['input']))} is not usable: {words}{more}"


def _known_keys(model: type[BaseModel], place: Sequence[str | int]) -> set[str]:
    return {key for group in _followed(model, place)[1] for key in _fields(group)}


def _followed(model: type, place: Sequence[str | int]) -> tuple[list[str], list[type]]:
    """Keys of a place that pydantic names, without tags of unions; the groups that stand there.

    Items of lists are written `key[3]`.
    """
    groups: list[type] = [model]
    keys: list[str] = []
    for k, part in enumerate(place):
        found = [_fields(group)[part] for group in groups if part in _fields(group)]
        tagged = [group for group in groups if _kind_of(group) == part]
        if isinstance(part, int):
            keys[-1] += f"[{part}]"
        elif found:
            keys.append(part)
            groups = [inner for annotation in found for inner in _groups(annotation)]
        elif tagged:
            groups = tagged
        elif k == len(place) - 1:
            keys.append(part)
    return keys, groups


def _fields(group: type) -> dict[Any, Any]:
    """Annotations of a group's fields, by key."""
    fields = getattr(group, "__pydantic_fields__", {})
    return {name: field.annotation for name, field in fields.items()}


def _groups(annotation: Any) -> list[type]:
    """Groups of keys that a value of this type may be; of a list those of its items."""
    if isinstance(annotation, type) and hasattr(annotation, "__pydantic_fields__"):
        return [annotation]
    return [group for inner in get_args(annotation) for group in _groups(inner)]


def _kind_of(group: type) -> str | None:
    """The value of a group's key `kind`; None where it has none."""
    kinds = get_args(_fields(group).get("kind"))
    return kinds[0] if kinds else None
