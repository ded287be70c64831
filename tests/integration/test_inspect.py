"""`fgslam inspect` on small recordings that are sound, or spoilt in one known way."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable
from inspect import signature
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest

from fgslam.cli import main as cli
from fgslam.core.arrays import Image
from fgslam.core.errors import CalibrationError, ConfigError, DatasetError
from fgslam.runs.inspect import inspect_recording

WIDTH, HEIGHT, FRAMES = 240, 180, 6
FAR, NEAR = 6, 15  # disparities of the back wall and of the board before it, pixels
STEP = 9  # pixels that the view moves a frame
Change = Callable[[Image], Image]


def canvas(seed: int) -> Image:
    """Smooth noise on several scales, with contrast enough for SIFT."""
    rng = np.random.default_rng(seed)
    shape = (HEIGHT + 60, WIDTH + 60 + FRAMES * STEP)
    octaves = [cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), s) * s for s in (1.2, 2.5, 5.0)]
    total = np.sum(octaves, axis=0)
    return np.clip(128.0 + 45.0 * total / total.std(), 0, 255).astype(np.uint8)


WALL, BOARD = canvas(1), canvas(2)


def view(frame: int, columns: float, rows: float) -> Image:
    """The wall and a board before it; nearer content moves by ``columns`` and ``rows`` of NEAR."""

    def crop(source: Image, disparity: int) -> Image:
        x = 30 + frame * STEP - round(columns * disparity)
        y = 30 - round(rows * disparity)
        return source[y : y + HEIGHT, x : x + WIDTH]

    image = crop(WALL, FAR).copy()
    x, y = 80 + round(columns * NEAR), 50 + round(rows * NEAR)
    image[y : y + 80, x : x + 90] = crop(BOARD, NEAR)[y : y + 80, x : x + 90]
    return image


def same(image: Image) -> Image:
    return image


def write(
    root: Path,
    directions: dict[str, tuple[float, float]],
    changes: dict[str, Change] | None = None,
    baseline: float = 0.1,
) -> Path:
    """An image folder; each camera sees disparities along its (columns, rows) direction."""
    for name, (columns, rows) in directions.items():
        (root / name).mkdir(parents=True)
        change = (changes or {}).get(name, same)
        for k in range(FRAMES):
            cv2.imwrite(str(root / name / f"{k:06d}.png"), change(view(k, columns, rows)))
    values = {"width": WIDTH, "height": HEIGHT, "fx": 200.0, "fy": 200.0, "cx": 119.5, "cy": 89.5}
    values["baseline_m"] = baseline
    if "top" in directions:
        values["vertical_baseline_m"] = 0.1
    (root / "calib.json").write_text(json.dumps(values), encoding="utf-8")
    stamps = "".join(f"{k:06d} {0.5 * k:.3f}\n" for k in range(FRAMES))
    (root / "times.txt").write_text(stamps, encoding="utf-8")
    return root


PAIR = {"right": (0.0, 0.0), "left": (1.0, 0.0)}
TRIPLE = {**PAIR, "top": (0.0, 1.0)}


def flat(report: str) -> str:
    """The report with its line breaks and columns undone."""
    return " ".join(report.split())


def inspected(root: Path, *overrides: str) -> str:
    return flat(inspect_recording(root, overrides, 4))


def numbers(pattern: str, report: str) -> list[float]:
    found = re.search(pattern, report)
    assert found is not None, report
    return [float(text) for text in found.groups()]


# --------------------------------------------------------------------------------------------
# Sound recordings


def test_sound_pair_is_measured_and_found_sound(tmp_path: Path) -> None:
    report = inspected(write(tmp_path / "sound", PAIR))
    assert "frames 6 over 2.5 s rate 2 Hz cameras 2, 240x180" in report
    assert "focal length 200 x 200 px, view 62 x 48 deg" in report
    assert f"dataset.kind image_folder, dataset.path {tmp_path / 'sound'}" in report
    assert "images read 6 of 6 (100 %) frames frames matched 4: 0, 2, 3, 5" in report
    right, left = numbers(r"SIFT features right (\d+) .*?, left (\d+) ", report)
    assert min(right, left) > 100
    assert numbers(r"right-left matches (\d+) ", report)[0] > 80
    low, high = numbers(r"disparity ([\d.]+) to ([\d.]+) px", report)
    assert low == pytest.approx(FAR, abs=0.2)
    assert high == pytest.approx(NEAR, abs=0.2)
    nearest, farthest = numbers(r"depth ([\d.]+) to ([\d.]+) m", report)
    assert nearest == pytest.approx(200 * 0.1 / NEAR, rel=0.02)
    assert farthest == pytest.approx(200 * 0.1 / FAR, rel=0.03)
    assert "odometry none recorded; set odometry.kind" in report
    assert "ground truth none, so no accuracy can be computed" in report
    assert "PROBLEM" not in report
    assert "WARNING" not in report
    assert report.endswith("No problem found.")


def test_sound_triple_agrees_in_depth(tmp_path: Path) -> None:
    report = inspected(write(tmp_path, TRIPLE))
    assert report.endswith("No problem found.")
    assert numbers(r"three-camera matches (\d+) ", report)[0] > 60
    assert "columns of" in report
    features, difference = numbers(r"both disparities of (\d+) features differ by ([\d.]+)", report)
    assert features > 200
    assert difference < 0.2


def test_number_of_frames_is_respected(tmp_path: Path) -> None:
    root = write(tmp_path, PAIR)
    reported: list[tuple[str, int, int]] = []
    report = inspect_recording(root, (), 2, lambda *now: reported.append(now))
    assert "frames matched 2: 0, 5" in flat(report)
    assert [now for now in reported if now[0] == "matching"] == [
        ("matching", 1, 2),
        ("matching", 2, 2),
    ]
    assert reported.count(("reading", 6, 6)) == 1


def test_overrides_select_frames_and_cameras(tmp_path: Path) -> None:
    root = write(tmp_path, TRIPLE)
    (root / "top").rename(root / "third")
    report = inspected(root, "dataset.stop=4")
    assert "frames 4 over 1.5 s" in report
    assert "cameras 2, 240x180" in report
    assert "three-camera" not in report


# --------------------------------------------------------------------------------------------
# Cameras


def test_swapped_cameras_are_reported_first(tmp_path: Path) -> None:
    report = inspect_recording(write(tmp_path, {"right": (1.0, 0.0), "left": (0.0, 0.0)}), (), 4)
    findings = [line for line in report.splitlines() if line.startswith(("PROBLEM", "WARNING"))]
    assert findings[0].startswith("PROBLEM  epipolar: cameras look swapped: ")
    assert "swap left and right" in flat(report)
    assert "depth unknown: too few matches" in flat(report)
    # What only follows from the swap is not reported again.
    assert len(findings) == 1
    assert report.splitlines()[-1].startswith("1 problem:")


def test_shifted_rows_are_reported(tmp_path: Path) -> None:
    report = inspected(write(tmp_path, PAIR, {"left": lambda image: np.roll(image, 3, axis=0)}))
    assert "PROBLEM epipolar: rows disagree by +3.0 px: the pair is not rectified" in report


def turned(degrees: float, scale: float = 1.0) -> Change:
    matrix = cv2.getRotationMatrix2D((119.5, 89.5), -degrees, scale)

    def turn(image: Image) -> Image:
        out = cv2.warpAffine(image, matrix, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT)
        return np.asarray(out, np.uint8)

    return turn


def test_turned_camera_is_measured(tmp_path: Path) -> None:
    report = inspected(write(tmp_path, PAIR, {"left": turned(-2.0)}))
    pattern = r"the left image is turned anticlockwise by about ([\d.]+) degrees"
    assert numbers(pattern, report)[0] == pytest.approx(2.0, abs=0.3)
    assert "PROBLEM epipolar: rows scatter" in report
    assert "changes from frame to frame" not in report


def test_turned_top_camera_is_measured(tmp_path: Path) -> None:
    report = inspected(write(tmp_path, TRIPLE, {"top": turned(3.0)}))
    pattern = r"the top image is turned clockwise by about ([\d.]+) degrees"
    assert numbers(pattern, report)[0] == pytest.approx(3.0, abs=0.4)


def test_magnified_camera_is_measured(tmp_path: Path) -> None:
    report = inspected(write(tmp_path, PAIR, {"left": turned(0.0, 1.04)}))
    pattern = r"the left image is larger by about ([\d.]+) %"
    assert numbers(pattern, report)[0] == pytest.approx(4.0, abs=0.6)


@pytest.mark.parametrize(
    ("cameras", "words"),
    [
        ({"left": (0.0, 1.0)}, ": the left camera seems to lie above or below the right one"),
        (
            {"left": (1.0, 0.0), "top": (0.0, -1.0)},
            ", top: the top camera seems swapped with the right one, or",
        ),
        (
            {"left": (1.0, 0.0), "top": (-1.0, 0.0)},
            ", top: the top camera seems to lie next to the right one",
        ),
    ],
)
def test_cameras_in_other_places_are_reported(
    tmp_path: Path, cameras: dict[str, tuple[float, float]], words: str
) -> None:
    report = inspected(write(tmp_path, {"right": (0.0, 0.0), **cameras}))
    assert f"PROBLEM epipolar{words}" in report
    assert "swapped" not in words or "move its images elsewhere" in report


def test_wrong_vertical_baseline_is_reported(tmp_path: Path) -> None:
    root = write(tmp_path, TRIPLE)
    values = json.loads((root / "calib.json").read_text())
    values["vertical_baseline_m"] = 0.08
    (root / "calib.json").write_text(json.dumps(values), encoding="utf-8")
    report = inspected(root)
    assert "the vertical disparity is 1.25" in report
    assert "correct the ratio of the two baselines" in report


def test_cameras_that_are_not_triggered_together(tmp_path: Path) -> None:
    root = write(tmp_path, PAIR)
    late = root / "left" / "000003.png"
    image = cv2.imread(str(late), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    cv2.imwrite(str(late), np.roll(image, 2, axis=0))
    report = inspected(root)
    assert "the offset of the rows changes from frame to frame" in report
    assert "most in frames 3: trigger the cameras together" in report


def test_disparities_beyond_the_gate_are_reported(tmp_path: Path) -> None:
    report = inspected(write(tmp_path, PAIR), "frontend.stereo.max_disparity_px=10")
    assert "more than frontend.stereo.max_disparity_px = 10 and are lost; raise it to 20" in report


# --------------------------------------------------------------------------------------------
# Images and files


def test_black_and_missing_images_are_reported(tmp_path: Path) -> None:
    root = write(tmp_path, PAIR)
    cv2.imwrite(str(root / "right" / "000002.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
    (root / "left" / "000005.png").unlink()
    report = inspected(root)
    assert "PROBLEM images: the right image is all black (too dark) in 1 of 5" in report
    assert "PROBLEM images: 1 of 6 (16.7 %) sampled frames cannot be read" in report
    assert "WARNING recording: 1 of 6 frames lack an image: 5 (left)" in report
    assert "frames matched 3: 0, 2, 3" in report
    assert "2 problems" in report


def test_dim_camera_with_few_features_is_reported(tmp_path: Path) -> None:
    def dim(image: Image) -> Image:
        # Out of focus as well: where only the light is low, detection finds features all the same.
        blurred = cv2.GaussianBlur(image, (0, 0), 9.0)
        return np.asarray(blurred // 3, np.uint8)

    report = inspected(write(tmp_path, PAIR, {"left": dim}))
    assert "the right camera is 3" in report
    assert "WARNING features: the left images have only" in report
    assert "check focus, exposure and dirt of the left camera" in report


def test_featureless_recording_is_reported_not_crashed(tmp_path: Path) -> None:
    smooth: Change = lambda image: np.tile(np.linspace(0, 255, WIDTH), (HEIGHT, 1)).astype(np.uint8)  # noqa: E731
    report = inspected(write(tmp_path, TRIPLE, dict.fromkeys(TRIPLE, smooth)))
    assert "only 0 matches between left and right" in report
    assert "4 of 4 frames have fewer than 15 matches: 0, 2, 3, 5" in report
    assert "depth unknown: too few matches" in report


def test_truth_and_odometry_are_reported(tmp_path: Path) -> None:
    root = write(tmp_path, PAIR)
    rows = [f"{0.5 * k} {0.2 * k} 0 0 0 0 0 1" for k in range(FRAMES)]
    (root / "gt_right_cam.txt").write_text("\n".join(rows), encoding="utf-8")
    speeds = [f"{0.5 * k},0.4,0" for k in range(FRAMES)]
    (root / "odom.csv").write_text("\n".join(speeds), encoding="utf-8")
    report = inspected(root)
    assert "odometry covers 5 of 5 (100 %) steps" in report
    assert "ground truth covers 6 of 6 (100 %) frames, path length 1 m" in report
    # Truth moves to the right, odometry forwards: both axes disagree by the whole step.
    assert "the error in forward motion is" in report
    assert "the error in sideways motion is" in report


@pytest.mark.parametrize("baseline", [0.0, -0.1, float("nan")])
def test_impossible_baseline_cannot_be_opened(tmp_path: Path, baseline: float) -> None:
    with pytest.raises(CalibrationError, match="baseline_m"):
        inspect_recording(write(tmp_path, PAIR, baseline=baseline))


def test_times_running_backwards_cannot_be_opened(tmp_path: Path) -> None:
    root = write(tmp_path, PAIR)
    (root / "times.txt").write_text("0 0.0\n1 0.5\n2 0.4\n", encoding="utf-8")
    with pytest.raises(DatasetError, match=r"times\.txt, line 3"):
        inspect_recording(root)


# --------------------------------------------------------------------------------------------
# Experiments and the command


def test_experiment_file_opens_its_recording(tmp_path: Path) -> None:
    root = write(tmp_path / "data", PAIR)
    rows = [f"{0.5 * k} {0.2 * k} 0 0 0 0 0 1" for k in range(FRAMES)]
    (root / "gt_left_cam.txt").write_text("\n".join(rows), encoding="utf-8")
    experiment = tmp_path / "try.yaml"
    text = (
        f"name: try\ndataset: {{kind: image_folder, path: {root}}}\nodometry: {{kind: synthetic}}"
    )
    experiment.write_text(text, encoding="utf-8")
    report = inspected(experiment, "dataset.stride=2")
    assert "frames 3 over 2 s" in report
    assert "WARNING recording: the odometry is synthetic" in report
    with pytest.raises(ConfigError, match=r"did you mean dataset\.stride"):
        inspect_recording(experiment, ["dataset.strid=2"])


@pytest.mark.slow
def test_rendered_lab_is_found_sound(
    tmp_path: Path, open3d: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FGSLAM_CACHE", str(tmp_path / "cache"))
    experiment = tmp_path / "lab.yaml"
    experiment.write_text("name: lab\ndataset: {kind: rendered_lab, stop: 3}", encoding="utf-8")
    reported: list[str] = []
    report = flat(inspect_recording(experiment, (), 3, lambda what, *_: reported.append(what)))
    assert set(reported) == {"rendering", "reading", "matching"}
    assert "cameras 3, 320x240" in report
    assert numbers(r"three-camera matches (\d+) ", report)[0] > 60
    assert report.endswith("No problem found.")


def run_cli(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["fgslam", *arguments])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return int(ended.value.code or 0)


def test_command_prints_the_report_and_succeeds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write(tmp_path, {"right": (1.0, 0.0), "left": (0.0, 0.0)})
    assert run_cli(monkeypatch, "inspect", str(root), "--frames", "3") == 0
    assert "cameras look swapped" in capsys.readouterr().out
    assert run_cli(monkeypatch, "inspect", str(root), "--frames", "1", "--unit", "1e-5") == 2
    assert "0.001 mm apart, as one camera" in capsys.readouterr().err
    assert run_cli(monkeypatch, "inspect", str(root), "--frames", "1", "--unit", "0.5") == 0
    assert re.search(r"baseline +0\.05 m", capsys.readouterr().out)


def test_command_takes_the_options_of_a_recording_as_init_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked, of_init = (set(signature(each).parameters) for each in (cli.inspect, cli.init))
    assert of_init - asked == {"estimator"}
    root, other = write(tmp_path / "drive", PAIR), tmp_path / "other.json"
    calibration = json.loads((root / "calib.json").read_text(encoding="utf-8"))
    other.write_text(json.dumps({**calibration, "baseline_m": 0.4}), encoding="utf-8")
    inspected = ("inspect", str(root), "--frames", "1")
    chosen = ("--camera", str(other), "--stop", "4", "--scale", "0.5")
    assert run_cli(monkeypatch, *inspected, *chosen) == 0
    assert re.search(r"frames +4 .*x\d+\n.*baseline +0\.4 m", capsys.readouterr().out, re.DOTALL)
    assert run_cli(monkeypatch, *inspected, "--fps", "5") == 2
    assert "states its own times; leave --fps out" in capsys.readouterr().err
    experiment = root / "try.yaml"
    experiment.write_text(f"name: a\ndataset: {{kind: image_folder, path: {root}}}", "utf-8")
    assert run_cli(monkeypatch, "inspect", str(experiment), "--camera", str(other)) == 2
    assert "--camera is for a recording" in capsys.readouterr().err


def test_command_refuses_what_is_no_recording_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "notes.txt").write_text("nothing to see", encoding="utf-8")
    assert run_cli(monkeypatch, "inspect", str(tmp_path)) == 2
    streams = capsys.readouterr()
    assert streams.out == ""
    lines = [line for line in streams.err.splitlines() if line.strip()]
    assert len(lines) == 1
    assert lines[0].startswith(f"fgslam: {tmp_path} has none of the known layouts: image folder")
