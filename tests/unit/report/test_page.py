"""The report page as text: sentences, escapes, size, bytes, pictures."""

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

import numpy as np
import pytest
from PIL import Image
from plotly import graph_objects as go
from reports import HOSTILE, estimator_report, full_report, loop, picture, without_truth

from fgslam.report.content import Column, Picture, TextTable
from fgslam.report.page import (
    MAX_WIDTH,
    embed,
    headline,
    render as render_page,
    slam_page,
    write_report,
)
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
    bits = "".join(f"{ord(character) & 127:07b}" for character in script)
    return gzip.decompress(int(bits[: len(bits) // 8 * 8], 2).to_bytes(len(bits) // 8)).decode()


# --------------------------------------------------------------------------------------------
# Sentences


def sentences(*estimators: tuple[str, float | None, float | None, str | None]) -> tuple[str, ...]:
    rng, truth = np.random.default_rng(0), loop(5)
    reports = tuple(
        dataclasses.replace(
            estimator_report(title, truth, rng),
            ate_m=ate,
            matched_poses=51,
            judged_poses=40,
            nees_per_dof=nees,
            verdict=verdict,
        )
        for title, ate, nees, verdict in estimators
    )
    return headline(ReportData("t", "", estimators=reports, truth=truth))


def test_the_best_is_named_with_its_lead() -> None:
    lines = sentences(
        ("filter", 0.03, 5000.0, "overconfident"),
        ("isam2", 0.012, 1.1, "consistent"),
        ("odometry", 2.5, 0.2, "conservative"),
    )
    assert lines[0] == (
        "isam2 is the most accurate: off by 1.20 cm (root mean square position error of 51 "
        "poses, SE3 aligned). The next, filter, is off by 3.00 cm, 2.5 times as much."
    )
    assert (
        "Consistent (errors as large as the covariances say): isam2 (NEES 1.1 of 40 poses)."
        in lines
    )
    assert any(
        line.startswith("Overconfident") and "filter (NEES 5,000 of 40 poses)" in line
        for line in lines
    )
    assert any(line.startswith("Conservative") and "odometry" in line for line in lines)


def test_truth_that_is_left_out_is_stated_once() -> None:
    rng, truth = np.random.default_rng(0), loop(5)
    why = "truth of frames 0 to 10 is off by 0.8 degrees: left out where it is judged"
    reports = tuple(
        dataclasses.replace(estimator_report(title, truth, rng), truth_remark=why)
        for title in ("isam2", "batch")
    )
    lines = headline(ReportData("t", "", estimators=reports, truth=truth))
    assert [line for line in lines if "0 to 10" in line] == [f"T{why[1:]}."]


def test_errors_within_the_tolerance_count_as_ties() -> None:
    lines = sentences(("a", 0.0100, 1.0, None), ("b", 0.0102, 1.0, None), ("c", 0.02, 1.0, None))
    assert lines[0].startswith("a and b are about equally accurate: 1.00 cm")
    assert lines[0].endswith("; c 2.00 cm.")
    assert lines[-1].startswith("The estimator's work for a frame took, in the median: ")
    assert lines[-2] == "Whether the covariances of a, b and c can be believed is not known."


def test_a_perfect_path_divides_by_nothing() -> None:
    two = sentences(("a", 0.0, None, None), ("b", 0.1, None, None))[0]
    assert two.endswith("The next, b, is off by 10.00 cm.")
    assert sentences(("a", 0.0, None, None))[0].startswith("a is off by 0.00 cm")


def test_unknown_values_are_stated() -> None:
    lines = headline(without_truth(full_report()))
    assert lines[0] == "How accurate the path is, is not known: there is no ground truth."
    assert lines[-1] == "ekf failed: the map of 4,000 landmarks needs 1.2 GB"
    assert headline(ReportData("t", "", estimators=())) == ("No estimator gave a result.",)


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
    figures = json.loads(text_of(drawings))["figures"]
    assert set(figures) == {"above", "map", "error", "axes", "nees", "time"}


def test_everything_from_outside_is_escaped() -> None:
    data = full_report()
    failed = EstimatorReport.failed(HOSTILE, HOSTILE, HOSTILE)
    rows = ((HOSTILE, (HOSTILE,)),)
    text = render(
        ReportData(
            HOSTILE,
            HOSTILE,
            estimators=(
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


def test_plotly_knows_all_that_figures_are_made_of() -> None:
    """They are built unchecked, which is five times faster; here Plotly checks each name."""
    for figure in slam_page(full_report()).figures:
        go.Figure(figure.drawing.to_dict())


def test_long_runs_stay_small() -> None:
    rng, truth = np.random.default_rng(5), loop(2500)
    reports = tuple(estimator_report(f"e{i}", truth, rng, landmarks=20_000) for i in range(8))
    noise = Picture("noise", picture(rng, 1400, 1300))
    text = render(ReportData("long", "", estimators=reports, truth=truth, pictures=(noise,) * 5))
    assert len(text.encode()) < 8e6
    left_out = "Left out to keep this page small, see the run folder: noise"
    assert left_out in text  # pictures at their worst


# --------------------------------------------------------------------------------------------
# Values that do not fit


def test_rows_and_shapes_must_agree() -> None:
    report = full_report().estimators[0]
    with pytest.raises(ValueError, match=r"landmark_kalman: nees has 3 rows, not 60"):
        dataclasses.replace(report, nees=np.zeros(3))
    with pytest.raises(ValueError, match="not unique"):
        ReportData("t", "", estimators=(report, report))


# --------------------------------------------------------------------------------------------
# Pictures


def test_small_pictures_are_kept_and_large_ones_shrunk(rng: np.random.Generator) -> None:
    small, large = picture(rng), picture(rng, 2000, 900)
    (kept, shrunk), left_out = embed([Picture("s", small), Picture("l", large)])
    assert left_out == []
    assert base64.b64decode(kept["uri"].partition(",")[2]) == small
    assert (kept["width"], kept["height"]) == (64, 48)
    assert shrunk["uri"].startswith("data:image/jpeg;base64,")
    with Image.open(io.BytesIO(base64.b64decode(shrunk["uri"].partition(",")[2]))) as opened:
        assert opened.size == (MAX_WIDTH, 495)


def test_pictures_that_cannot_be_shown_are_listed(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = picture(rng)
    shown, left_out = embed([Picture("torn", content[:100]), Picture("text", b"hello")])
    assert shown == []
    assert left_out == ["Picture not readable: torn", "Picture not readable: text"]
    monkeypatch.setattr("fgslam.report.page.BUDGET_BYTES", 150_000)
    many = [Picture(f"p{i}", picture(rng, 240, 180)) for i in range(12)]
    shown, left_out = embed(many)
    assert 0 < len(shown) < 12
    assert len(shown) + len(left_out) == 12
    assert sum(len(p["uri"]) for p in shown) < 150_000 * 1.34
    assert left_out[0] == f"Left out to keep this page small, see the run folder: p{len(shown)}"
