"""fgslam from its wheel alone: installed by pip, used in an empty folder, no checkout in sight."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest
from running import HANGS_AFTER_S, copy_of_checkout


def run(folder: Path, *command: object, **changes: str) -> subprocess.CompletedProcess[str]:
    """A command in a folder, with nothing of this process's paths."""
    kept = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    done = subprocess.run(  # noqa: S603
        list(map(str, command)),
        cwd=folder,
        env=kept | changes,
        capture_output=True,
        text=True,
        timeout=HANGS_AFTER_S,
        check=False,
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The commands' folder of an environment with the wheel and the libraries of this one.

    Only the libraries' folder is on its path: an editable checkout there stays out of reach.
    """
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--quiet"]
    build = ["wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", folder]
    checkout = copy_of_checkout(folder / "checkout")
    run(folder, *pip, *build, checkout)
    shutil.rmtree(checkout)
    (wheel,) = folder.glob("*.whl")
    environment = folder / "environment"
    venv.create(environment, symlinks=True)
    commands = environment / "bin"
    into = ["--python", commands / "python", "install", "--no-deps"]
    run(folder, *pip, *into, wheel)
    (packages,) = environment.glob("lib/python*/site-packages")
    libraries = sysconfig.get_path("purelib")
    (packages / "libraries.pth").write_text(libraries, encoding="utf-8")
    return commands


@pytest.mark.slow
def test_the_demo_runs(installed: Path, tmp_path: Path) -> None:
    home = run(tmp_path, installed / "python", "-c", "import fgslam; print(fgslam.__file__)").stdout
    assert Path(home).is_relative_to(installed.parent)
    run(tmp_path, installed / "fgslam", "demo")
    assert 1_000_000 < (tmp_path / "runs/demo/report.html").stat().st_size <= 3_000_000
    assert (tmp_path / "runs/demo/comparison.csv").is_file()


@pytest.mark.slow
def test_a_folder_becomes_a_map_without_open3d(
    installed: Path, recording: Path, tmp_path: Path
) -> None:
    command = (installed / "fgslam", "run", recording, "--out", "mapped")
    loaded = run(tmp_path, *command, PYTHONPROFILEIMPORTTIME="1").stderr
    assert re.search(r"\| +cv2$", loaded, flags=re.MULTILINE)
    assert not re.search(r"\| +(open3d|rerun|distributed)$", loaded, flags=re.MULTILINE)
    assert (tmp_path / "mapped/sliding_window/map.ply").is_file()
    assert [path.name for path in tmp_path.iterdir()] == ["mapped"]
