"""Readers of panoramas, mirror images and mirror video: what they give, and every refusal."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from fgslam.cameras.omni import (
    Equirectangular,
    HyperbolicMirror,
    LensCamera,
    RadialPolynomial,
    angles_of,
)
from fgslam.cameras.omni_files import make_camera
from fgslam.cameras.settings import (
    BloggieSettings,
    EquirectangularSettings,
    HyperbolicMirrorSettings,
    OCamCalibSettings,
    RadialPolynomialSettings,
)
from fgslam.core.arrays import Image
from fgslam.core.errors import CalibrationError, DatasetError, FrameError
from fgslam.datasets.omni import OmniRecording, PanoramaReduction, ids_of
from fgslam.datasets.opening import open_omni
from fgslam.datasets.settings import OmniPathSettings, OmniVideoSettings, PanoramasSettings
from fgslam.datasets.video import VideoFrames

HEADER = "id,file,x_m,y_m,heading_deg,room\n"
ROWS = "3,b.png,1.5,-2,270,kitchen\n12,a.png,0,0.25,-90.5,hall\n"
BLOGGIE = (
    "INPUT_FILENAME, input.mp4\nINPUT_WIDTH, 64\nINPUT_HEIGHT, 48\nOPTICAL_CENTER_X, 0.5\n"
    "OPTICAL_CENTER_Y, 0.5\nMAX_R_PERCENT, 0.97\nMIN_R_PERCENT, 0.22\nANGLE_SHIFT, 90.0\n"
)


def picture(seed: int, width: int = 64, height: int = 32) -> Image:
    return np.random.default_rng(seed).integers(0, 255, (height, width, 3), dtype=np.uint8)


def write(path: Path, rgb: Image) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """Two panoramas with poses."""
    write(tmp_path / "panos" / "a.png", picture(0))
    write(tmp_path / "panos" / "b.png", picture(1))
    write(tmp_path / "floor_plan.png", picture(2, 10, 10))
    (tmp_path / "poses.csv").write_text(HEADER + ROWS, encoding="utf-8")
    return tmp_path


def panoramas(folder: Path, **settings: object) -> OmniRecording:
    return open_omni(PanoramasSettings(path=str(folder), **settings))  # type: ignore[arg-type]


# --------------------------------------------------------------------------------------------
# Panoramas


def test_panoramas_with_poses(home: Path) -> None:
    recording = panoramas(home)
    assert len(recording) == 2
    assert recording.ids.tolist() == [3, 12]
    assert recording.names == ("b.png", "a.png")
    assert recording.rooms == ("kitchen", "hall")
    assert recording.poses is not None
    np.testing.assert_allclose(
        recording.poses, [[1.5, -2, -np.pi / 2], [0, 0.25, np.radians(-90.5)]], atol=1e-12
    )
    np.testing.assert_array_equal(recording.image(0), picture(1))
    np.testing.assert_array_equal(recording.image(1), picture(0))
    assert recording.camera == Equirectangular(64, 32)
    assert np.isnan(recording.timestamps).all()
    chosen = panoramas(home, start=1)
    assert chosen.names == ("a.png",)
    np.testing.assert_array_equal(chosen.image(0), picture(0))
    assert chosen.identity == recording.identity
    with pytest.raises(IndexError, match="expected 0 to 0"):
        chosen.image(1)


def test_panoramas_without_poses_come_in_walking_order(tmp_path: Path) -> None:
    for number in (10, 9, 100):
        write(tmp_path / f"wp_{number}.png", picture(number))
    recording = panoramas(tmp_path)
    assert recording.ids.tolist() == [9, 10, 100]
    assert recording.poses is None
    assert recording.rooms is None
    np.testing.assert_array_equal(recording.image(1), picture(10))


def test_ids_of_names() -> None:
    assert ids_of(["floor_01_pano_14", "floor_01_pano_2"]).tolist() == [14, 2]
    assert ids_of(["a_1", "b_1"]).tolist() == [0, 1]
    assert ids_of(["left", "right"]).tolist() == [0, 1]


def test_pictures_that_no_row_names_are_noted(home: Path) -> None:
    write(home / "panos" / "c.png", picture(3))
    assert panoramas(home).notes == ("1 pictures of panos/ are not in poses.csv",)


def test_reduction_moves_nothing() -> None:
    """A pattern of low frequency is the same function of bearing and elevation at any size."""

    def drawn(camera: Equirectangular) -> Image:
        grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
        bearing, elevation = angles_of(camera.rays(grid.reshape(-1, 2).astype(np.float64)))
        levels = np.stack(
            [
                128 + 100 * np.cos(3 * bearing),
                128 + 100 * np.sin(2 * bearing),
                128 + 90 * np.sin(2 * elevation),
            ],
            axis=-1,
        )
        return np.rint(levels).astype(np.uint8).reshape(camera.height, camera.width, 3)

    small = PanoramaReduction((512, 256), (200, 100))(drawn(Equirectangular(512, 256)))
    expected = drawn(Equirectangular(200, 100))
    assert small.shape == expected.shape
    difference = small.astype(float) - expected
    assert np.abs(difference[1:-1]).max() <= 2.0
    # Plain resizing is wrong by half a pixel at the seam: 9 levels here, with opposite signs.
    plain = cv2.resize(drawn(Equirectangular(512, 256)), (200, 100), interpolation=cv2.INTER_AREA)
    assert np.abs(plain.astype(float) - expected)[1:-1, [0, -1], 1].min() > 1.5


def test_reduced_panoramas(home: Path) -> None:
    write(home / "panos" / "a.png", picture(0, 256, 128))
    write(home / "panos" / "b.png", picture(1, 256, 128))
    recording = panoramas(home, width=128)
    assert recording.camera == Equirectangular(128, 64)
    image = recording.image(0)
    assert image.shape == (64, 128, 3)
    assert image.dtype == np.uint8
    assert image.mean() == pytest.approx(picture(1, 256, 128).mean(), abs=0.6)
    with pytest.raises(DatasetError, match=r"width is 512 but the panoramas .* only 256"):
        panoramas(home, width=512)


@pytest.mark.parametrize(
    ("content", "reported"),
    [
        ("", "line 1: no column id, file"),
        ("id,file,x_m,y_m\n1,a.png,0,0\n", "no column heading_deg"),
        (HEADER + "3,b.png,nan,0,0,\n", "line 2: x_m is nan, not finite"),
        (HEADER + "3,b.png,1,zwei,0,\n", "line 2: y_m is 'zwei'"),
        (HEADER + "3,c.png,1,2,3,\n", "line 2: there is no picture c.png"),
        (HEADER + ROWS + "3,a.png,1,2,3,\n", "line 4: id 3 is in line 2 already"),
    ],
)
def test_bad_pose_tables(home: Path, content: str, reported: str) -> None:
    (home / "poses.csv").write_text(content, encoding="utf-8")
    with pytest.raises(DatasetError, match=reported) as caught:
        panoramas(home)
    assert "poses.csv" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_bad_folders_and_pictures(home: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="does not exist"):
        panoramas(home / "nowhere")
    (home / "empty").mkdir()
    with pytest.raises(DatasetError, match="holds no picture"):
        panoramas(home / "empty")
    write(home / "panos" / "a.png", picture(0, 66, 32))
    recording = panoramas(home)
    with pytest.raises(FrameError, match=r"a\.png is 66x32 but the calibration states 64x32"):
        recording.image(1)
    data = (home / "panos" / "b.png").read_bytes()
    (home / "panos" / "b.png").write_bytes(data[: len(data) // 2])
    with pytest.raises(FrameError, match=r"b\.png is truncated"):
        panoramas(home)
    (home / "panos" / "b.png").write_bytes(b"no picture at all")
    with pytest.raises(FrameError, match=r"b\.png is not an image"):
        panoramas(home)


# --------------------------------------------------------------------------------------------
# Mirror images along a path


def test_a_path_of_mirror_images(tmp_path: Path) -> None:
    for number in (1, 2, 11):
        write(tmp_path / f"m{number}.png", picture(number, 64, 48))
    write(tmp_path / "other.png", picture(7, 10, 10))
    camera = HyperbolicMirrorSettings(size=(64, 48))
    recording = open_omni(OmniPathSettings(path=str(tmp_path), pattern="m*", camera=camera))
    assert recording.ids.tolist() == [1, 2, 11]
    assert isinstance(recording.camera, HyperbolicMirror)
    assert recording.camera.outer_radius == 23.5
    np.testing.assert_array_equal(recording.image(2), picture(11, 64, 48))
    with pytest.raises(DatasetError, match=r"no picture named \.\. "):
        open_omni(OmniPathSettings(path=str(tmp_path), pattern="..", camera=camera))
    write(tmp_path / "m2.png", picture(2, 48, 64))
    with pytest.raises(FrameError, match=r"m2\.png is 48x64 but the calibration .* 64x48"):
        recording.image(1)
    with pytest.raises(CalibrationError, match=r"calibrated for 320x240 pixels, but .* 64x48"):
        open_omni(
            OmniPathSettings(
                path=str(tmp_path), pattern="m*", camera=HyperbolicMirrorSettings(size=(320, 240))
            )
        )


# --------------------------------------------------------------------------------------------
# Video


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve frames whose brightness is their number times 20."""
    path = tmp_path_factory.mktemp("film") / "walk.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (64, 48))
    if not writer.isOpened():
        pytest.skip("this OpenCV cannot write MJPG video")
    for k in range(12):
        frame = np.full((48, 64, 3), 20 * k, np.uint8)
        frame[:, :, 0] = 0  # blue in OpenCV's order
        writer.write(frame)
    writer.release()
    (path.parent / "bloggie_settings.txt").write_text(BLOGGIE, encoding="utf-8")
    return path


def test_video_frames_by_number_in_any_order(film: Path) -> None:
    recording = open_omni(OmniVideoSettings(path=str(film), start=1, stride=2))
    assert recording.ids.tolist() == [1, 3, 5, 7, 9, 11]
    np.testing.assert_allclose(recording.timestamps, np.arange(1, 12, 2) / 25.0)
    for i in (0, 1, 4, 2, 5, 0):
        image = recording.image(i)
        level = 20.0 * recording.ids[i]
        np.testing.assert_allclose(image.mean(axis=(0, 1)), [level, level, 0.0], atol=6.0)
    image[:] = 0
    assert recording.image(0).mean() > 10.0  # the reader's own copy is untouched


def test_the_bloggies_file_gives_the_camera(film: Path) -> None:
    """Up is inside; 48 degrees above and 12 below the horizon; the panorama's middle is ahead."""
    camera = open_omni(OmniVideoSettings(path=str(film))).camera
    assert isinstance(camera, RadialPolynomial)
    assert camera.frame.centre == (31.5, 23.5)
    # Half of the height times 0.22 and 0.97.
    assert (camera.inner_radius, camera.outer_radius) == pytest.approx((5.28, 23.28))
    rims = camera.elevation(np.array([camera.inner_radius, camera.outer_radius]))
    np.testing.assert_allclose(np.degrees(rims), [48.0, -12.0], atol=0.5)
    # The tool's first column lies at the angle shift, here downward; its middle half a turn on.
    bearing, _ = angles_of(camera.rays(np.array([[31.5, 10.0], [42.0, 23.5]])))
    np.testing.assert_allclose(np.degrees(bearing), [0.0, 90.0], atol=1e-9)


def test_bad_videos(film: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="does not exist"):
        open_omni(OmniVideoSettings(path=str(tmp_path / "absent.mp4")))
    (tmp_path / "text.mp4").write_text("no video", encoding="utf-8")
    with pytest.raises(DatasetError, match="cannot be opened as a video"):
        open_omni(OmniVideoSettings(path=str(tmp_path / "text.mp4")))
    with pytest.raises(DatasetError, match=r"start is 50 but .* frames 0 to 11"):
        open_omni(OmniVideoSettings(path=str(film), start=50))
    (tmp_path / "film.avi").write_bytes(film.read_bytes())
    (tmp_path / "half.avi").write_bytes(film.read_bytes()[: film.stat().st_size // 2])
    with pytest.raises(DatasetError, match="cannot be opened as a video"):
        open_omni(OmniVideoSettings(path=str(tmp_path / "half.avi")))
    # What a container that promises more frames than it holds leads to.
    frames = VideoFrames(film)
    frames.load(3)
    with pytest.raises(FrameError, match=r"walk\.avi ends after 12 frames, frame 15"):
        frames.load(15)
    with pytest.raises(CalibrationError, match=r"there is no calibration bloggie_settings\.txt"):
        open_omni(OmniVideoSettings(path=str(tmp_path / "film.avi")))


# --------------------------------------------------------------------------------------------
# Cameras by their settings


def test_cameras_by_kind(tmp_path: Path) -> None:
    flat = make_camera(EquirectangularSettings(top_elevation_deg=30.0), (100, 50))
    assert flat == Equirectangular(100, 50, float(np.radians(30.0)), float(np.radians(-90.0)))
    default = make_camera(HyperbolicMirrorSettings(), (320, 240))
    expected = HyperbolicMirror.with_view((320, 240), 0.92, (np.radians(-65), np.radians(25)))
    assert isinstance(default, HyperbolicMirror)
    assert default.focal_px == pytest.approx(expected.focal_px)
    assert default.inner_radius == pytest.approx(expected.inner_radius)
    rim = float(60.0 * np.cos(np.radians(25)) / (0.92 - np.sin(np.radians(25))))
    given = make_camera(
        HyperbolicMirrorSettings(
            centre=(150.0, 110.0), focal_px=60.0, ring_px=(0.0, rim), ahead_deg=0.0
        ),
        (320, 240),
    )
    assert isinstance(given, HyperbolicMirror)
    assert (given.focal_px, given.inner_radius) == (60.0, 0.0)
    limit = given.elevation(np.array([given.outer_radius]))
    np.testing.assert_allclose(np.degrees(limit), 25.0, atol=1e-9)
    line = make_camera(
        RadialPolynomialSettings(ring_px=(20.0, 100.0), coefficients_deg=(-10.0, 40.0)), (320, 240)
    )
    assert isinstance(line, RadialPolynomial)
    np.testing.assert_allclose(np.degrees(line.elevation(np.array([20.0, 100.0]))), [-50, 30])


def test_a_calibration_file_is_looked_for_beside_the_pictures(tmp_path: Path) -> None:
    # Elevation -45 degrees at 100 px and 0 at 200: f = (rho^2 - 200^2) / 300.
    direct = "3 -133.333333333 0 0.0033333333333"
    angle = np.arctan2((np.linspace(60, 140, 200) ** 2 - 4e4) / 300.0, np.linspace(60, 140, 200))
    inverse = np.polynomial.polynomial.polyfit(angle, np.linspace(60, 140, 200), 8)
    (tmp_path / "my.txt").write_text(
        f"{direct}\n9 {' '.join(map(str, inverse))}\n149 199\n1 0 0\n300 400\n"
        "#ROI max min radius\n140 60\n",
        encoding="utf-8",
    )
    camera = make_camera(OCamCalibSettings(file="my.txt"), (400, 300), tmp_path)
    assert isinstance(camera, LensCamera)
    _, elevation = angles_of(camera.rays(np.array([[299.0, 149.0]])))
    np.testing.assert_allclose(np.degrees(elevation), -45.0, atol=1e-6)
    narrow = make_camera(
        OCamCalibSettings(file="my.txt", ring_px=(70.0, 99.0)), (400, 300), tmp_path
    )
    assert isinstance(narrow, LensCamera)
    assert narrow.ring == (70.0, 99.0)
    with pytest.raises(CalibrationError, match=r"no calibration other\.txt, nor "):
        make_camera(OCamCalibSettings(file="other.txt"), (400, 300), tmp_path)
    with pytest.raises(CalibrationError, match="400x300, but the picture has 640x480"):
        make_camera(OCamCalibSettings(file="my.txt"), (640, 480), tmp_path)


@pytest.mark.parametrize(
    ("content", "reported"),
    [
        (BLOGGIE.replace("INPUT_WIDTH, 64\n", ""), "lacks INPUT_WIDTH"),
        (BLOGGIE.replace("0.97", "much"), "line 6: MAX_R_PERCENT is 'much'"),
        (BLOGGIE.replace("0.97", "0.2"), "radii from 5.28 to 4.8"),
        (BLOGGIE.replace("OPTICAL_CENTER_X, 0.5", "OPTICAL_CENTER_X, 5"), "lies outside"),
    ],
)
def test_bad_bloggie_files(tmp_path: Path, content: str, reported: str) -> None:
    (tmp_path / "bloggie_settings.txt").write_text(content, encoding="utf-8")
    with pytest.raises(CalibrationError, match=reported):
        make_camera(BloggieSettings(), (64, 48), tmp_path)


@pytest.mark.parametrize(
    ("make", "reported"),
    [
        (lambda: HyperbolicMirrorSettings(outer_elevation_deg=80.0), "below arcsin"),
        (lambda: HyperbolicMirrorSettings(inner_elevation_deg=30.0), "must rise"),
        (lambda: HyperbolicMirrorSettings(centre=(900.0, 10.0)), "lies outside"),
        (lambda: RadialPolynomialSettings(size=(32, 32)), "calibrated for 32x32 pixels"),
        (lambda: RadialPolynomialSettings(coefficients_deg=(0.0, 1.0, 9.0)), "turns back"),
    ],
)
def test_impossible_settings(make: Callable[[], HyperbolicMirrorSettings], reported: str) -> None:
    with pytest.raises(CalibrationError, match=reported):
        make_camera(make(), (320, 240))
