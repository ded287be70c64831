"""Open3D where a system library, its wheel or memory is missing."""

import importlib
import importlib.util
import resource
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from fgslam.core import open3d_library
from fgslam.core.errors import MemoryShortageError, MissingDependencyError
from fgslam.core.open3d_library import (
    DEBIAN_PACKAGES,
    explain_missing_library,
    find_bundled_libusb,
    load_open3d,
)

LIBUSB = "libusb-1.0.so.0"
NO_LIBUSB = f"{LIBUSB}: cannot open shared object file: No such file or directory"
NO_ROOM = "libOpen3D.so.0.20: failed to map segment from shared object"
PROVIDED_EVERYWHERE = ("libc.so", "libm.so", "libgcc_s.so", "ld-linux", "libtbb.so", "libpthread")
Machine = Callable[..., list[str]]


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Machine:
    """Makes a machine: what its loader lacks, which libusb a wheel holds, how the import fails."""

    def make(
        lacks: set[str] | None = None,
        wheel: Path | None = None,
        fault: Exception | None = None,
    ) -> list[str]:
        loaded: list[str] = []

        def load(name: str, **_: object) -> None:
            if name in (lacks or set()):
                raise OSError(f"{name}: cannot open shared object file")
            loaded.append(name)

        def import_module(name: str) -> ModuleType:
            if fault is not None:
                raise fault
            loaded.append(name)
            return sys.modules.setdefault(name, ModuleType(name))

        monkeypatch.setitem(sys.modules, "open3d", ModuleType("open3d"))  # comes back at the end
        monkeypatch.delitem(sys.modules, "open3d")
        monkeypatch.setattr(open3d_library.ctypes, "CDLL", load)
        monkeypatch.setattr(importlib, "import_module", import_module)
        monkeypatch.setattr(open3d_library, "find_bundled_libusb", lambda: wheel)
        return loaded

    return make


def test_bundled_libusb_is_loaded_before_open3d_where_the_system_has_none(machine: Machine) -> None:
    loaded = machine(lacks={LIBUSB}, wheel=Path("/wheel/libusb-1.0.so"))
    assert load_open3d() is sys.modules["open3d"]
    assert loaded == ["/wheel/libusb-1.0.so", "open3d"]


def test_systems_own_libusb_is_preferred(machine: Machine) -> None:
    loaded = machine(wheel=Path("/wheel/libusb-1.0.so"))
    load_open3d()
    assert loaded == [LIBUSB, "open3d"]


def test_wheel_holds_a_library_that_answers_to_the_systems_name() -> None:
    path = find_bundled_libusb()
    assert path is not None
    assert b"libusb-1.0.so.0\0" in path.read_bytes()


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (ImportError(NO_LIBUSB), r"apt-get install -y libusb-1\.0-0$"),
        (ModuleNotFoundError("No module named 'open3d'"), "pip install open3d$"),
        (OSError("odd\nthing"), "cannot be loaded: odd$"),
    ],
)
def test_what_is_missing_is_named_with_its_remedy(
    fault: Exception, message: str, machine: Machine
) -> None:
    machine(lacks={LIBUSB}, fault=fault)
    with pytest.raises(MissingDependencyError, match=message) as caught:
        load_open3d()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("library", "remedy"), [*DEBIAN_PACKAGES.items(), ("libfoo-2.so.3", "the package that holds")]
)
def test_missing_libraries_are_named_with_their_package(library: str, remedy: str) -> None:
    text = explain_missing_library(f"{library}: cannot open shared object file: No such file")
    assert library in text
    assert remedy in text


@pytest.mark.parametrize("fault", [MemoryError(), ImportError(NO_ROOM), OSError(NO_ROOM)])
def test_open3d_without_memory_is_not_called_a_missing_library(
    fault: Exception, machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine(fault=fault)
    monkeypatch.setattr(resource, "getrlimit", lambda which: (10**12, -1))
    with pytest.raises(MemoryShortageError, match="memory is limited to 1000000 MB") as caught:
        load_open3d()
    assert "\n" not in str(caught.value)
    assert "raise the limit (ulimit -v)" in str(caught.value)


def test_open3d_is_loaded_where_it_fits_and_needs_no_room_again(
    machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine()
    room = 10**9
    monkeypatch.setattr(open3d_library, "room_bytes", lambda: room)
    with pytest.raises(MemoryShortageError, match="more than is left"):
        load_open3d()
    room = 2 * 10**9
    first = load_open3d()
    room = 10**8  # Open3D has taken the rest
    assert load_open3d() is first


def needed_libraries(path: Path) -> list[str]:
    """NEEDED entries of a 64-bit little-endian ELF file, from its dynamic section."""
    with path.open("rb") as file:
        header = file.read(64)
        assert header[:6] == b"\x7fELF\x02\x01"
        sections_at = struct.unpack_from("<Q", header, 40)[0]
        size, count = struct.unpack_from("<HH", header, 58)
        file.seek(sections_at)
        table = file.read(size * count)
        # Of each section: type, offset, size, link.
        sections = [(*struct.unpack_from("<4xI16xQQI", table, i * size),) for i in range(count)]
        _, offset, length, link = next(s for s in sections if s[0] == 6)
        file.seek(offset)
        dynamic = struct.iter_unpack("<qQ", file.read(length))
        names_at = [value for tag, value in dynamic if tag == 1]
        file.seek(sections[link][1])
        names = file.read(sections[link][2])
    return [names[at : names.index(b"\0", at)].decode() for at in names_at]


def test_listed_libraries_are_those_that_the_wheel_links() -> None:
    spec = importlib.util.find_spec("open3d")
    if spec is None or not spec.submodule_search_locations:
        pytest.skip("open3d is not installed")
    folder = Path(spec.submodule_search_locations[0])
    libraries = sorted(folder.glob("libOpen3D.so*"))
    if not libraries:
        pytest.skip(f"this build of open3d has no libOpen3D.so in {folder}")
    needed = {n for n in needed_libraries(libraries[0]) if not n.startswith(PROVIDED_EVERYWHERE)}
    assert needed == set(DEBIAN_PACKAGES)


@pytest.mark.parametrize(
    ("lacks", "wheel", "packages"),
    [
        (set(), None, ""),
        ({"libX11.so.6", "libGL.so.1"}, None, "libgl1 libx11-6"),
        ({LIBUSB}, None, "libusb-1.0-0"),
        ({LIBUSB}, Path("/wheel/libusb-1.0.so"), ""),
    ],
)
def test_setup_is_told_what_the_machine_lacks(
    lacks: set[str],
    wheel: Path | None,
    packages: str,
    machine: Machine,
    capsys: pytest.CaptureFixture[str],
) -> None:
    machine(lacks=lacks, wheel=wheel)
    assert open3d_library.main(["--packages"]) == int(bool(packages))
    assert capsys.readouterr().out.strip() == packages
    open3d_library.main([])
    line = capsys.readouterr().out
    assert line.count("\n") == int(bool(packages))
    assert all(name in line for name in lacks) or wheel is not None
    assert not packages or f"apt-get install {packages} " in line
