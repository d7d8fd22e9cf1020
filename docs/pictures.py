"""Renew docs/report.png and docs/film.gif from a run's report: ``python docs/pictures.py runs/doorkey``.

``make demo`` makes the run. Both files say which version of hypogoal drew the report, and a test compares that with the
package's, so that nobody is shown a page of long ago.
"""

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image, PngImagePlugin

import hypogoal

DOCS = Path(__file__).parent
REPORT, FILM = DOCS / "report.png", DOCS / "film.gif"
SCREEN = (1000, 720)
COLOURS = 128
VERSION = "hypogoal"  # the key of a picture's text


def version_of(picture: Path) -> str:
    """Read which version of hypogoal drew what a picture shows."""
    with Image.open(picture) as opened:
        text = opened.info.get(VERSION) or opened.info.get("comment", b"").decode()
    return text.removeprefix(f"{VERSION} ")


def photograph(page: Path) -> None:
    """Write the first screen of a page, as a browser shows it."""
    sys.path.insert(0, str(DOCS.parent / "tests"))
    from browser import CHROMIUM, SWITCHES

    with TemporaryDirectory() as folder:
        raw = Path(folder) / "screen.png"
        size = f"--window-size={SCREEN[0]},{SCREEN[1]}"
        profile = f"--user-data-dir={folder}/profile"
        command = [
            CHROMIUM,
            *SWITCHES,
            "--hide-scrollbars",
            profile,
            size,
            f"--screenshot={raw}",
            page.resolve().as_uri(),
        ]
        subprocess.run(command, check=True, capture_output=True, timeout=120)
        screen = Image.open(raw).convert("RGB").quantize(COLOURS)
    text = PngImagePlugin.PngInfo()
    text.add_text(VERSION, hypogoal.__version__)
    screen.save(REPORT, optimize=True, pnginfo=text)


def keep_film(film: Path) -> None:
    """Write a film again, frame by frame as it was, with the version as its comment."""
    with Image.open(film) as opened:
        comment = f"{VERSION} {hypogoal.__version__}".encode()
        opened.save(FILM, save_all=True, comment=comment, optimize=True)


if __name__ == "__main__":
    report = Path(sys.argv[1]) / "report"
    photograph(report / "index.html")
    films = sorted((report / "videos").glob("*.gif"))
    keep_film(films[0])
