"""Memory that the system allows this process, and faults that are a lack of it.

Libraries say in many ways that there is no more: NumPy raises MemoryError, OpenCV an error of its
own, the dynamic loader cannot map a shared object, a thread cannot be started.
"""

from __future__ import annotations

import errno
import os
import re
import resource
from pathlib import Path

from fgslam.core.errors import FgslamError, MemoryShortageError

_OF_LOADER = re.compile(
    r"failed to map segment|cannot allocate memory|cannot create shared object descriptor"
    r"|cannot map zero-fill pages",
    re.IGNORECASE,
)
_OF_LIBRARIES = re.compile(
    r"insufficient memory|outofmemory|can't start new thread|bad_alloc", re.IGNORECASE
)
_STATM = Path("/proc/self/statm")
_OF_MALLOC = {-1: 256 << 20, -3: 32 << 20}
"""Options of glibc's mallopt, bytes: more unused memory than the first at the heap's end is given
back (M_TRIM_THRESHOLD), what is larger than the second at once (M_MMAP_THRESHOLD, at its limit)."""


def keep_freed_memory() -> None:
    """Lets glibc keep freed memory for the next frame's arrays; another library does as it does.

    Pages that are given back and asked for again cost a sixth of SIFT's time at 640x480, and a
    twentieth of the loop's. What the environment sets of malloc (``MALLOC_...``) stays as it is.
    """
    import ctypes  # light modules do not load it

    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None and not any(name.startswith("MALLOC_") for name in os.environ):
        for option, size in _OF_MALLOC.items():
            mallopt(option, size)


def limit_bytes() -> int | None:
    """Address space that the process may use (``ulimit -v``), bytes; None where it is not limited.

    Threads, shared objects and files that are mapped count, used or not.
    """
    soft = resource.getrlimit(resource.RLIMIT_AS)[0]
    return None if soft == resource.RLIM_INFINITY else soft


def room_bytes() -> int | None:
    """Address space left below the limit, bytes; None where it is not limited, or not known."""
    limit = limit_bytes()
    if limit is None or not _STATM.exists():
        return None
    pages = int(_STATM.read_text(encoding="ascii").split()[0])
    return limit - pages * os.sysconf("SC_PAGE_SIZE")


def is_shortage(error: BaseException) -> bool:
    """True of an error for lack of memory, whichever library raised it.

    Not of this package's own errors: their text repeats names of files and settings.
    """
    if isinstance(error, FgslamError):
        return False
    if isinstance(error, MemoryError):
        return True
    if isinstance(error, OSError) and error.errno == errno.ENOMEM:
        return True
    if isinstance(error, (ImportError, OSError)):
        return bool(_OF_LOADER.search(str(error)))
    return isinstance(error, Exception) and bool(_OF_LIBRARIES.search(str(error)))


def shortage() -> str:
    """What is wrong where memory has run out, and how to correct it; no line break."""
    limit = limit_bytes()
    if limit is None:
        return "not enough memory; free some, or take fewer frames"
    return (
        f"not enough memory: the limit is {limit / 1e6:.0f} MB (ulimit -v); raise it, or take "
        "fewer frames"
    )


class ShortageTold:
    """What a library raises for lack of memory becomes a MemoryShortageError."""

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if error is not None and is_shortage(error):
            raise MemoryShortageError(shortage()) from error
