"""One BLAS thread: within it, whatever was set before, and given back afterwards."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
from threadpoolctl import ThreadpoolController, threadpool_info, threadpool_limits

from fgslam.core import threads
from fgslam.core.threads import one_blas_thread

ROOT = Path(__file__).parents[3]

# A full EKF whose covariance outgrows the size from which OpenBLAS shares products among threads:
# without the limit its bytes differ between one thread and two.
EKF_DIGEST = """
import hashlib
from pathlib import Path
from threadpoolctl import threadpool_info
from fgslam.runs.config import load_config
from fgslam.datasets.opening import open_measurements
from fgslam.core.log import MeasurementLog
from fgslam.slam.replay import replay
from fgslam.backend.settings import EkfSettings

config = load_config(Path("experiments/lab_trials.yaml"))
whole = open_measurements(config.dataset, 0).log
log = MeasurementLog(whole.rig, whole.motion_model)
for increment in whole.increments[:24]:
    log.append(increment)
estimate = replay(log, EkfSettings(), config.frontend.ego_motion).estimate
assert len(estimate.landmarks) > 150
digest = hashlib.sha256()
for array in (estimate.trajectory.poses, estimate.covariances, estimate.landmarks.covariances):
    digest.update(array.tobytes())
print(max(x["num_threads"] for x in threadpool_info() if x["user_api"] == "blas"))
print(digest.hexdigest())
"""


def blas_threads() -> list[int]:
    """Threads of every BLAS that this process has loaded."""
    return [x["num_threads"] for x in threadpool_info() if x["user_api"] == "blas"]


def digest_with(threads: int) -> tuple[int, str]:
    """What a process of its own says that was set to use so many threads."""
    found = subprocess.run(  # noqa: S603  our own program, above
        [sys.executable, "-c", EKF_DIGEST],
        cwd=ROOT,
        env=os.environ | {"OPENBLAS_NUM_THREADS": str(threads)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 0, found.stderr
    allowed, digest = found.stdout.split()
    return int(allowed), digest


def test_one_thread_inside_and_as_before_outside() -> None:
    with threadpool_limits(limits=2, user_api="blas"):
        before = blas_threads()
        assert max(before) == 2
        with one_blas_thread():
            assert set(blas_threads()) == {1}
        assert blas_threads() == before


def test_nested_thread_limits_end_independently() -> None:
    with threadpool_limits(limits=2, user_api="blas"):
        first, second = one_blas_thread(), one_blas_thread()
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert set(blas_threads()) == {1}
        second.__exit__(None, None, None)
        assert max(blas_threads()) == 2


def test_libraries_are_looked_for_only_after_an_import(monkeypatch: pytest.MonkeyPatch) -> None:
    searches = []

    class Counted(ThreadpoolController):  # type: ignore[misc]
        def __init__(self) -> None:
            searches.append(1)
            super().__init__()

    monkeypatch.setattr(threads, "ThreadpoolController", Counted)
    limits = threads.BlasLimits()
    for _ in range(2):
        limits.leave(limits.enter())
    assert len(searches) == 1
    monkeypatch.setitem(sys.modules, "a_library_with_a_blas", ModuleType("a"))
    for _ in range(2):
        limits.leave(limits.enter())
    assert len(searches) == 2


@pytest.mark.slow
def test_the_same_bytes_whatever_the_environment_says() -> None:
    (one, first), (two, second) = digest_with(1), digest_with(2)
    assert (one, two) == (1, min(2, len(os.sched_getaffinity(0))))
    assert first == second
