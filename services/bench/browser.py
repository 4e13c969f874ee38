"""A real browser, without a window: Debian's Chromium, driven by its own driver."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from selenium import webdriver
from selenium.webdriver.chrome.options import Options
from selenium.webdriver.chrome.service import Service

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
HOW_TO_GET_ONE = "apt-get install chromium chromium-driver"
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--no-proxy-server",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)


def open_browser(profile: Path, *flags: str) -> webdriver.Chrome | None:
    """A fresh browser with its profile in ``profile``, which keeps its console and network logs; None without one."""
    binary = next(filter(None, map(shutil.which, BROWSERS)), None)
    programme = shutil.which("chromedriver")
    if binary is None or programme is None:
        return None
    options = Options()
    options.binary_location = binary
    for flag in (*FLAGS, *flags, f"--user-data-dir={profile}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    environment = {k: v for k, v in os.environ.items() if "proxy" not in k.lower()}
    found = webdriver.Chrome(options, Service(programme, env=environment))
    found.set_page_load_timeout(40)
    return found
