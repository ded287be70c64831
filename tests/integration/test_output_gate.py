"""Every command that writes a file where it is told to: what is there is not lost."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from recordings import experiment
from running import Capture, Finished, Patch, main, write_config

BOARD = ("--board", "6x4", "--square", "0.05")
NEEDED = {
    "run --camera-out": ("run", "{recording}", "--out", "run", "--camera-out"),
    "run --map-out": ("run", "{recording}", "--out", "run", "--map-out"),
    "run --save-rrd": ("run", "{recording}", "--out", "run", "--save-rrd"),
    "export --map": ("export", "{run}", "--map"),
    "export --trajectory": ("export", "{run}", "--trajectory"),
    "export --graph": ("export", "{run}", "--graph"),
    "film": ("film", "{run}"),
    "view": ("view", "{run}", "--save"),
    "merge": ("merge", "a.fgmap", "b.fgmap", "--out"),
    "teach": ("teach", "{recording}", "--camera", "equirectangular", "--report", "run", "--out"),
    "join": ("join", "a.fgpath", "--report", "run", "--out"),
    "route": ("route", "a.fgmap", "--from", "a", "--to", "b", "--out"),
    "calibrate stereo": ("calibrate", "stereo", "{recording}", *BOARD, "--out"),
    "calibrate omni": ("calibrate", "omni", "{recording}", *BOARD, "--out"),
    "calibrate rings": (
        *("calibrate", "rings", "image.png", "--elevations=-15,15", "--inner", "9", "--out"),
    ),
    "camera show": ("camera", "show", "{recording}/calib.json", "--out"),
    "camera convert": ("camera", "convert", "{recording}/calib.json"),
}
ENDINGS = {"run --save-rrd": ".rrd", "view": ".rrd", "film": ".mp4", "export --graph": ".g2o"}


def refused(capfd: Capture, monkeypatch: Patch, *arguments: object) -> str:
    """The line of a command that must fail; `run` says first what the recording is."""
    assert main(monkeypatch, *arguments) == 2
    (line,) = capfd.readouterr().err.splitlines()
    return line


@pytest.mark.parametrize("which", NEEDED)
def test_a_file_that_is_there_is_kept_and_a_link_is_never_followed(
    which: str,
    recording: Path,
    finished: Finished,
    tmp_path: Path,
    monkeypatch: Patch,
    capfd: Capture,
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("a.fgmap", "b.fgmap", "a.fgpath", "image.png"):
        Path(name).write_text("an input")
    places = {"recording": str(recording), "run": str(finished.folder)}
    given = [word.format(**places) for word in NEEDED[which]]
    path = Path(f"there{ENDINGS.get(which, '.json')}")
    path.write_text("kept")
    said = refused(capfd, monkeypatch, *given, path)
    assert f"{path}: is there already; choose another name, or add --overwrite" in said
    link = path.with_stem("link")
    link.symlink_to(path)
    said = refused(capfd, monkeypatch, *given, link, "--overwrite")
    assert f"cannot write {link}: it is a link; choose another name" in said
    assert path.read_text() == "kept"
    assert not Path("run").exists()


def test_a_recording_keeps_its_calibration(
    own_recording: Path, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    monkeypatch.chdir(tmp_path)
    own = own_recording / "calib.json"
    before = own.read_bytes()
    other = Path(shutil.copy(own, tmp_path / "other.json"))
    config = write_config(tmp_path / "drive.yaml", experiment(own_recording))
    for source, path, why in (
        (own_recording, own, f"it is part of {own_recording}, which is read"),
        (config, own, f"it is part of {own_recording}, which is read"),
        (config, config, "it is read"),
        (own_recording, other, "it is read"),
    ):
        camera = ("--camera", other) if path is other else ()
        given = ("run", source, *camera, "--out", "run", "--camera-out", path, "--overwrite")
        assert f"cannot write {path}: {why}" in refused(capfd, monkeypatch, *given)
    assert own.read_bytes() == before == other.read_bytes()


def test_images_go_into_a_folder_of_their_own(
    finished: Finished, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    model = tmp_path / "model"
    (model / "images").mkdir(parents=True)
    given = ("export", finished.folder, "--images", model)
    assert f"{model}: is there already" in refused(capfd, monkeypatch, *given)
    assert main(monkeypatch, *given, "--overwrite") == 0
    assert (model / "sparse" / "0" / "images.txt").is_file()
