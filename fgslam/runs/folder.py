"""The run folder: what it may hold, and how one is begun, resumed or replaced.

Its files are written whole or not at all: :mod:`fgslam.core.files`.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import platform
import shlex
from collections.abc import Iterable
from contextlib import suppress
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

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
        own = f"process {os.getpid()} on {platform.node()}"
        while self._file is None:
            with clear_output_errors(self._path):
                file = os.open(self._path, _OPENED, 0o644)
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                if error.errno not in _NO_LOCKS:
                    why = f"cannot lock {self._path}: {error.strerror}"
                    if isinstance(error, BlockingIOError):
                        why = (
                            f"{self._path.parent}: {_name_in(file) or 'another process'} is "
                            "writing there; wait for it to end, or choose another --out"
                        )
                    os.close(file)
                    raise OutputError(why) from None
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(file), self._path.stat()):
                    self._file = file
            if self._file is None:
                os.close(file)  # its owner gave it back between opening and locking
                continue
            found = _name_in(file)
            self.before = "" if found == own else found
            with clear_output_errors(self._path):
                os.pwrite(file, own.encode(), 0)
                os.ftruncate(file, len(own.encode()))
            remove_unfinished_files(self._path.parent)


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

# What a run writes, and so all that overwriting one may delete; comparisons of it go along.
_RESULT_FILES = """
    config.yaml measurements.npz checkpoint.npz units/*.npz metrics.json timing.csv report.html
    view.rrd pictures/*.png ground_truth.tum ground_truth_landmarks.csv calibration.csv camera.json
    loops.csv comparison.csv trials.csv trials_timing.csv map.fgmap localisation.csv rig_memory.npz
    */online.tum */final.tum */covariance.csv */map.ply */frames.csv */noise.csv
    pairs.csv reference_pairs.csv links.csv estimates.csv routes.csv map.npz path_memory.npz
    frames.csv tracks.csv legs.csv commands.csv trajectory.csv logs/*.npz
    route.fgpath routes.fgmap path_images.csv follow.csv
"""


class FolderKind(NamedTuple):
    """A kind of folder of results: its name, the file that marks it, patterns of what it holds."""

    name: str
    marker: str
    files: tuple[str, ...]


RUN = FolderKind(
    "run",
    RUN_MARKER,
    (
        *(
            f"{inner}{name}"
            for inner in ("", "compare/", "trials/", "first/")
            for name in _RESULT_FILES.split()
        ),
        *(f"trials/{name}" for name in ("sweep.yaml", "cases.jsonl", "*.parquet")),
        "**/.*.partial*",
    ),
)

# --------------------------------------------------------------------------------------------
# The folder of a run, or of a sweep


def require_usable(path: Path, existing: ExistingFolder = "refuse", kind: FolderKind = RUN) -> None:
    """Looks whether results can go into a folder, which may be absent, and changes nothing.

    Args:
        path: the folder itself; an empty one is as good as none.
        existing: what is to be done with one that holds results already: refuse it, delete them
            (and only those), or keep them to resume.
        kind: of its results.

    Raises:
        OutputError: it holds results (`refuse`), something else (`overwrite`), or none (`resume`);
            or it cannot be written to.
    """
    held = (path / kind.marker).is_file()
    if existing == "resume":
        if not held:
            raise OutputError(
                f"cannot resume {path}: it holds no {kind.name} (no {kind.marker}); name the "
                f"folder of an interrupted {kind.name}, or start one without --resume"
            )
    elif (path.exists() or path.is_symlink()) and not path.is_dir():
        raise OutputError(f"cannot write {path}: it is not a folder; choose another name")
    elif held and existing == "refuse":
        raise OutputError(
            f"{path} holds a {kind.name} already; choose another --out, or add --overwrite or "
            "--resume"
        )
    elif not held and path.exists() and not is_empty(path):
        raise OutputError(
            f"{path} exists and holds something else than a {kind.name}; choose another folder"
        )
    if path.is_dir():
        require_writable(path)


def create_folder(path: Path, existing: ExistingFolder = "refuse", kind: FolderKind = RUN) -> Path:
    """Makes the folder of a run with its parents, and makes sure *now* that it can be written to.

    Raises OutputError, also as :func:`require_usable`.
    """
    require_usable(path, existing, kind)
    with clear_output_errors(path):
        if existing == "overwrite":
            files = {file for one in kind.files for file in path.glob(one) if file.is_file()}
            # The marker goes last: killed in the middle, the folder is still known for what it is.
            for file in sorted(files, key=lambda file: (file == path / kind.marker, file)):
                file.unlink()
            for folder in sorted({file.parent for file in files} - {path}, reverse=True):
                if not any(folder.iterdir()):
                    folder.rmdir()
        path.mkdir(parents=True, exist_ok=True)
    require_writable(path)
    return path


def begin_folder(
    path: Path, existing: ExistingFolder, owner: Owner, kind: FolderKind = RUN
) -> None:
    """As :func:`create_folder`; from then on no other process writes into it.

    Raises:
        OutputError: as there, or another process writes into it.
    """
    if not owner.holds:
        if not (path / kind.marker).is_file():
            create_folder(path, existing, kind)
        owner.take()
    create_folder(path, existing, kind)  # another may have begun there before it was taken


def is_run_folder(path: Path) -> bool:
    """Whether ``path`` holds a run, whole or interrupted."""
    return (path / RUN_MARKER).is_file()


def is_empty(path: Path) -> bool:
    """Whether a folder holds nothing, or what a run left that was killed before its first file."""
    with clear_output_errors(path):
        return all(file.name == OWNER_NAME or is_unfinished_file(file) for file in path.iterdir())


# --------------------------------------------------------------------------------------------
# Files of every task's run folder

_VERSIONS_OF = ("numpy", "scipy", "opencv-python-headless", "gtsam", "open3d", "numba")
_PROCESSORS = ("NUMBA_CPU_NAME", "OPENBLAS_CORETYPE")  # bytes are of a kind of processor


def write_config(folder: Path, config: Experiment, provenance: dict[str, Any]) -> None:
    """config.yaml: every default filled in, with the versions and where the data came from."""
    import yaml  # not before: a wrong path is answered without it

    known = {"versions": versions(), "directory": str(Path.cwd())} | provenance
    values = config.as_values() | {"provenance": known}
    write_text(folder / RUN_MARKER, yaml.safe_dump(values, sort_keys=False))


def versions() -> dict[str, str | None]:
    """Versions of this program, of Python and of packages, and processors chosen for these."""
    own = {"fgslam": __version__, "python": platform.python_version()}
    own |= {name: os.environ[name] for name in _PROCESSORS if name in os.environ}
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


# ------------------------------------------------------------------------------------------
# What one may do with a run


def next_commands(folder: Path | str, images: bool) -> tuple[str, ...]:
    """Commands that take the run of SLAM in ``folder`` further, of images or of measurements."""
    run = shlex.quote(str(folder))
    compare = f"fgslam compare {run} --estimators landmark_kalman,isam2,batch"
    export = f"fgslam export {run} --map map.ply"
    dense = f"{export} --colour --dense cloud.ply --grid map.yaml"
    return (compare, dense, f"fgslam film {run} run.mp4") if images else (compare, export)
