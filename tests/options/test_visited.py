"""Spec B7: what a policy visited while it learned, saved in the data format and learned from again."""

from pathlib import Path

import numpy as np
import pytest
from command_line import FIXED, refuses, run, settings
from corridor import Corridor, LongCorridor

from hypogoal.core.artefacts import open_artefact
from hypogoal.core.errors import UserError
from hypogoal.data import Collected, States, joined, open_dataset, write_dataset
from hypogoal.options.visited import Visited, unlabelled_file


def walk(visited: Visited, engine: Corridor, steps: int, seed: int = 0) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        actions = rng.integers(engine.n_actions, size=engine.count)
        step = engine.step(actions)
        visited.see(step.next_ids)


def cells(visited: Visited) -> list[int]:
    """Which cell each kept image shows."""
    wide = 7 if isinstance(visited.engine, LongCorridor) else 8
    return (visited.states()[:, 0, :, 0].argmax(axis=1) // wide).tolist()


def test_distinct_states_are_kept_once() -> None:
    """Spec B7: six cells make six states, however often they are visited and whatever ids an engine gives them."""
    for engine in (Corridor(3), LongCorridor(3)):
        visited = Visited(engine, 100, seed=0)
        walk(visited, engine, 300)
        assert sorted(cells(visited)) == [0, 1, 2, 3, 4, 5]


def test_too_many_are_a_fair_sample() -> None:
    """Spec B7: over seeds every cell is among three of six as often as another, also the start, visited most often."""
    counts = np.zeros(6)
    for seed in range(400):
        engine = Corridor(2)
        visited = Visited(engine, 3, seed=seed)
        walk(visited, engine, 60)
        kept = cells(visited)
        assert len({*kept}) == len(kept) == 3
        counts[kept] += 1
    # Binomial(400, 1/2): 200 +- 4 standard deviations of 10; far cells are at times not visited at all.
    assert (np.abs(counts[1:4] - 200) < 60).all(), counts
    assert counts[2] < 1.3 * counts[0], "the start state is favoured"


def test_it_goes_on_where_it_was() -> None:
    """Spec G1: a snapshot in between changes nothing."""
    whole, engine = Visited(e := LongCorridor(3), 4, 0), e
    walk(whole, engine, 20)
    other = Visited(engine, 4, 0)
    other.restore(whole.snapshot())
    for visited in (whole, other):
        fresh = LongCorridor(3)
        visited.engine = fresh
        walk(visited, fresh, 30, seed=1)
    np.testing.assert_array_equal(whole.states(), other.states())


def test_an_ensemble_learns_from_what_was_visited(corridor_run: Path, tmp_path: Path) -> None:
    """Spec B7: options save what they visited, and an ensemble is trained with it, with the data's own or instead."""
    for name in ("options-more", "meta-more"):
        found = open_dataset(corridor_run / name / "visited.h5")
        assert len(np.unique(found.unlabelled(), axis=0)) == 5
        assert found.counts()["labelled"]["left-end"] == {"states": 0, "positives": 0}
    data, options = corridor_run / "data.h5", corridor_run / "options-more"
    few = settings("members=2", "workers=1", "steps=10", *FIXED)
    train = ["train-ensemble", data, *few, "-q"]
    run(*train, "--unlabelled", data, "--unlabelled", options, "--out", tmp_path / "both")
    run(*train, "--unlabelled", options, "--out", tmp_path / "visited")
    weights = [folder / "left-end.safetensors" for folder in (corridor_run / "ensemble", tmp_path / "both")]
    assert weights[0].read_bytes() != weights[1].read_bytes()
    both = open_artefact(tmp_path / "both", "ensemble")
    assert [entry.kind for entry in both.manifest.inputs] == ["data", "data", "data"]
    assert both.input("data") == data, "what is evaluated is the data, not what was visited"
    states = [open_dataset(file).unlabelled_states() for file in (data, options / "visited.h5")]
    found = joined(states)
    assert len(found.observations) == len(states[0].observations) + 5 and found.origins == {}
    run("verify", tmp_path)


def test_states_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    """Spec G2: of another domain, none at all, and a folder without them: one line, exit code 2, nothing written."""
    import toy_data

    data, other = toy_data.write(tmp_path / "data.h5"), tmp_path / "other.h5"
    toy_data.write(other, domain="another")
    chosen = "sub_goals=one"  # the other has no negatives
    (tmp_path / "empty").mkdir()
    for wrong, words in (
        (other, "the domain is another"), (tmp_path / "empty", "no artefact here"), (tmp_path / "no.h5", "no such"),
    ):  # fmt: skip
        command = ["train-ensemble", str(data), "--unlabelled", str(wrong), "--out", str(tmp_path / "out"), "-q"]
        refuses(words, *command, "--set", chosen)
    assert not (tmp_path / "out").exists()


def test_states_of_another_type_are_refused(tmp_path: Path) -> None:
    """Spec G2: numbers of the shape of pictures, in the same domain."""
    for kind in (np.uint8, np.float32):
        states = States(np.ones((2, 4, 5, 3), kind), np.array([[True], [False]]))
        collected = Collected((4, 5, 3), ("one",), states, states, states)
        write_dataset(tmp_path / kind.__name__, collected, domain="toy", config={}, seed=0)
    pictures = open_dataset(tmp_path / "uint8")
    assert unlabelled_file(pictures.path, pictures) == pictures.path
    with pytest.raises(UserError, match="the observation dtype is float32, that of the data uint8"):
        unlabelled_file(tmp_path / "float32", pictures)
