"""The chooser over symbols: worlds whose best choice is known, Thompson sampling as its case of one state, resuming."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pytest
import torch

from hypogoal.core.errors import UserError
from hypogoal.meta import symbols
from hypogoal.meta.symbols import END, Model, SymbolsChooser
from hypogoal.options.choosers import Outcome

Moves = Mapping[tuple[str, int], list[tuple[float, float, str]]]  # by place and option: shares, returns, next places
OVER, CUT = "over", "cut"


class World:
    """Places that offer options; an option leads on, to the end of the task or to a cut. It lasts ``tau`` steps."""

    def __init__(
        self, offered: Mapping[str, list[int]], moves: Moves, seed: int = 0, tau: int = 1, gamma: float = 0.99
    ):
        self.offered, self.moves, self.tau, self.gamma = offered, moves, tau, gamma
        self.options = 1 + max(max(options) for options in offered.values())
        self.rng = np.random.default_rng(seed)

    def episode(self, chooser: SymbolsChooser, most: int = 50) -> tuple[float, list[int]]:
        """The undiscounted return of an episode from the first place, cut after ``most`` decisions, and its choices."""
        place, chosen, total = next(iter(self.offered)), [], 0.0
        for count in range(1, most + 1):
            mask = np.zeros((1, self.options), np.bool_)
            mask[0, self.offered[place]] = True
            [option] = chooser.choose(np.array([0]), np.array([0]), mask).tolist()
            assert mask[0, option]
            chosen.append(option)
            outcomes = self.moves[place, option]
            share = [outcome[0] for outcome in outcomes]
            _, reward, place = outcomes[self.rng.choice(len(outcomes), p=share)]
            total += reward
            cut = place == CUT or count == most
            chooser.record(outcome_of(option, reward, self.gamma**self.tau, place == OVER, cut and place != OVER))
            if place == OVER or cut:
                break
        return total, chosen

    def episodes(self, chooser: SymbolsChooser, count: int, most: int = 50) -> list[float]:
        return [self.episode(chooser, most)[0] for _ in range(count)]


def outcome_of(
    option: int, reward: float, discount: float, terminated: bool, truncated: bool, environment: int = 0
) -> Outcome:
    return Outcome.cast(
        [environment], [option], [0], [False], [False], [reward], [1], [discount], [0], [terminated], [truncated]
    )


def chooser_of(options: int, seed: int = 0, history: int = 0, keep: float = 1.0) -> SymbolsChooser:
    return SymbolsChooser(1, options, np.random.default_rng(seed), history, keep=keep)


def frozen(chooser: SymbolsChooser, seed: int = 0) -> SymbolsChooser:
    """Another one with its state, as from an artefact."""
    history = chooser.past.shape[1]
    other = chooser_of(chooser.model.options, seed, history)
    other.load(chooser.state())
    return other


def sure(reward: float, place: str) -> list[tuple[float, float, str]]:
    return [(1.0, reward, place)]


def test_with_one_state_it_is_thompson_sampling() -> None:
    """Beta-Bernoulli: how often each arm is drawn after counts (1, 4), (3, 3), (0, 1) and none, in 10,000 draws."""
    wins, losses = np.array([1, 3, 0, 0]), np.array([4, 3, 1, 0])
    model = Model(4, 0, 1.0)
    model.symbols = np.ones((1, 4), np.int64)
    for arm in range(4):
        for result, count in ((1, wins[arm]), (0, losses[arm])):
            for _ in range(count):
                model.count(np.array([0, arm, END, result]), result, 0.9)
    rng, draws = np.random.default_rng(0), 10_000
    chosen = [model.qualities(rng.standard_gamma)[0].argmax() for _ in range(draws)]
    good, bad = symbols.PRIOR * symbols.HOPE, symbols.PRIOR * (1 - symbols.HOPE)
    thompson = rng.beta(wins + good, losses + bad, size=(draws, 4)).argmax(1)
    ours, theirs = (np.bincount(arms, minlength=4) / draws for arms in (chosen, thompson))
    np.testing.assert_allclose(ours, theirs, atol=0.028)  # four standard errors of a difference


def test_values_are_those_of_the_equations() -> None:
    """Two symbols by hand: r = .5 then on to b, where 3 of 4 executions end with 1; the posterior's mean."""
    model = Model(1, 1, 1.0)
    model.symbols = np.array([[1, END], [1, 0]])
    for _ in range(2):
        model.count(np.array([0, 0, 1, 1]), 0.5, 0.9)
    for reward in (1.0, 1.0, 1.0, 0.0):
        model.count(np.array([1, 0, END, reward > 0]), reward, 0.9)
    weight = symbols.PRIOR
    good = weight * symbols.HOPE
    unknown_in_first = 0.9 * (3 + good) / (4 + weight)  # from the second's four executions, three of them rewarded
    unknown_in_second = 0.9 * (2 + good) / (2 + weight)
    second = (3 + weight * unknown_in_second) / (4 + weight)
    first = (2 * (0.5 + 0.9 * second) + weight * unknown_in_first) / (2 + weight)
    np.testing.assert_allclose(model.qualities(np.asarray)[:, 0], [first, second], atol=1e-4)


def test_what_an_option_did_elsewhere_tells_what_it_is_worth_here() -> None:
    """Options 0 to 3 ended with a reward, ended without, went on, or never ran, in the other symbols: U by hand."""
    model = Model(4, 1, 1.0)
    model.symbols = np.array([[1, 1, 1, 1, END], [1, 1, 1, 1, 0]])
    for option, following, reward in ((0, END, 1.0), (1, END, 0.0), (2, 0, 0.0)):
        for _ in range(5):
            model.count(np.array([0, option, following, reward > 0]), reward, 0.9)
    good, bad = symbols.PRIOR * symbols.HOPE, symbols.PRIOR * (1 - symbols.HOPE)
    all_of_it = 5 + symbols.PRIOR
    value = model.qualities(np.asarray)[1]
    expected = [0.9 * (5 + good) / all_of_it, 0.9 * good / all_of_it, 0.0, good / (good + bad)]
    expected[2] = 0.9 * (good + 5 * expected[0]) / all_of_it  # it goes on from here, where option 0 is best
    np.testing.assert_allclose(value, expected, atol=1e-4)


def test_a_cut_is_not_the_end_of_the_task() -> None:
    """An episode is cut before a slow option's end three times of four: what follows stays, so it is worth most."""
    moves: dict[Any, Any] = {
        ("a", 0): [(0.25, 1.0, OVER), (0.75, 0.0, CUT)],
        ("a", 1): [(0.5, 1.0, OVER), (0.5, 0.0, OVER)],
    }
    world, chooser = World({"a": [0, 1]}, moves), chooser_of(2)
    for _ in range(100):  # of each option
        for option in (0, 1):
            _, reward, place = moves["a", option][0 if world.rng.random() < moves["a", option][0][0] else 1]
            following = END if place == OVER else 0
            chooser.model.symbols = np.ones((1, 2), np.int64)
            chooser.model.count(np.array([0, option, following, reward > 0]), reward, 0.99)
    slow, fast = chooser.model.qualities(np.asarray)[0]
    assert slow > 0.9 > fast
    for _ in range(30):
        world.episode(chooser)
    assert world.episode(frozen(chooser))[1] == [0]


def test_what_never_ends_in_time_is_left_for_what_does() -> None:
    """Finite horizons: three decisions a task; the long way has its reward after four, the short one half after two."""
    offered = {"a": [0, 1], "b": [0, 1, 2], "c": [2], "d": [0, 2], "e": [1, 2]}
    moves = {
        ("a", 0): sure(0, "b"),
        ("b", 0): sure(0, "c"),
        ("b", 1): sure(0, "b"),
        ("b", 2): sure(0, "b"),
        ("c", 2): sure(0, "d"),
        ("d", 0): sure(1, OVER),
        ("d", 2): sure(0, OVER),
        ("a", 1): sure(0, "e"),
        ("e", 1): sure(0.5, OVER),
        ("e", 2): sure(0, OVER),
    }
    returns = World(offered, moves).episodes(chooser_of(3), 80, most=3)
    assert np.mean(np.array(returns[-20:]) == 0.5) >= 0.9


def test_an_option_of_no_length_does_not_hold_up_the_others() -> None:
    """A discount of 1: two places lead to each other for nothing, a third option ends the task with 1."""
    offered = {"a": [0, 2], "b": [1, 2]}
    moves = {("a", 0): sure(0, "b"), ("b", 1): sure(0, "a"), ("a", 2): sure(0, OVER), ("b", 2): sure(1, OVER)}
    world, chooser = World(offered, moves, tau=0), chooser_of(3)
    returns = world.episodes(chooser, 60)
    assert np.mean(returns[30:]) >= 0.9
    assert world.episode(frozen(chooser)) == (1.0, [0, 2])


def test_a_task_without_end_does_not_hold_a_draw_for_ever() -> None:
    """One long episode: two options do nothing, one has a reward; a draw that was wrong is replaced meanwhile."""
    moves = {("a", option): sure(float(option == 2), "a") for option in range(3)}
    total, chosen = World({"a": [0, 1, 2]}, moves).episode(chooser_of(3), most=200)
    assert total > 150 and chosen[-50:] == [2] * 50


@pytest.mark.parametrize("seed", range(3))
def test_it_finds_a_reward_that_was_long_in_coming(seed: int) -> None:
    """Eight places in a row with five options each, of which one leads on and the others end the task with nothing.

    Random choice reaches the end in one episode of 390,625. What an option did elsewhere misleads, and is outvoted.
    """
    places, right = "abcdefgh", [3, 0, 2, 1, 1, 3, 0, 2]
    offered = {place: [0, 1, 2, 3, 4 + number] for number, place in enumerate(places)}
    moves = {(place, option): sure(0, OVER) for place in places for option in offered[place]}
    for place, following, option in zip(places, places[1:], right, strict=False):
        moves[place, option] = sure(0, following)
    moves["h", right[-1]] = sure(1, OVER)
    world, chooser = World(offered, moves), chooser_of(12, seed)
    returns = world.episodes(chooser, 240)
    assert sum(returns[:8]) == 0, "or it was luck"
    assert np.mean(returns[220:]) >= 0.9
    assert world.episode(frozen(chooser)) == (1.0, right)


def test_thousands_of_symbols_take_bounded_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """A chain of 4,000 symbols: at most ``SWEEPS`` sweeps, each one pass over the outcomes; so far ahead it sees."""
    count, bits = 4_000, 12
    model = Model(bits + 2, 0, 1.0)
    binary = (np.arange(count)[:, None] >> np.arange(bits)) & 1
    model.symbols = np.hstack([binary, np.ones((count, 2), np.int64)])
    steps = np.arange(count)
    following = np.append(steps[1:], END)
    onwards = np.stack([steps, np.full(count, bits), following, following == END], axis=1)
    back = np.stack([steps, np.full(count, bits + 1), np.zeros(count, np.int64), np.zeros(count, np.int64)], axis=1)
    model.outcomes = np.concatenate([onwards, back])
    model.sums = np.tile([50.0, 0.0, 50.0 * 0.999], (2 * count, 1))
    model.sums[count - 1, 1] = 50.0
    passes = []
    bincount = np.bincount
    monkeypatch.setattr(np, "bincount", lambda *args: passes.append(len(args[0])) or bincount(*args))
    qualities = model.qualities(np.asarray)
    assert len(passes) <= symbols.SWEEPS + 10 and max(passes) == 2 * count
    near = qualities[-symbols.SWEEPS :, bits:]
    assert (near[:, 0] > near[:, 1]).all(), "it does not go on where the reward is near"


def switched(seed: int, history: int) -> float:
    """What is offered does not tell: option 2 works only right after 0 and then 1, else it ends the task with nothing.

    The mean return of episodes 301 to 400.
    """
    chooser, rng = chooser_of(3, seed, history), np.random.default_rng(seed)
    returns = []
    for _ in range(400):
        done: list[int] = []
        for count in range(12):
            [option] = chooser.choose(np.array([0]), np.array([0]), np.ones((1, 3), np.bool_)).tolist()
            works = done[-2:] == [0, 1] and rng.random() < 0.9
            done.append(option)
            terminated = option == 2
            reward = float(terminated and works)
            chooser.record(outcome_of(option, reward, 0.99, terminated, count == 11 and not terminated))
            if terminated:
                break
        returns.append(reward)
    return float(np.mean(returns[-100:]))


def test_a_hidden_switch_is_lost_without_history() -> None:
    """Where what is offered does not determine what follows, symbols without history lose; two options of it help."""
    blind, looking = ([switched(seed, history) for seed in range(4)] for history in (0, 2))
    assert max(blind) < 0.4 and min(looking) > 0.75


def test_old_counts_fade() -> None:
    """An option that failed 60 times while it was learned, and then works: half of each is left after a half-life."""
    keep = 0.5 ** (1 / symbols.HALF_LIFE)
    model = Model(2, 0, keep)
    model.symbols = np.ones((1, 2), np.int64)
    for reward in (0,) * 60 + (1,) * symbols.HALF_LIFE:
        total = model.count(np.array([0, 0, END, reward]), reward, 0.9)
    failed, worked = model.sums[:, 0]
    assert failed == pytest.approx(0.5 * (1 - keep**60) / (1 - keep))
    assert total == pytest.approx(failed + worked) and worked > failed
    for _ in range(100_000):  # of another place; denormal numbers, and 0, are no weight
        model.sums[:, :] *= 0.5
    assert np.isfinite(model.qualities(np.random.default_rng(0).standard_gamma)).all()


def test_frozen_play_is_greedy_and_counts_nothing() -> None:
    """By the posterior's mean: the arm of 8 in 10 before that of 1 in 2; symbols never met are played at random."""
    chooser = chooser_of(3)
    chooser.model.symbols = np.array([[1, 1, 0]])
    for arm, results in ((0, [1] * 8 + [0] * 2), (1, [1, 0])):
        for result in results:
            chooser.model.count(np.array([0, arm, END, result]), result, 0.9)
    other = frozen(chooser)
    before = {name: values.clone() for name, values in other.state().items()}
    for _ in range(20):
        assert other.choose(np.array([0]), np.array([0]), np.array([[True, True, False]])).tolist() == [0]
        other.record(outcome_of(0, 0.0, 0.9, True, False))
        other.begin_anew()
    unseen = np.array([[False, True, True]])
    assert {other.choose(np.array([0]), np.array([0]), unseen).item() for _ in range(50)} == {1, 2}
    assert all(torch.equal(values, before[name]) for name, values in other.state().items())


def carried_over(how: str) -> SymbolsChooser:
    """A chooser that goes on, elsewhere, from 40 executions of one arm and 4 of another."""
    before, after = chooser_of(2), chooser_of(2, 1)
    before.model.symbols = np.ones((1, 2), np.int64)
    for arm, count in ((0, 40), (1, 4)):
        for number in range(count):
            before.model.count(np.array([0, arm, END, number % 2]), number % 2, 0.9)
    after.carried = how
    after.carry(before.state())
    return after


def test_counts_are_carried_elsewhere() -> None:
    """None, of each pair the weight of one execution, or all; then it goes on learning."""
    weights = {how: carried_over(how).model.sums[:, 0].tolist() for how in ("none", "prior", "all")}
    assert weights == {"none": [], "prior": [0.5] * 4, "all": [20.0, 20.0, 2.0, 2.0]}
    chooser = carried_over("prior")
    moves = {("a", 0): sure(0, OVER), ("a", 1): sure(1, OVER)}
    assert np.mean(World({"a": [0, 1]}, moves).episodes(chooser, 30)[10:]) >= 0.9
    assert chooser.model.sums[:, 0].sum() == pytest.approx(32)


@pytest.mark.parametrize("broken", [{}, {"symbols": torch.zeros((1, 3), dtype=torch.int64)}])
def test_another_artefacts_weights_are_refused(broken: dict[str, Any]) -> None:
    """Of other options, or of another chooser: one line."""
    state = {**chooser_of(2).state(), **broken} if broken else {"network.weight": torch.zeros(1)}
    with pytest.raises(UserError, match="the weights do not fit symbols"):
        chooser_of(2).load(state)


def paths(chooser: SymbolsChooser, rng: np.random.Generator, count: int) -> Iterator[list[int]]:
    """Choices in three environments that end, cut or go on at random."""
    places = np.arange(chooser.due.size)
    for _ in range(count):
        offered = rng.random((places.size, chooser.model.options)) < 0.5
        offered[:, 0] = True
        chosen = chooser.choose(places, places, offered)
        ends = rng.random((2, places.size)) < 0.1
        for place in places[rng.random(places.size) < 0.8]:
            outcome = outcome_of(chosen[place], ends[0, place], 0.9, ends[0, place], ends[1, place], int(place))
            chooser.record(outcome)
        yield chosen.tolist()


def test_it_goes_on_after_a_break_as_if_there_had_been_none() -> None:
    """Spec G1: from a snapshot after any number of decisions, with history and fading."""

    def fresh() -> SymbolsChooser:
        return SymbolsChooser(3, 4, np.random.default_rng(5), 2, keep=0.98)

    whole, broken, rngs = fresh(), fresh(), [np.random.default_rng(1) for _ in range(2)]
    for count in (1, 7, 30):
        ours = [*paths(whole, rngs[0], count)]
        assert ours == [*paths(broken, rngs[1], count)]
        resumed = fresh()
        resumed.restore(broken.snapshot())
        broken = resumed
    for name, values in whole.state().items():
        assert torch.equal(values, broken.state()[name])
