"""The contract of a domain, as a test that its author runs (Spec B6; see ``hypogoal.domains.base``)."""

from __future__ import annotations

import dataclasses
import difflib
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.config import from_values, resolve
from hypogoal.core.progress import Progress
from hypogoal.core.seeding import rng_for, torch_generator
from hypogoal.dataset import Collected, States, require_names
from hypogoal.domains.base import Domain, Engine, Step
from hypogoal.settings import CONFIGS
from hypogoal.testing.verdict import Broken, Test, Verdict, run

COUNT, STEPS, MAX_STEPS = 3, 60, 25
GYMNASIUM_SAYS_NOT = ("is different from the unwrapped version",)  # of its checker's warnings: wrappers are the point


def check_domain(domain: Domain, config: Any = None, *, layout_seed: int = 0, seed: int = 0) -> Iterator[Verdict]:
    """Whether a domain keeps to what the stages rely on.

    Args:
        domain: see :mod:`hypogoal.domains.base`.
        config: an instance of its ``config_class``; the defaults where None. States are collected twice with it.
        layout_seed: the layout that is played.
        seed: of the collection and of the random play.
    """
    return run(_Contract(domain, config, layout_seed, seed).tests())


class _Contract:
    def __init__(self, domain: Domain, config: Any, layout_seed: int, seed: int):
        self.domain, self.config, self.layout_seed, self.seed = domain, config, layout_seed, seed

    def tests(self) -> Iterator[Test]:
        yield "names", self.names
        if self.domain.defaults:
            yield "defaults", self.defaults
        if self.domain.has_env:
            yield "gymnasium", self.gymnasium
        for test in (self.engine, self.images, self.steps, self.labels, self.determinism, self.going_on):
            yield test.__name__.replace("_", " "), test
        for test in (self.collection, self.classes, self.collected_again, self.heldout, self.network):
            yield test.__name__.replace("_", " "), test

    def names(self) -> str:
        goals = tuple(self.domain.sub_goals)
        require_names(goals)
        if not dataclasses.is_dataclass(self.domain.config_class):
            do = "Make it a frozen dataclass of hypogoal.core.config.setting fields; it may have none."
            raise Broken(f"config_class is {self.domain.config_class!r}", do)
        if self.config is None:
            self.config = resolve(self.domain.config_class, stage="collect")
        return ", ".join(goals)

    def defaults(self) -> str:
        """Of each stage settings that it has, with values that it takes."""
        known = {"collect": self.domain.config_class, **CONFIGS}
        for stage, values in self.domain.defaults.items():
            near = difflib.get_close_matches(str(stage), known, n=1)
            do = f"Did you mean {near[0]!r}?" if near else f"The stages are {', '.join(known)}."
            _is(stage in known, f"defaults are of {stage!r}, which is no stage", do)
            _is(isinstance(values, Mapping), f"defaults of {stage} are {values!r}", "Give a table: setting to value.")
            from_values(known[stage], values, stage)
        return ", ".join(f"{stage} {len(values)}" for stage, values in self.domain.defaults.items())

    def gymnasium(self) -> str:
        """Gymnasium's own checker."""
        from gymnasium.utils.env_checker import check_env

        env = self.domain.make_env()
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            check_env(env, skip_render_check=True, skip_close_check=True)  # closing makes it anew
        for one in told:
            if not any(text in str(one.message) for text in GYMNASIUM_SAYS_NOT):
                warnings.warn(str(one.message), stacklevel=2)
        return f"{env.observation_space.shape} {env.observation_space.dtype}, {env.action_space}"

    def make_engine(self) -> Engine:
        return self.domain.make_engine(self.layout_seed, COUNT, MAX_STEPS, **_start_arguments(self.domain, self.seed))

    def engine(self) -> str:
        engine: Engine = self.make_engine()
        _is(engine.count == COUNT, f"count is {engine.count} of {COUNT} environments", "Make as many as asked for.")
        _is(engine.n_actions >= 1, f"n_actions is {engine.n_actions}", "Say how many actions there are.")
        own = tuple(engine.observation_shape)
        text = f"observation_shape is {own} of the engine, {tuple(self.domain.observation_shape)} of the domain"
        _is(own == tuple(self.domain.observation_shape), text, "Make them agree.")
        _is(len(own) == 3, f"observation_shape is {own}", "Networks take images (height, width, channels).")
        _array(engine.reset(), np.int64, (COUNT,), "what reset() returns")
        _array(engine.ids, np.int64, (COUNT,), "ids")
        known = bool((engine.ids >= 0).all() and (engine.ids < engine.n_states).all())
        _is(known, f"ids {engine.ids} with n_states {engine.n_states}", "Ids are 0 .. n_states - 1.")
        return f"{engine.n_actions} actions, {COUNT} environments"

    def images(self) -> str:
        engine = self.make_engine()
        shape = (COUNT, *engine.observation_shape)
        images = engine.images(engine.ids)
        _array(images, np.uint8, shape, "what images() returns")
        out = np.zeros(shape, np.uint8)
        engine.images(engine.ids, out)
        _is(np.array_equal(out, images), "images(ids, out) does not fill out", "Write the images into it.")
        return f"uint8 {tuple(engine.observation_shape)}"

    def steps(self) -> str:
        engine = self.make_engine()
        ended = 0
        for actions in self.actions(engine):
            before = engine.elapsed.copy()
            step: Step = engine.step(actions)
            _array(step.next_ids, np.int64, (COUNT,), "next_ids of a step")
            _array(step.rewards, np.float32, (COUNT,), "rewards of a step")
            for name in ("terminated", "truncated"):
                _array(getattr(step, name), np.bool_, (COUNT,), f"{name} of a step")
            _is(bool(np.isfinite(step.rewards).all()), f"rewards are {step.rewards}", "Give finite numbers.")
            over = step.terminated | step.truncated
            cut = before + 1 >= MAX_STEPS
            _is(bool((over | ~cut).all()), "an episode went on after max_steps", "Truncate it there.")
            text = f"elapsed is {engine.elapsed} after {before}, ended {over}"
            _is(bool((engine.elapsed == np.where(over, 0, before + 1)).all()), text, "Count the steps of each episode.")
            same = engine.ids[~over] == step.next_ids[~over]
            _is(bool(same.all()), "ids differ from next_ids", "They differ only where an episode ended.")
            ended += int(over.sum())
        return f"{STEPS} random steps, {ended} episodes ended"

    def labels(self) -> str:
        """Of every state that random play meets; and whether what is seen says them."""
        engine = self.make_engine()
        goals = len(self.domain.sub_goals)
        rows: dict[bytes, set[bytes]] = {}
        met = np.zeros(goals, np.int64)
        for actions in self.actions(engine):
            ids = engine.step(actions).next_ids
            labels = engine.labels(ids)
            _array(labels, np.bool_, (COUNT, goals), "what labels() returns")
            met += labels.sum(0)
            for image, label in zip(engine.images(ids), labels, strict=True):
                rows.setdefault(image.tobytes(), set()).add(label.tobytes())
        torn = sum(len(labels) > 1 for labels in rows.values())
        if torn:
            warnings.warn(
                f"{torn} of {len(rows)} pictures were met with different labels: no classifier can tell those apart",
                stacklevel=2,
            )
        counts = ", ".join(f"{goal} {count}" for goal, count in zip(self.domain.sub_goals, met, strict=True))
        return f"held in random play, of {STEPS * COUNT} states: {counts}"

    def determinism(self) -> str:
        one, other = self.make_engine(), self.make_engine()
        for number, actions in enumerate(self.actions(one), 1):
            _same_step(
                one, other, actions, f"two engines of layout_seed {self.layout_seed}, step {number}", DETERMINISM
            )
        return f"two engines of one layout seed stay the same for {STEPS} steps"

    def going_on(self) -> str:
        one = self.make_engine()
        if not one.resumes:
            warnings.warn(
                "the engine has no snapshot and restore (resumes is false): training on it cannot be resumed",
                stacklevel=2,
            )
            return "not looked at"
        actions = list(self.actions(one))
        for row in actions[: STEPS // 2]:
            one.step(row)
        other = self.make_engine()
        other.restore(one.snapshot())
        for number, row in enumerate(actions[STEPS // 2 :], 1):
            _same_step(one, other, row, f"step {number} after restore()", "Save all that the next steps depend on.")
        return "a restored engine goes on as the one it was saved from"

    def collect(self) -> Collected:
        config = self.config
        return self.domain.collect(config, self.seed, Progress("check", total=1, quiet=True))

    def collection(self) -> str:
        self.collected = found = self.collect()
        goals = len(self.domain.sub_goals)
        names = tuple(found.sub_goals) == tuple(self.domain.sub_goals)
        _is(names, f"sub_goals are {found.sub_goals} of the states", "Give those of the domain, in their order.")
        for name, states in _sets(found):
            count = len(states.observations)
            _is(count > 0, f"there are no {name} states", "Collect some: other seeds, or more steps.")
            _array(states.observations, np.uint8, (count, *self.domain.observation_shape), f"{name} observations")
            _array(states.labels, np.bool_, (count, goals), f"{name} labels")
            for origin, values in states.origins.items():
                fits = values.shape == (count,) and values.dtype.kind in "iu"
                _is(fits, f"{name} origin {origin} is {values.dtype} {values.shape}", f"Give int ({count},).")
        return ", ".join(f"{len(states.observations)} {name}" for name, states in _sets(found))

    def classes(self) -> str:
        text = []
        for column, goal in enumerate(self.domain.sub_goals):
            for name, states in _sets(self.collected):
                labels = states.labels[:, column]
                if name == "unlabelled":
                    continue
                if not 0 < labels.sum() < len(labels):
                    missing = "positives" if not labels.any() else "negatives"
                    do = "Collect more steps or other layouts, or bring a policy that gets there."
                    if name == "labelled":
                        raise Broken(f"{goal} has no {missing} among the {name} states", do)
                    warnings.warn(f"{goal} has no {missing} among the {name} states. {do}", stacklevel=2)
                if name == "labelled":
                    text.append(f"{goal} {int(labels.sum())} of {len(labels)}")
        return f"positives among labelled: {', '.join(text)}"

    def collected_again(self) -> str:
        for (name, one), (_, other) in zip(_sets(self.collected), _sets(self.collect()), strict=True):
            same = np.array_equal(one.observations, other.observations) and np.array_equal(one.labels, other.labels)
            _is(same, f"{name} states differ when collected again with seed {self.seed}", DETERMINISM)
        return "the same states for the same seed"

    def heldout(self) -> str:
        known = {image.tobytes() for _, states in _sets(self.collected)[:2] for image in states.observations}
        states = self.collected.heldout
        double = sum(image.tobytes() in known for image in states.observations)
        if double:
            warnings.warn(
                f"{double} of {len(states.observations)} held-out states look like one of those for learning: "
                "scores on them say less about other contexts",
                stacklevel=2,
            )
        return "held-out states are others than those for learning" if not double else "some are known"

    def network(self) -> str:
        from hypogoal.hypotheses.config import EnsembleConfig
        from hypogoal.hypotheses.networks import build_network

        name = self.domain.defaults.get("train-ensemble", {}).get("network", EnsembleConfig().network)
        build_network(name, tuple(self.domain.observation_shape), torch_generator(0, "check"))
        return f"member network {name!r} takes the images"

    def actions(self, engine: Engine) -> Iterator[NDArray[np.int64]]:
        """The same random actions (E,) at every call."""
        rng = rng_for(self.seed, "check")
        for _ in range(STEPS):
            yield rng.integers(engine.n_actions, size=COUNT)


DETERMINISM = "What is random must come from the seed alone: for a Gymnasium environment from self.np_random."


def _sets(found: Collected) -> list[tuple[str, States]]:
    return [("labelled", found.labelled), ("unlabelled", found.unlabelled), ("held-out", found.heldout)]


def _start_arguments(domain: Domain, seed: int) -> dict[str, Any]:
    """What the engine of a domain with named starts must be told."""
    return {"start": domain.starts[0], "along": 0.0, "memory": 10_000, "seed": seed} if domain.starts else {}


def _same_step(one: Engine, other: Engine, actions: NDArray[np.int64], where: str, do: str) -> None:
    left, right = one.step(actions), other.step(actions)
    for name in ("rewards", "terminated", "truncated"):
        same = np.array_equal(getattr(left, name), getattr(right, name))
        _is(same, f"{name} differ ({where})", do)
    for ids, others in ((left.next_ids, right.next_ids), (one.ids, other.ids)):
        _is(np.array_equal(one.images(ids), other.images(others)), f"images differ ({where})", do)
        _is(np.array_equal(one.labels(ids), other.labels(others)), f"labels differ ({where})", do)


def _array(value: Any, dtype: Any, shape: tuple[int, ...], what: str) -> None:
    found = f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
    wanted = f"{np.dtype(dtype).name} {shape}"
    fits = isinstance(value, np.ndarray) and value.dtype == dtype and value.shape == shape
    _is(fits, f"{what}: {found} instead of {wanted}", "Give a NumPy array of that type and shape.")


def _is(kept: bool, what: str, do: str) -> None:
    if not kept:
        raise Broken(what, do)
