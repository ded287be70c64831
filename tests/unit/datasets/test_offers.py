"""Recordings to try: written as folders that open again, the public ones named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from fgslam.cli.main import app
from fgslam.core.errors import ConfigError, OutputError
from fgslam.datasets import offers
from fgslam.datasets.offers import OFFERS, write_recording
from fgslam.datasets.opening import open_recording
from fgslam.datasets.rendered import RenderedLabSequence
from fgslam.datasets.settings import ImageFolderSettings
from fgslam.runs.named_experiments import experiment_names, experiments_of_recordings
from fgslam.worlds.settings import RenderedLabSettings


def quiet(what: str, done: int, total: int) -> None:
    """No progress."""


def test_the_lab_is_written_as_a_folder_that_opens_with_wheels_and_truth(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = RenderedLabSequence(RenderedLabSettings(), 0, stop=4)
    monkeypatch.setattr(offers, "lab_sequence", lambda: source)
    assert write_recording("lab", tmp_path / "lab", quiet) == f"fgslam run {tmp_path / 'lab'}"
    found = open_recording(ImageFolderSettings(path=str(tmp_path / "lab")))
    assert len(found) == len(source) == 4
    for name in ("width", "height", "fx", "fy", "cx", "cy", "baseline", "vertical_baseline"):
        assert getattr(found.rig, name) == getattr(source.rig, name)
    np.testing.assert_array_equal(found.rig.bTc, source.rig.bTc)
    np.testing.assert_allclose(found.timestamps, source.timestamps, atol=1e-9)
    assert source.ground_truth is not None
    assert found.ground_truth is not None
    np.testing.assert_allclose(found.ground_truth.poses, source.ground_truth.poses, atol=1e-6)
    for i in range(len(found)):
        for read, made in zip(found.frame(i).images, source.frame(i).images, strict=True):
            np.testing.assert_array_equal(read, made)
    for i in range(1, len(found)):
        written, wheels = found.odometry(i), source.odometry(i)
        assert written is not None
        assert wheels is not None
        np.testing.assert_allclose(written.motion, wheels.motion, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "error", "advice"),
    [("labs", ConfigError, "there are lab, house"), ("euroc", ConfigError, "then type fgslam run")],
)
def test_what_is_not_made_here_is_refused_with_what_to_do(
    name: str, error: type[Exception], advice: str, tmp_path: Path
) -> None:
    with pytest.raises(error, match=advice):
        write_recording(name, tmp_path / "new", quiet)
    assert not (tmp_path / "new").exists()


def test_a_folder_with_something_in_it_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(OutputError, match="already"):
        write_recording("lab", tmp_path, quiet)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_the_list_fits_a_terminal_and_names_what_to_type() -> None:
    told = CliRunner().invoke(app, ["data"])
    assert told.exit_code == 0
    assert max(map(len, told.output.splitlines())) <= 96
    for name, offer in OFFERS.items():
        assert f"{name}: {offer.what}" in told.output
        command = f"$ fgslam data {name}" if offer.write else f"$ {offer.command}"
        assert command in told.output


def test_experiments_whose_recordings_do_not_come_with_fgslam_are_known() -> None:
    needing = experiments_of_recordings()
    assert {"kitti06", "euroc_v101", "starry_night", "mirror_video"} <= set(needing)
    assert not {"lab_loop", "goedeme_2005", "lab_laps", "kitti00_tracks"} & set(needing)
    assert set(needing) < set(experiment_names())
