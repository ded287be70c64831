"""The page of homing runs in a real browser that is offline: it draws, its moments move."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from browser import PHONE, Browser, browsing
from homing_pages import page
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By

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


def test_play_moves_the_robot_to_the_end_and_the_slider_with_it(browser: Browser) -> None:
    assert robot(browser)[1] == pytest.approx(0.0, abs=1e-6)
    play = browser.driver.find_element(By.CSS_SELECTOR, "#plot-local-map .updatemenu-button")
    browser.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", play)
    ActionChains(browser.driver).move_to_element(play).click().perform()
    layout = "document.getElementById('plot-local-map')._fullLayout"
    browser.wait(f"{layout}.sliders[0].active === 8")
    assert robot(browser)[1] == pytest.approx(8 / 9, abs=1e-6)


def test_page_fits_on_a_phone(browser: Browser) -> None:
    browser.size(*PHONE, phone=True)
    assert browser.js("document.documentElement.scrollWidth") <= PHONE[0]
