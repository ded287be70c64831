"""Linear algebra on one thread wherever estimators run.

Several threads sum in another order, so that a large product's last bits differ from machine to
machine; and matrices of a frame's size are too small to share: on a busy machine two threads take
10 to 20 times as long as one.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import util
from typing import Any

import numpy as np
from threadpoolctl import ThreadpoolController


def _load_when_used(name: str) -> None:
    """A part of NumPy that is loaded with its first use."""
    spec = util.find_spec(whole := f"numpy.{name}")
    if whole in sys.modules or spec is None or spec.loader is None:
        return
    spec.loader = util.LazyLoader(spec.loader)
    sys.modules[whole] = module = util.module_from_spec(spec)
    setattr(np, name, module)
    spec.loader.exec_module(module)


# SciPy asks for all parts of NumPy, and would load a compiler's and a test runner's for 0.1 s.
for _part in ("f2py", "testing"):
    _load_when_used(_part)
import scipy.linalg  # noqa: E402,F401  its BLAS is not NumPy's, and a limit reaches what is loaded


class BlasLimits:
    """Limits of the process, taken back in the reverse order in which they were set.

    A limit belongs to the whole process. Of several threads at work the first to leave must not
    take it from the others: what it set is undone only when all who came later have left, too.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._set: list[Any] = []  # as threadpoolctl gives them
        self._left: set[int] = set()
        self._loaded: ThreadpoolController | None = None
        self._modules = 0  # imported when the libraries were last looked for

    def enter(self) -> Any:
        """Sets a limit of one thread."""
        with self._lock:
            limits = self._libraries().limit(limits=1, user_api="blas")
            self._set.append(limits)
            return limits

    def _libraries(self) -> ThreadpoolController:
        """Looking for them takes a millisecond or two, in every frame: only after an import."""
        modules = len(sys.modules)  # before the search: what is imported meanwhile counts next time
        if self._loaded is None or self._modules != modules:
            self._loaded, self._modules = ThreadpoolController(), modules
        return self._loaded

    def leave(self, limits: Any) -> None:
        """Undoes a limit, and those before it that have left already."""
        with self._lock:
            self._left.add(id(limits))
            while self._set and id(self._set[-1]) in self._left:
                last = self._set.pop()
                self._left.remove(id(last))
                last.restore_original_limits()


_LIMITS = BlasLimits()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Every loaded BLAS works on one thread inside; usable as a decorator, too.

    Whatever the environment states (``OPENBLAS_NUM_THREADS``); what was set before comes back, once
    all threads that are inside have left.
    """
    limits = _LIMITS.enter()
    try:
        yield
    finally:
        _LIMITS.leave(limits)
