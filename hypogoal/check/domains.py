"""The contract of a domain (see ``hypogoal.domains.base``)."""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from gymnasium.utils.env_checker import check_env

from hypogoal import data
from hypogoal.check.verdict import Verdict, promise, verdicts
from hypogoal.core.config import Config, resolve
from hypogoal.core.errors import UserError
from hypogoal.core.own_code import place_of
from hypogoal.core.progress import Progress
from hypogoal.core.seeding import rng_for
from hypogoal.domains.base import Domain, Engine
from hypogoal.domains.gymnasium.play import PASS_SEEDS
from hypogoal.hypotheses.networks import AUTO
from hypogoal.label_checks import GET_MORE, Unmet, require_classes
from hypogoal.observations import PICTURE, numbers_of
from hypogoal.options.networks import embedding_for

COUNT, STEPS, MAX_STEPS = 3, 60, 25
STEP_KINDS = {"next_ids": "iu", "rewards": "iuf", "terminated": "b", "truncated": "b", "succeeded": "b"}
SEEDED = "All randomness must come from the seed, also from 0: Gymnasium's from self.np_random. Labels keep nothing."


def check_domain(domain: Domain, config: Config | None = None, *, seed: int = 0) -> Iterator[Verdict]:
    """Check whether a domain keeps the promises that the stages rely on.

    The check plays a layout at random, and collects a few states twice with ``config``, an instance of the domain's
    ``config_class`` (None: the defaults). ``seed`` seeds both. A sub-goal that play does not reach is a warning.
    """
    laws = [
        _Played.gymnasium,
        _Played.steps,
        _Played.two_engines,
        _Played.restore,
        _Played.collect,
    ]
    first = 0 if domain.has_env else 1
    return verdicts(laws[first:], _Played(domain, config, seed))


def collected(domain: Domain, config: Config | None, seed: int) -> data.Collected:
    """Return states that a domain collects with ``config``, or with the defaults of its ``config_class`` if None."""
    settings = config or resolve(domain.config_class, stage="collect")
    progress = Progress("check", total=1, quiet=True)
    return domain.collect(settings, seed, progress)


@dataclass
class _Played:
    """A domain, and how it is played."""

    domain: Domain
    config: Config | None
    seed: int

    def gymnasium(self) -> None:
        """Gymnasium's checker, which is not asked about rendering and closing, finds no fault."""
        warnings.filterwarnings("ignore", ".*is different from the unwrapped version")  # wrappers are checked, too
        try:
            check_env(self.domain.make_env(), skip_render_check=True, skip_close_check=True)
        except AssertionError as error:
            if place_of(error):
                raise
            fault = str(error).rstrip(".")
            do = PASS_SEEDS if "seed" in fault else ""
            raise UserError("Gymnasium's checker refuses the environment", fault, do) from None

    def steps(self) -> str:
        """Observations, labels and ends of episodes are as the domain says."""
        domain, engine = self.domain, self.make_engine()
        elapsed = np.zeros(COUNT, int)
        seen = set()
        for shown in self.play(engine):
            images = engine.images(engine.ids)
            labels = engine.labels(engine.ids)
            self.require_observations("images", images, COUNT)
            _require_array("labels", labels, bool, COUNT, len(domain.sub_goals))
            elapsed += 1
            over = shown["terminated"] | shown["truncated"]
            is_late = elapsed >= MAX_STEPS
            promise(over[is_late].all(), "an episode went on after max_steps", "Truncate it there.")
            elapsed[over] = 0
            for image, row in zip(images, labels, strict=True):
                seen.add((image.tobytes(), row.tobytes()))
        looks = {image for image, _ in seen}
        if len(looks) < len(seen):
            text = f"{len(looks)} observations have {len(seen)} different labels: no classifier can tell them apart"
            warnings.warn(text, stacklevel=1)
        if images.dtype == PICTURE:
            try:  # a warning only, since members see pictures of any size
                embedding_for(images.shape[1:], None, AUTO)
            except UserError as error:
                warnings.warn(f"options cannot be learned from these pictures: {error}", stacklevel=1)
        return f"{images.dtype} {images.shape[1:]}"

    def two_engines(self) -> None:
        """Two engines of the same layout seed show the same for the same actions."""
        first, second = self.make_engine(), self.make_engine()
        require_same(self.play(first), self.play(second), SEEDED)

    def restore(self) -> str | None:
        """A restored engine goes on as the engine whose snapshot it got."""
        saved, restored = self.make_engine(), self.make_engine()
        if not saved.resumes:
            warnings.warn("it has no snapshot and restore: training on it cannot be resumed", stacklevel=1)
            return "not looked at"
        for _ in self.play(saved):
            pass
        snapshot = saved.snapshot()
        restored.restore(snapshot)
        require_same(self.play(saved), self.play(restored), "Save all that the next steps need.")
        return None

    def collect(self) -> str:
        """Collected states can be stored, fit the domain, have both classes, and depend on the seed alone."""
        domain = self.domain
        files = []
        with TemporaryDirectory() as folder:
            place = Path(folder, "data.h5")
            for _ in range(2):
                try:
                    states = collected(domain, self.config, self.seed)
                except Unmet as error:
                    warnings.warn(str(error), stacklevel=1)
                    return "not looked at: play did not reach the states"
                data.write_dataset(place, states, domain=domain.name, config={}, seed=self.seed)
                files.append(place.read_bytes())
        fault = f"states differ when collected again with seed {self.seed}"
        promise(files[0] == files[1], fault, SEEDED)
        goals = tuple(states.sub_goals)
        in_order = tuple(name for name in domain.sub_goals if name in goals)
        do = f"Give the domain's, {domain.sub_goals}, in their order."
        promise(goals == in_order, f"sub_goals are {goals}", do)
        for name in ("labelled", "unlabelled", "heldout"):
            observations = getattr(states, name).observations
            count = max(len(observations), 1)
            self.require_observations(name, observations, count)
        labels = states.labelled.labels
        require_classes(labels, goals, "collect", GET_MORE)
        return f"{len(labels)} labelled states, positives of each sub-goal: {labels.sum(0)}"

    def require_observations(self, name: str, observations: Any, count: int) -> None:
        """Refuse anything but ``count`` of the domain's observations."""
        domain = self.domain
        _require_array(name, observations, domain.observation_dtype, count, *domain.observation_shape)
        are_finite = np.isfinite(numbers_of(observations)).all()
        promise(are_finite, f"{name} have numbers that are not finite", "Clip or replace them.")

    def make_engine(self) -> Engine:
        arguments: dict[str, Any] = {}
        if self.domain.starts:
            arguments["start"] = self.domain.starts[0]
            arguments["memory"] = 10_000
            arguments["seed"] = self.seed
        return self.domain.make_engine(0, COUNT, MAX_STEPS, **arguments)

    def play(self, engine: Engine) -> Iterator[dict[str, Any]]:
        """Yield what an engine shows in each step, by name. The actions are random, and the same at every call."""
        rng = rng_for(self.seed, "check")
        for actions in rng.integers(engine.n_actions, size=(STEPS, COUNT)):
            step = engine.step(actions)
            _require_step(step)
            shown = step._asdict()
            ids = shown.pop("next_ids")
            shown["images"] = engine.images(ids)
            shown["labels"] = engine.labels(ids)
            yield shown


def _require_step(step: Any) -> None:
    """Refuse a malformed step of an engine."""
    do = f"Give a Step of arrays of length {COUNT}, of the types in hypogoal.domains.base.Step."
    for name, letters in STEP_KINDS.items():
        value = getattr(step, name, None)
        if name == "succeeded" and value is None:
            continue
        values = np.asarray(value)
        is_right = values.shape == (COUNT,) and values.dtype.kind in letters
        promise(is_right, f"the engine's step gave {name} {value!r}", do)
    are_finite = np.isfinite(step.rewards).all()
    promise(are_finite, f"the engine's step gave {step.rewards}", "Give finite rewards.")


def require_same(first: Iterator[dict[str, Any]], second: Iterator[dict[str, Any]], do: str) -> None:
    """Refuse two engines that do not show the same."""
    for number, (left, right) in enumerate(zip(first, second, strict=True), 1):
        differ = [name for name, values in left.items() if not np.array_equal(values, right[name])]
        promise(not differ, f"{', '.join(differ)} differ in step {number}", do)


def _require_array(name: str, value: Any, dtype: Any, *shape: int) -> None:
    """Refuse anything but an array of this type and shape."""
    actual = f"{getattr(value, 'dtype', type(value))} {getattr(value, 'shape', '')}"
    wanted = f"{np.dtype(dtype)} {shape}"
    promise(actual == wanted, f"{name}: {actual} instead of {wanted}", "Give an array of that type and shape.")
