"""The dashboard in a real browser: submit, watch, wipe, and nothing that leaves the house."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from selenium import webdriver
from selenium.common.exceptions import StaleElementReferenceException
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.remote.webelement import WebElement
from selenium.webdriver.support.wait import WebDriverWait

from tests.browser.conftest import SUBJECT, Site

PATIENCE = 120.0
AUDIT = Path(__file__).with_name("audit.js").read_text(encoding="utf-8")
EXPECTED = ("favicon", " 422 ")  # a form that was refused is no defect
OWN = ("data:", "blob:", "about:", "chrome:", "devtools:")


@pytest.fixture
def browser(driver: webdriver.Chrome, site: Site) -> Iterator[webdriver.Chrome]:
    """The browser; afterwards it must have asked nobody else, and must not have complained."""
    for log in ("browser", "performance"):
        driver.get_log(log)
    yield driver
    asked = [json.loads(entry["message"])["message"] for entry in driver.get_log("performance")]
    urls = [m["params"]["request"]["url"] for m in asked if m["method"] == "Network.requestWillBeSent"]
    foreign = [u for u in urls if not u.startswith(OWN) and urlsplit(u).netloc != urlsplit(site.url).netloc]
    assert foreign == []
    complaints = [e["message"] for e in driver.get_log("browser") if e["level"] in {"SEVERE", "WARNING"}]
    assert [c for c in complaints if not any(word in c for word in EXPECTED)] == []
    driver.get("about:blank")


def wait(browser: webdriver.Chrome, look: Callable[[webdriver.Chrome], Any]) -> Any:
    return WebDriverWait(browser, PATIENCE, 0.1).until(look)


def one(browser: webdriver.Chrome, selector: str) -> WebElement:
    return browser.find_element(By.CSS_SELECTOR, selector)


def press(browser: webdriver.Chrome, selector: str) -> None:
    """A click where a person would see it; a list that is just being drawn again is waited for."""

    def clicked(browser: webdriver.Chrome) -> bool:
        browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", one(browser, selector))
        one(browser, selector).click()
        return True

    WebDriverWait(browser, PATIENCE, 0.1, [StaleElementReferenceException]).until(clicked)


def loaded(browser: webdriver.Chrome) -> bool:
    """Whether the wipe shows two pictures."""
    script = """const panes = [...document.querySelectorAll('.pane')];
    return panes.length === 2 && document.querySelector('[data-note]').textContent === '' && panes.every((p) => {
      const image = p.querySelector('img'); return image.hidden || (image.complete && image.naturalWidth > 0); });"""
    return bool(browser.execute_script(script))


def test_ticks_of_values_that_differ_by_a_rounding_error_end(browser: webdriver.Chrome, site: Site) -> None:
    browser.get(f"{site.url}/figures")
    script = (
        "const done = arguments[2]; import('/static/plot.js').then((m) => done(m.ticks(arguments[0], arguments[1])))"
    )
    for low, high in ((0.1, 0.1 + 2e-17), (0.1, 0.10000000000000002), (7.0, 7.0), (0.0, 0.0), (-1.0, 1.0)):
        found = browser.execute_async_script(script, low, high)
        assert len(found) <= 6
        assert all(low - 1e-8 <= tick <= high + 1e-8 for tick in found)


def test_a_job_goes_from_the_form_to_its_pictures_by_itself(browser: webdriver.Chrome, site: Site) -> None:
    browser.get(f"{site.url}/")
    press(browser, "a[href='/jobs/new']")
    for name, value in (("method", "rs-avatar"), ("subject", SUBJECT), ("preset", "smoke")):
        press(browser, f"input[name={name}][value={value}]")
    press(browser, "details:has([name=iterations]) > summary")
    one(browser, "[name=iterations]").send_keys("-5")
    press(browser, "[type=submit]")
    wait(browser, lambda b: one(b, "[data-field-box=iterations] .fault").is_displayed())
    assert "1" in one(browser, "[data-field-box=iterations] .fault").text
    one(browser, "[name=iterations]").clear()
    one(browser, "[name=iterations]").send_keys("60")
    press(browser, "details:has([name=T]) > summary")
    one(browser, "[name=T]").send_keys("half")
    press(browser, "[type=submit]")
    wait(browser, lambda b: "got 'half'" in one(b, "[data-field-box=T] .fault").text)
    one(browser, "[name=T]").clear()
    press(browser, "[type=submit]")
    wait(browser, lambda b: b.find_elements(By.CSS_SELECTOR, "article[data-job]"))
    wait(browser, lambda b: one(b, "article").get_attribute("data-state") == "succeeded")
    wait(browser, lambda b: b.find_elements(By.CSS_SELECTOR, "[data-heat] button"))  # the page has taken the result in
    wait(browser, loaded)
    assert one(browser, "[data-heat] button").is_displayed()
    assert one(browser, ".lead-figure dd").text.strip().endswith("dB")
    wait(browser, lambda b: len(b.find_elements(By.CSS_SELECTOR, "figure.curve path")) >= 2)
    wait(browser, lambda b: b.find_elements(By.CSS_SELECTOR, "[data-time] .plot-truth, [data-time] .plot-found"))


def test_the_wipe_moves_by_keyboard_and_the_map_opens_a_frame(
    browser: webdriver.Chrome, site: Site, jobs: dict[str, str]
) -> None:
    browser.get(f"{site.url}/jobs/{jobs['rs-avatar']}")
    wait(browser, loaded)
    wipe = one(browser, "[data-wipe]")
    assert "RS-Avatar" in wipe.get_attribute("aria-label")
    assert "truth" in wipe.get_attribute("aria-label")
    cut = lambda: browser.execute_script("return document.querySelector('.over').style.clipPath")  # noqa: E731
    before = cut()
    browser.execute_script("arguments[0].focus()", wipe)
    for _ in range(20):
        wipe.send_keys(Keys.ARROW_RIGHT)
    assert float(wipe.get_attribute("value")) == 60.0
    assert cut() == "inset(0px 40% 0px 0px)" != before
    wipe.send_keys(Keys.HOME)
    assert "100%" in cut()
    cell = browser.find_elements(By.CSS_SELECTOR, "[data-heat] button")[-1]
    browser.execute_script("arguments[0].focus()", cell)
    cell.send_keys(Keys.ENTER)
    wait(browser, lambda b: one(b, "[data-frame-out]").text == cell.get_attribute("data-frame"))
    assert one(browser, "[data-camera-select]").get_attribute("value") == cell.get_attribute("data-camera")
    wait(browser, lambda _: cell.get_attribute("aria-pressed") == "true")


def test_a_training_camera_shows_input_and_error(browser: webdriver.Chrome, site: Site, jobs: dict[str, str]) -> None:
    browser.get(f"{site.url}/jobs/{jobs['rs-avatar']}")
    wait(browser, loaded)
    show = """const s = document.querySelector(arguments[0]); s.value = [...s.options].find((o) =>
      o.value.includes(arguments[1])).value; s.dispatchEvent(new Event('change'));"""
    browser.execute_script(show, "[data-camera-select]", "04")
    wait(browser, lambda b: "input" in one(b, "[data-layer=left]").text)
    browser.execute_script(show, "[data-layer=left]", ":input")
    wait(browser, lambda b: "input" in one(b, "[data-tag=left]").text)
    browser.execute_script(show, "[data-layer=right]", ":error")
    spread = """const c = document.querySelector('[data-pane=right] canvas');
      if (c.hidden || !c.width) return 0;
      const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
      return new Set(d).size;"""
    wait(browser, lambda b: b.execute_script(spread) > 10)


def test_the_list_follows_jobs_it_did_not_know(browser: webdriver.Chrome, site: Site, jobs: dict[str, str]) -> None:
    browser.get(f"{site.url}/jobs")
    wait(browser, lambda b: one(b, "#link").text == "live")
    spec = {"method": "gauhuman", "subject": SUBJECT, "preset": "smoke", "iterations": 100_000, "seed": 7}
    job = site.client.post("/api/v1/jobs", json=spec).json()["id"]
    row = f"tr[data-job='{job}']"
    wait(browser, lambda b: b.find_elements(By.CSS_SELECTOR, row))
    press(browser, f"{row} [data-verb=cancel]")
    shown = "return document.querySelector(arguments[0])?.textContent"
    wait(browser, lambda b: b.execute_script(shown, f"{row} [data-field=state]") == "cancelled")
    for other in list(jobs.values()):
        press(browser, f"tr[data-job='{other}'] input[type=checkbox]")
    press(browser, "[data-compare]")
    wait(browser, loaded)
    assert "2 jobs" in one(browser, "h1").text


def test_pages_can_be_read_by_everybody(browser: webdriver.Chrome, site: Site, jobs: dict[str, str]) -> None:
    """Names, roles, contrast and width, light and dark, wide and narrow."""
    ours = jobs["rs-avatar"]
    urls = ["/", "/jobs", "/jobs/new", f"/jobs/{ours}", "/grids", "/benchmarks", "/subjects"]
    urls += [f"/jobs/compare?id={ours}&id={jobs['gauhuman']}"]
    faults = {}
    for url in urls:
        browser.get(site.url + url)
        wait(browser, lambda b: b.execute_script("return document.readyState") == "complete")
        for scheme, width in (("light", 1280), ("dark", 390)):
            emulation = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
            browser.execute_cdp_cmd("Emulation.setEmulatedMedia", emulation)
            size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
            browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
            if found := browser.execute_script(AUDIT):
                faults[url, scheme, width] = found
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
    assert not faults, json.dumps({str(where): found for where, found in faults.items()}, indent=1)


def test_charts_are_drawn_under_the_policy(browser: webdriver.Chrome, site: Site) -> None:
    browser.get(f"{site.url}/benchmarks")
    wait(browser, lambda b: len(b.find_elements(By.CSS_SELECTOR, ".chart .main-svg")) > 0)


def test_the_wipe_is_three_clicks_from_the_start(browser: webdriver.Chrome, site: Site, jobs: dict[str, str]) -> None:
    browser.get(f"{site.url}/")
    press(browser, f"a[href='/jobs/{jobs['rs-avatar']}']")
    wait(browser, loaded)
    assert one(browser, "[data-wipe]").is_displayed()


def test_both_replicas_have_served(site: Site, jobs: dict[str, str]) -> None:
    assert len(site.front.served) == 2
    assert min(site.front.served.values()) > 1
