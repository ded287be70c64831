"""Every script of examples/ runs alone, to its end, without a network."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import pytest

NEED_MORE = {"ros2_node"}  # ROS, or a bag: test_ros2_node.py
SCRIPTS = sorted((Path(__file__).parents[2] / "examples").glob("*.py"))
EXAMPLES = [path for path in SCRIPTS if path.stem not in NEED_MORE]


# They render a house, or compare estimators.
LONG = (
    "drive_home",
    "filter_or_smoother",
    "homing_vector",
    "live_robot",  # test_live_robot.py
    "own_features",
)
HERE = [
    script
    for script in EXAMPLES
    if (script.stem.startswith("own_") or script.stem == "saved_map") and script.stem not in LONG
]
SCRIPTS = [
    pytest.param(script, marks=pytest.mark.slow if script.stem in LONG else ())
    for script in EXAMPLES
    if script not in HERE
]


@pytest.mark.parametrize("script", HERE, ids=lambda path: path.stem)
def test_example_runs_to_its_end_in_this_process(
    script: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A process of its own would import everything, and render the laboratory, once more."""
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(script), run_name="__main__")
    assert capsys.readouterr().out


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_example_runs_to_its_end(script: Path, tmp_path: Path) -> None:
    done = subprocess.run(  # noqa: S603 -- our own script
        [sys.executable, str(script)], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout
