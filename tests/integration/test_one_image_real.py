"""A recording of which single images are missing is located as well as the complete one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from running import metrics_of

import fgslam as fg
from fgslam.backend.settings import DEFAULT_ESTIMATOR

SHARE, SEED = 0.05, 0


@pytest.mark.data
@pytest.mark.slow
def test_five_percent_of_single_images_missing_cost_no_accuracy(
    shared_data: Path, tmp_path: Path
) -> None:
    source, spoilt = shared_data / "euroc_v101_kf100", tmp_path / "spoilt"
    gone = np.random.default_rng(SEED).random((100, 2)) < SHARE
    gone[0] = gone[gone.all(axis=1)] = False
    for file in (path for path in source.rglob("*") if path.is_file()):
        camera = file.parent.name
        if camera not in ("left", "right") or not gone[int(file.stem), int(camera == "right")]:
            link = spoilt / file.relative_to(source)
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(file)
    fg.run(spoilt, {"output.pictures": False, "output.report": False}, tmp_path / "run")
    metrics = metrics_of(tmp_path / "run")
    assert metrics["status_counts"]["one_image"] == gone.sum() == 10
    # The complete recording has 1.5 cm; with the whole frames thrown away it were 7.5.
    assert metrics["estimators"][DEFAULT_ESTIMATOR]["ate_rmse_m"] < 0.02
