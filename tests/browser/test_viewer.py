"""The avatar in a real browser: what WebGL draws is what the kernels draw, and everything works from the keyboard."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Iterator
from contextlib import suppress
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image
from selenium import webdriver
from selenium.common.exceptions import TimeoutException
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

from tests.browser.conftest import Site
from tests.browser.test_dashboard import AUDIT, OWN, one, wait

REMARKS = ("GPU stall due to ReadPixels", "software WebGL", "favicon")  # on our looking at a canvas, without a GPU
SIZE = 256
DRAW = """
const [job, { size, azimuth, elevation, time, shutter }, done] = arguments;
(async () => {
  const { parseScene } = await import("/static/posing.js");
  const { SplatView, orbitCamera, slotsOf } = await import("/static/splats.js");
  const scene = parseScene(await (await fetch(`/api/v1/jobs/${job}/scene`)).arrayBuffer());
  const canvas = Object.assign(document.createElement("canvas"), { width: size, height: size });
  const slots = slotsOf(shutter, time, scene.readout / scene.period);
  new SplatView(canvas, scene).draw(orbitCamera(scene, azimuth, elevation, 1), slots);
  done(canvas.toDataURL("image/png"));
})().catch((error) => done(`error ${error}`));
"""


@pytest.fixture
def browser(driver: webdriver.Chrome, site: Site) -> Iterator[webdriver.Chrome]:
    """The browser; afterwards it must have asked nobody else, and must not have complained."""
    for log in ("browser", "performance"):
        driver.get_log(log)
    driver.set_script_timeout(120)
    yield driver
    asked = [json.loads(entry["message"])["message"] for entry in driver.get_log("performance")]
    urls = [m["params"]["request"]["url"] for m in asked if m["method"] == "Network.requestWillBeSent"]
    assert [u for u in urls if not u.startswith(OWN) and urlsplit(u).netloc != urlsplit(site.url).netloc] == []
    complaints = [e["message"] for e in driver.get_log("browser") if e["level"] in {"SEVERE", "WARNING"}]
    assert [c for c in complaints if not any(word in c for word in REMARKS)] == []
    driver.get("about:blank")


def on_black(data: bytes) -> np.ndarray:
    rgba = np.asarray(Image.open(io.BytesIO(data)).convert("RGBA")).astype(float) / 255
    return rgba[..., :3] * rgba[..., 3:]


def opened(browser: webdriver.Chrome, site: Site, job: str) -> None:
    """The viewer, with the Gaussians drawn."""
    browser.get(f"{site.url}/jobs/{job}/viewer")
    wait(browser, lambda b: int(one(b, "#stage").get_attribute("data-drawn") or 0) > 0)


LOOKS = (
    {"shutter": "global", "time": 2, "azimuth": 0, "elevation": 0},
    {"shutter": "rolling", "time": 1.4, "azimuth": 50, "elevation": 25},
    {"shutter": "bands:3", "time": 3.2, "azimuth": -120, "elevation": -10},
    {"shutter": "blur:5", "time": 2.5, "azimuth": 20, "elevation": 0},
)


@pytest.mark.parametrize("look", LOOKS, ids=lambda look: str(look["shutter"]))
def test_webgl_draws_what_the_kernels_draw(
    browser: webdriver.Chrome, site: Site, jobs: dict[str, str], look: dict[str, object]
) -> None:
    job, look = jobs["rs-avatar"], {**look, "size": SIZE}
    browser.get(f"{site.url}/jobs")
    drawn = browser.execute_async_script(DRAW, job, look)
    assert drawn.startswith("data:image/png;base64,"), drawn
    seen = on_black(base64.b64decode(drawn.partition(",")[2]))
    reply = site.client.get(f"/api/v1/jobs/{job}/render", params=look, timeout=120.0)
    assert reply.status_code == 200, reply.text
    rendered = on_black(reply.content)
    body = rendered.sum(-1) > 0.02
    assert body.sum() > 500
    error = float(np.square(seen - rendered)[body].mean())
    assert -10 * np.log10(error) > 35  # bytes, half-floats and a sort by means: 48 dB was measured on real avatars


def test_the_stage_is_not_blank_and_turns_by_keyboard(
    browser: webdriver.Chrome, site: Site, jobs: dict[str, str]
) -> None:
    opened(browser, site, jobs["rs-avatar"])
    canvas = one(browser, "#stage")
    assert canvas.is_displayed()
    assert not one(browser, "#poster").is_displayed()

    def pixels() -> np.ndarray:
        data = browser.execute_script("return document.getElementById('stage').toDataURL('image/png')")
        return on_black(base64.b64decode(data.partition(",")[2]))

    before = pixels()
    assert (before.max(-1) > 0.05).sum() > 1000
    browser.execute_script("arguments[0].focus()", canvas)
    for key in (Keys.ARROW_LEFT, Keys.ARROW_LEFT, Keys.ARROW_UP, "+", "."):
        canvas.send_keys(key)
    wait(browser, lambda b: one(b, "#time-out").text.startswith("frame 0.1"))
    assert one(browser, "#azimuth-out").text == "10°"
    assert one(browser, "#elevation-out").text == "5°"
    assert one(browser, "#zoom-out").text == "1.10×"
    wait(browser, lambda _: np.abs(pixels() - before).mean() > 1e-3)
    canvas.send_keys(Keys.SPACE)
    wait(browser, lambda b: one(b, "#play").get_attribute("aria-pressed") == "true")
    wait(browser, lambda b: float(one(b, "#time").get_attribute("value")) > 1)
    canvas.send_keys(Keys.SPACE)
    wait(browser, lambda b: "azimuth=10" in b.current_url)  # the address holds the view
    assert "azimuth 10°" in one(browser, "#said").get_attribute("textContent")


EXPOSURES = "return [...document.querySelectorAll('[data-exposure]')].map((i) => [i.src, i.complete && i.naturalWidth])"


def settled(browser: webdriver.Chrome, words: str) -> None:
    """Wait until all three exposures are sharp and of the address with ``words``."""
    seen: list[list[object]] = []

    def shown(browser: webdriver.Chrome) -> bool:
        seen[:] = browser.execute_script(EXPOSURES)
        return len(seen) == 3 and all(words in str(src) and width == 448 for src, width in seen)

    with suppress(TimeoutException):
        wait(browser, shown)
    assert shown(browser), seen


def test_the_readout_slider_moves_the_three_exposures(
    browser: webdriver.Chrome, site: Site, jobs: dict[str, str]
) -> None:
    opened(browser, site, jobs["rs-avatar"])
    settled(browser, "readout=8.8&")
    slider = one(browser, "#readout")
    browser.execute_script("arguments[0].focus()", slider)
    slider.send_keys(Keys.HOME)
    settled(browser, "readout=0&")
    one(browser, "input[name=shutter][value=rolling]").send_keys(Keys.SPACE)
    wait(browser, lambda b: one(b, "#clock").get_attribute("data-shutter") == "rolling")


def test_a_method_without_motion_says_so(browser: webdriver.Chrome, site: Site, jobs: dict[str, str]) -> None:
    opened(browser, site, jobs["gauhuman"])
    assert one(browser, "#still-note").is_displayed()


@pytest.mark.parametrize("width", [1280, 390])
def test_viewer_and_gallery_can_be_read_by_everybody(
    browser: webdriver.Chrome, site: Site, jobs: dict[str, str], width: int
) -> None:
    browser.set_window_size(width, 1000)
    for path in (f"/jobs/{jobs['rs-avatar']}/viewer", "/figures"):
        browser.get(f"{site.url}{path}")
        wait(browser, lambda b: b.execute_script("return document.readyState") == "complete")
        assert browser.execute_script(AUDIT) == [], path
        assert browser.execute_script("return document.documentElement.scrollWidth - innerWidth") <= 0, path
    browser.set_window_size(1280, 1000)


def test_the_gallery_draws_its_figures(browser: webdriver.Chrome, site: Site, jobs: dict[str, str]) -> None:
    browser.get(f"{site.url}/figures")
    browser.execute_script("for (const image of document.images) image.loading = 'eager'")
    widths = "return [...document.querySelectorAll('.plate img')].map((i) => i.complete ? i.naturalWidth : 0)"
    wait(browser, lambda b: all(width > 900 for width in b.execute_script(widths)))
    assert len(browser.find_elements(By.CSS_SELECTOR, ".plate img")) >= 4
    assert "ablation flag" in one(browser, "#ablation .empty").text
