"""Options that each begin at a start state, on engines that forget; the stage, too (Spec A3, B4, D1-D4, D6, E6, F3)."""

import csv
import json
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from command_line import refuses
from corridor import Corridor, LongCorridor
from option_loops import BEGIN, QUICK, Chosen, Scripted, loop_of, played
from toy_data import untrained

import hypogoal
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.tensors import load_tensors
from hypogoal.domains.base import Domain
from hypogoal.options.choosers import EvenChooser
from hypogoal.options.config import OptionConfig
from hypogoal.options.light import LightLearner
from hypogoal.options.loop import OptionLoop
from hypogoal.options.recording import Recorder
from hypogoal.options.tables import Executions
from hypogoal.stages.train_baseline import train_baseline
from hypogoal.stages.train_options import train_options

LEFT, RIGHT, STAY = 2, 3, 0


def play(engine: Corridor, actions: list[int], options: list[int], **settings: object) -> tuple[Chosen, Recorder]:
    """The same in every environment: what became of these options while these actions were played."""
    loop = loop_of(engine, Scripted(*actions), Chosen(*options), **BEGIN | {"option_timeout": 4} | settings)
    played(loop, len(actions))
    assert np.concatenate(loop.chooser.offered).all()
    return loop.chooser, loop.recorder


def columns(folder: Path) -> list[dict[str, int]]:
    with (folder / "executions.csv").open(newline="") as file:
        reader = csv.DictReader(file)
        assert tuple(reader.fieldnames) == Executions.names()
        return [{name: int(value) for name, value in row.items()} for row in reader]


def test_every_option_begins_at_a_start_state(tmp_path: Path) -> None:
    """Spec D4, F3: one reaches its end, one runs out of time, one dies, and each next one begins at the start.

    From cell 2: option 0 (left end) goes left twice; then it waits out its four steps in cell 2; then option 0 again,
    pushed right three times, dies in cell 5.
    """
    engine = LongCorridor(1)
    actions = [LEFT, LEFT, STAY, STAY, STAY, STAY, RIGHT, RIGHT, RIGHT, STAY]
    chooser, recorder = play(engine, actions, [0, 0, 0, 1])
    assert chooser.began == [0, 0, 0, 0]  # the id of the one start state
    assert [outcome.durations[0] for outcome in chooser.outcomes] == [2, 4, 3]
    assert [bool(outcome.truncated[0]) for outcome in chooser.outcomes] == [True, True, False]
    assert [bool(outcome.terminated[0]) for outcome in chooser.outcomes] == [False, False, True]
    assert recorder.episodes.rows == [(2, 2, 0.0, 0, 0), (6, 4, 0.0, 0, 0), (9, 3, 0.0, 1, 0)]
    assert engine.elapsed[0] == 1, "the fourth runs"

    recorder.write_executions(tmp_path, lambda positions, options: 10 * positions[:, 1])
    rows = columns(tmp_path)
    assert [(row["step"], row["option"], row["duration"]) for row in rows] == [(2, 0, 2), (6, 0, 4), (9, 0, 3)]
    assert [row["reached"] for row in rows] == [1, 0, 0]
    assert [row["terminated"] for row in rows] == [0, 0, 1]
    assert [row["inside_at_start"] for row in rows] == [0, 0, 0]
    assert [(row["room"], row["x"], row["y"], row["distance"]) for row in rows] == [
        (0, 0, 0, 0), (0, 2, 0, 20), (0, 5, 0, 50),
    ]  # fmt: skip
    assert recorder.recent(restarted=True) == pytest.approx({"reached": 1 / 3, "terminated": 1 / 3, "duration": 3.0})
    assert recorder.recent(restarted=False) == pytest.approx({"success": 0.0, "length": 3.0})
    assert Recorder(2, engine).recent(restarted=False) == {}


def test_an_option_that_begins_inside_its_sub_goal_runs_and_says_so(tmp_path: Path) -> None:
    """Spec D4, F3: nothing is masked; it runs one step at least, and its row says inside_at_start."""
    engine = LongCorridor(1, start="left")
    _, recorder = play(engine, [LEFT, RIGHT, RIGHT, RIGHT, RIGHT, STAY], [0, 0, 1])
    recorder.write_executions(tmp_path, lambda positions, options: positions[:, 1])
    rows = columns(tmp_path)
    assert [(row["duration"], row["reached"], row["inside_at_start"], row["x"]) for row in rows] == [
        (1, 1, 1, 0),
        (4, 0, 1, 4),
    ]


def test_no_executions_no_rows(tmp_path: Path) -> None:
    """Spec F3: an option that was never chosen has no rows, and nothing breaks."""
    engine = LongCorridor(1)
    Recorder(2, engine).write_executions(tmp_path, lambda positions, options: positions[:, 1])
    assert columns(tmp_path) == []


def test_an_engine_that_cannot_restart_is_refused() -> None:
    """Spec D4: a clear line, not options that go on where others stopped."""
    with pytest.raises(UserError, match="restart_options=true"):
        play(Corridor(1), [0], [0])


def test_stops_of_an_engine_that_forgets_are_kept_as_pictures(tmp_path: Path) -> None:
    """Spec F6: the last stops can be drawn although their states are forgotten."""
    engine = LongCorridor(1, memory=5)
    _, recorder = play(engine, [LEFT, LEFT, *[STAY] * 40], [0] * 12)
    (stop,) = [run.states[-1] for run in recorder.executions[0] if run.reached]
    assert not engine.remembers(np.array([stop])).any()
    with pytest.raises(ValueError, match="forgotten"):
        engine.images(np.array([stop]))
    recorder.write(tmp_path)
    with h5py.File(tmp_path / "terminations.h5") as file:
        (picture,) = file["0"][()]
    assert (picture[:, :7] == 255).all() and not picture[:, 7:].any(), "cell 0"


def learned(steps: int, engine: LongCorridor | None = None, **settings: object) -> OptionLoop:
    loop = loop_of(engine or LongCorridor(4), **QUICK | BEGIN | {"option_timeout": 10} | settings)
    return played(loop, steps // 4)


def test_values_over_several_steps_are_the_discounted_ones() -> None:
    """Spec D2: in cell 1 the left end is one step away, in cell 2 two: values near 1 and gamma."""
    learner = learned(2000, n_step=3, option_gamma=0.5, epsilon_final=0.3, option_learning_rate=2e-3).learner
    engine = learner.engine
    at = {cell: engine.cell.index(cell, engine.n_states - 1000) for cell in (1, 2)}
    with torch.no_grad():
        values = learner.networks.online(torch.from_numpy(engine.images(np.array(list(at.values())))))[:, 0]
    np.testing.assert_allclose(values[:, LEFT], [1.0, 0.5], atol=0.12)


def test_a_step_of_several_needs_own_experience() -> None:
    """Spec D2: others' sub-goals may lie in between."""
    with pytest.raises(UserError, match="experience=own"):
        learned(4, n_step=3, experience="shared")


def test_a_replay_longer_than_the_memory_is_refused() -> None:
    """Spec D3: before it begins, with the number that fits; with that number it begins."""
    with pytest.raises(UserError, match=r"replay=1000\. Give --set replay=") as caught:
        learned(4, LongCorridor(4, memory=900), replay=1000)
    learned(4, LongCorridor(4, memory=900), replay=int(caught.value.do.split("replay=")[1].split()[0]))


def test_forgotten_states_are_not_learned_from() -> None:
    """Spec D3: positives from long ago are kept by id; once their pictures are gone they are not drawn again."""
    engine = LongCorridor(4, memory=400)
    loop = learned(0, engine, replay=200, n_step=3)
    learner = loop.learner
    while not learner.positives.all():
        loop.step()
    learner.act = lambda ids, options, age, **_: np.zeros(len(ids), np.int64)  # from now on nothing is reached
    played(loop, 150)
    assert not engine.remembers(learner.positive.next_state[learner.positive.next_state > 0]).any()
    batch, indices, weights = learner._batch()
    assert engine.remembers(batch.state).all() and engine.remembers(batch.next_state).all()
    assert len(indices) == len(weights) == learner.settings.option_batch, "all of it from the replay"


def test_the_replay_never_outlives_the_memory() -> None:
    """Spec D3: with the smallest memory that is accepted, thousands of steps ask for no forgotten state."""
    config = OptionConfig.of(**(QUICK | BEGIN | {"replay": 300, "n_step": 7}))
    smallest = LightLearner.reach(config, 2)
    slow = {"update_interval": 32, "option_batch": 300}  # few updates, each with most of the replay
    learned(2000, LongCorridor(4, memory=smallest), replay=300, n_step=7, option_timeout=9, **slow)


def test_even_choice_gives_every_option_as_many_steps() -> None:
    """Spec D4: option 0 takes 2 steps each time, option 1 its full 10; uniform choice would give it 5 of 6 steps."""
    chooser = EvenChooser(np.random.default_rng(0), 2)
    recorder = played(loop_of(LongCorridor(4), Scripted(LEFT), chooser, **BEGIN, option_timeout=10), 1000).recorder
    recorder.flush()
    steps = [sum(row[6] for row in recorder.choices if row[1] == option) for option in (0, 1)]
    assert abs(steps[0] - steps[1]) <= 4 * 10 and sum(steps) > 3900
    masked = np.array([[True, False]])
    assert [chooser.choose(np.array([9]), np.zeros(1, np.int64), masked)[0] for _ in range(5)] == [0] * 5


class LongCorridorDomain(Domain):
    """The long corridor's two named cells."""

    name = "test_start_states:DOMAIN"
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


class Relabelled(LongCorridorDomain):
    """What an ensemble of the user's own labels says of its domain, which is ``DOMAIN``."""

    sub_goals = ("mine",)


pytestmark = pytest.mark.usefixtures("trusted")  # manifests here name this module's domain


@pytest.fixture(scope="module")
def corridor(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return untrained(tmp_path_factory.mktemp("run") / "ensemble", DOMAIN, members=1, network="mlp")


def train(ensemble: Path, out: Path, seed: int = 0, **changes):
    few = {"environments": 4, "warm_up": 60, "termination": "oracle", "option_timeout": 8, "steps": 400}
    return train_options(ensemble, out, seed=seed, quiet=True, **BEGIN | few | changes)


def test_options_from_a_named_start(corridor: Path, tmp_path: Path) -> None:
    """Spec A3, D4, F3: the stage writes the last executions with their distance, and says where they began."""
    train(corridor, tmp_path / "options", start="middle", n_step=3, chooser="even")
    artefact = open_artefact(tmp_path / "options", "options")
    assert artefact.config["steps"] == 800 and artefact.config["start"] == "middle"
    assert json.loads((tmp_path / "options" / "layout.json").read_text())["start"] == "middle"
    rows = columns(tmp_path / "options")
    assert {row["option"] for row in rows} == {0, 1}
    assert all(row["distance"] == min(row["x"], 5 - row["x"]) for row in rows)
    assert all((row["distance"] == 0) >= row["reached"] for row in rows)
    assert all(row["duration"] == 8 for row in rows if not row["reached"] and not row["terminated"])
    assert not any(row["inside_at_start"] for row in rows)
    last = json.loads((tmp_path / "options" / "metrics.jsonl").read_text().splitlines()[-1])
    assert last["step"] == 800 and {"reached", "terminated", "duration", "option_loss"} <= set(last)


def test_distances_to_unknown_sub_goals_are_not_written(tmp_path: Path) -> None:
    """Spec F3: of a sub-goal of the user's own labels the domain does not know the place."""
    ensemble = untrained(tmp_path / "ensemble", Relabelled(), members=1, network="mlp")
    train(ensemble, tmp_path / "options", start="middle", termination="learned")
    assert not (tmp_path / "options" / Executions.FILE).exists()


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
        rows = columns(tmp_path / name)
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
