"""``train-options`` on a domain with named starts, through the stage (Spec A3, B4, D4, F3)."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import refuses
from corridor import LongCorridor
from toy_data import untrained

import hypogoal
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.tensors import load_tensors
from hypogoal.domains.base import Domain
from hypogoal.options.tables import Executions
from hypogoal.stages.train_baseline import train_baseline
from hypogoal.stages.train_options import train_options

BEGIN = {"restart_options": True, "mask_reached": False, "experience": "own", "environments": 4, "warm_up": 60}


class LongCorridorDomain(Domain):
    """The long corridor's two named cells."""

    name = "test_named_starts:DOMAIN"
    sub_goals = ("left-end", "right-end")
    observation_shape = LongCorridor.observation_shape
    config_class = type(None)
    measures = True
    starts = tuple(LongCorridor.cells)

    def collect(self, config, seed, progress):
        raise NotImplementedError

    def make_engine(self, layout_seed, count, max_steps, **arguments):
        return LongCorridor(count, max_steps, **arguments)

    def distance_to(self, sub_goal, positions):
        return np.minimum(positions[:, 1], 5 - positions[:, 1])


DOMAIN = LongCorridorDomain()


pytestmark = pytest.mark.usefixtures("trusted")  # manifests here name this module's domain


@pytest.fixture(scope="module")
def corridor(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return untrained(tmp_path_factory.mktemp("run") / "ensemble", DOMAIN, members=1, network="mlp")


def rows_of(folder: Path) -> list[dict[str, int]]:
    with (folder / "executions.csv").open(newline="") as file:
        reader = csv.DictReader(file)
        assert tuple(reader.fieldnames) == Executions.names()
        return [{name: int(value) for name, value in row.items()} for row in reader]


def train(ensemble: Path, out: Path, seed: int = 0, **changes):
    settings = BEGIN | {"termination": "oracle", "option_timeout": 8, "steps": 400} | changes
    return train_options(ensemble, out, seed=seed, quiet=True, **settings)


def test_options_from_a_named_start(corridor: Path, tmp_path: Path) -> None:
    """Spec A3, D4, F3: the stage writes the last executions with their distance, and says where they began."""
    train(corridor, tmp_path / "options", start="middle", n_step=3, chooser="even")
    artefact = open_artefact(tmp_path / "options", "options")
    assert artefact.config["steps"] == 800 and artefact.config["start"] == "middle"
    assert json.loads((tmp_path / "options" / "layout.json").read_text())["start"] == "middle"
    rows = rows_of(tmp_path / "options")
    assert {row["option"] for row in rows} == {0, 1}
    assert all(row["distance"] == min(row["x"], 5 - row["x"]) for row in rows)
    assert all((row["distance"] == 0) >= row["reached"] for row in rows)
    assert all(row["duration"] == 8 for row in rows if not row["reached"] and not row["terminated"])
    assert not any(row["inside_at_start"] for row in rows)
    last = json.loads((tmp_path / "options" / "metrics.jsonl").read_text().splitlines()[-1])
    assert last["step"] == 800 and {"reached", "terminated", "duration", "option_loss"} <= set(last)


def test_a_start_must_be_one_of_the_domains(corridor: Path, tmp_path: Path) -> None:
    """Spec D4, G2: one line that names those there are; nothing is left behind."""
    words = ["train-options", corridor, "--out", tmp_path / "options", "--set", "termination=oracle"]
    refuses("unknown start: top. Give --set start=X, X one of middle, left.", *words, "--set", "start=top")
    refuses("where are episodes to begin?: start. Give --set start=X, X one of middle, left.", *words)


def test_a_domain_with_one_start_has_no_names_for_it(tmp_path: Path) -> None:
    """Spec D4, G2: DoorKey's layouts begin where they begin."""
    from hypogoal.domains.doorkey.domain import DOMAIN as doorkey

    ensemble = untrained(tmp_path / "ensemble", doorkey, 1, "mlp")
    with pytest.raises(UserError, match="unknown start: 1L"):
        train_options(ensemble, tmp_path / "options", steps=10, start="1L", quiet=True)


@pytest.mark.atari
def test_options_on_a_ladder(tmp_path: Path) -> None:
    """Spec A3, B4, D4, F3: learned members and the oracle on the emulator, from an ensemble to executions and stops."""
    from hypogoal.domains.montezuma.domain import DOMAIN as montezuma

    ensemble = untrained(tmp_path / "ensemble", montezuma, members=2)
    few = {"start": "1L", "option_timeout": 25, "steps": 160, "n_step": 3, "exploration": "persistent", "replay": 500}
    for name, options in (("learned", 2), ("oracle", 1)):
        train(ensemble, tmp_path / name, termination=name, **few)
        rows = rows_of(tmp_path / name)
        assert {row["option"] for row in rows} == set(range(options))
        positions = np.array([(row["room"], row["x"], row["y"]) for row in rows])
        np.testing.assert_array_equal(
            montezuma.distance_to("climb-down-ladder", positions), [row["distance"] for row in rows]
        )
        assert all(row["duration"] <= 25 for row in rows)
    reached = [row["distance"] <= 4 for row in rows if row["reached"]]  # the oracle's: two units in x and two in y
    assert all(reached)


def test_a_baseline_begins_where_it_is_told(tmp_path: Path) -> None:
    """Spec E7, I4: an unknown start leaves nothing behind."""
    few = {"agent": "ppo", "steps": 128, "max_episode_steps": 20, "quiet": True}
    train_baseline(DOMAIN.name, tmp_path / "ppo", start="left", **few)
    assert json.loads((tmp_path / "ppo" / "layout.json").read_text())["start"] == "left"
    with pytest.raises(UserError, match="unknown start: nowhere"):
        train_baseline(DOMAIN.name, tmp_path / "none", start="nowhere", **few)
    assert not (tmp_path / "none").exists()


def test_options_go_on_elsewhere(tmp_path: Path) -> None:
    """Options learned from one start go on from another; what is loaded plays as they do."""
    ensemble, near, far = (tmp_path / name for name in ("ensemble", "near", "far"))
    untrained(ensemble, DOMAIN, network="mlp")
    few = {"termination": "learned", "steps": 100}
    train(ensemble, near, start="middle", **few)
    # So long a warm-up that nothing is learned: the options as they are.
    few |= {"start": "left", "warm_up": 10**6, "options": near}
    train(ensemble, far, **few)
    weights, later = (load_tensors(folder / "options.safetensors") for folder in (near, far))
    assert all(torch.equal(value, later[name]) for name, value in weights.items() if name.startswith("online."))
    assert (later["option_steps"] > weights["option_steps"]).all()
    assert open_artefact(far).config["start"] == "left"
    picture = LongCorridor(1).images(np.zeros(1, np.int64))[0]
    assert 0 <= hypogoal.load_options(far).policies(1)(picture) < LongCorridor.n_actions
    another = untrained(tmp_path / "another", DOMAIN, network="mlp", seed=1)
    with pytest.raises(UserError, match="trained with another ensemble"):
        train(another, tmp_path / "other", **few)
