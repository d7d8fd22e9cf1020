"""The card in each artefact: what a reader wants to know first, the same for the same seed, no markup of strangers."""

from pathlib import Path
from typing import Any

import numpy as np
from toy_data import files_of

from hypogoal.cards import create_artefact
from hypogoal.core.artefacts import check_files, open_artefact
from hypogoal.inspection import faults_of

GOAL = "`open` [a](x) ![b](y) _door_"


def make(out: Path, domain: str = "doorkey", sub_goal: str = "one", inputs: tuple[Path, ...] = (), **more: Any) -> str:
    """The card of an ensemble artefact."""
    config = {"sub_goals": [sub_goal], "members": 3, "steps": 17, "workers": 1, "domain": domain, **more}
    with create_artefact(out, kind="ensemble", config=config, seed=5, inputs=inputs) as folder:
        for name in files_of("ensemble", config):
            (folder / name).write_text('{"sub_goal": "one", "step": 17, "labelled": 0.25}\n')
    return (out / "README.md").read_text(encoding="utf-8")


def test_a_card_says_what_it_is_how_it_was_made_and_how_to_load_it(tmp_path: Path) -> None:
    """Spec A8: kind, command, seed, inputs, what is no default, numbers, Python; hashed like every file."""
    data = tmp_path / "data.h5"
    data.write_text("states")
    card = make(tmp_path / "run" / "ensemble", inputs=(data,))
    assert card.startswith("# ensemble\n") and "`hypogoal train-ensemble` with seed 5" in card
    for line in (
        "../../data.h5 (data)",
        "steps = 17",
        "labelled loss: 0.25",
        "ensemble = hypogoal.load_ensemble('.', 'one')",
    ):
        assert f"\n    {line}\n" in card, line
    assert "members = 3" not in card, "the default"
    artefact = open_artefact(tmp_path / "run" / "ensemble")
    assert check_files(artefact) == [] and "README.md" in artefact.manifest["files"]
    (artefact.path / "README.md").write_text("mine")
    assert any("README.md: changed" in fault for fault in faults_of(artefact.path))


def test_the_same_seed_gives_the_same_card(tmp_path: Path) -> None:
    """Wherever it is made, and in however many processes."""
    assert make(tmp_path / "one") == make(tmp_path / "other", workers=7)
    assert make(tmp_path / "third", steps=18) != make(tmp_path / "fourth")


def test_no_name_is_markup(tmp_path: Path) -> None:
    """Spec H8: what is quoted changes nothing but lines that are indented, and stays in its line."""
    plain = make(tmp_path / "plain")
    strange = make(
        tmp_path / "strange",
        "a\n# mine\n\n<script>x</script>\u202e\x1b[31m",
        GOAL,
        note="\r\n\r\n# mine",
        **{"x\n# y": 1},
    )

    def outside(card: str) -> list[str]:
        return [line for line in card.splitlines() if not line.startswith("    ")]

    assert outside(strange) == outside(plain)
    assert GOAL in strange and all(sign not in strange for sign in "\u202e\x1b\r")
    before = [number for number, line in enumerate(strange.split("\n")) if line.startswith("    ")]
    lines = strange.split("\n")
    assert all(lines[number - 1] == "" or lines[number - 1].startswith("    ") for number in before)


def test_every_kind_has_a_card(tmp_path: Path) -> None:
    """What the table of texts says is what there is."""
    import tomllib

    import hypogoal

    texts = tomllib.loads((Path(hypogoal.__file__).parent / "cards.toml").read_text(encoding="utf-8"))
    kinds = texts.keys() - {"text"}
    audits = {"audit", "recorded-audit"}
    assert {"ensemble", "options", "meta", "baseline", "evaluation", "report", "comparison"} | audits == kinds
    options = {"sub_goals": ["one"], "termination": "learned"}
    for kind in ("options", "report"):
        with create_artefact(tmp_path / kind, kind=kind, config=options, seed=0) as folder:
            (folder / "metrics.jsonl").write_text('{"step": 1, "success": 0.5}\n' if kind == "options" else "")
    assert "success: 0.5" in (tmp_path / "options/README.md").read_text()
    assert np.all([name in (tmp_path / "report/README.md").read_text() for name in ("# report", "none")])
