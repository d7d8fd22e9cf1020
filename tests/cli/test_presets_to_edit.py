"""``hypogoal config STAGE --write``: a preset to edit with the stage's settings; and commands without ``--out``."""

from pathlib import Path

import pytest

from hypogoal.cli import main
from hypogoal.settings import CONFIGS, configuration


@pytest.mark.parametrize("stage", ["collect", *CONFIGS])
@pytest.mark.parametrize("preset", [None, "demo"])
def test_a_written_preset_has_the_same_settings(stage: str, preset: str | None, tmp_path: Path) -> None:
    file = tmp_path / "my.toml"
    chosen = ["--preset", preset] if preset else []
    assert main(["config", stage, *chosen, "--write", str(file)]) == 0
    assert configuration(stage, "doorkey", str(file), ()) == configuration(stage, "doorkey", preset, ())


def test_an_existing_file_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "my.toml"
    file.write_text("mine")
    assert main(["config", "train-meta", "--write", str(file)]) == 2
    assert file.read_text() == "mine" and "a new .toml file" in capsys.readouterr().err


def test_a_dry_run_of_a_sweep_needs_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["sweep", "figure3", "--seeds", "0", "--dry-run"]) == 0
    assert "--out runs/figure3/" in capsys.readouterr().out
    assert not [*tmp_path.iterdir()]
    assert main(["sweep"]) == 2
    assert "which experiment?" in capsys.readouterr().err
