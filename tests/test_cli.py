"""The command line end to end on a toy scale, and each mistake's one line (Spec A1-A8, G2)."""

import json
import re
import shutil
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from toy_data import reseal

import hypogoal
from hypogoal.cli import main
from hypogoal.core.config import describe
from hypogoal.dataset import open_dataset
from hypogoal.settings import CONFIGS
from hypogoal.stages.sweep import config_class_of

SMALL = ["--set", "heldout_layouts=1", "--set", "unlabelled_seeds=1"]
QUICK = [
    "--set",
    "environments=8",
    "--set",
    "warm_up=100",
    "--set",
    "max_episode_steps=60",
    "--set",
    "random_episodes=5",
]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of every stage, a few steps each."""
    run = tmp_path_factory.mktemp("run")
    assert main(["collect", "doorkey", "--out", str(run / "data.h5"), *SMALL, "-q"]) == 0
    ensemble = f"train-ensemble {run}/data.h5 --out {run}/ensemble --set steps=4 --set workers=1 -q"
    options = f"train-options {run}/ensemble --out {run}/options --set steps=600 -q"
    meta = f"train-meta {run}/ensemble --options {run}/options --out {run}/meta --set steps=800 --set decisions=32 -q"
    assert main(ensemble.split()) == 0
    assert main([*options.split(), *QUICK]) == 0
    assert main([*meta.split(), *QUICK]) == 0
    return run


def one_line(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> str:
    """Run a command that must fail with code 2 and a single line on stderr; returns the line."""
    capsys.readouterr()
    assert main(arguments) == 2
    captured = capsys.readouterr()
    lines = captured.err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("hypogoal: "), captured.err
    assert captured.out == ""
    return lines[0]


def test_steps_of_both_stages_count(made: Path) -> None:
    """Spec A3, A4, F5: train-meta continues; its curve begins with the episodes of train-options."""
    rows = [line.split(",") for line in (made / "meta" / "episodes.csv").read_text().splitlines()[1:]]
    assert int(rows[0][0]) <= 600 < int(rows[-1][0]) <= 1400 + 8
    manifest = json.loads((made / "meta" / "manifest.json").read_text())
    assert manifest["config"]["options_steps"] == 600
    assert {entry["kind"] for entry in manifest["inputs"]} == {"ensemble", "options"}
    layout = json.loads((made / "meta" / "layout.json").read_text())
    assert layout["layout_seed"] == 100 and layout["shortest_path"] >= 9


def test_collected_states_and_members_are_files(made: Path) -> None:
    """Spec A1, A2, B3: all states in one file, with their origin; a file of weights per sub-goal."""
    dataset = open_dataset(made / "data.h5")
    counts = dataset.counts()
    assert counts["labelled"]["go-to-goal"] == {"states": 1640, "positives": 8}
    assert len(dataset.unlabelled()) == counts["unlabelled"] > 500
    assert set(dataset.heldout("go-to-goal").origins["layout_seed"]).isdisjoint({0, 1, 2})
    assert {path.stem for path in (made / "ensemble").glob("*.safetensors")} == set(dataset.sub_goals)


def test_show_and_verify(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Spec A8: what is this, is it whole."""
    for part, kind in (("data.h5", "data"), ("ensemble", "ensemble"), ("meta", "meta"), ("", "run")):
        capsys.readouterr()
        assert main(["show", str(made / part), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["kind"] == kind
        assert main(["show", str(made / part)]) == 0
        assert main(["verify", str(made / part)]) == 0
        assert "whole" in capsys.readouterr().out


def test_pictures_do_not_spoil_json(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Spec A6: what a machine is to read is JSON and nothing else."""
    assert main(["show", str(made / "data.h5"), "--json", "--pictures", str(tmp_path)]) == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["kind"] == "data" and str(tmp_path) in said.err


def test_verify_finds_damage(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Spec G2."""
    copy = tmp_path / "ensemble"
    shutil.copytree(made / "ensemble", copy)
    weights = copy / "go-to-goal.safetensors"
    weights.write_bytes(weights.read_bytes()[:1000])
    assert main(["verify", str(copy), "--json"]) == 2
    assert "go-to-goal.safetensors: changed" in json.loads(capsys.readouterr().out)["faults"][0]


def test_python_interface(made: Path) -> None:
    """The contract of the Python interface; Spec E1."""
    ensemble = hypogoal.load_ensemble(made / "ensemble", "open-red-door")
    probabilities = ensemble.predict(np.zeros((2, 64, 64, 3), dtype=np.uint8))
    assert probabilities.shape == (2, 3) and probabilities.dtype == np.float32
    for part in ("options", "meta"):
        options = hypogoal.load_options(made / part)
        env = hypogoal.OptionEnv(gymnasium.make("hypogoal/DoorKey-8x8-v0", layout_seed=100), options)
        assert env.action_space == gymnasium.spaces.Discrete(15)
        env.reset(seed=0)
        rng = np.random.default_rng(0)
        for _ in range(5):
            masks = env.action_masks()
            assert masks.shape == (15,) and masks.any()
            observation, _reward, terminated, truncated, info = env.step(int(rng.choice(np.flatnonzero(masks))))
            assert env.observation_space.contains(observation)
            assert 1 <= info["duration"] <= 10
            if terminated or truncated:
                env.reset()


def test_resume_keeps_what_is_complete(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Spec A6, G1: what was made with the same settings, seed and inputs; else it is one line."""
    made = Path(shutil.copytree(made, tmp_path / "run"))
    assert main(["evaluate", str(made), "-q"]) == main(["report", str(made), "-q"]) == 0
    capsys.readouterr()
    data, ensemble, meta = (str(made / name) for name in ("data.h5", "ensemble", "meta"))
    collect = ["collect", "doorkey", "--out", data, *SMALL, "--resume", "-q"]
    train = ["train-ensemble", data, "--out", ensemble, "--set", "steps=4", "--set", "workers=1", "--resume", "-q"]
    fewer = [*train[:-2], "--set", "workers=2", *train[-2:]]  # of which no result depends
    evaluate, report = ["evaluate", str(made), "--resume", "-q"], ["report", str(made), "--resume", "-q"]
    files = [path for path in sorted(made.rglob("*")) if path.is_file()]
    before = [path.read_bytes() for path in files]
    outs = (data, ensemble, ensemble, str(made / "evaluation"), str(made / "report" / "index.html"))
    for arguments, out in zip((collect, train, fewer, evaluate, report), outs, strict=True):
        assert main(arguments) == 0
        said = capsys.readouterr()
        assert said.out == f"{out}\n" and f"{out} is complete already" in said.err
    made_with = "the complete output was made with"
    cases = [
        ([*collect, "--seed", "1"], f"{made_with} seed=0, not 1"),
        ([*train, "--diversity", "none"], f"{made_with} diversity=dbat, not none"),
        ([*train, "--seed", "3"], f"{made_with} seed=0, not 3"),
        ([*train, "--unlabelled", data], f"{made_with} other inputs"),
        ([train[0], str(made / "none.h5"), *train[2:]], "no such data file"),
        (["train-meta", ensemble, "--out", str(made / "options"), "--resume"], "not of kind 'meta': it is of kind"),
        (["collect", "montezuma", "--out", data, "--resume"], f"{made_with} domain=doorkey, not montezuma"),
        (["train-baseline", "montezuma", "--out", meta, "--resume"], "not of kind 'baseline'"),
        ([*report, "--videos", "2"], f"{made_with} videos=1, not 2"),
    ]
    for arguments, words in cases:
        assert words in one_line(capsys, arguments)
    assert [path for path in sorted(made.rglob("*")) if path.is_file()] == files
    assert [path.read_bytes() for path in files] == before


def test_same_seed_same_bytes(made: Path, tmp_path: Path) -> None:
    """Same seed, same machine, same bytes: every stage, whether TensorBoard gets the logs or not."""
    assert main(["collect", "doorkey", "--out", str(tmp_path / "data.h5"), *SMALL, "-q"]) == 0
    arguments = ["--set", "steps=4", "--set", "workers=2", "-q", "--tensorboard", str(tmp_path / "boards")]
    assert main(["train-ensemble", str(made / "data.h5"), "--out", str(tmp_path / "ensemble"), *arguments]) == 0
    meta = f"train-meta {made}/ensemble --options {made}/options --out {tmp_path}/meta --set steps=800 -q"
    meta += f" --tensorboard {tmp_path}/boards/meta"
    assert main([*meta.split(), "--set", "decisions=32", *QUICK]) == 0
    files = ("meta.safetensors", "options.safetensors", "episodes.csv", "choices.csv", "metrics.jsonl")
    for name in ("ensemble/open-red-door.safetensors", "ensemble/metrics.jsonl", *(f"meta/{file}" for file in files)):
        assert (made / name).read_bytes() == (tmp_path / name).read_bytes(), name
    for name in ("open-red-door", "meta"):
        assert any((tmp_path / "boards" / name).iterdir()), name


@pytest.fixture(scope="module")
def places(made: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Where things are that commands are told of: what was made, a damaged file, an artefact to come, nothing."""
    folder = tmp_path_factory.mktemp("mistakes")
    (folder / "cut.h5").write_bytes((made / "data.h5").read_bytes()[:5000])
    shutil.copytree(made / "ensemble", folder / "newer")
    reseal(folder / "newer", format=3)
    own = {name: folder / name for name in ("newer", "none", "out")}
    return {"made": made, "data": made / "data.h5", "ensemble": made / "ensemble", "cut": folder / "cut.h5", **own}


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("train-ensemble {none}.h5 --out {out}", "no such data file"),
        ("train-ensemble {ensemble} --out {out}", "a folder where a data file is needed"),
        ("train-meta {data} --out {out}", "not an artefact"),
        ("train-meta {made}/options --out {out}", "'options' artefact, but ensemble is needed"),
        ("train-meta {ensemble} --options {ensemble} --out {out}", "but options is needed"),
        ("train-ensemble {data} --out {ensemble}", "exists already"),
        ("collect doorkey --out {data}", "exists already"),
        ("train-ensemble {data} --out {data} --force", "would replace an input"),
        ("train-meta {ensemble} --out {ensemble} --force", "would replace an input"),
        ("export {data} --out {data} --force", "as .npz"),
        ("collect doorkey --out {ensemble} --force", "not of kind 'data'"),
        ("evaluate {ensemble} --out {ensemble} --force", "not of kind 'evaluation'"),
        ("train-ensemble {data} --out {out} --set sub_goals=fly", "unknown sub-goal: fly"),
        ("train-ensemble {data} --out {out} --set sub_goals=go-to-goal,go-to-goal", "a sub-goal is named twice"),
        ("train-ensemble {data} --out {out} --seed 9007199254740992", "--seed"),
        ("collect doorkey --out {out} --seed 36893488147419103232", "--seed"),
        ("train-meta {ensemble} --out {out} --layout-seed 9007199254740993", "out of range: layout_seed"),
        ("train-meta {ensemble} --out {out} --set layout_seed=9007199254740993", "out of range"),
        ("run doorkey --out {out} --set seeds=1,9007199254740992", "out of range"),
        ("collect chess --out {out}", "unknown domain: chess"),
        ("collect nosuchmodule:DOMAIN --out {out}", "cannot be loaded"),
        ("run doorkey --out {out} --preset turbo", "unknown preset: turbo"),
        ("run chess --out {out}", "unknown experiment: chess"),
        ("run doorkey --out {out} --set train-meta.stepz=3", "has no setting: stepz"),
        ("run doorkey --out {out} --set bake.steps=3", "no such stage"),
        ("run doorkey --out {made}", "exists already"),
        ("train-meta {ensemble} --out {out} --set stepz=3", "Did you mean 'steps'"),
        ("train-meta {ensemble} --out {out} --set steps=0", "out of range"),
        ("train-ensemble {data} --out {out} --members 0", "out of range"),
        ("train-ensemble {data} --out {out} --diversity magic", "magic"),
        ("train-ensemble {cut} --out {out}", "truncated or not HDF5"),
        ("show {cut}", "truncated or not HDF5"),
        ("train-meta {newer} --out {out}", "newer"),
        ("train-meta {ensemble} --out {out} --device tpu", "unknown device"),
        ("train-meta {ensemble} --options {made}/options --out {out} --layout-seed 3", "layout_seed"),
        ("evaluate {none}", "no such run: "),
        ("report {none}", "no such run: "),
        ("report {made} --format pdf", "--format is for --figures"),
        ("report {made} --figures {out} --videos 2", "--videos is for the page"),
        ("config bake", "no such stage"),
        ("train-meta", "--help"),
        ("frobnicate", "--help"),
    ],
)
def test_mistakes(places: dict[str, Path], capsys: pytest.CaptureFixture[str], command: str, words: str) -> None:
    """Spec G2: missing input, wrong kind, unknown names, values out of range: one line, nothing written."""
    assert words in one_line(capsys, command.format(**places).split())
    assert sorted(path.name for path in places["out"].parent.iterdir()) == ["cut.h5", "newer"]


def test_a_failed_force_keeps_the_old_artefact(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Spec G2: nothing lost."""
    copy = tmp_path / "ensemble"
    shutil.copytree(made / "ensemble", copy)
    one_line(capsys, ["train-ensemble", str(tmp_path / "none.h5"), "--out", str(copy), "--force"])
    assert main(["verify", str(copy)]) == 0


@pytest.mark.parametrize("stage", ["collect", *CONFIGS, "run"])
@pytest.mark.parametrize("domain", ["doorkey", "montezuma"])
def test_sources_of_settings_are_those_that_a_reader_can_look_up(stage: str, domain: str) -> None:
    """The paper's tables and sections, not numbers of our requirements."""
    rows = describe(config_class_of(stage, domain))
    assert rows
    assert not [row["source"] for row in rows if re.search(r"\bSpec\b|\b[A-H][1-9]\b", row["source"])]


def test_config_lists_every_setting(capsys: pytest.CaptureFixture[str]) -> None:
    """'hypogoal config STAGE': default, unit, meaning, source."""
    assert main(["config", "train-meta"]) == 0
    text = capsys.readouterr().out
    assert "gae_lambda = 0.95" in text and "paper: 0.97" in text
    assert main(["config", "train-meta", "--json"]) == 0
    assert any(row["name"] == "steps" for row in json.loads(capsys.readouterr().out))


def test_dry_run_lists_commands_and_runs_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Spec A6: a run is ordinary commands. Spec D5, E4: in the paper's, policies start fresh, a layout per agent."""
    out = tmp_path / "run"
    assert main(["run", "doorkey", "--preset", "paper", "--out", str(out), "--dry-run"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert sum("train-meta" in line and "chooser" not in line and "termination" not in line for line in lines) == 10
    assert len({line.split("--layout-seed ")[1].split()[0] for line in lines if "--layout-seed" in line}) == 10
    assert not any("train-options" in line for line in lines)
    assert not out.exists()
