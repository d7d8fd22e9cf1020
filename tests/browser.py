"""A page in a real browser: headless Chromium loads it, runs a script in it, and gives the document it ends with."""

import html
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
CHROMIUM = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
SWITCHES = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-component-update",
    "--disable-background-networking", "--disable-sync", "--disable-dev-shm-usage", "--virtual-time-budget=5000",
)  # fmt: skip

needs_browser = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium here: install the package chromium, or name the program in $CHROMIUM"
)


def document_of(page: Path, fragment: str, folder: Path, script: str = "") -> str:
    """The document after loading ``page#fragment``.

    Args:
        page: an HTML file.
        fragment: what follows the ``#`` of the address.
        folder: of the test's own, for the browser's profile and a copy of the page.
        script: run at the end of the page; what it puts into ``document.title`` is the copy's title.
    """
    assert CHROMIUM is not None
    copy = folder / "page.html"
    text = page.read_text(encoding="utf-8")
    copy.write_text(text.replace("</body>", f"<script>{script}</script></body>"), encoding="utf-8")
    address = f"{copy.as_uri()}#{fragment}"
    command = [CHROMIUM, *SWITCHES, f"--user-data-dir={folder / 'profile'}", "--dump-dom", address]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    return done.stdout


def title_of(document: str) -> str:
    """What the script reported."""
    found = re.search(r"<title>(.*?)</title>", document, re.S)
    assert found
    return html.unescape(found[1])
