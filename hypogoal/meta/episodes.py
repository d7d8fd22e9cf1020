"""Episodes of a trained agent: frame by frame for films, and as data for other software (Spec D1, E1)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.artefacts import Artefact
from hypogoal.core.config import known, resolve
from hypogoal.core.tensors import load_tensors
from hypogoal.domains.base import Layouts, load_domain
from hypogoal.meta.config import TrainMetaConfig
from hypogoal.meta.setup import Setup
from hypogoal.meta.training import assemble, continue_with
from hypogoal.observations import Observations
from hypogoal.options.choosers import FILE
from hypogoal.options.loop import OptionLoop, Transitions

REPLAY = 1_000  # nothing is learned: a small one
SOLVED = "solved"  # why the last option of an episode ended


@dataclass(frozen=True)
class Frame:
    """One state of an episode."""

    observation: Observations  # (*obs)
    step: int  # of the episode
    option: int  # that runs in this state, or ended in it
    predictions: tuple[bool, ...]  # of its sub-goal's K members on the state; option g*K + k goes by the k-th
    left: int  # steps until its timeout
    ended: str  # why it ended in this state; empty where it goes on


@dataclass(frozen=True)
class Episode:
    """T steps."""

    observations: Observations  # (T + 1, *obs), the last one that of the state it ended in
    actions: NDArray[np.int64]  # (T,), primitive ones
    options: NDArray[np.int64]  # (T,), which option ran
    rewards: NDArray[np.float32]  # (T,)
    terminated: bool  # the task was over; otherwise the episode was cut


def agent_of(
    artefact: Artefact,
    seed: int,
    environments: int = 1,
    layouts: Sequence[int] = (),
) -> OptionLoop:
    """Environments in which the agent of a meta artefact plays; ``seed`` is of the draws.

    ``layouts``: one of these in each environment, instead of those that it was trained in; without its ``cap``.

    A file of it, or its ensemble, missing or damaged, or a domain that is not installed is a ``UserError``.
    """
    source = Artefact(artefact.input("ensemble"))
    settings = known(TrainMetaConfig, artefact.config)
    settings |= {"environments": environments, "replay": REPLAY, "decisions": 2, "save_visited": 0}
    if artefact.kind != "meta":
        settings["chooser"] = "random"
    if layouts:
        settings |= {"layouts": "", "cap": 0.0}
    config = resolve(TrainMetaConfig, settings, {}, stage="train-meta")
    setup = Setup(
        load_domain(artefact.config["domain"]),
        source.config,
        source.path,
        config,
        seed,
    )
    loop = assemble(setup, layouts=Layouts(layouts) if layouts else None)
    continue_with(loop, artefact)
    if FILE in artefact.manifest.files:
        loop.chooser.load(load_tensors(artefact.path / FILE))
    return loop


def play_episode(loop: OptionLoop, members: int) -> list[Frame]:
    """One episode of :func:`agent_of`, K ``members``: a frame per step, and one for where each execution ended."""
    frames = []

    def see(
        ids: NDArray[np.int64],
        step: int,
        left: int,
        moved: Transitions,
        *,
        ended: bool,
    ) -> None:
        [option] = moved.options.tolist()
        first = option - option % members
        predictions = loop.terminations.of(ids)[0, first : first + members].tolist()
        why = _why(loop, moved, predictions[option - first]) if ended else ""
        frames.append(
            Frame(
                loop.engine.images(ids)[0].copy(),
                step,
                option,
                tuple(predictions),
                left,
                why,
            )
        )

    for step, moved in enumerate(_steps(loop)):
        left = loop.config.option_timeout - int(loop.age[0])
        see(moved.ids, step, left + 1, moved, ended=False)
        if moved.ended[0]:
            see(moved.next_ids, step + 1, left, moved, ended=True)
    return frames


def _why(loop: OptionLoop, moved: Transitions, positive: bool) -> str:
    """Why an option ended."""
    if moved.terminated[0]:
        *_, succeeded = loop.recorder.episodes[-1]
        return SOLVED if succeeded else "the episode, unsolved"
    if moved.timed_out[0]:
        return "its time is up"
    return "its classifier is positive" if positive else "the episode is cut"


def play_episodes(loop: OptionLoop, count: int) -> Iterator[Episode]:
    """So many episodes of :func:`agent_of`, one after the other."""
    for _ in range(count):
        observations, steps = [], []
        for moved in _steps(loop):
            observations.append(loop.engine.images(moved.ids)[0].copy())
            steps.append(moved)
        observations.append(loop.engine.images(moved.next_ids)[0])
        yield Episode(
            np.stack(observations),
            np.array([moved.actions[0] for moved in steps], dtype=np.int64),
            np.array([moved.options[0] for moved in steps], dtype=np.int64),
            np.array([moved.rewards[0] for moved in steps], dtype=np.float32),
            bool(moved.terminated[0]),
        )


def _steps(loop: OptionLoop) -> Iterator[Transitions]:
    """The steps of an episode; options are greedy, and drawn as in training."""
    played = len(loop.recorder.episodes)
    while len(loop.recorder.episodes) == played:
        yield loop.advance(learning=False)
