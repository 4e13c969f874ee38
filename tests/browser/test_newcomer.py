"""From a service that has run nothing to a wipe that moves: as few clicks as promised."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from selenium import webdriver
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.wait import WebDriverWait

from services.demo import free_port
from tests.browser.conftest import REAL
from tests.browser.test_dashboard import loaded, one
from tests.system.harness import Host

PATIENCE = 300.0  # seconds: the built-in subject is made first
MOST_CLICKS = 3


@pytest.fixture(scope="module")
def fresh(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Host]:
    """A service on a new home, as ``make up`` starts it."""
    with ExitStack() as stack:
        host = Host(tmp_path_factory.mktemp("fresh"), free_port(), child_command=REAL, threads_per_job=1)
        stack.callback(host.close)
        for name in ("redis", "api", "worker"):
            host.start(name)
        yield host


class Visitor:
    """Somebody who reads, clicks what is in sight, and is counted."""

    def __init__(self, driver: webdriver.Chrome) -> None:
        self.driver = driver
        self.clicks = 0

    def click(self, words: str) -> None:
        """Press the link or button that says ``words``."""
        found = self.driver.find_element(By.XPATH, f"//main//*[self::a or self::button][normalize-space()='{words}']")
        self.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", found)
        found.click()
        self.clicks += 1

    def wait_for(self, selector: str) -> None:
        """Read on until it is there."""
        WebDriverWait(self.driver, PATIENCE, 0.2).until(lambda d: d.find_elements(By.CSS_SELECTOR, selector))

    def wipe(self) -> None:
        """Move the slider by keyboard, once its two pictures are there."""
        WebDriverWait(self.driver, PATIENCE, 0.2).until(loaded)
        slider = one(self.driver, "[data-wipe]")
        self.driver.execute_script("arguments[0].focus()", slider)
        slider.send_keys(Keys.HOME)
        assert "100%" in self.driver.execute_script("return document.querySelector('.over').style.clipPath")
        assert slider.is_displayed()


def test_a_newcomer_needs_few_clicks_to_move_the_wipe(driver: webdriver.Chrome, fresh: Host) -> None:
    visitor = Visitor(driver)
    driver.get(f"{fresh.settings.url}/")
    visitor.click("Run the first job")
    visitor.wait_for("[name=preset][value=smoke]:checked")
    visitor.click("Submit job")
    visitor.wait_for("article[data-state=succeeded] [data-heat]")  # the page takes the result in by itself
    visitor.wipe()
    assert visitor.clicks <= MOST_CLICKS


def test_from_a_result_on_the_overview_it_is_one_click(driver: webdriver.Chrome, fresh: Host) -> None:
    visitor = Visitor(driver)
    driver.get(f"{fresh.settings.url}/")
    visitor.click("RS-Avatar (ours)")
    visitor.wipe()
    assert visitor.clicks == 1
