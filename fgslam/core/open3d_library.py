"""Open3D on machines that lack one of its system libraries: loading it, and what is missing.

Open3D's wheel links against libusb, OpenGL, X11 and others even where only its ray caster is
used. libusb also lives on PyPI, so its absence is handled here; for the others a message names
what to install. ``make setup`` runs this module: ``python -m fgslam.core.open3d_library`` prints
in one line what is missing and how to provide it, and ``--packages`` prints the Debian package
names alone.
"""

from __future__ import annotations

import ctypes
import importlib
import importlib.util
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType

from fgslam.core.errors import MemoryShortageError, MissingDependencyError
from fgslam.core.memory import is_shortage, limit_bytes, room_bytes

_LIBUSB = "libusb-1.0.so.0"
_TAKES = 1_300_000_000  # bytes of address space, measured with Open3D 0.20; half of it is its code

DEBIAN_PACKAGES: Mapping[str, str] = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libidn2.so.0": "libidn2-0",
    "libstdc++.so.6": "libstdc++6",
    "libudev.so.1": "libudev1",
    _LIBUSB: "libusb-1.0-0",
}
"""Shared objects that Open3D 0.20's ``libOpen3D.so`` NEEDs beyond libc and its own TBB."""


def load_open3d() -> ModuleType:
    """The open3d module, imported at the first call (about one second).

    Raises:
        MissingDependencyError: Open3D or a system library it needs is absent.
        MemoryShortageError: the process may not use as much memory as Open3D takes.
    """
    room = room_bytes()
    # Loaded in part it may end the process; loaded already, it takes no more.
    if "open3d" not in sys.modules and room is not None and room < _TAKES:
        raise MemoryShortageError(_too_little())
    try:
        if not can_load(_LIBUSB) and (bundled := find_bundled_libusb()) is not None:
            # The loader matches by SONAME: an object already loaded satisfies Open3D's request.
            ctypes.CDLL(str(bundled), mode=ctypes.RTLD_GLOBAL)
        return importlib.import_module("open3d")
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            "Open3D, which the rendered lab and dense maps need, is not installed: pip install "
            "open3d"
        ) from error
    except (MemoryError, ImportError, OSError) as error:
        if isinstance(error, MemoryError) or is_shortage(error):
            raise MemoryShortageError(_too_little()) from error
        raise MissingDependencyError(explain_missing_library(str(error))) from error


def _too_little() -> str:
    limit = limit_bytes()
    given = "memory is short" if limit is None else f"memory is limited to {limit / 1e6:.0f} MB"
    how = "free some" if limit is None else "raise the limit (ulimit -v)"
    return (
        f"{given}, and Open3D, which renders the lab, takes {_TAKES / 1e6:.0f} MB, more than "
        f"is left; {how}, or run a recording that is not rendered"
    )


def can_load(library: str) -> bool:
    """Whether the dynamic loader finds a shared object, which is then loaded for all to use."""
    try:
        ctypes.CDLL(library, mode=ctypes.RTLD_GLOBAL)
    except OSError:
        return False
    return True


def find_bundled_libusb() -> Path | None:
    """Path of the shared object inside the ``libusb_package`` wheel, or None where it is absent."""
    spec = importlib.util.find_spec("libusb_package")
    if spec is None or not spec.submodule_search_locations:
        return None
    folder = Path(next(iter(spec.submodule_search_locations)))
    return next(iter(sorted(folder.glob("libusb-1.0.so*"))), None)


def explain_missing_library(message: str) -> str:
    """One line for the user: which shared object the loader missed, and how to install it."""
    found = re.search(r"(lib[\w.+-]+?\.so[\w.]*)", message)
    if found is None:
        return f"Open3D cannot be loaded: {(message or 'no reason given').splitlines()[0]}"
    library = found.group(1)
    package = DEBIAN_PACKAGES.get(library)
    how = f"sudo apt-get install -y {package}" if package else "install the package that holds it"
    return f"Open3D needs the system library {library}: {how}"


def missing_libraries() -> list[str]:
    """Shared objects that neither the system nor an installed Python package provides, sorted."""
    absent = {name for name in DEBIAN_PACKAGES if not can_load(name)}
    return sorted(absent - ({_LIBUSB} if find_bundled_libusb() else set()))


def main(arguments: list[str]) -> int:
    """Print what is missing, if anything; status 1 then, else 0."""
    missing = missing_libraries()
    packages = " ".join(DEBIAN_PACKAGES[name] for name in missing)
    if "--packages" in arguments and missing:
        print(packages)
    elif missing:
        print(
            f"Open3D cannot load here: missing {', '.join(missing)}; the rendered lab will not "
            f"run, all else will; install: apt-get install {packages} (or what your system calls "
            "them)"
        )
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
