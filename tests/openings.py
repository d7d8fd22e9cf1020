"""The opening of a report, read off its HTML: every sentence is checked against ``numbers.csv``, by other code."""

import csv
import html
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path

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
    rf"({'|'.join(WORDS)}) (on this (?:layout|seed|ladder)|over (\d+) (?:layout|seed|ladder)s): .*? (\d+) % .*? (\d+) %"
    r"(?: in \w+)?(?: \(([+-]\d+) points \[(-?\d+), (-?\d+)\]\))?\."
)
UNIFORM = "uniform among its own options"


def opening(page: str) -> tuple[str, list[str]]:
    """A page's task, if it says one, and the sentences of its verdict, baselines among them."""
    block = re.search(r'<div class="verdict">(.*?)</div>', page, re.S)
    assert block
    lines = [html.unescape(re.sub("<.*?>", "", text)) for text in re.findall(r"<p[ >].*?</p>", block[1], re.S)]
    task = [line.removeprefix("Task. ") for line in lines[:1] if line.startswith("Task. ")]
    return "".join(task), lines[len(task) :]


def percent(share: float) -> str:
    return f"{100 * share:.0f}"


def agrees(run: Path, task: str, *kinds: str) -> None:
    """The page has this task, sentences that begin with each of ``kinds``, and in them the numbers of the run."""
    shown, sentences = opening((run / "report" / "index.html").read_text(encoding="utf-8"))
    assert shown.startswith(task) and bool(shown) == bool(task), shown
    with (run / "evaluation" / "numbers.csv").open(newline="", encoding="utf-8") as file:
        cells = list(csv.DictReader(file))
    numbers = Numbers(run, cells)
    for sentence in sentences:
        numbers.check(sentence)
    for kind in kinds:
        assert any(sentence.startswith(kind) for sentence in sentences), (kind, sentences)


class Numbers:
    """The cells of ``numbers.csv``, and what sentences may be made of."""

    def __init__(self, run: Path, cells: Sequence[CELL]):
        self.run, self.cells, self.most = run, cells, 0

    def of(self, quantity: str, scope: str = "") -> list[CELL]:
        return [
            cell for cell in self.cells if (cell["quantity"], cell["scope"]) == (quantity, scope) and not cell["step"]
        ]

    def played(self) -> list[CELL]:
        """Frozen play; of a run without, play on layouts that were asked for."""
        return self.of("success", "frozen") or [one for one in self.of("success", "zero-shot") if not one["sub_goal"]]

    def members(self, cell: CELL) -> int:
        """Of an agent's artefact."""
        manifest = json.loads((self.run / cell["artefact"] / "manifest.json").read_text(encoding="utf-8"))
        return int(manifest["config"].get("members", 0))

    def check(self, sentence: str) -> None:
        """One sentence; one that fits nothing known is an error."""
        if compared := COMPARED.fullmatch(sentence):
            self.comparison(sentence, compared)
        elif count := re.match(r"(One run is|Two runs are) not evidence", sentence):
            assert self.most == ("One run is", "Two runs are").index(count[1]) + 1
        elif share := re.fullmatch(r"(?!Options).*: (\d+) % of the last training episodes solved\.", sentence):
            trained = self.of("success")
            first = [float(cell["value"]) for cell in trained if cell["method"] == trained[0]["method"]]
            assert share[1] == percent(float(np.mean(first)))
        elif sentence.startswith("Whether hypotheses mattered is unknown"):
            assert not any(cell["method"] == UNIFORM for cell in self.played()) and not self.pairs("hypotheses")
        elif share := re.fullmatch(r"Options (of|that end at true).* stop at the base in (\d+) % of .*", sentence):
            oracle = share[1] != "of"
            shares = [self.stopped(cell) for cell in self.of("executions") if not self.other(cell, oracle)]
            assert share[2] == percent(float(np.mean([value for value in shares if value is not None])))
        elif sentence.startswith("No agent has been trained yet"):
            assert not self.of("success")
        elif sentence.startswith("No episode of an agent has ended yet"):
            assert all(cell["value"] == "" for cell in self.of("success"))
        elif scores := re.search(
            r"balanced accuracy .* (\d?\.\d+) for the best .*, (\S+) on average, (\S+) for", sentence
        ):
            for shown, of in zip(scores.groups(), (np.max, np.mean, np.min), strict=True):
                assert float(shown) == round(self.accuracy(of), 2)
        else:
            self.baselines(sentence)

    def baselines(self, sentence: str) -> None:
        """PPO and DQN, with the steps that they were given."""
        start = "On primitive actions, with the same cap: "
        assert sentence.startswith(start), sentence
        for name, share, steps in re.findall(
            r"([\w ]+?) (\d+) % \(after ([\d,]+) steps\)", sentence.removeprefix(start)
        ):
            name = name.removeprefix("and ").strip()
            values = [float(cell["value"]) for cell in self.of("success") if cell["method"] == name]
            assert share == percent(float(np.mean(values)))
            assert int(steps.replace(",", "")) in {
                int(float(c["value"])) for c in self.of("steps") if c["method"] == name
            }

    def accuracy(self, of: Callable[[Sequence[float]], float]) -> float:
        """Of members of each sub-goal, mean over seeds, then over sub-goals."""
        places: dict[str, dict[str, list[float]]] = {}
        for cell in self.of("balanced_accuracy", "heldout"):
            places.setdefault(cell["sub_goal"], {}).setdefault(cell["artefact"], []).append(float(cell["value"]))
        return float(np.mean([np.mean([of(values) for values in goal.values()]) for goal in places.values()]))

    @staticmethod
    def other(cell: CELL, oracle: bool) -> bool:
        """A row of ladders that a sentence is not about, or not of the first member."""
        return cell["member"] != "0" or not cell["ladder"] or cell["method"].startswith("oracle") != oracle

    def stopped(self, cell: CELL) -> float | None:
        """The share that stopped at the base, of the validated member of the row's options, else of the first."""
        same = ("artefact", "sub_goal", "ladder")
        alike = [one for one in self.cells if all(one[name] == cell[name] for name in same)]
        validated = [one["value"] for one in alike if one["quantity"] == "validated_member"]
        member = str(int(float(validated[0]))) if validated and validated[0] else "0"
        (value,) = (one["value"] for one in alike if one["quantity"] == "reached_base" and one["member"] == member)
        return float(value) if value else None

    def pairs(self, subject: str) -> list[tuple[str, float, float]]:
        """Unit and the two shares, run by run."""
        if subject == "options":
            first, second = ([], {})
            for cell in (cell for cell in self.of("executions") if not self.other(cell, False)):
                if (share := self.stopped(cell)) is not None:
                    place = (cell["ladder"], cell["seed"], cell["N"])
                    if cell["method"] == "single CNN":
                        second[place] = share
                    elif cell["N"]:
                        first.append((place, share))
            return [(place[0], share, second[place]) for place, share in first if place in second]
        frozen = self.played()
        played = [cell for cell in frozen if cell["method"] != UNIFORM]
        if subject == "choosing" and frozen:
            uniform = {(c["artefact"], c["layout"]): float(c["value"]) for c in frozen if c["method"] == UNIFORM}
            agents = [cell for cell in played if self.members(cell) > 1]
            pairs = [(cell, uniform[cell["artefact"], cell["layout"]]) for cell in agents]
            return [(self.unit(cell, agents), float(cell["value"]), other) for cell, other in pairs]
        agents = played or [cell for cell in self.of("success") if cell["method"].startswith("options (learned")]
        single = {(c["layout"], c["seed"]): float(c["value"]) for c in agents if self.members(c) == 1}
        if subject == "choosing":
            random = [cell for cell in self.of("success") if cell["method"].startswith("random choice")]
            single = {(cell["layout"], cell["seed"]): float(cell["value"]) for cell in random}
        several = [cell for cell in agents if self.members(cell) > 1 and (cell["layout"], cell["seed"]) in single]
        places = [(self.unit(cell, several), float(cell["value"])) for cell in several]
        return [(*place, single[cell["layout"], cell["seed"]]) for place, cell in zip(places, several, strict=True)]

    @staticmethod
    def unit(cell: CELL, cells: Sequence[CELL]) -> str:
        """A layout, or a seed where all are of one layout."""
        return cell["layout"] if len({one["layout"] for one in cells}) > 1 else cell["seed"]

    def comparison(self, sentence: str, shown: re.Match[str]) -> None:
        """Both shares, the difference with its interval, the number of units and the words for it."""
        subject = "choosing" if "hoosing" in shown[1] else "options" if "executions" in sentence else "hypotheses"
        pairs = self.pairs(subject)
        assert pairs, sentence
        units = sorted({unit for unit, _, _ in pairs})
        shares = np.array([np.mean([pair for unit, *pair in pairs if unit == one], axis=0) for one in units])
        self.most = max(self.most, len(units))
        assert (shown[4], shown[5]) == tuple(percent(share) for share in shares.mean(axis=0)), (sentence, shares)
        assert len(units) == int(shown[3] or 1), sentence
        apart = shares[:, 0] - shares[:, 1]
        low = high = float(apart.mean())
        if len(units) > 1:
            half = float(student.ppf(0.975, len(units) - 1) * apart.std(ddof=1) / np.sqrt(len(units)))
            low, high = max(-1.0, low - half), min(1.0, high + half)
            assert shown[6] == f"{100 * apart.mean():+.0f}"
            assert (shown[7], shown[8]) == (f"{100 * low:.0f}", f"{100 * high:.0f}")
        inside = max(abs(low), abs(high)) < MARGIN
        assert WORDS[shown[1]] == ("alike" if inside else "better" if low > 0 else "worse" if high < 0 else "undecided")
