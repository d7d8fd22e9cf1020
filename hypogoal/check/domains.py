"""The contract of a domain (Spec B6; see ``hypogoal.domains.base``)."""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from gymnasium.utils.env_checker import check_env

from hypogoal.check.verdict import Verdict, promise, verdicts
from hypogoal.core.config import STAGES, model_of, resolve
from hypogoal.core.progress import Progress
from hypogoal.core.seeding import rng_for
from hypogoal.data import GET_MORE, Unmet, require_classes, require_names, write_dataset
from hypogoal.domains.base import Domain, Engine, check_step

COUNT, STEPS, MAX_STEPS = 3, 60, 25
STATE_NOW = "A label is a function of the state now: count, keep and draw nothing in it."
SEEDED = "All randomness must come from the seed: for a Gymnasium environment from self.np_random."


def check_domain(domain: Domain, config: Any = None, *, layout_seed: int = 0, seed: int = 0) -> Iterator[Verdict]:
    """Whether a domain keeps the promises that the stages rely on.

    Plays a layout at random, and collects a few states twice with ``config``, an instance of its ``config_class``
    (None: the defaults). ``seed`` is for both. A sub-goal that play does not reach is a warning.
    """
    laws: list[Any] = [_Played.settings, _Played.gymnasium] if domain.has_env else [_Played.settings]
    laws += [_Played.observations, _Played.steps, _Played.labels, _Played.two_engines, _Played.restore, _Played.collect]
    return verdicts(laws, _Played(domain, config, layout_seed, seed))


@dataclass
class _Played:
    """A domain, and how it is played."""

    domain: Domain
    config: Any
    layout_seed: int
    seed: int

    def settings(self) -> None:
        """Names of sub-goals can be those of files, and each stage takes the defaults for it."""
        domain = self.domain
        require_names(tuple(domain.sub_goals))
        self.config = self.config or resolve(domain.config_class, stage="collect")
        for stage, values in domain.defaults.items():
            text = f"defaults are for {stage!r}, which is not a stage"
            promise(
                stage in STAGES,
                text,
                f"The stages are {', '.join(STAGES)}.",
            )
            model = domain.config_class if stage == "collect" else model_of(stage)
            resolve(model, values, {}, stage=stage)

    def gymnasium(self) -> None:
        """Gymnasium's checker finds nothing, but for rendering, and closing, which makes the environment again."""
        warnings.filterwarnings("ignore", ".*is different from the unwrapped version")  # wrappers are the point
        check_env(self.domain.make_env(), skip_render_check=True, skip_close_check=True)

    def observations(self) -> str:
        """Of the domain's type and shape, also written into ``out``."""
        engine = self.make_engine()
        images = engine.images(engine.ids)
        self.require_observations("images", images, COUNT)
        out = np.zeros_like(images)
        engine.images(engine.ids, out)
        promise(
            np.array_equal(images, out),
            "images(ids, out) does not fill out",
            "Write the images into it.",
        )
        return f"{images.dtype} {images.shape[1:]}"

    def steps(self) -> None:
        """Well-formed, counted, and episodes end in time."""
        engine, elapsed = self.make_engine(), np.zeros(COUNT, int)
        for shown in self.play(engine):
            elapsed += 1
            over = shown["terminated"] | shown["truncated"]
            promise(
                over[elapsed >= MAX_STEPS].all(),
                "an episode went on after max_steps",
                "Truncate it there.",
            )
            elapsed[over] = 0
            promise(
                np.array_equal(engine.elapsed, elapsed),
                f"elapsed is {engine.elapsed}, not {elapsed}",
                "Count the steps of each episode.",
            )

    def labels(self) -> None:
        """The same when asked twice in the same state."""
        engine, goals = self.make_engine(), np.array(self.domain.sub_goals)
        seen = set()
        for _ in self.play(engine):
            labels = engine.labels(engine.ids)
            _require_array("labels", labels, np.bool_, COUNT, len(goals))
            changed = (engine.labels_now() != labels).any(0)
            promise(
                not changed.any(),
                f"asked twice in the same state, labels differ: {', '.join(goals[changed])}",
                STATE_NOW,
            )
            for image, row in zip(engine.images(engine.ids), labels, strict=True):
                seen.add((image.tobytes(), row.tobytes()))
        images = {image for image, _ in seen}
        if len(images) < len(seen):
            text = f"{len(images)} observations have {len(seen)} different labels: no classifier can tell them apart"
            warnings.warn(text, stacklevel=1)

    def two_engines(self) -> None:
        """Of the same layout seed: the same actions show the same."""
        _require_same(self.play(self.make_engine()), self.play(self.make_engine()), SEEDED)

    def restore(self) -> str | None:
        """A restored engine goes on as the one whose snapshot it got."""
        saved, restored = self.make_engine(), self.make_engine()
        if not saved.resumes:
            warnings.warn("it has no snapshot and restore: training on it cannot be resumed", stacklevel=1)
            return "not looked at"
        for _ in self.play(saved):
            pass
        restored.restore(saved.snapshot())
        _require_same(self.play(saved), self.play(restored), "Save all that the next steps need.")
        return None

    def collect(self) -> str:
        """Can be stored, fits the domain, the same file for the same seed, of both classes."""
        domain, goals = self.domain, tuple(self.domain.usual_sub_goals)
        progress = Progress("check", total=1, quiet=True)
        files = []
        with TemporaryDirectory() as folder:
            place = Path(folder, "data.h5")
            for _ in range(2):
                try:
                    found = domain.collect(self.config, self.seed, progress)
                except Unmet as error:
                    warnings.warn(str(error), stacklevel=1)
                    return "not looked at: play did not reach the states"
                write_dataset(place, found, domain=domain.name, config={}, seed=self.seed)
                files.append(place.read_bytes())
        promise(
            files[0] == files[1],
            f"states differ when collected again with seed {self.seed}",
            SEEDED,
        )
        text = f"sub_goals are {found.sub_goals}, not {goals}"
        promise(
            tuple(found.sub_goals) == goals,
            text,
            "Give the domain's, in their order.",
        )
        for name in ("labelled", "unlabelled", "heldout"):
            observations = getattr(found, name).observations
            promise(
                len(observations),
                f"there are no {name} states",
                "Collect some: other seeds, or more steps.",
            )
            self.require_observations(name, observations, len(observations))
        require_classes(found.labelled.labels, goals, "collect", GET_MORE)
        labels = found.labelled.labels
        return f"{len(labels)} labelled states, positives of each sub-goal: {labels.sum(0)}"

    def require_observations(self, name: str, values: Any, count: int) -> None:
        """Refuse anything but so many observations of the domain's type and shape."""
        _require_array(name, values, self.domain.observation_dtype, count, *self.domain.observation_shape)

    def make_engine(self) -> Engine:
        starts = self.domain.starts
        arguments = {"start": starts[0], "memory": 10_000, "seed": self.seed} if starts else {}
        return self.domain.make_engine(self.layout_seed, COUNT, MAX_STEPS, **arguments)

    def play(self, engine: Engine) -> Iterator[dict[str, Any]]:
        """What an engine shows in each step, by name; the actions are random, the same at every call."""
        for actions in rng_for(self.seed, "check").integers(engine.n_actions, size=(STEPS, COUNT)):
            step = engine.step(actions)
            check_step(engine, step)
            shown = step._asdict()
            ids = shown.pop("next_ids")
            yield {**shown, "images": engine.images(ids), "labels": engine.labels(ids)}


def _require_same(first: Iterator[dict[str, Any]], second: Iterator[dict[str, Any]], do: str) -> None:
    """Two engines show the same."""
    for number, (left, right) in enumerate(zip(first, second, strict=True), 1):
        for name, values in left.items():
            promise(np.array_equal(values, right[name]), f"{name} differ in step {number}", do)


def _require_array(name: str, value: Any, dtype: Any, *shape: int) -> None:
    """Refuse anything but an array of this type and shape."""
    actual = f"{getattr(value, 'dtype', type(value))} {getattr(value, 'shape', '')}"
    wanted = f"{np.dtype(dtype)} {shape}"
    promise(
        actual == wanted,
        f"{name}: {actual} instead of {wanted}",
        "Give a NumPy array of that type and shape.",
    )
