"""What all tests share: repeatable property tests, the folder of real recordings, generators."""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from hypothesis import settings

from fgslam.core.errors import MissingDependencyError
from fgslam.core.open3d_library import load_open3d
from fgslam.core.threads import one_blas_thread

# Thousands of collected tests are objects that stay: to look for cycles among them every 700 new
# ones took two fifths of the time of collecting.
gc.set_threshold(50_000, 20, 100)


def pytest_collection_finish() -> None:
    """What is collected stays: later searches for cycles pass it over."""
    gc.freeze()


# A red test must be red again on the next run, and slow machines must not make one red.
settings.register_profile(
    "fgslam", max_examples=50, derandomize=True, deadline=None, print_blob=True
)
settings.load_profile("fgslam")

SHARED_DATA = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(scope="session", autouse=True)
def _one_blas_thread() -> Iterator[None]:
    """As estimators run in the program, in the tests' own calls and in what they start."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with one_blas_thread():
        yield


@pytest.fixture(scope="session", autouse=True)
def _ctrl_c_is_heard() -> None:
    """Also where the tests run in a shell's background: what they start would ignore it, too."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def _compiled_once() -> None:
    """Processes that tests start keep compiled modules: else each would compile the package."""
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings beside the checkout; skips the test where there is none."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"no recordings at {SHARED_DATA}: this test needs real data")
    return SHARED_DATA


@pytest.fixture(scope="session")
def open3d() -> ModuleType:
    """Open3D; skips the test on machines that lack a system library of it."""
    try:
        return load_open3d()
    except MissingDependencyError as error:
        pytest.skip(str(error))


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator that starts afresh, the same, in every test."""
    return np.random.default_rng(20010521)
