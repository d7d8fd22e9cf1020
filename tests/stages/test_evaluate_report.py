"""Spec A5, F, F7: a run of real, tiny artefacts is evaluated and drawn; what is missing is named."""

import json
import re
import shutil
import tomllib
from base64 import b64encode
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from command_line import refuses, run, trusting
from openings import agrees
from toy_data import reseal

from hypogoal.cells import Cell
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.errors import UserError
from hypogoal.data import open_dataset
from hypogoal.evaluation import table
from hypogoal.evaluation.run import read_evaluation
from hypogoal.experiments.run import begin
from hypogoal.hypotheses.ensemble import read_ensemble
from hypogoal.stages.evaluate import evaluate
from hypogoal.stages.report import report
from hypogoal.stages.train_meta import train_meta

STEPS = 1_024 + 2_048  # of options, then of agents
GOALS = ["collect-red-key", "open-red-door"]


@pytest.fixture
def results(tiny_run):
    """What was found in the shared run."""
    return read_evaluation(tiny_run)


def page_of(folder, **how):
    """The page of a run that is drawn now."""
    return (report(folder, **how).path / "index.html").read_text(encoding="utf-8")


def test_the_page_opens_with_the_task_and_a_verdict_of_its_numbers(tiny_run):
    """Spec I1: recomputed from ``numbers.csv``."""
    agrees(tiny_run, "Take the red key, open the red door and reach the goal", "One run is not")
    page = (tiny_run / "report" / "index.html").read_text()
    assert '<a href="#choosing">What choosing is worth</a>.' in page and 'id="choosing"' in page


def test_agents_are_grouped_and_counted_whole(tiny_run, results):
    """Spec F5, E6, E7: the steps of train-options count, and its artefact is not an agent of its own."""
    assert [*results.of(quantity="reward", step=pd.NA)["method"]] == [
        "option agent", "random choice", "oracle terminations", "PPO tuned",
    ]  # fmt: skip
    own = results.of(artefact="meta", step=pd.NA, scope="").set_index("quantity")["value"]
    rows = (tiny_run / "meta" / "episodes.csv").read_text().splitlines()[1:]
    assert (own["steps"], own["episodes"]) == (STEPS, len(rows))
    last = np.array([row.split(",") for row in rows[-100:]], dtype=float)
    assert own["length"] == pytest.approx(last[:, 1].mean())
    assert own["success"] == pytest.approx(last[:, 3].mean())
    assert own["length_over_shortest"] == pytest.approx(last[:, 1].mean() / own["shortest_path"])
    curve = results.of(artefact="meta", quantity="reward")["step"].dropna()
    assert (curve.min() > 0, curve.max()) == (True, STEPS)


def test_an_agent_without_a_whole_episode_is_said_to_be_one(corridor_run, tmp_path):
    """Spec F5: there is no success to speak of, neither 0 nor a dash."""
    train_meta(corridor_run / "ensemble", tmp_path / "meta", steps=8, environments=4, max_episode_steps=30)
    numbers = evaluate(tmp_path).metrics
    assert "success" not in {*numbers[numbers["scope"] == ""]["quantity"]}
    page = page_of(tmp_path)
    assert "No episode of an agent has ended yet" in page and "reached the goal in" not in page


def test_members_are_judged_on_heldout_states(tiny_run, results):
    """Spec F1, F2: numbers of each ensemble, sub-goal and member, recomputed here from the file and the weights."""
    methods = results.of(quantity="states").drop_duplicates("artefact").set_index("artefact")["method"]
    dbat = "D-BAT, 2 members"
    assert methods.to_dict() == {"another": dbat, "ensemble": dbat, "ensemble-none": "no diversity, 2 members"}
    source = open_artefact(tiny_run / "ensemble")
    split = open_dataset(tiny_run / "data.h5").heldout("collect-red-key")
    yes = read_ensemble(source.path, source.config, "collect-red-key").predict(split.observations) > 0.5
    recall, rejections = yes[split.labels].mean(0), (~yes)[~split.labels].mean(0)
    own = results.of(artefact="ensemble", sub_goal="collect-red-key", scope="heldout").set_index("quantity")["value"]
    np.testing.assert_allclose(own["balanced_accuracy"], (recall + rejections) / 2)
    assert own["disagreement"] == pytest.approx((yes[:, 0] != yes[:, 1]).mean())
    assert own["layouts"] == len(set(split.origins["layout_seed"].tolist()))
    table = pd.read_csv(tiny_run / "evaluation/tables/hypotheses.csv")
    assert len(table[table["quantity"] == "best"]) == len(GOALS) + 1


def test_selection_counts_every_decision(tiny_run, results):
    """Spec F6: what was chosen and offered, and the random chooser's control beside it; oracle has no members."""
    table = pd.read_csv(tiny_run / "evaluation/tables/selection.csv")
    assert [*table["method"].unique()] == ["option agent", "random choice"]
    choices = np.genfromtxt(tiny_run / "meta-random" / "choices.csv", delimiter=",", names=True)
    random = table[table["method"] == "random choice"]
    assert len(random) == 4
    assert random["chosen"].sum() == choices["chosen"].sum()
    assert random["expected"].sum() == pytest.approx(choices["chosen"].sum())
    often = random["preference"][random["expected"] > 20]
    assert len(often) and often.between(0.5, 1.7).all()
    overlaid = [name for name in results.arrays if name.startswith("terminations/meta/")]
    assert results.arrays[overlaid[0]].shape == (64, 64, 3)
    assert 0 < len(overlaid) <= 4


def test_every_number_is_explained(tiny_run, results):
    """Spec A5, A8: each quantity has its unit and meaning, run.json is strict, the inputs' hashes in the manifest."""
    meanings = tomllib.loads((Path(table.__file__).parent / "quantities.toml").read_text(encoding="utf-8"))
    assert {*results.numbers["quantity"]} <= {*meanings}

    def refuse(name):
        raise AssertionError(name)

    json.loads((tiny_run / "evaluation" / "run.json").read_text(), parse_constant=refuse)
    kinds = sorted(entry.kind for entry in open_artefact(tiny_run / "evaluation", "evaluation").manifest.inputs)
    assert kinds == ["baseline", "data", "ensemble", "ensemble", "ensemble", "meta", "meta", "meta"]


def test_what_is_missing_is_named(results, tiny_run, tmp_path):
    """Spec F: no silent absence, in the results, on the page and in an evaluation of a run with a baseline only."""
    assert results.facts["missing"] == [], "what nobody asked for is not missed"
    shutil.copytree(tiny_run / "ppo", tmp_path / "ppo")
    evaluate(tmp_path)
    assert read_evaluation(tmp_path).facts["missing"] == ["no ensemble"]
    assert "<li>no ensemble</li>" in page_of(tmp_path)


def test_hypotheses_alone_are_told_in_the_terminal(tiny_run, tmp_path, monkeypatch):
    """Spec A5, A8, F1: a table of members, none of agents that nobody trained; 'show' tells it again, damage too.

    Spec G4: a mean over nine of ten seeds says that it is one.
    """
    monkeypatch.setenv("COLUMNS", "80")
    for name in ("ensemble", "ensemble-none"):
        shutil.copytree(tiny_run / name, tmp_path / name)
    shutil.copy(tiny_run / "data.h5", tmp_path / "data.h5")
    begin([Cell(name=name, words=["train-ensemble", "d"], run=tmp_path) for name in ("ensemble", "other")], tmp_path)
    *lines, then, where = run("evaluate", tmp_path).out.splitlines()
    assert max(map(len, lines)) <= 80
    assert (then, where) == (f"next: hypogoal report {tmp_path}", str(tmp_path / "evaluation"))
    told = "\n".join(lines)
    assert "D-BAT, 2 members" in told and "no diversity, 2 members" in told
    assert "PPO" not in told and "last 100" not in told
    facts = json.loads((tmp_path / "evaluation" / "run.json").read_text(encoding="utf-8"))
    assert facts["missing"] == ["1 of the run's cells are not done; the first is other"]
    table = pd.read_csv(tmp_path / "evaluation/tables/hypotheses.csv").set_index(["method", "sub_goal", "quantity"])
    means = table["mean"].sort_index()["D-BAT, 2 members", "collect-red-key"]
    (line,) = (line for line in lines if "collect-red-key" in line)
    assert [cell.strip() for cell in line.split("│")[3:6]] == [
        f"{means[which]:.3f}" for which in ("best", "mean", "worst")
    ]
    for path in (tmp_path, tmp_path / "evaluation"):
        assert line in run("show", path).out.splitlines()
    (tmp_path / "evaluation" / "run.json").write_text("{}", encoding="utf-8")
    refuses("run.json", "show", tmp_path)


def test_the_page_needs_nothing_else(tiny_run):
    """Spec F7: pictures are in it, every link leads to a place on it, nothing is fetched."""
    page = (tiny_run / "report" / "index.html").read_text(encoding="utf-8")
    ids = re.findall(r'\bid="([^"]+)"', page)
    assert len(ids) == len(set(ids))
    links = re.findall(r'\b(?:src|href)="([^"]+)"', page)
    drawn = tuple(f"data:image/{kind};base64," for kind in ("webp", "gif", "svg+xml"))
    assert all(link.startswith(drawn) or link.removeprefix("#") in ids for link in links)
    assert len(links) > len(ids) and not re.search(r"<(link|iframe|object)|fetch\(|import\(|url\(|https?://", page)


def test_the_page_shows_all_of_it_each_time_the_same(tiny_run, tiny_copy):
    """Spec F5, F6, F7, G1: curves, hypotheses, examples, overlays, choices, provenance, with seeds in the captions."""
    page = page_of(tiny_copy, force=True)
    assert page == (tiny_run / "report" / "index.html").read_text(encoding="utf-8")
    for title in (
        "What the hypotheses say", "Summary", "Hypotheses",
        "Which hypotheses are chosen, and where they stop", "What members look at", "Data, settings, provenance",
    ):  # fmt: skip
        assert f"<h2>{title}</h2>" in page
    names = [path.name for path in (tiny_run / "report" / "figures").iterdir()]
    assert {"figure6.svg", "members.svg", "figure7.svg"} <= {*names}
    assert page.count("data:image/gif;base64,") == 1
    assert re.search(r"Episode \d of meta on layout 100 has \d+ steps", page)
    assert page.count("<h3>Methods compared run by run") == 1, "one run of an agent is no table of pairs"
    assert "The layout is 100, and the run seed is 0." in page
    assert "This run lacks" not in page


def test_what_changed_since_is_said(tiny_copy):
    """Spec A5, E1, F7: what an evaluation does not know of; its film needs no agent, others do."""
    (kept,) = (path for path in (tiny_copy / "report" / "videos").iterdir() if path.suffix == ".gif")
    film = (tiny_copy / "evaluation" / "film.gif").read_bytes()
    assert kept.name == "meta-episode-0.gif" and kept.read_bytes() == film
    assert not [line for line in read_evaluation(tiny_copy).facts["missing"] if "since" in line]
    reseal(shutil.copytree(tiny_copy / "ppo", tiny_copy / "later"), seed=1)
    (tiny_copy / "meta" / "options.safetensors").unlink()
    text = page_of(tiny_copy, force=True)
    assert "later: made since this evaluation" in text
    assert b64encode(film).decode() in text
    assert "image/gif" not in page_of(tiny_copy, videos=0, force=True)
    with pytest.raises(UserError, match=r"options\.safetensors"):
        report(tiny_copy, videos=1, force=True)


def test_numbers_need_no_film(tiny_run, tmp_path):
    """Spec E1, F7, G2: an agent ends options by code that the user has not allowed; only a film needs this code."""
    with trusting():
        few = {"steps": 64, "environments": 4, "max_episode_steps": 30}
        train_meta(tiny_run / "ensemble", tmp_path / "meta", termination="odd_parts:Never", **few)
    told = run("evaluate", tmp_path).out
    assert "no film of an episode: a file names code of its own" in told and ".." not in told
    page = page_of(tmp_path)
    assert "no film of an episode: " in page and "odd_parts:Never" in page and "image/gif" not in page
    refuses("odd_parts:Never", "report", tmp_path, "--videos", "1", "--force")


def test_the_papers_figures_as_files(tiny_run, tmp_path, monkeypatch):
    """Spec F2, F5, F6, F7: those that the run has artefacts for, with captions; of the others what they need.

    Spec G1: whatever a matplotlibrc says they are those of the page, to the byte.
    """
    for setting, value in {"text.usetex": True, "figure.dpi": 1000, "savefig.bbox": "tight"}.items():
        monkeypatch.setitem(mpl.rcParams, setting, value)
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
    for name in ("figure6", "figure7", "members"):
        assert (tmp_path / f"a/{name}.svg").read_bytes() == (tiny_run / f"report/figures/{name}.svg").read_bytes()


def test_what_cannot_be_evaluated_is_one_line(tiny_copy, tmp_path):
    """Spec G2: nothing there, or a damaged file, which is named; no half-written evaluation is left."""
    refuses("nothing to evaluate", "evaluate", tmp_path / "tiny" / "report" / "figures")
    refuses("was not evaluated", "report", tiny_copy / "report")
    shutil.copytree(tiny_copy / "evaluation", tmp_path / "bare" / "evaluation")
    refuses("Videos need a meta artefact", "report", tmp_path / "bare", "--videos", "1")
    path = tiny_copy / "meta" / "terminations.h5"
    path.write_bytes(path.read_bytes()[:-40])
    refuses("terminations.h5", "evaluate", tiny_copy, "--out", tiny_copy / "again", "-q")
