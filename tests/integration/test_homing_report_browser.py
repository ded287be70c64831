"""The page of homing runs in a real browser that is offline: it draws, its moments move."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from browser import PHONE, Browser, browsing
from homing_pages import page
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

from fgslam.report.page import write_html

FIGURES = ("local-map", "drive", "direction", "claimed", "catchment")
DRAWN = "document.getElementById('plot-{}')._fullData"


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    folder: Path = tmp_path_factory.mktemp("homing")
    write_html(folder / "report.html", page())
    with browsing(folder) as found:
        found.assert_loads_quietly(folder / "report.html")
        yield found


def robot(browser: Browser) -> list[float]:
    """Where the local map shows the robot now."""
    found = (
        f"[...{DRAWN.format('local-map')}].filter(t => t.name === 'robot' && t.mode === 'markers')"
        ".map(t => [t.x[0], t.y[0]])"
    )
    (place,) = browser.js(found)
    return [float(v) for v in place]


def test_every_figure_is_drawn(browser: Browser) -> None:
    for figure in FIGURES:
        assert browser.js(f"{DRAWN.format(figure)}.length") >= 1, figure


def test_the_slider_moves_the_robot_and_one_moment_is_drawn(browser: Browser) -> None:
    assert robot(browser)[1] == pytest.approx(0.0, abs=1e-6)
    slider = browser.driver.find_element(
        By.CSS_SELECTOR, 'input[type="range"][data-figure="local-map"]'
    )
    for _ in range(6):
        slider.send_keys(Keys.ARROW_RIGHT)
    browser.wait(f"{DRAWN.format('local-map')}.some(t => t.name === 'lost feature')")
    assert robot(browser)[1] == pytest.approx(6 / 9, abs=1e-6)
    assert browser.js("document.querySelector('.moments output').textContent") == "3.0 s"


def test_play_runs_to_the_end_and_stops(browser: Browser) -> None:
    button = browser.driver.find_element(By.CSS_SELECTOR, 'button[data-play="local-map"]')
    browser.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", button)
    button.click()
    browser.wait("document.querySelector('button[data-play=\"local-map\"]').textContent === 'Play'")
    assert robot(browser)[1] == pytest.approx(8 / 9, abs=1e-6)


def test_a_switch_hides_what_it_names(browser: Browser) -> None:
    switch = 'input[data-figure="local-map"][data-switch="ellipses"]'
    shown = f"{DRAWN.format('local-map')}.some(t => t.visible === true && /sigma/.test(t.name))"
    assert browser.js(shown) is True
    box = browser.driver.find_element(By.CSS_SELECTOR, switch)
    browser.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", box)
    box.click()
    browser.wait(f"!({shown})")


def test_page_fits_on_a_phone(browser: Browser) -> None:
    browser.size(*PHONE, phone=True)
    assert browser.js("document.documentElement.scrollWidth") <= PHONE[0]
