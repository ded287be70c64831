"""The small recording that the integration tests run, made once."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from recordings import experiment, write_recording
from running import Finished, run_values


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
