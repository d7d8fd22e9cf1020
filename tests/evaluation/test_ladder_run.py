"""Spec A5, F1-F4, F7: a small run with ladders, in the real file formats, is evaluated and drawn end to end."""

import csv
import io
import json
import re
import shutil

import h5py
import numpy as np
import pytest
from command_line import refuses
from ladder_run import ROOMS, SUB_GOAL, LadderDomain, executions, write_options
from openings import agrees
from rich.console import Console
from toy_data import reseal

from hypogoal.core.artefacts import open_artefact
from hypogoal.data import open_dataset
from hypogoal.evaluation import judging
from hypogoal.evaluation.figure_files import draw_figures
from hypogoal.evaluation.questions import summary_table
from hypogoal.evaluation.run import find_artefacts
from hypogoal.hypotheses.ensemble import read_ensemble
from hypogoal.hypotheses.scores import member_scores, ranking
from hypogoal.stages.evaluate import evaluate
from hypogoal.stages.report import report

QUIET = {"quiet": True}


@pytest.fixture
def metrics(ladders):
    return json.loads((ladders / "evaluation" / "metrics.json").read_text(encoding="utf-8"))


@pytest.fixture
def page(ladders):
    return (ladders / "report" / "index.html").read_text(encoding="utf-8")


def test_the_page_opens_with_a_verdict_of_its_numbers(ladders):
    """Spec I1: options of several members against those of one classifier, recomputed from ``numbers.csv``."""
    task = "The reward and the end of an episode are those of the domain 'ladder_run:DOMAIN'"
    agrees(ladders, task, "Several hypotheses made no difference over 2 ladders: options", "Two runs are not evidence")


def test_members_are_judged_room_by_room(ladders, metrics):
    """Spec F1: recomputed here from the file and the weights: unseen rooms, all rooms, and the validated member."""
    ensemble = next(one for one in metrics["ensembles"] if one["path"] == "ensemble/dbat/groups-2-seed-1")
    assert (ensemble["method"], ensemble["groups"], ensemble["name"]) == ("dbat, K=2", 2, "dbat, K=2, groups=2")
    source = open_artefact(ladders / ensemble["path"])
    split = open_dataset(ladders / "data/groups-2.h5").heldout(SUB_GOAL)
    probabilities = read_ensemble(source.path, source.config, SUB_GOAL).predict(split.observations)
    yes = probabilities > 0.5
    (scopes,) = ensemble["sub_goals"]
    for name, inside in (
        ("unseen", np.isin(split.origins["room"], (9, 20))),
        ("all", np.ones(len(split.labels), dtype=bool)),
        ("labelled", np.isin(split.origins["room"], (1, 2, 6))),
    ):
        scores = member_scores(yes[inside], split.labels[inside])
        scores["ranking"] = ranking(probabilities[inside], split.labels[inside])
        for score in ("accuracy", "balanced_accuracy", "recall", "ranking"):
            found = [member[score] for member in scopes[name]["members"]]
            assert found == pytest.approx(scores[score].tolist())
        if name == "labelled":
            assert scopes[name]["validated_member"] == int(scores["balanced_accuracy"].argmax())


def test_any_number_of_processes_gives_the_same_evaluation(small_ladders, tmp_path, monkeypatch):
    """Spec G1, G5: judged in two processes: the same numbers and arrays; this run is too small for more than one."""
    metrics = evaluate(small_ladders, tmp_path / "alone", **QUIET).metrics
    cases = [case for _, case in judging.cases_of(find_artefacts(small_ladders, "ensemble"))]
    assert judging.processes_for(cases, 2) == 1
    monkeypatch.setattr(judging, "SPREAD_FROM", 0)
    monkeypatch.setenv("HYPOGOAL_CORES", "2")
    assert judging.processes_for(cases, 2) == 2
    assert evaluate(small_ladders, tmp_path / "again", **QUIET).metrics == metrics
    with h5py.File(tmp_path / "again/arrays.h5") as spread, h5py.File(tmp_path / "alone/arrays.h5") as alone:
        found = []
        alone.visititems(lambda name, item: found.append(name) if isinstance(item, h5py.Dataset) else None)
        assert found
        for name in found:
            assert np.array_equal(spread[name][()], alone[name][()]), name


def test_figure_3_has_a_row_per_method_and_n(metrics):
    """Spec F1: over both seeds, in order; with every ladder labelled no balanced accuracy, yet accuracy."""
    assert [(row["method"], row["groups"], row["ensembles"]) for row in metrics["rooms"]] == [
        (method, groups, 2) for method in ("dbat, K=2", "no diversity, K=2", "single CNN") for groups in (1, 2, 3)
    ]
    last = metrics["rooms"][2]
    assert last["positives"] == {"unseen": 0, "all": sum(ROOMS.values())}
    assert last["scores"]["unseen"]["balanced_accuracy"]["best"]["mean"] is None
    assert last["scores"]["unseen"]["balanced_accuracy"]["best"]["n"] == 0
    assert last["scores"]["unseen"]["accuracy"]["best"]["n"] == 2
    first = metrics["rooms"][0]
    own = [one for one in metrics["ensembles"] if (one["method"], one["groups"]) == ("dbat, K=2", 1)]
    members = [one["sub_goals"][0]["unseen"]["members"] for one in own]
    values = [max(member["balanced_accuracy"] for member in of_one) for of_one in members]
    found = first["scores"]["unseen"]["balanced_accuracy"]["best"]
    assert found["mean"] == pytest.approx(np.mean(values))
    assert found["standard_deviation"] == pytest.approx(np.std(values, ddof=1))
    assert metrics["hypotheses"] == []
    assert first["disagreement_heldout"]["mean"] is not None


def test_distances_are_those_of_the_tables(metrics):
    """Spec F3: members stop 10 (m + 1) + seed away on 1L and twice that on 2-6; the oracle at 0, 0, 4 and 8."""
    found = metrics["distance"]
    over = {row["method"]: row for row in found["over_ladders"]}
    assert list(over) == ["dbat, K=2", "no diversity, K=2", "single CNN", "oracle termination"]
    dbat, oracle = over["dbat, K=2"], over["oracle termination"]
    assert dbat["best"]["mean"] == pytest.approx(((10 + 20) / 2 + (11 + 22) / 2) / 2)
    assert dbat["worst"]["mean"] == pytest.approx(((20 + 40) / 2 + (21 + 42) / 2) / 2)
    assert dbat["best"]["standard_deviation"] == pytest.approx(np.sqrt(0.5) * 1.5)
    assert dbat["ladders"] == ["1L", "2-6"]
    assert (oracle["groups"], oracle["best"]["mean"], oracle["reached_base"]["mean"]) == (None, 3, 0.75)
    assert (oracle["died"]["mean"], oracle["timed_out"]["mean"]) == (0.25, 0)
    validated = {
        one["seed"]: one["sub_goals"][0]["labelled"]["validated_member"]
        for one in metrics["ensembles"]
        if (one["method"], one["groups"]) == ("dbat, K=2", 2)
    }
    wanted = [1.5 * (10 * (validated[seed] + 1) + seed) for seed in (0, 1)]
    assert dbat["validated"]["mean"] == pytest.approx(np.mean(wanted))
    assert len(found["options"]) == 2 * 2 * 4
    for row in found["options"]:
        fell = [np.nan, np.nan] if row["method"] == "oracle termination" else [0.5, 1 / (1 + np.exp(-1))]
        told = [np.nan if (edge := option["threshold"]) is None else edge for option in row["options"]]
        assert told == pytest.approx(fell[: len(told)], nan_ok=True)
    pairs = {(row["second"], row["quantity"].split()[1]): row for row in metrics["comparisons"]["distance"]}
    best, mean = pairs["single CNN", "best"], pairs["single CNN", "mean"]
    assert best["ties"] == best["n"] == 4 and best["units"] == 2
    assert mean["wins"] == mean["ties"] == 0  # its one member is D-BAT's nearer one
    assert {row["where"] for row in metrics["comparisons"]["rooms"]} == {"N=1", "N=2", "N=3"}
    assert metrics["agents"] == metrics["selection"] == []
    assert metrics["missing"] == []


def test_every_number_is_a_row_of_one_table(ladders, metrics):
    """Spec A5: numbers.csv says of each number what it is of, and has those of metrics.json."""
    with (ladders / "evaluation/numbers.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    place = {"method": "dbat, K=2", "sub_goal": SUB_GOAL, "member": "1", "seed": "1", "N": "2"}

    def of(quantity, **where):
        wanted = {**place, **where, "quantity": quantity}
        (row,) = [row for row in rows if all(row[name] == value for name, value in wanted.items())]
        return float(row["value"])

    assert of("distance", ladder="2-6") == 2 * (10 * 2 + 1)
    ensemble = next(one for one in metrics["ensembles"] if one["path"] == "ensemble/dbat/groups-2-seed-1")
    member = ensemble["sub_goals"][0]["unseen"]["members"][1]
    assert of("ranking", scope="unseen") == member["ranking"]
    assert {row["quantity"] for row in rows} <= set(metrics["quantities"])
    assert {row["artefact"] for row in rows} == {
        *(one["path"] for one in metrics["ensembles"]),
        *(one["path"] for one in metrics["distance"]["options"]),
    }


def test_stops_are_kept_to_be_drawn(ladders, metrics):
    """Spec F4: of the first seed's best members, in the room's picture, by what became of them."""
    one, other = metrics["distance"]["shown"]
    assert (one["ladder"], one["groups"], one["seed"], one["rooms"]) == ("1L", 2, 0, [1, 6])
    assert other["rooms"] == [2, 6, 1]
    assert [column["method"] for column in one["columns"]] == [
        "dbat, K=2", "no diversity, K=2", "single CNN", "oracle termination",
    ]  # fmt: skip
    with h5py.File(ladders / "evaluation" / "arrays.h5") as arrays:
        assert set(arrays["pictures"]) == {"1", "2", "6"}
        assert arrays["pictures/6"][0, 0, 0] == 30
        path = "stops/options/oracle/ladder-1L-seed-0/0"
        assert arrays[f"{path}/positions"][()].tolist() == [[1, 20 + away, 100] for away in (0, 0, 4, 8)]
        assert arrays[f"{path}/pixels"][0].tolist() == [20.5, 100.5]
        assert arrays[f"{path}/fates"][()].tolist() == [0, 0, 0, 1]


def test_attributions_are_of_an_ensemble_that_can_disagree(ladders, metrics):
    """Spec F2: of the smallest N with the most members, on states in unseen rooms, each complete."""
    found = metrics["saliency"]
    assert found["ensemble"] == "ensemble/dbat/groups-1-seed-0"
    (goal,) = found["sub_goals"]
    errors = [member["completeness_error"] for state in goal["states"] for member in state["members"]]
    assert len(errors) == 2 * len(goal["states"]) > 0
    assert max(errors) < 1e-9
    with h5py.File(ladders / "evaluation" / "arrays.h5") as arrays:
        group = arrays[f"saliency/{SUB_GOAL}"]
        assert group["attributions"].shape == (len(goal["states"]), 2, 36, 36, 4)
        places = json.loads(group["places"][()])
        assert all(re.fullmatch(r"room (2|6|9|20) \(unseen\)", place) for place in places)


def test_states_to_browse_say_room_and_kind(metrics, page):
    """Spec F2, F7: of the ensemble that options were learned with; members lead to those options, by ladder."""
    assert metrics["explorer"]["ensemble"] == "ensemble/dbat/groups-2-seed-0"
    (goal,) = json.loads(re.search(r'id="explorer-data">(.*?)</script>', page, re.S)[1])["goals"]
    assert {state["kind"] for state in goal["states"]} == {"base", "near-base", "on-ladder", "elsewhere"}
    assert {state["place"] for state in goal["states"]} >= {"room 9 (unseen)", "room 1 (labelled data from it)"}
    names = [option["name"] for option in goal["members"][1]["options"]]
    assert names == ["ladder 1L, seed 0", "ladder 2-6, seed 0"]
    assert ["distance from the true sub-goal", "20.0"] in goal["members"][1]["options"][0]["facts"]
    assert '<option value="near-base">' in page


def test_every_number_is_explained(metrics):
    """Spec A5: what metrics.json calls a number is in its own glossary; strict JSON as written."""
    known = set(metrics["quantities"])
    scopes = metrics["ensembles"][0]["sub_goals"][0]
    option = metrics["distance"]["options"][0]["options"][0]
    state = metrics["saliency"]["sub_goals"][0]["states"][0]
    for numbers in (
        *(set(scopes[name]) - {"members"} for name in ("unseen", "all", "labelled", "heldout", "unlabelled")),
        scopes["all"]["members"][0],
        option,
        state["members"][0],
        metrics["rooms"][0]["scores"]["all"]["accuracy"]["best"],
        metrics["distance"]["over_ladders"][0]["best"],
    ):
        assert set(numbers) - {"member", "option", "unit", "interval_over"} <= known
    assert {"scopes", "groups", "all_negative"} <= known


def test_the_terminal_summary_fits(metrics):
    """Spec A5: methods x N, for members and for where options stop, at 80 columns."""
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(summary_table(metrics))
    lines = console.export_text().splitlines()
    assert max(map(len, lines)) <= 80
    text = "\n".join(lines)
    assert re.search(r"no diversity, K=2 +│ 2 │ 0\.\d\d │", text)
    rows = {row["method"]: row for row in metrics["distance"]["over_ladders"]}
    best, mean = (re.escape(f"{rows['dbat, K=2'][which]['mean']:.1f}") for which in ("best", "mean"))
    assert best != mean
    assert re.search(rf"dbat, K=2 +│ 2 │ +{best} │ +\S+ │ +{mean} │ +\S+ │ +0 % ", text)
    assert re.search(r"oracle termination +│ – │ +3\.0 │ +– │ +3\.0 │ +3\.0 │ +75 % ", text)


def test_the_page_shows_ladders_and_nothing_of_agents(ladders, page):
    """Spec F7: its sections, Figures 3 to 5 with seeds, intervals, and what the paper claims; no empty section."""
    titles = re.findall(r"<h2>(.*?)</h2>", page)
    assert titles == [
        "Summary", "Hypotheses in rooms without labels", "Options on ladders", "Where options stop on the ladders",
        "Explore the hypotheses", "Ranking, whatever the threshold", "What members look at",
        "Data, settings, provenance",
    ]  # fmt: skip
    assert page.count("<figure") == 4
    assert "At N=3 no unseen room has positives left" in page
    assert "A member that is never positive has accuracy 0.86 (N=1), 0.86 (N=2) and 0.86 (N=3)" in page
    assert "Ladders: 1L and 2-6; seeds: 0 and 1." in page
    assert "not drawn" not in re.sub(r"rooms that are not drawn none", "", page)
    assert "Missing in this run" not in page
    names = {path.stem for path in (ladders / "report" / "figures").iterdir()}
    assert names == {"figure3", "figure4", "figure5-1L-N2", "figure5-2-6-N2"}
    ids = re.findall(r'\bid="([^"]+)"', page)
    assert len(ids) == len(set(ids))
    links = re.findall(r'(?:src|href)="([^"]+)"', page)
    assert all(link.startswith("data:image/png;base64,") or link[1:] in ids for link in links)


def test_the_papers_figures_as_files(ladders, tmp_path):
    """Spec F1-F4: Figures 2 to 5 and 9 of one sub-goal; what the agents' figures would need."""
    written, missing = draw_figures(ladders, tmp_path, "png")
    assert [path.stem for path in written] == [
        "figure2", "figure3", "figure4", "figure5-1L-N2", "figure5-2-6-N2", "figure9", "captions",
    ]  # fmt: skip
    assert [line.partition(":")[0] for line in missing] == ["Figure 6", "Figure 7", "Figure 8"]


def test_ensembles_alone(ladders, tmp_path):
    """Spec F1, F7: without options the page has Figure 3 and says what Figures 4 and 5 lack."""
    for name in ("data/groups-1.h5", "ensemble/dbat/groups-1-seed-0"):
        (tmp_path / name).parent.mkdir(parents=True)
    shutil.copy(ladders / "data/groups-1.h5", tmp_path / "data")
    shutil.copytree(ladders / "ensemble/dbat/groups-1-seed-0", tmp_path / "ensemble/dbat/groups-1-seed-0")
    metrics = evaluate(tmp_path, tmp_path / "evaluation", **QUIET).metrics
    assert metrics["missing"] == [
        "no ensemble artefact of an ensemble without diversity (Figure 3)",
        "no ensemble artefact of a single CNN (Figure 3)",
        "no options artefact of a ladder (Figures 4 and 5)",
    ]
    page = (report(tmp_path).path / "index.html").read_text(encoding="utf-8")
    assert page.count("<figure") == 1
    assert "no options artefact of a ladder (Figures 4 and 5)" in page
    assert "Learning curves" not in page
    Console(width=80, file=io.StringIO()).print(summary_table(metrics))


def test_options_without_their_ensembles_evaluation(ladders, tmp_path):
    """Spec F3: options may be made from an ensemble that is not in the run; N and method come from its manifest."""
    source = ladders / "ensemble/none/groups-2-seed-0"
    write_options(tmp_path / "options", source, "2-6", 3, executions(0, [7]) + executions(1, [5]), 2)
    metrics = evaluate(tmp_path, tmp_path / "evaluation", **QUIET).metrics
    (row,) = metrics["distance"]["over_ladders"]
    assert (row["method"], row["groups"], row["best"]["mean"]) == ("no diversity, K=2", 2, 5)
    assert row["validated"]["mean"] is None
    assert metrics["missing"][0] == "no ensemble"
    page = (report(tmp_path).path / "index.html").read_text(encoding="utf-8")
    assert "<li>no ensemble</li>" in page
    assert "Figure 5 of the paper: ladder 2-6, N=2, seed 3" in page


def test_a_table_of_executions_that_is_not_there(small_ladders):
    """Spec F, G2: options of a start without the table are named; a damaged table is one line."""
    options = small_ladders / "options/dbat/groups-2-ladder-1L-seed-0"
    (options / "executions.csv").write_text("step\n1\n", encoding="utf-8")
    refuses("executions.csv", "evaluate", small_ladders, "-q")
    shutil.rmtree(options)
    write_options(options, small_ladders / "ensemble/dbat/groups-2-seed-0", "1L", 0, [], 2)
    files = open_artefact(options).manifest.files
    reseal(options, files={name: digest for name, digest in files.items() if name != "executions.csv"})
    metrics = evaluate(small_ladders, small_ladders / "evaluation", **QUIET).metrics
    silent = "no executions.csv in options/dbat/groups-2-ladder-1L-seed-0: its domain tells no distance"
    assert silent in metrics["missing"]
    (row,) = (row for row in metrics["distance"]["over_ladders"] if row["method"].startswith("dbat"))
    assert (row["seeds"], row["incomplete_seeds"]) == (0, [0])
    page = (report(small_ladders).path / "index.html").read_text(encoding="utf-8")
    assert "Seeds that lack a ladder are left out: dbat, K=2, N=2" in page


def test_a_domain_without_pictures(small_ladders, monkeypatch):
    """Spec F4: what is missing is the pictures, not the numbers."""
    monkeypatch.setattr(LadderDomain, "pictures", False)
    metrics = evaluate(small_ladders, small_ladders / "evaluation", **QUIET).metrics
    assert metrics["distance"]["shown"] == []
    assert metrics["distance"]["over_ladders"][0]["best"]["mean"] is not None
    page = (report(small_ladders).path / "index.html").read_text(encoding="utf-8")
    assert "The domain has no pictures of its rooms" in page
