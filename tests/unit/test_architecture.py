"""The house rules hold in fgslam, and the checker finds each kind of violation."""

from __future__ import annotations

import itertools
import re
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest
from architecture_rules import (
    ROOMS,
    Module,
    check_modules,
    check_package,
    imports_of,
    load_package,
    private_name_violations,
)

PACKAGE = Path(__file__).parents[2] / "fgslam"


@cache
def whole_package() -> list[Module]:
    """The modules of fgslam, parsed once."""
    return load_package(PACKAGE)


def write_package(folder: Path, files: dict[str, str]) -> Path:
    """A package ``fgslam`` under ``folder`` with the given sources and every ``__init__``."""
    root = folder / "fgslam"
    for name, source in {"__init__.py": "", **files}.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(source)
        init = path.parent / "__init__.py"
        if not init.exists():
            init.write_text("")
    return root


def findings(folder: Path, files: dict[str, str]) -> list[str]:
    return [str(v) for v in check_package(write_package(folder, files))]


def test_fgslam_keeps_the_house_rules() -> None:
    violations = check_modules(whole_package())
    assert not violations, "\n" + "\n".join(map(str, violations))


def test_tests_reach_no_private_name_of_the_package() -> None:
    violations = private_name_violations(PACKAGE.parent / "tests", whole_package())
    assert not violations, "\n" + "\n".join(map(str, violations))


def test_the_checker_sees_the_whole_package() -> None:
    names = {module.name for module in whole_package()}
    assert {
        "fgslam",
        "fgslam.core.arrays",
        "fgslam.core.geometry",
        "fgslam.backend.protocol",
    } <= names
    assert len(names) == len(list(PACKAGE.rglob("*.py")))


def test_a_lawful_package_passes(tmp_path: Path) -> None:
    files = {
        "core/arrays.py": "import numpy as np\n",
        "core/geometry.py": "from fgslam.core.arrays import x\n",
        "core/open3d_library.py": "def load():\n    import open3d\n    return open3d\n",
        "datasets/lab.py": "import cv2\nfrom fgslam.core import open3d_library\n",
        "factors/stereo.py": "import gtsam\nfrom fgslam.core import arrays\n",
        "backend/isam2.py": "import gtsam\nfrom fgslam.factors.landmark import f\n",
        "slam/pipeline.py": "from fgslam.backend import isam2\nfrom fgslam.datasets import lab\n",
        "cli/main.py": "def main():\n    from fgslam.slam import pipeline\n    return pipeline\n",
        "__main__.py": "from fgslam.cli.main import main\n",
    }
    assert findings(tmp_path, files) == []


ROOM_CASES = {
    "core imports a room": ("core/a.py", "from fgslam.frontend import sift\n", 1),
    "absolute imports count": ("core/arrays.py", "\nimport fgslam.slam.pipeline\n", 2),
    "a stage imports a stage": ("frontend/sift.py", "x = 1\nimport fgslam.report.ply\n", 2),
    "a stage imports a stage from the root": ("frontend/b.py", "from fgslam import factors\n", 1),
    "relative imports count": ("evaluation/a.py", "from ..report import ply\n", 1),
    "relative imports in a package count": (
        "evaluation/__init__.py",
        "from ..report import p\n",
        1,
    ),
    "imports inside functions count": (
        "factors/a.py",
        "def f():\n    from fgslam.backend import isam2\n",
        2,
    ),
    "literal import_module counts": (
        "factors/b.py",
        "import importlib\nm = importlib.import_module('fgslam.backend.isam2')\n",
        2,
    ),
    "worlds do not know datasets": ("worlds/a.py", "import fgslam.datasets.lab\n", 1),
    "the back-end does not read recordings": ("backend/a.py", "import fgslam.datasets.a\n", 1),
    "nothing imports cli": ("slam/a.py", "from fgslam.cli.main import main\n", 1),
    "the back-end does not know the loop": ("backend/b.py", "import fgslam.slam.pipeline\n", 1),
    "nothing is loose at the top": ("pipeline.py", "x = 1\n", 1),
    "SLAM does not know homing": ("slam/b.py", "import fgslam.frontend.homing.sift\n", 1),
    "homing does not know SLAM": ("backend/homing/c.py", "import fgslam.backend.filters.k\n", 1),
}


@pytest.mark.parametrize("case", ROOM_CASES)
def test_room_violations_are_reported_with_file_and_line(tmp_path: Path, case: str) -> None:
    name, source, line = ROOM_CASES[case]
    rooms = {f"{room}/__init__.py": "" for room in sorted(ROOMS)}
    found = findings(tmp_path, {**rooms, name: source})
    assert len(found) == 1, found
    assert found[0].startswith(f"fgslam/{name}:{line}: ")


def test_a_folder_of_modules_is_a_package(tmp_path: Path) -> None:
    """A linter passes over a folder that an ignore rule swallowed; its __init__.py is missing."""
    (tmp_path / "fgslam" / "runs").mkdir(parents=True)
    (tmp_path / "fgslam" / "__init__.py").write_text("")
    (tmp_path / "fgslam" / "runs" / "a.py").write_text("x = 1\n")
    found = [str(violation) for violation in check_package(tmp_path / "fgslam")]
    assert found == ["fgslam/runs/a.py:1: fgslam/runs has no __init__.py; add one"]


LIBRARY_CASES = {
    "cv2 in the back-end": (
        "backend/a.py",
        "import cv2\n",
        "'cv2' only in cameras, datasets, frontend",
    ),
    "gtsam in the front-end": (
        "frontend/a.py",
        "import gtsam\n",
        "'gtsam' only in backend, factors",
    ),
    "gtsam submodules": ("report/a.py", "from gtsam.symbol_shorthand import X\n", "'gtsam' only"),
    "open3d in the pipeline": (
        "slam/pipeline.py",
        "def f():\n    import open3d\n",
        "'open3d' only in core",
    ),
}


@pytest.mark.parametrize("case", LIBRARY_CASES)
def test_library_violations(tmp_path: Path, case: str) -> None:
    name, source, message = LIBRARY_CASES[case]
    found = findings(tmp_path, {name: source})
    assert len(found) == 1, found
    assert message in found[0]


STATEMENT_CASES = {
    "allow_pickle": "import numpy as np\n\nx = np.load('a', allow_pickle=True)\n",
    "unseeded generator": "import numpy as np\n\nx = np.random.default_rng()\n",
    "second value": "SHARE = 0.1\n\nSHARE, MOST = 0.2, 3\n",
    "computed import": "import importlib\n\nx = importlib.import_module('a' + 'b')\n",
}


@pytest.mark.parametrize("case", STATEMENT_CASES)
def test_statement_violations_are_on_their_line(tmp_path: Path, case: str) -> None:
    found = findings(tmp_path, {"frontend/bad.py": STATEMENT_CASES[case]})
    assert len(found) == 1, found
    assert found[0].startswith("fgslam/frontend/bad.py:3: ")


def test_lawful_statements_pass(tmp_path: Path) -> None:
    source = (
        "import numpy as np\ng = np.random.default_rng(7)\ny = np.load('a', allow_pickle=False)\n"
        "g = (g, y)\n"
    )
    assert findings(tmp_path, {"frontend/good.py": source}) == []


def test_cycles_are_found_with_their_route(tmp_path: Path) -> None:
    found = findings(
        tmp_path,
        {
            "frontend/a.py": "from fgslam.frontend import b\n",
            "frontend/b.py": "def f():\n    from fgslam.frontend.c import g\n",
            "frontend/c.py": "import fgslam.frontend.a\n",
            "frontend/d.py": "import fgslam.frontend.a\n",
        },
    )
    assert len(found) == 3
    route = "fgslam.frontend.a -> fgslam.frontend.b -> fgslam.frontend.c -> fgslam.frontend.a"
    assert found[0] == f"fgslam/frontend/a.py:1: import cycle: {route}"
    assert found[1].startswith("fgslam/frontend/b.py:2: ")


def test_sizes_are_limited(tmp_path: Path) -> None:
    body = "    x = 1\n"
    docstring = '    """One.\n' + "\n" * 20 + '    """\n'
    fine = "def f():\n" + docstring + 79 * body
    assert findings(tmp_path / "fine", {"frontend/a.py": fine}) == []
    long_function = findings(tmp_path / "f", {"frontend/a.py": "def f():\n" + 80 * body})
    assert long_function == ["fgslam/frontend/a.py:1: function f of 81 lines (at most 80)"]
    long_module = findings(tmp_path / "m", {"frontend/a.py": "import cv2\n\n# why\n" + "x\n" * 701})
    assert long_module == ["fgslam/frontend/a.py:1: module of 701 code lines (at most 700)"]


def test_a_new_room_needs_a_place_in_the_order(tmp_path: Path) -> None:
    found = findings(tmp_path, {"gadgets/__init__.py": "x = 1\n"})
    assert len(found) == 1
    assert "'gadgets' is no room" in found[0]


_DISTRIBUTIONS = {
    "PIL": "pillow",
    "cv2": "opencv-python-headless",
    "dask": "distributed",  # its other half
    "pydantic_core": "pydantic",  # its other half
    "rerun": "rerun-sdk",
    "skimage": "scikit-image",
    "yaml": "pyyaml",
}
"""Where a module's distribution has another name."""
_LOADED_BY_NAME = {"open3d", "skimage", "libusb_package"}


def plain(name: str) -> str:
    """A distribution's name as package indices compare it."""
    return re.sub(r"[-_.]+", "-", re.split(r"[<>=!~\[ ]", name)[0]).lower()


def test_what_the_package_imports_is_declared() -> None:
    """A library that comes along with another one today need not do so tomorrow."""
    modules = whole_package()
    imported = {item.target for module in modules for item in imports_of(module, modules)}
    libraries = _LOADED_BY_NAME | {name.partition(".")[0] for name in imported}
    libraries -= set(sys.stdlib_module_names) | {"fgslam"}
    text = (PACKAGE.parent / "pyproject.toml").read_text(encoding="utf-8")
    project = tomllib.loads(text)["project"]
    declared = {plain(name) for name in project["dependencies"]}
    declared |= {plain(name) for name in project["optional-dependencies"]["viewer"]}
    assert not {name for name in libraries if plain(_DISTRIBUTIONS.get(name, name)) not in declared}


def test_every_room_of_the_order_exists() -> None:
    rooms = {module.layer for module in whole_package()}
    assert set(ROOMS) <= rooms


def test_light_modules_load_no_heavy_library() -> None:
    # `fgslam --help` must answer at once, and work where a library cannot be loaded.
    script = (
        "import sys; from fgslam.core import arrays, geometry, log\n"
        "from fgslam.runs import config; from fgslam.cli import main\n"
        "print([m for m in ('cv2', 'gtsam', 'open3d', 'matplotlib', 'scipy') if m in sys.modules])"
    )
    done = subprocess.run(  # noqa: S603 - our own interpreter and our own script
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


PRIVATE_CASES = {
    "attribute": "made = object()\nmade._kept()\n",
    "import": "\nfrom fgslam.core.a import _kept\n",
    "attribute set by name": "\nmonkeypatch.setattr(module, '_kept', 1)\n",
    "path": "\nmonkeypatch.setattr('fgslam.core.a._kept', 1)\n",
    "path handed on": "x = 1\nSMALL = {'fgslam.core.a._kept': 1}\n",
}


@pytest.mark.parametrize("case", PRIVATE_CASES)
def test_a_private_name_that_a_test_reaches_is_found(tmp_path: Path, case: str) -> None:
    modules = load_package(write_package(tmp_path, {"core/a.py": "def _kept(): pass\n"}))
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "test_a.py").write_text(PRIVATE_CASES[case])
    found = private_name_violations(tmp_path / "tests", modules)
    assert [str(each) for each in found] == ["tests/test_a.py:2: reaches the private _kept"]


def test_private_names_of_the_test_itself_and_of_libraries_are_its_own(tmp_path: Path) -> None:
    modules = load_package(write_package(tmp_path, {"core/a.py": "_mine = _kept = 1\n"}))
    (tmp_path / "tests").mkdir()
    source = "import os\n_mine = 1\nsame = os._mine, os._exit\nself._kept = 1\n"
    (tmp_path / "tests" / "test_a.py").write_text(source)
    assert private_name_violations(tmp_path / "tests", modules) == []


def test_no_two_test_files_have_one_name() -> None:
    """Pytest imports them by their names alone: of two alike it collects one and stops."""
    names = sorted(path.name for path in (PACKAGE.parent / "tests").rglob("test_*.py"))
    assert [a for a, b in itertools.pairwise(names) if a == b] == []
