"""What docs/results claims of the kidnapped robot, as regression tests with their bounds."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from fgslam.runs.config import LocalisationConfig, load_experiment
from fgslam.runs.engine import run_task
from fgslam.runs.tasks.localisation import Scored, open_localisation, scored

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.evidence import relocalising

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
QUIET = ("output.pictures=false", "output.report=false", "output.checkpoint_seconds=3600")


def asked(name: str, folder: Path, *overrides: str) -> tuple[Scored, ...]:
    config = load_experiment(EXPERIMENTS / f"{name}.yaml", [*QUIET, *overrides])
    assert isinstance(config, LocalisationConfig)
    return scored(config, run_task(open_localisation, config, folder).asked)


@pytest.mark.parametrize("name", ["kidnapped", "kidnapped_euroc"])
def test_the_experiments_are_valid(name: str) -> None:
    config = load_experiment(EXPERIMENTS / f"{name}.yaml")
    assert isinstance(config, LocalisationConfig)
    assert config.map.made_from is not None


@pytest.mark.slow
@pytest.mark.usefixtures("open3d")
def test_random_poses_are_found_in_the_lab(tmp_path: Path) -> None:
    """On the first 60 poses: never false, nearly always found."""
    one, three = asked("kidnapped", tmp_path / "run", "dataset.drive.frames=180")
    assert one.numbers["asked"] >= 50
    for judged in (one, three):
        assert judged.numbers["false"] == judged.numbers["too_few_in_view"]["false"] == 0
    assert one.numbers["share_right"] is not None
    assert three.numbers["share_right"] is not None
    assert one.numbers["share_right"] > 0.85
    assert three.numbers["share_right"] > 0.93


@pytest.mark.slow
@pytest.mark.data
def test_odd_frames_of_euroc_are_found_in_the_map_of_the_even_ones(
    shared_data: Path, tmp_path: Path
) -> None:
    """70 % are found, nearly all of them within 10 cm and 2 degrees, none at a wrong place."""
    data = f"{shared_data / 'euroc_v101_kf100'}"
    paths = (f"dataset.path={data}", f"map.made_from.dataset.path={data}")
    (judged,) = asked("kidnapped_euroc", tmp_path / "run", *paths)
    counts = judged.numbers
    assert counts["with_truth"] == counts["asked"] == 50
    assert counts["accepted"] >= 35
    assert counts["false"] == 0
    assert counts["right"] >= 0.97 * counts["accepted"]
    if counts["inexact"]:
        pytest.xfail(
            f"{counts['inexact']} of {counts['accepted']} beyond 10 cm or 2 degrees; wanted: 0"
        )


@pytest.mark.slow
@pytest.mark.data
def test_links_between_single_frames_of_euroc(shared_data: Path) -> None:
    """A twelfth of all pairs. One frame is a poor map: the loop detector needs more than this."""
    links = relocalising.link_frames(shared_data, every=12).surer(0.05, 1.0)
    assert links.linked.sum() > 15
    assert links.precision > 0.8
    assert links.recall > 0.4
