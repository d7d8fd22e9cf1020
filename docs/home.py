"""Write docs/index.md, the site's first page: README.md with the links that the site has (``python docs/home.py``)."""

import re
from pathlib import Path

DOCS = Path(__file__).parent
ELSEWHERE = r"\[([^\]]+)\]\((?!docs/|https?:)([^)]+)\)"  # links to files that are no pages


def home() -> str:
    """The page's text."""
    text = (DOCS.parent / "README.md").read_text(encoding="utf-8")
    text = re.sub(ELSEWHERE, r"\1 (`\2`)", text)
    return text.replace("](docs/", "](")


if __name__ == "__main__":
    (DOCS / "index.md").write_text(home(), encoding="utf-8")
