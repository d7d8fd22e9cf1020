"""A bandit over options: each option has one worth, whatever the state, learned from whole episodes (Spec H4).

An episode is solved that is over with rewards, discounted within options, above 0 in sum, or as its domain says. That
is credited to every option chosen in it, also to those that did nothing for it.
What holds already is not offered, and of the others the one whose turn it is not fails: so an order is learned too.
An option's worth is taken for fixed: failures from before its policy had learned its way count for ever.
"""

from collections.abc import Mapping
from typing import Self

import numpy as np
import torch
from torch import Tensor

from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.core.tensors import AGAIN, check_fit
from hypogoal.domains.base import Engine
from hypogoal.options.choosers import Chooser, Ids, Offered, Outcome
from hypogoal.options.config import OptionConfig


class ThompsonChooser(Chooser):
    """For an episode each option's share of solved episodes is drawn from Beta(1 + solved, 1 + unsolved).

    Of the options offered it takes the one with the highest draw. ``record`` notes what episodes came to, ``learn``
    alone learns from it: a frozen agent does not, as of PPO. ``credit`` float64 (2, O) is how many episodes that were
    solved, and that were not, each option was chosen in. Source: Thompson 1933; Russo et al. 2018, A Tutorial on
    Thompson Sampling, Algorithm 3.2.
    """

    CHANGING = ("rng", "credit", "_due", "_taken", "_earned", "_drawn")

    def __init__(self, options: int, environments: int, rng: np.random.Generator):
        self.rng = rng
        self.credit, self._due = np.zeros((2, options)), np.zeros((2, options))
        self._taken, self._drawn = np.zeros((environments, options)), np.zeros((environments, options))
        self._earned = np.zeros(environments)

    @classmethod
    def create(cls, engine: Engine, options: int, config: OptionConfig, seed: int, device: str) -> Self:
        return cls(options, engine.count, rng_for(seed, "random-choice"))

    def choose(self, environments: Ids, ids: Ids, offered: Offered) -> Ids:
        fresh = environments[~self._taken[environments].any(1)]
        solved, unsolved = 1.0 + self.credit
        self._drawn[fresh] = self.rng.beta(solved, unsolved, (len(fresh), len(solved)))
        chosen = np.where(offered, self._drawn[environments], -1.0).argmax(1)
        self._taken[environments, chosen] = 1.0
        return chosen

    def record(self, outcome: Outcome) -> None:
        self._earned[outcome.environments] += outcome.returns
        over = outcome.terminated | outcome.truncated
        ended = outcome.environments[over]
        by_reward = outcome.terminated[over] & (self._earned[ended] > 0)
        solved = by_reward if outcome.succeeded is None else outcome.succeeded[over]
        self._due += self._taken[ended[solved]].sum(0), self._taken[ended[~solved]].sum(0)
        self._taken[ended], self._earned[ended] = 0.0, 0.0

    def begin_anew(self) -> None:
        self._taken[:], self._earned[:] = 0.0, 0.0

    def learn(self) -> dict[str, float]:
        self.credit += self._due
        self._due[:] = 0.0
        return {}

    def state(self) -> dict[str, Tensor]:
        return {"credit": torch.from_numpy(self.credit.copy())}

    def load(self, state: Mapping[str, Tensor]) -> None:
        """What an artefact's learned; a ``UserError`` where it is not that of such a bandit."""
        check_fit(self.state(), state, "meta.safetensors", AGAIN)
        if (state["credit"] < 0).any():
            raise UserError("a bandit's credit is below 0", "meta.safetensors", AGAIN)
        self.credit = state["credit"].numpy().copy()
