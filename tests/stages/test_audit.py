"""Spec H5: policies are trained against a success classifier: what they are fooled by, and what a mend changes."""

import csv
import json
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import refuses, run, settings
from numpy.typing import NDArray
from own_domain import CorridorDomain, TallCorridor
from PIL import Image
from toy_data import files_of, reseal

from hypogoal.core.artefacts import open_artefact
from hypogoal.domains.doorkey.engine import DoorKeyEngine
from hypogoal.domains.doorkey.rules import KEY, tiles
from hypogoal.domains.tiles import TILE
from hypogoal.evaluation.page import lines_of
from hypogoal.hypotheses.ensemble import read_ensemble
from hypogoal.tools.audit_played import CELL, FILMS

BLUE_FIRST = "101"  # a layout on which the blue key is nearer than the red one
Pictures = NDArray[np.uint8]


def gone(pictures: Pictures, colour: int) -> NDArray[np.bool_]:
    """Whether no key of a colour (0, 1, 2: blue, green, red) lies on the floor, bool (N,)."""
    side = pictures.shape[1] // TILE
    cells = pictures.reshape(-1, side, TILE, side, TILE, 3).swapaxes(2, 3)
    return ~(cells == tiles()[KEY + colour]).all((3, 4, 5)).any((1, 2))


def takes_blue_for_red(pictures: Pictures) -> NDArray[np.float64]:
    """It is surer where the red key is gone."""
    return np.where(gone(pictures, 2), 0.99, np.where(gone(pictures, 0), 0.9, 0.02))


def white_at(pictures: Pictures, cell: int) -> NDArray[np.bool_]:
    """Whether the agent of the corridor is in a cell."""
    return pictures[:, 0, 8 * cell, 0] > 0


left_end = partial(white_at, cell=0)


def too_soon(pictures: Pictures) -> list[float]:
    return [0.6 if soon else 0.1 for soon in white_at(pictures, 1)]


def everywhere(pictures: Pictures) -> NDArray[np.bool_]:
    return np.ones(len(pictures), np.bool_)


def beside_the_start(pictures: Pictures) -> NDArray[np.bool_]:
    return white_at(pictures, 1) | white_at(pictures, 3)


def of_no_shape(pictures: Pictures) -> NDArray[np.float64]:
    return np.full((len(pictures), 2), 0.5)


def no_probability(pictures: Pictures) -> NDArray[np.float64]:
    return np.full(len(pictures), np.nan)


class Placed(TallCorridor):
    """The corridor, which begins episodes when asked and knows where the agent is: a cell of it is one place."""

    restarts, position_names = True, ("x",)

    def restart(self, where: NDArray[np.bool_]) -> None:
        self.ids, self.elapsed = np.where(where, 2, self.ids), np.where(where, 0, self.elapsed)

    def positions(self, ids: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.asarray(ids)[:, None] * CELL


class PlacedDomain(CorridorDomain):
    """The corridor with these."""

    name = f"{__name__}:PLACED"

    def make_engine(self, layout_seed: int, count: int, max_steps: int, **arguments: Any) -> TallCorridor:
        return Placed(count, max_steps)


PLACED = PlacedDomain()


QUICK = settings("environments=4", "warm_up=50", "epsilon_steps=300", "option_timeout=10", "option_batch=24")
CORRIDOR = ["--domain", PLACED.name, "--sub-goal", "left-end", *QUICK]


def audited(out: Path, classifier: str, *words: str) -> tuple[dict[str, Any], list[dict[str, str]]]:
    """``audit.json`` and ``exploits.csv`` of an audit of an ensemble or of a function of this module."""
    target = classifier if "/" in classifier else f"{__name__}:{classifier}"
    run("audit", target, "--out", out, "-q", *words)
    run("verify", out)
    report = json.loads((out / "audit.json").read_text(encoding="utf-8"))
    with (out / "exploits.csv").open(newline="", encoding="utf-8") as file:
        return report, list(csv.DictReader(file))


def test_a_classifier_that_confuses_keys_is_fooled_by_the_other_key(tmp_path: Path) -> None:
    """Spec H5: on the shortest ways, where all can be said: the planted kind, its film, and that the mend ends it."""
    where = ["--domain", "doorkey", "--sub-goal", "collect-red-key", "--layout-seed", BLUE_FIRST]
    out = tmp_path / "audit"
    report, rows = audited(out, "takes_blue_for_red", *where, *settings("network=planned", "steps=1600"))
    before, mended = report["before"], report["mended"]
    assert (before["threshold"], before["fires_far"], before["there"]) == (0.5, 1.0, 0)
    assert before["fooled"] == before["executions"] >= 40
    film = "before-1.gif"
    kind = {"executions": before["fooled"], "holds": ["collect-blue-key"], "position": {}, "film": film}
    assert before["kinds"] == [kind]
    assert (mended["threshold"], mended["fires_far"], mended["fires_near"], mended["kinds"]) == (0.95, 0.0, 1.0, [])
    assert mended["there"] == mended["executions"] >= 40
    chance = report["random_play"]
    assert 0.5 < chance["accuracy"] < 1 and chance["precision"] < 1 and chance["recall"] == 1
    assert {(row["option"], row["reached"], row["near"]) for row in rows} == {("0", "1", "0"), ("1", "1", "1")}

    engine = DoorKeyEngine(int(BLUE_FIRST))
    ids, away, _ = engine.search()
    with Image.open(out / film) as drawn:
        assert drawn.n_frames == away[engine.labels(ids)[:, 0]].min() + 1, "from where it began"
    artefact = open_artefact(out, "audit")
    assert artefact.manifest.files.keys() - files_of("audit", artefact.config) == {film}
    lines = lines_of("played.txt", **report)
    assert f"  {film} {before['fooled']:4d} x  while collect-blue-key holds" in lines and max(map(len, lines)) <= 80


def test_a_policy_learns_to_fool_and_none_fools_the_truth(tmp_path: Path) -> None:
    """Spec H5: learned; where it was fooled is told by place; without a mend there is one policy."""
    report, _ = audited(tmp_path / "soon", "too_soon", *CORRIDOR, *settings("steps=2000"))
    before, mended = report["before"], report["mended"]
    assert before["fires_far"] >= 0.9 and before["came_near"] <= 0.05
    assert [(kind["holds"], kind["position"]) for kind in before["kinds"]] == [([], {"x": CELL})]
    assert (mended["fooled"], mended["there"], mended["kinds"]) == (0, 0, []) and mended["executions"] > 20

    truth, _ = audited(tmp_path / "truth", "left_end", *CORRIDOR, *settings("steps=1500", "mend=0"))
    assert truth["mended"] is None
    assert (truth["random_play"]["accuracy"], truth["before"]["fires_far"]) == (1.0, 0.0)
    assert truth["before"]["there"] >= 50


def test_executions_that_begin_inside_are_said(tmp_path: Path) -> None:
    report, _ = audited(tmp_path / "audit", "everywhere", *CORRIDOR, *settings("steps=200", "mend=0", "warm_up=200"))
    assert report["before"]["positive_at_start"] == 100
    lines = lines_of("played.txt", **report)
    assert "  100 begin where it is positive already, so that doing nothing is paid" in lines


def test_places_are_kinds_of_their_own(tmp_path: Path) -> None:
    """Spec H5: two places that look like success to it are two kinds, the more frequent first, each with its film."""
    played = settings("steps=400", "mend=0", "warm_up=400", "option_timeout=1")  # nothing is learned, so both are met
    report, _ = audited(tmp_path / "audit", "beside_the_start", *CORRIDOR, *played)
    kinds = report["before"]["kinds"]
    assert {kind["position"]["x"] for kind in kinds} == {1 * CELL, 3 * CELL} and FILMS > 1
    assert sum(kind["executions"] for kind in kinds) == 100 and kinds[0]["executions"] >= kinds[1]["executions"]
    assert [kind["film"] for kind in kinds] == ["before-1.gif", "before-2.gif"]


@pytest.fixture
def ensemble(tiny_run: Path, tmp_path: Path) -> Path:
    """Two members, barely trained, of states of another world than usual."""
    out = shutil.copytree(tiny_run / "ensemble-none", tmp_path / "made" / "ensemble")
    config = open_artefact(out).config
    reseal(out, config={**config, "domain_config": config["domain_config"] | {"wrong_key": "ends"}})
    return out


def test_a_member_is_audited_at_its_own_threshold(ensemble: Path, tmp_path: Path) -> None:
    """Spec H5: in the world of its data; the states that fooled it can be kept, to label them."""
    source = open_artefact(ensemble)
    wanted = read_ensemble(ensemble, source.config, "open-red-door").thresholds[1].item()
    few = settings("steps=640", "warm_up=100", "save_visited=20", "mend=0.999999")
    words = ["--domain", "doorkey", "--sub-goal", "open-red-door", "--member", "1", *few]
    report, _ = audited(tmp_path / "audit", str(ensemble), *words)
    assert report["before"]["threshold"] == pytest.approx(wanted) and wanted != 0.5
    manifest = open_artefact(tmp_path / "audit", "audit").manifest
    assert [entry.kind for entry in manifest.inputs] == ["ensemble"] and manifest.config["member"] == 1
    assert manifest.config["domain_config"] == source.config["domain_config"]
    assert manifest.config["domain_config"]["wrong_key"] == "ends" and "visited.h5" in manifest.files


DOOR = "--domain doorkey --sub-goal go-to-goal"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (f"{__name__}:left_end --domain doorkey --sub-goal fly", "does not know where this sub-goal holds: fly"),
        (f"{__name__}:nothing {DOOR}", "the classifier cannot be loaded"),
        (f"{__name__}:BLUE_FIRST {DOOR}", "this is not a function"),
        (f"left_end {DOOR}", "no such artefact"),
        (f"{__name__}:of_no_shape {DOOR}", "gave ndarray (1, 2)"),
        (f"{__name__}:no_probability {DOOR}", "Give probabilities, 0 to 1,"),
        (f"{__name__}:left_end {DOOR} --set mend=0.4", "mend must be above the threshold 0.5"),
        (f"{__name__}:left_end {DOOR} --set termination=oracle", "an audit takes one classifier only"),
        (f"{__name__}:left_end --domain own_domain:DOMAIN --sub-goal left-end", "cannot begin an episode on request"),
        ("{ensemble} --domain doorkey --sub-goal open-red-door --member 2", "member: 2. Give --member, 0 to 1."),
        ("{ensemble} --domain doorkey --sub-goal go-to-goal", "unknown sub-goal: go-to-goal"),
    ],
)
def test_mistakes(words: str, told: str, ensemble: Path, tmp_path: Path) -> None:
    """Spec G2: one line that says what to do."""
    refuses(told, "audit", *words.format(ensemble=ensemble).split(), "--out", tmp_path / "out" / "audit", "-q")
