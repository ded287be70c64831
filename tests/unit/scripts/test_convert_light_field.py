from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from dataset_builders import save

from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import CalibrationError, DatasetError, FgslamError, FrameError
from fgslam.core.geometry import transform_to_camera
from fgslam.core.log import ImageSequence
from fgslam.datasets.opening import open_recording
from fgslam.datasets.recording import Recording
from fgslam.datasets.settings import ImageFolderSettings
from scripts.convert.light_field import convert, shift_image

WIDTH, HEIGHT, COLUMNS = 120, 90, 9
FOCAL, PITCH, FOCAL_DEPTH = 100.0, 0.005, 0.6
# Points (x, y, z) in metres before the camera at column 0, row 0; the last one lies far behind
# the focal plane, where the recording's own disparities are negative.
POINTS = np.array([[0.05, 0.02, 0.3], [-0.05, -0.06, 0.5], [0.2, 0.25, 0.9]])


def view_of(place: FloatArray) -> Image:
    """Blobs where a camera moved in its image plane by ``place`` (x right, y down) sees them."""
    y, x = np.indices((HEIGHT, WIDTH))
    image = np.zeros((HEIGHT, WIDTH))
    for point in POINTS:
        inverse_depth = 1.0 / point[2] - 1.0 / FOCAL_DEPTH
        column = 59.5 + FOCAL * (point[0] / point[2] - place[0] * inverse_depth)
        row = 44.5 + FOCAL * (point[1] / point[2] - place[1] * inverse_depth)
        image += 240.0 * np.exp(-((x - column) ** 2 + (y - row) ** 2) / (2 * 1.5**2))
    return np.round(np.clip(image, 0, 255)).astype(np.uint8)


@pytest.fixture
def grid(tmp_path: Path) -> Path:
    """Views at jittered places; u grows with the column, v falls with the row (upwards), in mm."""
    rng = np.random.default_rng(4)
    lines = ["# file,row,col,v,u"]
    for row in range(0, 16, 4):
        for column in range(COLUMNS):
            jitter = rng.normal(0.0, 0.1e-3, 2) if column else np.zeros(2)
            place = np.array([PITCH * column, -PITCH * row]) + jitter
            name = f"r{row:02d}_c{column:02d}.png"
            save(tmp_path / name, view_of(place))
            lines.append(f"{name},{row},{column},{1e3 * place[1]:.9f},{1e3 * place[0]:.9f}")
    (tmp_path / "positions.csv").write_text("\n".join(lines), encoding="utf-8")
    calibration = {"width": WIDTH, "height": HEIGHT}
    (tmp_path / "calib.json").write_text(json.dumps(calibration), encoding="utf-8")
    return tmp_path


def converted(root: Path) -> Recording:
    """The grid as an image folder, opened."""
    convert(root, root / "converted")
    return open_recording(ImageFolderSettings(path=str(root / "converted")))


def centre(image: Image, near: FloatArray) -> FloatArray:
    """Centre of the blob near a pixel, by weights, iterated."""
    weight = image.astype(np.float64)
    y, x = np.indices(image.shape)
    at = np.array(near, np.float64)
    for _ in range(20):
        w = weight * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2 * 2.5**2))
        at = np.array([(w * x).sum(), (w * y).sum()]) / w.sum()
    return at


def expected_in_first_frame(grid: Path, recording: Recording, k: int) -> FloatArray:
    """(column, row, disparity) of a point in frame 0, from the scene the views were drawn of."""
    rows = np.loadtxt(grid / "positions.csv", delimiter=",", usecols=(1, 2, 3, 4), skiprows=1)
    _, _, v, u = rows[(rows[:, 0] == 8) & (rows[:, 1] == 4)][0]
    x, y, z = POINTS[k]
    inverse_depth = 1.0 / z - 1.0 / FOCAL_DEPTH
    column = 59.5 + FOCAL * (x / z - 1e-3 * u * inverse_depth)
    row = 44.5 + FOCAL * (y / z - 1e-3 * v * inverse_depth)
    disparity = FOCAL * recording.rig.baseline * inverse_depth + 4.0
    return np.array([column, row, disparity])


def test_frames_are_a_rigid_trinocular_walk(grid: Path) -> None:
    """One rigid set of points explains all views of all frames, with the true poses."""
    recording = converted(grid)
    assert isinstance(recording, ImageSequence)
    assert len(recording) == COLUMNS - 4
    rig, truth = recording.rig, recording.ground_truth
    assert truth is not None
    assert rig.vertical_baseline is not None
    first = recording.frame(0).images
    points = []
    for k in range(len(POINTS)):
        at = expected_in_first_frame(grid, recording, k)
        c, r = centre(first[0], at[:2])
        d = centre(first[1], at[:2] + np.array([at[2], 0.0]))[0] - c
        depth = rig.fx * rig.baseline / d
        points.append([(c - rig.cx) * depth / rig.fx, (r - rig.cy) * depth / rig.fy, depth])
    for i in range(len(recording)):
        images = recording.frame(i).images
        expected = rig.predict(transform_to_camera(truth.poses[i], np.array(points)))
        for c, r, d in expected:
            assert d > 0.5
            vertical = d * rig.vertical_baseline / rig.baseline
            for image, place in zip(images, ([c, r], [c + d, r], [c, r + vertical]), strict=True):
                np.testing.assert_allclose(centre(image, np.array(place)), place, atol=0.15)


def test_rig_and_truth_follow_the_positions(grid: Path) -> None:
    recording = converted(grid)
    rows = np.loadtxt(grid / "positions.csv", delimiter=",", usecols=(1, 2, 3, 4), skiprows=1)
    place = {(int(r), int(c)): np.array([u, v]) for r, c, v, u in rows}
    columns = np.arange(4, COLUMNS)
    along = np.mean([place[8, c][0] - place[8, c - 4][0] for c in columns])
    up = np.mean([place[8, c][1] - place[12, c][1] for c in columns])
    assert recording.rig.baseline == pytest.approx(1e-3 * along)
    assert recording.rig.vertical_baseline == pytest.approx(1e-3 * up)
    truth = recording.ground_truth
    assert truth is not None
    expected = 1e-3 * np.array([place[8, c] - place[8, 4] for c in columns])
    np.testing.assert_allclose(truth.poses[:, :2, 3], expected, atol=1e-12)
    np.testing.assert_array_equal(truth.poses[:, :3, :3], np.tile(np.eye(3), (5, 1, 1)))


def test_whole_pixels_are_shifted_without_loss() -> None:
    image = np.random.default_rng(1).integers(0, 255, (20, 30), dtype=np.uint8)
    moved = shift_image(image, np.array([3.0, -2.0]))
    np.testing.assert_array_equal(moved[:-2, 3:], image[2:, :-3])
    np.testing.assert_array_equal(moved[:-2, 0], image[2:, 0])


def test_fractional_shift_of_a_smooth_image() -> None:
    x = np.arange(60)
    row = 128.0 + 100.0 * np.sin(2 * np.pi * x / 12.0)
    moved = shift_image(np.round(np.tile(row, (20, 1))).astype(np.uint8), np.array([0.25, 0.0]))
    expected = 128.0 + 100.0 * np.sin(2 * np.pi * (x - 0.25) / 12.0)
    np.testing.assert_allclose(moved[10, 8:-8], expected[8:-8], atol=1.5)


def test_a_missing_or_wrong_view_is_refused(grid: Path) -> None:
    (grid / "r08_c06.png").unlink()
    with pytest.raises(FrameError, match=r"r08_c06\.png cannot be read"):
        convert(grid, grid / "converted")
    save(grid / "r08_c06.png", np.zeros((9, 12), np.uint8))
    with pytest.raises(
        FrameError, match=r"r08_c06\.png is 12x9 but the calibration states 120x90; restore"
    ):
        convert(grid, grid / "converted")


def written(name: str, content: str) -> Callable[[Path], object]:
    return lambda root: (root / name).write_text(content, encoding="utf-8")


BAD: list[tuple[Callable[[Path], object], type[FgslamError], list[str]]] = [
    (written("positions.csv", "a,1,2\n"), DatasetError, ["line 1", "file, row, column"]),
    (written("positions.csv", "a,1,2,nan,3\n"), DatasetError, ["line 1", "correct"]),
    (written("positions.csv", "a,5,4,0,0\n"), DatasetError, ["row 8", "top neighbours", "[5]"]),
    (written("calib.json", '{"width": 0, "height": 4}'), CalibrationError, ["width is 0"]),
    (written("calib.json", '{"width": 4}'), CalibrationError, ["no 'height'", "add it"]),
]


@pytest.mark.parametrize(("spoil", "error", "words"), BAD)
def test_bad_input_is_refused_in_one_line(
    grid: Path, spoil: Callable[[Path], object], error: type[FgslamError], words: list[str]
) -> None:
    spoil(grid)
    with pytest.raises(error) as raised:
        convert(grid, grid / "converted")
    assert type(raised.value) is error
    assert "\n" not in str(raised.value)
    for part in words:
        assert part in str(raised.value)


def test_gantry_that_runs_the_other_way_is_refused(grid: Path) -> None:
    lines = (grid / "positions.csv").read_text().splitlines()
    mirrored = [line.rsplit(",", 1) for line in lines[1:]]
    (grid / "positions.csv").write_text("\n".join(f"{a},{-float(u)}" for a, u in mirrored))
    with pytest.raises(DatasetError, match="u must grow with the column"):
        convert(grid, grid / "converted")
