"""A page in a real browser: headless Chromium loads it and runs a script in it."""

import html
import os
import re
import shutil
import subprocess
from base64 import b64encode
from hashlib import sha256
from pathlib import Path

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
CHROMIUM = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
SWITCHES = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-component-update",
    "--disable-background-networking", "--disable-sync", "--disable-dev-shm-usage", "--virtual-time-budget=5000",
    "--enable-logging=stderr",
)  # fmt: skip

needs_browser = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium here: install the package chromium, or name the program in $CHROMIUM"
)


def run_in(page: Path, script: str, folder: Path, *switches: str) -> tuple[str, list[str]]:
    """What a script at the end of a page makes its title, and the browser's lines: errors, what the policy blocked.

    The page's policy is told of the script. ``folder``, of the test's own, is for the browser, as ``switches`` are.
    """
    assert CHROMIUM is not None
    digest = b64encode(sha256(script.encode()).digest()).decode()
    text = page.read_text(encoding="utf-8").replace("script-src ", f"script-src 'sha256-{digest}' ", 1)
    copy = folder / "page.html"
    copy.write_text(text.replace("</body>", f"<script>{script}</script></body>"), encoding="utf-8")
    command = [CHROMIUM, *SWITCHES, *switches, f"--user-data-dir={folder / 'profile'}", "--dump-dom", copy.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    title = re.search(r"<title>(.*?)</title>", done.stdout, re.S)
    assert title
    return html.unescape(title[1]), [line for line in done.stderr.splitlines() if ":CONSOLE" in line]
