"""Every command and every line of Python in README.md runs, in the order in which it stands.

The commands run in a copy of the checkout whose `.venv` is the environment that runs the tests. Two
are replaced: `make test` is shown but not run, since it would run this test again; `pip install .`
would change that environment, so that it installs into a folder of its own, without dependencies
and without downloading the build system. The fast test shortens the demo to its first frames, draws
no pictures and runs fgslam in this process; the slow one drives it whole, each command its own.
"""

from __future__ import annotations

import os
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from running import ROOT, copy_of_checkout, main

import fgslam

README = (ROOT / "README.md").read_text(encoding="utf-8")
DEMO_SHORT = (
    "fgslam run lab_loop --set dataset.stop=6 --set compare=[] --set output.pictures=false"
    " --out runs/demo"
)


LARGEST_PAGE = 2_500_000
"""Bytes of the demo's page: with its pictures, Plotly and the data of all figures."""


def blocks(language: str) -> list[str]:
    """Fenced blocks of one language, in order."""
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


def commands() -> list[str]:
    """Lines of the shell blocks without their comments."""
    lines = "".join(blocks("sh")).splitlines()
    return [found for line in lines if (found := re.sub(r"\s+# .*", "", line).strip())]


def run(command: list[str], folder: Path) -> None:
    """Runs a command as a user would, with the tests' interpreter first on the path."""
    paths = [str(Path(sys.executable).parent), os.environ["PATH"]]
    environment = os.environ | {"PATH": os.pathsep.join(paths), "PYTHONPATH": str(folder)}
    done = subprocess.run(  # noqa: S603  commands of the README
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{shlex.join(command)}\n{done.stdout}\n{done.stderr}"


def provide_environment(folder: Path) -> None:
    """What `make` sets up first, without the installation: it is there already."""
    environment = folder / ".venv"
    environment.mkdir()
    (environment / "bin").symlink_to(Path(sys.executable).parent)
    for stamp in ("runtime", "dev"):
        (environment / f".{stamp}-stamp").touch()


def installed_elsewhere(folder: Path) -> list[str]:
    """The installation into a folder of its own."""
    target = ["--target", str(folder.parent / "installed"), "--no-deps", "--no-build-isolation"]
    return [sys.executable, "-m", "pip", "install", "--quiet", "--no-compile", *target, str(folder)]


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A copy of the checkout without what git ignores."""
    folder = copy_of_checkout(tmp_path / "checkout")
    provide_environment(folder)
    return folder


def assert_results(folder: Path) -> None:
    """What the Python block saves."""
    assert (folder / "path.tum").is_file()
    assert (folder / "map.ply").is_file()


def test_readme_fits_a_screen_and_a_half() -> None:
    assert len(README.splitlines()) <= 90
    assert len(re.findall(r"!\[", README)) == 1
    assert len(commands()) == 4


def replaced_in(folder: Path) -> dict[str, list[str]]:
    """Commands that would change more than the copy, and what is run instead."""
    return {
        "make test": ["make", "--dry-run", "test"],
        "pip install .": installed_elsewhere(folder),
    }


def assert_whole(installed: Path) -> None:
    """An installed package has every file of the checkout's, and the experiments."""
    package = Path(fgslam.__file__).parent
    files = [path for path in package.rglob("*") if path.is_file() and path.suffix != ".pyc"]
    experiments = (ROOT / "experiments").glob("*.yaml")
    expected = {path.relative_to(package) for path in files}
    expected |= {path.relative_to(ROOT) for path in experiments}
    assert not {path for path in expected if not (installed / path).is_file()}


def test_commands_run_in_order_with_a_short_demo(
    checkout: Path, in_this_process: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(["make", "--dry-run", "demo"], checkout)
    replaced = replaced_in(checkout) | {"make demo": shlex.split(DEMO_SHORT)}
    assert set(replaced) <= set(commands())
    replaced["pip install ."] = ["true"]  # the slow test installs it
    monkeypatch.chdir(checkout)
    for command in commands():
        words = replaced.get(command, shlex.split(command))
        if words[0] == "fgslam":
            assert main(monkeypatch, *words[1:]) == 0, command
        else:
            run(words, checkout)
    (checkout / "readme.py").write_text(blocks("python")[0], encoding="utf-8")
    runpy.run_path("readme.py")
    assert_results(checkout)
    assert (checkout / "runs/demo/report.html").stat().st_size <= LARGEST_PAGE


@pytest.mark.slow
def test_commands_run_in_order(checkout: Path) -> None:
    replaced = replaced_in(checkout)
    for command in commands():
        run(replaced.get(command, shlex.split(command)), checkout)
    (checkout / "readme.py").write_text(blocks("python")[0], encoding="utf-8")
    run([sys.executable, "readme.py"], checkout)
    assert_results(checkout)
    assert (checkout / "runs/demo/report.html").stat().st_size <= LARGEST_PAGE
    assert (checkout / "runs/demo/compare/comparison.csv").is_file()
    assert_whole(checkout.parent / "installed/fgslam")


def test_make_targets_that_the_documents_name_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([a-z-]+):", makefile, flags=re.MULTILINE))
    text = README + (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    assert set(re.findall(r"\bmake ([a-z-]+)", text)) <= targets | {"test-all"}


def test_links_of_the_readme_lead_to_files() -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        assert (ROOT / target).is_file(), target
