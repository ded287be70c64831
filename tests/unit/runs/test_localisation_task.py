"""A map says how its features were looked for; other ways are noted, settings it lacks are not."""

from __future__ import annotations

from typing import Any

import pytest

from fgslam.runs.tasks.localisation import settings_that_differ

NOW = {
    "sift": {"max_features": 3},
    "appearance": {"mode": "descriptor"},
    "stereo": {"pixel_sigma": 0.3, "others": "auto"},
}


@pytest.mark.parametrize(
    ("made", "groups"),
    [
        (NOW, []),
        (NOW | {"stereo": {"pixel_sigma": 0.3}}, []),
        (NOW | {"stereo": {"pixel_sigma": 0.3, "retired": 1}}, []),
        (NOW | {"stereo": {"pixel_sigma": 0.2}}, ["stereo"]),
        (NOW | {"sift": {"max_features": 5}}, ["sift"]),
        ({"sift": None}, []),
    ],
)
def test_what_a_map_was_made_with_otherwise(made: dict[str, Any], groups: list[str]) -> None:
    assert settings_that_differ(made, NOW) == groups
