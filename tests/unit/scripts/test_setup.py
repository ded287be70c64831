"""scripts/setup.sh and the Makefile, on machines made up here."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
# What a surrounding `make test FGSLAM_PYTHON=...` hands down must not steer the runs in here.
FROM_MAKE = ("MAKEFLAGS", "MFLAGS", "MAKELEVEL", "MAKEOVERRIDES", "FGSLAM_PYTHON")


def executable(path: Path, script: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("#!/bin/sh\n" + script)
    path.chmod(0o755)
    return path


def own_environment() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name not in FROM_MAKE}


def run_setup(
    checkout: Path, *arguments: str, **variables: str
) -> subprocess.CompletedProcess[str]:
    """Runs a copy of the script, so that it cannot touch this checkout's environment."""
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("bash is not installed")
    (checkout / "scripts").mkdir(parents=True)
    shutil.copy(ROOT / "scripts" / "setup.sh", checkout / "scripts")
    # Not root, so that nothing is ever installed here.
    executable(checkout / "bin" / "id", "echo 1000\n")
    path = f"{checkout / 'bin'}:/usr/bin:/bin"
    return subprocess.run(  # noqa: S603 - our own script
        [bash, str(checkout / "scripts" / "setup.sh"), *arguments],
        capture_output=True,
        text=True,
        env={**own_environment(), "PATH": path, **variables},
        check=False,
    )


def test_setup_says_which_python_is_needed(tmp_path: Path) -> None:
    done = run_setup(tmp_path, "runtime", FGSLAM_PYTHON="/nowhere/python")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "Python 3.11, 3.12 or 3.13 is needed" in done.stderr
    assert "make setup FGSLAM_PYTHON=" in done.stderr


def test_setup_says_which_package_makes_environments(tmp_path: Path) -> None:
    python = executable(
        tmp_path / "python",
        'case "$2" in *ensurepip*) exit 1 ;; *print*) echo 3.12 ;; esac\n',
    )
    done = run_setup(tmp_path, "runtime", FGSLAM_PYTHON=str(python))
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "no ensurepip" in done.stderr
    assert "python3.12-venv" in done.stderr
    assert not (tmp_path / ".venv").exists()


def test_setup_passes_over_pythons_that_do_not_run(tmp_path: Path) -> None:
    # As the names that version managers leave on the PATH.
    for name in ("python3.11", "python3.12", "python3.13"):
        executable(tmp_path / "bin" / name, "echo not for this folder >&2; exit 127\n")
    executable(
        tmp_path / "bin" / "python3",
        'case "$2" in *ensurepip*) exit 1 ;; *print*) echo 3.13 ;; esac\n',
    )
    done = run_setup(tmp_path, "runtime")
    assert "python3 cannot make virtual environments" in done.stderr
    assert "python3.13-venv" in done.stderr


def test_setup_that_fails_leaves_no_stamp(tmp_path: Path) -> None:
    executable(
        tmp_path / ".venv" / "bin" / "python",
        'case "$*" in *"pip install"*) echo "no index" >&2; exit 1 ;; esac\n',
    )
    done = run_setup(tmp_path, "dev")
    assert done.returncode == 1
    assert "pip could not install" in done.stderr
    assert not (tmp_path / ".venv" / ".dev-stamp").exists()


def test_setup_succeeds_without_system_libraries(tmp_path: Path) -> None:
    executable(
        tmp_path / ".venv" / "bin" / "python",
        'case "$*" in\n'
        '  *"open3d_library --packages") echo libgl1; exit 1 ;;\n'
        "  *open3d_library) echo Open3D cannot load here; exit 1 ;;\n"
        "esac\n",
    )
    done = run_setup(tmp_path, "runtime")
    assert done.returncode == 0, done.stderr
    assert "Open3D cannot load here" in done.stderr
    assert (tmp_path / ".venv" / ".runtime-stamp").exists()


def test_setup_refuses_unknown_kinds(tmp_path: Path) -> None:
    done = run_setup(tmp_path, "everything")
    assert done.returncode == 1
    assert "use runtime or dev" in done.stderr


@pytest.mark.parametrize(
    ("target", "stamps"),
    [
        ("demo", ["runtime"]),
        ("test", ["runtime", "dev"]),
        ("check", ["runtime", "dev"]),
    ],
)
def test_every_target_sets_up_first_and_once(
    tmp_path: Path, target: str, stamps: list[str]
) -> None:
    make = shutil.which("make")
    if make is None:
        pytest.skip("make is not installed")
    for name in ("Makefile", "pyproject.toml", "scripts/setup.sh"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)

    def dry_run() -> list[str]:
        command = [make, "--dry-run", "--no-print-directory", target]
        done = subprocess.run(  # noqa: S603 - our own Makefile
            command,
            cwd=tmp_path,
            capture_output=True,
            text=True,
            env=own_environment(),
            check=True,
        )
        return [line for line in done.stdout.splitlines() if "scripts/setup.sh" in line]

    assert dry_run() == [f"bash scripts/setup.sh {kind}" for kind in stamps]
    (tmp_path / ".venv").mkdir()
    for kind in stamps:
        (tmp_path / ".venv" / f".{kind}-stamp").touch()
    assert dry_run() == []
