"""The run folder: what it may hold, and how one is begun, resumed or replaced.

Its files are written whole or not at all: :mod:`fgslam.core.files`.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import platform
from collections.abc import Iterable
from contextlib import suppress
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from fgslam.core import __version__
from fgslam.core.errors import OutputError
from fgslam.core.files import (
    clear_output_errors,
    is_unfinished_file,
    remove_unfinished_files,
    require_writable,
    write_text,
)

if TYPE_CHECKING:
    from fgslam.runs.config import Experiment


# ------------------------------------------------------------------------------------------
# Who writes into a run folder: one process at a time, known by a lock that ends with it

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


ExistingFolder: TypeAlias = Literal["refuse", "overwrite", "resume"]

RUN_MARKER = "config.yaml"
"""The file that every run folder holds; it is written first."""

METRICS_FILE = "metrics.json"
REPORT_FILE = "report.html"
LOG_FILE = "measurements.npz"
STATE_FILE = "checkpoint.npz"
COMPARISON_FILE = "comparison.csv"
CALIBRATION_FILE = "calibration.csv"
CAMERA_FILE = "camera.json"
TRIALS_FILE = "trials.csv"
TIMING_FILE = "trials_timing.csv"

_ESTIMATOR_FILES = (
    "online.tum",
    "final.tum",
    "covariance.csv",
    "map.ply",
    "frames.csv",
    "noise.csv",
)
_RESULT_FILES = (
    RUN_MARKER,
    LOG_FILE,
    STATE_FILE,
    "ground_truth.tum",
    "ground_truth_landmarks.csv",
    METRICS_FILE,
    "timing.csv",
    CALIBRATION_FILE,
    CAMERA_FILE,
    "loops.csv",
    COMPARISON_FILE,
    TRIALS_FILE,
    TIMING_FILE,
    REPORT_FILE,
    "view.rrd",
    "map.fgmap",
    # of homing runs
    "pairs.csv",
    "reference_pairs.csv",
    "links.csv",
    "localisation.csv",
    "estimates.csv",
    "routes.csv",
    "map.npz",
    "path_memory.npz",
    "frames.csv",
    "tracks.csv",
    "legs.csv",
    "commands.csv",
    "trajectory.csv",
    "route.fgpath",
    "routes.fgmap",
    "path_images.csv",
    "follow.csv",
    "logs/*.npz",
    "units/*.npz",
    "pictures/*.png",
    *(f"*/{name}" for name in _ESTIMATOR_FILES),
)
# What a run writes, and so all that overwriting one may delete; comparisons of it go along.
_RUN_FILES = (
    *_RESULT_FILES,
    *(f"{inner}/{name}" for inner in ("compare", "trials", "first") for name in _RESULT_FILES),
    "**/.*.partial*",
)

# --------------------------------------------------------------------------------------------
# The run folder


def create_run_folder(path: Path, existing: ExistingFolder = "refuse") -> Path:
    """Make the folder of a run, and make sure *now* that it can be written to.

    Args:
        path: the folder itself; its parents are created too. An empty one is as good as none.
        existing: what to do with a folder that holds a run already: refuse it, delete that run's
            files (and only those), or keep them to resume.

    Returns:
        ``path``.

    Raises:
        OutputError: it exists (`refuse`), holds something else than a run (`overwrite`), holds
            no run (`resume`), or cannot be written to.
    """
    if existing == "resume":
        _require_run(path)
    elif path.exists() or path.is_symlink():
        _make_room(path, overwrite=existing == "overwrite")
    with clear_output_errors(path):
        path.mkdir(parents=True, exist_ok=True)
    require_writable(path)
    return path


def begin_run_folder(path: Path, existing: ExistingFolder, owner: Owner) -> None:
    """As :func:`create_run_folder`; from then on no other process writes into it.

    Raises:
        OutputError: as there, or another process writes into it.
    """
    if not owner.holds:
        if not is_run_folder(path):
            create_run_folder(path, existing)
        owner.take()
    create_run_folder(path, existing)  # another run may have begun there before it was taken


def is_run_folder(path: Path) -> bool:
    """Whether ``path`` holds a run, whole or interrupted."""
    return (path / RUN_MARKER).is_file()


def is_empty(path: Path) -> bool:
    """Whether a folder holds nothing, or what a run left that was killed before its first file."""
    with clear_output_errors(path):
        return all(file.name == OWNER_NAME or is_unfinished_file(file) for file in path.iterdir())


def _require_run(path: Path) -> None:
    if not is_run_folder(path):
        raise OutputError(
            f"cannot resume {path}: it holds no run (no {RUN_MARKER}); "
            "name the folder of an interrupted run, or start one without --resume"
        )


def _make_room(path: Path, *, overwrite: bool) -> None:
    if not path.is_dir():
        raise OutputError(f"cannot write {path}: it is not a folder; choose another name")
    if is_empty(path):
        return
    if not is_run_folder(path):
        raise OutputError(
            f"{path} exists and holds something else than a run; choose another folder"
        )
    if not overwrite:
        raise OutputError(
            f"{path} holds a run already; choose another --out, or add --overwrite or --resume"
        )
    with clear_output_errors(path):
        _delete_run_files(path)


def _delete_run_files(path: Path) -> None:
    files = {file for pattern in _RUN_FILES for file in path.glob(pattern) if file.is_file()}
    # The marker goes last: killed in the middle, the folder is still known for a run.
    for file in sorted(files, key=lambda file: (file == path / RUN_MARKER, file)):
        file.unlink()
    for folder in sorted({file.parent for file in files} - {path}, reverse=True):
        if not any(folder.iterdir()):
            folder.rmdir()


# --------------------------------------------------------------------------------------------
# Files of every task's run folder

_VERSIONS_OF = ("numpy", "scipy", "opencv-python-headless", "gtsam", "open3d")


def write_config(folder: Path, config: Experiment, provenance: dict[str, Any]) -> None:
    """config.yaml: every default filled in, with the versions and where the data came from."""
    import yaml  # not before: a wrong path is answered without it

    values = config.as_values() | {"provenance": {"versions": versions()} | provenance}
    write_text(folder / RUN_MARKER, yaml.safe_dump(values, sort_keys=False))


def versions() -> dict[str, str | None]:
    """Versions of this program, of Python and of the packages that shape the numbers."""
    own = {"fgslam": __version__, "python": platform.python_version()}
    return own | {name: _version(name) for name in _VERSIONS_OF}


def digest_of(files: Iterable[Path]) -> str:
    """SHA-256 of the files' names and contents, in their order."""
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


@cache
def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
