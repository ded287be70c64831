"""The report page in a real browser that is offline: it draws, its controls work, it fits."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browser import LAPTOP, PHONE, WIDE, Browser, browsing
from reports import HOSTILE, estimator_report, full_report, loop, without_truth
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

from fgslam.report.content import Picture
from fgslam.report.run_results import EstimatorReport, ReportData
from fgslam.report.slam_page import write_report

FIGURES = ("above", "map", "error", "axes", "nees", "time")
FARTHEST_PLOT = (
    "Math.max(...[...document.querySelectorAll('.plot')].map(p => p.getBoundingClientRect().right))"
)
DRAWN = "document.getElementById('plot-{}')._fullData"


@pytest.fixture(scope="module")
def offline(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with browsing(tmp_path_factory.mktemp("profile")) as browser:
        yield browser


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "a report #1.html"
    write_report(path, full_report())
    return path


@pytest.fixture
def browser(offline: Browser, page: Path) -> Browser:
    """The full report on a wide screen in light colours, all controls as at the start."""
    offline.size(*WIDE)
    offline.scheme("light")
    if offline.driver.current_url == page.as_uri():
        offline.reset()  # loading takes seconds
    else:
        offline.open(page)
    return offline


def write(path: Path, data: ReportData) -> Path:
    write_report(path, data)
    return path


def visible(browser: Browser, figure: str) -> list[str]:
    """Names of the traces that a figure shows."""
    return browser.js(f"{DRAWN.format(figure)}.filter(t => t.visible === true).map(t => t.name)")


def switch(browser: Browser, selector: str) -> None:
    """Clicks a control as a person would; the figures follow."""
    box = browser.driver.find_element(By.CSS_SELECTOR, selector)
    browser.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", box)
    box.click()


def figure_switch(figure: str, key: str) -> str:
    return f'input[data-figure="{figure}"][data-switch="{key}"]'


def test_page_loads_offline_without_error_or_request(offline: Browser, page: Path) -> None:
    browser = offline
    browser.assert_loads_quietly(page)
    for figure in FIGURES:
        assert browser.js(f"{DRAWN.format(figure)}.length") >= 2
    assert browser.js("document.querySelectorAll('#plot-map canvas').length") >= 1
    assert browser.js("navigator.onLine") is False


def test_the_table_has_a_row_for_each_estimator(browser: Browser) -> None:
    titles = browser.js(
        "[...document.querySelectorAll('tbody th')].map(cell => cell.innerText.trim())"
    )
    assert titles == ["landmark_kalman", "isam2", "ekf (failed)"]
    assert "isam2 is the most accurate" in browser.js("document.body.innerText")
    assert "ekf failed: the map of 4,000 landmarks" in browser.js("document.body.innerText")


def test_an_estimator_is_hidden_and_shown_in_every_figure(browser: Browser) -> None:
    def of_isam2(figure: str) -> list[str]:
        return [name for name in visible(browser, figure) if name.startswith("isam2")]

    figures = [figure for figure in FIGURES if figure != "axes"]  # shows one that is chosen
    before = {figure: visible(browser, figure) for figure in figures}
    assert all(of_isam2(figure) for figure in figures)
    switch(browser, 'input[data-estimator="1"]')
    browser.wait(f"!{DRAWN.format('time')}[1].visible")
    assert not any(of_isam2(figure) for figure in figures)
    assert all(visible(browser, figure) for figure in figures)  # the others stay
    box = browser.driver.find_element(By.CSS_SELECTOR, 'input[data-estimator="1"]')
    box.send_keys(Keys.SPACE)  # and back, by keyboard
    browser.wait(f"{DRAWN.format('time')}[1].visible === true")
    assert {figure: visible(browser, figure) for figure in figures} == before


def test_errors_along_the_axes_are_those_of_the_chosen_estimator(browser: Browser) -> None:
    assert [name.split(",")[0] for name in visible(browser, "axes")][1::2] == ["isam2"] * 3
    select = browser.driver.find_element(By.CSS_SELECTOR, 'select[data-figure="axes"]')
    select.send_keys("landmark_kalman")
    browser.wait(f"{DRAWN.format('axes')}[1].visible === true")
    names = [name.split(",")[0] for name in visible(browser, "axes")][1::2]
    assert names == ["landmark_kalman"] * 3
    assert browser.js("Object.keys(document.getElementById('plot-axes')._fullLayout)").count(
        "yaxis3"
    )


def test_ellipses_and_their_enlargement_are_switched(browser: Browser) -> None:
    name = "isam2, 3 sigma"
    width = (
        "(i => { const x = [...i.x].slice(-34, -1); return Math.max(...x) - Math.min(...x); })"
        f"({DRAWN.format('above')}.find(t => t.visible === true && t.name === '{name}'))"
    )
    large = browser.js(width)
    switch(browser, figure_switch("above", "enlarged"))
    small = browser.js(width)
    assert small == pytest.approx(2 * 3 * 0.01, rel=0.05)  # six claimed standard deviations
    assert large > 1.9 * small
    switch(browser, figure_switch("above", "ellipses"))
    assert name not in visible(browser, "above")
    switch(browser, figure_switch("above", "ellipses"))
    assert name in visible(browser, "above")


def test_every_layer_of_the_view_from_above_has_its_switch(browser: Browser) -> None:
    for key, name in (
        ("truth", "truth"),
        ("final", "isam2, final"),
        ("online", "isam2, online"),
        ("landmarks", "landmark of isam2"),
    ):
        shown = name in visible(browser, "above")
        switch(browser, figure_switch("above", key))
        assert (name in visible(browser, "above")) is not shown


def test_the_map_is_that_of_the_chosen_estimator(browser: Browser) -> None:
    assert "landmark of isam2" in visible(browser, "map")  # the best one's at first
    select = browser.driver.find_element(By.CSS_SELECTOR, 'select[data-figure="map"]')
    select.send_keys("landmark_kalman")
    browser.wait(f"{DRAWN.format('map')}[0].visible === true")
    landmarks = [name for name in visible(browser, "map") if name.startswith("landmark of")]
    assert landmarks == ["landmark of landmark_kalman"]


def test_scales_are_linear_or_logarithmic(browser: Browser) -> None:
    kind = "document.getElementById('plot-error')._fullLayout.yaxis.type"
    assert browser.js(kind) == "linear"
    switch(browser, figure_switch("error", "log"))
    browser.wait(f"{kind} === 'log'")


SCENE = "document.getElementById('plot-map')._fullLayout.scene"
DRAWN_EYE, KEPT_EYE = f"{SCENE}._scene.getCamera().eye", f"{SCENE}.camera.eye"
AT_REST = f"['x', 'y', 'z'].every(k => Math.abs({DRAWN_EYE}[k] - {KEPT_EYE}[k]) < 1e-6)"


@pytest.mark.slow
def test_the_map_turns_by_mouse_and_stays_turned(browser: Browser, page: Path) -> None:
    browser.open(page)
    before = browser.js(KEPT_EYE)
    scene = browser.driver.find_element(By.ID, "plot-map")
    browser.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", scene)

    def drag() -> None:
        held = ActionChains(browser.driver).move_to_element_with_offset(scene, 40, 60)
        held.click_and_hold().move_by_offset(120, 30).move_by_offset(80, 10).release().perform()

    browser.repeat(drag, f"Math.abs({KEPT_EYE}.x - ({before['x']})) > 0.05")
    drawn = f"{DRAWN.format('map')}.filter(t => t.visible === true).length"
    shown = browser.js(drawn)
    turned = browser.js(KEPT_EYE)
    switch(browser, figure_switch("map", "truth"))
    browser.wait(f"{drawn} !== {shown}")
    browser.wait(AT_REST)
    assert browser.js(KEPT_EYE) == pytest.approx(turned, abs=1e-6)


def test_the_map_turns_by_arrow_keys(browser: Browser) -> None:
    before = browser.js(KEPT_EYE)
    scene = browser.driver.find_element(By.ID, "plot-map")

    def press() -> None:
        browser.driver.execute_script("arguments[0].focus()", scene)
        ActionChains(browser.driver).send_keys(Keys.ARROW_LEFT).perform()

    browser.repeat(press, f"Math.abs({KEPT_EYE}.x - ({before['x']})) > 0.02")
    browser.wait(AT_REST)
    turned = browser.js(KEPT_EYE)
    radius = np.hypot(before["x"], before["y"])
    assert np.hypot(turned["x"], turned["y"]) == pytest.approx(radius, rel=1e-3)
    assert turned["z"] == pytest.approx(before["z"], abs=1e-6)


def test_axes_from_above_are_equal(browser: Browser) -> None:
    scale = (
        "(l => Math.abs(l.xaxis._length / (l.xaxis.range[1] - l.xaxis.range[0]) "
        "/ (l.yaxis._length / (l.yaxis.range[1] - l.yaxis.range[0]))))"
        "(document.getElementById('plot-above')._fullLayout)"
    )
    assert browser.js(scale) == pytest.approx(1.0, rel=1e-3)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_colours_are_readable(browser: Browser, scheme: str) -> None:
    browser.scheme(scheme)
    browser.wait(f"matchMedia('(prefers-color-scheme: {scheme})').matches")
    paper = colour(browser, "getComputedStyle(document.documentElement).backgroundColor")
    assert (luminance(paper) < 0.05) is (scheme == "dark")
    text = colour(browser, "getComputedStyle(document.body).color")
    assert contrast(text, paper) > 7.0
    tick = "getComputedStyle(document.querySelector('#plot-error .xtick text')).fill"
    browser.wait(f"{tick} === getComputedStyle(document.body).color")
    for i in range(10):
        browser.driver.execute_script(
            f"document.querySelector('.swatch').style.background = 'var(--e{i})'"
        )
        swatch = "getComputedStyle(document.querySelector('.swatch')).backgroundColor"
        assert contrast(colour(browser, swatch), paper) >= 3.0, i
    line = "getComputedStyle(document.querySelector('#plot-error .js-line')).stroke"
    assert contrast(colour(browser, line), paper) >= 3.0


def test_a_picture_opens_large_and_closes(browser: Browser) -> None:
    switch(browser, "button.enlarge")
    assert browser.js("document.getElementById('closer').open") is True
    assert browser.js("document.querySelector('#closer img').naturalWidth") > 0
    ActionChains(browser.driver).send_keys(Keys.ESCAPE).perform()
    browser.wait("!document.getElementById('closer').open")


def test_a_foreign_script_is_refused_by_the_page(browser: Browser) -> None:
    browser.complaints()
    browser.driver.execute_script(
        "const s = document.createElement('script'); s.textContent = 'window.ran = 1';"
        "document.body.append(s)"
    )
    assert browser.js("window.ran === undefined") is True
    assert any("Content Security Policy" in line for line in browser.complaints())


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_laptop_shows_tables_and_figures_whole(browser: Browser, scheme: str) -> None:
    browser.scheme(scheme)
    browser.size(*LAPTOP)
    browser.wait(f"({FARTHEST_PLOT}) <= {LAPTOP[0]}")
    assert browser.js("innerWidth") == LAPTOP[0]
    assert browser.js("document.documentElement.scrollWidth") <= LAPTOP[0]
    tables = browser.js(
        "[...document.querySelectorAll('.scroll')].map(b => [b.scrollWidth, b.clientWidth])"
    )
    assert tables
    assert all(content <= box for content, box in tables)
    narrowest = browser.js(
        "Math.min(...[...document.querySelectorAll('.plot')].map(p => p.clientWidth))"
    )
    assert narrowest > 300  # as wide as a phone shows it


def test_a_phone_scrolls_the_table_and_not_the_page(browser: Browser, page: Path) -> None:
    browser.size(*PHONE, phone=True)
    browser.open(page)
    browser.driver.execute_script(  # as a note with a long path in it
        "document.querySelector('.subtitle').insertAdjacentHTML("
        "'afterend', '<ul><li>/' + 'folder_'.repeat(20) + 'odometry.csv</li></ul>')"
    )
    assert browser.js("innerWidth") == PHONE[0]
    assert browser.js("document.documentElement.scrollWidth") <= PHONE[0]
    plots = browser.js(
        "[...document.querySelectorAll('.plot')].map(p => p.getBoundingClientRect().right)"
    )
    assert len(plots) == len(FIGURES)
    assert max(plots) <= PHONE[0]
    assert browser.js("getComputedStyle(document.querySelector('.scroll')).overflowX") == "auto"


# --------------------------------------------------------------------------------------------
# Other pages: after all tests of the first one, which takes seconds to load


def test_the_browser_does_see_errors_and_requests(offline: Browser, tmp_path: Path) -> None:
    """Guards the guards: a page that breaks the rules is noticed."""
    bad = tmp_path / "bad.html"
    bad.write_text('<script>nowhere()</script><img src="https://example.org/a.png">')
    offline.complaints(), offline.requests()
    offline.driver.get(bad.as_uri())
    assert any("nowhere is not defined" in line for line in offline.complaints())
    assert offline.requests() == ["https://example.org/a.png"]


def test_nothing_from_outside_is_run_or_taken_for_markup(offline: Browser, tmp_path: Path) -> None:
    data = full_report()
    hostile = dataclasses.replace(data.estimators[0], title=HOSTILE, remarks=(HOSTILE,))
    everything = dataclasses.replace(
        data,
        title=HOSTILE,
        subtitle=HOSTILE,
        notes=(HOSTILE,),
        estimators=(hostile, EstimatorReport.failed(HOSTILE + "2", "x", HOSTILE)),
        pictures=(Picture(HOSTILE, data.pictures[0].content), Picture(HOSTILE, b"no picture")),
        config_yaml=HOSTILE,
        versions={HOSTILE: HOSTILE},
    )
    offline.complaints()
    offline.open(write(tmp_path / "hostile.html", everything))
    assert offline.complaints() == []
    assert offline.js("document.querySelectorAll('body script').length") == 3
    assert offline.js("document.title") == HOSTILE
    assert offline.js("document.querySelector('h1').innerText") == HOSTILE
    assert offline.js(f"{DRAWN.format('time')}[0].name").count("&lt;script&gt;") == 1


def one_estimator() -> ReportData:
    rng, truth = np.random.default_rng(1), loop(12)
    return ReportData("one", "", (estimator_report("a", truth, rng, landmarks=0),), truth)


@pytest.mark.parametrize(
    ("name", "data", "said"),
    [
        ("no truth", without_truth(full_report()), "there is no ground truth"),
        ("one estimator without landmarks", one_estimator(), "(no landmarks)"),
        (
            "all failed",
            ReportData("x", "", (EstimatorReport.failed("a", "a", "diverged"),)),
            "No estimator gave a result.",
        ),
        ("no estimator", ReportData("x", "", ()), "No estimator gave a result."),
    ],
)
@pytest.mark.slow
def test_incomplete_runs_have_a_page(
    offline: Browser, tmp_path: Path, name: str, data: ReportData, said: str
) -> None:
    offline.complaints()
    offline.open(write(tmp_path / "incomplete.html", data))
    assert offline.complaints() == []
    assert said in offline.js("document.body.innerText")


# --------------------------------------------------------------------------------------------
# Contrast as the WCAG 2.2 defines it


def colour(browser: Browser, expression: str) -> tuple[float, ...]:
    text = browser.js(expression)
    assert text.startswith("rgb("), text
    return tuple(float(part) / 255.0 for part in text[4:-1].split(","))


def luminance(rgb: tuple[float, ...]) -> float:
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in rgb]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    bright, dim = sorted([luminance(a), luminance(b)], reverse=True)
    return (bright + 0.05) / (dim + 0.05)
