"""Spec A5, F, F7: a run of real, tiny artefacts is evaluated and drawn; what is missing is named."""

import csv
import io
import json
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser

import h5py
import numpy as np
import pytest
from command_line import refuses, run
from openings import agrees
from rich.console import Console
from toy_data import reseal

from hypogoal.core.artefacts import Artefact, open_artefact, sha256_of
from hypogoal.core.errors import UserError
from hypogoal.evaluation import hypotheses
from hypogoal.evaluation.figure_files import draw_figures
from hypogoal.evaluation.questions import summary_table
from hypogoal.evaluation.run import read_evaluation
from hypogoal.experiments.sweep import Cell, begin
from hypogoal.look import outcome
from hypogoal.stages.evaluate import evaluate, unmade_cells
from hypogoal.stages.report import report
from hypogoal.stages.train_ensemble import train_ensemble
from hypogoal.stages.train_meta import train_meta

QUIET = {"quiet": True}
SHORT = {"max_episode_steps": 64, "random_episodes": 20, "layout_seed": 100}
STEPS = 1_024 + 2_048  # of options, then of agents
FIGURES = {"reward", "members"}
GOALS = ["collect-red-key", "open-red-door"]


@pytest.fixture(scope="module")
def metrics(tiny_run):
    """The numbers of the shared run."""
    return json.loads((tiny_run / "evaluation" / "metrics.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def page(tiny_run):
    """The page of the shared run."""
    return (tiny_run / "report" / "index.html").read_text(encoding="utf-8")


def test_the_page_opens_with_the_task_and_a_verdict_of_its_numbers(tiny_run):
    """Spec I1: recomputed from ``numbers.csv``, with what a baseline was given beside it."""
    agrees(tiny_run, "Take the red key, open the red door and reach the goal", "One run is not", "On primitive actions")


def test_agents_are_grouped_and_counted_whole(tiny_run, metrics):
    """Spec F5, E6, E7: the steps of train-options count, and its artefact is not an agent of its own."""
    agents = {agent["name"]: agent for agent in metrics["agents"]}
    assert list(agents) == ["options (learned members)", "random choice", "oracle terminations", "PPO tuned"]
    (own,) = agents["options (learned members)"]["runs"]
    assert own["steps"] == STEPS
    rows = (tiny_run / "meta" / "episodes.csv").read_text().splitlines()[1:]
    assert own["episodes"] == len(rows)
    last = np.array([row.split(",") for row in rows[-100:]], dtype=float)
    assert own["length"] == pytest.approx(last[:, 1].mean())
    assert own["success"] == pytest.approx(last[:, 3].mean())
    assert own["length_over_shortest"] == pytest.approx(last[:, 1].mean() / own["shortest_path"])


def test_an_agent_without_a_whole_episode_is_said_to_be_one(tiny_run, tmp_path):
    """Spec F5: there is no success to speak of, neither 0 nor a dash."""
    unfinished = {"steps": 512, "max_episode_steps": 100, "random_episodes": 2}
    train_meta(tiny_run / "ensemble", tmp_path / "meta", **unfinished, **QUIET)
    metrics = evaluate(tmp_path, tmp_path / "evaluation", **QUIET).metrics
    assert metrics["agents"][0]["success"]["mean"] is None
    page = (report(tmp_path).path / "index.html").read_text(encoding="utf-8")
    assert "No episode of an agent has ended yet" in page
    assert "reached the goal in" not in page


def test_what_was_made_since_is_said(tiny_copy):
    """Spec A5, F7: a report of an evaluation that does not know all that is there says what, and what to do."""
    assert not [line for line in read_evaluation(tiny_copy).metrics["missing"] if "since" in line]
    reseal(shutil.copytree(tiny_copy / "ppo", tiny_copy / "later"), seed=1)
    page = (report(tiny_copy, force=True).path / "index.html").read_text(encoding="utf-8")
    assert "later: made since this evaluation" in page


def test_cells_of_a_sweep_that_are_not_done_are_said(tiny_run, tmp_path):
    """Spec A5, G4: a mean over nine of ten seeds says that it is one."""
    shutil.copytree(tiny_run / "ensemble", tmp_path / "ensemble")
    begin([Cell(name=name, words=["train-ensemble", "d"]) for name in ("ensemble", "other")], tmp_path)
    assert unmade_cells(tmp_path) == ["1 of the run's cells are not done: other"]


def test_members_are_judged_on_heldout_states(tiny_run, metrics):
    """Spec F1, F2: numbers of each ensemble, sub-goal and member, recomputed here from the file and the weights."""
    from hypogoal.data import open_dataset
    from hypogoal.hypotheses.ensemble import read_ensemble

    assert [(one["path"], one["name"]) for one in metrics["ensembles"]] == [
        ("another", "dbat, K=2"), ("ensemble", "dbat, K=2"), ("ensemble-none", "no diversity, K=2"),
    ]  # fmt: skip
    source = open_artefact(tiny_run / "ensemble")
    goal = metrics["ensembles"][1]["sub_goals"][0]
    split = open_dataset(tiny_run / "data.h5").heldout("collect-red-key")
    yes = read_ensemble(source.path, source.config, "collect-red-key").predict(split.observations) > 0.5
    recall, rejections = yes[split.labels].mean(0), (~yes)[~split.labels].mean(0)
    found = [member["balanced_accuracy"] for member in goal["heldout"]["members"]]
    np.testing.assert_allclose(found, (recall + rejections) / 2)
    assert goal["heldout"]["disagreement"] == pytest.approx((yes[:, 0] != yes[:, 1]).mean())
    assert goal["heldout"]["layouts"] == len(set(split.origins["layout_seed"].tolist()))
    assert len(metrics["hypotheses"]) == len(GOALS) + 1


def test_thresholds_are_those_of_members_and_of_options(tiny_run, metrics, tmp_path):
    """Whatever rule set them; of options they are the artefact's, which may have fallen since."""
    from hypogoal.core.tensors import load_tensors, save_tensors
    from hypogoal.evaluation.run import thresholds_of
    from hypogoal.hypotheses.ensemble import read_ensemble

    by_place = {}
    for name, ensemble in zip(("another", "ensemble", "ensemble-none"), metrics["ensembles"], strict=True):
        source = open_artefact(tiny_run / name)
        for goal in ensemble["sub_goals"]:
            wanted = read_ensemble(source.path, source.config, goal["sub_goal"]).thresholds.tolist()
            assert [member["threshold"] for member in goal["heldout"]["members"]] == wanted
            by_place |= {(name, goal["sub_goal"], str(member)): value for member, value in enumerate(wanted)}
    assert by_place["ensemble", "open-red-door", "0"] == 0.5 != by_place["ensemble-none", "open-red-door", "0"]
    assert "threshold" not in metrics["settings"]
    with (tiny_run / "evaluation" / "numbers.csv").open(newline="") as file:
        told = [row for row in csv.DictReader(file) if row["quantity"] == "threshold" and row["scope"] == "heldout"]
    assert {(row["artefact"], row["sub_goal"], row["member"]): float(row["value"]) for row in told} == by_place
    (agent,) = metrics["selection"][0]["runs"]
    assert {member["threshold"] for goal in agent["sub_goals"] for member in goal["members"]} == {0.5}

    shutil.copytree(tiny_run / "meta", tmp_path / "meta")
    weights = load_tensors(tmp_path / "meta" / "options.safetensors")
    weights["thresholds"][3] = -np.log(3.0)
    save_tensors(tmp_path / "meta" / "options.safetensors", weights)
    assert thresholds_of(Artefact(tmp_path / "meta")) == pytest.approx([0.5] * 3 + [0.25])
    assert np.isnan(thresholds_of(open_artefact(tiny_run / "meta-oracle"))).all()


def test_attributions_are_complete(tiny_run, metrics):
    """Spec F2: DeepLift of every member on a few held-out states of every sub-goal adds up to its log-odds."""
    found = metrics["saliency"]
    assert found["ensemble"] == "another", "the first of those with the most members"
    assert [goal["sub_goal"] for goal in found["sub_goals"]] == GOALS
    members = [member for goal in found["sub_goals"] for state in goal["states"] for member in state["members"]]
    assert members
    assert max(member["completeness_error"] for member in members) < 1e-9
    assert set(members[0]) - {"member"} <= set(metrics["quantities"])
    with h5py.File(tiny_run / "evaluation" / "arrays.h5") as arrays:
        goal = next(goal for goal in found["sub_goals"] if goal["states"])
        group = arrays[f"saliency/{goal['sub_goal']}"]
        values = group["attributions"][0, 0].astype(float).sum()
        assert values == pytest.approx(goal["states"][0]["members"][0]["attributed"], abs=1e-4)
        assert group["attributions"].shape == (len(goal["states"]), 2, 64, 64, 3)


def test_selection_counts_every_decision(tiny_run, metrics):
    """Spec F6: what was chosen and offered, and the random chooser's control beside it; oracle has no members."""
    assert [agent["name"] for agent in metrics["selection"]] == ["options (learned members)", "random choice"]
    table = np.genfromtxt(tiny_run / "meta-random" / "choices.csv", delimiter=",", names=True)
    (random,) = metrics["selection"][1]["runs"]
    members = [member for goal in random["sub_goals"] for member in goal["members"]]
    assert [member["option"] for member in members] == list(range(4))
    assert sum(member["chosen"] for member in members) == table["chosen"].sum()
    assert sum(member["expected"] for member in members) == pytest.approx(sum(member["chosen"] for member in members))
    often = [member for member in members if member["expected"] > 40]
    assert often
    assert all(0.5 < member["preference"] < 1.7 for member in often)
    assert all(0 <= member["match"] <= 1 for member in members)


def test_metrics_are_strict_json(tiny_run, metrics):
    """Spec A5, A8: each number's unit beside it, and the inputs' hashes in the manifest."""
    artefact = open_artefact(tiny_run / "evaluation", "evaluation")

    def refuse(name):
        raise AssertionError(name)

    json.loads((tiny_run / "evaluation" / "metrics.json").read_text(), parse_constant=refuse)
    for key in ("success", "length", "near"):
        aggregated = metrics["agents"][0][key]
        assert {"mean", "standard_error", "iqm", "interval", "interval_over", "n", "unit"} == set(aggregated)
    assert set(metrics["ensembles"][0]["sub_goals"][0]["heldout"]["members"][0]) - {"member"} <= set(
        metrics["quantities"]
    )
    named = {"first", "second", "quantity", "where", "higher", "interval_over"}
    pairs = [*metrics["comparisons"]["agents"], *metrics["comparisons"]["hypotheses"]]
    assert {(row["second"], row["quantity"]) for row in pairs} >= {
        ("random choice", "length"), ("PPO tuned", "success"), ("no diversity, K=2", "balanced accuracy, best member"),
    }  # fmt: skip
    assert set().union(*pairs) - named <= set(metrics["quantities"])
    kinds = sorted(entry.kind for entry in artefact.manifest.inputs)
    assert kinds == ["baseline", "data", "ensemble", "ensemble", "ensemble", "meta", "meta", "meta"]


def test_what_is_missing_is_named(tiny_run, metrics, tmp_path):
    """Spec F: no silent absence, in the metrics, on the page and in an evaluation of a run with a baseline only."""
    assert metrics["missing"] == [], "what nobody asked for is not missed"
    shutil.copytree(tiny_run / "ppo", tmp_path / "only" / "ppo")
    alone = evaluate(tmp_path / "only", tmp_path / "only" / "evaluation", **QUIET).metrics
    assert json.loads((tmp_path / "only" / "evaluation" / "metrics.json").read_text(encoding="utf-8")) == alone
    assert alone["missing"][0] == "no ensemble"
    assert alone["ensembles"] == alone["selection"] == []
    text = (report(tmp_path / "only").path / "index.html").read_text(encoding="utf-8")
    assert "<li>no ensemble</li>" in text


def test_an_ensemble_alone_can_be_evaluated(tiny_run, tmp_path):
    """Spec F1, F7: hypotheses without agents."""
    few = {"steps": 2, "members": 1, "workers": 1, "sub_goals": ("open-red-door",)}
    train_ensemble(tiny_run / "data.h5", tmp_path / "ensemble", **few, **QUIET)
    metrics = evaluate(tmp_path, tmp_path / "evaluation", **QUIET).metrics
    assert [row["name"] for row in metrics["hypotheses"]] == ["single CNN"]
    assert metrics["hypotheses"][0]["disagreement_heldout"]["mean"] is None
    assert "<li>no agents</li>" in (report(tmp_path).path / "index.html").read_text(encoding="utf-8")


def test_hypotheses_alone_are_told_in_the_terminal(tiny_run, tmp_path, monkeypatch):
    """Spec A5, A8, F1: a table of members, none of agents that nobody trained; 'show' tells it again, damage too."""
    monkeypatch.setenv("COLUMNS", "80")
    for name in ("ensemble", "ensemble-none"):
        shutil.copytree(tiny_run / name, tmp_path / name)
    shutil.copy(tiny_run / "data.h5", tmp_path / "data.h5")
    *lines, then, where = run("evaluate", tmp_path).out.splitlines()
    assert max(map(len, lines)) <= 80
    assert (then, where) == (f"next: hypogoal report {tmp_path}", str(tmp_path / "evaluation"))
    told = "\n".join(lines)
    assert "D-BAT, 2 members" in told and "no diversity, 2 members" in told
    assert "PPO" not in told and "last 100" not in told
    metrics = json.loads((tmp_path / "evaluation" / "metrics.json").read_text(encoding="utf-8"))
    assert metrics["missing"] == ["no agents"]
    row = next(row for row in metrics["hypotheses"] if row["sub_goal"] == "collect-red-key")
    numbers = [f"{row[which]['mean']:.3f}" for which in ("best", "mean", "worst")]
    (line,) = (line for line in lines if "collect-red-key" in line)
    assert [cell.strip() for cell in line.split("│")[3:6]] == numbers
    for path in (tmp_path, tmp_path / "evaluation"):
        assert line in run("show", path).out.splitlines()
    assert json.loads(run("show", tmp_path / "evaluation", "--json").out)["numbers"] == metrics
    (tmp_path / "evaluation" / "metrics.json").write_text("{}", encoding="utf-8")
    refuses("the evaluation's numbers are damaged", "show", tmp_path)


def test_numbers_of_another_shape_are_told():
    """Spec G2: a table of a stranger's evaluation is drawn whatever stands in it, or is damaged in one line."""
    row = {"sub_goal": "y"} | {which: {"mean": 0.5} for which in ("best", "mean", "worst", "disagreement_heldout")}
    numbers = {"rooms": [], "distance": {"options": []}, "agents": [], "missing": [], "choosing": []}
    details = {"kind": "evaluation", "path": "here"}
    with pytest.raises(UserError, match="the evaluation's numbers are damaged: here"):
        outcome({**details, "numbers": numbers | {"hypotheses": [{"name": 3}]}})
    for name in (3, None, True, ["x"], 1e308):
        told = outcome({**details, "numbers": numbers | {"hypotheses": [row | {"name": name}]}})
        assert str(name)[:4] in "\n".join(told)


def test_tables_fit_a_terminal(metrics):
    """Spec A5: the summary is readable at 80 columns."""
    for table in (summary_table(metrics), *hypotheses.summary(metrics)):
        console = Console(width=80, record=True, file=io.StringIO())
        console.print(table)
        lines = console.export_text().splitlines()
        assert max(map(len, lines)) <= 80
        assert any("collect-red-key" in line or "PPO tuned" in line for line in lines)


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


def test_the_page_is_whole_and_needs_nothing_else(page):
    """Spec F7: well-formed, unique ids, every link inside the page, scripts in it, no network."""
    found = Structure(page)
    assert found.stack == []
    assert len(found.ids) == len(set(found.ids))
    inside = {f"#{identity}" for identity in found.ids}
    assert all(
        link.startswith(("data:image/png;base64,", "data:image/gif;base64,")) or link in inside for link in found.links
    )
    assert not {"link", "iframe", "object"} & set(found.tags)
    assert not re.search(r"fetch\(|XMLHttpRequest|import\(|https?://(?!www\.w3\.org/)", "".join(found.scripts))
    assert not re.search(r"url\((?!#)|@import", page)
    assert all(target in inside for target in re.findall(r"url\((#[^)]*)\)", page))


def test_texts_of_a_page_are_escaped(tiny_copy):
    """A run's folder may be called like mark-up."""
    evaluation = tiny_copy / "evaluation"
    file = evaluation / "metrics.json"
    metrics = json.loads(file.read_text(encoding="utf-8"))
    file.write_text(json.dumps(metrics | {"run": "a&b<b>"}), encoding="utf-8")
    listed = Artefact(evaluation).manifest.files
    reseal(evaluation, files={**listed, file.name: sha256_of(file)})
    report(tiny_copy, force=True, **QUIET)
    page = (tiny_copy / "report" / "index.html").read_text(encoding="utf-8")
    assert "a&amp;b&lt;b&gt;" in page
    assert "a&b<b>" not in page


def test_the_page_shows_all_of_it(tiny_run, page):
    """Spec F5, F6, F7: curves, hypotheses, examples, overlays, choices, provenance, with seeds in the captions."""
    for title in (
        "Summary", "Hypotheses", "Explore the hypotheses",
        "Which hypotheses are chosen, and where they stop", "What members look at", "Data, settings, provenance",
    ):  # fmt: skip
        assert f"<h2>{title}</h2>" in page
    drawn = {path.name.rpartition(".")[0] for path in (tiny_run / "report" / "figures").iterdir()}
    assert {*FIGURES, "figure7"} <= drawn
    assert page.count("<figure") == 1 + len(drawn) and page.count("data:image/gif;base64,") == 1
    assert re.search(r"Episode \d of meta, layout 100: \d+ steps", page)
    assert page.count("<h3>Seed by seed: ") == 1, "one run of an agent is no table of pairs"
    assert "1 run: layout seed 100, run seed 0" in page
    assert "Figure 6 of the paper" in page
    assert "Missing in this run" not in page
    assert page.count("data:image/png;base64,") >= 10
    assert {path.name for path in (tiny_run / "report" / "figures").iterdir()} == {
        f"{name}.{kind}" for name in drawn for kind in ("svg", "png")
    }
    assert all(name.startswith(("figure", "terminations-")) for name in drawn - FIGURES)


def test_a_run_whose_agent_cannot_play_has_a_page_without_a_film(tiny_copy, page):
    """Spec E1, F7: where nobody asked for one, a line says why there is none; where somebody did, it is an error."""
    (kept,) = (path for path in (tiny_copy / "report" / "videos").iterdir() if path.suffix == ".gif")
    assert kept.name == "meta-episode-0.gif"
    assert "image/gif" not in (report(tiny_copy, videos=0, force=True).path / "index.html").read_text(encoding="utf-8")
    (tiny_copy / "meta" / "options.safetensors").unlink()
    text = (report(tiny_copy, force=True).path / "index.html").read_text(encoding="utf-8")
    assert "no film of an episode: " in text and "image/gif" not in text
    with pytest.raises(UserError, match=r"options\.safetensors"):
        report(tiny_copy, videos=1, force=True)


def test_the_report_is_the_same_each_time(tiny_copy, page):
    """Spec G1, F7: nothing in it depends on when or where it is made."""
    assert (report(tiny_copy, force=True).path / "index.html").read_text(encoding="utf-8") == page


def test_the_papers_figures_as_files(tiny_run, metrics, tmp_path):
    """Spec F2, F5, F6: what the run has artefacts for, each with its caption; for the others what they need."""
    kind = "pdf"
    written, missing = draw_figures(tiny_run, tmp_path / "figures", kind)
    names = {path.name for path in written}
    wanted = {"figure6", "figure7", "members", "terminations-collect-red-key"}
    assert {f"{name}.{kind}" for name in wanted} <= names
    explained = [goal["sub_goal"] for goal in metrics["saliency"]["sub_goals"] if goal["states"]]
    assert len(explained) > 1
    assert {name for name in names if name.startswith(("figure2", "figure9"))} == {
        f"figure{number}-{sub_goal}.{kind}" for number in (2, 9) for sub_goal in explained
    }
    assert names == {path.name for path in (tmp_path / "figures").iterdir()}
    files = [path for path in written if path.name != "captions.md"]
    assert all(path.read_bytes().startswith(b"%PDF") for path in files)
    captions = (tmp_path / "figures" / "captions.md").read_text(encoding="utf-8")
    assert re.findall(r"^## (.*)$", captions, re.M) == [path.name for path in files]
    assert "option agent: 1 run: layout seed 100" in captions
    assert [line.partition(":")[0] for line in missing] == ["Figure 3", "Figure 4", "Figure 5", "Figure 8"]
    assert all("It needs" in line and line in captions for line in missing)
    with pytest.raises(UserError, match="exists already"):
        draw_figures(tiny_run, tmp_path / "figures", kind)


def test_figures_on_request_from_the_command_line(tiny_run, tmp_path):
    """Spec F7, G2: files on stdout, what is missing on stderr; an unknown format is one line."""
    refuses("Choose one of svg, pdf, png", "report", tiny_run, "--figures", tmp_path / "a", "--format", "jpeg")
    assert not (tmp_path / "a").exists()
    told = run("report", tiny_run, "--figures", tmp_path / "a")
    assert "Figure 4: not drawn. It needs options artefacts with executions.csv" in told.err
    assert str(tmp_path / "a" / "figure6.svg") in told.out.splitlines()
    (tmp_path / "matplotlibrc").write_text("text.usetex: True\nfigure.dpi: 100000\nsavefig.bbox: tight\n")
    command = [sys.executable, "-P", "-m", "hypogoal", "report", str(tiny_run), "--figures", "b"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    drawn = [{file.name: file.read_bytes() for file in (tmp_path / name).iterdir()} for name in "ab"]
    assert drawn[0] == drawn[1]  # a figure is the same whatever the folder would have matplotlib do


def test_arrays_say_what_the_report_draws(tiny_run, metrics):
    """Spec F5, F6: curves per agent, overlays per option, examples per sub-goal, in plain HDF5."""
    with h5py.File(tiny_run / "evaluation" / "arrays.h5") as arrays:
        grid = arrays["curves/grid"][()]
        assert grid[0] == 0
        assert grid[-1] == STEPS
        for index, agent in enumerate(metrics["agents"]):
            assert arrays[f"curves/{index}/reward"].shape == (len(agent["runs"]), len(grid))
        some = next(iter(arrays["terminations/meta"].values()))
        assert some.shape == (64, 64, 3)
        counts = arrays["termination-states/meta/counts"][()]
        assert [str(option) for option in np.flatnonzero(counts)] == sorted(arrays["terminations/meta"], key=int)


def test_damaged_states_where_options_stop_are_one_line(tiny_copy):
    """Spec G2: the file is named, and no half-written evaluation is left."""
    path = tiny_copy / "meta" / "terminations.h5"
    path.write_bytes(path.read_bytes()[:-40])
    refuses("terminations.h5", "evaluate", tiny_copy, "--out", tiny_copy / "again", "-q")


def test_nothing_to_evaluate_is_one_line(tmp_path):
    """Spec G2."""
    refuses("nothing to evaluate", "evaluate", tmp_path)
    refuses("was not evaluated", "report", tmp_path)
