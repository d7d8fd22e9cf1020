"""The small interface behind which a domain lives (Spec B6), and how one is found by name."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from hypogoal.core import own_code
from hypogoal.core.errors import UserError
from hypogoal.dataset import Collected

BUILT_IN = {
    "doorkey": "hypogoal.domains.doorkey:DOMAIN",
    "montezuma": "hypogoal.domains.montezuma:DOMAIN",
}
ENTRY_POINTS = "hypogoal.domains"
IMPORTED = "imported"  # what states are of where 'hypogoal import' was not told
CONFIGS = {  # of the stages that train: their settings, some of which a domain may have other defaults for
    "train-ensemble": "hypogoal.stages.train_ensemble:TrainEnsembleConfig",
    "train-options": "hypogoal.stages.train_options:TrainOptionsConfig",
    "train-meta": "hypogoal.stages.train_meta:TrainMetaConfig",
    "train-baseline": "hypogoal.stages.train_baseline:BaselineConfig",
}


class Step(NamedTuple):
    """One step of all environments of an engine.

    Attributes:
        next_ids: int64 (E,), the states reached, before any automatic reset.
        rewards: float32 (E,).
        terminated: bool (E,), the task is over.
        truncated: bool (E,), the episode was cut at its step limit.
    """

    next_ids: NDArray[np.int64]
    rewards: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


class Engine(Protocol):
    """Many environments of one layout, stepped together; every distinct state has an integer id.

    It may also have ``snapshot`` (all that it is, nested dicts of arrays and JSON values) and ``restore``, which on an
    engine made with the same arguments continues from one; without them what is played on it cannot be resumed.
    """

    n_actions: int
    count: int
    observation_shape: tuple[int, ...]
    max_steps: int
    ids: NDArray[np.int64]
    elapsed: NDArray[np.int64]

    @property
    def n_states(self) -> int:
        """Ids known so far are 0 .. n_states - 1."""

    def reset(self) -> NDArray[np.int64]:
        """Put every environment at the start of an episode; returns the ids."""

    def step(self, actions: NDArray[np.int64]) -> Step:
        """Step every environment; where an episode ends, ``ids`` is a start state again afterwards."""

    def images(self, ids: NDArray[np.int64], out: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
        """Observations uint8 (n, *observation_shape) of known states."""

    def labels(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """True sub-goal predicates, bool (n, G): the oracle that only evaluation and the upper bound may see."""


@runtime_checkable
class Domain(Protocol):
    """What hypogoal needs to know of a domain; :class:`hypogoal.GymnasiumDomain` makes one of an environment.

    ``hypogoal check`` tests it. It may also have

    - ``env_id``: its Gymnasium environment;
    - ``defaults``: settings of stages that suit it, see ``defaults_of``;
    - ``collected_bytes``: config -> bytes of observations that ``collect`` will make, at the most;
    - ``played_bytes``: steps -> bytes of pictures that an engine keeps while it plays them, at the most;
    - ``resumes``: true where ``collect`` also takes ``kept``, a function from a name to the ``Checkpoints`` in which
      the part of that name is kept until all are there;
    - ``kinds``: names of the values of the origin ``kind``;
    - ``starts``: names of places where episodes begin, one of which ``make_engine`` takes as ``start``;
    - ``distance``: positions (n, 3) of an engine that has ``positions`` -> int (n,), to the nearest place where a
      sub-goal holds;
    - ``picture``: room -> uint8 (height, width, 3), ``pixel``: positions -> column and row in that picture (n, 2),
      ``rooms_of``: start -> the rooms to draw.
    """

    name: str
    sub_goals: tuple[str, ...]
    observation_shape: tuple[int, ...]
    config_class: type

    def collect(self, config: Any, seed: int, progress: Any) -> Collected:
        """Labelled, unlabelled and held-out states."""

    def make_engine(self, layout_seed: int, count: int, max_steps: int, **arguments: Any) -> Engine:
        """An engine of ``count`` environments of one layout."""


def load_domain(name: str, *, given: bool = False) -> Domain:
    """A domain by its name, by an installed entry point (group ``hypogoal.domains``) or as ``module:object``.

    ``module:object`` is code that will run, see :mod:`hypogoal.core.own_code`.

    Args:
        name: the domain.
        given: the user gave this name, on the command line or in a program.

    Raises:
        UserError: no such domain, code that the user did not allow, or the object is not a domain.
    """
    try:
        with own_code.given(*([name] if given else [])):
            domain = own_code.load_own(name, "domain", ENTRY_POINTS, BUILT_IN)
    except UserError:
        if name != IMPORTED:
            raise
        do = f"Import them again with --domain, one of {', '.join(BUILT_IN)} or module:object, and train on that file."
        raise UserError("nobody said which domain these imported states are of", name, do) from None
    if not isinstance(domain, Domain):
        raise UserError("the object is not a domain", name, "See hypogoal.domains.base.Domain for what it needs.")
    return domain


def installed_domain(name: str, *, given: bool = False) -> Domain | None:
    """The domain; None where it is not installed here: own data may name one that is not.

    Raises:
        UserError: the name is code that the user did not allow (see :func:`load_domain`).
    """
    with own_code.given(*([name] if given else [])):
        own_code.require_trust(name, "domain")
        try:
            return load_domain(name)
        except UserError:
            return None


def stage_config(stage: str) -> type:
    """The settings of one of the stages in ``CONFIGS``."""
    module, _, name = CONFIGS[stage].partition(":")
    found: type = getattr(importlib.import_module(module), name)
    return found


def defaults_of(domain: str, stage: str, *, given: bool = False) -> Mapping[str, Any]:
    """The settings of a stage that this domain has by default, in place of the general ones; empty where none are.

    Raises:
        UserError: see :func:`installed_domain`.
    """
    defaults: Mapping[str, Mapping[str, Any]] = getattr(installed_domain(domain, given=given), "defaults", {})
    return defaults.get(stage, {})
