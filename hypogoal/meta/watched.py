"""A trained agent's episode, frame by frame: which option runs, what its member says, how long it may (Spec D1, E1)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from hypogoal.core.artefacts import Artefact, open_artefact
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.core.tensors import load_tensors
from hypogoal.domains.base import Domain
from hypogoal.meta.config import MetaConfig
from hypogoal.meta.playing import PlayConfig, build
from hypogoal.meta.ppo import MetaPolicy
from hypogoal.options.choosers import RandomChooser
from hypogoal.options.execution import Chooser, Learner, OptionLoop
from hypogoal.options.initiation import Initiation
from hypogoal.options.recording import Recorder

REPLAY = 1_000  # nothing is learned: a small one


@dataclass(frozen=True)
class Frame:
    """One state of an episode.

    Attributes:
        observation: uint8 (H, W, C).
        step: of the episode.
        option: that runs in this state, or ended in it.
        says_yes: its own classifier's verdict on the state.
        left: steps until its timeout.
        ended: why it ended in this state; empty where it goes on.
    """

    observation: NDArray[np.uint8]
    step: int
    option: int
    says_yes: bool
    left: int
    ended: str


@dataclass(frozen=True)
class Agent:
    """A meta artefact's agent: its resolved settings, those of its ensemble, and its weights.

    Attributes:
        config: of the artefact's manifest.
        about: of its ensemble's.
        ensemble: the ensemble's folder.
        options: tensors of ``options.safetensors``.
        meta: tensors of ``meta.safetensors``; None where options are chosen at random.
        initiation: tensors of ``initiation.safetensors``; None where no option is held back.
    """

    config: Mapping[str, Any]
    about: Mapping[str, Any]
    ensemble: Path
    options: dict[str, Tensor]
    meta: dict[str, Tensor] | None
    initiation: dict[str, Tensor] | None = None


@dataclass
class _Onlooker:
    """A learner that is looked at while it acts, and learns nothing."""

    learner: Learner
    loop: OptionLoop | None = None
    frames: list[Frame] = field(default_factory=list)

    def act(
        self, ids: NDArray[np.int64], options: NDArray[np.int64], age: NDArray[np.int64], *, explore: bool = True
    ) -> NDArray[np.int64]:
        """As the learner's own."""
        self._see(ids, int(options[0]), int(age[0]), "")
        return self.learner.act(ids, options, age, explore=explore)

    def observe(
        self,
        ids: NDArray[np.int64],
        actions: NDArray[np.int64],
        next_ids: NDArray[np.int64],
        options: NDArray[np.int64],
        *,
        terminated: NDArray[np.bool_],
        timed_out: NDArray[np.bool_],
        ended: NDArray[np.bool_],
    ) -> None:
        """What the option arrived at, where it ended there."""
        if ended[0]:
            why = "the task is over" if terminated[0] else "its time is up" if timed_out[0] else ""
            self._see(next_ids, int(options[0]), self.frames[-1].left, why, arrived=True)

    def learn(self) -> dict[str, float]:
        """Nothing."""
        return {}

    def snapshot(self) -> dict[str, Any]:
        """As the learner's own."""
        return self.learner.snapshot()

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """As the learner's own."""
        self.learner.restore(snapshot)

    def _see(self, ids: NDArray[np.int64], option: int, age: int, ended: str, *, arrived: bool = False) -> None:
        assert self.loop is not None
        says_yes = bool(self.loop.verdicts.of(ids)[0, option])
        left = age - 1 if arrived else self.loop.config.option_timeout - age
        if arrived and not ended:
            ended = "its classifier says yes" if says_yes else "the episode is cut"
        step = int(self.loop.episode_length[0]) + arrived
        self.frames.append(Frame(self.loop.engine.images(ids)[0].copy(), step, option, says_yes, left, ended))


def read_agent(artefact: Artefact) -> Agent:
    """The agent of a meta artefact.

    Raises:
        UserError: a file of it, or its ensemble, is missing or damaged.
    """
    about = open_artefact(artefact.input("ensemble"), "ensemble")
    there = artefact.manifest["files"]
    options, meta, initiation = (
        load_tensors(artefact.path / name) if name in there else None
        for name in ("options.safetensors", "meta.safetensors", "initiation.safetensors")
    )
    if options is None:
        raise UserError("the agent has no options", artefact.path, "Make the artefact again.")
    return Agent(artefact.config, about.config, about.path, options, meta, initiation)


def loop_of(
    agent: Agent, domain: Domain, seed: int, onlooker: Callable[[Learner], Learner] | None = None
) -> OptionLoop:
    """One environment in which the agent plays.

    Args:
        agent: see :class:`Agent`.
        domain: where it lives.
        seed: of the draws.
        onlooker: what is to stand between the loop and the options' learner.
    """
    config = replace(_settings(PlayConfig, agent.config), environments=1, replay=REPLAY)
    engine, verdicts, learner = build(domain, agent.ensemble, agent.about, config, seed)
    learner.load(agent.options)
    meta = _settings(MetaConfig, agent.config)
    chooser: Chooser = RandomChooser(rng_for(seed, "random-choice"))
    if agent.meta is not None:
        chooser = MetaPolicy(engine, verdicts.options, meta, seed)
        chooser.load(agent.meta)
    initiation = None
    if agent.initiation is not None:
        initiation = Initiation(engine, verdicts.options, config, seed)
        initiation.load(agent.initiation)
    played: Learner = onlooker(learner) if onlooker else learner
    recorder = Recorder(verdicts.options)
    return OptionLoop(engine, verdicts, played, chooser, recorder, config, gamma=meta.gamma, initiation=initiation)


def play_episode(agent: Agent, domain: Domain, seed: int) -> list[Frame]:
    """One episode with greedy options; options are drawn as in training.

    Args:
        agent: see :class:`Agent`.
        domain: where it lives.
        seed: of the draws.

    Returns:
        A frame per step, and one for the state in which each execution ended.
    """
    loop = loop_of(agent, domain, seed, _Onlooker)
    onlooker = loop.learner
    assert isinstance(onlooker, _Onlooker)
    onlooker.loop = loop
    while not loop.recorder.episodes:
        loop.step(explore=False, learn=False)
    return onlooker.frames


def _settings(kind: type[Any], config: Mapping[str, Any]) -> Any:
    """Settings of an artefact as a configuration of this kind; those that it does not have yet are the defaults."""
    return kind(**{one.name: config[one.name] for one in fields(kind) if one.name in config})
