"""The training engine of Montezuma's Revenge, which steps many emulators together, and keeps each frame once.

An observation is four frames, of 7 kB each. Each step adds one frame, so states share frames.
"""

from collections.abc import Mapping
from itertools import chain
from operator import itemgetter
from typing import Any

import numpy as np

from hypogoal.core.arrays import Bools, Ints
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.domains.montezuma import emulator as game
from hypogoal.domains.montezuma.env import MAX_STEPS, START_STATES, make_starts
from hypogoal.domains.montezuma.sub_goals import SUB_GOALS, judge_sub_goals
from hypogoal.domains.turns import TurnEngine

MEMORY = 110_000  # states, for the replay of Table 2 (1e5 transitions) and those that are not yet in the replay


class MontezumaEngine(TurnEngine):
    """Many games that begin at one ladder or elsewhere, stepped together.

    Every step of every environment gives a state with a new id. Images are available for the newest ``memory`` states,
    and ``memory`` must be at least ``count``. Positions and labels are available for all states.

    The arguments are those of ``MontezumaLadder``, and ``count``, the number of environments (E). ``seed`` is the seed
    of the start states, and of the draw of a start state for each episode. Raises ``UserError`` if the memory is too
    small.
    """

    CHANGING = (*TurnEngine.CHANGING, "_rng")
    n_actions = game.N_ACTIONS
    observation_shape = game.OBSERVATION_SHAPE
    position_names = game.Position._fields
    width = len(game.FACTS)
    _image = staticmethod(game.stack_frames)

    def __init__(
        self,
        start: str,
        count: int,
        *,
        max_steps: int = MAX_STEPS,
        start_states: int = START_STATES,
        memory: int = MEMORY,
        seed: int = 0,
    ):
        super().__init__()
        if memory < count:
            raise UserError(f"{count} games need a memory of as many states", f"memory={memory}", "Give a larger one.")
        self.count, self.max_steps = count, max_steps
        self.memory = self.room = memory
        self._emulators = [game.Emulator() for _ in range(count)]
        emulator = self._emulators[0]
        self.starts = make_starts(emulator, start, start_states, seed)
        self._rng = rng_for(seed, "start-of-episode")
        for begin in self.starts:
            emulator.restore(begin)
            self._add(begin.seen, emulator.facts().tobytes())
        self.reset()

    def _begin(self, number: int) -> int:
        begin = int(self._rng.integers(len(self.starts)))
        self._emulators[number].restore(self.starts[begin])
        return begin

    def _play(self, number: int, action: int, elapsed: int) -> tuple[Any, ...]:
        emulator = self._emulators[number]
        reward = emulator.step(action)
        facts = emulator.facts()
        state = self._add(emulator.seen, facts.tobytes())
        terminated = bool(facts[game.DYING])
        truncated = elapsed >= self.max_steps
        return state, reward, terminated, truncated

    def positions(self, ids: Ints) -> Ints:
        facts = self.read_facts(ids)
        return facts[:, : len(self.position_names)].astype(int)

    def labels(self, ids: Ints) -> Bools:
        facts = self.read_facts(ids)
        return judge_sub_goals(facts, SUB_GOALS.values())

    def snapshot(self) -> dict[str, Any]:
        """Return all that a resumed run needs, which is mostly the frames in memory."""
        stacks = [*self._seen.values()]
        stacks += [emulator.seen for emulator in self._emulators]
        frames = {id(frame): frame for frame in chain(*stacks)}  # each frame once
        place = {address: row for row, address in enumerate(frames)}
        rows = [place[id(frame)] for frame in chain(*stacks)]
        states = []
        for emulator in self._emulators:
            state = emulator.ale.cloneState().serialize()
            states.append(np.frombuffer(state, np.uint8))
        return {
            **super().snapshot(),
            "frames": np.stack([*frames.values()]),
            "stacks": np.reshape(rows, (-1, game.STACK)),
            "states": states,
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Continue from a ``snapshot`` of an engine made with the same arguments."""
        from ale_py import ALEState

        super().restore(snapshot)
        frames = [frame.copy() for frame in snapshot["frames"]]  # because copies can be freed one by one
        stacks = [itemgetter(*rows)(frames) for rows in snapshot["stacks"].tolist()]
        self._seen = dict(zip(self.kept, stacks[: -self.count], strict=True))
        playing = stacks[-self.count :]
        for emulator, saved, seen in zip(self._emulators, snapshot["states"], playing, strict=True):
            state = ALEState(saved.tobytes())
            emulator.restore(game.Snapshot(state, seen))
