"""Figures of homing: what they draw."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from homing_pages import FEATURES, drive, estimates, truth

from fgslam.core.arrays import FloatArray
from fgslam.report.content import Figure
from fgslam.report.homing_figures import (
    MAX_MOMENTS,
    Line,
    Links,
    catchment_figure,
    curve_figure,
    drive_figure,
    local_map_figure,
    network_figure,
    sorted_errors,
    unfolded,
)


def points(found: Any) -> FloatArray:
    return np.column_stack([found.x, found.y])


def at_step(figure: Figure, name: str, step: int) -> Any:
    return next(t for t in figure.drawing.frames[step].data if t.name == name)


def moments(figure: Figure) -> list[str]:
    return [step.label for step in figure.drawing.layout.sliders[0].steps]


def names(figure: Figure) -> list[str]:
    return [t.name for t in figure.drawing.data]


def test_a_lost_feature_becomes_a_star_where_it_was_last() -> None:
    figure = local_map_figure(estimates(9), truth(9))
    assert len(moments(figure)) == len(figure.drawing.frames) == 9
    assert len(at_step(figure, "lost features", 3).x) == 0
    star = at_step(figure, "lost features", 6)
    assert star.marker.symbol == "star"
    np.testing.assert_allclose(points(star), [[-FEATURES[2, 1], FEATURES[2, 0]]], atol=1e-6)
    # Ahead is up the page, left is left.
    assert list(at_step(figure, "features", 6).text) == ["0", "1", "3"]


def test_the_truth_is_drawn_in_legs() -> None:
    figure = local_map_figure(estimates(9), truth(9))
    (path,) = [t for t in figure.drawing.data if t.name == "true path"]
    assert points(path)[-1, 1] == pytest.approx(8 / 9)
    assert "truth" not in names(local_map_figure(estimates(9)))


def test_long_homings_are_thinned_to_moments() -> None:
    figure = local_map_figure(estimates(400))
    assert len(moments(figure)) == MAX_MOMENTS
    assert moments(figure)[-1] == "199.5 s"


def test_unknown_covariances_draw_no_ellipse() -> None:
    found = estimates(2)
    blind = [
        type(e)(
            e.time, e.robot, e.target, np.full((6, 6), np.nan), e.ids, e.landmarks,
            np.full_like(e.landmark_covariances, np.nan),
        )
        for e in found
    ]  # fmt: skip

    def ellipses(figure: Figure) -> FloatArray:
        return np.concatenate([points(t) for t in figure.drawing.data if "sigma" in t.name])

    assert not np.isfinite(ellipses(local_map_figure(blind))).any()
    assert np.isfinite(ellipses(local_map_figure(found))).any()


def test_the_drive_has_its_legs_targets_and_walls() -> None:
    figure = drive_figure(drive())
    assert {"leg 1", "leg 2", "targets", "walls"} <= set(names(figure))
    legs = [points(t) for t in figure.drawing.data if t.name in ("leg 1", "leg 2")]
    np.testing.assert_allclose(legs[0][-1], legs[1][0])  # no gap between legs
    assert np.isnan(points(at_step(figure, "direction of home", 0))[1]).all()  # not known yet
    assert np.isfinite(points(at_step(figure, "direction of home", 20))).all()


def test_catchment_shows_both_outcomes() -> None:
    figure = catchment_figure(np.eye(2), np.array([True, False]), ["one", "two"])
    found = {t.name: t for t in figure.drawing.data}
    np.testing.assert_allclose(points(found["arrived"]), [[0.0, 1.0]])
    np.testing.assert_allclose(points(found["did not arrive"]), [[-1.0, 0.0]])
    assert list(found["did not arrive"].text) == ["two"]
    assert not catchment_figure(np.zeros((0, 2)), np.zeros(0, bool), []).has_numbers


def test_distribution_counts_missing_answers() -> None:
    figure = sorted_errors({"a": np.array([3.0, -1.0, np.nan, 2.0])}, "deg", ("k", "Errors"))
    np.testing.assert_allclose(points(figure.drawing.data[0]), [[1, 25], [2, 50], [3, 75]])


def test_a_chain_unfolds_to_a_line() -> None:
    places = unfolded(5, [(0, 1), (1, 2), (2, 3), (3, 4)])
    np.testing.assert_allclose(np.abs(np.diff(places[:, 0])), 1.0, atol=1e-9)
    np.testing.assert_allclose(places[:, 1], 0.0, atol=1e-6)
    apart = unfolded(4, [(0, 1), (2, 3)])
    assert np.linalg.norm(apart[0] - apart[1]) < np.linalg.norm(apart[0] - apart[2])
    assert unfolded(1, []).shape == (1, 2)


def test_links_of_each_kind_that_there_is_are_drawn() -> None:
    kinds = [
        Links("right", 0, ((0, 1), (1, 2)), ("2 deg", "3 deg")),
        Links("none", 1, (), ()),
        Links("wrong", 2, ((0, 2),), ("40 deg",), shown=False),
    ]
    places = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    figure = network_figure(("k", "Pairs", "What."), places, ("2", "3", "4"), kinds)
    lines = [(t.name, t.visible) for t in figure.drawing.data if t.mode == "lines"]
    assert lines == [("right (2)", True), ("wrong (1)", "legendonly")]
    marks = [t for t in figure.drawing.data if t.name == "wrong (1)" and t.mode == "markers"]
    np.testing.assert_allclose(points(marks[0]), [[0.5, 0.5]])
    assert list(figure.drawing.data[-1].text) == ["2", "3", "4"]
    hostile = network_figure(("k", "Pairs", "What."), places, ("<b>", "3", "4"), kinds)
    assert hostile.drawing.data[-1].text[0] == "&lt;b&gt;"


def test_an_answer_between_gaps_is_seen() -> None:
    """No line is drawn to it; the others have none but the line."""
    x, nan = np.arange(6.0), np.nan
    figure = curve_figure(
        ("k", "h", "d"),
        [Line("alone", 0, x, np.array([1.0, nan, 2.0, nan, 3.0, 3.0])), Line("all", 1, x, x)],
        ("x", "y"),
    )
    alone, whole = figure.drawing.data
    assert [size > 0 for size in alone.marker.size] == [True, False, True, False, False, False]
    assert (alone.mode, whole.mode) == ("lines+markers", "lines")
