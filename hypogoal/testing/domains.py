"""The contract of a domain, as a test that its author runs (Spec B6; see ``hypogoal.domains.base``)."""

import dataclasses
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.config import from_values, meant, resolve
from hypogoal.core.preflight import human
from hypogoal.core.progress import Progress
from hypogoal.core.seeding import rng_for, torch_generator
from hypogoal.dataset import GET_MORE, NUMBERS, PICTURE, Collected, States, hard_to_learn, leave_out, require_names
from hypogoal.domains.base import Domain, Engine, Step
from hypogoal.settings import CONFIGS
from hypogoal.testing.verdict import Test, Verdict, promise, run

COUNT, STEPS, MAX_STEPS = 3, 60, 25
GYMNASIUM_SAYS_NOT = ("is different from the unwrapped version",)  # of its checker's warnings: wrappers are the point


def check_domain(domain: Domain, config: Any = None, *, layout_seed: int = 0, seed: int = 0) -> Iterator[Verdict]:
    """Whether a domain keeps to what the stages rely on.

    Collects a few states twice, with ``config``, an instance of its ``config_class`` (None: the defaults), and plays a
    layout at random. ``seed`` is for both.
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
        of_engine = (self.engine, self.images, self.steps, self.labels, self.determinism, self.going_on)
        of_states = (self.collection, self.classes, self.collected_again, self.heldout, self.network)
        for test in (*of_engine, *of_states):
            yield test.__name__.replace("_", " "), test

    def names(self) -> str:
        goals = tuple(self.domain.sub_goals)
        require_names(goals)
        do = "Make it a frozen dataclass of hypogoal.core.config.setting fields; it may have none."
        is_config = dataclasses.is_dataclass(self.domain.config_class)
        promise(is_config, f"config_class is {self.domain.config_class!r}", do)
        if self.config is None:
            self.config = resolve(self.domain.config_class, stage="collect")
        return ", ".join(goals)

    def defaults(self) -> str:
        """Of each stage settings that it has, with values that it takes."""
        known = {"collect": self.domain.config_class, **CONFIGS}
        for stage, values in self.domain.defaults.items():
            do = meant(str(stage), known) or f"The stages are {', '.join(known)}."
            promise(stage in known, f"defaults are for {stage!r}, which is not a stage", do)
            kept = isinstance(values, Mapping)
            promise(kept, f"defaults of {stage} are {values!r}", "Give a table: setting to value.")
            from_values(known[stage], values, stage)
        return ", ".join(f"{stage} {len(values)}" for stage, values in self.domain.defaults.items())

    def gymnasium(self) -> str:
        """Gymnasium's own checker."""
        from gymnasium.utils.env_checker import check_env

        env = self.domain.make_env()
        with warnings.catch_warnings(record=True) as given:
            warnings.simplefilter("always")
            check_env(env, skip_render_check=True, skip_close_check=True)  # closing makes it anew
        for warning in given:
            if not any(text in str(warning.message) for text in GYMNASIUM_SAYS_NOT):
                warnings.warn(str(warning.message), stacklevel=2)
        return f"{env.observation_space}, {env.action_space}"

    def make_engine(self) -> Engine:
        starts = self.domain.starts
        arguments = {"start": starts[0], "along": 0.0, "memory": 10_000, "seed": self.seed} if starts else {}
        return self.domain.make_engine(self.layout_seed, COUNT, MAX_STEPS, **arguments)

    def engine(self) -> str:
        engine: Engine = self.make_engine()
        promise(engine.count == COUNT, f"count is {engine.count} of {COUNT} environments", "Make as many as asked for.")
        promise(engine.n_actions >= 1, f"n_actions is {engine.n_actions}", "Say how many actions there are.")
        shape = tuple(engine.observation_shape)
        text = f"observation_shape is {shape} in the engine, {tuple(self.domain.observation_shape)} in the domain"
        promise(shape == tuple(self.domain.observation_shape), text, "Make them agree.")
        dtype = engine.observation_dtype
        text = f"observations are {dtype} in the engine, {self.domain.observation_dtype} in the domain"
        promise(dtype == self.domain.observation_dtype and dtype in (PICTURE, NUMBERS), text, "Give uint8 or float32.")
        given = f"observation_shape is {shape}"
        promise(len(shape) == 3 or dtype == NUMBERS, given, "Pictures are (height, width, channels).")
        if self.domain.doubt:
            warnings.warn(self.domain.doubt, stacklevel=2)
        _array(engine.reset(), np.int64, (COUNT,), "what reset() returns")
        _array(engine.ids, np.int64, (COUNT,), "ids")
        known = bool((engine.ids >= 0).all() and (engine.ids < engine.n_states).all())
        promise(known, f"ids {engine.ids} with n_states {engine.n_states}", "Ids are 0 .. n_states - 1.")
        return f"{engine.n_actions} actions, {COUNT} environments"

    def images(self) -> str:
        engine = self.make_engine()
        shape = (COUNT, *engine.observation_shape)
        images = engine.images(engine.ids)
        _array(images, engine.observation_dtype, shape, "what images() returns")
        out = np.zeros_like(images)
        engine.images(engine.ids, out)
        promise(np.array_equal(out, images), "images(ids, out) does not fill out", "Write the images into it.")
        return f"{engine.observation_dtype} {tuple(engine.observation_shape)}"

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
            if step.succeeded is not None:
                _array(step.succeeded, np.bool_, (COUNT,), "succeeded of a step")
            promise(bool(np.isfinite(step.rewards).all()), f"rewards are {step.rewards}", "Give finite numbers.")
            over = step.terminated | step.truncated
            cut = before + 1 >= MAX_STEPS
            promise(bool((over | ~cut).all()), "an episode went on after max_steps", "Truncate it there.")
            counted = bool((engine.elapsed == np.where(over, 0, before + 1)).all())
            text = f"elapsed is {engine.elapsed} after {before}, ended {over}"
            promise(counted, text, "Count the steps of each episode.")
            same = engine.ids[~over] == step.next_ids[~over]
            promise(bool(same.all()), "ids differ from next_ids", "They differ only where an episode ended.")
            ended += int(over.sum())
        return f"{STEPS} random steps, {ended} episodes ended"

    def labels(self) -> str:
        """Of every state that random play meets, asked twice; and whether what is seen says them."""
        engine, do = self.make_engine(), "A label is a function of the state now: count, keep and draw nothing in it."
        goals = len(self.domain.sub_goals)
        rows: dict[bytes, set[bytes]] = {}
        met = np.zeros(goals, np.int64)
        for actions in self.actions(engine):
            ids = engine.step(actions).next_ids
            labels = engine.labels(ids)
            _array(labels, np.bool_, (COUNT, goals), "what labels() returns")
            changed = (engine.labels_now() != engine.labels(engine.ids)).any(0)
            named = ", ".join(goal for goal, other in zip(self.domain.sub_goals, changed, strict=True) if other)
            promise(not named, f"asked twice in the same state, labels differ: {named}", do)
            met += labels.sum(0)
            for image, label in zip(engine.images(ids), labels, strict=True):
                rows.setdefault(image.tobytes(), set()).add(label.tobytes())
        torn = sum(len(labels) > 1 for labels in rows.values())
        if torn:
            text = f"{torn} of {len(rows)} observations came with different labels: no classifier can tell those apart"
            warnings.warn(text, stacklevel=2)
        counts = ", ".join(f"{goal} {count}" for goal, count in zip(self.domain.sub_goals, met, strict=True))
        return f"held in random play, of {STEPS * COUNT} states: {counts}"

    def determinism(self) -> str:
        first, second = self.make_engine(), self.make_engine()
        for number, actions in enumerate(self.actions(first), 1):
            where = f"two engines of layout_seed {self.layout_seed}, step {number}"
            _same_step(first, second, actions, where, DETERMINISM)
        return f"two engines of one layout seed stay the same for {STEPS} steps"

    def going_on(self) -> str:
        saved = self.make_engine()
        if not saved.resumes:
            text = "the engine has no snapshot and restore (resumes is false): training on it cannot be resumed"
            warnings.warn(text, stacklevel=2)
            return "not looked at"
        actions = list(self.actions(saved))
        for row in actions[: STEPS // 2]:
            saved.step(row)
        restored = self.make_engine()
        restored.restore(saved.snapshot())
        for number, row in enumerate(actions[STEPS // 2 :], 1):
            where = f"step {number} after restore()"
            _same_step(saved, restored, row, where, "Save all that the next steps depend on.")
        return "a restored engine goes on as the one it was saved from"

    def collect(self) -> Collected:
        return self.domain.collect(self.domain.small(self.config), self.seed, Progress("check", total=1, quiet=True))

    def collection(self) -> str:
        self.collected = self.collect()
        goals = len(self.domain.sub_goals)
        text = f"the states' sub_goals are {self.collected.sub_goals}"
        same = tuple(self.collected.sub_goals) == tuple(self.domain.sub_goals)
        promise(same, text, "Give those of the domain, in their order.")
        for name, states in _sets(self.collected):
            count = len(states.observations)
            promise(count > 0, f"there are no {name} states", "Collect some: other seeds, or more steps.")
            kind, shape = self.domain.observation_dtype, self.domain.observation_shape
            _array(states.observations, kind, (count, *shape), f"{name} observations")
            _array(states.labels, np.bool_, (count, goals), f"{name} labels")
            for origin, values in states.origins.items():
                fits = values.shape == (count,) and values.dtype.kind in "iu"
                promise(fits, f"{name} origin {origin} is {values.dtype} {values.shape}", f"Give int ({count},).")
        found = ", ".join(f"{len(states.observations)} {name}" for name, states in _sets(self.collected))
        size = self.domain.collected_bytes(self.config)
        return f"{found}; 'collect' keeps up to {human(size)}, twice that in memory" if size else found

    def classes(self) -> str:
        text = []
        for column, goal in enumerate(self.domain.sub_goals):
            labelled, heldout = self.collected.labelled.labels[:, column], self.collected.heldout.labels[:, column]
            promise(len(np.unique(labelled)) == 2, *_missing(goal, "labelled", labelled))
            if len(np.unique(heldout)) < 2:
                warnings.warn(". ".join(_missing(goal, "held-out", heldout)), stacklevel=2)
            text.append(f"{goal} {int(labelled.sum())} of {len(labelled)}")
        for line in hard_to_learn(self.collected.labelled.labels, self.domain.sub_goals):
            warnings.warn(f"{line}. {GET_MORE}", stacklevel=2)
        return f"positives among labelled: {', '.join(text)}"

    def collected_again(self) -> str:
        for (name, states), (_, again) in zip(_sets(self.collected), _sets(self.collect()), strict=True):
            same = all(np.array_equal(getattr(states, of), getattr(again, of)) for of in ("observations", "labels"))
            promise(same, f"{name} states differ when collected again with seed {self.seed}", DETERMINISM)
        return "the same states for the same seed"

    def heldout(self) -> str:
        states, known = self.collected.heldout, (self.collected.labelled, self.collected.unlabelled)
        double = len(states.labels) - len(leave_out(states, *(of.observations for of in known)).labels)
        if not double:
            return "held-out states differ from those for learning"
        text = f"{double} of {len(states.observations)} held-out states look like one of those for learning: "
        warnings.warn(f"{text}scores on them say less about other contexts", stacklevel=2)
        return "some are known"

    def network(self) -> str:
        from hypogoal.hypotheses.config import EnsembleConfig
        from hypogoal.hypotheses.networks import build_network, network_for

        name = self.domain.defaults.get("train-ensemble", {}).get("network", EnsembleConfig().network)
        name = network_for(name, self.domain.observation_dtype)
        build_network(name, tuple(self.domain.observation_shape), torch_generator(0, "check"))
        return f"member network {name!r} takes the observations"

    def actions(self, engine: Engine) -> Iterator[NDArray[np.int64]]:
        """The same random actions (E,) at every call."""
        rng = rng_for(self.seed, "check")
        for _ in range(STEPS):
            yield rng.integers(engine.n_actions, size=COUNT)


DETERMINISM = "All randomness must come from the seed: for a Gymnasium environment from self.np_random."


def _sets(collected: Collected) -> list[tuple[str, States]]:
    return [("labelled", collected.labelled), ("unlabelled", collected.unlabelled), ("held-out", collected.heldout)]


def _missing(goal: str, name: str, labels: NDArray[np.bool_]) -> tuple[str, str]:
    """What to say, and to do, where labels are of one class."""
    text = f"{goal} has no {'negatives' if labels.any() else 'positives'} among the {name} states"
    return text, GET_MORE


def _same_step(first: Engine, second: Engine, actions: NDArray[np.int64], where: str, do: str) -> None:
    left, right = first.step(actions), second.step(actions)
    for name in ("rewards", "terminated", "truncated", "succeeded"):
        same = np.array_equal(getattr(left, name), getattr(right, name))
        promise(same, f"{name} differ ({where})", do)
    for ids, others in ((left.next_ids, right.next_ids), (first.ids, second.ids)):
        promise(np.array_equal(first.images(ids), second.images(others)), f"images differ ({where})", do)
        promise(np.array_equal(first.labels(ids), second.labels(others)), f"labels differ ({where})", do)


def _array(value: Any, dtype: Any, shape: tuple[int, ...], what: str) -> None:
    given = f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
    wanted = f"{np.dtype(dtype).name} {shape}"
    fits = isinstance(value, np.ndarray) and value.dtype == dtype and value.shape == shape
    promise(fits, f"{what}: {given} instead of {wanted}", "Give a NumPy array of that type and shape.")
