"""A headless Chromium without any network, for pages that must work from a file alone."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from selenium import webdriver
from selenium.common.exceptions import TimeoutException
from selenium.webdriver.chrome.options import Options
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.chrome.webdriver import WebDriver
from selenium.webdriver.support.ui import WebDriverWait

_FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--disable-quic",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-default-apps",
    "--no-first-run",
    "--no-default-browser-check",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--hide-scrollbars",
    # No name is ever looked up, whatever the browser or a page asks for.
    "--host-resolver-rules=MAP * ~NOTFOUND",
)
_LOCAL = ("file:", "data:", "blob:", "about:", "chrome:", "chrome-untrusted:")
WIDE = (1400, 900)
LAPTOP = (1280, 800)
PHONE = (390, 844)


class Browser:
    """A page in a browser that is offline."""

    def __init__(self, driver: WebDriver) -> None:
        self.driver = driver
        self.size(*WIDE)
        self.driver.set_network_conditions(offline=True, latency=0, throughput=0)

    def size(self, width: int, height: int, *, phone: bool = False) -> None:
        """The window, or a phone's screen with its touch."""
        self.driver.execute_cdp_cmd(
            "Emulation.setDeviceMetricsOverride",
            {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": phone},
        )
        self.driver.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": phone})

    def scheme(self, name: str) -> None:
        """`light` or `dark`, as the user's system would ask for."""
        features = [{"name": "prefers-color-scheme", "value": name}]
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})

    def open(self, page: Path) -> None:
        """Loads a report and waits until its figures are drawn."""
        self.driver.get(page.resolve().as_uri())
        self.wait("document.documentElement.dataset.drawn === 'yes'")

    def assert_loads_quietly(self, page: Path) -> None:
        """A report loads without an error in the console and asks for nothing outside itself."""
        self.complaints(), self.requests()  # forget what came before
        self.open(page)
        assert self.complaints() == []
        assert self.requests() == []

    def js(self, expression: str) -> Any:
        """Value of a JavaScript expression."""
        return self.driver.execute_script(f"return {expression}")

    def wait(self, condition: str) -> None:
        """Until a JavaScript expression is true."""
        WebDriverWait(self.driver, 60.0, 0.05).until(lambda _: self.js(condition))

    def repeat(self, gesture: Callable[[], None], condition: str) -> None:
        """A gesture again and again until a JavaScript expression is true.

        A busy machine may lose a movement of the mouse or a key.
        """
        for _ in range(12):
            gesture()
            try:
                WebDriverWait(self.driver, 5.0, 0.05).until(lambda _: self.js(condition))
            except TimeoutException:
                continue
            return
        raise AssertionError(f"the gesture has no effect: not {condition}")

    def complaints(self) -> list[str]:
        """Errors in the console, of scripts and of the page's policy; reported once each."""
        return [
            entry["message"]
            for entry in self.driver.get_log("browser")  # type: ignore[no-untyped-call]
            if entry["level"] == "SEVERE"  # warnings are the software renderer's on its speed
        ]

    def requests(self) -> list[str]:
        """Addresses asked for that are not in the file itself."""
        messages = [
            json.loads(entry["message"])["message"]
            for entry in self.driver.get_log("performance")  # type: ignore[no-untyped-call]
        ]
        asked = [
            str(message["params"]["request"]["url"])
            for message in messages
            if message["method"] == "Network.requestWillBeSent"
        ]
        return [url for url in asked if not url.startswith(_LOCAL)]


@contextmanager
def browsing(profile: Path) -> Iterator[Browser]:
    """A browser with a profile of its own; skips the test where there is none."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    driver_path = shutil.which("chromedriver")
    if chromium is None or driver_path is None:
        pytest.skip("no chromium and chromedriver on the PATH: apt-get install chromium-driver")
    options = Options()
    options.binary_location = chromium
    for flag in (*_FLAGS, f"--user-data-dir={profile}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(driver_path))
    try:
        yield Browser(driver)
    finally:
        driver.quit()
