"""Spec A5, F, F7: a run of real, tiny artefacts is evaluated and drawn; what is missing is named."""

import json
import re
import shutil
from html.parser import HTMLParser

import pytest
from command_line import refuses, run
from openings import agrees
from toy_data import reseal

from hypogoal.cells import Cell
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.errors import UserError
from hypogoal.evaluation.run import read_evaluation
from hypogoal.experiments.run import begin
from hypogoal.stages.evaluate import evaluate
from hypogoal.stages.report import report
from hypogoal.stages.train_meta import train_meta

GOALS = ["collect-red-key", "open-red-door"]


@pytest.fixture(scope="module")
def metrics(tiny_run):
    """The numbers of the shared run."""
    return json.loads((tiny_run / "evaluation" / "metrics.json").read_text(encoding="utf-8"))


def page_of(folder, **how):
    """The page of a run that is drawn now."""
    return (report(folder, **how).path / "index.html").read_text(encoding="utf-8")


def test_the_page_opens_with_the_task_and_a_verdict_of_its_numbers(tiny_run):
    """Spec I1: recomputed from ``numbers.csv``, with what a baseline was given beside it."""
    agrees(tiny_run, "Take the red key, open the red door and reach the goal", "One run is not", "On primitive actions")


def test_an_agent_without_a_whole_episode_is_said_to_be_one(tiny_run, tmp_path):
    """Spec F5: there is no success to speak of, neither 0 nor a dash."""
    train_meta(tiny_run / "ensemble", tmp_path / "meta", steps=512, max_episode_steps=100, random_episodes=2)
    assert evaluate(tmp_path).metrics["agents"][0]["success"]["mean"] is None
    page = page_of(tmp_path)
    assert "No episode of an agent has ended yet" in page and "reached the goal in" not in page


def test_what_was_made_since_is_said(tiny_copy):
    """Spec A5, F7: a report of an evaluation that does not know all that is there says what, and what to do."""
    assert not [line for line in read_evaluation(tiny_copy).metrics["missing"] if "since" in line]
    reseal(shutil.copytree(tiny_copy / "ppo", tiny_copy / "later"), seed=1)
    assert "later: made since this evaluation" in page_of(tiny_copy, force=True)


def test_metrics_are_strict_json(tiny_run):
    """Spec A5, A8: and the inputs' hashes are in the manifest."""
    text = (tiny_run / "evaluation" / "metrics.json").read_text(encoding="utf-8")
    assert not re.search(r"\b(NaN|Infinity)\b", text)
    kinds = sorted(entry.kind for entry in open_artefact(tiny_run / "evaluation", "evaluation").manifest.inputs)
    assert kinds == ["baseline", "data", "ensemble", "ensemble", "ensemble", "meta", "meta", "meta"]


def test_what_is_missing_is_named(tiny_run, metrics, tmp_path):
    """Spec F: no silent absence, in the metrics, on the page and in an evaluation of a run with a baseline only."""
    assert metrics["missing"] == [], "what nobody asked for is not missed"
    shutil.copytree(tiny_run / "ppo", tmp_path / "ppo")
    alone = evaluate(tmp_path).metrics
    assert alone["missing"][0] == "no ensemble"
    assert alone["ensembles"] == alone["selection"] == []
    assert "<li>no ensemble</li>" in page_of(tmp_path)


def test_hypotheses_alone_are_told_in_the_terminal(tiny_run, tmp_path, monkeypatch):
    """Spec A5, A8, F1: a table of members, none of agents that nobody trained; 'show' tells it again, damage too.

    Spec G4: a mean over nine of ten seeds says that it is one.
    """
    monkeypatch.setenv("COLUMNS", "80")
    for name in ("ensemble", "ensemble-none"):
        shutil.copytree(tiny_run / name, tmp_path / name)
    shutil.copy(tiny_run / "data.h5", tmp_path / "data.h5")
    begin([Cell(name=name, words=["train-ensemble", "d"]) for name in ("ensemble", "other")], tmp_path)
    *lines, then, where = run("evaluate", tmp_path).out.splitlines()
    assert max(map(len, lines)) <= 80
    assert (then, where) == (f"next: hypogoal report {tmp_path}", str(tmp_path / "evaluation"))
    told = "\n".join(lines)
    assert "D-BAT, 2 members" in told and "no diversity, 2 members" in told
    assert "PPO" not in told and "last 100" not in told
    metrics = json.loads((tmp_path / "evaluation" / "metrics.json").read_text(encoding="utf-8"))
    assert metrics["missing"] == ["no agents", "1 of the run's cells are not done; the first is other"]
    row = next(row for row in metrics["hypotheses"] if row["sub_goal"] == "collect-red-key")
    numbers = [f"{row[which]['mean']:.3f}" for which in ("best", "mean", "worst")]
    (line,) = (line for line in lines if "collect-red-key" in line)
    assert [cell.strip() for cell in line.split("│")[3:6]] == numbers
    for path in (tmp_path, tmp_path / "evaluation"):
        assert line in run("show", path).out.splitlines()
    assert json.loads(run("show", tmp_path / "evaluation", "--json").out)["numbers"] == metrics
    (tmp_path / "evaluation" / "metrics.json").write_text("{}", encoding="utf-8")
    refuses("metrics.json is changed since it was written", "show", tmp_path)


class Structure(HTMLParser):
    """Open tags that are never closed, ids, and whatever would be fetched."""

    VOID = frozenset({"meta", "img", "link", "br", "input", "hr"})

    def __init__(self, text):
        super().__init__()
        self.stack, self.ids, self.links, self.tags, self.scripts = [], [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        given = dict(attributes)
        self.ids += [given["id"]] if "id" in given else []
        self.links += [given[key] for key in ("src", "href", "xlink:href") if key in given]
        if tag not in self.VOID:
            self.stack.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if tag not in self.VOID:
            self.stack.pop()

    def handle_endtag(self, tag):
        assert self.stack.pop() == tag

    def handle_data(self, data):
        self.scripts += [data] if self.stack[-1:] == ["script"] else []


def test_the_page_is_whole_and_needs_nothing_else(tiny_run):
    """Spec F7: well-formed, unique ids, every link inside the page, scripts in it, no network."""
    page = (tiny_run / "report" / "index.html").read_text(encoding="utf-8")
    found = Structure(page)
    assert found.stack == []
    assert len(found.ids) == len(set(found.ids))
    inside = {f"#{identity}" for identity in found.ids}
    drawn = ("data:image/png;base64,", "data:image/gif;base64,")
    assert all(link.startswith(drawn) or link in inside for link in found.links)
    assert not {"link", "iframe", "object"} & set(found.tags)
    assert not re.search(r"fetch\(|XMLHttpRequest|import\(|https?://(?!www\.w3\.org/)", "".join(found.scripts))
    assert not re.search(r"url\((?!#)|@import", page)
    assert all(target in inside for target in re.findall(r"url\((#[^)]*)\)", page))


def test_the_page_shows_all_of_it_each_time_the_same(tiny_run, tiny_copy):
    """Spec F5, F6, F7, G1: curves, hypotheses, examples, overlays, choices, provenance, with seeds in the captions."""
    page = page_of(tiny_copy, force=True)
    assert page == (tiny_run / "report" / "index.html").read_text(encoding="utf-8")
    for title in (
        "Summary", "Hypotheses", "Explore the hypotheses",
        "Which hypotheses are chosen, and where they stop", "What members look at", "Data, settings, provenance",
    ):  # fmt: skip
        assert f"<h2>{title}</h2>" in page
    names = [path.name for path in (tiny_run / "report" / "figures").iterdir()]
    drawn = {name.rpartition(".")[0] for name in names}
    assert {"reward", "members", "figure7"} <= drawn
    assert sorted(names) == sorted(f"{name}.{kind}" for name in drawn for kind in ("svg", "png"))
    assert page.count("<figure") == 1 + len(drawn) and page.count("data:image/gif;base64,") == 1
    assert re.search(r"Episode \d of meta, layout 100: \d+ steps", page)
    assert page.count("<h3>Seed by seed: ") == 1, "one run of an agent is no table of pairs"
    assert "1 run: layout seed 100, run seed 0" in page
    assert "Missing in this run" not in page


def test_a_run_whose_agent_cannot_play_has_a_page_without_a_film(tiny_copy):
    """Spec E1, F7: where nobody asked for one, a line says why there is none; where somebody did, it is an error."""
    (kept,) = (path for path in (tiny_copy / "report" / "videos").iterdir() if path.suffix == ".gif")
    assert kept.name == "meta-episode-0.gif"
    assert "image/gif" not in page_of(tiny_copy, videos=0, force=True)
    (tiny_copy / "meta" / "options.safetensors").unlink()
    text = page_of(tiny_copy, force=True)
    assert "no film of an episode: " in text and "image/gif" not in text
    with pytest.raises(UserError, match=r"options\.safetensors"):
        report(tiny_copy, videos=1, force=True)


def test_the_papers_figures_as_files(tiny_run, tmp_path):
    """Spec F2, F5, F6, F7: those that the run has artefacts for, with captions; of the others what they need."""
    command = ["report", tiny_run, "--figures", tmp_path / "a"]
    refuses("Choose one of svg, pdf, png", *command, "--format", "jpeg")
    assert not (tmp_path / "a").exists()
    told = run(*command)
    names = {path.name for path in (tmp_path / "a").iterdir()}
    wanted = {"figure6", "figure7", "members", *(f"figure{number}-{goal}" for number in (2, 9) for goal in GOALS)}
    assert {f"{name}.svg" for name in wanted} <= names and str(tmp_path / "a" / "figure6.svg") in told.out.splitlines()
    captions = (tmp_path / "a" / "captions.md").read_text(encoding="utf-8")
    assert {*re.findall(r"^## (.*)$", captions, re.M), "captions.md"} == names
    missing = told.err.splitlines()
    assert [line.partition(":")[0] for line in missing] == ["Figure 3", "Figure 4", "Figure 5", "Figure 8"]
    assert all("It needs" in line and line in captions for line in missing)
    refuses("exists already", *command)


def test_what_cannot_be_evaluated_is_one_line(tiny_copy, tmp_path):
    """Spec G2: nothing there, or a damaged file, which is named; no half-written evaluation is left."""
    refuses("nothing to evaluate", "evaluate", tmp_path / "tiny" / "report" / "figures")
    refuses("was not evaluated", "report", tiny_copy / "report")
    path = tiny_copy / "meta" / "terminations.h5"
    path.write_bytes(path.read_bytes()[:-40])
    refuses("terminations.h5", "evaluate", tiny_copy, "--out", tiny_copy / "again", "-q")
