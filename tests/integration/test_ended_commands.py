"""Ctrl-C and SIGTERM at any moment end the commands that are no runs of SLAM, too."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from recordings import experiment
from running import HANGS_AFTER_S, main, run_values
from test_resume_run import write_config
from textured_room import SMALL_CAMERA_FILE, folder_of

from fgslam.runs.config import make_experiment
from fgslam.runs.run import run_experiment

pytestmark = pytest.mark.slow

WITHIN_S = 2.0
MOMENTS = 4
LONGEST_S = 12.0  # of what is waited for before the last moment; a demo drives for a minute


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory, recording: Path) -> Path:
    """What the commands are given."""
    root = tmp_path_factory.mktemp("commands")
    folder_of(root / "drive", np.arange(0.0, 3.6, 0.2))
    folder_of(root / "again", np.arange(0.1, 3.6, 0.2))
    (root / "camera.yaml").write_text(SMALL_CAMERA_FILE, encoding="utf-8")
    for name in ("drive", "again"):
        given = (root / name, "--camera", root / "camera.yaml", "--out", root / f"{name}.fgpath")
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(root)
            assert main(patch, "teach", *given) == 0
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        routes = (root / "drive.fgpath", root / "again.fgpath")
        assert main(patch, "join", *routes, "--out", root / "house.fgmap") == 0
    for k in range(2):
        values = experiment(recording, seed=k) | {"map": {"save": str(root / f"{k}.fgmap")}}
        run_values(values, root / f"run{k}")
    write_config(root / "drive.yaml", experiment(recording))
    (root / "recording").symlink_to(recording)
    run_experiment(make_experiment(HOMINGS, "test"), root / "homings")
    boards(root / "boards")
    return root


HOMINGS: dict[str, Any] = {
    "task": "homing_trials",
    "name": "few_homings",
    "jobs": 1,
    "trials": 2,
    "outliers": [0.0],
    "estimator": {"kind": "homing_ekf"},
    "dataset": {"images_per_s": 4.0},
    "output": {"logs": 2},
}


def boards(folder: Path) -> None:
    """A chessboard before two cameras, from 24 sides."""
    folder.mkdir()
    squares = np.indices((6, 8)).sum(axis=0) % 2
    board = np.pad(np.kron(squares, np.ones((40, 40))), 40, constant_values=1.0) * 255.0
    rng, flat = np.random.default_rng(2), np.array([[0, 0], [400, 0], [400, 320], [0, 320]])
    for k in range(24):
        seen = flat + np.array([120, 80]) + rng.uniform(-40.0, 40.0, (4, 2))
        for name, shift in (("left", 25.0), ("right", 0.0)):
            there = (seen + np.array([shift, 0.0])).astype(np.float32)
            to = cv2.getPerspectiveTransform(flat.astype(np.float32), there)
            image = cv2.warpPerspective(board.astype(np.uint8), to, (640, 480), borderValue=90)
            cv2.imwrite(str(folder / f"{name}{k}.png"), image)


COMMANDS = {
    "teach": "teach {}/drive --camera {}/camera.yaml --out route.fgpath --report taught",
    "follow": "follow {}/drive.fgpath {}/again --out followed",
    "join": "join {}/drive.fgpath {}/again.fgpath --out house.fgmap --report joined",
    "route": "route {}/house.fgmap --from drive/0 --to again --out way.fgpath",
    "calibrate": "calibrate stereo {}/boards --board 7x5 --square 0.03 --out camera.json",
    "film": "film {}/run0 film.mp4",
    "sweep": "sweep {}/drive.yaml --set seed=0:40 --jobs 2 --out swept",
    "merge": "merge {}/0.fgmap {}/1.fgmap --out both.fgmap",
    "demo": "demo --out demo",
    "compare": "compare {}/run0 {}/run1 --estimators isam2,batch,ekf --jobs 2 --out compared",
    "compare-homing": "compare {}/homings --estimators homing_graph,graph_batch --out compared",
    "localize": "localize {}/0.fgmap {}/recording --out located",
    "inspect": "inspect {}/recording",
    "export": "export {}/run0 --map map.ply --trajectory t.mcap --graph run.g2o --images colmap",
}


def start(command: str, place: Path, folder: Path) -> subprocess.Popen[str]:
    words = [sys.executable, "-m", "fgslam", *command.replace("{}", str(place)).split()]
    return subprocess.Popen(  # noqa: S603
        words,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        cwd=folder,
        start_new_session=True,
    )


def nobody_left(group: int) -> bool:
    with suppress(ProcessLookupError):
        os.killpg(group, 0)
        return False
    return True


def allowed_s() -> float:
    """More where others wait for a processor as well."""
    return WITHIN_S * float(np.clip(os.getloadavg()[0] / (os.cpu_count() or 1), 1.0, 3.0))


@pytest.mark.parametrize("name", COMMANDS)
def test_at_any_moment_it_ends_within_two_seconds_and_leaves_no_process(
    name: str, place: Path, tmp_path: Path
) -> None:
    begun = time.monotonic()
    with start(COMMANDS[name], place, tmp_path) as process:
        with suppress(subprocess.TimeoutExpired):
            process.communicate(timeout=LONGEST_S)
        takes = time.monotonic() - begun
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        os.killpg(process.pid, signal.SIGKILL) if process.poll() is None else None
    rng = np.random.default_rng(len(name))
    for k, moment in enumerate(rng.uniform(0.3, max(takes, 0.4), MOMENTS).tolist()):
        folder = tmp_path / str(k)
        folder.mkdir()
        number = (signal.SIGINT, signal.SIGTERM)[k % 2]
        with start(COMMANDS[name], place, folder) as process:
            with suppress(subprocess.TimeoutExpired):
                process.communicate(timeout=moment)
            ended_before = process.poll() is not None
            asked = time.monotonic()
            if not ended_before:
                os.killpg(process.pid, number)
            _, said = process.communicate(timeout=HANGS_AFTER_S)
            took = time.monotonic() - asked
        assert "Traceback" not in said, said
        if not ended_before:
            # Negative: before the first line of the program, or after its last one.
            assert process.returncode in (128 + number, -number, 0), (moment, said)
            assert took < allowed_s(), f"{took:.1f} s after signal {number} at {moment:.1f} s"
        left = time.monotonic() + allowed_s()
        while not nobody_left(process.pid):
            assert time.monotonic() < left, f"a process is left, {moment:.1f} s, {number}"
            time.sleep(0.05)
