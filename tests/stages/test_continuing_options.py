"""Spec A4, A8: ``train-meta --options`` continues options only where they fit."""

from pathlib import Path

import pytest

from hypogoal.cli import main
from hypogoal.core.artefacts import open_artefact
from hypogoal.evaluation.curves import read_run
from hypogoal.learners import episodes

TESTS = Path(__file__).parents[1]
FEW = ("--set", "environments=4", "--set", "warm_up=50", "--set", "steps=200", "-q")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Data, two ensembles, and options of the first."""
    folder = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as patch:
        allow(patch)
        data = str(folder / "data.h5")
        assert main(["collect", "own_domain:DOMAIN", "--out", data, "-q"]) == 0
        for name, seed in (("ensemble", "0"), ("other", "1")):
            few = ("--set", "steps=3", "--set", "workers=1", "--seed", seed, "-q")
            assert main(["train-ensemble", data, "--out", str(folder / name), *few]) == 0
        assert main(["train-options", str(folder / "ensemble"), "--out", str(folder / "options"), *FEW]) == 0
    return folder


def allow(patch: pytest.MonkeyPatch) -> None:
    """The corridor as a user's own domain."""
    patch.syspath_prepend(str(TESTS))
    patch.syspath_prepend(str(TESTS / "domains"))
    patch.setenv("HYPOGOAL_TRUST", "own_domain:DOMAIN")


@pytest.mark.parametrize(
    ("ensemble", "changes", "words"),
    [
        ("other", (), "another ensemble"),
        ("ensemble", ("--set", "layout_seed=3"), "layout_seed=100, not 3"),
        ("ensemble", ("--set", "termination=oracle"), "termination=learned, not oracle"),
        ("ensemble", ("--set", "network=paper", "--set", "experience=own"), "network=light, not paper"),
    ],
)
def test_options_that_do_not_fit_are_refused(
    run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    ensemble: str,
    changes: tuple[str, ...],
    words: str,
) -> None:
    """Spec A8, G2: one line that says what differs, exit code 2, nothing written."""
    allow(monkeypatch)
    out = tmp_path / "meta"
    command = ["train-meta", str(run / ensemble), "--options", str(run / "options"), "--out", str(out), *FEW, *changes]
    assert main(command) == 2
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_options_that_fit_are_continued(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Spec A4: environment steps spent before count in the episodes' steps."""
    allow(monkeypatch)
    out = tmp_path / "meta"
    command = ["train-meta", str(run / "ensemble"), "--options", str(run / "options"), "--out", str(out), *FEW]
    assert main(command) == 0
    before = (run / "options/episodes.csv").read_text()
    after = (out / "episodes.csv").read_text()
    assert after.startswith(before) and int(after.splitlines()[-1].split(",")[0]) > 200
    shorter = [*command[: -len(FEW)][:-1], str(tmp_path / "shorter"), *FEW, "--set", "max_episode_steps=7"]
    assert main(shorter) == 0
    steps = [int(row.split(",")[0]) for row in (tmp_path / "shorter/episodes.csv").read_text().splitlines()[1:]]
    assert min(steps) > 200, "episodes of practice in a world of longer episodes are none of the agent's"


def test_practice_that_succeeds_ends_and_the_meta_policy_counts_its_steps(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What ended it stands on the command's last line and in the manifest; its limit is none of what was spent."""
    allow(monkeypatch)
    monkeypatch.setattr(episodes, "LAST", 3)
    few = [*FEW[:-1], "--set", "until=0.3"]
    said = {}
    for name, changes in (("early", ("--set", "steps=4000")), ("late", ("--set", "steps=40"))):
        command = ["train-options", str(run / "ensemble"), "--out", str(tmp_path / name), *few, *changes]
        assert main(command) == 0
        said[name] = capsys.readouterr().out.splitlines()[-3]
        assert main([*command, "--resume"]) == 0, "it is complete"
        capsys.readouterr()
    assert said["early"].endswith("ended by until=0.3") and said["late"].endswith(
        "ended by the limit, until=0.3 not reached"
    )
    early, late = (open_artefact(tmp_path / name).config for name in said)
    assert 40 < early["ended_at"] < early["steps"] == 4000 and early["until_reached"] is True
    assert (late["ended_at"], late["steps"], late["until_reached"]) == (40, 40, False)

    out = tmp_path / "meta"
    command = ["train-meta", str(run / "ensemble"), "--options", str(tmp_path / "early"), "--out", str(out), *FEW]
    assert main(command) == 0
    agent = read_run(open_artefact(out), "meta")
    assert agent.config["options_ended_at"] == early["ended_at"] and agent.budget == early["ended_at"] + 200
    assert early["ended_at"] < agent.episodes.step[-1] <= agent.budget
