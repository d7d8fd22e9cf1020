"""The contract of a domain, as tests for its author (Spec B6; see ``hypogoal.domains.base``)."""

import dataclasses
import traceback
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.config import from_values, meant, resolve
from hypogoal.core.own_code import UsersCode
from hypogoal.core.progress import Progress
from hypogoal.core.seeding import rng_for, torch_generator
from hypogoal.data import GET_MORE, Collected, States, Unmet, hard_to_learn, leave_out, require_names
from hypogoal.domains.base import Domain, Engine, Step
from hypogoal.observations import NUMBERS, PICTURE
from hypogoal.settings import CONFIGS
from hypogoal.testing.verdict import Test, Verdict, promise, run

COUNT, STEPS, MAX_STEPS = 3, 60, 25
IGNORED_WARNINGS = ("is different from the unwrapped version",)  # of Gymnasium's checker: wrappers are the point
DETERMINISM = "All randomness must come from the seed: for a Gymnasium environment from self.np_random."


def check_domain(
    domain: Domain,
    config: Any = None,
    *,
    layout_seed: int = 0,
    seed: int = 0,
    progress: Progress | None = None,
) -> Iterator[Verdict]:
    """Whether a domain keeps the promises that the stages rely on.

    Plays a layout at random, and collects a few states twice with ``config``, an instance of its ``config_class``
    (None: the defaults). ``seed`` is for both. A sub-goal that play does not reach is a warning. ``progress`` shows
    how far collecting is.
    """
    progress = progress or Progress("check", total=1, quiet=True)
    yield from run(_Contract(domain, config, layout_seed, seed, progress).tests())


class _Contract:
    def __init__(self, domain: Domain, config: Any, layout_seed: int, seed: int, progress: Progress):
        self.domain, self.config, self.layout_seed, self.seed = domain, config, layout_seed, seed
        self.progress, self.reached_all = progress, True

    def tests(self) -> Iterator[Test]:
        yield "names", self.names
        if self.domain.defaults:
            yield "defaults", self.defaults
        if self.domain.has_env:
            yield "gymnasium", self.gymnasium
        of_engine = (self.engine, self.images, self.steps, self.labels, self.determinism, self.going_on)
        of_states = (self.collection, self.classes, self.heldout, self.network, self.collected_again)
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
        """Each stage must have these settings and accept their values."""
        configs = {"collect": self.domain.config_class, **CONFIGS}
        for stage, values in self.domain.defaults.items():
            do = meant(str(stage), configs) or f"The stages are {', '.join(configs)}."
            promise(stage in configs, f"defaults are for {stage!r}, which is not a stage", do)
            is_table = isinstance(values, Mapping)
            promise(is_table, f"defaults of {stage} are {values!r}", "Give a table: setting to value.")
            from_values(configs[stage], values, stage)
        return ", ".join(f"{stage} {len(values)}" for stage, values in self.domain.defaults.items())

    def gymnasium(self) -> str:
        """Gymnasium's own checker, except for rendering, and for closing, which makes the environment again."""
        from gymnasium.utils.env_checker import check_env

        env = self.domain.make_env()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                check_env(env, skip_render_check=True, skip_close_check=True)
            except Exception as error:
                names = " ".join(frame.name for frame in traceback.extract_tb(error.__traceback__))
                method = next((method for method in ("reset", "step") if method in names), "")
                with UsersCode("the environment", env, method, failed="breaks Gymnasium's contract:"):
                    raise
        for warning in caught:
            if not any(text in str(warning.message) for text in IGNORED_WARNINGS):
                warnings.warn(str(warning.message), stacklevel=2)
        return f"{env.observation_space}, {env.action_space}"

    def make_engine(self) -> Engine:
        starts = self.domain.starts
        arguments = {"start": starts[0], "memory": 10_000, "seed": self.seed} if starts else {}
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
        allowed = dtype in (PICTURE, NUMBERS) or dtype.names is not None
        promise(dtype == self.domain.observation_dtype and allowed, text, "Give uint8 or float32.")
        text = f"observation_shape is {shape}"
        promise(len(shape) == 3 or dtype != PICTURE, text, "Pictures are (height, width, channels).")
        if self.domain.doubt:
            warnings.warn(self.domain.doubt, stacklevel=2)
        _array(engine.reset(), np.int64, (COUNT,), "what reset() returns")
        _array(engine.ids, np.int64, (COUNT,), "ids")
        valid = bool((engine.ids >= 0).all() and (engine.ids < engine.n_states).all())
        promise(valid, f"ids {engine.ids} with n_states {engine.n_states}", "Ids are 0 .. n_states - 1.")
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
        ended = played = 0
        for actions in self.actions(engine):
            played += 1
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
        return f"{played} random steps, {ended} episodes ended"

    def labels(self) -> str:
        """Labels of all states in random play: the same when computed twice, and determined by the observation."""
        engine, do = self.make_engine(), "A label is a function of the state now: count, keep and draw nothing in it."
        goals = len(self.domain.sub_goals)
        rows: dict[bytes, set[bytes]] = {}
        positives = np.zeros(goals, np.int64)
        for actions in self.actions(engine):
            ids = engine.step(actions).next_ids
            labels = engine.labels(ids)
            _array(labels, np.bool_, (COUNT, goals), "what labels() returns")
            changed = (engine.labels_now() != engine.labels(engine.ids)).any(0)
            named = ", ".join(goal for goal, other in zip(self.domain.sub_goals, changed, strict=True) if other)
            promise(not named, f"asked twice in the same state, labels differ: {named}", do)
            positives += labels.sum(0)
            for image, label in zip(engine.images(ids), labels, strict=True):
                rows.setdefault(image.tobytes(), set()).add(label.tobytes())
        ambiguous = sum(len(labels) > 1 for labels in rows.values())
        if ambiguous:
            text = f"{ambiguous} of {len(rows)} observations have different labels: no classifier can tell them apart"
            warnings.warn(text, stacklevel=2)
        counts = ", ".join(f"{goal} {count}" for goal, count in zip(self.domain.sub_goals, positives, strict=True))
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
        actions = self.actions(saved)
        for _ in range(STEPS // 2):
            saved.step(next(actions))
        restored = self.make_engine()
        restored.restore(saved.snapshot())
        for number, row in enumerate(actions, 1):
            where = f"step {number} after restore()"
            _same_step(saved, restored, row, where, "Save all that the next steps depend on.")
        return "a restored engine goes on as the one it was saved from"

    def collect(self) -> Collected:
        self.progress.resume(0)
        try:
            return self.domain.collect(self.domain.small(self.config), self.seed, self.progress)
        except Unmet as error:
            if error.collected is None:
                raise
            self.reached_all = False
            return error.collected

    def collection(self) -> str:
        self.collected = self.collect()
        goals = len(self.domain.usual_sub_goals)
        text = f"the states' sub_goals are {self.collected.sub_goals}"
        same = tuple(self.collected.sub_goals) == tuple(self.domain.usual_sub_goals)
        promise(same, text, "Give those of the domain, in their order.")
        for name, states in _sets(self.collected):
            count = len(states.observations)
            text, do = f"there are no {name} states", "Collect some: other seeds, or more steps."
            promise(count > 0 or not self.reached_all, text, do)
            if not count:
                warnings.warn(f"{text}: 'collect' would stop here. {do}", stacklevel=2)
            kind, shape = self.domain.observation_dtype, self.domain.observation_shape
            _array(states.observations, kind, (count, *shape), f"{name} observations")
            _array(states.labels, np.bool_, (count, goals), f"{name} labels")
            for origin, values in states.origins.items():
                fits = values.shape == (count,) and values.dtype.kind in "iu"
                promise(fits, f"{name} origin {origin} is {values.dtype} {values.shape}", f"Give int ({count},).")
        return ", ".join(f"{len(states.observations)} {name}" for name, states in _sets(self.collected))

    def classes(self) -> str:
        text = []
        for column, goal in enumerate(self.domain.usual_sub_goals):
            labelled, heldout = self.collected.labelled.labels[:, column], self.collected.heldout.labels[:, column]
            both = len(np.unique(labelled)) == 2
            promise(both or not self.reached_all, *_missing(goal, "labelled", labelled))
            if not both:
                warnings.warn(self.never_reached(goal, bool(labelled.any())), stacklevel=2)
            if len(np.unique(heldout)) < 2:
                warnings.warn(". ".join(_missing(goal, "held-out", heldout)), stacklevel=2)
            text.append(f"{goal} {int(labelled.sum())} of {len(labelled)}")
        complete = [len(np.unique(column)) > 1 for column in self.collected.labelled.labels.T]
        goals = [goal for goal, both in zip(self.domain.usual_sub_goals, complete, strict=True) if both]
        for line in hard_to_learn(self.collected.labelled.labels[:, complete], goals):
            warnings.warn(f"{line}. {GET_MORE}", stacklevel=2)
        return f"positives among labelled: {', '.join(text)}"

    def collected_again(self) -> str:
        for (name, states), (_, again) in zip(_sets(self.collected), _sets(self.collect()), strict=True):
            same = np.array_equal(states.observations, again.observations) and np.array_equal(
                states.labels, again.labels
            )
            promise(same, f"{name} states differ when collected again with seed {self.seed}", DETERMINISM)
        return "the same states for the same seed"

    def heldout(self) -> str:
        states, training = self.collected.heldout, (self.collected.labelled, self.collected.unlabelled)
        kept = leave_out(states, *(part.observations for part in training))
        repeated = len(states.labels) - len(kept.labels)
        if not repeated:
            return "held-out states differ from those for learning"
        text = f"{repeated} of {len(states.observations)} held-out states look like one of those for learning: "
        warnings.warn(f"{text}scores on them say less about other contexts", stacklevel=2)
        return "some are known"

    def network(self) -> str:
        from hypogoal.hypotheses.config import EnsembleConfig
        from hypogoal.hypotheses.networks import build_network, network_for

        name = self.domain.defaults.get("train-ensemble", {}).get("network", EnsembleConfig().network)
        dtype = self.domain.observation_dtype
        name = network_for(name, dtype)
        build_network(name, tuple(self.domain.observation_shape), torch_generator(0, "check"), dtype=dtype)
        return f"member network {name!r} takes the observations"

    def never_reached(self, goal: str, always: bool) -> str:
        """The warning about a sub-goal that held in none, or in all (``always``), of the labelled states."""
        text = f"{goal} held in {'every' if always else 'no'} state that play met on the labelled layouts, "
        text += "so 'collect' would stop here: "
        text += f"it is {'hard to leave' if always else 'rare'}, or its function errs"
        return f"{text}. {GET_MORE}"

    def actions(self, engine: Engine) -> Iterator[NDArray[np.int64]]:
        """Random actions (E,), the same at every call."""
        rng = rng_for(self.seed, "check")
        for _ in range(STEPS):
            yield rng.integers(engine.n_actions, size=COUNT)


def _sets(collected: Collected) -> list[tuple[str, States]]:
    return [("labelled", collected.labelled), ("unlabelled", collected.unlabelled), ("held-out", collected.heldout)]


def _missing(goal: str, name: str, labels: NDArray[np.bool_]) -> tuple[str, str]:
    """The fault, and what to do, if labels have one class only."""
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


def _array(value: Any, dtype: Any, shape: tuple[int, ...], name: str) -> None:
    kind = f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
    expected = f"{np.dtype(dtype).name} {shape}"
    fits = isinstance(value, np.ndarray) and value.dtype == dtype and value.shape == shape
    promise(fits, f"{name}: {kind} instead of {expected}", "Give a NumPy array of that type and shape.")
