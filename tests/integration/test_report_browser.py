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

from fgslam.report.content import ON_LIGHT, Picture
from fgslam.report.page import write_report
from fgslam.report.results import EstimatorReport, ReportData

FIGURES = ("above", "map", "error", "axes", "nees", "time")
FARTHEST_PLOT = (
    "Math.max(...[...document.querySelectorAll('.plot')].map(p => p.getBoundingClientRect().right))"
)
WHITE = (1.0, 1.0, 1.0)
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
    """The full report on a wide screen in light colours."""
    offline.size(*WIDE)
    offline.scheme("light")
    if offline.driver.current_url != page.as_uri():
        offline.open(page)  # takes seconds
    return offline


def write(path: Path, data: ReportData) -> Path:
    write_report(path, data)
    return path


def visible(browser: Browser, figure: str) -> list[str]:
    """Names of the traces that a figure shows."""
    return browser.js(f"{DRAWN.format(figure)}.filter(t => t.visible === true).map(t => t.name)")


def click_legend(browser: Browser, figure: str, name: str) -> None:
    """Clicks an entry of a figure's legend as a person would."""
    entry = browser.js(
        f"[...document.querySelectorAll('#plot-{figure} .traces')]"
        f".find(e => e.textContent === '{name}').querySelector('.legendtoggle')"
    )
    browser.driver.execute_script(
        "arguments[0].closest('.plot').scrollIntoView({block: 'center'})", entry
    )
    ActionChains(browser.driver).move_to_element(entry).click().perform()


def test_page_loads_offline_without_error_or_request(offline: Browser, page: Path) -> None:
    browser = offline
    browser.assert_loads_quietly(page)
    for figure in FIGURES:
        assert browser.js(f"{DRAWN.format(figure)}.length") >= 2
    assert browser.js("document.querySelectorAll('#plot-map canvas').length") >= 1
    assert browser.js("navigator.onLine") is False


def test_the_legend_hides_and_shows_what_it_names(browser: Browser) -> None:
    name = "landmarks of landmark_kalman"
    before = visible(browser, "above")
    for now in (name not in before, name in before):
        click_legend(browser, "above", name)
        browser.wait(
            f"{DRAWN.format('above')}.some(t => t.name === '{name}' && "
            f"(t.visible === true) === {str(now).lower()})"
        )
    assert visible(browser, "above") == before


def test_scales_are_linear_or_logarithmic(browser: Browser) -> None:
    kind = "document.getElementById('plot-error')._fullLayout.yaxis.type"
    assert browser.js(kind) == "linear"
    for button, expected in ((1, "log"), (0, "linear")):
        found = browser.driver.find_elements(By.CSS_SELECTOR, "#plot-error .updatemenu-button")
        ActionChains(browser.driver).move_to_element(found[button]).click().perform()
        browser.wait(f"{kind} === '{expected}'")


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
    for name in ON_LIGHT:  # figures are drawn on white paper in any scheme
        assert contrast(tuple(int(name[k : k + 2], 16) / 255.0 for k in (1, 3, 5)), WHITE) >= 3.0


def test_a_picture_opens_large_and_closes(browser: Browser) -> None:
    summary = browser.driver.find_element(By.CSS_SELECTOR, ".gallery summary")
    width = "document.querySelector('.gallery img').clientWidth"
    small = browser.js(width)
    summary.click()
    browser.wait(f"{width} > 1.5 * {small}")
    summary.click()
    browser.wait(f"{width} === {small}")


def test_the_slider_moves_map_errors_and_image_by_keyboard(browser: Browser, page: Path) -> None:
    def scroll_to(figure: str) -> None:
        browser.driver.execute_script(f"document.getElementById('plot-{figure}').scrollIntoView()")

    scroll_to("above")
    now = f"{DRAWN.format('above')}.at(-1)"
    end = full_report().estimators[1].final_poses[-1, 2, 3]
    assert browser.js(f"{now}.y[1]") == pytest.approx(end, abs=1e-3)
    step = browser.driver.find_element(By.ID, "step")
    browser.repeat(lambda: step.send_keys(Keys.HOME), f"{now}.y[1] === 0")
    assert browser.js("document.getElementById('when').value") == "0.00 s"
    assert browser.js("document.getElementById('view').src").startswith("data:image/jpeg;base64,")
    step.send_keys(Keys.ARROW_RIGHT)
    browser.wait("document.getElementById('when').value === '0.25 s'")
    scroll_to("error")
    browser.wait("document.getElementById('plot-error').layout.shapes?.[0]?.x0 === 0.25")


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
        ("one estimator without landmarks", one_estimator(), "a is off by"),
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
