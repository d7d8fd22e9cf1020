"""docs/own-domain.md: the domains that it shows, as a reader would take them (Spec B6)."""

import json
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pandas as pd
import pytest
from command_line import run, settings
from test_docs import DOCS, blocks

from hypogoal.check import check_domain, require
from hypogoal.data import open_dataset


def module_of(words: str, folder: Path, name: str) -> Any:
    """The page's block with these words as a file in a folder."""
    [code] = [block for block in blocks(DOCS / "own-domain.md", "py") if words in block]
    path = folder / f"{name}.py"
    path.write_text(code, encoding="utf-8")
    module = ModuleType(name)
    exec(compile(code, str(path), "exec"), module.__dict__)
    return module


@pytest.mark.usefixtures("trusted")
def test_the_smallest_domain_without_gymnasium(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It keeps the contract, and its option is learned."""
    require(check_domain(module_of("class Line(Engine)", tmp_path, "line").DOMAIN))
    monkeypatch.syspath_prepend(str(tmp_path))
    data, ensemble, options = tmp_path / "data.h5", tmp_path / "ensemble", tmp_path / "options"
    run("collect", "line:DOMAIN", "--out", data, "-q")
    run("train-ensemble", data, "--out", ensemble, "-q", *settings("members=1", "diversity=none", "workers=1"))
    run("train-options", ensemble, "--out", options, "-q", *settings("steps=4000", "epsilon_steps=1000"))
    episodes = pd.read_csv(options / "episodes.csv").tail(20)
    assert episodes["succeeded"].all() and episodes["length"].median() <= 5  # four steps from the start


@pytest.mark.slow
@pytest.mark.usefixtures("trusted")
def test_four_rooms_from_the_page_to_a_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Labelled in a corner, planned and played elsewhere; no engine is written."""
    module_of("FourRoomsEnv", tmp_path, "four_rooms")
    monkeypatch.syspath_prepend(str(tmp_path))
    folder = tmp_path / "run"
    data, ensemble = folder / "data.h5", folder / "ensemble"
    small = settings("labelled_seeds=5,6", "unlabelled_seeds=1", "heldout_seeds=1,3,5,6", "steps=500", "explore=0")
    run("collect", "four_rooms:DOMAIN", "--out", data, "-q", *small)
    heldout = open_dataset(data).heldout("target")
    np.testing.assert_array_equal(heldout.origins["planted_goal"], heldout.labels)
    assert (heldout.origins["planted_corner"] != heldout.labels).sum() > 1
    run("train-ensemble", data, "--out", ensemble, "-q", *settings("members=2", "steps=20", "workers=1"))
    run(
        "train-meta",
        ensemble,
        "--out",
        folder / "meta",
        "-q",
        *settings("network=planned", "steps=300", "layouts=4", "max_episode_steps=40"),
    )
    assert json.loads((folder / "meta" / "manifest.json").read_text(encoding="utf-8"))["config"]["network"] == "planned"
    run("evaluate", folder, "-q")
    run("report", folder, "-q")
    assert (folder / "report" / "index.html").is_file()
