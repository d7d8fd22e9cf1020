"""Spec H5: a policy is trained against a success classifier; what it is fooled by is told, and what a mend changes."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from corridor import Corridor, LongCorridor
from numpy.typing import NDArray
from PIL import Image

from hypogoal.cli import main
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.own_code import OF_FILE
from hypogoal.dataset import open_dataset
from hypogoal.domains.doorkey import DOMAIN, DoorKeyConfig
from hypogoal.domains.doorkey_engine import KEY, TILE, DoorKeyEngine, tiles
from hypogoal.evaluation.audit import CELL, Execution, kinds_of, lines_of
from hypogoal.hypotheses.config import TrainEnsembleConfig
from hypogoal.hypotheses.ensemble import read_ensemble
from hypogoal.stages.collect import collect
from hypogoal.stages.train_ensemble import train_ensemble

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


def left_end(pictures: Pictures) -> NDArray[np.bool_]:
    return white_at(pictures, 0)


def too_soon(pictures: Pictures) -> list[float]:
    return [0.6 if soon else 0.1 for soon in white_at(pictures, 1)]


def of_no_shape(pictures: Pictures) -> NDArray[np.float64]:
    return np.full((len(pictures), 2), 0.5)


def no_probability(pictures: Pictures) -> NDArray[np.float64]:
    return np.full(len(pictures), np.nan)


def audited(out: Path, name: str, *words: str) -> tuple[dict, list[dict[str, int]]]:
    """``audit.json`` and ``executions.csv`` of an audit of a function of this module."""
    target = name if ":" in name else f"{__name__}:{name}"
    assert main(["audit", target, "--out", str(out), "-q", *words]) == 0
    assert main(["verify", str(out)]) == 0
    report = json.loads((out / "audit.json").read_text(encoding="utf-8"))
    with (out / "executions.csv").open(newline="", encoding="utf-8") as file:
        return report, [{column: int(value) for column, value in row.items()} for row in csv.DictReader(file)]


def setting(*pairs: str) -> list[str]:
    return [word for pair in pairs for word in ("--set", pair)]


@pytest.fixture
def corridor(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The words for a small audit in the corridor."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1]))
    few = setting(
        "steps=1500", "environments=4", "warm_up=50", "epsilon_steps=300", "option_timeout=10", "option_batch=24"
    )
    return ["--domain", "own_domain:DOMAIN", "--sub-goal", "left-end", *few]


def test_a_classifier_that_confuses_keys_is_fooled_by_the_other_key(tmp_path: Path) -> None:
    """Spec H5: on the shortest ways, where all can be said: the planted kind, its film, and that the mend ends it."""
    shortest = setting("network=planned", "steps=320", "executions=20")
    where = ["--domain", "doorkey", "--sub-goal", "collect-red-key", "--layout-seed", BLUE_FIRST, *shortest]
    report, rows = audited(tmp_path / "audit", "takes_blue_for_red", *where)
    before, mended = report["before"], report["mended"]
    assert (before["threshold"], before["exploit_rate"], before["fooled"], before["executions"]) == (0.5, 1.0, 20, 20)
    assert before["kinds"] == [
        {"executions": 20, "holds": ["collect-blue-key"], "position": {}, "film": "before-1.gif"}
    ]
    assert (mended["threshold"], mended["exploit_rate"], mended["said_yes"], mended["kinds"]) == (0.95, 0.0, 20, [])
    assert 0.5 < report["random_play"]["accuracy"] < 1 and report["random_play"]["false_yes"] > 0
    assert report["random_play"]["false_no"] == 0
    assert {(row["mended"], row["said_yes"], row["holds"], row["kind"]) for row in rows} == {
        (0, 1, 0, 0),
        (1, 1, 1, -1),
    }

    engine = DoorKeyEngine(int(BLUE_FIRST))
    ids, away = engine.distances()
    steps = int(away[engine.labels(ids)[:, 0]].min())
    assert {row["steps"] for row in rows if not row["mended"]} == {steps}
    with Image.open(tmp_path / "audit" / "before-1.gif") as film:
        assert film.n_frames == steps + 1
        corners = []
        for number in range(film.n_frames):
            film.seek(number)
            corners.append(film.convert("RGB").getpixel((1, 1)))
    assert len({*corners[:-1]}) == 1 and corners[-1] not in corners[:-1], "the last picture alone is marked"
    lines = list(lines_of(report))
    assert "  before-1.gif   20 x  while collect-blue-key holds" in lines
    assert max(map(len, lines)) <= 80


def test_a_policy_learns_to_fool_and_none_fools_the_truth(tmp_path: Path, corridor: list[str]) -> None:
    """Spec H5: learned, on an engine that cannot begin episodes when asked; the same seed gives the same bytes."""
    report, rows = audited(tmp_path / "soon", "too_soon", *corridor)
    assert report["before"]["exploit_rate"] == 1.0 and report["before"]["fooled"] >= 90
    assert [kind["holds"] for kind in report["before"]["kinds"]] == [[]]
    stays = [row for row in rows if row["yes_at_start"] and row["said_yes"] and row["steps"] == 1]
    assert not stays, "they follow from the executions before"
    mended = report["mended"]
    assert (mended["said_yes"], mended["fooled"], mended["exploit_rate"]) == (0, 0, None)

    truth, _ = audited(tmp_path / "truth", "left_end", *corridor, "--set", "mend=none")
    assert truth["mended"] is None
    assert (truth["random_play"]["accuracy"], truth["before"]["exploit_rate"]) == (1.0, 0.0)
    assert truth["before"]["said_yes"] >= 50

    audited(tmp_path / "again", "too_soon", *corridor)
    for name in ("audit.json", "executions.csv", "before-1.gif"):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "soon" / name).read_bytes()


@pytest.fixture(scope="module")
def ensemble(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two members, barely trained."""
    folder = tmp_path_factory.mktemp("member")
    collect(DOMAIN, DoorKeyConfig(heldout_layouts=1, unlabelled_seeds=(1,)), folder / "data.h5", quiet=True)
    few = TrainEnsembleConfig(steps=10, members=2, workers=1, sub_goals=("open-red-door",))
    train_ensemble(folder / "data.h5", few, folder / "ensemble", quiet=True)
    return folder / "ensemble"


def test_a_member_is_audited_in_its_domain(ensemble: Path, tmp_path: Path) -> None:
    """Spec H5: its sub-goal, its domain, its threshold; the mend of the labelled positives."""
    few = setting("steps=640", "warm_up=100")
    source = open_artefact(ensemble)
    members = read_ensemble(ensemble, source.config, "open-red-door")
    before = float(members.thresholds[1])
    low = ["--set", "threshold=0.001", "--set", "mend=positives-median"]
    report, _ = audited(tmp_path / "audit", f"{ensemble}:open-red-door/1", *few, *low)
    assert before == 0.5
    assert report["sub_goal"] == "open-red-door" and report["domain"] == "doorkey"
    manifest = open_artefact(tmp_path / "audit", "audit").manifest
    assert [entry["kind"] for entry in manifest["inputs"]] == ["ensemble"]
    assert manifest["config"]["domain_config"] == source.config["domain_config"]
    split = open_dataset(source.input("data")).labelled("open-red-door")
    median = np.median(members.predict(split.observations)[split.labels, 1])
    assert report["mended"]["threshold"] == pytest.approx(median)


def test_kinds_of_false_yes() -> None:
    """What looks alike is one kind, unless other sub-goals hold there; the most frequent comes first."""
    engine = Corridor(1)

    def fooled(*cells: int) -> list[Execution]:
        return [Execution(0, [2, cell], True, [cell == 0, False], False, False) for cell in cells]

    assert kinds_of(engine, fooled(1, 3, 3), 0.0) == [1, 0, 0]
    assert kinds_of(engine, fooled(1, 3, 3, 0), 1.0) == [0, 0, 0, 1]
    assert kinds_of(engine, [], 0.1) == []


class Wide(LongCorridor):
    """A cell of the corridor is as wide as a place."""

    def positions(self, ids: NDArray[np.int64]) -> NDArray[np.int64]:
        return super().positions(ids) * CELL


def test_kinds_are_places_where_positions_are_known() -> None:
    """Whatever else the pictures show: states 0 and 2 are in the same cell, 1 in another."""
    engine = Wide(1)
    for action in (3, 2):  # right, and back
        engine.step(np.array([action]))
    rows = [Execution(0, [0, state], True, [False, False], False, False) for state in (1, 0, 2)]
    assert kinds_of(engine, rows, 1.0) == [1, 0, 0]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("{here}:left_end", "Give --domain."),
        ("{here}:left_end --domain own_domain:DOMAIN", "which sub-goal"),
        ("{here}:left_end --domain own_domain:DOMAIN --sub-goal fly", "does not know where this is true: fly"),
        ("{here}:nothing --domain doorkey", "the classifier cannot be loaded"),
        ("{here}:BLUE_FIRST --domain doorkey", "this is no classifier"),
        ("left_end --domain doorkey", "this is no classifier"),
        ("{here}:of_no_shape --domain doorkey --sub-goal go-to-goal", "gave float64 ("),
        ("{here}:no_probability --domain doorkey --sub-goal go-to-goal", "Give probabilities, 0 to 1."),
        (
            "{here}:left_end --domain doorkey --sub-goal go-to-goal --set mend=threshold:0.4",
            "mends no threshold",
        ),
        ("{here}:left_end --domain doorkey --sub-goal go-to-goal --set mend=often", "mends no threshold"),
        ("{here}:left_end --domain doorkey --sub-goal go-to-goal --set mend=positives-median", "mends no threshold"),
        ("{ensemble}:open-red-door/2", "has members 0 to 1"),
        ("{ensemble}:fly/0", "unknown sub-goal: fly"),
        ("{ensemble}/none:open-red-door/0", "no such artefact"),
    ],
)
def test_mistakes(
    words: str, told: str, ensemble: Path, tmp_path: Path, corridor: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """Spec G2: one line that says what to do, exit code 2, nothing written."""
    assert corridor
    given = words.format(here=__name__, ensemble=ensemble).split()
    assert main(["audit", *given, "--out", str(tmp_path / "audit"), "-q"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and told in lines[0], lines
    assert not any(tmp_path.iterdir())


def test_a_files_word_is_not_the_users(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Spec H8: a classifier that a sweep's file names is loaded only where the user allowed it."""
    monkeypatch.setenv(OF_FILE, "1")
    words = ["--domain", "doorkey", "--sub-goal", "go-to-goal", "--out", str(tmp_path / "audit"), "-q"]
    assert main(["audit", f"{__name__}:left_end", *words]) == 2
    assert "a file names code of its own as its classifier" in capsys.readouterr().err
