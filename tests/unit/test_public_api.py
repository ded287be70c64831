"""The front door: what `import fgslam` offers, loads, and says about itself."""

from __future__ import annotations

import ast
import importlib
import inspect
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any, get_args

import pytest

import fgslam as fg
from fgslam.core import errors as core_errors

LIBRARIES = ("numpy", "scipy", "cv2", "gtsam", "pydantic", "yaml", "open3d", "plotly", "pandas")
IMPORTS = """
import json, sys
import fgslam
first = sorted(sys.modules)
fgslam.StereoRig
print(json.dumps([first, sorted(sys.modules)]))
"""
ARRAY_WORDS = ("(4, 4)", "(n,", "(height, width", "(n, 3)", "(4, 4, n)")


def public() -> list[str]:
    return [name for name in fg.__all__ if not name.startswith("__") and name != "errors"]


def test_importing_loads_no_library() -> None:
    found = subprocess.run(  # noqa: S603  our own program, above
        [sys.executable, "-c", IMPORTS], capture_output=True, text=True, check=True
    )
    first, after = json.loads(found.stdout)
    assert not [name for name in LIBRARIES if name in first]
    inner = [name for name in first if name.startswith("fgslam.")]
    assert len(inner) <= 5, inner
    assert "numpy" in after
    assert "gtsam" not in after


def test_every_name_can_be_imported_and_listed() -> None:
    assert len(set(fg.__all__)) == len(fg.__all__)
    assert set(fg.__all__) <= set(dir(fg))
    for name in fg.__all__:
        assert getattr(fg, name) is not None


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Smal'"):
        _ = fg.Smal  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", public())
def test_every_public_name_is_documented(name: str) -> None:
    found = getattr(fg, name)
    text = inspect.getdoc(found) or ""
    assert len(text.splitlines()[0]) > 20, f"{name}: no first line that says what comes out"
    if inspect.isclass(found):
        for member, value in vars(found).items():
            documented = inspect.isfunction(value) or isinstance(value, property | classmethod)
            if documented and not member.startswith("_"):
                assert inspect.getdoc(value), f"{name}.{member} has no docstring"


@pytest.mark.parametrize("name", ["Slam.track", "Odometry", "Trajectory", "Features", "Map.locate"])
def test_shapes_stand_where_arrays_are_handed_over(name: str) -> None:
    found = fg
    for part in name.split("."):
        found = getattr(found, part)
    text = inspect.getdoc(found) or ""
    assert any(word in text for word in ARRAY_WORDS), text


def test_errors_have_a_short_name() -> None:
    import fgslam.errors
    from fgslam.errors import FgslamError

    assert fgslam.errors is core_errors
    assert FgslamError is core_errors.FgslamError
    kinds = [kind for kind in vars(core_errors).values() if inspect.isclass(kind)]
    assert all(issubclass(kind, FgslamError) for kind in kinds)
    assert all(kind.__doc__ for kind in kinds)


# --------------------------------------------------------------------------------------------
# The reference: every type that the public API demands or returns is on it

PAGES = Path(__file__).parents[2] / "docs" / "reference"
ENTRY = re.compile(r"^::: (\S+)(?:\n    options:\n      filters: (\[.*\]))?$", re.MULTILINE)


def entries() -> dict[Any, list[str]]:
    """What the page of the API describes, and the names of members that it leaves out."""
    found = {}
    for path, filters in ENTRY.findall((PAGES / "api.md").read_text(encoding="utf-8")):
        home, _, name = path.rpartition(".")
        found[getattr(importlib.import_module(home), name)] = re.findall(r"!\^(\w+)\$", filters)
    return found


@lru_cache
def names_of(module: str) -> dict[str, Any]:
    """What names in a module mean, those that are imported for type checkers alone as well."""
    known = dict(vars(sys.modules[module]))
    for node in ast.walk(ast.parse(inspect.getsource(sys.modules[module]))):
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("fgslam"):
            for one in node.names:
                if (one.asname or one.name) not in known:
                    home = importlib.import_module(str(node.module))
                    known[one.asname or one.name] = getattr(home, one.name)
    return known


def types_in(annotation: Any, module: str) -> set[Any]:
    """Classes of the package in an annotation."""
    names = re.findall(r"(?<![\w.])\w+(?![\w.])", str(annotation))
    waiting = [names_of(module).get(name) for name in names]
    found = set()
    while waiting:
        one = waiting.pop()
        waiting.extend(one if isinstance(one, list) else get_args(one))
        if inspect.isclass(one) and one.__module__.startswith("fgslam."):
            found.add(one)
    return found


def demanded_and_returned(described: Any, left_out: list[str]) -> Iterator[tuple[str, Any]]:
    """Each public member (empty: itself) with a class that stands in its annotations."""
    members: dict[str, Any] = {"": described}
    if inspect.isclass(described):
        of_package = [one for one in described.__mro__ if one.__module__.startswith("fgslam.")]
        members = {k: v for one in reversed(of_package) for k, v in vars(one).items()}
        for one in of_package:
            for name, annotation in inspect.get_annotations(one).items():
                if not name.startswith("_"):
                    yield from ((name, each) for each in types_in(annotation, one.__module__))
    for name, value in members.items():
        if name in left_out or (name.startswith("_") and name != "__init__"):
            continue
        value = getattr(value, "fget", None) or getattr(value, "__func__", value)
        if inspect.isfunction(value) and value.__module__.startswith("fgslam."):
            for annotation in value.__annotations__.values():
                yield from ((name, each) for each in types_in(annotation, value.__module__))


def test_every_type_that_the_api_demands_or_returns_is_in_the_reference() -> None:
    described = entries()
    settings = " ".join((PAGES / "settings.md").read_text(encoding="utf-8").split())
    assert {getattr(fg, name) for name in public()} <= set(described)
    missing = set()
    for one, left_out in described.items():
        for member, found in demanded_and_returned(one, left_out):
            of_run = found.__module__.endswith(("settings", "config"))
            by_key = of_run and all(
                re.search(rf"[`.]{key}[`,]", settings)
                for key, hint in found.__annotations__.items()
                if "ClassVar" not in str(hint)
            )
            if found not in described and not by_key:
                missing.add(f"{found.__module__}.{found.__qualname__}: {one.__name__}.{member}")
    assert not missing, "\n".join(sorted(missing))
