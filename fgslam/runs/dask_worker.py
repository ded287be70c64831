"""A Dask worker that ends with the process that started it: `python -m fgslam.runs.dask_worker`."""

from __future__ import annotations

import asyncio
import os
import queue
import shutil
import sys
import threading


def main(folder: str) -> None:
    """Works for the scheduler whose address is the first line of standard input, until that ends.

    What takes a worker long, loading Dask and what cases and trials need, is done before it waits
    for the address: while whoever started it still checks what there is to do.
    """
    addresses: queue.SimpleQueue[str] = queue.SimpleQueue()
    threading.Thread(target=_follow_parent, args=(addresses, folder), daemon=True).start()
    import distributed  # noqa: F401

    import fgslam.runs.sweeps.case  # noqa: F401

    asyncio.run(_work(addresses.get(), folder))


def _follow_parent(addresses: queue.SimpleQueue[str], folder: str) -> None:
    """The pipe ends with the process at its other end, however that ends; nothing is lost here."""
    addresses.put(sys.stdin.buffer.readline().decode().strip())
    sys.stdin.buffer.read()
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(0)


async def _work(scheduler: str, folder: str) -> None:
    import distributed
    from distributed.comm import get_address_host

    # A thread more would share memory and the limit of BLAS; what is done here is not kept here.
    # Without a host it would listen on every address of the machine, and run what comes.
    settings = {"nthreads": 1, "memory_limit": 0, "local_directory": folder, "dashboard": False}
    host = get_address_host(scheduler)
    async with distributed.Worker(scheduler, host=host, **settings, death_timeout=10) as worker:
        await worker.finished()


if __name__ == "__main__":
    main(sys.argv[1])
