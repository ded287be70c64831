"""What a command loads: judged by modules, since times depend on the machine."""

from __future__ import annotations

import resource
import subprocess
import sys

import pytest

HEAVY = frozenset(
    {"cv2", "gtsam", "jinja2", "matplotlib", "numpy", "open3d", "pandas", "PIL", "plotly"}
    | {"dask", "distributed", "pyarrow", "rerun", "scipy", "skimage", "yaml"}
)
_RUN = """
import contextlib, os, sys
from fgslam.cli.main import main
sys.argv = ["fgslam", *sys.argv[1:]]
with contextlib.suppress(SystemExit), contextlib.redirect_stdout(open(os.devnull, "w")):
    main()
print(*sys.modules)
"""


def loaded(code: str, *arguments: str) -> set[str]:
    """Libraries that a fresh interpreter has loaded after this code."""
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True
    )
    return {name.partition(".")[0] for name in done.stdout.split()} & HEAVY


def test_importing_the_package_loads_no_library() -> None:
    assert not loaded("import sys, fgslam; print(*sys.modules)")


@pytest.mark.parametrize(
    "command",
    [
        "--version",
        "run",
        "run absent.yaml",
        "run docs",
        "run lab_loop --no-such-option",
        "inspect absent",
        "inspect docs",
        "compare absent",
        "export absent",
        "view absent",
        "localize absent docs",
        "merge absent absent --out both",
    ],
)
def test_a_wrong_path_is_answered_before_any_library_is_loaded(command: str) -> None:
    assert not loaded(_RUN, *command.split())


def test_help_loads_no_library() -> None:
    assert not loaded(_RUN, "--help")
    assert not loaded(_RUN, "run", "--help")


def test_a_wrong_setting_is_answered_before_arrays_are_loaded() -> None:
    assert loaded(_RUN, "run", "lab_loop", "--set", "dataset.kin=1") == {"yaml"}


def test_a_run_of_the_paper_s_filter_loads_no_solver_of_graphs_and_nothing_that_draws() -> None:
    """Pictures, page, statistics of trials and the world's renderer are imported when used."""
    modules = "fgslam.runs.run, fgslam.runs.tasks.slam, fgslam.slam.factory"
    slow_parts = {"scipy.stats", "scipy.interpolate", "scipy.spatial.transform"}
    code = f"import sys, {modules}; assert not {slow_parts} & set(sys.modules); print(*sys.modules)"
    assert loaded(code) == {"numpy", "scipy", "cv2", "yaml"}


def test_a_memory_limit_below_what_libraries_take_is_one_line() -> None:
    """Below it NumPy's and OpenCV's libraries crash or hang while they are loaded."""

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (400_000_000, 400_000_000))

    done = subprocess.run(
        [sys.executable, "-m", "fgslam", "inspect", "."],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=limited,
        timeout=60,
    )
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "memory limit of 400 MB" in line
    assert "raise it" in line
