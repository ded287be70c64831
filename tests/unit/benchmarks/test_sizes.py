"""The lab at other sizes of the image."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[3]))

from benchmarks.evidence.sizes import sizes_table


@pytest.mark.slow
def test_larger_images_have_more_features_and_inliers() -> None:
    table = sizes_table((320, 640), frames=3)
    assert table.column("located") == ["3 of 3", "3 of 3"]
    for name in ("features an image", "inliers"):
        small, large = (float(str(cell)) for cell in table.column(name))
        assert large > 1.5 * small, name
