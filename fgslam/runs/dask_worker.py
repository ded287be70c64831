"""A Dask worker that ends with the process that started it: `python -m fgslam.runs.dask_worker`."""

from __future__ import annotations

import asyncio
import os
import shutil
import sys
import threading


def main() -> None:
    """Works for the scheduler at the address given until standard input ends."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    asyncio.run(_work(sys.argv[1], sys.argv[2]))


def _end_with_parent() -> None:
    """The pipe ends with the process at its other end, however that ends; nothing is lost here."""
    sys.stdin.buffer.read()
    shutil.rmtree(sys.argv[2], ignore_errors=True)
    os._exit(0)


async def _work(scheduler: str, folder: str) -> None:
    import distributed

    # A thread more would share memory and the limit of BLAS; what is done here is not kept here.
    settings = {"nthreads": 1, "memory_limit": 0, "local_directory": folder, "dashboard": False}
    async with distributed.Worker(scheduler, **settings, death_timeout=10) as worker:
        await worker.finished()


if __name__ == "__main__":
    main()
