"""The contracts of views and teachers: what members see, and what they are told of unlabelled states."""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from hypogoal.check.domains import SEEDED
from hypogoal.check.verdict import Verdict, promise, verdicts
from hypogoal.core.arrays import Floats
from hypogoal.core.config import resolve
from hypogoal.core.progress import Progress
from hypogoal.core.seeding import rng_for
from hypogoal.data import Collected
from hypogoal.domains.base import Domain, load_domain
from hypogoal.hypotheses.config import EnsembleConfig
from hypogoal.hypotheses.teacher import taught_by
from hypogoal.hypotheses.views import StateOrigins, View, changed_by, pools_of, view_of

FEW = 8  # states
MEMBERS = 3


def check_view(name: str, domain: Domain | None = None, config: Any = None, seed: int = 0) -> Iterator[Verdict]:
    """Whether a view, by its ``module:Class``, can be learned, stored and used on states of a domain, or of rooms.

    They are collected with ``config``, an instance of the domain's ``config_class`` (None: the defaults).
    """
    laws = [_Shown.shows, _Shown.learns, _Shown.changes, _Shown.draws]
    return verdicts(laws, _Shown(name, domain or load_domain("rooms"), config, seed))


def check_teacher(name: str, domain: Domain | None = None, config: Any = None, seed: int = 0) -> Iterator[Verdict]:
    """Whether a teacher, by its ``module:function``, gives scores that members can learn; as :func:`check_view`."""
    return verdicts([_Shown.teaches], _Shown(name, domain or load_domain("rooms"), config, seed))


@dataclass
class _Shown:
    """A view or a teacher by its name, and where states are collected, whose first sub-goal counts."""

    name: str
    domain: Domain
    config: Any
    seed: int

    @cached_property
    def states(self) -> Collected:
        """Some, with labels and without."""
        config = self.config or resolve(self.domain.config_class, stage="collect")
        return self.domain.collect(config, self.seed, Progress("check", total=1, quiet=True))

    def shows(self) -> str:
        """Of a state alone the same as of it among others, and the same again."""
        view, few = self.view(), self.states.labelled.observations[:FEW]
        seen = view.see(few)
        alone = np.concatenate([view.see(few[number : number + 1]) for number in range(FEW)])
        promise(np.array_equal(seen, alone), "a state alone and among others differ", "Look at each state alone.")
        return f"{view.dtype} {view.shape}"

    def learns(self) -> None:
        """The same from the same seed; a fresh view shows the same with its parameters and buffers."""
        view, loaded = self.view(), self.view(fitted=False)
        loaded.load_state_dict(view.state_dict())
        observations = self.states.labelled.observations
        seen = view.see(observations)
        promise(np.array_equal(seen, self.view().see(observations)), "what it learned differs", SEEDED)
        is_kept = np.array_equal(seen, loaded.see(observations))
        promise(is_kept, "what it learned is not loaded", "Keep it in parameters or buffers.")

    def changes(self) -> str | None:
        """Batches change as the generator draws; without one they are what members see."""
        view, few = self.view(), self.states.labelled.observations[:FEW]
        if not view.changes:
            return "it changes nothing"
        kept = view.to_change(few)
        changed_by(view, kept, rng_for(self.seed, "check"))
        plain = np.array_equal(changed_by(view, kept, None), view.see(few))
        promise(plain, "without a generator a batch is not what members see", "Change nothing without one.")
        return None

    def draws(self) -> str:
        """Pools of positives."""
        labelled = self.states.labelled
        pools, share = pools_of(self.view(), labelled.labels[:, 0], labelled.origins)
        return f"{len(pools)} pools of positives, {share:g} of a batch"

    def teaches(self) -> str:
        """The same scores for the same seed."""
        scores = self.scores()
        promise(np.array_equal(scores, self.scores()), "scores differ when asked again", SEEDED)
        if (scores == scores[0]).all():
            warnings.warn(f"all {MEMBERS} members are told the same", stacklevel=1)
        return f"{scores.dtype} {scores.shape}, {(scores > 0).mean():.0%} positive"

    def scores(self) -> Floats:
        """Those of the teacher, (K, M)."""
        labelled, unlabelled = self.states.labelled, self.states.unlabelled
        scores = taught_by(
            self.name,
            labelled.observations,
            labelled.labels[:, 0],
            unlabelled.observations,
            MEMBERS,
            self.seed,
        )
        return scores.numpy()

    def view(self, *, fitted: bool = True) -> View:
        """A fresh one."""
        labelled, unlabelled = self.states.labelled, self.states.unlabelled
        return view_of(
            labelled.observations,
            unlabelled.observations,
            EnsembleConfig(view=self.name),
            StateOrigins(labelled.origins, unlabelled.origins),
            self.seed,
            fitted=fitted,
        )
