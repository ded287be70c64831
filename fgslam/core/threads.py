"""Linear algebra on one thread wherever estimators run.

Several threads sum in another order, so that a large product's last bits differ from machine to
machine; and matrices of a frame's size are too small to share: on a busy machine two threads take
10 to 20 times as long as one.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import scipy.linalg  # noqa: F401  its BLAS is not NumPy's, and a limit reaches what is loaded
from threadpoolctl import threadpool_limits


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Every loaded BLAS works on one thread inside; usable as a decorator, too.

    Whatever the environment says (``OPENBLAS_NUM_THREADS``); what was set before comes back.
    """
    with threadpool_limits(limits=1, user_api="blas"):
        yield
