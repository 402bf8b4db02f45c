"""The Chromium in which tests open the report's page: what is installed, under any of its names."""

import os
import shutil
from itertools import chain
from pathlib import Path

NAMES = ("chromium", "chromium-browser", "chromium-headless-shell", "google-chrome", "google-chrome-stable")
PLAYWRIGHT = ("chromium*/chrome-linux*/chrome", "chromium*/chrome-*linux*/*headless*shell")


def find_chromium() -> str | None:
    """Path of a Chromium: that of the variable ``CHROMIUM``, else of the PATH, else one that Playwright brought."""
    if named := os.environ.get("CHROMIUM"):
        return named
    brought = Path(os.environ.get("PLAYWRIGHT_BROWSERS_PATH", Path.home() / ".cache" / "ms-playwright"))
    unpacked = (str(path) for pattern in PLAYWRIGHT for path in sorted(brought.glob(pattern), reverse=True))
    return next(chain(filter(None, map(shutil.which, NAMES)), unpacked), None)
