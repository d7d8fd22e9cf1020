"""A page in a real browser: headless Chromium loads it, runs a script in it, and gives the document it ends with."""

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


def document_of(page: Path, fragment: str, folder: Path, script: str = "") -> str:
    """The document after loading ``page#fragment``.

    Args:
        page: an HTML file.
        fragment: what follows the ``#`` of the address.
        folder: of the test's own, for the browser's profile and a copy of the page.
        script: run at the end of the page, whose policy is told so; what it puts into ``document.title`` is the copy's
            title.
    """
    digest = b64encode(sha256(script.encode()).digest()).decode()
    text = page.read_text(encoding="utf-8").replace("script-src ", f"script-src 'sha256-{digest}' ", 1)
    return loaded(text.replace("</body>", f"<script>{script}</script></body>"), folder, fragment)[0]


def loaded(text: str, folder: Path, fragment: str = "") -> tuple[str, list[str]]:
    """The document that a page of this text becomes, and the browser's lines on it: errors, what a policy blocked."""
    assert CHROMIUM is not None
    copy = folder / "page.html"
    copy.write_text(text, encoding="utf-8")
    command = [
        CHROMIUM,
        *SWITCHES,
        f"--user-data-dir={folder / 'profile'}",
        "--dump-dom",
        f"{copy.as_uri()}#{fragment}",
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    return done.stdout, [line for line in done.stderr.splitlines() if ":CONSOLE" in line]


def title_of(document: str) -> str:
    """What the script reported."""
    found = re.search(r"<title>(.*?)</title>", document, re.S)
    assert found
    return html.unescape(found[1])
