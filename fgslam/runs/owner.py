"""Who writes into a run folder: one process at a time, known by a lock that ends with it."""

from __future__ import annotations

import errno
import fcntl
import os
import platform
from contextlib import suppress
from pathlib import Path

from fgslam.core.errors import OutputError
from fgslam.core.files import clear_output_errors, remove_unfinished_files

OWNER_NAME = ".owner"
_OPENED = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
"""Said by file systems that know no locks: there a run goes without."""


class Owner:
    """This process as the only one that writes into a folder, until it is left.

    The system takes the lock from a process that ends, however it ends: its folder can be taken
    over at once.

    Attributes:
        before: the owner that ended without giving the folder back, in words; empty without one.
    """

    def __init__(self, folder: Path) -> None:
        """``folder`` need not exist yet."""
        self._path = folder / OWNER_NAME
        self._file: int | None = None
        self.before = ""

    def __enter__(self) -> Owner:
        return self

    def __exit__(self, *error: object) -> None:
        if self._file is not None:
            # Before the lock goes: who opens the name after that makes a file of its own. What
            # cannot be removed any more is taken over, and hides no error that was the reason.
            with suppress(OSError):
                self._path.unlink(missing_ok=True)
            os.close(self._file)
            self._file = None

    @property
    def holds(self) -> bool:
        """Whether the folder is this process's."""
        return self._file is not None

    def take(self) -> None:
        """Takes the folder, which exists, unless this did so before.

        Raises:
            OutputError: another process writes into it, or it cannot be written to.
        """
        while self._file is None:
            with clear_output_errors(self._path):
                file = os.open(self._path, _OPENED, 0o644)
            try:
                self._lock(file)
            except OutputError:
                os.close(file)
                raise
            if self._is_at_its_place(file):
                self._file = file
                self._sign(file)
                remove_unfinished_files(self._path.parent)
            else:  # its owner gave it back, and with it this file, between opening and locking
                os.close(file)

    def _lock(self, file: int) -> None:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OutputError(
                f"{self._path.parent}: {_name_in(file) or 'another process'} is writing there; "
                "wait for it to end, or choose another --out"
            ) from None
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise OutputError(f"cannot lock {self._path}: {error.strerror}") from None

    def _is_at_its_place(self, file: int) -> bool:
        try:
            return os.path.samestat(os.fstat(file), self._path.stat())
        except FileNotFoundError:
            return False

    def _sign(self, file: int) -> None:
        own = f"process {os.getpid()} on {platform.node()}"
        found = _name_in(file)
        if found != own:
            self.before = found
        with clear_output_errors(self._path):
            os.pwrite(file, own.encode(), 0)
            os.ftruncate(file, len(own.encode()))


def _name_in(file: int) -> str:
    return os.pread(file, 200, 0).decode(errors="replace")


def give_back(folder: Path) -> None:
    """Removes what an owner left that was killed. Raises OutputError where it is alive."""
    if (folder / OWNER_NAME).exists():
        with Owner(folder) as owner:
            owner.take()
