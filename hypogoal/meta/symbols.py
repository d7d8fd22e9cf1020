"""A policy over options that counts: a table of symbols in place of a network, explored by posterior sampling.

The symbols s of a state are which options are offered there and, with ``history`` H, the last H options of the episode.
An execution of option o leads from s to an outcome j = (s', R > 0); s' are the next symbols, or the end of the task.
n_j executions of o in s ended in j, with means r_j of R and g_j of gamma^tau. Then, with m outcomes known,

    p ~ Dirichlet(n_1, ..., n_m, PRIOR),
    Q(s, o) = sum_j p_j (r_j + g_j V(s'_j)) + p_{m+1} U(s, o),  V(s) = max of Q(s, o) over options offered,  V(end) = 0.

Outcome m + 1 is unknown. What it is worth is learned from what o did in other symbols, since an option that opens the
wrong door here will do so there: it was rewarded there in n+ executions, ended the task with nothing in n- and went on
in n0, so

    q ~ Dirichlet(n+ + PRIOR HOPE, n- + PRIOR (1 - HOPE), n0),  U(s, o) = g_o (q+ best + q0 V(s)).

``best`` is the highest r of all, but at least 1; g_o is the mean of gamma^tau over the executions of o, or 1.

Posterior sampling: for each episode of each environment one p and q are drawn, and followed greedily. If every
execution ends the task with 1 or 0, there is one s, and Q(o) ~ Beta(n_1 + PRIOR HOPE, n_0 + PRIOR (1 - HOPE)) if g_o
is 1, so this is Thompson sampling. They are drawn again where s is new, or executions have doubled the n of (s, o).
Value iteration begins at V = 0 and takes at most ``SWEEPS`` sweeps: the value of so many decisions, in bounded time.
An episode that is cut does not tell what follows: its last execution counts as one that led back to s, so V(s) stays.
Options that learn drift: with each execution of an option its counts fade, by half in ``HALF_LIFE`` of them.

Source: Osband, Russo and Van Roy 2013 (posterior sampling); Ouyang et al. 2017 (draws that end when counts doubled).
"""

from collections.abc import Callable, Mapping
from typing import Any, Self

import numpy as np
import torch
from numpy.random import Generator
from torch import Tensor

from hypogoal.core.arrays import Doubles, Ints
from hypogoal.core.artefacts import AGAIN
from hypogoal.core.checkpoints import Resumable
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.domains.base import Engine
from hypogoal.meta.config import GAMMA, SymbolsConfig
from hypogoal.options.choosers import FILE, Chooser, Offered, Outcome
from hypogoal.options.config import OptionConfig

PRIOR = 0.1  # executions that an unknown outcome weighs
HOPE = 0.2  # the share of these that is rewarded
HALF_LIFE = 200  # executions of an option
TINY = 1e-300  # no weight, but no division by 0: draws of small weights, and counts that faded, can be 0
SWEEPS = 100
CLOSE = 1e-4  # the largest change of a value at which sweeps end
END = -1  # in place of symbols, and of options before an episode's first


class Model(Resumable):
    """What O ``options`` led to from S symbols: M outcomes. Of an option's counts each execution leaves ``keep``.

    Attributes:
        symbols: 1 for each option offered, then the last options: int64 (S, O + history).
        outcomes: symbols, option, next symbols or ``END``, whether rewarded: int64 (M, 4).
        sums: executions, their returns and discounts: float64 (M, 3).
    """

    CHANGING = ("symbols", "outcomes", "sums")

    def __init__(self, options: int, history: int, keep: float):
        self.options, self.keep = options, keep
        self.symbols = np.zeros((0, options + history), np.int64)
        self.outcomes = np.zeros((0, 4), np.int64)
        self.sums = np.zeros((0, 3))

    def count(self, outcome: Ints, returned: float, discount: float) -> float:
        """One more execution; returns how many there are now of its option from its symbols."""
        row = place_in(self.outcomes, outcome)
        if row == len(self.sums):
            self.outcomes = np.vstack([self.outcomes, outcome])
            self.sums = np.vstack([self.sums, np.zeros(3)])
        self.sums[self.outcomes[:, 1] == outcome[1]] *= self.keep
        self.sums[row] += 1, returned, discount
        return float(self.executions()[row])

    def pairs(self) -> Ints:
        """Symbols and option of each outcome as one number: int64 (M,)."""
        return self.outcomes[:, 0] * self.options + self.outcomes[:, 1]

    def executions(self) -> Doubles:
        """How many there are, of the option and symbols of each outcome: float64 (M,)."""
        return np.bincount(self.pairs(), self.sums[:, 0])[self.pairs()].astype(np.float64)

    def qualities(self, draw: Callable[[Doubles], Doubles]) -> Doubles:
        """Q float64 (S, O), -inf: not offered. ``draw``: a generator's ``standard_gamma``, or ``asarray`` for means."""
        offered = self.symbols[:, : self.options] > 0
        pair, following = self.pairs(), self.outcomes[:, 2]
        counts, returned, discounts = self.sums.T
        means = returned / (TINY + counts)
        weights = draw(counts)
        rewarded, on = self.elsewhere(weights, draw)
        unknown = draw(np.full(offered.size, PRIOR))
        total = TINY + unknown + np.bincount(pair, weights, offered.size)
        share, unknown = weights / total[pair], unknown / total
        rewards = np.bincount(pair, share * means, offered.size) + unknown * rewarded * means.max(initial=1.0)
        going_on = share * discounts / (TINY + counts) * (following != END)
        values = np.zeros(len(offered))
        for _ in range(SWEEPS):
            later = np.bincount(pair, going_on * values[following], offered.size)
            staying = unknown * on * np.repeat(values, self.options)
            qualities = np.where(offered, (rewards + later + staying).reshape(offered.shape), -np.inf)
            before, values = values, qualities.max(axis=1)
            if np.abs(values - before).max(initial=0.0) < CLOSE:
                break
        return qualities

    def elsewhere(self, weights: Doubles, draw: Callable[[Doubles], Doubles]) -> tuple[Doubles, Doubles]:
        """g_o q+ and g_o q0 of each symbols and option, float64 (S * O,), from the drawn weights (M,) of outcomes."""
        _, option, following, _ = self.outcomes.T
        rewarded = self.outcomes[:, 3] > 0
        executions, _, discounts = (np.bincount(option, column, self.options) for column in self.sums.T)
        discount = np.where(executions > 0, discounts / (TINY + executions), 1.0)
        ended = following == END
        good = self._from_others(weights * rewarded) + draw(np.full(self.options, PRIOR * HOPE))
        bad = self._from_others(weights * (ended & ~rewarded)) + draw(np.full(self.options, PRIOR * (1 - HOPE)))
        on = self._from_others(weights * (~ended & ~rewarded))
        scale = discount / (TINY + good + on + bad)
        return (scale * good).ravel(), (scale * on).ravel()

    def _from_others(self, weights: Doubles) -> Doubles:
        """By symbols and option (S, O) the sum over the same option's outcomes in all other symbols."""
        shape = len(self.symbols), self.options
        of_each = np.bincount(self.pairs(), weights, shape[0] * shape[1]).reshape(shape)
        return np.maximum(of_each.sum(axis=0) - of_each, 0.0)  # a difference can be a hair below 0


class SymbolsChooser(Chooser):
    """Chooses among O options in E environments; learns until it is told to :meth:`load` what an artefact has."""

    CHANGING = ("model", "rng", "plans", "tried", "due", "began", "running", "waiting", "past")

    def __init__(
        self, environments: int, options: int, rng: Generator, history: int = 0, carried: str = "all", keep: float = 1.0
    ):
        self.model, self.rng, self.carried, self.frozen = Model(options, history, keep), rng, carried, False
        self.plans = [np.zeros(0, np.int64)] * environments  # the best option for each symbols, by a draw,
        self.tried = [np.zeros(0, np.int64)] * environments  # how often it was taken since,
        self.due = np.ones(environments, np.bool_)  # and whether another draw is due
        self.began = np.zeros(environments, np.int64)  # the symbols in which the last option was chosen,
        self.running = Outcome.zeros(environments)  # what came of it,
        self.waiting = np.zeros(environments, np.bool_)  # and whether the next symbols are still to be seen
        self.past = np.full((environments, history), END)  # the last options

    @classmethod
    def create(cls, engine: Engine, options: int, config: OptionConfig, seed: int, device: str) -> Self:
        settings = config.part(SymbolsConfig)
        keep = 1.0 if config.network == "planned" else 0.5 ** (1 / HALF_LIFE)  # what is planned does not change
        return cls(engine.count, options, rng_for(seed, "symbols"), settings.history, settings.carried, keep)

    def choose(self, environments: Ints, ids: Ints, offered: Offered) -> Ints:
        chosen = np.empty(len(environments), np.int64)
        for row, place in enumerate(environments.tolist()):
            symbols = np.append(offered[row], self.past[place])
            began = place_in(self.model.symbols, symbols)
            if began == len(self.model.symbols):
                if self.frozen:
                    chosen[row] = self.rng.choice(np.flatnonzero(offered[row]))
                    continue
                self.model.symbols = np.vstack([self.model.symbols, symbols])
            if self.waiting[place]:
                self._count(place, began)
            if self.due[place] or began >= len(self.plans[place]):
                self.plans[place] = self.model.qualities(self.rng.standard_gamma).argmax(axis=1)
                self.tried[place] = np.zeros(len(self.model.symbols), np.int64)
                self.due[place] = False
            self.began[place], chosen[row] = began, self.plans[place][began]
        return chosen

    def record(self, outcome: Outcome) -> None:
        """Count executions that ended with their episode; the others wait for their next symbols."""
        self.running.put(outcome.environments, outcome)
        over = outcome.terminated | outcome.truncated
        self.waiting[outcome.environments] = True
        for row, place in enumerate(outcome.environments.tolist()):
            self.past[place] = np.append(self.past[place], outcome.options[row])[1:]
            if over[row]:
                self._count(place, END if outcome.terminated[row] else int(self.began[place]))
                self.begin_anew(place)

    def _count(self, place: int, following: int) -> None:
        """The last option of an environment led to these symbols."""
        self.waiting[place] = False
        if self.frozen:
            return
        began, ran = self.began[place], self.running
        outcome = np.array([began, ran.options[place], following, ran.returns[place] > 0])
        discount = min(ran.discounts[place], GAMMA)  # an option of no length counts as a step, or loops were free
        counted = self.model.count(outcome, ran.returns[place], discount)
        self.tried[place][began] += 1
        self.due[place] |= 2 * self.tried[place][began] >= counted

    def begin_anew(self, places: Any = slice(None)) -> None:
        """An episode begins in some environments, by default in all."""
        self.past[places], self.waiting[places], self.due[places] = END, False, not self.frozen

    def state(self) -> dict[str, Tensor]:
        """The attributes of :class:`Model`, by their names."""
        return {name: torch.from_numpy(values) for name, values in self.model.snapshot().items()}

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Be frozen, greedy by the mean of an artefact's posterior; a ``UserError`` where that is of other symbols."""
        shape = self.model.symbols.shape[1:]
        if {*state} != {*self.model.CHANGING} or state["symbols"].shape[1:] != shape:
            raise UserError(f"the weights do not fit symbols {shape}", FILE, AGAIN)
        self.model.restore({name: values.numpy() for name, values in state.items()})
        self.plans = [self.model.qualities(np.asarray).argmax(axis=1)] * len(self.plans)
        self.frozen = True
        self.begin_anew()

    def carry(self, state: Mapping[str, Tensor]) -> None:
        if self.carried != "none":
            self.load(state)
        if self.carried == "prior":
            self.model.sums /= np.maximum(self.model.executions(), 1.0)[:, None]
        self.frozen = False
        self.begin_anew()


def place_in(table: Ints, row: Ints) -> int:
    """The first place of a row (k,) in a table (n, k); n where it is not there."""
    alike = (table == row).all(axis=1)
    return int(np.append(alike, True).argmax())
