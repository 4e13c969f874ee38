"""Pictures of every page of a running service, at 1440 and 390 px, light and dark.

    python -m docs.screenshots http://127.0.0.1:8000 [--out docs/screens] [--only job home] [--subject studio]

Needs Chromium and its driver. Only jobs on the built-in subject are shown unless another one is named.
"""

from __future__ import annotations

import argparse
import io
import json
import re
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import Any

from PIL import Image
from selenium import webdriver

from services.bench.browser import HOW_TO_GET_ONE, open_browser

FLAGS = ("--hide-scrollbars", "--force-device-scale-factor=1")
WIDTHS = {"wide": 1440, "narrow": 390}
SCHEMES = ("light", "dark")
TALLEST = 12000
COMPARED = ("gauhuman", "rs-avatar", "mad-avatar", "oracle")
QUALITY = 84  # of a stored picture
NOBODY = "00000000-0000-0000-0000-000000000000"
PATIENCE = 60.0  # seconds that a page may take to draw itself
CALM = 1.0  # seconds without anything left to load
LEFT = """
for (const image of document.images) image.loading = 'eager';
const seen = (all) => [...document.querySelectorAll(all)].filter((node) => node.checkVisibility());
const images = seen('img').filter((image) => !image.complete || !image.naturalWidth || image.matches('.stale'));
const words = seen('[role=status], [role=log]').filter((node) => node.textContent.trim().endsWith('…'));
const blank = ['curves', 'time', 'overlay', 'log'].map((name) => `[data-${name}]:empty`);
const nodes = [...images, ...words, ...seen(['.chart:not(:has(.main-svg))', ...blank].join())];
const left = nodes.map((node) => node.alt || node.textContent.trim() || node.outerHTML.slice(0, 60));
if (document.readyState !== 'complete') left.push('the page itself');
if (document.fonts.status !== 'loaded') left.push('fonts');
return left;
"""
DIRECT = urllib.request.build_opener(urllib.request.ProxyHandler({}))


def ask(url: str) -> Any:
    """JSON of the service."""
    with DIRECT.open(url, timeout=20) as reply:
        return json.load(reply)


def pages(base: str, subject: str) -> dict[str, str]:
    """Name to address of everything that is to be shown; what has no example yet is left out."""
    found = {"home": "/", "jobs": "/jobs", "new": "/jobs/new", "grids": "/grids", "figures": "/figures"}
    found |= {
        "benchmarks": "/benchmarks",
        "subjects": "/subjects",
        "error": f"/jobs/{NOBODY}",
    }
    done = ask(f"{base}/api/v1/jobs?state=succeeded&subject={subject}&sort=-psnr&limit=200")["items"]
    best = {job["method"]: job["id"] for job in reversed(done)}
    if "rs-avatar" in best:
        found |= {"job": f"/jobs/{best['rs-avatar']}", "viewer": f"/jobs/{best['rs-avatar']}/viewer"}
    if len(compared := [best[method] for method in COMPARED if method in best]) > 1:
        found["compare"] = "/jobs/compare?" + "&".join(f"id={job}" for job in compared)
    if grids := ask(f"{base}/api/v1/grids?limit=1")["items"]:
        found["grid"] = f"/grids/{grids[0]['id']}"
    return found


def shoot(driver: webdriver.Chrome, url: str, width: int, scheme: str, path: Path) -> None:
    """One page, whole."""
    emulation = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", emulation)
    _size(driver, width, 900)
    driver.get(url)
    wait(driver, path.stem)
    wide = driver.execute_script("return document.documentElement.scrollWidth")
    if wide > width:
        print(f"  {path.stem}: scrolls sideways, {wide} px of {width}")
    for _ in range(2):  # some of a page grows with the window
        height = driver.execute_script("return document.documentElement.scrollHeight")
        _size(driver, width, min(int(height), TALLEST))
        wait(driver, path.stem)
    if height > TALLEST:
        print(f"  {path.stem}: cut, {height} px of {TALLEST}")
    path.parent.mkdir(parents=True, exist_ok=True)
    picture = Image.open(io.BytesIO(driver.get_screenshot_as_png())).convert("RGB")
    picture.save(path, quality=QUALITY, method=6) if path.suffix == ".webp" else picture.save(path)


def wait(driver: webdriver.Chrome, name: str) -> None:
    """Until nothing has been left to load for a moment; says what is still missing when patience ends."""
    end = time.monotonic() + PATIENCE
    calm = time.monotonic()
    while time.monotonic() < calm + CALM:
        if left := driver.execute_script(LEFT):
            calm = time.monotonic()
        if left and calm > end:
            print(f"  {name}: not there after {PATIENCE:g} s: {'; '.join(left)}")
            return
        time.sleep(0.2)


def _size(driver: webdriver.Chrome, width: int, height: int) -> None:
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)


def main() -> None:
    """Take all pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("base")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "screens")
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--subject", default="studio")
    parser.add_argument("--widths", nargs="*", default=list(WIDTHS), choices=list(WIDTHS))
    parser.add_argument("--schemes", nargs="*", default=list(SCHEMES), choices=list(SCHEMES))
    parser.add_argument("--suffix", default=".webp", choices=[".webp", ".png"])
    options = parser.parse_args()
    base = options.base.rstrip("/")
    with tempfile.TemporaryDirectory() as profile:
        driver = open_browser(Path(profile), *FLAGS)
        if driver is None:
            raise SystemExit(f"no browser here: {HOW_TO_GET_ONE}")
        for name, address in pages(base, options.subject).items():
            if options.only and name not in options.only:
                continue
            for width in options.widths:
                for scheme in options.schemes:
                    file = re.sub(r"[^a-z-]", "", f"{name}-{width}-{scheme}") + options.suffix
                    shoot(driver, base + address, WIDTHS[width], scheme, options.out / file)
        for entry in driver.get_log("browser"):
            print(f"  console: {entry['level']} {entry['message']}")
        driver.quit()


if __name__ == "__main__":
    main()
