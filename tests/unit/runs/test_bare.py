"""A recording without a configuration: what is recognised, said, and refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from dataset_builders import (
    EUROC_SIZE,
    curve,
    euroc,
    image_folder,
    kitti,
    picture,
    save,
    sensor_yaml,
    write_calibration,
    write_tum,
)

from fgslam.backend.settings import SlidingWindowSettings
from fgslam.core.errors import CalibrationError, ConfigError, DatasetError
from fgslam.core.geometry import pose
from fgslam.datasets.layouts import recognise_layout
from fgslam.datasets.settings import ConstantVelocitySettings, RecordedOdometrySettings
from fgslam.runs.bare import bare_experiment, experiment_of, short_config
from fgslam.runs.config import ExperimentConfig, make_config
from fgslam.runs.opening import open_sequence

AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
MOUNTINGS = (pose(AHEAD, np.zeros(3)), pose(AHEAD, np.array([0.0, -0.1, 0.0])))


# --------------------------------------------------------------------------------------------
# What it becomes


def test_a_recording_without_odometry_runs_by_constant_velocity(tmp_path: Path) -> None:
    found = bare_experiment(image_folder(tmp_path / "walk"))
    assert found.config == ExperimentConfig(
        name="walk",
        dataset=found.config.dataset,
        odometry=ConstantVelocitySettings(),
        estimator=SlidingWindowSettings(),
    )
    assert found.description.startswith(
        "walk: image folder, 2 cameras 32x24; 6 frames at 10 Hz; no odom"
    )
    assert "truth" not in found.description


def test_recorded_odometry_is_used_and_truth_only_mentioned(tmp_path: Path) -> None:
    root = image_folder(tmp_path / "walk")
    write_tum(root / "odometry.txt", 0.1 * np.arange(6.0), curve(6))
    without_truth = bare_experiment(root).config
    write_tum(root / "gt_right_cam.txt", 0.1 * np.arange(6.0), curve(6))
    found = bare_experiment(root)
    assert found.config.odometry == RecordedOdometrySettings()
    assert found.config == without_truth
    assert "; odometry; truth, for evaluation only; estimator " in found.description


def test_every_layout_is_named_in_the_line(tmp_path: Path) -> None:
    drive, _ = kitti(tmp_path / "car", 3, "06")
    flight = euroc(tmp_path / "drone", MOUNTINGS)
    assert (
        "KITTI 06: KITTI odometry, 2 cameras 32x24; 3 frames" in bare_experiment(drive).description
    )
    drone = "drone: EuRoC native, 2 cameras 64x48, unrectified; 4 frames at 20"
    assert drone in bare_experiment(flight).description


def test_the_printed_configuration_keeps_what_was_asked_for(tmp_path: Path) -> None:
    asked = ["dataset.stop=3", "estimator.kind=batch", "frontend.sift.max_features=900"]
    text = short_config(image_folder(tmp_path), None, asked)
    assert (
        make_config(yaml.safe_load(text), "printed")
        == bare_experiment(tmp_path, None, asked).config
    )


def test_a_configuration_of_that_name_goes_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    image_folder(tmp_path / "lab_loop")
    shipped, said = experiment_of(Path("lab_loop"))
    own, told = experiment_of(Path("./lab_loop").absolute())
    assert (shipped.dataset.kind, said) == ("rendered_lab", "")
    assert (own.dataset.kind, told[:9]) == ("image_folder", "lab_loop:")


# --------------------------------------------------------------------------------------------
# Calibration from elsewhere


def test_a_calibration_file_takes_the_place_of_the_folders_own(tmp_path: Path) -> None:
    root = image_folder(tmp_path / "walk")
    (root / "calib.json").rename(tmp_path / "mine.json")
    found = bare_experiment(root, tmp_path / "mine.json")
    assert open_sequence(found.config).rig.baseline == 0.2
    assert found.values["dataset"]["camera_file"] == str(tmp_path / "mine.json")


def test_images_of_a_raw_rig_are_rectified_by_its_calibration(tmp_path: Path) -> None:
    root = image_folder(tmp_path / "walk")
    for k in range(6):
        for name in ("left", "right"):
            save(root / name / f"{k:06d}.png", picture(k, *EUROC_SIZE))
    (root / "calib.json").unlink()
    for camera, bTc in zip(("cam0", "cam1"), MOUNTINGS, strict=True):
        folder = tmp_path / "rig" / camera
        folder.mkdir(parents=True)
        (folder / "sensor.yaml").write_text(yaml.safe_dump(sensor_yaml(bTc)), encoding="utf-8")
    sequence = open_sequence(bare_experiment(root, tmp_path / "rig").config)
    right, _ = sequence.frame(0).images
    assert (sequence.rig.width, sequence.rig.height) == EUROC_SIZE
    assert sequence.rig.baseline == pytest.approx(0.1, abs=1e-6)
    assert not np.array_equal(right, picture(0, *EUROC_SIZE))


def test_a_calibration_is_for_recordings_that_need_one(tmp_path: Path) -> None:
    drive, _ = kitti(tmp_path / "car", 3, "06")
    with pytest.raises(ConfigError, match="holds its own calibration; leave --camera out"):
        bare_experiment(drive, tmp_path / "calib.json")
    with pytest.raises(ConfigError, match=r"in an experiment it is dataset\.camera_file"):
        experiment_of(Path("kitti06"), tmp_path / "calib.json")
    with pytest.raises(DatasetError, match="no such calibration file"):
        bare_experiment(image_folder(tmp_path / "walk"), tmp_path / "absent.json")


def test_a_third_camera_needs_a_calibration_of_three(tmp_path: Path) -> None:
    root = image_folder(tmp_path / "walk", top=True)
    write_calibration(tmp_path)
    with pytest.raises(CalibrationError, match=r"knows two cameras, but .* has a third one"):
        bare_experiment(root, tmp_path / "calib.json")


# --------------------------------------------------------------------------------------------
# Bad input: one clear line


def refused(folder: Path, *overrides: str) -> str:
    with pytest.raises((DatasetError, CalibrationError, ConfigError)) as caught:
        bare_experiment(folder, None, overrides)
    text = str(caught.value)
    assert "\n" not in text
    return text


def test_two_layouts_that_fit_equally_are_both_named_and_one_can_be_chosen(tmp_path: Path) -> None:
    root = euroc(image_folder(tmp_path / "both"), MOUNTINGS)
    line = refused(root)
    assert "fits several layouts equally well: image folder; EuRoC native; say which" in line
    assert bare_experiment(root, None, ["dataset.kind=euroc"]).config.dataset.kind == "euroc"
    assert bare_experiment(root, None, ["dataset.kind=image_folder"]).description.startswith(
        "both: image"
    )
    assert "is no layout of a folder of images" in refused(root, "dataset.kind=rendered_lab")


def test_two_layouts_that_are_begun_say_what_each_lacks(tmp_path: Path) -> None:
    (tmp_path / "left").mkdir()
    (tmp_path / "mav0" / "cam0").mkdir(parents=True)
    line = refused(tmp_path)
    assert "image folder (lacks right, calib.json, times.txt); EuRoC native (lacks mav0/c" in line


def test_a_complete_layout_wins_over_parts_of_another(tmp_path: Path) -> None:
    root = image_folder(tmp_path)
    (root / "mav0").mkdir()
    assert recognise_layout(root)["kind"] == "image_folder"


def test_an_empty_folder(tmp_path: Path) -> None:
    assert "is empty; give the folder of a recording" in refused(tmp_path)


def test_a_missing_calibration(tmp_path: Path) -> None:
    root = image_folder(tmp_path)
    (root / "calib.json").unlink()
    line = refused(root)
    assert f"{root / 'calib.json'}" in line
    assert "give a calibration: " in line
    assert "by --camera FILE" in line


def test_images_that_are_not_rectified(tmp_path: Path) -> None:
    root = image_folder(tmp_path)
    write_calibration(root, rectified=False)
    line = refused(root)
    assert "states that the images are not rectified; rectify them first" in line
    assert "or give the raw cameras' calibration by --camera FILE" in line
