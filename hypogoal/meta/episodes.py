"""Episodes of a trained agent: frame by frame for films, and as data for other software."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from hypogoal.core.arrays import Ints
from hypogoal.core.artefacts import Artefact
from hypogoal.core.config import known, resolve
from hypogoal.core.tensors import load_tensors
from hypogoal.domains.base import Layouts
from hypogoal.domains.find import load_domain
from hypogoal.meta.config import TrainMetaConfig
from hypogoal.meta.setup import Setup, assemble
from hypogoal.meta.training import continue_with
from hypogoal.observations import Observations
from hypogoal.options.choosers import FILE
from hypogoal.options.learner import Transitions
from hypogoal.options.loop import OptionLoop

REPLAY = 1_000  # small, because nothing is learned
SOLVED = "solved"  # why the last option of an episode ended


@dataclass(frozen=True)
class Frame:
    """One state of an episode."""

    observation: Observations  # (*obs)
    step: int  # the number of steps of the episode so far
    option: int  # the option that runs in the state, or ended in the state
    predictions: tuple[bool, ...]  # of the K members of its sub-goal; option g*K + k goes by the k-th
    left: int  # the number of steps until the option's timeout
    ended: str  # why the option ended in the state, empty if the option goes on


def agent_of(
    artefact: Artefact,
    seed: int,
    environments: int = 1,
    layouts: Sequence[int] = (),
) -> OptionLoop:
    """Return a loop in which the agent of a meta artefact plays. ``seed`` seeds its draws.

    The options of an options artefact are chosen at random. With ``layouts``, each environment plays one of the layouts
    in place of those of training, without the artefact's ``cap``.

    Raises ``UserError`` if a file of the artefact, or its ensemble, is missing or damaged, or if the domain is not
    installed.
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
    """Play one episode of :func:`agent_of`, with K ``members``.

    Returns a frame for each step, and another frame for the state in which each execution ended.
    """
    frames = []
    for step, moved in enumerate(_steps(loop)):
        left = loop.config.option_timeout - int(loop.age[0])
        [option] = moved.options.tolist()
        running = partial(_frame, loop, members, option)
        frames.append(running(moved.ids, step, left + 1, ""))
        if moved.ended[0]:
            frames.append(running(moved.next_ids, step + 1, left, _why(loop, moved)))
    return frames


def _frame(loop: OptionLoop, members: int, option: int, ids: Ints, step: int, left: int, ended: str) -> Frame:
    first = option - option % members
    predictions = loop.terminations.of(ids)[0, first : first + members]
    [picture] = loop.engine.images(ids)
    return Frame(picture.copy(), step, option, tuple(predictions.tolist()), left, ended)


def _why(loop: OptionLoop, moved: Transitions) -> str:
    """Return why an option ended, in words."""
    if moved.terminated[0]:
        return SOLVED if loop.recorder.episodes.rows[-1].succeeded else "the episode, unsolved"
    if moved.timed_out[0]:
        return "its time is up"
    return "its classifier is positive" if moved.reached[0] else "the episode is cut"


def play_episodes(loop: OptionLoop, count: int) -> Iterator[tuple[Observations, Transitions]]:
    """Play ``count`` episodes of :func:`agent_of`.

    Yields the observations of each episode, (T + 1, *obs), up to the state in which it ended, and its T steps.
    """
    for _ in range(count):
        pictures, steps = [], []
        for moved in _steps(loop):
            pictures.append(loop.engine.images(moved.ids)[0].copy())
            steps.append(moved)
        pictures.append(loop.engine.images(moved.next_ids)[0])
        yield np.stack(pictures), Transitions.joined(steps)


def _steps(loop: OptionLoop) -> Iterator[Transitions]:
    """Play an episode and yield its steps. Actions are greedy, and options are chosen as in training."""
    played = len(loop.recorder.episodes.rows)
    while len(loop.recorder.episodes.rows) == played:
        yield loop.advance(learning=False)
