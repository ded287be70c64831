import resource
import sys
from pathlib import Path
from types import ModuleType

import pytest

from fgslam.core.errors import MemoryShortageError, MissingDependencyError
from fgslam.worlds import open3d_library
from fgslam.worlds.open3d_library import (
    explain_missing_library,
    find_bundled_libusb,
    load_open3d,
)

NO_LIBUSB = OSError("libusb-1.0.so.0: cannot open shared object file: No such file or directory")
NO_ROOM = "libOpen3D.so.0.20: failed to map segment from shared object"


class Loader:
    """A dynamic loader on a machine without the system's libusb."""

    def __init__(self) -> None:
        self.loaded: list[str] = []

    def __call__(self, name: str) -> object:
        if name == "libusb-1.0.so.0":
            raise NO_LIBUSB
        self.loaded.append(name)
        return object()


def test_bundled_libusb_is_loaded_before_open3d_where_the_system_has_none() -> None:
    loader, module = Loader(), ModuleType("open3d")

    def import_module(name: str) -> ModuleType:
        assert name == "open3d"
        assert loader.loaded == ["/wheel/libusb-1.0.so"]
        return module

    assert load_open3d(import_module, loader, lambda: Path("/wheel/libusb-1.0.so")) is module


def test_systems_own_libusb_is_preferred() -> None:
    loaded: list[str] = []

    def no_need() -> Path | None:
        raise AssertionError("the bundled library was looked for")

    load_open3d(lambda name: ModuleType(name), loaded.append, no_need)
    assert loaded == ["libusb-1.0.so.0"]


def test_wheel_holds_a_library_that_answers_to_the_systems_name() -> None:
    path = find_bundled_libusb()
    assert path is not None
    assert b"libusb-1.0.so.0\0" in path.read_bytes()


def test_missing_libusb_everywhere_names_the_package() -> None:
    def import_module(name: str) -> ModuleType:
        raise ImportError(str(NO_LIBUSB))

    with pytest.raises(MissingDependencyError, match=r"apt-get install -y libusb-1\.0-0") as caught:
        load_open3d(import_module, Loader(), lambda: None)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("library", "package"),
    [("libGL.so.1", "libgl1"), ("libX11.so.6", "libx11-6"), ("libEGL.so.1", "libegl1"),
     ("libudev.so.1", "libudev1")],
)  # fmt: skip
def test_missing_libraries_are_named_with_their_package(library: str, package: str) -> None:
    text = explain_missing_library(f"{library}: cannot open shared object file: No such file")
    assert library in text
    assert text.endswith(f"apt-get install -y {package}")


def test_unknown_library_and_unknown_failure_still_give_one_line() -> None:
    assert "libfoo-2.so.3" in explain_missing_library("libfoo-2.so.3: cannot open shared object")
    assert explain_missing_library("odd\nthing").count("\n") == 0


def test_absent_open3d_says_how_to_install_it() -> None:
    def import_module(name: str) -> ModuleType:
        raise ModuleNotFoundError(f"No module named {name!r}")

    with pytest.raises(MissingDependencyError, match="pip install open3d"):
        load_open3d(import_module, lambda name: object(), lambda: None)


@pytest.mark.parametrize("fault", [MemoryError(), ImportError(NO_ROOM), OSError(NO_ROOM)])
def test_open3d_without_memory_is_not_called_a_missing_library(
    fault: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    def import_module(name: str) -> ModuleType:
        raise fault

    monkeypatch.delitem(sys.modules, "open3d", raising=False)
    monkeypatch.setattr(resource, "getrlimit", lambda which: (10**12, -1))
    with pytest.raises(MemoryShortageError, match="memory is limited to 1000000 MB") as caught:
        load_open3d(import_module, lambda name: object(), lambda: None)
    assert "\n" not in str(caught.value)


def test_open3d_is_not_loaded_where_it_does_not_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "open3d", raising=False)
    monkeypatch.setattr(open3d_library, "room_bytes", lambda: 10**9)
    with pytest.raises(MemoryShortageError, match="more than is left"):
        load_open3d(lambda name: pytest.fail("it was loaded"), lambda name: object(), lambda: None)


def test_a_second_load_needs_no_room(monkeypatch: pytest.MonkeyPatch) -> None:
    def import_module(name: str) -> ModuleType:
        return sys.modules.setdefault(name, ModuleType(name))

    monkeypatch.setitem(sys.modules, "open3d", ModuleType("open3d"))  # what was there comes back
    monkeypatch.delitem(sys.modules, "open3d")
    room = 2 * 10**9
    monkeypatch.setattr(open3d_library, "room_bytes", lambda: room)
    first = load_open3d(import_module, lambda name: object(), lambda: None)
    room = 10**8  # Open3D has taken the rest
    assert load_open3d(import_module, lambda name: object(), lambda: None) is first
