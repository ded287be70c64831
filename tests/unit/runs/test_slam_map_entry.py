"""The rig's memory that a run is given: where it lies, and what is left alone."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from recordings import experiment, write_recording

from fgslam.core.errors import CalibrationError, ConfigError, OutputError
from fgslam.runs.config import ExperimentConfig, make_config
from fgslam.runs.opening import open_sequence
from fgslam.runs.tasks.slam_map_entry import GivenMemory, open_memory
from fgslam.slam.rig_memory import DriveEvidence, RigMemory


def remembering(root: Path, where: str = "auto") -> ExperimentConfig:
    return make_config(experiment(root) | {"rig_memory": where}, "test")


def opened(config: ExperimentConfig) -> GivenMemory:
    found = open_memory(config, open_sequence(config), None)
    assert found is not None
    return found


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_recording(tmp_path / "boards", frames=3)


def test_a_memory_lies_next_to_the_calibration_and_leaves_the_own_frames_out(root: Path) -> None:
    config = remembering(root)
    new = opened(config)
    assert new.path.parent == root
    assert not new.fault
    assert not new.notes(None)
    sequence = open_sequence(config)
    size = 3
    frames = (np.array([17]), np.array([sequence.frame(2).digest()]))
    drives = tuple(DriveEvidence(f, np.eye(size), np.ones(size)) for f in frames)
    RigMemory(new.known.calibration, drives).save(new.path)
    later = opened(config)
    assert [one.frames.tolist() for one in later.known.drives] == [[17]]
    assert later.notes(None) == (
        f"the calibration begins as 1 earlier drive found it ({new.path}); --rig-memory off leaves "
        "that out",
    )


def test_experiments_and_rigs_that_are_taken_as_calibrated_have_none(root: Path) -> None:
    config = remembering(root, "off")
    assert make_config(experiment(root), "test").rig_memory == "off"
    assert open_memory(config, open_sequence(config), None) is None
    stated = make_config(
        experiment(root) | {"rig_memory": "auto", "frontend": {"self_calibration": False}}, "test"
    )
    assert open_memory(stated, open_sequence(stated), None) is None


@pytest.mark.parametrize("foreign", [b"mine", b""])
def test_a_file_that_is_none_is_left_as_it_is(root: Path, foreign: bytes) -> None:
    config = remembering(root)
    path = opened(config).path
    path.write_bytes(foreign)
    found = opened(config)
    assert str(path) in found.fault
    assert len(found.notes(None)) == 1
    assert path.read_bytes() == foreign
    with pytest.raises(CalibrationError, match=r"move (it|this one) away"):
        opened(remembering(root, str(path)))


def test_a_folder_that_is_read_only_is_named_once(root: Path) -> None:
    root.chmod(0o555)
    try:
        found = opened(remembering(root))
    finally:
        root.chmod(0o755)
    assert "--rig-memory FILE keeps it elsewhere" in found.fault or "permission" in found.fault
    assert len(found.notes(None)) == 1


def test_a_named_file_must_be_one_that_can_be_written(root: Path, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="its folder does not exist"):
        opened(remembering(root, str(tmp_path / "no" / "memory.npz")))
    (tmp_path / "memory.npz").symlink_to(tmp_path / "elsewhere.npz")
    with pytest.raises(OutputError, match="a link"):
        opened(remembering(root, str(tmp_path / "memory.npz")))


def test_next_to_a_calibration_without_a_file_nothing_can_lie(root: Path) -> None:
    config = remembering(root)
    sequence = SimpleNamespace(rig=open_sequence(config).rig)
    lab = config.model_copy(update={"dataset": SimpleNamespace()})
    with pytest.raises(ConfigError, match="give a file, or off"):
        open_memory(lab, sequence, None)


def test_a_drive_whose_cameras_have_moved_since_says_so(root: Path) -> None:
    found = GivenMemory(root / "memory.npz", RigMemory(""))
    calibration = SimpleNamespace(moved_before=True)
    assert "have moved since" in found.notes(calibration)[0]
