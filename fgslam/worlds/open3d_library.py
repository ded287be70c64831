"""Open3D on machines that lack one of its system libraries: loading it, and what is missing.

Open3D's wheel links against libusb, OpenGL, X11 and others even where only its ray caster is
used. libusb also lives on PyPI, so its absence is handled here; for the others a message says
what to install. ``make setup`` runs this module: ``python -m fgslam.worlds.open3d_library`` says
in one line what is missing and how to provide it, and ``--packages`` prints the Debian package
names alone.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import importlib
import importlib.util
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType

from fgslam.core.errors import MemoryShortageError, MissingDependencyError
from fgslam.core.memory import is_shortage, limit_bytes, room_bytes

_LIBUSB = "libusb-1.0.so.0"
_TAKES = 1_300_000_000  # bytes of address space, measured with Open3D 0.20; half of it is its code


def load_open3d(
    import_module: Callable[[str], ModuleType] = importlib.import_module,
    load_library: Callable[[str], object] | None = None,
    bundled_libusb: Callable[[], Path | None] | None = None,
) -> ModuleType:
    """The open3d module, imported at the first call (about one second).

    The arguments exist for tests and stand for the import system, the dynamic loader, and the
    finder of the libusb that the ``libusb_package`` wheel holds.

    Raises:
        MissingDependencyError: Open3D or a system library it needs is absent.
        MemoryShortageError: the process may not use as much memory as Open3D takes.
    """
    load = load_library or _load_globally
    if "open3d" not in sys.modules:  # loaded already, it takes no more
        _require_room()
    try:
        _provide_libusb(load, bundled_libusb or find_bundled_libusb)
        return import_module("open3d")
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            "the rendered lab needs Open3D, which is not installed: pip install open3d"
        ) from error
    except MemoryError as error:
        raise MemoryShortageError(_too_little()) from error
    except (ImportError, OSError) as error:
        if is_shortage(error):
            raise MemoryShortageError(_too_little()) from error
        raise MissingDependencyError(explain_missing_library(str(error))) from error


def _require_room() -> None:
    """Raises where Open3D would not fit: loaded in part it may end the process."""
    room = room_bytes()
    if room is not None and room < _TAKES:
        raise MemoryShortageError(_too_little())


def _too_little() -> str:
    limit = limit_bytes()
    given = "memory is short" if limit is None else f"memory is limited to {limit / 1e6:.0f} MB"
    how = "free some" if limit is None else "raise the limit (ulimit -v)"
    return (
        f"{given}, and Open3D, which renders the lab, takes {_TAKES / 1e6:.0f} MB, more than "
        f"is left; {how}, or run a recording that is not rendered"
    )


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
        return (
            f"Open3D cannot be loaded: {message.splitlines()[0] if message else 'no reason given'}"
        )
    library = found.group(1)
    package = DEBIAN_PACKAGES.get(library)
    if package is None:
        return f"Open3D needs the system library {library}: install the package that holds it"
    return f"Open3D needs the system library {library}: sudo apt-get install -y {package}"


def _load_globally(name: str) -> object:
    return ctypes.CDLL(name, mode=ctypes.RTLD_GLOBAL)


def _provide_libusb(load: Callable[[str], object], bundled: Callable[[], Path | None]) -> None:
    """Preloads the wheel's libusb where the system has none.

    The loader matches by SONAME, so an object already loaded satisfies Open3D's own request.
    """
    try:
        load(_LIBUSB)
    except OSError:
        path = bundled()
        if path is not None:
            load(str(path))


# --------------------------------------------------------------------------------------------
# What the system lacks


DEBIAN_PACKAGES: Mapping[str, str] = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libidn2.so.0": "libidn2-0",
    "libstdc++.so.6": "libstdc++6",
    "libudev.so.1": "libudev1",
    "libusb-1.0.so.0": "libusb-1.0-0",
}
"""Shared objects that Open3D 0.20's ``libOpen3D.so`` NEEDs beyond libc and its own TBB."""

PRELOADABLE: Mapping[str, str] = {"libusb-1.0.so.0": "libusb_package"}
"""Shared objects that a Python package carries, preloaded where the system has none."""


def can_load(soname: str) -> bool:
    """Whether the dynamic loader finds the shared object."""
    try:
        ctypes.CDLL(soname)
    except OSError:
        return False
    return True


def has_package(name: str) -> bool:
    """Whether a Python package is installed, without importing it."""
    return importlib.util.find_spec(name) is not None


def missing_libraries(
    can_load: Callable[[str], bool] = can_load, has_package: Callable[[str], bool] = has_package
) -> list[str]:
    """Shared objects that neither the system nor an installed Python package provides, sorted."""
    absent = [soname for soname in DEBIAN_PACKAGES if not can_load(soname)]
    return sorted(s for s in absent if s not in PRELOADABLE or not has_package(PRELOADABLE[s]))


def describe(missing: list[str]) -> str:
    """One line: what is missing, what will not work without it, and how to install it."""
    packages = " ".join(DEBIAN_PACKAGES[soname] for soname in missing)
    return (
        f"Open3D cannot load here: missing {', '.join(missing)}; the rendered lab will not run, "
        f"all else will; install: apt-get install {packages} (or what your system calls them)"
    )


def main(arguments: list[str]) -> int:
    """Print what is missing, if anything; status 1 then, else 0."""
    missing = missing_libraries()
    if not missing:
        return 0
    if "--packages" in arguments:
        print(*(DEBIAN_PACKAGES[soname] for soname in missing))
    else:
        print(describe(missing))
    return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
