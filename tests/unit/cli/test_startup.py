"""What a command loads: judged by modules, since times depend on the machine."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from fgslam.cli import start

HEAVY = frozenset(
    {"cv2", "gtsam", "jinja2", "matplotlib", "numpy", "open3d", "pandas", "PIL", "plotly"}
    | {"dask", "distributed", "llvmlite", "numba", "pyarrow", "rerun", "scipy", "skimage", "yaml"}
)
_RUN = """
import contextlib, os, sys
from fgslam.cli.main import main
for command in sys.argv[1:]:
    sys.argv = ["fgslam", *command.split()]
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(open(os.devnull, "w")):
        main()
print(*sys.modules)
"""


def loaded(code: str, *commands: str) -> set[str]:
    """Libraries that a fresh interpreter has loaded after this code."""
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-c", code, *commands], capture_output=True, text=True, check=True
    )
    return {name.partition(".")[0] for name in done.stdout.split()} & HEAVY


def test_importing_the_package_loads_no_library() -> None:
    assert not loaded("import sys, fgslam; print(*sys.modules)")


def test_help_and_wrong_paths_are_answered_before_any_library_is_loaded() -> None:
    """One after the other in one process."""
    assert not loaded(
        _RUN,
        *("--version", "run", "run lab_loop --no-such-option", "inspect docs", "compare absent"),
        *("localize absent docs", "merge absent absent --out both", "--help", "run --help"),
    )


def test_a_wrong_setting_is_answered_before_arrays_are_loaded() -> None:
    assert loaded(_RUN, "run lab_loop --set dataset.kin=1") == {"yaml"}


def test_a_run_of_the_paper_s_filter_loads_no_solver_of_graphs_and_nothing_that_draws() -> None:
    """Pictures, page, statistics of trials and the world's renderer are imported when used."""
    modules = "fgslam.runs.run, fgslam.runs.tasks.slam, fgslam.slam.build"
    slow_parts = {"scipy.stats", "scipy.interpolate", "scipy.spatial.transform"}
    code = f"import sys, {modules}; assert not {slow_parts} & set(sys.modules); print(*sys.modules)"
    assert loaded(code) == {"numpy", "scipy", "cv2", "yaml"}


def test_the_library_loads_nothing_that_draws_before_it_is_asked() -> None:
    code = "import sys, fgslam; fgslam.run, fgslam.sweep, fgslam.compare; print(*sys.modules)"
    assert not loaded(code) & {"plotly", "matplotlib", "pandas", "distributed"}


def limited_to(limit: int, *command: str) -> subprocess.CompletedProcess[str]:
    """A command, ended, that may use so many bytes of address space."""
    return subprocess.run(  # noqa: S603
        [sys.executable, "-m", "fgslam", *command],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit)),
        timeout=600,
    )


@pytest.mark.parametrize("mb", [400, 1150])
def test_a_memory_limit_below_what_libraries_take_is_one_line(mb: int) -> None:
    """Below it libraries crash while they are loaded, or try for memory without end."""
    done = limited_to(mb * 1_000_000, "inspect", ".")
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert f"memory limit of {mb} MB" in line
    assert "raise it" in line


@pytest.mark.parametrize(
    ("gigabytes", "cores", "single"),
    [(2, 2, True), (7.9, 2, True), (8.1, 2, False), (256, 2, False), (8.1, 64, True),
     (256, 64, False), (None, 2, False)],
)  # fmt: skip
def test_only_a_limit_that_threads_would_fill_keeps_libraries_on_one(
    gigabytes: float | None, cores: int, single: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    limit = None if gigabytes is None else int(1e9 * gigabytes)
    monkeypatch.setattr(start, "limit_bytes", lambda: limit)
    monkeypatch.setattr(os, "cpu_count", lambda: cores)
    monkeypatch.setattr(os, "environ", given := {"OMP_NUM_THREADS": "3"})
    start.require_memory()
    others = {"OPENBLAS_NUM_THREADS": "1"} if single else {}
    assert given == {"OMP_NUM_THREADS": "3"} | others  # what the user says stays


@pytest.mark.slow
@pytest.mark.parametrize("mb", [1300, 2000])
def test_a_memory_limit_below_what_rendering_takes_is_one_line(mb: int, tmp_path: Path) -> None:
    given = ("--set", "dataset.stop=2", "--set", "compare=[]", "--out", str(tmp_path / "run"))
    done = limited_to(mb * 1_000_000, "run", "lab_loop", *given)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert f"memory is limited to {mb} MB" in line
    assert "raise the limit" in line


@pytest.mark.slow
def test_a_run_in_the_least_memory_that_is_allowed_finishes(tmp_path: Path) -> None:
    """Of a simulated world: BLAS, SciPy, GTSAM and the page of the report."""
    given = ("--set", "dataset.stop=5", "--set", "compare=[isam2]", "--out", str(tmp_path / "run"))
    done = limited_to(1_200_000_000, "run", "lab_trials", *given)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run" / "report.html").is_file()


def test_a_film_that_cannot_be_read_is_one_line(tmp_path: Path) -> None:
    """What FFmpeg writes to the standard error by itself is no line of ours."""
    (tmp_path / "damaged.mp4").write_bytes(b"rubbish")
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-m", "fgslam", "inspect", str(tmp_path / "damaged.mp4")],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert done.stderr.startswith("fgslam: ")
    assert done.stderr.count("\n") == 1
