"""The small recording that the integration tests run, made once."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from recordings import experiment, write_recording
from running import Finished, run_values, units_in_this_process


@pytest.fixture(scope="module", autouse=True)  # of a session it would last into other folders
def _coarse_pictures() -> Iterator[None]:
    """What pictures look like is tested elsewhere; here coarse ones, drawn faster."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fgslam.report.pictures.DPI", 50)
        yield


@pytest.fixture
def in_this_process() -> Iterator[None]:
    """Replays, pairs and drives in this process: one of its own imports everything for seconds."""
    with units_in_this_process():
        yield


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve trinocular frames; read only."""
    return write_recording(tmp_path_factory.mktemp("recordings") / "boards")


@pytest.fixture
def own_recording(recording: Path, tmp_path: Path) -> Path:
    """A copy of the recording to spoil."""
    return Path(shutil.copytree(recording, tmp_path / "recording"))


@pytest.fixture(scope="session")
def finished(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """An uninterrupted run of the recording, without pictures; read only."""
    return run_values(experiment(recording), tmp_path_factory.mktemp("runs") / "finished")
