"""Spec A4, A8: ``train-meta --options`` continues options only where they fit."""

import shutil
from pathlib import Path

import pytest
from command_line import refuses, run, settings
from toy_data import reseal

from hypogoal.core.artefacts import open_artefact
from hypogoal.domains import episodes
from hypogoal.evaluation.curves import budget_of
from hypogoal.options.tables import Episodes

FEW = [*settings("environments=4", "warm_up=50", "steps=200", "max_episode_steps=30"), "-q"]


@pytest.mark.parametrize(
    ("ensemble", "pairs", "words"),
    [
        ("other-ensemble", [], "another ensemble"),
        ("ensemble", ["layout_seed=3"], "layout_seed=100, not 3"),
        ("ensemble", ["termination=oracle"], "termination=learned, not oracle"),
        ("ensemble", ["network=paper", "experience=own"], "network=light, not paper"),
    ],
)
def test_options_that_do_not_fit_are_refused(
    corridor_copy: Path, tmp_path: Path, ensemble: str, pairs: list[str], words: str
) -> None:
    """Spec A8, G2: one line that says what differs."""
    reseal(shutil.copytree(corridor_copy / "ensemble", corridor_copy / "other-ensemble"), seed=1)
    command = ["train-meta", corridor_copy / ensemble, "--options", corridor_copy / "options", *FEW, *settings(*pairs)]
    refuses(words, *command, "--out", tmp_path / "meta")


def test_options_that_fit_are_continued(corridor_run: Path, tmp_path: Path) -> None:
    """Spec A4: environment steps spent before count in the episodes' steps."""
    command = ["train-meta", corridor_run / "ensemble", "--options", corridor_run / "options", *FEW]
    run(*command, "--out", tmp_path / "meta")
    before = (corridor_run / "options/episodes.csv").read_text()
    after = (tmp_path / "meta" / "episodes.csv").read_text()
    assert after.startswith(before) and int(after.splitlines()[-1].split(",")[0]) > 400
    run(*command, "--out", tmp_path / "shorter", "--set", "max_episode_steps=7")
    steps = [int(row.split(",")[0]) for row in (tmp_path / "shorter/episodes.csv").read_text().splitlines()[1:]]
    assert min(steps) > 400, "episodes of practice in a world of longer episodes are none of the agent's"


def test_options_go_on_as_they_were_learned(corridor_run: Path, tmp_path: Path) -> None:
    """Spec D1, D8, H6: their time and what they see by are taken over; others are refused."""
    options, meta = tmp_path / "options", tmp_path / "meta"
    own = settings("option_timeout=40", "embedding=tiles")
    run("train-options", corridor_run / "ensemble", "--out", options, *FEW, *own)
    command = ["train-meta", corridor_run / "ensemble", "--options", options, "--out", meta, *FEW]
    refuses("trained with option_timeout=40, not 10", *command, "--set", "option_timeout=10")
    refuses("trained with embedding=tiles, not auto", *command, "--set", "embedding=auto")
    run(*command)
    config = open_artefact(meta).config
    assert (config["option_timeout"], config["embedding"]) == (40, "tiles")


def test_practice_that_succeeds_ends_and_the_meta_policy_counts_its_steps(
    corridor_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What ended it stands on the command's last line and in the manifest; its limit is none of what was spent."""
    monkeypatch.setattr(episodes, "LAST", 3)
    lines = {}
    for name, steps in (("early", "4000"), ("late", "40")):
        words = ["train-options", corridor_run / "ensemble", "--out", tmp_path / name, *FEW[:-1]]
        words += settings("until=0.3", f"steps={steps}")
        lines[name] = run(*words).out.splitlines()[-3]
        run(*words, "--resume")  # it is complete
    assert lines["early"].endswith("until=0.3 reached") and lines["late"].endswith("until=0.3 not reached")
    early, late = (open_artefact(tmp_path / name).config for name in lines)
    assert 40 < early["ended_at"] < early["steps"] == 4000 and early["until_reached"] is True
    assert (late["ended_at"], late["steps"], late["until_reached"]) == (40, 40, False)

    out = tmp_path / "meta"
    run("train-meta", corridor_run / "ensemble", "--options", tmp_path / "early", "--out", out, *FEW)
    agent = open_artefact(out)
    budget = budget_of(agent.config)
    assert agent.config["options_ended_at"] == early["ended_at"] and budget == early["ended_at"] + 200
    assert early["ended_at"] < Episodes.read(out / "episodes.csv").step[-1] <= budget
