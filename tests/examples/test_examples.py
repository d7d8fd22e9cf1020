"""The examples go through the stages by the command line, as their readers would take them (Spec B6)."""

import ast
import importlib
import json
import runpy
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from command_line import FIXED, fails, run, settings
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
from hypogoal.evaluation import saliency

EXAMPLES = Path(__file__).parents[2] / "examples"
MOST_LINES = 30
UNKNOWN = "Whether hypotheses mattered is unknown"
OWN_TASK = "The reward and the end of an episode are those of the domain 'own'"


@pytest.fixture(autouse=True)
def in_the_examples_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(EXAMPLES)


LAYOUTS = settings("labelled_seeds=0", "unlabelled_seeds=1", "heldout_seeds=2", "steps=600")
PLAY = settings("steps=240", "environments=2", "warm_up=50", "layout_seed=0", "max_episode_steps=60")
SHORT = {  # appended to the page's commands, so that they end in seconds
    "collect": LAYOUTS,
    "train-ensemble": settings("steps=20", "members=2", "workers=1", *FIXED),
    "train-options": PLAY,
    "train-meta": PLAY,
}


@pytest.mark.slow
def test_unlock_pickup_goes_through_all_stages_as_the_page_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Spec B6, A1-A5: an environment, two label functions and a way to wander, under 30 lines, are all one writes.

    The page's commands in their order, but for ``check`` of the domain, which the next test does, and those in
    FourRooms, which ``library/test_pages.py`` runs in small.
    """
    page = EXAMPLES.parent / "docs" / "own-domain.md"
    example = EXAMPLES / "unlock_pickup.py"
    assert blocks(page, "python")[0] == example.read_text(encoding="utf-8")
    assert len(example.read_text(encoding="utf-8").splitlines()) < MOST_LINES
    for name in ("unlock_pickup.py", "margin.py", "wide_network.py"):
        (tmp_path / name).write_bytes((EXAMPLES / name).read_bytes())
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYPOGOAL_TRUST")
    ran = []
    for words in commands(page):
        in_four_rooms = "four" in " ".join(words)
        if words[:3] != ["hypogoal", "check", "unlock_pickup:DOMAIN"] and not in_four_rooms:
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
    assert main(["check", "unlock_pickup:DOMAIN", *LAYOUTS, *settings("steps=300")]) == 0
    assert "FAIL" not in capsys.readouterr().out


def test_the_audits_page_audits_its_classifier(tmp_path: Path) -> None:
    """Spec H5: the page's command, on shortest ways instead of learned ones, fools the classifier as in its film."""
    page = EXAMPLES.parent / "docs" / "audit.md"
    words = commands(page)[0]
    out = tmp_path / "audit"
    quick = settings("network=planned", "steps=320")
    assert main([*words[1 : words.index("--out")], "--out", str(out), *quick]) == 0
    report = json.loads((out / "audit.json").read_text(encoding="utf-8"))
    assert (report["before"]["fires_far"], report["mended"]["fires_far"]) == (1.0, 0.0)
    assert [kind["holds"] for kind in report["before"]["kinds"]] == [[]]
    with Image.open(page.with_name("audit.gif")) as shown, Image.open(out / "before-1.gif") as made:
        assert shown.n_frames == made.n_frames == 4


@pytest.mark.slow
def test_vector_goals_goes_through_all_stages(tmp_path: Path) -> None:
    """Spec B6: observations that are a dictionary of numbers; what is of pictures only is left out, or refused."""
    folder = tmp_path / "run"
    data, ensemble, options, meta = (folder / name for name in ("data.h5", "ensemble", "options", "meta"))
    play = settings("steps=800", "environments=4", "warm_up=200", "layout_seed=0")
    few = settings("unlabelled_seeds=1", "heldout_seeds=2")
    run("collect", "vector_goals:DOMAIN", "--out", data, "-q", *few)
    run("train-ensemble", data, "--out", ensemble, "-q", *settings("members=2", "workers=1"))
    run("train-options", ensemble, "--out", options, "-q", *play, *settings("save_visited=50"))
    run("train-meta", ensemble, "--out", meta, "--options", options, "-q", *play)
    run("train-baseline", "vector_goals:DOMAIN", "--out", folder / "ppo", "--data", data, "-q", "--steps", 600)
    run("evaluate", folder, "-q")
    run("report", folder)
    run("verify", folder)
    config = json.loads((ensemble / "manifest.json").read_text(encoding="utf-8"))["config"]
    assert [config[key] for key in ("network", "observation_shape", "observation_dtype")] == ["mlp", [6], "float32"]
    page = (folder / "report" / "index.html").read_text(encoding="utf-8")
    assert 'id="figure-features' in page and "held-out states that were looked at" not in page
    drawn = "".join(path.read_text(encoding="utf-8") for path in (folder / "report/figures").glob("features*.svg"))
    assert "position[0]" in drawn and "held[1]" in drawn
    agrees(folder, OWN_TASK, UNKNOWN)
    assert open_dataset(options / "visited.h5").unlabelled().dtype == "float32"
    policies = load_options(options)
    env = OptionEnv(policies.make_env(), policies)
    observation, _ = env.reset(seed=0)
    assert set(observation) == {"position", "key", "held"} and env.action_masks().shape == (4,)
    assert 1 <= env.step(0)[4]["duration"] <= 20
    assert not (folder / "evaluation" / "film.gif").exists() and "image/gif" not in page
    assert "pictures" in fails("report", folder, "--videos", "1", "--force").err
    assert "pictures" in fails("show", data, "--pictures", tmp_path).err
    for setting in ("network=paper", "meta_network=paper"):
        own = settings(setting, "experience=own", "chooser=ppo")
        told = fails("train-meta", ensemble, "--out", tmp_path / "m", "-q", *own)
        assert f"see pictures only: {setting}" in told.err


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
    monkeypatch.setattr(saliency, "INTEGRATED", 2)
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
    assert "against it, by integrated gradients" in (run / "report" / "index.html").read_text(encoding="utf-8")
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
def test_freeway_is_collected_learned_and_played(tmp_path: Path) -> None:
    """Spec B6: an Atari game other than Montezuma's Revenge, with sub-goals from its memory and defaults of its own."""
    data, ensemble = tmp_path / "data.h5", tmp_path / "ensemble"
    layouts = settings("unlabelled_seeds=1", "heldout_seeds=2", "steps=400", "states=200")
    run("collect", "freeway:DOMAIN", "--out", data, "-q", *layouts)
    run("train-ensemble", data, "--out", ensemble, "-q", *SHORT["train-ensemble"])
    assert json.loads((ensemble / "manifest.json").read_text(encoding="utf-8"))["config"]["network"] == "montezuma"
    assert open_dataset(data).sub_goals == ("half-way", "far-side")
    play = [*PLAY, *settings("max_episode_steps=120")]  # a reset loads the game
    run("train-meta", ensemble, "--out", tmp_path / "meta", "-q", *play)


@pytest.mark.slow
def test_own_pictures_go_from_arrays_to_a_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec B6: the commands of its docstring, without an environment; members differ where the labels do not say."""
    example = EXAMPLES / "own_pictures.py"
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(example))
    lines = (ast.get_docstring(ast.parse(example.read_text(encoding="utf-8"))) or "").replace("\\\n", "").splitlines()
    for words in (line.split() for line in lines):
        if words[:1] == ["hypogoal"]:
            assert main(words[1:]) == 0, words
    members = pd.read_csv("runs/lamp/evaluation/tables/hypotheses.csv").set_index("quantity")["mean"]
    assert members["best"] > 0.95 and members["worst"] < 0.9
    assert "lamp-on" in Path("runs/lamp/report/index.html").read_text(encoding="utf-8")
    agrees(Path("runs/lamp"), "", "No agent has been trained yet")


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_every_policy_of_the_locked_room_reaches_its_sub_goal(seed: int) -> None:
    """Spec I4: each door by its colour, the locked one with its key, and the key, before MiniGrid's own time is up."""
    example = importlib.import_module("locked_room")
    env, rng = example.make(), np.random.default_rng(0)
    locked = 0

    def labels() -> dict[str, bool]:
        return {name: label(env) for name, label in example.SUB_GOALS.items()}

    for name, policy in example.POLICIES.items():
        env.reset(seed=seed)
        holds, steps = labels(), 0
        assert not any(holds.values())
        while not holds[name]:
            env.step(policy(env, None, rng))
            holds, steps = labels(), steps + 1
            assert steps < 150, name
        others = {other for other, held in holds.items() if held} - {name}
        locked += name != "hold-key" and "hold-key" in others
    assert locked == 1
