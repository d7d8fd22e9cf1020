"""Spec A5, F1-F4, F7: a small run with ladders, in the real file formats, is evaluated and drawn end to end."""

import re
import shutil

import h5py
import numpy as np
import pandas as pd
import pytest
from command_line import refuses
from ladder_run import ROOMS, SUB_GOAL, executions, write_options
from openings import agrees

from hypogoal.core.artefacts import open_artefact
from hypogoal.data import open_dataset
from hypogoal.evaluation import judging, saliency
from hypogoal.evaluation.distance import HIT, MISS, STOP
from hypogoal.evaluation.questions import answers, summary
from hypogoal.evaluation.run import find_artefacts, read_evaluation
from hypogoal.hypotheses.ensemble import read_ensemble
from hypogoal.hypotheses.scores import member_scores, ranking
from hypogoal.stages.evaluate import evaluate
from hypogoal.stages.report import report

QUIET = {"quiet": True}
DBAT, NONE, ONE = "D-BAT, 2 members", "no diversity, 2 members", "one classifier"


@pytest.fixture
def results(ladders):
    return read_evaluation(ladders)


@pytest.fixture
def page(ladders):
    return (ladders / "report" / "index.html").read_text(encoding="utf-8")


def table_of(run, name):
    """A table of a run, by what it is of."""
    table = pd.read_csv(run / "evaluation" / "tables" / f"{name}.csv")
    return table.set_index([column for column in ("method", "N", "quantity") if column in table])


def test_the_page_opens_with_a_verdict_of_its_numbers(ladders):
    """Spec I1: options of several members against those of one classifier, recomputed from ``numbers.csv``."""
    task = "The reward and the end of an episode are those of the domain 'ladder_run:DOMAIN'"
    alike = "Having several hypotheses made no difference on these 2 ladders: options"
    agrees(ladders, task, alike, "Fewer than six layouts or seeds are not evidence")


def test_members_are_judged_room_by_room(ladders, results):
    """Spec F1: recomputed here from the file and the weights: unseen rooms, all rooms, and the validated member."""
    path = "ensemble/dbat/groups-2-seed-1"
    source = open_artefact(ladders / path)
    split = open_dataset(ladders / "data/groups-2.h5").heldout(SUB_GOAL)
    probabilities = read_ensemble(source.path, source.config, SUB_GOAL).predict(split.observations)
    yes = probabilities > 0.5
    for scope, inside in (
        ("unseen", np.isin(split.origins["room"], (9, 20))),
        ("all", np.ones(len(split.labels), dtype=bool)),
        ("labelled", np.isin(split.origins["room"], (1, 2, 6))),
    ):
        scores = member_scores(yes[inside], split.labels[inside])
        scores["ranking"] = ranking(probabilities[inside], split.labels[inside])
        for score in ("accuracy", "balanced_accuracy", "recall", "ranking"):
            found = results.of(artefact=path, scope=scope, quantity=score)
            assert (found["method"] == DBAT).all() and (found["N"] == 2).all()
            assert found["value"].tolist() == pytest.approx(scores[score].tolist())
        if scope == "labelled":
            picked = results.of(artefact=path, quantity="validated_member")["value"]
            assert picked.tolist() == [scores["balanced_accuracy"].argmax()]


def test_any_number_of_processes_gives_the_same_evaluation(small_ladders, tmp_path, monkeypatch):
    """Spec G1, G5: judged in two processes: the same numbers and arrays; this run is too small for more than one."""
    evaluate(small_ladders, tmp_path / "alone", **QUIET)
    ensembles = [(each, each.input("data")) for each in find_artefacts(small_ladders, "ensemble")]
    assert judging.processes_for(ensembles) == 1
    monkeypatch.setattr(judging, "SPREAD_FROM", 0)
    monkeypatch.setattr(judging, "cores", lambda: 2)
    assert judging.processes_for(ensembles) == 2
    evaluate(small_ladders, tmp_path / "again", **QUIET)
    for name in ("numbers.csv", "run.json", "tables/rooms.csv"):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "alone" / name).read_bytes()
    with h5py.File(tmp_path / "again/arrays.h5") as spread, h5py.File(tmp_path / "alone/arrays.h5") as alone:
        found = []
        alone.visititems(lambda name, item: found.append(name) if isinstance(item, h5py.Dataset) else None)
        assert found
        for name in found:
            assert np.array_equal(spread[name][()], alone[name][()]), name


def test_figure_3_has_a_row_per_method_and_n(ladders, results):
    """Spec F1: over both seeds, in order; with every ladder labelled no balanced accuracy, yet accuracy."""
    table = table_of(ladders, "rooms")
    best = "accuracy, unseen, best"
    found = table[table.index.get_level_values("quantity") == best]
    assert found.index.droplevel(2).tolist() == [(method, n) for method in (DBAT, NONE, ONE) for n in (1, 2, 3)]
    assert (found["n"] == 2).all()
    assert (DBAT, 3, "balanced_accuracy, unseen, best") not in table.index
    positives = results.of(quantity="positives", N=3).groupby("scope")["value"].max()
    assert (positives["unseen"], positives["all"]) == (0, sum(ROOMS.values()))
    own = results.of(method=DBAT, N=1, scope="unseen", quantity="balanced_accuracy")
    values = own.groupby("seed")["value"].max()
    found = table.loc[DBAT, 1, "balanced_accuracy, unseen, best"]
    assert (found["mean"], found["standard_deviation"]) == pytest.approx((values.mean(), values.std()))
    assert not (ladders / "evaluation/tables/hypotheses.csv").exists()
    assert (DBAT, 1, "disagreement, heldout") in table.index


def test_distances_are_those_of_the_tables(ladders, results):
    """Spec F3: members stop 10 (m + 1) + seed away on 1L and twice that on 2-6; the oracle at 0, 0, 4 and 8."""
    table = table_of(ladders, "distance").droplevel("N")
    assert [*dict.fromkeys(table.index.get_level_values("method"))] == [DBAT, NONE, ONE, "oracle termination"]
    dbat, oracle = table.loc[DBAT], table.loc["oracle termination"]
    assert dbat["mean"]["best"] == pytest.approx(((10 + 20) / 2 + (11 + 22) / 2) / 2)
    assert dbat["mean"]["worst"] == pytest.approx(((20 + 40) / 2 + (21 + 42) / 2) / 2)
    assert dbat["standard_deviation"]["best"] == pytest.approx(np.sqrt(0.5) * 1.5)
    shares = [oracle["mean"][name] for name in ("best", "reached_base", "died", "timed_out")]
    assert shares == [3, 0.75, 0.25, 0]
    validated = results.of(quantity="validated_member", scope="labelled", method=DBAT, N=2).set_index("seed")["value"]
    wanted = [1.5 * (10 * (validated[seed] + 1) + seed) for seed in (0, 1)]
    assert dbat["mean"]["validated"] == pytest.approx(np.mean(wanted))
    pairs = pd.read_csv(ladders / "evaluation/tables/distance-pairs.csv").set_index(["second", "quantity"])
    best = pairs.loc[ONE, "best"]
    assert best["ties"] == best["n"] == 4 and best["units"] == 2
    assert {*pd.read_csv(ladders / "evaluation/tables/rooms-pairs.csv")["N"]} == {1, 2}
    assert results.facts["agents"] == {} and results.facts["missing"] == []


def test_stops_are_kept_to_be_drawn(ladders, results):
    """Spec F4: of the first seed's best members, in the room's picture, by what became of them."""
    assert results.arrays["pictures/6"][0, 0, 0] == 30
    assert not any("seed-1" in name for name in results.arrays if name.startswith("stops"))
    stops = pd.DataFrame(results.arrays["stops/options/oracle/ladder-1L-seed-0"], columns=STOP)
    assert stops["room"].tolist() == [1] * 4
    assert stops["column"].tolist() == [20.5 + away for away in (0, 0, 4, 8)] and stops["row"][0] == 100.5
    assert stops["fate"].tolist() == [HIT, HIT, HIT, MISS]


def test_attributions_are_of_the_ensemble_that_options_were_learned_with(results):
    """Spec F2: on states in unseen rooms, each complete; the gallery has every kind of place."""
    looked_at = results.facts["looked_at"]
    assert looked_at["ensemble"]["artefact"] == "ensemble/dbat/groups-2-seed-0"
    told = looked_at["sub_goals"][SUB_GOAL]
    assert 0 <= told["completeness_error"] < 1e-9
    explained = results.arrays[f"saliency/{SUB_GOAL}/attributions"]
    assert explained.shape == (saliency.EXPLAINED, 2, 36, 36, 4)
    drawn = told["places"][: len(told["kinds"])]
    assert all(re.fullmatch(r"room (9|20) \(unseen\)", place) for place in drawn)
    assert {*told["places"]} >= {"room 9 (unseen)", "room 1 (labelled data from it)"}


def test_the_terminal_summary_fits(ladders, results):
    """Spec A5: methods x N, for members and for where options stop, at 80 columns."""
    lines = summary(results, answers(results))
    assert max(map(len, lines)) <= 80
    text = "\n".join(lines)
    assert re.search(r"no diversity, 2 members +│ 1 +│ +0\.\d\d │", text)
    means = table_of(ladders, "distance").sort_index().loc[DBAT, 2]["mean"]
    assert re.search(rf"2 +│ {DBAT} +│ +{means['best']:.1f} │ +\S+ │ +{means['mean']:.1f} │ +\S+ │", text)
    assert re.search(r"– +│ oracle termination +│ +3\.0 │ +– │ +3\.0 │ +3\.0 │", text)


def test_the_page_shows_ladders_and_nothing_of_agents(ladders, page):
    """Spec F7: its sections, Figures 2 to 5 with seeds, intervals, and what the paper claims; no empty section."""
    assert re.findall(r"<h2>(.*?)</h2>", page) == [
        "What the hypotheses say", "Hypotheses in rooms without labels", "Options on ladders", "What members look at",
        "Data, settings, provenance",
    ]  # fmt: skip
    assert page.count("<figure") == 5
    assert "A dash means that no unseen room has positives left" in page
    assert "averaged over the ladders 1L and 2-6 and over the seeds 0 and 1" in page
    assert "This run lacks" not in page
    names = {path.stem for path in (ladders / "report" / "figures").iterdir()}
    assert names == {"figure2", "figure3", "figure4", "figure5-1L", "figure5-2-6"}, "Figure 9 is drawn once asked for"


def test_ensembles_alone(ladders, tmp_path):
    """Spec F1, F7: without options the page has Figure 3; what nobody made is not missed."""
    for name in ("data/groups-1.h5", "ensemble/dbat/groups-1-seed-0"):
        (tmp_path / name).parent.mkdir(parents=True)
    shutil.copy(ladders / "data/groups-1.h5", tmp_path / "data")
    shutil.copytree(ladders / "ensemble/dbat/groups-1-seed-0", tmp_path / "ensemble/dbat/groups-1-seed-0")
    evaluate(tmp_path, **QUIET)
    results = read_evaluation(tmp_path)
    assert results.facts["missing"] == []
    page = (report(tmp_path).path / "index.html").read_text(encoding="utf-8")
    assert 'id="figure-figure3"' in page and "Options on ladders" not in page
    assert summary(results, answers(results))


def test_options_without_their_ensembles_evaluation(ladders, tmp_path):
    """Spec F3: options may be made from an ensemble that is not in the run; N and method come from its manifest."""
    source = ladders / "ensemble/none/groups-2-seed-0"
    write_options(tmp_path / "options", source, "2-6", 3, executions(0, [7]) + executions(1, [5]), 2)
    evaluate(tmp_path, **QUIET)
    table = table_of(tmp_path, "distance")
    assert table.loc[NONE, 2, "best"]["mean"] == 5
    assert (NONE, 2, "validated") not in table.index
    page = (report(tmp_path).path / "index.html").read_text(encoding="utf-8")
    assert "<li>no ensemble</li>" in page
    assert "Figure 5 for ladder 2-6 and the first seed" in page


def test_a_damaged_table_is_one_line(small_ladders):
    """Spec G2."""
    (small_ladders / "options/dbat/groups-2-ladder-1L-seed-0/executions.csv").write_text("step\n1\n", encoding="utf-8")
    refuses("executions.csv", "evaluate", small_ladders, "-q")
