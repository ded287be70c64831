"""The report page as text and values: sentences, thinning, ellipses, escapes, size, bytes."""

from __future__ import annotations

import base64
import dataclasses
import gzip
import hashlib
import io
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from reports import HOSTILE, estimator_report, full_report, loop, picture, without_truth

from fgslam.core.errors import OutputError
from fgslam.core.geometry import so3_exp
from fgslam.report.content import Column, Figure, Picture, TextTable, level_axes, peaks, thinned
from fgslam.report.figures import (
    Detail,
    drive_from_above,
    error_over_time,
    map_to_turn,
    nees_over_time,
    position_sigma,
)
from fgslam.report.page import BUDGET_BYTES, MAX_WIDTH, embed, headline, slam_page, write_report
from fgslam.report.page import render as render_page
from fgslam.report.results import EstimatorReport, ReportData


class Reader(HTMLParser):
    """Elements with their attributes, and scripts with their text, as a browser parses them."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[str] = []
        self._in_script = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag == "script":
            self.scripts.append("")
        self._in_script = tag == "script"

    def handle_endtag(self, tag: str) -> None:
        self._in_script = self._in_script and tag != "script"

    def handle_data(self, data: str) -> None:
        if self._in_script:
            self.scripts[-1] += data

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]


def render(data: ReportData) -> str:
    return render_page(slam_page(data))


def text_of(script: str) -> str:
    """Text of a compressed element."""
    return gzip.decompress(base64.b64decode(script)).decode("utf-8")


def named(figure: Figure, name: str) -> Any:
    return next(trace for trace in figure.drawing.data if trace.name == name)


def shown(figure: Figure) -> set[str]:
    return {trace.name for trace in figure.drawing.data if trace.visible is True}


def with_values(data: ReportData, **values: Any) -> ReportData:
    """The same with every estimator's values replaced."""
    changed = tuple(dataclasses.replace(e, **values) for e in data.estimators if not e.failure)
    return dataclasses.replace(data, estimators=changed)


# --------------------------------------------------------------------------------------------
# Sentences


def sentences(*estimators: tuple[str, float | None, float | None, str | None]) -> tuple[str, ...]:
    rng, truth = np.random.default_rng(0), loop(5)
    reports = tuple(
        dataclasses.replace(
            estimator_report(title, truth, rng), ate_m=ate, nees_per_dof=nees, verdict=verdict
        )
        for title, ate, nees, verdict in estimators
    )
    return headline(ReportData("t", "", reports, truth))


def test_the_best_is_named_with_its_lead() -> None:
    lines = sentences(
        ("filter", 0.03, 5000.0, "overconfident"),
        ("isam2", 0.012, 1.1, "consistent"),
        ("odometry", 2.5, 0.2, "conservative"),
    )
    assert lines[0] == (
        "isam2 is the most accurate: off by 1.20 cm (root mean square position error, SE3 "
        "aligned). The next, filter, is off by 3.00 cm, 2.5 times as much."
    )
    assert "Consistent (errors as large as the covariances say): isam2 (NEES 1.1)." in lines
    assert any(line.startswith("Overconfident") and "filter (NEES 5,000)" in line for line in lines)
    assert any(line.startswith("Conservative") and "odometry" in line for line in lines)


def test_errors_within_the_tolerance_count_as_ties() -> None:
    lines = sentences(("a", 0.0100, 1.0, None), ("b", 0.0102, 1.0, None), ("c", 0.02, 1.0, None))
    assert lines[0].startswith("a and b are about equally accurate: 1.00 cm")
    assert lines[-1] == "Whether the covariances of a, b and c can be believed is not known."


def test_a_perfect_path_divides_by_nothing() -> None:
    two = sentences(("a", 0.0, None, None), ("b", 0.1, None, None))[0]
    assert two.endswith("The next, b, is off by 10.00 cm.")
    assert sentences(("a", 0.0, None, None))[0].startswith("a is off by 0.00 cm")


def test_unknown_values_are_stated() -> None:
    lines = headline(without_truth(full_report()))
    assert lines[0] == "How accurate the path is, is not known: there is no ground truth."
    assert lines[-1] == "ekf failed: the map of 4,000 landmarks needs 1.2 GB"
    assert headline(ReportData("t", "", ())) == ("No estimator gave a result.",)


def test_the_map_of_the_best_estimator_is_shown_first() -> None:
    assert full_report().best == 1
    assert without_truth(full_report()).best == 0
    assert ReportData("t", "", ()).best == 0
    figure = map_to_turn(full_report())
    assert "landmarks of isam2" in shown(figure)
    assert "landmarks of landmark_kalman" not in shown(figure)


# --------------------------------------------------------------------------------------------
# Figures


def test_noise_is_drawn_where_it_is_known_each_kind_with_its_unit() -> None:
    data = full_report(frames=20)
    assert "noise" not in [figure.key for figure in slam_page(data).figures]
    unknown = np.full(20, np.nan)
    noise = {
        "rotation_sigma_dps2": np.r_[np.nan, np.linspace(100.0, 5.0, 19)],
        "translation_sigma_mps2": np.full(20, 0.4),
        "gyroscope_factor": unknown,
        "match_factor": np.ones(20),
        "single_factor": np.full(20, 0.9),
        "correlated_factor": np.full(20, 2.5),
    }
    figure = next(f for f in slam_page(with_values(data, noise=noise)).figures if f.key == "noise")
    layout = figure.drawing.layout
    titles = [layout[axis].title.text for axis in sorted(layout) if "yaxis" in axis]
    assert titles == [
        "rotation (deg/s\u00b2)",
        "translation (m/s\u00b2)",
        "matches (\u00d7 stated)",
        "graph (\u00d7 stated)",
    ]
    assert "isam2, weighed by" in shown(figure)
    drawn = named(figure, "isam2, rotation")["y"]
    np.testing.assert_allclose(drawn, noise["rotation_sigma_dps2"], rtol=1e-6)
    assert {
        named(figure, f"isam2, {words}").yaxis for words in ("weighed by", "single measurement")
    } == {"y4"}
    assert not figure.note


def test_without_noise_of_the_motion_the_page_says_only_what_is_known() -> None:
    figures = slam_page(with_values(full_report(20), noise={"match_factor": np.ones(20)})).figures
    note = next(figure.note for figure in figures if figure.key == "noise")
    assert note == (
        "No noise of a motion model is shown: it estimates none, or odometry measured the motion."
    )


@pytest.mark.parametrize("up", [(0.0, -1.0, 0.0), (0.1, -0.9, 0.4), (1.0, 0.0, 0.0)])
def test_level_axes_are_a_rotation_with_up_last(up: tuple[float, ...]) -> None:
    level = level_axes(np.array(up))
    np.testing.assert_allclose(level @ level.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(level) == pytest.approx(1.0)
    np.testing.assert_allclose(level @ np.array(up), [0, 0, np.linalg.norm(up)], atol=1e-12)


def test_a_level_camera_sees_ahead_as_ahead() -> None:
    np.testing.assert_array_equal(level_axes(np.array([0, -1.0, 0])) @ [1, 2, 3], [1, 3, -2])


def test_ellipses_hold_three_sigma_of_the_covariance_turned_into_the_world() -> None:
    """A pose turned by 90 degrees: its own z axis, with the large sigma, is the world's x."""
    data = full_report(frames=2)
    pose = np.eye(4)
    pose[:3, :3] = so3_exp(np.array([0.0, np.pi / 2, 0.0]))
    covariance = np.diag([9.0, 9.0, 9.0, 0.01**2, 0.02**2, 0.5**2])
    data = with_values(
        data, final_poses=np.stack([pose, pose]), covariances=np.stack([covariance, covariance])
    )
    x = named(drive_from_above(data), "isam2, 3 sigma")["x"]
    y = named(drive_from_above(data), "isam2, 3 sigma")["y"]
    assert np.nanmax(x) == pytest.approx(3 * 0.5, rel=0.01)
    assert np.nanmax(y) == pytest.approx(3 * 0.01, rel=0.01)


def test_scales_start_so_that_the_best_can_be_seen() -> None:
    """Beside dead reckoning, errors are logarithmic and ellipses of true size at first."""
    rng, truth = np.random.default_rng(2), loop(60)
    good = estimator_report("good", truth, rng, sigma_m=0.005)
    similar = ReportData("", "", (good, estimator_report("b", truth, rng, sigma_m=0.008)), truth)
    assert error_over_time(similar).drawing.layout.yaxis.type == "linear"
    assert re.search(r"Ellipses are drawn \d+ times larger", drive_from_above(similar).note)
    drifting = estimator_report("odometry", truth, rng, sigma_m=0.15)
    unlike = drive_from_above(ReportData("", "", (good, drifting), truth))
    both = ReportData("", "", (good, drifting), truth)
    assert error_over_time(both).drawing.layout.yaxis.type == "log"
    assert "larger" not in unlike.note
    assert {"good, 3 sigma", "odometry, 3 sigma"} <= shown(unlike)


def test_ellipses_that_would_hide_the_view_wait_until_asked_for() -> None:
    rng, truth = np.random.default_rng(2), loop(60)
    good = estimator_report("good", truth, rng, sigma_m=0.005)
    lost = estimator_report("lost", truth, rng)
    covariances = lost.covariances.copy()
    covariances[:, 3:, 3:] = 4.0 * np.eye(3)
    lost = dataclasses.replace(lost, covariances=covariances)
    figure = drive_from_above(ReportData("", "", (good, lost), truth))
    assert "larger" in figure.note  # as the good one alone needs it
    assert "good, 3 sigma" in shown(figure)
    assert "lost, 3 sigma" not in shown(figure)


def test_covariances_that_are_not_known_have_no_ellipse() -> None:
    data = with_values(full_report(), covariances=np.full((60, 6, 6), np.nan))
    assert not len(named(drive_from_above(data), "isam2, 3 sigma")["x"])
    assert np.isnan(position_sigma(data.estimators[0])).all()


def test_large_maps_and_long_runs_are_thinned_and_it_is_said() -> None:
    data = full_report(frames=300, landmarks=900)
    assert "evenly spread" not in drive_from_above(data).note
    above = drive_from_above(data, Detail(poses=100, dots_above=500))
    assert "100 of up to 300 poses and 500 of up to 900 landmarks" in above.note
    assert len(named(above, "isam2, final")["x"]) == 100
    assert len(named(above, "landmarks of isam2")["x"]) == 500


def test_far_landmarks_do_not_shrink_the_map() -> None:
    data = full_report(landmarks=400)
    positions = data.estimators[1].landmarks.positions.copy()
    positions[:3] = [900.0, 0.0, 900.0]
    landmarks = dataclasses.replace(data.estimators[1].landmarks, positions=positions)
    far = with_values(data, landmarks=landmarks)
    low, high = drive_from_above(far).drawing.layout.xaxis.range
    assert high - low < 15.0
    solid = map_to_turn(far)
    assert named(solid, "landmarks of isam2")["x"].max() < 15.0
    assert re.search(r"Far landmarks outside the box, not drawn: up to \d+\.", solid.note)


def test_thinning_keeps_ends_and_peaks() -> None:
    assert thinned(3, 10).tolist() == [0, 1, 2]
    rows = thinned(2500, 100)
    assert (rows[0], rows[-1], len(rows)) == (0, 2499, 100)
    values = np.zeros(1000)
    values[[17, 333, 998]] = 5.0
    values[500:520] = np.nan
    kept = peaks(values, 50)
    assert len(kept) == 50
    assert (np.diff(kept) > 0).all()
    assert {17, 333, 998} <= set(kept.tolist())


def test_nees_of_exact_poses_is_left_out_of_a_logarithmic_axis() -> None:
    data = full_report()
    nees = data.estimators[0].nees.copy()
    nees[:4] = 0.0
    figure = nees_over_time(with_values(data, nees=nees))
    assert np.isnan(named(figure, "isam2")["y"][:4]).all()
    assert "0.07 to 3.12" in figure.description


def test_nees_caption_says_which_estimator_each_band_is_of() -> None:
    data = full_report()
    titles = [estimator.title for estimator in data.estimators]
    bands = [(0.07, 3.12), *[(0.21, 2.41)] * (len(titles) - 1)]
    estimators = tuple(
        dataclasses.replace(estimator, nees_band=band)
        for estimator, band in zip(data.estimators, bands, strict=True)
    )
    figure = nees_over_time(dataclasses.replace(data, estimators=estimators))
    words = f"(0.07 to 3.12 of {titles[0]}; 0.21 to 2.41 of {', '.join(titles[1:])})"
    assert words in figure.description


# --------------------------------------------------------------------------------------------
# The page


def test_the_page_needs_nothing_else() -> None:
    text = render(full_report())
    reader = Reader(text)
    for tag, attributes in reader.elements:
        for name in ("src", "href", "srcset", "data", "action", "poster"):
            value = attributes.get(name)
            assert value is None or value.startswith("data:"), (tag, value)
    assert "@import" not in text
    assert "url(" not in text[: text.index("<body>")]


def test_only_the_two_scripts_may_run() -> None:
    reader = Reader(render(full_report()))
    (policy,) = [m["content"] for m in reader.all("meta") if "http-equiv" in m]
    assert policy is not None
    drawings, plotly, script = reader.scripts
    assert "default-src 'none'" in policy
    run = (text_of(plotly), script)
    digests = [base64.b64encode(hashlib.sha256(s.encode()).digest()).decode() for s in run]
    assert re.findall(r"'sha256-([^']+)'", policy) == digests
    assert "unsafe-inline'" not in policy.split("style-src")[0]
    assert set(json.loads(text_of(drawings))) == {"above", "map", "error", "axes", "nees", "time"}


def test_everything_from_outside_is_escaped() -> None:
    data = full_report()
    failed = EstimatorReport.failed(HOSTILE, HOSTILE, HOSTILE)
    rows = ((HOSTILE, (HOSTILE,)),)
    text = render(
        ReportData(
            HOSTILE,
            HOSTILE,
            (
                dataclasses.replace(data.estimators[0], title="x" + HOSTILE, remarks=(HOSTILE,)),
                failed,
            ),
            notes=(HOSTILE,),
            tables=(TextTable("k", HOSTILE, HOSTILE, (Column(HOSTILE, HOSTILE),), rows),),
            pictures=(Picture(HOSTILE, data.pictures[0].content),),
            config_yaml=HOSTILE,
            versions={HOSTILE: HOSTILE},
        )
    )
    assert "<script>alert" not in text
    assert len(Reader(text).scripts) == 3
    assert text.count("</style>") == 1
    assert not [a for _, a in Reader(text).elements if "quotes" in a]


def test_the_same_data_give_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.html", "b.html"):
        write_report(tmp_path / name, full_report())
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_figures_and_pictures_have_words() -> None:
    reader = Reader(render(full_report()))
    plots = [a for a in reader.all("div") if a.get("role") == "img"]
    assert len(plots) == 6
    assert all(a["aria-describedby"] and a["aria-labelledby"] for a in plots)
    assert all(image.get("alt") for image in reader.all("img"))
    headings = [tag for tag, _ in reader.elements if re.fullmatch("h[1-6]", tag)]
    assert headings[0] == "h1"
    assert headings.count("h1") == 1
    ids = [a["id"] for _, a in reader.elements if "id" in a]
    assert len(ids) == len(set(ids))


def test_the_calibration_is_drawn_with_its_band_where_the_run_kept_one() -> None:
    assert "calibration" not in {figure.key for figure in slam_page(full_report()).figures}
    changes = [f"left_{name}" for name in ("yaw_deg", "pitch_deg", "roll_deg", "focal_percent")]
    found = {"timestamp": np.array([1.0, 2.0]), "knocks": np.array([0.0, 1.0])}
    found |= {name: np.array([0.1, 0.2]) for name in changes}
    found |= {f"{name}_sigma": np.array([0.02, 0.01]) for name in changes}
    page = slam_page(dataclasses.replace(full_report(), calibration=found))
    figure = next(figure for figure in page.figures if figure.key == "calibration")
    band, line = figure.drawing.data[:2]
    assert len(figure.drawing.data) == 8
    np.testing.assert_allclose(line.y, [0.1, 0.2], rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(band.y, [0.16, 0.23, 0.17, 0.04], rtol=0.0, atol=1e-6)
    assert "moved 1 times" in figure.note


def test_a_failed_estimator_has_a_row() -> None:
    assert "ekf failed: the map" in render(full_report())
    assert "ekf (failed)" in render(full_report())


def test_long_runs_stay_small() -> None:
    rng, truth = np.random.default_rng(5), loop(2500)
    reports = tuple(estimator_report(f"e{i}", truth, rng, landmarks=20_000) for i in range(8))
    noise = Picture("noise", picture(rng, 1400, 1300))
    text = render(ReportData("long", "", reports, truth, pictures=(noise,) * 5))
    assert len(text.encode()) < 8e6
    left_out = "Left out to keep this page small, see the run folder: noise"
    assert left_out in text  # pictures at their worst


def test_an_error_of_the_disk_is_reported(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"nowhere.*choose another folder"):
        write_report(tmp_path / "nowhere" / "report.html", full_report())


# --------------------------------------------------------------------------------------------
# Values that do not fit


def test_rows_and_shapes_must_agree() -> None:
    report = full_report().estimators[0]
    with pytest.raises(ValueError, match=r"landmark_kalman: nees has 3 rows, not 60"):
        dataclasses.replace(report, nees=np.zeros(3))
    with pytest.raises(ValueError, match="a: 1 values in a table of 0 columns"):
        TextTable("k", "h", "f", (), (("a", ("1",)),))
    with pytest.raises(ValueError, match="not unique"):
        ReportData("t", "", (report, report))


# --------------------------------------------------------------------------------------------
# Pictures


def test_small_pictures_are_kept_and_large_ones_shrunk(rng: np.random.Generator) -> None:
    small, large = picture(rng), picture(rng, 2000, 900)
    (kept, shrunk), left_out = embed([Picture("s", small), Picture("l", large)])
    assert left_out == []
    assert base64.b64decode(kept.uri.partition(",")[2]) == small
    assert (kept.width, kept.height) == (64, 48)
    assert shrunk.uri.startswith("data:image/webp;base64,")
    with Image.open(io.BytesIO(base64.b64decode(shrunk.uri.partition(",")[2]))) as opened:
        assert opened.size == (MAX_WIDTH, 495)


def test_pictures_that_cannot_be_shown_are_listed(rng: np.random.Generator) -> None:
    content = picture(rng)
    shown, left_out = embed([Picture("torn", content[:100]), Picture("text", b"hello")])
    assert shown == []
    assert left_out == ["Picture not readable: torn", "Picture not readable: text"]
    many = [Picture(f"p{i}", picture(rng, 1200, 900)) for i in range(12)]
    shown, left_out = embed(many)
    assert 0 < len(shown) < 12
    assert len(shown) + len(left_out) == 12
    assert sum(len(p.uri) for p in shown) < BUDGET_BYTES * 1.34
    assert left_out[0] == f"Left out to keep this page small, see the run folder: p{len(shown)}"
