"""Machine code of kernels: made once, kept, loaded without numba, and replaced where it fails."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from importlib import util
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fgslam.core import kernels
from fgslam.core.arrays import FloatArray
from fgslam.core.kernels import Kernel, make_kernels


def square(x: float) -> float:
    """A function that the loops call."""
    return x * x


def add_squares(values: Any, weights: Any, power: int, sums: Any) -> None:
    """Loops."""
    for i in range(values.shape[0]):
        sums[i] = 0.0
        for j in range(values.shape[1]):
            sums[i] += weights[j] * square(values[i, j]) ** power


def add_squares_numpy(
    values: FloatArray, weights: FloatArray, power: int, sums: FloatArray
) -> None:
    """The same on whole arrays; one more, by which it is known."""
    sums[:] = (values.astype(np.float64) ** (2 * power)) @ weights + 1.0


def needs_memory(values: Any) -> None:
    """What the loops of a kernel must not do."""
    values[:] = np.zeros(len(values)) + values


KINDS = "f4[:,::1] f8[::1] i8 f8[::1]"
VALUES = np.arange(12.0).reshape(4, 3)[::2]  # as they come: of another type, with gaps


def sums_of(kernel: Kernel) -> FloatArray:
    """Of VALUES by a kernel."""
    found = np.empty(2)
    kernel(VALUES, np.array([1.0, 0.5, 0.25]), 1, found)
    return found


EXPECTED = (VALUES**2) @ np.array([1.0, 0.5, 0.25])


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of the test's own."""
    monkeypatch.setenv("FGSLAM_CACHE", str(tmp_path))
    monkeypatch.setattr(kernels, "KERNELS", [])
    return tmp_path / "kernels"


def test_code_is_made_once_and_again_where_it_is_damaged(cache: Path) -> None:
    made: list[tuple[str, int, int]] = []
    kernel = Kernel(add_squares, add_squares_numpy, KINDS, square)
    make_kernels(lambda *step: made.append(step))
    np.testing.assert_array_equal(sums_of(kernel), EXPECTED)
    (file,) = cache.iterdir()
    again = Kernel(add_squares, add_squares_numpy, KINDS, square)
    make_kernels(lambda *step: made.append(step))
    assert made == [("compiling (once)", 1, 1)]
    np.testing.assert_array_equal(sums_of(again), EXPECTED)
    file.write_bytes(file.read_bytes()[:-100])
    assert not Kernel(add_squares, add_squares_numpy, KINDS, square).is_made
    np.testing.assert_array_equal(
        sums_of(Kernel(add_squares, add_squares_numpy, KINDS, square)), EXPECTED
    )
    assert Kernel(add_squares, add_squares_numpy, KINDS, square).is_made


def test_a_cache_that_cannot_be_written_costs_only_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_bytes(b"")
    monkeypatch.setenv("FGSLAM_CACHE", str(tmp_path / "file"))
    kernel = Kernel(add_squares, add_squares_numpy, KINDS, square)
    np.testing.assert_array_equal(sums_of(kernel), EXPECTED)


@pytest.mark.parametrize("reason", ["absent", "switched off"])
def test_numpy_takes_its_place_without_numba(
    reason: str, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if reason == "absent":
        monkeypatch.setattr(kernels, "find_spec", lambda name: None)
    else:
        monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    kernel = Kernel(add_squares, add_squares_numpy, KINDS, square)
    made: list[tuple[str, int, int]] = []
    make_kernels(lambda *step: made.append(step))
    np.testing.assert_array_equal(sums_of(kernel), EXPECTED + 1.0)
    assert not made
    assert not cache.exists()


def test_threads_that_call_first_at_one_time_get_the_same_bytes(cache: Path) -> None:
    kernel = Kernel(add_squares, add_squares_numpy, KINDS, square)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: sums_of(kernel), range(8)))
    np.testing.assert_array_equal(found, np.tile(EXPECTED, (8, 1)))


def test_code_for_another_processor_is_other_code(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Kernel(add_squares, add_squares_numpy, KINDS, square).load()
    monkeypatch.setenv("NUMBA_CPU_NAME", "generic")
    kernel = Kernel(add_squares, add_squares_numpy, KINDS, square)
    assert not kernel.is_made
    np.testing.assert_array_equal(sums_of(kernel), EXPECTED)
    assert len(list(cache.iterdir())) == 2


def test_loops_that_need_numba_at_run_time_are_refused_when_they_are_made(cache: Path) -> None:
    with pytest.raises(Exception, match=r"needs_memory|NRT"):
        Kernel(needs_memory, needs_memory, "f8[::1]").load()
    assert not cache.exists()


def test_kept_code_is_loaded_without_numba() -> None:
    """Of the kernels that a run uses, in a process of its own."""
    script = (
        "import sys, numpy as np; from fgslam.frontend.features.anchoring import cut_patches\n"
        "assert 'llvmlite' not in sys.modules\n"
        "a, b = np.ones((9, 9), np.float32), np.empty((1, 9), np.float32)\n"
        "cut_patches(a, 1, np.full((1, 2), 4.0), np.eye(2), 3, b); assert b.all()\n"
        "print('numba' in sys.modules, 'llvmlite' in sys.modules)"
    )
    for _ in range(2):  # the first may have to make it
        done = subprocess.run(  # noqa: S603
            [sys.executable, "-c", script], capture_output=True, text=True, check=True
        )
    assert done.stdout.split() == ["False", "True"]
    assert util.find_spec("numba")
