"""The small interface behind which a domain lives (Spec B6), and how one is found by name."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from importlib import metadata
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.dataset import Collected

BUILT_IN = {
    "doorkey": "hypogoal.domains.doorkey:DOMAIN",
    "montezuma": "hypogoal.domains.montezuma:DOMAIN",
}
ENTRY_POINTS = "hypogoal.domains"


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
    """What hypogoal needs to know of a domain.

    It may also have ``starts`` (names of places where episodes begin, one of which ``make_engine`` takes as ``start``),
    ``distance`` (positions (n, 3) of an engine that has ``positions`` -> int (n,), to the nearest place where a
    sub-goal holds), ``picture`` (room -> uint8 (height, width, 3)) and ``pixel`` (positions -> column and row in that
    picture (n, 2)), ``rooms_of`` (start -> the rooms to draw), ``kinds`` (names of the values of the origin ``kind``),
    ``defaults`` (see ``defaults_of``) and ``resumes``: where that is true, ``collect`` also takes ``kept``, a function
    from a name to the ``Checkpoints`` in which the part of that name is kept until all are there.
    """

    name: str
    sub_goals: tuple[str, ...]
    observation_shape: tuple[int, ...]
    config_class: type
    env_id: str

    def collect(self, config: Any, seed: int, progress: Any) -> Collected:
        """Labelled, unlabelled and held-out states."""

    def make_engine(self, layout_seed: int, count: int, max_steps: int, **arguments: Any) -> Engine:
        """An engine of ``count`` environments of one layout."""


def load_domain(name: str) -> Domain:
    """A domain by its name, by an installed entry point (group ``hypogoal.domains``) or as ``module:object``.

    Raises:
        UserError: no such domain, or the object is not one.
    """
    entries = {entry.name: entry.value for entry in metadata.entry_points(group=ENTRY_POINTS)}
    target = BUILT_IN.get(name) or entries.get(name) or name
    if ":" not in target:
        known = ", ".join(sorted({*BUILT_IN, *entries}))
        raise UserError("unknown domain", name, f"Choose one of {known}, or give module:object.")
    module, _, attribute = target.partition(":")
    try:
        domain = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise UserError(f"the domain cannot be loaded ({error})", name, "Check the module and the object.") from None
    if not isinstance(domain, Domain):
        raise UserError("the object is not a domain", name, "See hypogoal.domains.base.Domain for what it needs.")
    return domain


def defaults_of(domain: str, stage: str) -> Mapping[str, Any]:
    """The settings of a stage that this domain has by default, in place of the general ones; empty where none are.

    A domain that cannot be loaded has none: own data may name a domain that is not installed here.
    """
    try:
        found = load_domain(domain)
    except UserError:
        return {}
    defaults: Mapping[str, Mapping[str, Any]] = getattr(found, "defaults", {})
    return defaults.get(stage, {})
