"""A policy over options that counts: a table of symbols in place of a network, explored by posterior sampling.

The symbols s of a state say which options are offered in the state. With ``history`` H, they also say which H options
were the last ones of the episode. An execution of option o leads from s to an outcome j = (s', R > 0). s' are the next
symbols, or the end of the task. n_j executions of o in s had the outcome j, with mean r_j of R and mean g_j of
gamma^tau. If m outcomes are known,

    p ~ Dirichlet(n_1, ..., n_m, PRIOR),
    Q(s, o) = sum_j p_j (r_j + g_j V(s'_j)) + p_{m+1} U(s, o),  V(s) = max of Q(s, o) over options offered,  V(end) = 0.

Outcome m + 1 is unknown. Its value is learned from what o did in other symbols, because an option that opens the wrong
door here will do so there, too. In other symbols, o was rewarded in n+ executions, ended the task with nothing in n-
executions, and did neither in n0 executions, so

    q ~ Dirichlet(n+ + PRIOR HOPE, n- + PRIOR (1 - HOPE), n0),  U(s, o) = g_o (q+ best + q0 V(s)).

``best`` is the highest r of all, but at least 1. g_o is the mean of gamma^tau over the executions of o, or 1 if there
are none.

Posterior sampling works as follows. For each episode of each environment one p and one q are drawn, and followed
greedily. If every execution ends the task with 1 or 0, there is only one s. If g_o is 1, too,
Q(o) ~ Beta(n_1 + PRIOR HOPE, n_0 + PRIOR (1 - HOPE)), so this is Thompson sampling. p and q are drawn again if s is
new, or if executions have doubled the n of (s, o). Value iteration begins at V = 0 and takes at most ``SWEEPS`` sweeps,
so a value covers ``SWEEPS`` decisions at most and takes bounded time.

An episode that is cut does not tell what follows. So its last execution counts as an execution that led back to s, and
V(s) stays as it is. Options that learn drift. So with each execution of an option the counts of that option
fade, by half in ``HALF_LIFE`` executions.

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

PRIOR = 0.1  # the weight of an unknown outcome, in executions
HOPE = 0.2  # the share of the prior's executions that is rewarded
HALF_LIFE = 200  # the number of executions of an option in which its counts fade by half
# Added to divisors, because a draw of a small weight, or a count that has faded, can be 0. The number is too small to
# change any other quotient.
TINY = 1e-300
SWEEPS = 100
CLOSE = 1e-4  # the largest change of a value at which sweeps end
END = -1  # stands for symbols after the end of the task, and for options before the first option of an episode


class Model(Resumable):
    """Counts of what O ``options`` led to from S symbols, with M outcomes.

    With each execution of an option, the earlier counts of that option are multiplied by ``keep``.

    Attributes:
        symbols: int64 (S, O + history). The first O columns are 1 for each option offered, the others are the last
            options.
        outcomes: int64 (M, 4), the symbols, the option, the next symbols or ``END``, and whether the execution was
            rewarded.
        sums: float64 (M, 3), the number of executions, the sum of their returns and the sum of their discounts.
    """

    CHANGING = ("symbols", "outcomes", "sums")

    def __init__(self, options: int, history: int, keep: float):
        self.options, self.keep = options, keep
        self.symbols = np.zeros((0, options + history), np.int64)
        self.outcomes = np.zeros((0, 4), np.int64)
        self.sums = np.zeros((0, 3))

    def count(self, outcome: Ints, returned: float, discount: float) -> float:
        """Count one more execution. Return how many executions of its option from its symbols there are now."""
        row = place_in(self.outcomes, outcome)
        if row == len(self.sums):
            self.outcomes = np.vstack([self.outcomes, outcome])
            self.sums = np.vstack([self.sums, np.zeros(3)])
        self.sums[self.outcomes[:, 1] == outcome[1]] *= self.keep
        self.sums[row] += 1, returned, discount
        return float(self.executions()[row])

    def pairs(self) -> Ints:
        """Return the symbols and option of each outcome as one number, int64 (M,)."""
        return self.outcomes[:, 0] * self.options + self.outcomes[:, 1]

    def executions(self) -> Doubles:
        """Return, for each outcome, the number of executions of its option from its symbols, float64 (M,)."""
        return np.bincount(self.pairs(), self.sums[:, 0])[self.pairs()].astype(np.float64)

    def qualities(self, draw: Callable[[Doubles], Doubles]) -> Doubles:
        """Return Q, float64 (S, O), with -inf for options that are not offered.

        ``draw`` is a generator's ``standard_gamma`` for a posterior sample, or ``asarray`` for the mean.
        """
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
        """Return g_o q+ and g_o q0 for each symbols and option, float64 (S * O,).

        ``weights`` (M,) are the drawn weights of the outcomes.
        """
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
        """Return, by symbols and option (S, O), the sum of ``weights`` over an option's outcomes in other symbols."""
        shape = len(self.symbols), self.options
        of_each = np.bincount(self.pairs(), weights, shape[0] * shape[1]).reshape(shape)
        return np.maximum(of_each.sum(axis=0) - of_each, 0.0)  # rounding can leave a difference slightly below 0


class SymbolsChooser(Chooser):
    """A chooser among O options in E environments, which counts what options lead to.

    The chooser learns, until :meth:`load` is called with the state of an artefact.
    """

    CHANGING = ("model", "rng", "plans", "tried", "due", "began", "running", "waiting", "past")

    def __init__(
        self, environments: int, options: int, rng: Generator, history: int = 0, carried: str = "all", keep: float = 1.0
    ):
        self.model, self.rng, self.carried, self.frozen = Model(options, history, keep), rng, carried, False
        # For each environment: the best option for each symbols by the last draw, how often an option was taken in the
        # symbols since that draw, and whether another draw is due.
        self.plans = [np.zeros(0, np.int64)] * environments
        self.tried = [np.zeros(0, np.int64)] * environments
        self.due = np.ones(environments, np.bool_)
        # The symbols in which the last option was chosen, the outcome of that option, and whether its next symbols are
        # still to be seen.
        self.began = np.zeros(environments, np.int64)
        self.running = Outcome.zeros(environments)
        self.waiting = np.zeros(environments, np.bool_)
        self.past = np.full((environments, history), END)  # the last options

    @classmethod
    def create(cls, engine: Engine, options: int, config: OptionConfig, seed: int, device: str) -> Self:
        settings = config.part(SymbolsConfig)
        keep = 1.0 if config.network == "planned" else 0.5 ** (1 / HALF_LIFE)  # planned options do not drift
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
        """Count executions that ended together with their episode.

        The other executions are counted once their next symbols are seen.
        """
        self.running.put(outcome.environments, outcome)
        over = outcome.terminated | outcome.truncated
        self.waiting[outcome.environments] = True
        for row, place in enumerate(outcome.environments.tolist()):
            self.past[place] = np.append(self.past[place], outcome.options[row])[1:]
            if over[row]:
                self._count(place, END if outcome.terminated[row] else int(self.began[place]))
                self.begin_anew(place)

    def _count(self, place: int, following: int) -> None:
        """Count that the last option of an environment led to the symbols ``following``."""
        self.waiting[place] = False
        if self.frozen:
            return
        began, ran = self.began[place], self.running
        outcome = np.array([began, ran.options[place], following, ran.returns[place] > 0])
        discount = min(ran.discounts[place], GAMMA)  # an option counts as one step at least, or loops would be free
        counted = self.model.count(outcome, ran.returns[place], discount)
        self.tried[place][began] += 1
        self.due[place] |= 2 * self.tried[place][began] >= counted

    def begin_anew(self, places: Any = slice(None)) -> None:
        """Begin an episode in some environments, by default in all."""
        self.past[places], self.waiting[places], self.due[places] = END, False, not self.frozen

    def state(self) -> dict[str, Tensor]:
        """Return the attributes of :class:`Model`, by name."""
        return {name: torch.from_numpy(values) for name, values in self.model.snapshot().items()}

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Load an artefact's counts, then be frozen: choose greedily by the mean of the posterior.

        Raises ``UserError`` if the counts are of other symbols.
        """
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
    """Return the index of the first row of ``table`` (n, k) that equals ``row`` (k,), or n if there is none."""
    alike = (table == row).all(axis=1)
    return int(np.append(alike, True).argmax())
