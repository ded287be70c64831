"""YAML as plain values: what a text cannot mean, and what would not end, is an error with its line.

PyYAML's safe loader builds no objects, but it lets errors of Python through, reads dates where text
was meant, keeps the last of two equal keys, and expands aliases of aliases without end.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from fgslam.core.errors import FgslamError
from fgslam.core.files import read_text

MOST_BYTES = 1_000_000
"""Of a file that a person writes; the longest experiment has 3,000."""
_MOST_VALUES = 20_000
_DEEPEST = 50
_LARGEST = 2**63 - 1
_NOT_MEANT = (ValueError, LookupError, AttributeError, TypeError, OverflowError)
"""What PyYAML lets through for scalars that are not of their tag."""
_TIMESTAMP = "tag:yaml.org,2002:timestamp"


class PlainLoader(yaml.SafeLoader):
    """The safe loader, with errors that name their line, and dates as the text that they are."""

    most_values = _MOST_VALUES

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = self._count = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """As the safe loader's. Raises yaml.YAMLError beyond the limits of depth and number."""
        self._depth += 1
        self._count += 1
        mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
        if self._depth > _DEEPEST:
            raise yaml.MarkedYAMLError(problem=f"nested over {_DEEPEST} deep", problem_mark=mark)
        if self._count > self.most_values:
            what = f"more than {self.most_values} values"
            raise yaml.MarkedYAMLError(problem=what, problem_mark=mark)
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def construct_object(self, node: Any, deep: bool = False) -> Any:
        """As the safe loader's. Raises yaml.YAMLError for what it cannot make."""
        try:
            value = super().construct_object(node, deep=deep)
        except _NOT_MEANT:
            tag = str(node.tag).rpartition(":")[2]
            raise _marked(f"{_short(node.value)} is no {tag}", node) from None
        if isinstance(value, int) and abs(value) > _LARGEST:
            raise _marked(f"{_short(node.value)} is too large a number", node)
        return value


PlainLoader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag != _TIMESTAMP]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


def read_yaml(path: Path, error: type[FgslamError], give: str = "give a YAML text file") -> Any:
    """Plain values of a file. Raises ``error`` with place and mend for what is none."""
    text = read_text(path, error, give, MOST_BYTES)
    try:
        return plain_values(text)
    except yaml.YAMLError as cause:
        raise error(f"{path}{problem_of(cause)}; correct that line") from None


def plain_values(text: str) -> Any:
    """What a YAML text holds. Raises yaml.YAMLError, also for what safe_load lets pass."""
    node = composed(text)
    return None if node is None else PlainLoader("").construct_document(node)


def composed(text: str) -> Any:
    """The root node of a YAML text, None of an empty one. Raises yaml.YAMLError as above."""
    node = PlainLoader(text).get_single_node()
    if node is not None:
        _expanded(node, {})
    return node


def problem_of(error: yaml.YAMLError) -> str:
    """Where and why a text is no YAML, in a few words."""
    if not isinstance(error, yaml.MarkedYAMLError) or error.problem_mark is None:
        return f": not valid YAML ({' '.join(str(error).split())})"
    return f", line {error.problem_mark.line + 1}: not valid YAML ({error.problem})"


def _expanded(node: Any, sizes: dict[int, int]) -> int:
    """Values that a node stands for, aliases counted each time. Raises yaml.YAMLError."""
    if id(node) in sizes:
        if sizes[id(node)] == 0:
            raise _marked("an alias of what it stands in", node)
        return sizes[id(node)]
    sizes[id(node)] = 0
    inner: list[Any] = []
    if node.id == "mapping":
        _require_single_keys(node)
        inner = [one for pair in node.value for one in pair]
    elif isinstance(node, yaml.SequenceNode):
        inner = node.value
    count = 1 + sum(_expanded(one, sizes) for one in inner)
    if count > _MOST_VALUES:
        what = f"more than {_MOST_VALUES} values, aliases counted each time"
        raise _marked(what, node)
    sizes[id(node)] = count
    return count


def _require_single_keys(node: yaml.Node) -> None:
    known: set[str] = set()
    for key, _ in node.value:
        if isinstance(key, yaml.ScalarNode):
            if key.value in known:
                raise _marked(f"key {_short(key.value)} is given twice; remove one", key)
            known.add(key.value)


def _marked(problem: str, node: yaml.Node) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark)


def _short(text: object) -> str:
    shown = str(text)
    return repr(shown if len(shown) <= 40 else f"{shown[:30]}...")
