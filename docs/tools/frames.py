"""Pictures of a simulated session: docs/assets/live_*.webp, its page; report.webp.

Needs Chromium and its driver (Debian: chromium, chromium-driver) and the extras
live and dev. ``python docs/tools/frames.py``, two to three minutes.
"""

from __future__ import annotations

import base64
import io
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile
import time
from typing import Any

from PIL import Image
from selenium import webdriver

FOLDER = pathlib.Path(__file__).parents[1] / "assets"
SIZE = (1280, 800)
SHOWN = (960, 600)
LOADING = 6.0  # seconds until the scene is drawn
FEWEST, MOST = 12, 24  # frames
SECONDS = 0.5  # between two frames
SESSION = ("simulate", "calibrate", "--arm", "--zero", "--live", "--speedup", "0.1")


def browser(scheme: str) -> Any:
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or "chromium"
    for flag in (
        "--headless=new",
        "--no-sandbox",
        "--disable-dev-shm-usage",
        "--hide-scrollbars",
    ):
        options.add_argument(flag)
    service = webdriver.ChromeService(shutil.which("chromedriver"))
    page = webdriver.Chrome(options, service)
    feature = {"name": "prefers-color-scheme", "value": scheme}
    page.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
    size = {"width": SIZE[0], "height": SIZE[1], "deviceScaleFactor": 1}
    page.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size | {"mobile": False})
    return page


def frame(page: Any) -> Image.Image:
    shot = page.execute_cdp_cmd("Page.captureScreenshot", {})["data"]
    picture = Image.open(io.BytesIO(base64.b64decode(shot))).convert("RGB")
    return picture.resize(SHOWN)


def picture_of(report: pathlib.Path, page: Any) -> None:
    """The upper part of a report, as docs/assets/report.webp."""
    size = {"width": SIZE[0], "height": 1400, "deviceScaleFactor": 1, "mobile": False}
    page.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    page.get(report.as_uri())
    shot = page.execute_cdp_cmd("Page.captureScreenshot", {})["data"]
    picture = Image.open(io.BytesIO(base64.b64decode(shot))).convert("RGB")
    picture.resize((960, 1050)).save(FOLDER / "report.webp", quality=60, method=6)


def main() -> None:
    pages = {scheme: browser(scheme) for scheme in ("light", "dark")}
    found: dict[str, list[Image.Image]] = {scheme: [] for scheme in pages}
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "rig", *SESSION, "--out", folder]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as session:
            assert session.stdout is not None
            lines = (re.search(r"live page: (\S+)", line) for line in session.stdout)
            url = next(line[1] for line in lines if line)
            for page in pages.values():
                page.get(url)
            time.sleep(LOADING)
            while session.poll() is None:
                for scheme, page in pages.items():
                    found[scheme].append(frame(page))
                time.sleep(SECONDS)
            time.sleep(2.0)  # the page shows the end
            for scheme, page in pages.items():
                found[scheme].append(frame(page))
            (report,) = pathlib.Path(folder).glob("*/report.html")
            picture_of(report, pages["light"])
            for page in pages.values():
                page.quit()
    if (number := min(map(len, found.values()))) < FEWEST:
        sys.exit(
            f"{number} frames, at least {FEWEST} wanted: run it on an idle machine"
        )
    for scheme, (first, *rest) in found.items():
        rest = rest[:: max(1, len(rest) // MOST)] + rest[-1:]
        times = [350] * len(rest) + [4000]  # ms; the last stays
        first.save(
            FOLDER / f"live_{scheme}.webp", save_all=True, append_images=rest,
            duration=times, loop=0, quality=60, method=6,
        )  # fmt: skip


if __name__ == "__main__":
    main()
