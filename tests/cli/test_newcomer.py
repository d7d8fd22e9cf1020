"""The command line as a newcomer meets it: groups, examples, settings as options, what comes next (Spec A6, A8)."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import refuses, run
from typer.main import get_command

from hypogoal.cli import app, main
from hypogoal.evaluation.compare import winners
from hypogoal.look import numbers_of
from hypogoal.settings import CONFIGS, OFTEN, STAGES, options_of

ROOT = Path(__file__).resolve().parents[2]
COMMANDS = get_command(app).commands  # type: ignore[attr-defined]


def told(*arguments: str, **environment: str) -> list[str]:
    """What a command prints in a terminal of 80 columns, its lines."""
    around = os.environ | {"COLUMNS": "80", "NO_COLOR": "1", "TERM": "dumb", **environment}
    command = [sys.executable, "-m", "hypogoal", *arguments]
    done = subprocess.run(command, cwd=ROOT, env=around, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


def test_help_is_in_groups_with_a_line_to_start_from() -> None:
    """Groups in their order, every command in one line of one of them, nothing wider than the terminal."""
    lines = told("--help")
    panels = [match[1] for line in lines if (match := re.match(r"╭─ ([\w ]+?) ─", line))]
    assert panels == ["Options", "Make", "Look", "Own data and code", "Run many"]
    assert any(line.strip().startswith("Start here: hypogoal run") for line in lines)
    named = [match[1] for line in lines if (match := re.match(r"│ ([a-z][a-z-]+)  +\S", line))]
    assert sorted(named) == sorted(COMMANDS)
    assert named.index("collect") < named.index("train-ensemble") < named.index("run") < named.index("show")
    assert max(map(len, lines)) <= 80


@pytest.mark.parametrize("name", [*COMMANDS])
def test_help_ends_with_an_example_that_can_be_typed(name: str) -> None:
    """Of options that the command has; types are a word, no bounds of sixteen digits."""
    lines = told(name, "--help")
    assert max(map(len, lines)) <= 80
    text = "\n".join(lines)
    example = " ".join(text[text.index(" Example: ") :].split())
    assert example.startswith(f"Example: hypogoal {name} ")
    assert [line.strip() for line in lines if line.strip()][-1] == example.removeprefix("Example: "), "a line to copy"
    options = {option for param in COMMANDS[name].params for option in param.opts}
    given = {word for word in example.split() if word.startswith("--")}
    assert given <= options | {"--out"}
    types = text[text.index("─ Options") :]
    assert not [long for long in ("range>", "range ", "9007199254740991", "<bool>", "list[") if long in types]


@pytest.mark.parametrize("stage", [*OFTEN])
def test_settings_are_options(stage: str) -> None:
    """Each with its meaning and default; what they are told is what --set would be."""
    options = {option: param for param in COMMANDS[stage].params for option in param.opts}
    assert 3 <= len(options_of(stage)) <= 5
    for flag, row in options_of(stage).items():
        assert row["meaning"][1:] in options[flag].help and str(row["default"]) in options[flag].help
    assert not {"--out", "--set", "--seed", "--resume"} & {*options_of(stage)}


def test_an_option_is_a_setting(tmp_path: Path) -> None:
    """--steps 640 and --set steps=640 are one; --set goes before; what it may not be is one line, code 2."""
    train = ["train-baseline", "doorkey", "--set", "max_episode_steps=20", "--set", "random_episodes=1", "-q"]
    found = {}
    for name, given in (
        ("option", ["--steps", "640", "--setting", "paper"]),
        ("set", ["--set", "steps=640", "--set", "setting=paper"]),
        ("both", ["--steps", "64", "--set", "steps=640", "--setting", "paper"]),
    ):
        run(*train, *given, "--out", tmp_path / name)
        config = json.loads((tmp_path / name / "manifest.json").read_text())["config"]
        found[name] = (config["steps"], config["setting"])
    assert {*found.values()} == {(640, "paper")}
    for wrong, words in (("0", "out of range"), ("many", "wrong type of value")):
        refuses(words, *train, "--steps", wrong, "--out", tmp_path / "none")
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("train-meta e --out o --gae-lambda 3", ["--set gae_lambda=VALUE", "hypogoal config train-meta"]),
        ("train-ensemble d --out o --bogus 3", ["--set key=VALUE", "hypogoal config train-ensemble"]),
        ("collect doorkey --out o --bogus 3", ["--set key=VALUE", "hypogoal config collect"]),
        ("show runs --bogus", ["See 'hypogoal show --help'"]),
    ],
)
def test_unknown_options_lead_on(command: str, words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """One line, code 2: how a setting is given, and where all are listed."""
    assert main(command.split()) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert all(word in line for word in words), line


def test_run_without_out_and_with_a_seed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec A6: a dry run needs no --out and writes nothing; the seed is that of every cell; --set goes before."""
    monkeypatch.chdir(tmp_path)
    for given, seed in ((["--seed", "7"], "7"), (["--seed", "7", "--set", "seeds=8"], "8")):
        lines = run("run", "doorkey", "--preset", "demo", "--dry-run", *given).out.splitlines()
        assert lines[0].endswith("--out runs/doorkey/data.h5")
        assert {match[1] for line in lines if (match := re.search(r"--seed (\d+)", line))} == {seed}
    assert not [*tmp_path.iterdir()]


def test_config_lists_stages_and_the_most_changed_first() -> None:
    """In groups, wrapped at words; --json has the same rows as ever."""
    printed = run("config")
    assert [line.split()[0] for line in printed.out.splitlines()] == [*STAGES, "run"]
    lines = run("config", "train-meta").out.splitlines()
    named = [line.split()[0] for line in lines if re.match(r"  \w", line)]
    assert {*named[: len(OFTEN["train-meta"])]} == {*OFTEN["train-meta"]}
    assert len(named) == len({*named}) > 40
    assert lines[0] == "Most changed:" and "PPO over options, with SMDP returns:" in lines
    assert max(len(line) for line in lines if line.startswith("      ")) <= 80


@pytest.mark.parametrize("stage", [*STAGES, "run"])
def test_config_fits_a_terminal(stage: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """80 columns; no mark-up; no range, setting or command is broken at a hyphen."""
    monkeypatch.setenv("COLUMNS", "80")
    for domain in ("doorkey", "montezuma", "rooms"):
        lines = run("config", stage, "--domain", domain).out.splitlines()
        assert max(map(len, lines)) <= 80 and not any("`" in line for line in lines)
        assert not any(re.search(r"\w-$", line) for line in lines)


def test_config_says_where_a_value_is_from() -> None:
    """A domain's own defaults are not from DoorKey's table, a preset's are the preset's."""

    def rows(*arguments: str) -> dict[str, dict[str, object]]:
        return {row["name"]: row for row in json.loads(run("config", *arguments, "--json").out)}

    ladders, doorkey = rows("train-ensemble", "--domain", "montezuma"), rows("train-ensemble")
    assert (doorkey["learning_rate"]["default"], doorkey["learning_rate"]["source"]) == (2e-4, "Table 3")
    assert (ladders["learning_rate"]["default"], ladders["learning_rate"]["source"]) == (
        5e-4,
        "paper, appendix (Table 1)",
    )
    assert rows("train-meta", "--domain", "rooms")["steps"]["source"] == "rooms's own"
    demo = rows("train-meta", "--preset", "demo")["steps"]
    assert (demo["default"], demo["source"]) == (50_000, "preset demo")


def test_config_loads_no_domain_where_it_needs_none() -> None:
    """So that it answers at once: what takes long is the environments' modules."""
    code = "import sys; from hypogoal.cli import main; main(['config', 'train-ensemble']); "
    script = code + "print('HEAVY', sorted({'gymnasium', 'minigrid', 'torch', 'scipy', 'numpy'} & {*sys.modules}))"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "HEAVY []"


def test_the_package_alone_imports_no_gymnasium() -> None:
    """Which takes a second."""
    light = "import sys, hypogoal; print('gymnasium' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", light], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def log(path: Path, *lines: object) -> None:
    path.write_text("".join(line if isinstance(line, str) else json.dumps(line) + "\n" for line in lines))


def test_results_are_those_of_the_logs(tmp_path: Path) -> None:
    """By hand: the last line of each sub-goal; damage is passed over."""
    assert numbers_of(tmp_path) == {}
    log(
        tmp_path / "metrics.jsonl",
        *({"sub_goal": goal, "step": step, "labelled": step / size} for goal, size in (("a", 10), ("b", 20))
          for step in (1, 4)),
        "no JSON\n", "[1]\n", {"sub_goal": "c", "labelled": None},
    )  # fmt: skip
    assert numbers_of(tmp_path) == pytest.approx({"labelled loss": (0.4 + 0.2) / 2})


def test_a_stage_says_what_it_came_to_and_what_is_next(tiny_run: Path, tmp_path: Path) -> None:
    """Then where its output is; of that alone with --quiet."""
    folder = tmp_path / "run"
    train = ["train-ensemble", tiny_run / "data.h5", "--out", folder / "ensemble", "--steps", "2"]
    train += ["--set", "workers=1", "--set", "sub_goals=collect-blue-key"]
    result, then, path = run(*train).out.splitlines()
    assert re.fullmatch(r"held-out balanced accuracy: best member [\d.]+, mean [\d.]+, worst [\d.]+", result)
    assert then == f"next: hypogoal train-options {folder}/ensemble --out {folder}/options"
    assert path == str(folder / "ensemble")
    assert run(*train, "-q", "--force").out.splitlines() == [path]


def test_show_says_the_result_first(tiny_run: Path) -> None:
    """Of an artefact, and of each in a run."""
    path = tiny_run / "ensemble"
    shown = run("show", path).out.splitlines()
    logged = shown[0].removeprefix(f"{path}: ensemble; ")
    assert re.fullmatch(r"labelled loss [\d.]+", logged)
    assert "config:" in shown and any(line.startswith("files: ") for line in shown)
    assert f"{path}: ensemble; {logged}" in run("show", tiny_run).out.splitlines()


def test_winners_by_hand() -> None:
    """Spec F5: who wins, by how much, on what; none where the interval holds nought; fewer steps are better."""
    about = {"first": "a", "second": "b", "n": 4, "units": 4, "wins": 1, "ties": 0}
    length = {"where": "PPO", "quantity": "length", "higher": False, "difference": 3.5}
    near = {"where": "", "quantity": "near_goal", "higher": True, "difference": 0.5, "difference_interval": [-0.1, 1.1]}
    assert winners([about | length | {"difference_interval": [1.0, 6.0]}, about | near, about | near | {"n": 0}]) == [
        "PPO: length: b beats a (a +3.5, 95 % [1, 6], n = 4; a wins 1 of 4, 0 tied)",
        "near goal: no clear winner of a and b (a +0.5, 95 % [-0.1, 1.1], n = 4; a wins 1 of 4, 0 tied)",
    ]
    assert winners([about | length | {"difference_interval": [None, None]}])[0].startswith("PPO: length: no clear")
    assert "no pairs" in winners([])[0]


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("collect ", {"doorkey", "montezuma", "rooms"}),
        ("run mont", {"montezuma-ladders"}),
        ("run doorkey --preset pa", {"paper"}),
        ("config train-m", {"train-meta"}),
        ("train-meta x --set gae", {"gae_lambda="}),
        ("run doorkey --set train-meta.cho", {"train-meta.chooser="}),
        ("train-ensemble --memb", {"--members"}),
    ],
)
def test_a_shell_completes(typed: str, offered: set[str]) -> None:
    """Domains, experiments, presets, stages, settings, options: as bash asks for them."""
    words = {"COMP_WORDS": f"hypogoal {typed}", "COMP_CWORD": str(len(typed.split(" ")))}
    assert {*told(**words, _HYPOGOAL_COMPLETE="complete_bash")} == offered


def test_every_stage_has_its_settings_told() -> None:
    """A name in OFTEN is a setting of its stage."""
    assert {*OFTEN} == {*CONFIGS}
