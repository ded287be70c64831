"""fgslam teach and fgslam follow: routes from folders of panoramas and films, and mistakes."""

from __future__ import annotations

import csv
import itertools
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import textured_room
from PIL import Image as PictureFile
from running import main
from textured_room import SMALL_CAMERA_FILE, folder_of, seen_at

import fgslam as fg
from fgslam.core.sensors import CameraRig
from fgslam.core.types import Trajectory, write_covariances
from fgslam.homing.route import PathMemory
from fgslam.runs.bare import teaching
from fgslam.runs.folder import RUN_MARKER
from fgslam.runs.run import run_experiment

Capture = pytest.CaptureFixture[str]
Patch = pytest.MonkeyPatch
EPOCH_S = 1_700_000_000.25


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A taught drive, another one of the same way, and the camera's keys."""
    root = tmp_path_factory.mktemp("routes")
    folder_of(root / "drive", np.arange(0.0, 3.6, 0.4))
    folder_of(root / "again", np.arange(0.2, 3.6, 0.8))
    (root / "camera.yaml").write_text(SMALL_CAMERA_FILE, encoding="utf-8")
    PictureFile.fromarray(np.ascontiguousarray(seen_at(1.8)[:, :200])).save(
        root / "drive" / "view_4a.png"
    )
    times = "".join(f"view_{k}.png {5 + k}\n" for k in range(9)) + "view_4a.png 9.5\n"
    (root / "drive" / "times.txt").write_text(times, encoding="utf-8")
    stamps = "".join(f"view_{k}.png {EPOCH_S + 0.1 * k:.2f}\n" for k in range(5))
    (root / "again" / "times.txt").write_text(stamps, encoding="utf-8")
    # SLAM on the drive: 0.4 m a second along x.
    poses = "".join(f"{5 + 0.5 * k} {0.2 * k} 0 0 0 0 0 1\n" for k in range(17))
    (root / "final.tum").write_text(poses, encoding="utf-8")
    return root


@pytest.fixture(scope="module")
def taught(data: Path) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        route = data / "route.fgpath"
        given = (data / "drive", "--camera", data / "camera.yaml", "--out", route)
        given += ("--poses", data / "final.tum")
        assert main(patch, "teach", *given, "--report", data / "taught") == 0
    return route


def mistake(capfd: Capture, monkeypatch: Patch, *arguments: object) -> str:
    """The one line that a command prints which must fail."""
    capfd.readouterr()
    assert main(monkeypatch, *arguments) == 2
    said = [line for line in capfd.readouterr().err.splitlines() if "moov atom" not in line]
    (line,) = said  # beside what FFmpeg itself prints
    assert line.startswith("fgslam: ")
    return line


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_a_route_is_taught_with_the_reason_of_each_path_image(taught: Path, data: Path) -> None:
    rows = rows_of(data / "taught" / "path_images.csv")
    path = PathMemory.load(taught)
    assert path.camera == textured_room_camera()
    assert len(path) == len(rows) < 9
    other = "view_4a.png is 200x91 but the calibration states 301x91"
    assert other in (data / "taught" / "report.html").read_text(encoding="utf-8")
    assert (rows[0]["reason"], rows[-1]["reason"]) == ("start", "end")
    numbers = json.loads((data / "taught" / "metrics.json").read_text(encoding="utf-8"))
    assert numbers["kilobytes_per_image"] <= 20.0
    assert (data / "taught" / "pictures" / "path_images.png").stat().st_size > 10_000
    assert (data / "taught" / "report.html").is_file()
    assert (data / "taught" / "route.fgpath").read_bytes() == taught.read_bytes()


@pytest.mark.parametrize(("images", "said"), [(0, "There is no route yet."), (3, "path images")])
def test_teaching_that_is_stopped_leaves_the_route_so_far_or_none(
    data: Path, tmp_path: Path, images: int, said: str
) -> None:
    asked = itertools.count()
    config = teaching(data / "drive", str(data / "camera.yaml"), tmp_path / "route.fgpath")
    result = run_experiment(config, tmp_path / "run", stopped=lambda: next(asked) >= images)
    assert result.status == "interrupted"
    assert said in result.lines[0]
    assert (tmp_path / "route.fgpath").exists() == bool(images)
    if images:
        assert len(PathMemory.load(tmp_path / "route.fgpath")) >= 1


def test_a_mirrored_recording_is_told(
    taught: Path, tmp_path: Path, capfd: Capture, monkeypatch: Patch
) -> None:
    (tmp_path / "back").mkdir()
    for k in range(3):
        mirrored = np.ascontiguousarray(seen_at(0.2 + 0.9 * k)[:, ::-1])
        PictureFile.fromarray(mirrored).save(tmp_path / "back" / f"view_{k}.png")
    back = ("follow", taught, tmp_path / "back", "--out", tmp_path / "run")
    assert main(monkeypatch, *back) == 2
    said = " ".join(capfd.readouterr().err.splitlines()[-1:])
    assert said.endswith("as if they were mirrored left to right: mirror them back")


def textured_room_camera() -> object:
    from fgslam.cameras.omni import Equirectangular

    top = float(np.deg2rad(54.0))
    return Equirectangular(301, 91, top, -top)


def test_another_drive_follows_it(
    taught: Path, data: Path, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    """Without a camera given: the route's own."""
    assert main(monkeypatch, "follow", taught, data / "again", "--out", tmp_path / "run") == 0
    said = capfd.readouterr().out.lower()
    assert "the place is known" in said
    assert "whole panoramas?" not in said
    rows = rows_of(tmp_path / "run" / "follow.csv")
    assert len(rows) == 5
    places = [int(row["path_image"]) for row in rows]
    assert places == sorted(places)
    known = [row for row in rows if not row["refusal"]]
    assert len(known) >= 3
    for row in known[:-1]:
        assert abs(float(row["direction_deg"])) < 5.0
        assert float(row["sigma_direction_deg"]) < 5.0
        assert float(row["v_mps"]) > 0.0
    assert all(row["state"] == "wait" for row in rows[:-1] if row["refusal"])
    assert rows[-1]["state"] == "arrived"  # 0.2 m past the end
    metres = [(0.2 + 0.8 * k, row) for k, row in enumerate(rows) if row["x_m"]]
    assert len(metres) >= 2
    for truth, row in metres:
        assert abs(float(row["x_m"]) - truth) < 0.4
        assert 0.0 < float(row["sigma_position_m"]) < 0.4
        assert float(row["to_target_m"]) > 0.0
    again = tmp_path / "again"
    assert main(monkeypatch, "run", tmp_path / "run" / RUN_MARKER, "--out", again) == 0
    assert (again / "follow.csv").read_bytes() == (tmp_path / "run" / "follow.csv").read_bytes()


STEREO = CameraRig(320, 240, 200.0, 200.0, 159.5, 119.5, 0.2, None, np.eye(4))


def stereo_folder(place: Path, metres: np.ndarray, times: np.ndarray) -> Path:
    """The drive as a stereo rig saw it that rode along: left/, right/, calib.json, times.txt."""
    for side in ("left", "right"):
        (place / side).mkdir(parents=True)
    for k, one in enumerate(metres.tolist()):
        seen = textured_room.stereo(np.array([-2.0 + one, 0.4, 0.0]), STEREO)
        for side, image in zip(("right", "left"), seen, strict=True):
            PictureFile.fromarray(image).save(place / side / f"{k:06d}.png")
    names = ("width", "height", "fx", "fy", "cx", "cy")
    calibration = {name: getattr(STEREO, name) for name in names} | {"baseline_m": STEREO.baseline}
    (place / "calib.json").write_text(json.dumps(calibration), encoding="utf-8")
    lines = "".join(f"{k} {t}\n" for k, t in enumerate(times.tolist()))
    (place / "times.txt").write_text(lines, encoding="utf-8")
    return place


@pytest.mark.slow
@pytest.mark.usefixtures("in_this_process")
def test_a_route_of_a_robot_with_stereo_has_the_metres_of_its_own_slam(
    data: Path, tmp_path: Path, monkeypatch: Patch
) -> None:
    """SLAM's world is the right camera's first place: z is ahead, x to the right."""
    metres = np.arange(0.0, 3.3, 0.1)
    drive = stereo_folder(tmp_path / "stereo", metres, 5.0 + metres / 0.4)
    run, route = tmp_path / "slam", tmp_path / "route.fgpath"
    assert main(monkeypatch, "run", drive, "--out", run) == 0
    (poses,) = run.glob("*/final.tum")
    given = ("--camera", data / "camera.yaml", "--poses", poses, "--out", route)
    assert main(monkeypatch, "teach", data / "drive", *given, "--report", tmp_path / "t") == 0
    path = PathMemory.load(route)
    assert path.metric is not None
    truth = np.array([0.4 * int(name[5:].removesuffix(".png")) for name in path.names])
    found = path.metric.poses[:, :3, 3]
    expected = np.column_stack([np.zeros((len(truth), 2)), truth])
    np.testing.assert_allclose(found, expected, rtol=0, atol=0.05)
    sigma = np.sqrt(path.metric.covariances[1:, [3, 4, 5], [3, 4, 5]])
    assert (sigma > 0.0).all()
    assert (sigma < 0.1).all()
    assert main(monkeypatch, "follow", route, data / "again", "--out", tmp_path / "f") == 0
    rows = rows_of(tmp_path / "f" / "follow.csv")
    metric = [(0.2 + 0.8 * k, row) for k, row in enumerate(rows) if row["x_m"]]
    assert len(metric) >= 2
    ahead = {path.names[k]: truth[k] for k in range(len(path))}
    for place, row in metric:
        here = np.array([float(row[name]) for name in ("x_m", "y_m", "z_m")])
        off, sigma_m = here - [0.0, 0.0, place], float(row["sigma_position_m"])
        assert np.abs(off).max() < 0.4
        assert np.linalg.norm(off) < 3.0 * sigma_m
        left = ahead[path.names[int(row["target"])]] - place
        assert abs(float(row["to_target_m"]) - left) < 0.4


@pytest.fixture(scope="module")
def followed(taught: Path, data: Path) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        assert main(patch, "follow", taught, data / "again", "--out", data / "followed") == 0
    return data / "followed"


def shown_in(film: Path) -> list[np.ndarray]:
    frames = cv2.VideoCapture(str(film))
    return [frame.astype(int) for ok, frame in iter(frames.read, (False, None)) if ok]


def test_a_film_shows_image_path_image_and_the_way_home(
    followed: Path, data: Path, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    film, pictured = tmp_path / "way.mp4", tmp_path / "pictured.mp4"
    assert main(monkeypatch, "film", followed, film) == 0
    assert "way.mp4: 5 frames" in capfd.readouterr().out
    frames = shown_in(film)
    assert [frame.shape for frame in frames] == [(720, 1280, 3)] * 5
    rows = rows_of(followed / "follow.csv")
    stamps = [float(row["time_s"]) for row in rows]
    np.testing.assert_allclose(stamps, EPOCH_S + 0.1 * np.arange(5), rtol=0.0, atol=1e-6)
    assert cv2.VideoCapture(str(film)).get(cv2.CAP_PROP_FPS) == pytest.approx(10.0, abs=0.1)
    for frame, row in zip(frames, rows, strict=True):
        blue, green, red = np.moveaxis(frame[360:600, 800:], 2, 0)  # arrow and command
        arrow = ((red > 190) & (np.abs(green - 150) < 40) & (blue < 80)).any()
        assert arrow == bool(row["direction_deg"])
    assert (np.abs(frames[1] - frames[0])[:600, :760].max(axis=2) > 60).any()  # the image
    assert main(monkeypatch, "film", followed, pictured, "--taught", data / "taught") == 0
    panel = np.abs(shown_in(pictured)[0] - frames[0]).max(axis=2) > 60
    assert panel[60:300, 820:].mean() > 0.1  # the path image's picture
    assert panel[:, :760].mean() < 0.01


def test_mistakes_of_a_film_of_a_route(
    taught: Path, followed: Path, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    film = ("film", followed, tmp_path / "way.gif")
    assert "leave out --estimator" in mistake(capfd, monkeypatch, *film, "--estimator", "isam2")
    assert "give its --report" in mistake(capfd, monkeypatch, *film, "--taught", tmp_path)
    said = mistake(capfd, monkeypatch, *film, "--taught", followed)
    assert "task follow is a homing experiment" in said
    config = followed / RUN_MARKER
    kept, route = config.read_text(encoding="utf-8"), tmp_path / "other.fgpath"
    path = PathMemory.load(taught)
    replace(path, names=tuple(f"{name} again" for name in path.names)).save(route)
    config.write_text(kept.replace(str(taught), str(route)), encoding="utf-8")
    try:
        assert "was taught again since it was followed" in mistake(capfd, monkeypatch, *film)
    finally:
        config.write_text(kept, encoding="utf-8")
    assert not (tmp_path / "way.gif").exists()


def test_another_place_is_said(
    taught: Path, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    other = tmp_path / "other"
    other.mkdir()
    rng = np.random.default_rng(0)
    for k in range(2):
        noise = rng.integers(0, 255, (91, 301, 3), np.uint8)
        PictureFile.fromarray(noise).save(other / f"{k}.png")
    PictureFile.fromarray(noise[:, :200]).save(other / "2.png")
    assert main(monkeypatch, "follow", taught, other, "--out", tmp_path / "run") == 1
    said = " ".join(capfd.readouterr().out.split())
    assert "Not one of 2 images is recognised on the route" in said
    assert "2.png is 200x91 but the calibration states 301x91" in said
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "damaged or of another size" in page
    rows = rows_of(tmp_path / "run" / "follow.csv")
    assert [row["name"] for row in rows] == ["0.png", "1.png", "2.png"]
    assert (rows[2]["image"], rows[2]["time_s"], rows[2]["state"]) == ("2", "0.200000000", "")
    assert "2.png is 200x91 but the calibration states 301x91" in rows[2]["refusal"]


def film_of(path: Path, count: int) -> Path:
    """Motion JPEG of panoramas, the first ones of the drive."""
    film = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (301, 91))
    for k in range(count):
        film.write(np.ascontiguousarray(seen_at(0.1 * k)[:, :, ::-1]))
    film.release()
    return path


def test_poses_of_another_clock_or_without_times_are_refused(
    data: Path, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    monkeypatch.chdir(tmp_path)
    given = ("--camera", data / "camera.yaml", "--out", "r.fgpath", "--poses")
    untimed = folder_of(tmp_path / "untimed", np.arange(0.0, 2.0, 0.8))
    said = mistake(capfd, monkeypatch, "teach", untimed, *given, data / "final.tum")
    assert "its images have no times" in said
    late = tmp_path / "late.tum"
    late.write_text("105 0 0 0 0 0 0 1\n106 1 0 0 0 0 0 1\n", encoding="utf-8")
    said = mistake(capfd, monkeypatch, "teach", data / "drive", *given, late)
    assert "from 105.000 to 106.000 s, but drive from 5.000 to 13.000 s" in said
    other = Trajectory(np.arange(2.0), np.tile(np.eye(4), (2, 1, 1)))
    write_covariances(tmp_path / "covariance.csv", other, np.zeros((2, 6, 6)))
    said = mistake(capfd, monkeypatch, "teach", data / "drive", *given, late)
    assert "covariance.csv: not the poses' of late.tum" in said
    assert "no_such.tum" in mistake(
        capfd, monkeypatch, "teach", data / "drive", *given, "no_such.tum"
    )
    assert not (tmp_path / "runs").exists()


def test_a_film_is_a_recording_too(data: Path, tmp_path: Path, monkeypatch: Patch) -> None:
    film, route = film_of(tmp_path / "walk.avi", 3), tmp_path / "r.fgpath"
    monkeypatch.chdir(tmp_path)
    camera = ("--camera", data / "camera.yaml")
    assert main(monkeypatch, "teach", film, *camera, "--out", route) == 0
    assert (tmp_path / "runs" / "teach_walk" / "path_images.csv").is_file()
    assert len(PathMemory.load(route)) in (1, 2)


def test_wrong_inputs_are_one_line_each(
    taught: Path, data: Path, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    monkeypatch.chdir(tmp_path)
    out = ("--out", tmp_path / "r.fgpath")
    drive, camera = data / "drive", ("--camera", data / "camera.yaml")
    said = mistake(capfd, monkeypatch, "teach", drive, *out)
    assert "no camera is given; add --camera FILE" in said
    said = mistake(capfd, monkeypatch, "teach", drive, "--camera", "none.txt", *out)
    assert "there is no file none.txt" in said
    said = mistake(capfd, monkeypatch, "teach", tmp_path / "nowhere", *camera, *out)
    assert "no such film or folder" in said
    (tmp_path / "empty.mp4").write_bytes(b"")
    said = mistake(capfd, monkeypatch, "teach", tmp_path / "empty.mp4", *camera, *out)
    assert "cannot be opened as a video" in said
    none = film_of(tmp_path / "none.avi", 0)
    said = mistake(capfd, monkeypatch, "teach", none, *camera, *out)
    assert "holds no frame" in said or "cannot be opened as a video" in said
    said = mistake(
        capfd, monkeypatch, "teach", drive, *camera, "--out", tmp_path / "no" / "r.fgpath"
    )
    assert "its folder does not exist" in said
    assert not (tmp_path / "runs").exists()


def test_wrong_routes_are_one_line_each(
    taught: Path, data: Path, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    monkeypatch.chdir(tmp_path)
    again, cut = data / "again", tmp_path / "cut.fgpath"
    stored = taught.read_bytes()
    teach = ("teach", again, "--camera", data / "camera.yaml")
    given = (*teach, "--out", taught, "--report", tmp_path / "run")
    assert "is there already" in mistake(capfd, monkeypatch, *given)
    for command in (
        ("join", taught),
        (*teach, "--poses", taught),
        ("route", taught, "--from", "a", "--to", "b"),
    ):
        said = mistake(capfd, monkeypatch, *command, "--out", taught, "--overwrite")
        assert f"cannot write {taught}: it is read; choose another name" in said
    assert taught.read_bytes() == stored
    opencv = tmp_path / "pair.yaml"
    opencv.write_text("%YAML:1.0\n---\nM1: 1\n", encoding="utf-8")
    said = mistake(capfd, monkeypatch, "follow", taught, again, "--camera", opencv)
    assert f"{opencv} is written by OpenCV, of no omnidirectional camera that is read" in said
    said = mistake(capfd, monkeypatch, "follow", taught, data)
    assert "folders in it do (again, drive): give that of the one camera" in said
    said = mistake(capfd, monkeypatch, "follow", data / "camera.yaml", again)
    assert "not a readable path memory" in said
    cut.write_bytes(taught.read_bytes()[:-2000])
    assert "truncated" in mistake(capfd, monkeypatch, "follow", cut, again)
    assert "no such file" in mistake(capfd, monkeypatch, "follow", tmp_path / "none", again)
    small = tmp_path / "small"
    small.mkdir()
    PictureFile.fromarray(np.ascontiguousarray(seen_at(0.0)[::2, ::2])).save(small / "0.png")
    said = mistake(capfd, monkeypatch, "follow", taught, small)
    assert "pictures have 151x46 pixels, but the route was taught with 301x91" in said
    PathMemory.of(PathMemory.load(taught).images).save(tmp_path / "blind.fgpath")
    said = mistake(capfd, monkeypatch, "follow", tmp_path / "blind.fgpath", again)
    assert "holds no camera" in said
    assert not (tmp_path / "runs").exists()


# --------------------------------------------------------------------------------------------
# Routes joined


@pytest.fixture(scope="module")
def crossing(taught: Path, data: Path) -> Path:
    """A route across the one that was taught, of three images."""
    camera = PathMemory.load(taught).camera
    assert camera is not None
    poses = [np.array([0.1, y, 1.571]) for y in (-1.5, 0.2, 1.7)]
    views = [np.ascontiguousarray(textured_room.picture(pose)[::2, ::2]) for pose in poses]
    fg.teach(views, camera).save(data / "across.fgpath")
    return data / "across.fgpath"


@pytest.mark.usefixtures("in_this_process")
def test_routes_are_joined_and_the_way_is_said(
    taught: Path, crossing: Path, data: Path, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    """As the library joins them, to the byte."""
    monkeypatch.chdir(tmp_path)
    assert main(monkeypatch, "join", taught, crossing, "--out", "house.fgmap") == 0
    assert "Every place can be reached" in " ".join(capfd.readouterr().out.split())
    assert (tmp_path / "runs" / "join_house" / "links.csv").is_file()
    joined = fg.RouteMap.join(
        {"route": PathMemory.load(taught), "across": PathMemory.load(crossing)}
    )
    joined.save(tmp_path / "library.fgmap")
    assert Path("library.fgmap").read_bytes() == Path("house.fgmap").read_bytes()

    first = data / "drive" / "view_0.png"
    given = ("--from", first, "--to", "across", "--out", "way.fgpath")
    assert main(monkeypatch, "route", "house.fgmap", *given) == 0
    said = capfd.readouterr().out
    assert f"{first}: at route/view_0" in said
    assert PathMemory.load("way.fgpath").names[-1] == "across/2"
    ends = ("--from", "across/0", "--to", "route")
    assert main(monkeypatch, "route", "house.fgmap", *ends) == 0
    assert "degrees" in capfd.readouterr().out

    said = mistake(capfd, monkeypatch, "route", "house.fgmap", "--from", "x", "--to", "route")
    assert "x: neither a picture nor a place of the map" in said
    PictureFile.fromarray(np.full((91, 301, 3), 90, np.uint8)).save("grey.png")
    said = mistake(
        capfd, monkeypatch, "route", "house.fgmap", "--from", "grey.png", "--to", "route"
    )
    assert "grey.png: " in said
    said = mistake(capfd, monkeypatch, "route", taught, *ends)
    assert "not an fgslam topological map; give a file that holds one" in said


def test_routes_that_cannot_be_joined_are_one_line_each(
    taught: Path, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    monkeypatch.chdir(tmp_path)
    said = mistake(capfd, monkeypatch, "join", taught, taught, "--out", "x.fgmap")
    assert "two files are called route" in said
    said = mistake(capfd, monkeypatch, "join", taught, "--out", "no/x.fgmap")
    assert "its folder does not exist" in said
    assert "no such file" in mistake(capfd, monkeypatch, "join", "none", "--out", "x.fgmap")
    assert not Path("runs").exists()
