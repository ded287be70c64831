"""Experiments that come with fgslam are found by name, from the wheel and from a checkout."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from fgslam.core.errors import ConfigError
from fgslam.runs.config import read_mapping
from fgslam.runs.named_experiments import experiment_names, find_experiment, suggestion

ROOT = Path(__file__).parents[3]


def test_every_experiment_of_the_checkout_has_a_name() -> None:
    assert "lab_loop" in experiment_names()
    assert set(experiment_names()) == {p.stem for p in (ROOT / "experiments").glob("*.yaml")}


def test_a_bare_name_is_an_experiment_and_a_path_is_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert read_mapping(find_experiment(Path("lab_loop")))["name"] == "lab_loop"
    for other in ("absent", "elsewhere/lab_loop", "lab_loop.yaml"):
        assert find_experiment(Path(other)) == Path(other)
    (tmp_path / "lab_loop").mkdir()  # e.g. an earlier run's folder
    assert find_experiment(Path("lab_loop")).is_file()


def test_a_file_of_that_name_goes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lab_loop").write_text("name: mine\n", encoding="utf-8")
    assert find_experiment(Path("lab_loop")) == Path("lab_loop")


@pytest.mark.parametrize("missing", ["lab_lop", "experiments/lab_loop.yaml"])
def test_a_missing_file_with_a_known_name_suggests_it(
    missing: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert "lab_loop" in suggestion(Path(missing))
    with pytest.raises(ConfigError, match=r"no such file; the experiment lab_loop comes with"):
        read_mapping(Path(missing))


def test_the_build_step_copies_every_experiment_into_the_wheel(tmp_path: Path) -> None:
    """``setup.py`` itself, without the rest of a build, which needs the network."""
    code = (
        "import sys, setuptools\n"
        "given = {}\n"
        "setuptools.setup = lambda **options: given.update(options)\n"
        "import setup\n"
        "from setuptools import Distribution\n"
        "from setuptools.command.build_py import build_py\n"
        "build_py.run = lambda self: None\n"
        "command = given['cmdclass']['build_py'](Distribution({'packages': []}))\n"
        "command.build_lib, command.editable_mode = sys.argv[1], False\n"
        "command.run()"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], cwd=ROOT, check=True)  # noqa: S603
    copied = {path.stem for path in (tmp_path / "fgslam" / "experiments").glob("*.yaml")}
    assert copied == set(experiment_names())
