"""Words of the project on the pages for newcomers: none is used before the page defines it or links its definition."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
CONCEPTS, GLOSSARY = DOCS / "concepts.md", DOCS / "glossary.md"
DOORS = (  # pages for newcomers, for those who have a success classifier, and for those who have an environment
    ROOT / "README.md",
    DOCS / "tutorial.md",
    CONCEPTS,
    DOCS / "in-a-notebook.md",
    DOCS / "audit.md",
    DOCS / "own-data.md",
    DOCS / "library.md",
    DOCS / "own-domain.md",
    DOCS / "choosing.md",
)
# How a word is found, by its entry in the glossary. Words that English has, too, are not listed: run, cell, decision.
WORDS = {
    "Balanced accuracy": r"balanced accuracy",
    "Better of two": r"better of two",
    "Chooser": r"choosers?",
    "Conditional preference": r"conditional preference",
    "Context": r"contexts?",
    "Coverage@K": r"coverage",
    "Cross-fitted": r"cross-fitted",
    "D-BAT": r"D-BAT",
    "Distilled options": r"distilled",
    "Diversity weight": r"diversity weight|weight of diversity",
    "Ensemble": r"ensembles?",
    "Execution": r"executions?",
    "False positive": r"false positives?",
    "Held-out states": r"held-out states",
    "Hypothesis": r"hypothes[ie]s",
    "Initiation set": r"initiation",
    "Labelled states": r"(?<!un)labelled states",
    "Ladder group": r"ladder groups?",
    "Layout": r"layouts?",
    "Masked": r"masked",
    "Member": r"members?",
    "Option": r"options?",
    "Oracle": r"oracle(?:'s)?",
    "Owns": r"owns|owned",
    "Planned options": r"plan(?:ned)? options",
    "Policy over options": r"polic(?:y|ies) over options|meta-policy",
    "Preference": r"preference",
    "Ranking": r"ranking",
    "Restarts": r"restarts",
    "Sub-goal": r"sub-goals?",
    "Teacher": r"teachers?",
    "Termination classifier": r"termination classifier",
    "Termination set": r"termination set",
    "Threshold": r"thresholds?",
    "Timeout": r"timeouts?",
    "Uniform-random choice": r"uniform-random choice",
    "Unlabelled states": r"unlabelled states",
    "Useless member": r"useless members?",
    "Within-rho": r"within-rho",
}


def prose_of(page: Path) -> str:
    """The text of a page without code, headings, comments and the descriptions of pictures."""
    text = page.read_text(encoding="utf-8")
    for left_out in (r"^```.*?^```", r"<!--.*?-->", r"^#.*?$", r"!\[.*?\]\(.*?\)", r"`[^`]+`"):
        text = re.sub(left_out, " ", text, flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"\s+", " ", text)


def definitions_in(page: Path, prose: str) -> list[tuple[int, str]]:
    """Where the prose emphasises words or links the place that defines them: (position, words)."""
    found = []
    for emphasised in re.finditer(r"\*{1,2}(?=\S)([^*]{2,60}?)(?<=\S)\*{1,2}", prose):
        found.append((emphasised.start(), emphasised[1]))
    elsewhere = r"^#" if page == CONCEPTS else r"(?:concepts|glossary)\.md"
    for link in re.finditer(r"\[([^\]]+)\]\(([^)]*)\)", prose):
        if re.search(elsewhere, link[2]):
            found.append((link.start(), link[1]))
    return found


def used_too_early(page: Path) -> list[str]:
    """The listed words that a page uses before it defines them, each with the text around its first use."""
    prose = prose_of(page)
    definitions = definitions_in(page, prose)
    visible = re.sub(r"\]\([^)]*\)", lambda target: "]" + " " * (len(target[0]) - 1), prose)  # no link targets
    early = []
    for name, pattern in WORDS.items():
        whole = re.compile(rf"(?<![\w-])(?:{pattern})(?![\w-])", re.IGNORECASE)
        use = whole.search(visible)
        if use is None:
            continue
        defined = [position for position, words in definitions if whole.search(words)]
        if not defined or min(defined) > use.start():
            early.append(f"{name}: ...{visible[max(0, use.start() - 60) : use.end() + 20]}...")
    return early


@pytest.mark.parametrize("page", DOORS, ids=lambda page: page.name)
def test_no_word_is_used_before_it_is_defined(page: Path) -> None:
    """By emphasis where the page explains it, or by a link to the place that does."""
    assert not used_too_early(page)


def test_a_word_that_comes_too_early_is_found(tmp_path: Path) -> None:
    """Of two words one is defined only after its first use; links' targets and code do not count as uses."""
    page = tmp_path / "page.md"
    page.write_text("# Members\n`members` [here](a/members.md): each **option**\nhas a member, a *member*.\n")
    [early] = used_too_early(page)
    assert early.startswith("Member: ")


def sections_of(text: str) -> dict[str, str]:
    """A page's text below each heading, by the heading's anchor."""
    parts = re.split(r"^#+ (.+)$", text, flags=re.MULTILINE)
    anchors = [re.sub(r"[^\w\s-]", "", heading.lower()).strip().replace(" ", "-") for heading in parts[1::2]]
    return dict(zip(anchors, parts[2::2], strict=True))


def test_the_index_of_words_leads_to_their_definitions() -> None:
    """Each entry links a section of the concepts that has the word in bold, and each listed word is an entry."""
    sections = sections_of(CONCEPTS.read_text(encoding="utf-8"))
    index = GLOSSARY.read_text(encoding="utf-8")
    entries = re.findall(r"^- \[\*\*(.+?)\*\*\]\(concepts\.md#(.+?)\): ", index, re.MULTILINE)
    assert {*WORDS} <= {name for name, _ in entries}
    lost = []
    for name, anchor in entries:
        one_line = re.sub(r"\s+", " ", sections[anchor].lower())
        bold = re.findall(r"\*\*([^*]+)\*\*", one_line)
        wanted = name.lower().split(",")[0]
        if not any(wanted in words or words in wanted for words in bold):
            lost.append(name)
    assert not lost
