"""`fgslam run --save-rrd`: the file is read back, and the run's results stay the same bytes."""

from __future__ import annotations

import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import experiment
from running import Capture, Finished, Patch, bytes_of, main, mistake, write_config

from fgslam.core.types import Trajectory

chunks: Any = pytest.importorskip("rerun.chunk", reason="the extra `viewer` is not installed")

WORLD = "/world/first_camera"


def recorded(file: Path) -> dict[str, list[dict[str, Any]]]:
    """Rows of each entity in the order of their frames, by the components' short names."""
    rows: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for chunk in chunks.RrdReader(file).stream():
        for row in chunk.to_record_batch().to_pylist():
            rows[str(chunk.entity_path)].append(
                {name.rpartition(":")[2]: value for name, value in row.items()}
            )
    return {name: sorted(found, key=frame_of) for name, found in rows.items()}


def frame_of(row: dict[str, Any]) -> int:
    return int(row.get("frame") or 0)


@pytest.fixture(scope="module")
def shown(
    finished: Finished, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, dict[str, list[dict[str, Any]]]]:
    """The run folder of a watched run, and what its file holds."""
    folder = tmp_path_factory.mktemp("watched")
    config = write_config(folder / "boards.yaml", finished.values)
    with pytest.MonkeyPatch.context() as patch:
        given = ("run", config, "--out", folder / "run", "--save-rrd", folder / "run.rrd")
        assert main(patch, *given) == 0
    assert {path.name for path in folder.iterdir()} == {"boards.yaml", "run", "run.rrd"}
    return folder / "run", recorded(folder / "run.rrd")


Shown = tuple[Path, dict[str, list[dict[str, Any]]]]


def test_a_watched_run_gives_the_same_bytes(shown: Shown, finished: Finished) -> None:
    assert bytes_of(shown[0]) == bytes_of(finished.folder)


def test_path_and_camera_are_the_online_poses(shown: Shown, finished: Finished) -> None:
    folder, rows = shown
    online = Trajectory.load(folder / "landmark_kalman" / "online.tum").poses[:, :3, 3]
    placed = [r for r in rows[f"{WORLD}/camera"] if r.get("translation")]
    np.testing.assert_allclose([r["translation"][0] for r in placed], online, rtol=0, atol=1e-6)
    (line,) = rows[f"{WORLD}/path/0000"][-1]["strips"]
    np.testing.assert_allclose(line, online, rtol=0, atol=1e-6)
    (truth,) = rows[f"{WORLD}/truth"][0]["strips"]
    assert len(truth) == len(online)
    assert np.abs(np.array(truth) - online).max() < 0.01


def test_images_matches_status_and_numbers_are_there_for_each_frame(
    shown: Shown, finished: Finished
) -> None:
    _, rows = shown
    for camera in ("right", "left", "top"):
        assert len([r for r in rows[f"/cameras/{camera}"] if r.get("blob")]) == 12
        assert len(rows[f"/cameras/{camera}/seen"]) == 12
    for k, (row, increment) in enumerate(
        zip(rows["/cameras/right/seen"], finished.result.outputs.recorder.log, strict=True)
    ):
        assert len(row["positions"]) == len(increment.observations), k
    assert len(rows["/cameras/right/ways"][5]["strips"]) > 50
    said = [row["text"][0] for row in rows["/status"]]
    assert said[0].startswith("frame 0 first: 0 of 0 matches agree")
    assert all(line.startswith(f"frame {k} ok: ") for k, line in enumerate(said[1:], start=1))
    assert {row["level"][0] for row in rows["/status"]} == {"INFO"}
    matched = [row["scalars"][0] for row in rows["/numbers/matched"] if row.get("scalars")]
    assert matched == finished.result.outputs.recorder.column("inliers").tolist()


def test_landmarks_and_ellipsoids_are_those_of_the_estimator(
    shown: Shown, finished: Finished
) -> None:
    _, rows = shown
    blocks = [found for name, found in rows.items() if name.startswith(f"{WORLD}/landmarks/")]
    last = np.concatenate([found[-1]["positions"] for found in blocks if found[-1]["positions"]])
    landmarks = finished.result.outputs.pipeline.estimator.landmarks()
    assert len(last) == len(landmarks)
    np.testing.assert_allclose(last, landmarks.positions, rtol=0, atol=1.1e-3)
    final = rows[f"{WORLD}/landmarks_three_sigma"][-1]
    (*_, increment) = finished.result.outputs.recorder.log
    seen = landmarks.select(np.isin(landmarks.ids, increment.kept.ids))
    largest = 3.0 * np.sqrt(np.linalg.eigvalsh(seen.covariances)[:, -1])
    found = np.max(final["half_sizes"], axis=1)
    np.testing.assert_allclose(found, np.maximum(largest, 1e-4), rtol=1e-5)


def test_what_cannot_be_watched_is_refused_in_a_line(
    recording: Path, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    config = write_config(tmp_path / "boards.yaml", experiment(recording))
    run = ("run", config, "--out", tmp_path / "run")
    wrong_name = mistake(capfd, monkeypatch, *run, "--save-rrd", tmp_path / "run.txt")
    assert wrong_name.endswith("the viewer opens .rrd files; use that ending")
    no_folder = mistake(capfd, monkeypatch, *run, "--save-rrd", tmp_path / "no" / "run.rrd")
    assert no_folder.endswith("its folder does not exist; choose another folder")
    other_task = mistake(capfd, monkeypatch, "run", "homing_lab", "--save-rrd", "run.rrd")
    assert "show SLAM on images, and this is another task" in other_task
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    no_screen = mistake(capfd, monkeypatch, *run, "--live")
    assert no_screen.endswith("there is none; use --save-rrd FILE.rrd")
    monkeypatch.setitem(sys.modules, "rerun", None)
    missing = mistake(capfd, monkeypatch, *run, "--live")
    assert missing.endswith("install it: pip install 'fgslam[viewer]'")
    assert not (tmp_path / "run").exists()
