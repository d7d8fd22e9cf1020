"""The opening of a report, read off its HTML."""

import html
import re
from pathlib import Path


def agrees(run: Path, task: str, *kinds: str) -> None:
    """The page has this task, none if it is empty, and sentences that begin with each of ``kinds``."""
    page = (run / "report" / "index.html").read_text(encoding="utf-8")
    block = re.search(r'<div class="verdict">(.*?)</div>', page, re.S)
    assert block
    sentences = [html.unescape(re.sub("<.*?>", "", text)) for text in re.findall(r"<p[ >].*?</p>", block[1], re.S)]
    assert sentences[0].startswith(f"Task. {task}") if task else not sentences[0].startswith("Task. "), sentences
    for kind in kinds:
        assert any(sentence.startswith(kind) for sentence in sentences), (kind, sentences)
