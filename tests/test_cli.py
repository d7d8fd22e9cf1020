"""The command line end to end on a toy scale, and each mistake's one line (Spec A1-A8, G2)."""

import json
from pathlib import Path

import pytest
from command_line import refuses, run
from shared_runs import CORRIDOR_RUN, DOORKEY_RUN, command


def test_show_and_verify(tiny_run: Path, tmp_path: Path) -> None:
    """Spec A6, A8: what is this, is it whole; what a machine is to read is JSON and nothing else."""
    for part, kind in (("data.h5", "data"), ("ensemble", "ensemble"), ("meta", "meta"), ("", "run")):
        assert json.loads(run("show", tiny_run / part, "--json").out)["kind"] == kind
        run("show", tiny_run / part)
        assert "whole" in run("verify", tiny_run / part).out
    said = run("show", tiny_run / "data.h5", "--json", "--pictures", tmp_path)
    assert json.loads(said.out)["kind"] == "data" and str(tmp_path) in said.err


def resumed(folder: Path, name: str, *more: str) -> list[str]:
    """The command of one of the shared run's outputs, to be continued."""
    return [*command(DOORKEY_RUN, folder, name), "--resume", *more]


def test_what_is_complete_is_kept(tiny_run: Path) -> None:
    """Spec A6, G1: what was made with the same settings, seed and inputs is neither made again nor changed."""
    commands = {
        tiny_run / "data.h5": resumed(tiny_run, "data.h5"),
        tiny_run / "ensemble": resumed(tiny_run, "ensemble", "--set", "workers=2"),  # of which no result depends
        tiny_run / "meta": resumed(tiny_run, "meta"),
        tiny_run / "evaluation": ["evaluate", tiny_run, "--resume", "-q"],
        tiny_run / "report" / "index.html": ["report", tiny_run, "--resume", "-q"],
    }
    for out, words in commands.items():
        said = run(*words)
        assert said.out == f"{out}\n" and " is complete already" in said.err


def test_what_was_made_otherwise_is_not_resumed(tiny_run: Path) -> None:
    """Spec A6, G1: by each command; which settings, seeds and inputs differ is the store's to find."""
    made_with, data = "the complete output was made with", tiny_run / "data.h5"
    refuses(f"{made_with} domain=doorkey, not montezuma", "collect", "montezuma", "--out", data, "--resume")
    refuses(f"{made_with} other inputs", *resumed(tiny_run, "ensemble", "--unlabelled", str(data)))
    refuses("not of kind 'baseline'", "train-baseline", "montezuma", "--out", tiny_run / "meta", "--resume")
    refuses(f"{made_with} videos=kept, not 2", "report", tiny_run, "--resume", "--videos", "2")


def test_same_seed_same_bytes(corridor_run: Path, corridor_copy: Path, tmp_path: Path) -> None:
    """Same seed, same machine, same bytes: every stage, in any number of processes, logs in TensorBoard or not."""
    boards = tmp_path / "boards"
    more = {"ensemble": ["--set", "workers=2", "--tensorboard", boards], "meta": ["--tensorboard", boards / "meta"]}
    for name in ("data.h5", "ensemble", "options", "meta", "ppo"):
        run(*command(CORRIDOR_RUN, corridor_copy, name), *more.get(name, []), "--force")
        made = corridor_run / name
        for path in [made, *made.rglob("*")]:
            if path.is_file() and path.name != "manifest.json":
                assert path.read_bytes() == (corridor_copy / path.relative_to(corridor_run)).read_bytes(), path
    for name in ("left-end", "meta"):
        assert any((boards / name).iterdir()), name


@pytest.fixture
def places(tiny_run: Path, tmp_path: Path) -> dict[str, Path]:
    """Where things are that commands are told of: what was made, an artefact to come, nothing."""
    made = {"made": tiny_run, "data": tiny_run / "data.h5", "ensemble": tiny_run / "ensemble"}
    return made | {name: tmp_path / name for name in ("none", "out")}


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("train-ensemble {ensemble} --out {out}", "is a directory"),
        ("train-meta {data} --out {out}", "no artefact here"),
        ("train-meta {made}/options --out {out}", "'options' artefact, but ensemble is needed"),
        ("train-ensemble {data} --out {ensemble}", "exists already"),
        ("train-ensemble {data} --out {data} --force", "would replace an input"),
        ("train-ensemble {data} --out {out} --set sub_goals=fly", "unknown sub-goal: fly"),
        ("train-ensemble {data} --out {out} --set sub_goals=open-red-door,open-red-door", "a sub-goal is named twice"),
        ("collect doorkey --out {out} --seed -1", "--seed"),
        ("collect chess --out {out}", "unknown domain: chess"),
        ("train-ensemble {data} --out {out} --diversity magic", "magic"),
        ("train-meta {ensemble} --out {out} --device tpu", "unknown device"),
        ("evaluate {none}", "no such run: "),
        ("report {made} --format pdf", "--format is for --figures"),
        ("config bake", "no such stage"),
    ],
)
def test_mistakes(places: dict[str, Path], line: str, words: str) -> None:
    """Spec G2: missing input, wrong kind, unknown names, values out of range: one line, nothing written."""
    refuses(words, *line.format(**places).split())


def test_config_lists_every_setting() -> None:
    """'hypogoal config STAGE': default, unit, meaning, source."""
    text = run("config", "train-meta").out
    assert "gae_lambda = 0.95" in text and "paper: 0.97" in text
    assert any(row["name"] == "steps" for row in json.loads(run("config", "train-meta", "--json").out))
