"""The examples go through the stages by the command line, as their readers would take them (Spec B6)."""

from __future__ import annotations

import ast
import csv
import json
import runpy
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from openings import agrees
from PIL import Image
from safetensors.torch import load_file
from test_docs import blocks, commands
from torch import nn

from hypogoal import OptionEnv, load_ensemble, load_options
from hypogoal.cli import main
from hypogoal.core import own_code
from hypogoal.core.errors import UserError
from hypogoal.data import open_dataset
from hypogoal.evaluation import attributing

EXAMPLES = Path(__file__).parents[2] / "examples"
MOST_LINES = 30
UNKNOWN = "Whether hypotheses mattered is unknown"
OWN_TASK = "The reward and the end of an episode are those of the domain 'own'"


@pytest.fixture(autouse=True)
def in_the_examples_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(EXAMPLES)  # modules of the current folder are found
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")


def code_lines(path: Path) -> int:
    """Lines of a module that are neither empty nor comments nor docstrings."""
    text = path.read_text(encoding="utf-8")
    lines = {number for number, line in enumerate(text.splitlines(), 1) if line.strip() and line.strip()[0] != "#"}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            lines -= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return len(lines)


def settings(*pairs: str) -> list[str]:
    return [word for pair in pairs for word in ("--set", pair)]


LAYOUTS = settings("labelled_seeds=0", "unlabelled_seeds=1", "heldout_seeds=2", "steps=600")
PLAY = settings("steps=240", "environments=2", "warm_up=50", "layout_seed=0", "max_episode_steps=60")
SHORT = {  # appended to the page's commands, so that they end in seconds
    "collect": LAYOUTS,
    "train-ensemble": settings("steps=20", "members=2", "workers=1"),
    "train-options": PLAY,
    "train-meta": PLAY,
}


@pytest.mark.slow
def test_unlock_pickup_goes_through_all_stages_as_the_page_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Spec B6, A1-A5: an environment, two label functions and a way to wander, under 30 lines, are all one writes.

    The page's commands in their order, but for ``check`` of the domain, which the next test does.
    """
    page = EXAMPLES.parent / "docs" / "own-domain.md"
    example = EXAMPLES / "unlock_pickup.py"
    assert blocks(page, "python")[0] == example.read_text(encoding="utf-8")
    assert code_lines(example) < MOST_LINES
    for name in ("unlock_pickup.py", "margin.py", "wide_network.py"):
        (tmp_path / name).write_bytes((EXAMPLES / name).read_bytes())
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYPOGOAL_TRUST")
    ran = []
    for words in commands(page):
        if words[:3] != ["hypogoal", "check", "unlock_pickup:DOMAIN"]:
            assert main([*words[1:], *SHORT.get(words[1], ())]) == 0, words
            ran.append(words[1])
    stages = ["collect", "train-ensemble", "train-options", "train-meta", "evaluate", "report"]
    assert ran == [*stages, "check", "train-ensemble"]
    run = tmp_path / "runs" / "unlock"
    extending = EXAMPLES.parent / "docs" / "extending.md"
    (tmp_path / "first.py").write_text(next(block for block in blocks(extending, "py") if "class First" in block))
    for words in commands(extending):
        in_unlock = [word.replace("runs/demo", "runs/unlock") for word in words]
        assert main([*in_unlock[1:], *SHORT[words[1]]]) == 0, words
    own_code._allowed.clear()
    with pytest.raises(UserError, match="a file names code of its own as its network: wide_network:wide"):
        load_options(run / "wide")
    monkeypatch.setenv("HYPOGOAL_TRUST", "1")
    assert load_options(run / "wide").policies.network.cells.features == 64
    for goal, row in open_dataset(run / "data.h5").counts()["labelled"].items():
        assert 10 < row["positives"] < row["states"] - 10, goal
    numbers = pd.read_csv(run / "evaluation" / "numbers.csv")
    assert [*numbers.query("quantity == 'states'")["sub_goal"]] == ["hold-key", "open-door"]
    assert "reward" in {*numbers["quantity"]}
    assert "open-door" in (run / "report" / "index.html").read_text(encoding="utf-8")
    agrees(run, OWN_TASK, UNKNOWN)


def test_the_example_keeps_its_contract(capsys: pytest.CaptureFixture[str]) -> None:
    """Spec B6: the page's first command."""
    assert main(["check", "unlock_pickup:DOMAIN", *LAYOUTS]) == 0
    assert "FAIL" not in capsys.readouterr().out


def test_the_audits_page_audits_its_classifier(tmp_path: Path) -> None:
    """Spec H5: the page's command, on the shortest ways instead of learned ones, fools the classifier as the page says.

    The film in the page is the one that the command makes.
    """
    page = EXAMPLES.parent / "docs" / "audit.md"
    words = commands(page)[0]
    out = tmp_path / "audit"
    quick = settings("network=planned", "steps=320")
    assert main([*words[1 : words.index("--out")], "--out", str(out), *quick]) == 0
    report = json.loads((out / "audit.json").read_text(encoding="utf-8"))
    assert (report["before"]["fires_far"], report["mended"]["fires_far"]) == (1.0, 0.0)
    assert [kind["holds"] for kind in report["before"]["kinds"]] == [[]]
    film = page.with_name("audit.gif")
    assert film.stat().st_size < 300_000
    with Image.open(film) as shown, Image.open(out / "before-1.gif") as made:
        assert shown.n_frames == made.n_frames == 4
    with (page.parent / "results" / "audit-layouts.csv").open(newline="", encoding="utf-8") as file:
        rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]
    assert len(rows) == 20 and all(row["executions"] == row["mended_executions"] == 100 for row in rows)
    fooled = [f"{row['layout']:.0f}" for row in rows if row["fooled"] == 100]
    assert f"On layouts {', '.join(fooled[:-1])} and {fooled[-1]} every" in page.read_text(encoding="utf-8")
    assert sum(row["there"] for row in rows) == 1_600 and {row["mended_there"] for row in rows} == {100}


@pytest.mark.slow
def test_vector_goals_goes_through_all_stages(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Spec B6: observations that are a dictionary of numbers; what is of pictures only is left out, or refused."""
    example = EXAMPLES / "vector_goals.py"
    text = example.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= (110 if "hypogoal run examples" in text else 40)
    run = tmp_path / "run"
    data, ensemble, options, meta = (str(run / name) for name in ("data.h5", "ensemble", "options", "meta"))
    play = settings("steps=2500", "environments=4", "warm_up=200", "layout_seed=0")
    few = settings("unlabelled_seeds=1", "heldout_seeds=2")
    for words in (
        ["collect", "vector_goals:DOMAIN", "--out", data, *few],
        ["train-ensemble", data, "--out", ensemble, *settings("members=2", "workers=1")],
        ["train-options", ensemble, "--out", options, *play, *settings("save_visited=50")],
        ["train-meta", ensemble, "--out", meta, "--options", options, *play],
        ["train-baseline", "vector_goals:DOMAIN", "--out", str(run / "ppo"), "--data", data, *settings("steps=600")],
        ["evaluate", str(run)],
        ["report", str(run)],
    ):
        assert main([*words, "-q"] if words[0] != "report" else words) == 0, words
    assert main(["verify", str(run)]) == 0
    config = json.loads((run / "ensemble" / "manifest.json").read_text(encoding="utf-8"))["config"]
    assert [config[key] for key in ("network", "observation_shape", "observation_dtype")] == ["mlp", [6], "float32"]
    page = (run / "report" / "index.html").read_text(encoding="utf-8")
    assert 'id="figure-features' in page
    drawn = "".join(path.read_text(encoding="utf-8") for path in (run / "report" / "figures").glob("features*.svg"))
    assert "position[0]" in drawn and "held[1]" in drawn
    assert not any(text in page for text in ("States to look through", "laid over each other"))
    agrees(run, OWN_TASK, UNKNOWN)
    assert open_dataset(run / "options" / "visited.h5").unlabelled().dtype == "float32"
    policies = load_options(options)
    env = OptionEnv(policies.make_env(), policies)
    observation, _ = env.reset(seed=0)
    assert set(observation) == {"position", "key", "held"} and env.action_masks().shape == (4,)
    assert 1 <= env.step(0)[4]["duration"] <= 20
    capsys.readouterr()
    for words in (["report", str(run), "--videos", "1", "--force"], ["show", data, "--pictures", str(tmp_path)]):
        assert main(words) == 2 and "pictures" in capsys.readouterr().err
    for setting in ("network=paper", "meta_network=paper"):
        assert (
            main(["train-meta", ensemble, "--out", str(tmp_path / "m"), "-q", *settings(setting, "experience=own")])
            == 2
        )
        assert f"see pictures only: {setting}" in capsys.readouterr().err
    minari = tmp_path / "played-v0"
    assert main(["export", meta, "--out", str(minari), "--episodes", "2", "-q"]) == 0
    space = json.loads(json.loads((minari / "data" / "metadata.json").read_text())["observation_space"])
    assert (space["dtype"], space["shape"]) == ("float32", [6])


@pytest.mark.slow
def test_the_frozen_backbone_goes_through_all_stages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec A1-A8, B6, C5, F2: the example's own commands; torch and safetensors alone rebuild a member."""
    example = EXAMPLES / "frozen_backbone.py"
    text = example.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 60
    (tmp_path / example.name).write_text(text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYPOGOAL_TRUST")
    lines = (ast.get_docstring(ast.parse(text)) or "").replace("\\\n", "").splitlines()
    monkeypatch.setattr(attributing, "INTEGRATED", 2)
    two = settings("sub_goals=collect-red-key,open-red-door")
    few = {**SHORT, "collect": settings("unlabelled_seeds=1", "heldout_layouts=1")}
    few["train-ensemble"] = [*SHORT["train-ensemble"], *two]
    for words in (line.split() for line in lines):
        if words[:1] == ["hypogoal"] and words[1] not in ("train-options", "train-meta"):  # which judge all states
            assert main([*words[1:], *few.get(words[1], ())]) == 0, words
    run = tmp_path / "runs" / "backbone"
    facts = json.loads((run / "evaluation" / "run.json").read_text(encoding="utf-8"))
    told = [*facts["looked_at"]["sub_goals"].values()]
    assert told and all(goal["how"] == "integrated gradients" for goal in told)
    assert max(goal["completeness_error"] for goal in told) < 1e-3
    assert "attributions by integrated gradients" in (run / "report" / "index.html").read_text(encoding="utf-8")
    layers, (width,) = runpy.run_path(example.name)["vit"]((64, 64, 3))
    member = nn.Sequential(*layers, nn.Flatten(), nn.Linear(96, width), nn.ReLU(), nn.Linear(width, 2)).eval()
    weights = load_file(run / "ensemble" / "collect-red-key.safetensors")
    prefix = "members.0."  # as docs/formats.md names them
    member.load_state_dict({name[len(prefix) :]: value for name, value in weights.items() if name.startswith(prefix)})
    images = torch.zeros(1, 64, 64, 3, dtype=torch.uint8)
    logits = member(images.permute(0, 3, 1, 2) / 255)
    expected = load_ensemble(run / "ensemble", "collect-red-key").logits(images.numpy())[:, 0]
    np.testing.assert_allclose(logits.detach().numpy(), expected, atol=1e-5)


@pytest.mark.atari
@pytest.mark.slow
def test_freeway_goes_through_all_stages(tmp_path: Path) -> None:
    """Spec B6: an Atari game other than Montezuma's Revenge, with sub-goals from its memory and defaults of its own."""
    run = tmp_path / "run"
    data, ensemble = str(run / "data.h5"), run / "ensemble"
    layouts = settings("unlabelled_seeds=1", "heldout_seeds=2", "steps=400", "states=200")
    assert main(["collect", "freeway:DOMAIN", "--out", data, "-q", *layouts]) == 0
    few = settings("steps=10", "members=2", "workers=1")
    assert main(["train-ensemble", data, "--out", str(ensemble), "-q", *few]) == 0
    assert json.loads((ensemble / "manifest.json").read_text(encoding="utf-8"))["config"]["network"] == "montezuma"
    play = [*PLAY, *settings("max_episode_steps=120")]  # a reset loads the game
    options, meta = str(run / "options"), str(run / "meta")
    assert main(["train-options", str(ensemble), "--out", options, "-q", *play]) == 0
    assert main(["train-meta", str(ensemble), "--options", options, "--out", meta, "-q", *play]) == 0
    assert main(["evaluate", str(run), "-q"]) == 0
    assert main(["report", str(run)]) == 0
    numbers = pd.read_csv(run / "evaluation" / "numbers.csv")
    assert {*numbers.query("quantity == 'balanced_accuracy'")["sub_goal"]} == {"half-way", "far-side"}
    assert "reward" in {*numbers["quantity"]}
    assert "far-side" in (run / "report" / "index.html").read_text(encoding="utf-8")
    agrees(run, OWN_TASK, UNKNOWN)


@pytest.mark.slow
def test_own_pictures_go_from_arrays_to_a_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec B6: the commands of its docstring, without an environment; members differ where the labels do not say."""
    example = EXAMPLES / "own_pictures.py"
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(example))
    for line in example.read_text(encoding="utf-8").splitlines():
        if line.startswith("    hypogoal "):
            assert main(line.split()[1:]) == 0, line
    members = pd.read_csv("runs/lamp/evaluation/tables/hypotheses.csv").set_index("quantity")["mean"]
    assert members["best"] > 0.95 and members["worst"] < 0.9
    assert "lamp-on" in Path("runs/lamp/report/index.html").read_text(encoding="utf-8")
    agrees(Path("runs/lamp"), "", "No agent has been trained yet")


@pytest.mark.parametrize("example", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_examples_are_short(example: Path) -> None:
    """Spec B6: what one reads before one writes one's own; sweeps, figures, a robot and own parts may be longer."""
    text = example.read_text(encoding="utf-8")
    longer = {
        "hypogoal run examples": 110,
        "robot_bin.py": 150,
        "robot_bin": 60,
        "def policy(": 80,
        "QUESTION = ": 60,
        "class Frozen": 60,
        "objectives:ace": 90,
        "teacher=joint": 350,
        "class Learner(": 350,
        "view=one_room": 360,
    }
    assert len(text.splitlines()) <= next((lines for word, lines in longer.items() if word in text), 40)
