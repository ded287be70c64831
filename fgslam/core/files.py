"""Files: written whole or not at all, and texts of other tools read line by line.

Every file is written next to its place and then renamed over it, which POSIX does in one step: an
interrupted run leaves the previous version or none, never half a file.
"""

from __future__ import annotations

import errno
import hashlib
import itertools
import os
import re
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from glob import escape
from pathlib import Path

from fgslam.core.errors import DatasetError, FgslamError, OutputError

_REMEDIES = {
    errno.ENOSPC: "the disk is full; free some space or choose another folder",
    errno.EDQUOT: "the disk quota is used up; free some space or choose another folder",
    errno.EACCES: "permission denied; choose a folder that you may write to",
    errno.EPERM: "permission denied; choose a folder that you may write to",
    errno.EROFS: "the file system is read-only; choose another folder",
    errno.ENOTDIR: "part of the path is a file, not a folder; choose another folder",
    errno.EISDIR: "that is a folder; name a file",
    errno.ENOENT: "its folder does not exist; choose another folder",
    errno.EFBIG: "the file grew beyond the allowed size; raise the limit (ulimit -f)",
    errno.ENAMETOOLONG: "the name is too long; choose a shorter one",
}


_KEPT = 100  # characters of a name, which may be as long as the system allows already
_COUNT = itertools.count()
_WRITER = re.compile(r"\.(\d+)-\d+\.partial")


@contextmanager
def clear_output_errors(path: Path) -> Iterator[None]:
    """Turn an OSError about ``path`` into an OutputError of one line with what to do."""
    try:
        yield
    except OSError as error:
        cause = error.strerror or str(error)
        remedy = _REMEDIES.get(error.errno or 0, f"{cause}; choose another folder")
        raise OutputError(f"cannot write {path}: {remedy}") from error


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A path next to ``path`` to write to; it takes the place of ``path`` when all went well.

    Args:
        path: the file to write; its folder must exist.

    Yields:
        The temporary path, with the same suffix, for writers that choose the format by it.

    Raises:
        OutputError: the folder cannot be written to, the disk is full, or at ``path`` is something
            else than a regular file.
    """
    partial = _beside(path)
    _require_replaceable(path)
    with clear_output_errors(path):
        try:
            yield partial
            os.replace(partial, path)
        finally:
            # Still there only when something failed: that error must not be hidden by another.
            remove_quietly(partial)


def require_output(
    path: Path, overwrite: bool, inputs: Iterable[Path] = (), folder: bool = False
) -> None:
    """The gate, before any work, of every file that a command writes under a name it is given.

    Args:
        path: a new file, or with ``overwrite`` a regular one.
        overwrite: whether `--overwrite` was given.
        inputs: files and folders that the command reads: nothing of them is replaced.
        folder: ``path`` is a folder for files, new, empty, or with ``overwrite`` any.

    Raises:
        OutputError: it is none of these, or its folder cannot be written to.
    """
    require_writable(path.parent)
    if folder:
        if not path.exists():
            return
        if not path.is_dir():
            raise OutputError(f"cannot write {path}: it is not a folder; choose another name")
        if not any(path.iterdir()):
            return
    elif not _require_replaceable(path):
        return
    place = path.resolve()
    for source in inputs:
        known = source.resolve()
        if place == known or known in place.parents:
            what = "it is read" if place == known else f"it is part of {source}, which is read"
            raise OutputError(f"cannot write {path}: {what}; choose another name")
    if not overwrite:
        raise OutputError(f"{path}: is there already; choose another name, or add --overwrite")


def _require_replaceable(path: Path) -> bool:
    """Whether a regular file is at this place. Raises OutputError where something else is."""
    with clear_output_errors(path):
        try:
            mode = path.lstat().st_mode
        except FileNotFoundError:
            return False
    if not stat.S_ISREG(mode):
        raise OutputError(f"cannot write {path}: it is {_kind_of(mode)}; choose another name")
    return True


def _kind_of(mode: int) -> str:
    return next((word for is_it, word in _KINDS if is_it(mode)), "no file")


def _beside(path: Path) -> Path:
    """A name of this process and moment alone: two that write one file shall not share it."""
    own = f"{os.getpid()}-{next(_COUNT)}"
    return path.with_name(f".{path.name[:_KEPT]}.{own}.partial{path.suffix[:_KEPT]}")


def is_unfinished_file(path: Path) -> bool:
    """Whether a process that was killed while writing left this file next to its place."""
    return path.name.startswith(".") and ".partial" in path.name and path.is_file()


def remove_unfinished_files(folder: Path) -> None:
    """Removes what processes that were killed while writing left in a folder and below."""
    for path in folder.rglob(".*.partial*"):
        if is_unfinished_file(path) and not _is_being_written(path):
            remove_quietly(path)


def remove_left_behind(path: Path) -> None:
    """Removes what a process that was killed while writing ``path`` left next to it.

    For files outside run folders that take long to write; of this process nothing is touched.
    """
    own = f".{path.name[:_KEPT]}.{os.getpid()}-"
    for other in path.parent.glob(f".{escape(path.name[:_KEPT])}.*.partial*"):
        mine = other.name.startswith(own)
        if not mine and is_unfinished_file(other) and not _is_being_written(other):
            remove_quietly(other)


def _is_being_written(path: Path) -> bool:
    """Whether the file belongs to another process that is alive."""
    found = _WRITER.search(path.name)
    if found is None or int(found[1]) == os.getpid():
        return False
    try:
        os.kill(int(found[1]), 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True


def cache_root() -> Path:
    """``$FGSLAM_CACHE``, or ``~/.cache/fgslam``."""
    named = os.environ.get("FGSLAM_CACHE")
    return Path(named).expanduser() if named else Path.home() / ".cache" / "fgslam"


def write_bytes(path: Path, content: bytes) -> None:
    """Write a whole file atomically. Raises OutputError when it cannot be written."""
    with replacing(path) as partial:
        partial.write_bytes(content)


_DIGEST = 32  # bytes before what is kept: by them a damaged file is known


def cached(path: Path) -> bytes | None:
    """What :func:`keep_cached` kept in a file; None where it is not, or damaged."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    digest, kept = content[:_DIGEST], content[_DIGEST:]
    return kept if hashlib.sha256(kept).digest() == digest else None


def keep_cached(path: Path, content: bytes) -> None:
    """Keeps what takes time to make where the cache can be written; else it is made again."""
    with suppress(OSError, OutputError):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, hashlib.sha256(content).digest() + content)


def write_text(path: Path, content: str) -> None:
    """Write a whole UTF-8 file atomically, with Unix line ends. Raises OutputError."""
    write_bytes(path, content.encode("utf-8"))


def require_writable(folder: Path) -> None:
    """Tries *now* whether files can be written into a folder. Raises OutputError."""
    probe = _beside(folder / "writable")
    with clear_output_errors(folder):
        try:
            probe.write_bytes(b"\0")
        finally:
            remove_quietly(probe)


def remove_quietly(path: Path) -> None:
    """Removes a file where that is possible."""
    with suppress(OSError):
        path.unlink(missing_ok=True)


def make_subfolder(run: Path, name: str) -> Path:
    """A folder inside the run folder, created when absent. Raises OutputError."""
    folder = run / name
    with clear_output_errors(folder):
        folder.mkdir(exist_ok=True)
    return folder


def remove_file(path: Path) -> None:
    """Removes a file, if it is there. Raises OutputError."""
    with clear_output_errors(path):
        path.unlink(missing_ok=True)


def remove_files(folder: Path, pattern: str) -> None:
    """Removes files of a folder, and the folder once it is empty. Raises OutputError."""
    for path in folder.glob(pattern):
        remove_file(path)
    with clear_output_errors(folder):
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()


# --------------------------------------------------------------------------------------------
# Text files of other tools, line by line


def read_text(
    path: Path,
    error: type[FgslamError] = DatasetError,
    remedy: str = "restore the file",
    most_bytes: int = 1_000_000_000,
) -> str:
    """The text of a UTF-8 file. Raises ``error`` with the remedy where it cannot be read."""
    require_file(path, error, remedy, most_bytes)
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as cause:
        reason = _not_text(path) if isinstance(cause, UnicodeDecodeError) else cause.strerror
        raise error(f"cannot read {path}: {reason}; {remedy}") from cause


def _not_text(path: Path) -> str:
    with path.open("rb") as file:
        marked = file.read(2) in (b"\xff\xfe", b"\xfe\xff")
    return "it is not text in UTF-8, but in UTF-16" if marked else "it is not text in UTF-8"


def require_file(
    path: Path, error: type[FgslamError], remedy: str, most_bytes: int | None = None
) -> None:
    """Raises ``error`` unless a path is that of a file of data, of a size that can be read.

    Who opens a pipe waits for its other end, and a device may have no end.
    """
    try:
        found = path.stat()
    except (OSError, ValueError) as cause:  # the second: a name that holds NUL
        reason = cause.strerror if isinstance(cause, OSError) else str(cause)
        raise error(f"cannot read {path}: {reason}; {remedy}") from cause
    if not stat.S_ISREG(found.st_mode):
        raise error(f"cannot read {path}: it is {_kind_of(found.st_mode)}; {remedy}")
    if most_bytes is not None and found.st_size > most_bytes:
        size, most = found.st_size / 1e6, most_bytes / 1e6
        raise error(f"cannot read {path}: {size:.1f} MB, {most:g} MB at most; {remedy}")


def as_path(given: object, error: type[FgslamError], what: str = "path") -> Path:
    """The path that a text or a path-like object is. Raises ``error`` for what can be none."""
    if not isinstance(given, str | os.PathLike):
        raise error(f"{what}: a {type(given).__name__}; give a text or a pathlib.Path")
    try:
        name = os.fspath(given)
    except TypeError as cause:  # a path-like object whose own path is neither text nor bytes
        raise error(f"{what}: {cause}; give a text or a pathlib.Path") from cause
    if not isinstance(name, str):
        raise error(
            f"{what}: the path of a {type(given).__name__} is of {type(name).__name__}; give a "
            "text or a pathlib.Path"
        )
    if not name:
        raise error(f"{what}: the name is empty; give that of a file or folder")
    path = Path(name)
    try:
        path.stat()
    except ValueError as cause:  # a name that holds NUL, or half of a surrogate pair
        raise error(f"{what}: {cause}; give the name of a file or folder") from cause
    except OSError as cause:
        if cause.errno == errno.ENAMETOOLONG:
            raise error(f"{what}: {path}: the name is too long") from cause
    return path


_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISLNK, "a link"),
)


def shown_in(folder: Path) -> list[Path]:
    """What a folder holds, sorted, but for hidden files: macOS puts a ``._NAME`` next to NAME."""
    return sorted(path for path in folder.iterdir() if not path.name.startswith("."))


def read_lines(path: Path, error: type[DatasetError] = DatasetError) -> list[tuple[int, str]]:
    """Numbered lines, without blank ones and comments (``#``). Raises ``error`` if unreadable."""
    stripped = ((k, line.strip()) for k, line in enumerate(read_text(path, error).splitlines(), 1))
    return [(k, line) for k, line in stripped if line and not line.startswith("#")]
