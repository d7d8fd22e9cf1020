"""The contract of a domain (Spec B6; see ``hypogoal.domains.base``)."""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

from hypogoal.check.verdict import Verdict, promise, verdicts
from hypogoal.core.config import MODELS, model_of, resolve
from hypogoal.core.progress import Progress
from hypogoal.core.seeding import rng_for
from hypogoal.data import GET_MORE, Collected, Unmet, require_classes, require_names
from hypogoal.domains.base import Domain, Engine, Step

COUNT, STEPS, MAX_STEPS = 3, 60, 25
STATE_NOW = "A label is a function of the state now: count, keep and draw nothing in it."
SEEDED = "All randomness must come from the seed: for a Gymnasium environment from self.np_random."


def check_domain(domain: Domain, config: Any = None, *, layout_seed: int = 0, seed: int = 0) -> Iterator[Verdict]:
    """Whether a domain keeps the promises that the stages rely on.

    Plays a layout at random, and collects a few states twice with ``config``, an instance of its ``config_class``
    (None: the defaults). ``seed`` is for both. A sub-goal that play does not reach is a warning.
    """
    laws = [_Played.settings, _Played.gymnasium] if domain.has_env else [_Played.settings]
    laws += [_Played.steps, _Played.observations, _Played.labels, _Played.two_engines, _Played.restore, _Played.collect]
    return verdicts(laws, _Played(domain, config, layout_seed, seed))


@dataclass
class _Played:
    """A domain, and how it is played."""

    domain: Domain
    config: Any
    layout_seed: int
    seed: int

    def settings(self) -> str:
        """Names of sub-goals become files; its own settings have defaults; each stage takes those it gets."""
        domain = self.domain
        require_names(tuple(domain.sub_goals))
        self.config = self.config or resolve(domain.config_class, stage="collect")
        models = {"collect": domain.config_class} | {stage: model_of(stage) for stage in MODELS}
        for stage, values in domain.defaults.items():
            text = f"defaults are for {stage!r}, which is not a stage"
            promise(stage in models, text, f"The stages are {', '.join(models)}.")
            resolve(models[stage], values, {}, stage=stage)
        return f"defaults for {', '.join(domain.defaults) or 'no stage'}"

    def gymnasium(self) -> str:
        """Gymnasium's own checker, but for rendering, and for closing, which makes the environment again."""
        warnings.filterwarnings("ignore", ".*is different from the unwrapped version")  # wrappers are the point
        env = self.domain.make_env()
        check_env(env, skip_render_check=True, skip_close_check=True)
        return f"{env.observation_space}, {env.action_space}"

    def steps(self) -> str:
        """Arrays of the right type and shape, finite rewards, episodes that end in time."""
        engine, domain, ended = self.make_engine(), self.domain, 0
        types = {"next_ids": np.int64, "rewards": np.float32, "images": domain.observation_dtype}
        shapes = {"images": domain.observation_shape, "labels": (len(domain.sub_goals),)}
        for actions in self.actions(engine):
            elapsed = engine.elapsed + 1
            step = engine.step(actions)
            for name, values in _shown(engine, step).items():
                _require_array(name, values, types.get(name, np.bool_), COUNT, *shapes.get(name, ()))
            finite = bool(np.isfinite(step.rewards).all())
            promise(finite, f"rewards are {step.rewards}", "Give finite numbers.")
            over = step.terminated | step.truncated
            cut = bool(over[elapsed >= MAX_STEPS].all())
            promise(cut, "an episode went on after max_steps", "Truncate it there.")
            counted = np.array_equal(engine.elapsed, np.where(over, 0, elapsed))
            promise(counted, f"elapsed is {engine.elapsed}, ended {over}", "Count the steps of each episode.")
            ended += int(over.sum())
        return f"{STEPS} at random in {COUNT} environments, {ended} episodes ended"

    def observations(self) -> str:
        """Written into ``out``, too."""
        engine = self.make_engine()
        images = engine.images(engine.ids)
        out = np.zeros_like(images)
        engine.images(engine.ids, out)
        filled = np.array_equal(images, out)
        promise(filled, "images(ids, out) does not fill out", "Write the images into it.")
        if self.domain.doubt:
            warnings.warn(self.domain.doubt, stacklevel=1)
        return f"{images.dtype} {images.shape[1:]}"

    def labels(self) -> str:
        """The same when computed twice; a warning where observations do not show them."""
        engine, goals = self.make_engine(), np.array(self.domain.sub_goals)
        seen: dict[bytes, set[bytes]] = {}
        for actions in self.actions(engine):
            engine.step(actions)
            labels = engine.labels(engine.ids)
            changed = (engine.labels_now() != labels).any(0)
            text = f"asked twice in the same state, labels differ: {', '.join(goals[changed])}"
            promise(not changed.any(), text, STATE_NOW)
            for image, row in zip(engine.images(engine.ids), labels, strict=True):
                seen.setdefault(image.tobytes(), set()).add(row.tobytes())
        ambiguous = sum(len(rows) > 1 for rows in seen.values())
        if ambiguous:
            text = f"{ambiguous} of {len(seen)} observations have different labels: no classifier can tell them apart"
            warnings.warn(text, stacklevel=1)
        return f"the same when asked twice, in {len(seen)} observations"

    def two_engines(self) -> str:
        first = self.make_engine()
        _require_same(first, self.make_engine(), self.actions(first), SEEDED)
        return f"the same for {STEPS} steps of layout_seed {self.layout_seed}"

    def restore(self) -> str:
        """A restored engine goes on as the one whose snapshot it got."""
        saved, restored = self.make_engine(), self.make_engine()
        if not saved.resumes:
            warnings.warn("it has no snapshot and restore: training on it cannot be resumed", stacklevel=1)
            return "not looked at"
        actions = self.actions(saved)
        for row in actions:
            saved.step(row)
        restored.restore(saved.snapshot())
        _require_same(saved, restored, actions, "After restore() it is another: save all that the next steps need.")
        return f"the same for {STEPS} steps after it"

    def collect(self) -> str:
        """States of the right type and shape, the same for the same seed, of both classes."""
        domain, goals = self.domain, tuple(self.domain.usual_sub_goals)
        try:
            first, again = self.collected(), self.collected()
        except Unmet as error:
            warnings.warn(str(error), stacklevel=1)
            return "not looked at: play did not reach the states"
        same = tuple(first.sub_goals) == goals
        promise(same, f"sub_goals are {first.sub_goals}, not {goals}", "Give the domain's, in their order.")
        for name in ("labelled", "unlabelled", "heldout"):
            states, others = getattr(first, name), getattr(again, name)
            count = len(states.labels)
            promise(count > 0, f"there are no {name} states", "Collect some: other seeds, or more steps.")
            _require_array(name, states.observations, domain.observation_dtype, count, *domain.observation_shape)
            _require_array(f"labels of {name}", states.labels, np.bool_, count, len(goals))
            same = np.array_equal(states.labels, others.labels)
            same &= np.array_equal(states.observations, others.observations)
            promise(same, f"{name} states differ when collected again with seed {self.seed}", SEEDED)
        require_classes(first.labelled.labels, goals, "collect", GET_MORE)
        counts = zip(goals, first.labelled.labels.sum(0), strict=True)
        positives = ", ".join(f"{count} {goal}" for goal, count in counts)
        return f"positives of {len(first.labelled.labels)}: {positives}"

    def collected(self) -> Collected:
        config = self.domain.small(self.config)
        return self.domain.collect(config, self.seed, Progress("check", total=1, quiet=True))

    def make_engine(self) -> Engine:
        starts = self.domain.starts
        arguments = {"start": starts[0], "memory": 10_000, "seed": self.seed} if starts else {}
        return self.domain.make_engine(self.layout_seed, COUNT, MAX_STEPS, **arguments)

    def actions(self, engine: Engine) -> NDArray[np.int64]:
        """Random actions (steps, E), the same at every call."""
        return rng_for(self.seed, "check").integers(engine.n_actions, size=(STEPS, COUNT))


def _shown(engine: Engine, step: Step) -> dict[str, Any]:
    """All that a step shows, by name."""
    parts = {name: values for name, values in step._asdict().items() if values is not None}
    images = engine.images(step.next_ids)
    return {**parts, "images": images, "labels": engine.labels(step.next_ids)}


def _require_same(first: Engine, second: Engine, actions: NDArray[np.int64], do: str) -> None:
    """Two engines show the same."""
    for number, row in enumerate(actions, 1):
        left, right = _shown(first, first.step(row)), _shown(second, second.step(row))
        for name in left.keys() - {"next_ids"}:
            promise(np.array_equal(left[name], right[name]), f"{name} differ in step {number}", do)


def _require_array(name: str, value: Any, dtype: Any, *shape: int) -> None:
    """Refuse anything but a NumPy array of this type and shape."""
    actual = f"{getattr(value, 'dtype', type(value))} {getattr(value, 'shape', '')}"
    wanted = f"{np.dtype(dtype)} {shape}"
    fits = isinstance(value, np.ndarray) and actual == wanted
    promise(fits, f"{name}: {actual} instead of {wanted}", "Give a NumPy array of that type and shape.")
