"""The opening of a report, read off its HTML: how agents compare is checked against ``numbers.csv``, by other code."""

import csv
import html
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t as student

CELL = dict[str, str]
MARGIN = 0.1
WORDS = {
    "Choosing mattered": "better", "Choosing made it worse": "worse", "Choosing made no difference": "alike",
    "Whether choosing mattered is undecided": "undecided", "Several hypotheses mattered": "better",
    "Several hypotheses made it worse": "worse", "Several hypotheses made no difference": "alike",
    "Whether several hypotheses mattered is undecided": "undecided",
}  # fmt: skip
COMPARED = re.compile(
    rf"({'|'.join(WORDS)}) (on this (?:layout|seed)|over (\d+) (?:layout|seed)s): .*? (\d+) % .*? (\d+) %"
    r"(?: in \w+)?(?: \(([+-]\d+) points \[(-?\d+), (-?\d+)\]\))?\."
)
UNIFORM = "uniform-random choice among its own options"


def agrees(run: Path, task: str, *kinds: str) -> None:
    """The page has this task, sentences that begin with each of ``kinds``, and compares by the run's numbers."""
    page = (run / "report" / "index.html").read_text(encoding="utf-8")
    block = re.search(r'<div class="verdict">(.*?)</div>', page, re.S)
    assert block
    sentences = [html.unescape(re.sub("<.*?>", "", text)) for text in re.findall(r"<p[ >].*?</p>", block[1], re.S)]
    assert sentences[0].startswith(f"Task. {task}") if task else not sentences[0].startswith("Task. "), sentences
    with (run / "evaluation" / "numbers.csv").open(newline="", encoding="utf-8") as file:
        cells = list(csv.DictReader(file))
    for sentence in sentences:
        if compared := COMPARED.fullmatch(sentence):
            subject = "choosing" if "hoosing" in compared[1] else "hypotheses"
            check(compared, pairs(run, cells, subject))
    for kind in kinds:
        assert any(sentence.startswith(kind) for sentence in sentences), (kind, sentences)


def check(shown: re.Match[str], compared: Sequence[tuple[str, float, float]]) -> None:
    """Both shares, the difference with its interval, the number of units and the words for it."""
    assert compared, shown[0]
    units = sorted({unit for unit, _, _ in compared})
    shares = np.array([np.mean([pair for unit, *pair in compared if unit == one], axis=0) for one in units])
    assert (shown[4], shown[5]) == tuple(f"{100 * share:.0f}" for share in shares.mean(axis=0)), (shown[0], shares)
    assert len(units) == int(shown[3] or 1), shown[0]
    apart = shares[:, 0] - shares[:, 1]
    low = high = float(apart.mean())
    if len(units) > 1:
        half = float(student.ppf(0.975, len(units) - 1) * apart.std(ddof=1) / np.sqrt(len(units)))
        low, high = max(-1.0, low - half), min(1.0, high + half)
        assert shown[6] == f"{100 * apart.mean():+.0f}"
        assert (shown[7], shown[8]) == (f"{100 * low:.0f}", f"{100 * high:.0f}")
    inside = max(abs(low), abs(high)) < MARGIN
    assert WORDS[shown[1]] == ("alike" if inside else "better" if low > 0 else "worse" if high < 0 else "undecided")


def pairs(run: Path, cells: Sequence[CELL], subject: str) -> list[tuple[str, float, float]]:
    """Unit (a layout, or a seed where all are of one layout) and the two shares, run by run."""

    def of(scope: str) -> list[CELL]:
        kept = [cell for cell in cells if (cell["quantity"], cell["scope"]) == ("success", scope)]
        return [cell for cell in kept if not (cell["step"] or cell["sub_goal"])]

    def config(cell: CELL) -> dict[str, Any]:
        manifest = json.loads((run / cell["artefact"] / "manifest.json").read_text(encoding="utf-8"))
        return dict(manifest["config"])

    def members(cell: CELL) -> int:
        return int(config(cell).get("members", 0))

    trained = of("")
    frozen = of("frozen") or of("zero-shot")  # play on layouts that were asked for
    played = [cell for cell in frozen if cell["method"] != UNIFORM]
    agents = played or [cell for cell in trained if config(cell).get("chooser") == "ppo"]
    several = [cell for cell in agents if members(cell) > 1]
    keys = ("layout", "seed")
    others = [cell for cell in agents if members(cell) == 1]
    if subject == "choosing" and frozen:
        keys = ("artefact", "layout")
        others = [cell for cell in frozen if cell["method"] == UNIFORM]
    elif subject == "choosing":
        others = [cell for cell in trained if cell["method"].startswith("random choice")]
    shares = {tuple(cell[key] for key in keys): float(cell["value"]) for cell in others}
    several = [cell for cell in several if tuple(cell[key] for key in keys) in shares]
    unit = "layout" if len({cell["layout"] for cell in several}) > 1 else "seed"
    return [(cell[unit], float(cell["value"]), shares[tuple(cell[key] for key in keys)]) for cell in several]
