"""The page of homing runs as text and values."""

from __future__ import annotations

import base64
import gzip
import json
import re
from pathlib import Path

import numpy as np
import pytest
from homing_pages import FEATURES, drive, estimates, page, truth
from reports import HOSTILE

from fgslam.core.arrays import FloatArray
from fgslam.report.content import Column, TextTable
from fgslam.report.figures.homing import (
    MAX_MOMENTS,
    claimed_against_true,
    local_map_figure,
    sorted_errors,
    upwards,
)
from fgslam.report.figures.plan import (
    Links,
    catchment_figure,
    drive_figure,
    network_figure,
    unfolded,
)
from fgslam.report.figures.traces import SIGMAS, Figure, Trace, outlines, unpacked
from fgslam.report.page import render, write_html


def points(found: Trace) -> FloatArray:
    return np.column_stack([unpacked(found["x"]), unpacked(found["y"])])


def at_step(figure: Figure, name: str, step: int) -> list[Trace]:
    return [t for t in figure.traces if t["name"] == name and t["meta"].get("step") == step]


def test_ahead_is_up_and_left_is_left() -> None:
    drawn = upwards(np.array([[2.0, 1.0]]))
    assert (drawn["x"][0], drawn["y"][0]) == (-1.0, 2.0)


def test_an_ellipse_lies_at_its_deviations() -> None:
    covariance = np.array([[4.0, 1.0], [1.0, 2.0]])
    outline = outlines(np.array([[1.0, -1.0]]), covariance[None])[0] - [1.0, -1.0]
    distance = np.einsum("ni,ij,nj->n", outline, np.linalg.inv(covariance), outline)
    np.testing.assert_allclose(distance, SIGMAS**2, rtol=1e-12)
    assert np.isnan(outlines(np.zeros((1, 2)), np.full((1, 2, 2), np.nan))).all()


def test_a_lost_feature_becomes_a_star_where_it_was_last() -> None:
    figure = local_map_figure(estimates(9), truth(9))
    assert len(figure.steps) == 9
    assert at_step(figure, "lost feature", 3) == []
    (star,) = at_step(figure, "lost feature", 6)
    assert star["marker"]["symbol"] == "star"
    np.testing.assert_allclose(points(star), [[-FEATURES[2, 1], FEATURES[2, 0]]], atol=1e-6)
    (diamonds,) = at_step(figure, "feature", 6)
    assert diamonds["text"] == ["0", "1", "3"]


def test_the_truth_is_drawn_in_legs() -> None:
    figure = local_map_figure(estimates(9), truth(9))
    (path,) = [t for t in figure.traces if t["name"] == "true path"]
    assert points(path)[-1, 1] == pytest.approx(8 / 9)
    assert "truth" not in {s.key for s in local_map_figure(estimates(9)).switches}


def test_long_homings_are_thinned_to_moments() -> None:
    figure = local_map_figure(estimates(400))
    assert len(figure.steps) == MAX_MOMENTS
    assert figure.steps[-1] == "199.5 s"


def test_unknown_covariances_draw_no_ellipse() -> None:
    found = estimates(2)
    blind = [
        type(e)(
            e.time, e.robot, e.target, np.full((6, 6), np.nan), e.ids, e.landmarks,
            np.full_like(e.landmark_covariances, np.nan),
        )
        for e in found
    ]  # fmt: skip
    names = {t["name"] for t in local_map_figure(blind).traces}
    assert not any("sigma" in name for name in names)
    assert any("sigma" in t["name"] for t in local_map_figure(found).traces)


def test_the_drive_has_its_legs_targets_and_walls() -> None:
    figure = drive_figure(drive())
    names = [t["name"] for t in figure.traces if "step" not in t["meta"]]
    assert {"leg 1", "leg 2", "targets", "walls"} <= set(names)
    legs = [points(t) for t in figure.traces if t["name"] in ("leg 1", "leg 2")]
    np.testing.assert_allclose(legs[0][-1], legs[1][0])  # no gap between legs
    assert at_step(figure, "direction of home", 0) == []  # not known yet
    assert len(at_step(figure, "direction of home", 20)) == 1


def test_catchment_shows_both_outcomes() -> None:
    figure = catchment_figure(np.eye(2), np.array([True, False]), ["one", "two"])
    found = {t["name"]: t for t in figure.traces}
    np.testing.assert_allclose(points(found["arrived"]), [[0.0, 1.0]])
    np.testing.assert_allclose(points(found["did not arrive"]), [[-1.0, 0.0]])
    assert found["did not arrive"]["text"] == ["two"]
    assert catchment_figure(np.zeros((0, 2)), np.zeros(0, bool), []).traces == ()


def test_distribution_counts_missing_answers() -> None:
    figure = sorted_errors({"a": np.array([3.0, -1.0, np.nan, 2.0])}, "deg", ("k", "Errors"))
    np.testing.assert_allclose(points(figure.traces[0]), [[1, 25], [2, 50], [3, 75]])


def test_no_answer_draws_no_cloud() -> None:
    assert claimed_against_true({"a": np.zeros(0)}, {"a": np.zeros(0)}).traces == ()


def test_a_ragged_table_is_refused() -> None:
    with pytest.raises(ValueError, match="2 values in a table of 1 columns"):
        TextTable("k", "h", "f", (Column("a", "b"),), (("row", ("1", "2")),))


def test_the_page_is_whole_repeatable_and_small(tmp_path: Path) -> None:
    write_html(tmp_path / "a.html", page())
    write_html(tmp_path / "b.html", page())
    content = (tmp_path / "a.html").read_bytes()
    assert content == (tmp_path / "b.html").read_bytes()
    assert len(content) < 3e6
    text = content.decode("utf-8")
    for key in ("local-map", "drive", "direction", "claimed", "catchment"):
        assert f'id="plot-{key}"' in text
    assert 'data-play="local-map"' in text
    assert text.count("data-steps=") == 2


def test_nothing_from_outside_is_markup() -> None:
    text = render(page(HOSTILE))
    assert "<script>alert" not in text
    values = re.search(r'id="report-data"[^>]*>(.*?)</script>', text, re.DOTALL)
    assert values is not None
    found = json.loads(gzip.decompress(base64.b64decode(values.group(1))))
    assert set(found) >= {"local-map", "drive"}


def test_a_chain_unfolds_to_a_line() -> None:
    places = unfolded(5, [(0, 1), (1, 2), (2, 3), (3, 4)])
    np.testing.assert_allclose(np.abs(np.diff(places[:, 0])), 1.0, atol=1e-9)
    np.testing.assert_allclose(places[:, 1], 0.0, atol=1e-6)
    apart = unfolded(4, [(0, 1), (2, 3)])
    assert np.linalg.norm(apart[0] - apart[1]) < np.linalg.norm(apart[0] - apart[2])
    assert unfolded(1, []).shape == (1, 2)


def test_links_have_a_switch_for_each_kind_that_there_is() -> None:
    kinds = [
        Links("right", 0, ((0, 1), (1, 2)), ("2 deg", "3 deg")),
        Links("none", 1, (), ()),
        Links("wrong", 2, ((0, 2),), ("40 deg",), shown=False),
    ]
    places = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    figure = network_figure(("k", "Pairs", "What."), places, ("2", "3", "4"), kinds)
    assert [(s.label, s.on) for s in figure.switches] == [("right (2)", True), ("wrong (1)", False)]
    marks = [t for t in figure.traces if t["name"] == "wrong" and t["mode"] == "markers"]
    np.testing.assert_allclose(points(marks[0]), [[0.5, 0.5]])
    assert figure.traces[-1]["text"] == ["2", "3", "4"]
    hostile = network_figure(("k", "Pairs", "What."), places, ("<b>", "3", "4"), kinds)
    assert hostile.traces[-1]["text"][0] == "&lt;b&gt;"
