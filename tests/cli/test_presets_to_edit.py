"""``hypogoal config STAGE --write``: a preset to edit with the stage's settings; and commands without ``--out``."""

from pathlib import Path

import pytest
from command_line import run

from hypogoal.cli import main
from hypogoal.settings import CONFIGS, configuration


@pytest.mark.parametrize("stage", ["collect", *CONFIGS])
@pytest.mark.parametrize("preset", [None, "demo"])
def test_a_written_preset_has_the_same_settings(stage: str, preset: str | None, tmp_path: Path) -> None:
    file = tmp_path / "my.toml"
    chosen = ["--preset", preset] if preset else []
    run("config", stage, *chosen, "--write", file)
    assert configuration(stage, "doorkey", str(file), ()) == configuration(stage, "doorkey", preset, ())


def test_an_existing_file_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "my.toml"
    file.write_text("mine")
    assert main(["config", "train-meta", "--write", str(file)]) == 2
    assert file.read_text() == "mine" and "a new .toml file" in capsys.readouterr().err


def test_a_dry_run_needs_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert "--out runs/figure3/" in run("run", "figure3", "--seed", "0", "--dry-run").out
    assert not [*tmp_path.iterdir()]
