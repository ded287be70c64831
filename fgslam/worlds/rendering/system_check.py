"""What Open3D's wheel needs of the system, and what of it is absent here.

Only the rendered lab and some point-cloud conversions need Open3D. ``make setup`` runs this module:
``python -m fgslam.worlds.rendering.system_check`` says in one line what is missing and how to
provide it, and ``--packages`` prints the Debian package names alone. Standard library only.
"""

from __future__ import annotations

import ctypes
import importlib.util
import sys
from collections.abc import Callable, Mapping

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
