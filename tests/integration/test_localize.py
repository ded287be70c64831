"""`fgslam localize` and the task `localisation` on a small recording, and a user's mistakes."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from recordings import experiment, write_calibration
from running import main, run_values

from fgslam.core.errors import ConfigError
from fgslam.runs.config import LocalisationConfig, load_experiment, make_experiment
from fgslam.runs.engine import run_task
from fgslam.runs.tasks.localisation import open_localisation


@pytest.fixture(scope="module")
def map_file(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of the even frames; read only."""
    folder = tmp_path_factory.mktemp("maps")
    dataset = {"kind": "image_folder", "path": str(recording), "stride": 2}
    values = experiment(recording, dataset=dataset, map={"save": str(folder / "boards.fgmap")})
    run_values(values, folder / "run")
    return folder / "boards.fgmap"


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "localisation.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def values_of(recording: Path, map_file: Path, **changes: Any) -> dict[str, Any]:
    return {
        "task": "localisation",
        "name": "boards",
        "map": {"load": str(map_file)},
        "dataset": {"kind": "image_folder", "path": str(recording), "start": 1, "stride": 2},
        "output": {"pictures": False, "report": False},
    } | changes


def test_one_frame_is_reported_in_full(
    monkeypatch: pytest.MonkeyPatch,
    recording: Path,
    map_file: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(monkeypatch, "localize", map_file, recording, "--frame", 5) == 0
    reported = dict(
        line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines() if " " in line
    )
    assert reported["frame"].strip() == "5, from 1 frame"
    assert reported["verdict"].strip() == "found"
    assert float(reported["error"].split()[0]) < 1.0  # centimetres
    assert {"position", "sigma", "candidates", "inliers", "residual", "why"} <= set(reported)


def test_every_frame_with_files_that_repeat_the_run(
    monkeypatch: pytest.MonkeyPatch, recording: Path, map_file: Path, tmp_path: Path
) -> None:
    out = tmp_path / "found"
    four = ("--start", 2, "--stop", 6)
    assert main(monkeypatch, "localize", map_file, recording, *four, "--out", out) == 0
    rows = rows_of(out)
    assert [int(row["frame"]) for row in rows] == [2, 3, 4, 5]
    assert all(row["verdict"] == "found" and float(row["error_m"]) < 0.02 for row in rows)
    assert (out / "pictures" / "localisation_1.png").stat().st_size > 10_000
    assert "Found from 1 frame" in (out / "report.html").read_text(encoding="utf-8")
    metrics = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
    assert metrics["queries"]["1"]["accepted"] == 4
    assert "SE3 over 6 poses" in metrics["alignment"]
    again = tmp_path / "again"
    config = load_experiment(out / "config.yaml", ["output.report=false"])
    assert isinstance(config, LocalisationConfig)
    run_task(open_localisation, config, again)
    assert (again / "localisation.csv").read_bytes() == (out / "localisation.csv").read_bytes()


def test_a_submap_is_located_at_its_last_frame(recording: Path, map_file: Path) -> None:
    values = values_of(recording, map_file, localisation={"frames": [1, 3], "every": 2})
    config = make_experiment(values, "test")
    result = run_task(open_localisation, config, map_file.parent / "submaps")
    one, three = result.asked.of(1), result.asked.of(3)
    assert [a.frame for a in one] == [a.frame for a in three] == [5, 9]
    rows = rows_of(map_file.parent / "submaps")
    assert all(row["verdict"] == "found" and float(row["error_m"]) < 0.01 for row in rows)
    for single, submap in zip(one, three, strict=True):
        assert submap.features > single.features
        assert submap.found is not None
        assert single.found is not None
        assert len(submap.found.ids) >= len(single.found.ids)


def test_nothing_to_see_is_refused_not_an_error(
    monkeypatch: pytest.MonkeyPatch,
    own_recording: Path,
    map_file: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for path in own_recording.glob("*/000003.png"):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        cv2.imwrite(str(path), np.full_like(image, 90))
    for path in own_recording.glob("*/000004.png"):
        path.write_bytes(b"no image")
    three = ("--set", "dataset.start=3", "--set", "dataset.stop=6")
    assert main(monkeypatch, "localize", map_file, own_recording, *three) == 3
    lines = capsys.readouterr().out.splitlines()
    assert "too_few_matches" in lines[0]
    assert "only 0 features look like a landmark" in lines[0]
    assert "no_image" in lines[1]
    assert "found" in lines[2]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--frame", 99), "--frame 99: "),
        (("--frame", 12, "--frames", 3), "ends with frame 11; choose a smaller one"),
        (("--frame", 1, "--frames", 3), "--frame 1: too few frames before it"),
        (("--frame", 3, "--stride", 2), "--frame 3: not among the frames selected"),
        (("--frames", 13), "12 frames are selected, and a query takes 13"),
        (("--set", "localisation.fame=3"), "unknown key localisation.fame"),
    ],
)
def test_wrong_frames_are_reported(
    options: tuple[object, ...],
    words: str,
    monkeypatch: pytest.MonkeyPatch,
    recording: Path,
    map_file: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(monkeypatch, "localize", map_file, recording, *options) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line


def test_wrong_maps_and_recordings_are_reported(
    monkeypatch: pytest.MonkeyPatch,
    own_recording: Path,
    map_file: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def line(*arguments: object) -> str:
        assert main(monkeypatch, "localize", *arguments) == 2
        (reported,) = capsys.readouterr().err.splitlines()
        return reported

    assert "no such file" in line(tmp_path / "none.fgmap", own_recording)
    foreign = tmp_path / "foreign.fgmap"
    foreign.write_text("no map", encoding="utf-8")
    assert "not a readable map" in line(foreign, own_recording)
    assert str(tmp_path / "nowhere") in line(map_file, tmp_path / "nowhere")
    homing = tmp_path / "homing.yaml"
    homing.write_text(yaml.safe_dump({"task": "homing", "name": "h"}), encoding="utf-8")
    assert "is a homing experiment" in line(map_file, homing)
    measured = tmp_path / "measured.yaml"
    values = {"name": "m", "dataset": {"kind": "simulated_measurements"}}
    measured.write_text(yaml.safe_dump(values), encoding="utf-8")
    assert "measurements have no appearance" in line(map_file, measured)
    camera = ("--camera", own_recording / "calib.json")
    assert "it is dataset.camera_file" in line(map_file, measured, *camera)
    (tmp_path / "wider").mkdir()
    write_calibration(tmp_path / "wider", baseline_m=0.2)
    wider = ("--camera", tmp_path / "wider" / "calib.json")
    assert "another rig (baseline 0.1" in line(map_file, own_recording, *wider)


def test_a_map_that_is_made_first_and_one_that_is_there_answer_alike(
    recording: Path, map_file: Path, tmp_path: Path
) -> None:
    dataset = {"kind": "image_folder", "path": str(recording), "stride": 2}
    given = values_of(recording, map_file, frontend={"matching": {"widen_sigmas": 3.0}})
    given["localisation"] = {"every": 3}
    made = given | {"map": {"made_from": {"dataset": dataset}}}
    rows = []
    for name, values in (("given", given), ("made", made)):
        result = run_task(open_localisation, make_experiment(values, "test"), tmp_path / name)
        assert result.status == "finished"
        rows.append(rows_of(tmp_path / name))
    assert (tmp_path / "made" / "first" / "map.fgmap").is_file()
    assert rows[0] == rows[1]
    assert len(rows[0]) == 2


def test_stopping_leaves_valid_files(recording: Path, map_file: Path, tmp_path: Path) -> None:
    asked = iter((False, True))
    config = make_experiment(values_of(recording, map_file), "test")
    result = run_task(open_localisation, config, tmp_path / "run", stopped=lambda: next(asked))
    assert result.status == "interrupted"
    assert len(rows_of(tmp_path / "run")) == 2


def test_a_map_is_needed_and_only_one(recording: Path, map_file: Path) -> None:
    values = values_of(recording, map_file)
    for wrong in ({}, {"load": "a", "made_from": {"dataset": values["dataset"]}}):
        with pytest.raises(ConfigError, match="map needs either load or made_from"):
            make_experiment(values | {"map": wrong}, "test")
