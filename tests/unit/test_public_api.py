"""The front door: what `import fgslam` offers, loads, and says about itself."""

from __future__ import annotations

import inspect
import json
import subprocess
import sys

import pytest

import fgslam as fg
from fgslam.core import errors as core_errors

LIBRARIES = ("numpy", "scipy", "cv2", "gtsam", "pydantic", "yaml", "open3d", "plotly", "pandas")
IMPORTS = """
import json, sys
import fgslam
first = sorted(sys.modules)
fgslam.StereoRig
print(json.dumps([first, sorted(sys.modules)]))
"""
ARRAY_WORDS = ("(4, 4)", "(n,", "(height, width", "(n, 3)", "(4, 4, n)")


def public() -> list[str]:
    return [name for name in fg.__all__ if not name.startswith("__") and name != "errors"]


def test_importing_loads_no_library() -> None:
    found = subprocess.run(  # noqa: S603  our own program, above
        [sys.executable, "-c", IMPORTS], capture_output=True, text=True, check=True
    )
    first, after = json.loads(found.stdout)
    assert not [name for name in LIBRARIES if name in first]
    inner = [name for name in first if name.startswith("fgslam.")]
    assert len(inner) <= 5, inner
    assert "numpy" in after
    assert "gtsam" not in after


def test_every_name_can_be_imported_and_listed() -> None:
    assert len(set(fg.__all__)) == len(fg.__all__)
    assert set(fg.__all__) <= set(dir(fg))
    for name in fg.__all__:
        assert getattr(fg, name) is not None


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Smal'"):
        _ = fg.Smal  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", public())
def test_every_public_name_is_documented(name: str) -> None:
    found = getattr(fg, name)
    text = inspect.getdoc(found) or ""
    assert len(text.splitlines()[0]) > 20, f"{name}: no first line that says what comes out"
    if inspect.isclass(found):
        for member, value in vars(found).items():
            documented = inspect.isfunction(value) or isinstance(value, property | classmethod)
            if documented and not member.startswith("_"):
                assert inspect.getdoc(value), f"{name}.{member} has no docstring"


@pytest.mark.parametrize("name", ["Slam.track", "Odometry", "Trajectory", "Features", "Map.locate"])
def test_shapes_stand_where_arrays_are_handed_over(name: str) -> None:
    found = fg
    for part in name.split("."):
        found = getattr(found, part)
    text = inspect.getdoc(found) or ""
    assert any(word in text for word in ARRAY_WORDS), text


def test_errors_have_a_short_name() -> None:
    import fgslam.errors
    from fgslam.errors import FgslamError

    assert fgslam.errors is core_errors
    assert FgslamError is core_errors.FgslamError
    kinds = [kind for kind in vars(core_errors).values() if inspect.isclass(kind)]
    assert all(issubclass(kind, FgslamError) for kind in kinds)
    assert all(kind.__doc__ for kind in kinds)
