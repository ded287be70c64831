"""The house rules as a checker over a package's syntax trees; knows no module by heart but rooms.

Every finding is a :class:`Violation` with file and line. ``test_architecture.py`` runs it on fgslam
and, to show that it can fail, on packages written to break each rule.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

ROOMS: dict[str, frozenset[str] | None] = {
    "core": frozenset(),
    "cameras": frozenset({"core"}),
    "factors": frozenset({"core"}),
    "evaluation": frozenset({"core"}),
    "report": frozenset({"core", "evaluation"}),
    "worlds": frozenset({"core", "cameras"}),
    "frontend": frozenset({"core", "cameras"}),
    "datasets": frozenset({"core", "cameras", "worlds"}),
    "backend": frozenset({"core", "frontend", "factors"}),
    "slam": frozenset({"core", "cameras", "frontend", "backend", "datasets"}),
    "homing": frozenset({"core", "cameras", "frontend", "backend"}),
    "runs": frozenset(
        {
            "core",
            "cameras",
            "evaluation",
            "report",
            "frontend",
            "datasets",
            "backend",
            "slam",
            "homing",
        }
    ),
    "cli": None,
}
"""Every room of the package and the rooms that it may import besides itself; None: all of them."""

TOP_MODULES = frozenset({"", "__main__"})
"""What may stand at the top of the package beside its rooms."""

SLAM_ROOMS = (
    "slam",
    "frontend.tracking",
    "frontend.places",
    "backend.filters",
    "backend.smoothers",
)
"""Rooms of SLAM; those of homing are the ones with `homing` in their name."""

THIRD_PARTY_HOMES: dict[str, frozenset[str]] = {
    "cv2": frozenset({"frontend", "datasets", "cameras", "report"}),
    "open3d": frozenset({"core"}),
    "gtsam": frozenset({"factors", "backend"}),
    "gtsam_unstable": frozenset({"factors", "backend"}),
    "distributed": frozenset({"runs"}),
    "dask": frozenset({"runs"}),
    "pyarrow": frozenset({"report"}),
}
MAX_MODULE_LINES = 700
"""Code lines of one subject: neither blank, comment, docstring nor import."""
MAX_FUNCTION_LINES = 80

_COMPUTED_IMPORT = "import_module of a computed name"

FunctionNode = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True, order=True)
class Violation:
    """One broken rule, printed as ``file:line: message``."""

    path: str
    line: int
    message: str

    def __str__(self) -> str:
        return f"{self.path}:{self.line}: {self.message}"


@dataclass(frozen=True)
class Import:
    """An imported name and where; ``lazy`` inside a function, ``typing`` for type checkers only."""

    target: str
    line: int
    lazy: bool
    typing: bool


@dataclass(frozen=True)
class Module:
    """A parsed source file of the package under check."""

    name: str
    path: str
    source: str = field(repr=False)
    tree: ast.Module = field(repr=False)
    is_package: bool

    @cached_property
    def nodes(self) -> tuple[ast.AST, ...]:
        """All of the tree, found once."""
        return tuple(ast.walk(self.tree))

    @property
    def code_lines(self) -> int:
        """Lines that are neither blank, comment, docstring nor import."""
        skipped: set[int] = set()
        for node in self.nodes:
            if isinstance(node, ast.Import | ast.ImportFrom):
                skipped.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
            elif isinstance(node, ast.Module | ast.ClassDef | FunctionNode):
                skipped.update(_docstring_lines(node))
        return sum(
            number not in skipped and bool(line.strip()) and not line.strip().startswith("#")
            for number, line in enumerate(self.source.splitlines(), 1)
        )

    @property
    def layer(self) -> str:
        """First name below the package's root, or the empty string for the root itself."""
        return [*self.name.split("."), ""][1]


def load_package(root: Path) -> list[Module]:
    """All modules under the package folder ``root``, by name."""
    modules = []
    for path in sorted(root.rglob("*.py")):
        parts = [root.name, *path.relative_to(root).with_suffix("").parts]
        is_package = parts[-1] == "__init__"
        source = path.read_text(encoding="utf-8")
        modules.append(
            Module(
                name=".".join(parts[:-1] if is_package else parts),
                path=path.relative_to(root.parent).as_posix(),
                source=source,
                tree=ast.parse(source, str(path)),
                is_package=is_package,
            )
        )
    return modules


def check_package(root: Path) -> list[Violation]:
    """Every violation in the package folder ``root``, sorted."""
    return check_modules(load_package(root))


def check_modules(modules: list[Module]) -> list[Violation]:
    """Every violation in the modules of a package, sorted."""
    found: list[Violation] = []
    imports = {module.name: list(imports_of(module, modules)) for module in modules}
    for module in modules:
        found += room_violations(module, imports[module.name])
        found += side_violations(module, imports[module.name])
        found += library_violations(module, imports[module.name])
        found += size_violations(module)
        found += statement_violations(module)
    found += package_violations(modules)
    found += cycle_violations(modules, imports)
    return sorted(found)


def package_violations(modules: list[Module]) -> Iterator[Violation]:
    """Folders of modules without ``__init__.py``: linters and installers may pass them over."""
    packages = {str(Path(m.path).parent) for m in modules if m.is_package}
    for module in modules:
        folder = str(Path(module.path).parent)
        if folder not in packages:
            yield Violation(module.path, 1, f"{folder} has no __init__.py; add one")


# --------------------------------------------------------------------------------------------
# Reading imports


def imports_of(module: Module, modules: list[Module]) -> Iterator[Import]:
    """What a module imports, wherever in it; ``from a import b`` means ``a.b`` if that exists."""
    known = {m.name for m in modules}
    called = "import_module" in module.source  # else none of its expressions imports
    for node, lazy, typing in _walk_with_context(module.tree, called):
        for target in _targets(node, module, known):
            yield Import(target, node.lineno, lazy, typing)


def _walk_with_context(
    tree: ast.Module, expressions: bool
) -> Iterator[tuple[ast.stmt | ast.expr, bool, bool]]:
    stack: list[tuple[ast.AST, bool, bool]] = [(tree, False, False)]
    while stack:
        node, lazy, typing = stack.pop()
        if isinstance(node, ast.expr) and not expressions:
            continue
        if isinstance(node, ast.stmt | ast.expr):
            yield node, lazy, typing
        lazy = lazy or isinstance(node, FunctionNode | ast.Lambda)
        if isinstance(node, ast.If) and _names_type_checking(node.test):
            stack += [(child, lazy, True) for child in node.body]
            stack += [(child, lazy, typing) for child in node.orelse]
        else:
            stack += [(child, lazy, typing) for child in ast.iter_child_nodes(node)]


def _names_type_checking(test: ast.expr) -> bool:
    name = test.attr if isinstance(test, ast.Attribute) else getattr(test, "id", None)
    return name == "TYPE_CHECKING"


def _targets(node: ast.AST, module: Module, known: set[str]) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        base = _absolute(node, module)
        for alias in node.names:
            inner = f"{base}.{alias.name}"
            yield inner if inner in known else base
    elif isinstance(node, ast.Call) and _imports_literal(node):
        yield str(getattr(node.args[0], "value", ""))


def _imports_literal(node: ast.Call) -> bool:
    # A computed name escapes every rule; `_call_violation` refuses it.
    return (
        _called_name(node) == "import_module"
        and bool(node.args)
        and isinstance(node.args[0], ast.Constant)
    )


def _absolute(node: ast.ImportFrom, module: Module) -> str:
    if not node.level:
        return node.module or ""
    parts = module.name.split(".")
    parts = parts[: len(parts) - node.level + module.is_package]
    return ".".join([*parts, node.module] if node.module else parts)


def _called_name(node: ast.Call) -> str:
    function = node.func
    return function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")


# --------------------------------------------------------------------------------------------
# Rooms, libraries, cycles


def room_violations(module: Module, imports: list[Import]) -> Iterator[Violation]:
    """Imports that go against the order of the rooms, and modules that stand in no room."""
    if module.layer not in ROOMS and module.layer not in TOP_MODULES:
        yield Violation(
            module.path, 1, f"'{module.layer}' is no room; give it one in architecture_rules.py"
        )
        return
    root = module.name.split(".")[0]
    allowed = ROOMS.get(module.layer)
    for item in imports:
        parts = item.target.split(".")
        if parts[0] != root or len(parts) == 1 or parts[1] == module.layer:
            continue
        if parts[1] == "cli" and module.layer != "__main__":
            yield Violation(module.path, item.line, "nothing imports cli")
        elif allowed is not None and parts[1] not in allowed:
            yield Violation(
                module.path, item.line, f"room '{module.layer}' must not import '{item.target}'"
            )


def side_of(name: str) -> str | None:
    """`homing` or `slam`; None for what both may use."""
    inner = name.partition(".")[2]
    if any("homing" in part for part in inner.split(".")):
        return "homing"
    slam = any(inner == room or inner.startswith(f"{room}.") for room in SLAM_ROOMS)
    return "slam" if slam else None


def side_violations(module: Module, imports: list[Import]) -> Iterator[Violation]:
    """Imports between SLAM and homing, in either direction."""
    here = side_of(module.name)
    for item in imports:
        there = side_of(item.target) if item.target.startswith("fgslam.") else None
        if here and there and here != there:
            yield Violation(
                module.path, item.line, f"{here} must not import {there}: '{item.target}'"
            )


def library_violations(module: Module, imports: list[Import]) -> Iterator[Violation]:
    """Libraries outside their homes."""
    for item in imports:
        library = item.target.split(".")[0]
        homes = THIRD_PARTY_HOMES.get(library)
        if homes is not None and module.layer not in homes:
            yield Violation(
                module.path, item.line, f"'{library}' only in {', '.join(sorted(homes))}"
            )


def cycle_violations(
    modules: list[Module], imports: dict[str, list[Import]]
) -> Iterator[Violation]:
    """One finding for each module that can reach itself over imports, lazy ones included."""
    known = {module.name for module in modules}
    edges = {
        name: {item.target for item in items if item.target in known}
        for name, items in imports.items()
    }
    for module in modules:
        route = _route_back(module.name, edges)
        if route:
            first = next(i for i in imports[module.name] if i.target == route[1])
            yield Violation(module.path, first.line, f"import cycle: {' -> '.join(route)}")


def _route_back(start: str, edges: dict[str, set[str]]) -> list[str]:
    """Shortest route from ``start`` to itself, breadth first, or nothing."""
    routes = [[start]]
    seen: set[str] = set()
    for route in routes:
        for target in sorted(edges[route[-1]]):
            if target == start:
                return [*route, start]
            if target not in seen:
                seen.add(target)
                routes.append([*route, target])
    return []


# --------------------------------------------------------------------------------------------
# Sizes and statements


def size_violations(module: Module) -> Iterator[Violation]:
    """Modules and functions that are too long; a function's docstring does not count."""
    lines = module.code_lines
    if lines > MAX_MODULE_LINES:
        yield Violation(
            module.path, 1, f"module of {lines} code lines (at most {MAX_MODULE_LINES})"
        )
    for node in module.nodes:
        if isinstance(node, FunctionNode):
            last = node.end_lineno or node.lineno
            length = last - node.lineno + 1 - len(_docstring_lines(node))
            if length > MAX_FUNCTION_LINES:
                yield Violation(
                    module.path,
                    node.lineno,
                    f"function {node.name} of {length} lines (at most {MAX_FUNCTION_LINES})",
                )


def _docstring_lines(node: ast.Module | ast.ClassDef | FunctionNode) -> range:
    """Lines of a docstring; none without one."""
    if ast.get_docstring(node) is None:
        return range(0)
    docstring = node.body[0]
    return range(docstring.lineno, (docstring.end_lineno or docstring.lineno) + 1)


def statement_violations(module: Module) -> Iterator[Violation]:
    """Calls that run data as code or hide randomness, as far as ruff does not know them.

    And constants of one name: the last one counts for all of the module, whatever the first states.
    """
    for node in module.nodes:
        message = _call_violation(node) if isinstance(node, ast.Call) else None
        # The package's own __init__ looks its public names up in a table (PEP 562).
        if message and not (message == _COMPUTED_IMPORT and "." not in module.name):
            yield Violation(module.path, getattr(node, "lineno", 1), message)
    constants = set[str]()
    for node in module.tree.body:
        if isinstance(node, ast.Assign):
            names = [n for n in ast.walk(node) if isinstance(n, ast.Name)]
            read = {n.id for n in names if isinstance(n.ctx, ast.Load)}
            stored = {n.id for n in names if isinstance(n.ctx, ast.Store)}
            for name in sorted((stored & constants) - read):
                yield Violation(module.path, node.lineno, f"{name} has a value already")
            constants |= stored


def _call_violation(node: ast.Call) -> str | None:
    name = _called_name(node)
    if name == "import_module" and not _imports_literal(node):
        return _COMPUTED_IMPORT
    if name == "default_rng" and not (node.args or node.keywords):
        return "default_rng() without a seed is not repeatable"
    if any(k.arg == "allow_pickle" and getattr(k.value, "value", True) for k in node.keywords):
        return "allow_pickle=True runs what a file says"
    return None


# --------------------------------------------------------------------------------------------
# Tests

_SETTERS = frozenset({"setattr", "getattr", "hasattr", "delattr"})


def private_name_violations(tests: Path, modules: list[Module]) -> list[Violation]:
    """Private names of the package that tests reach: a change of a module may rename them."""
    defined = {name for module in modules for name in _defined_names(module.nodes)}
    private = {name for name in defined if name.startswith("_") and not name.startswith("__")}
    private -= {"_fields", "_replace", "_asdict"}  # public, of named tuples
    found: list[Violation] = []
    for path in sorted(tests.rglob("*.py")):
        name = path.relative_to(tests.parent).as_posix()
        text = path.read_text(encoding="utf-8")
        if private.isdisjoint(re.findall(r"\b_\w+", text)):
            continue  # parsing takes seconds
        nodes = tuple(ast.walk(ast.parse(text, str(path))))
        reached = sorted(_reached_names(nodes, private - set(_defined_names(nodes))))
        found += [Violation(name, line, f"reaches the private {what}") for line, what in reached]
    return found


def _defined_names(nodes: tuple[ast.AST, ...]) -> Iterator[str]:
    """Names of functions, classes, variables and attributes that a module defines."""
    for node in nodes:
        if isinstance(node, FunctionNode | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
        elif isinstance(node, ast.Attribute) and _of_self(node) and isinstance(node.ctx, ast.Store):
            yield node.attr


def _of_self(node: ast.Attribute) -> bool:
    return getattr(node.value, "id", "") in ("self", "cls")


def _reached_names(nodes: tuple[ast.AST, ...], private: set[str]) -> Iterator[tuple[int, str]]:
    for node in nodes:
        if isinstance(node, ast.Attribute) and node.attr in private:
            if not _of_self(node):
                yield node.lineno, node.attr
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("fgslam"):
            for alias in node.names:
                if alias.name in private:
                    yield node.lineno, alias.name
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            *path, last = node.value.split(".")
            if path[:1] == ["fgslam"] and last in private:
                yield node.lineno, last
        elif isinstance(node, ast.Call) and _called_name(node) in _SETTERS:
            for argument in node.args[1:2]:
                name = getattr(argument, "value", None)
                if isinstance(name, str) and name in private:
                    yield node.lineno, name
