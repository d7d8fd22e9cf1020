"""Spec F5, F7: runs side by side, from real artefacts with made-up contents; what cannot be compared is one line."""

import json
import re
import shutil

import pandas as pd
import pytest
from command_line import refuses, run
from toy_data import fill, reseal, write_table

from hypogoal.core.artefacts import Artefact, open_artefact, sha256_of
from hypogoal.core.drafts import create
from hypogoal.evaluation.statistics import pairs
from hypogoal.stages.evaluate import evaluate
from hypogoal.tools.beside import labels_of, winners
from hypogoal.tools.compare import compare

STEPS = 3_000


def read_pairs(comparison):
    """Its table of pairs."""
    return pd.read_csv(comparison / "pairs.csv").astype({"N": "Int64"})


def write_baseline(run, agent, layout, seed, length, steps=STEPS, solved=1, **more):
    """A baseline artefact whose episodes all take ``length`` steps and reach the goal, or are cut."""
    config = {"agent": agent, "setting": "tuned", "steps": steps, "layout_seed": layout, "domain": "doorkey", **more}
    with create(run / f"{agent}/layout-{layout}-seed-{seed}", kind="baseline", config=config, seed=seed) as draft:
        out = draft.files
        rows = [(end, length, solved, solved, solved) for end in range(length, steps + 1, length)]
        write_table(out / "episodes.csv", ("step", "length", "reward", "terminated", "succeeded"), rows)
        facts = {"layout_seed": layout, "shortest_path": 10, "random_success": 0.1, "random_episodes": 20}
        (out / "layout.json").write_text(json.dumps(facts), encoding="utf-8")
        fill(out, "baseline", config)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two settings of one agent on two layouts and seeds, in which the second is faster but for one pair."""
    folder = tmp_path_factory.mktemp("runs")
    for name, shorter, rate in (("slow", 0, 1e-3), ("fast", 5, 1e-4)):
        for layout in (100, 101):
            for seed in (0, 1):
                usual = 20 + layout - 100
                length = usual - shorter if (layout, seed) != (101, 1) else usual + (name == "fast")
                write_baseline(folder / name, "ppo", layout, seed, length, learning_rate=rate)
        evaluate(folder / name, folder / name / "evaluation", quiet=True)
    write_baseline(folder / "slow", "dqn", 100, 0, 50)
    evaluate(folder / "slow", folder / "slow" / "evaluation", quiet=True, force=True)
    return folder


@pytest.fixture(scope="module")
def compared(runs):
    run("compare", runs / "slow", runs / "fast", "--out", runs / "both")
    return runs / "both"


def test_what_differs_is_told_and_nothing_else(compared):
    """Spec A8, F7: the setting that was changed; agents that only one run has show in what they bring."""
    differences = pd.read_csv(compared / "differences.csv", dtype=str).set_index(["of", "setting"])
    assert differences.to_dict("index") == {
        ("baseline", "agent"): {"slow": "dqn, ppo", "fast": "ppo"},
        ("baseline", "learning_rate"): {"slow": "0.001", "fast": "0.0001"},
    }


def test_runs_are_paired_by_layout_and_seed(compared):
    """Spec F5: the first run against the second by hand: it loses three pairs by 5 steps and wins one by 1."""
    pairs = read_pairs(compared).set_index("quantity")
    length, near = pairs.loc["length"], pairs.loc["near"]
    assert (length["first"], length["second"], length["of"]) == ("slow", "fast", "PPO tuned")
    assert (length["n"], length["wins"], length["probability"]) == (4, 1, 0.25)
    assert length["difference"] == pytest.approx((5 + 5 + 5 - 1) / 4)
    assert (near["n"], near["wins"], near["ties"], near["difference"]) == (4, 0, 2, -0.5)  # 15 steps of 10 are near
    assert [line for line in run("show", compared).out.splitlines() if line.startswith("PPO tuned: length: ")]


def test_the_page_shows_both(compared):
    """Spec F7: curves, every agent in the table, one file, its inputs known."""
    text = (compared / "index.html").read_text(encoding="utf-8")
    titles = re.findall(r"<h3[^>]*>(.*?)</h3>", text)
    assert titles == ["Methods compared run by run", "Summary", "What differs"]
    assert "DQN tuned" in text and "within 1.5 shortest paths</th>" in text
    assert text.count("<figure") == 1 and not re.search(r'(?:src|href)="(?!#|data:)', text)
    artefact = open_artefact(compared, "comparison")
    assert [entry.kind for entry in artefact.manifest.inputs] == ["evaluation", "evaluation"]
    assert len([*(compared / "figures").iterdir()]) == 1, "rewards are alike, lengths are not"


def test_lengths_are_compared_where_somebody_solved_something(tmp_path):
    """Spec F5: an episode that was cut is as long as its limit, which is no tie of two agents."""
    for name, solved in (("one", 0), ("other", 0), ("solving", 1)):
        for seed in (0, 1):
            write_baseline(tmp_path / name, "ppo", 100, seed, 40, solved=solved)
        evaluate(tmp_path / name, quiet=True)
    nobody = read_pairs(compare([tmp_path / "one", tmp_path / "other"], tmp_path / "nobody").path)
    assert nobody["quantity"].tolist() == ["success", "near"] and (nobody["ties"] == 2).all()
    one = read_pairs(compare([tmp_path / "one", tmp_path / "solving"], tmp_path / "somebody").path)
    assert {"success", "length"} <= {*one["quantity"]}


def test_runs_of_one_agent_without_a_common_seed_have_no_pairs(tmp_path):
    """Spec F5: the page has both in its table; nobody wins."""
    for name, seed in (("one", 0), ("other", 1)):
        write_baseline(tmp_path / name, "ppo", 100, seed, 40)
        evaluate(tmp_path / name, quiet=True)
    made = compare([tmp_path / "one", tmp_path / "other"], tmp_path / "out")
    assert read_pairs(made.path).empty
    assert "no two runs share a seed" in run("show", made.path).out


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"domain": "doorkey"', '"domain": "montezuma"', "other: montezuma)"),
        ('"agents": {', '"agents": {}, "others": {', "no kind of result in common"),
        ('"format": 7', '"format": 1', "another version of hypogoal evaluated this (format 1, needed: 7)"),
    ],
)
def test_evaluations_that_do_not_fit_are_refused(runs, tmp_path, old, new, words):
    """Spec G2: another domain, other settings, nothing in common, another version's."""
    shutil.copytree(runs / "fast", tmp_path / "other")
    path = tmp_path / "other" / "evaluation" / "run.json"
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    reseal(path.parent, files={**Artefact(path.parent).manifest.files, path.name: sha256_of(path)})
    refuses(words, "compare", runs / "slow", tmp_path / "other", "--out", tmp_path / "out")


def test_what_cannot_be_compared_is_refused(runs, tmp_path):
    """Spec G2: one run, one run twice, one that was not evaluated, into one of them."""
    slow, fast, out = runs / "slow", runs / "fast", tmp_path / "out"
    (tmp_path / "empty").mkdir()
    refuses("two or more different runs", "compare", slow, "--out", out)
    refuses("two or more different runs", "compare", slow, fast, runs / "both" / ".." / "slow", "--out", out)
    refuses("was not evaluated", "compare", slow, tmp_path / "empty", "--out", out)
    refuses("would replace an input", "compare", slow, fast, "--out", fast)
    assert labels_of(["/a/run", "/b/run"]) == ["a/run", "b/run"]  # as short as tells them apart


@pytest.mark.parametrize(("of", "winner"), [("success", "slow beats fast"), ("length", "fast beats slow")])
def test_the_winner_is_the_better_one(of, winner):
    """Spec F5: the first has the higher values in each of six layouts, and of lengths the lower is better."""
    runs = [
        {"method": name, "N": pd.NA, "ladder": "", "sub_goal": "", "layout": layout, "seed": 0, "value": value}
        for name, value in (("slow", 1.0), ("fast", 0.5))
        for layout in range(6)
    ]
    both = pairs(pd.DataFrame(runs).assign(of=of, quantity=of)).assign(of="PPO tuned")
    (line,) = winners(both)
    assert line.startswith(f"PPO tuned: {of}: {winner} (slow +0.5, 95 % [0.5, 0.5], n = 6;")
