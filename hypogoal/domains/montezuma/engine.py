"""The training engine of Montezuma's Revenge: many emulators stepped together, states by id, each frame kept once.

An observation is four frames, and each step adds one, so states share frames. The newest ``memory`` states are kept;
the frames of older ones are forgotten.
"""

from collections.abc import Mapping
from itertools import chain
from operator import itemgetter
from typing import Any

import numpy as np

from hypogoal.core.arrays import Bools, Bytes, Ints
from hypogoal.core.seeding import rng_for
from hypogoal.domains.base import TurnEngine
from hypogoal.domains.montezuma import emulator as game
from hypogoal.domains.montezuma.env import MAX_STEPS, START_STATES, Start, beginning_named, make_starts
from hypogoal.domains.montezuma.sub_goals import FACT_BYTES, FACTS, SUB_GOALS, labels_of

MEMORY = 110_000  # states; the replay of Table 2 (1e5 transitions) and those not yet in it
DYING = game.RAM["dying"]
KNOWN = len(FACTS) + 1  # bytes kept of every state: its facts, and whether the agent is alive
facts_in = itemgetter(*FACT_BYTES)


class MontezumaEngine(TurnEngine):
    """Many games that begin at one ladder or elsewhere, stepped together.

    Ids 0 .. S-1 always are the S start states; every step of every environment gets a new id. Images are available for
    the newest ``memory`` of these, at least one for each environment; positions and labels for all.

    Arguments as for ``MontezumaLadder``, and ``count``, the number of environments (E). ``seed`` also draws the start
    state each episode begins with. A frame is 7 kB, allocated on first use. An unknown start, too few start states, or
    no emulator is a ``UserError``.
    """

    CHANGING = (*TurnEngine.CHANGING, "_rng")
    n_actions = game.N_ACTIONS
    observation_shape = game.OBSERVATION_SHAPE
    position_names = ("room", "x", "y")

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
        self.count, self.max_steps = count, max_steps
        self.memory: int = memory
        self.room = memory
        self._emulators = [game.Emulator() for _ in range(count)]
        self.starts: list[Start] = make_starts(game.Emulator(), beginning_named(start), start_states, seed)
        self._rng = rng_for(seed, "start-of-episode")
        self._ring: list[game.Frames] = []  # four states' stacks share a frame in memory
        self._known_bytes = bytearray()  # ``KNOWN`` of each state
        for begin in self.starts:
            self._known_bytes += bytes((*begin.facts, True))
        self.reset()

    @property
    def n_states(self) -> int:
        return len(self._known_bytes) // KNOWN

    def _begin(self, number: int) -> int:
        begin = int(self._rng.integers(len(self.starts)))
        start = self.starts[begin]
        self._emulators[number].restore(start.snapshot)
        return begin

    def _play(self, number: int, action: int, elapsed: int) -> tuple[int, float, bool, bool]:
        emulator = self._emulators[number]
        state = self.n_states
        reward = emulator.step(action)
        ram = emulator.ram().tobytes()
        alive = ram[DYING] == 0 and not emulator.ale.game_over()
        self._keep(state, emulator.seen)
        self._known_bytes += bytes((*facts_in(ram), alive))
        return state, reward, not alive, elapsed >= self.max_steps

    def images(self, ids: Ints) -> Bytes:
        """Observations uint8 (n, 84, 84, 4) of states (n,); ``ValueError`` if one is unknown or forgotten."""
        images = self._room_for(len(ids))
        for image, state in zip(images, self._kept(ids), strict=True):
            if state < len(self.starts):
                seen = self.starts[state].snapshot.seen
            else:
                seen = self._ring[self._place(state)]
            game.stack_frames(seen, image)
        return images

    def _facts(self, ids: Ints) -> Ints:
        """``KNOWN`` of states, int64 (n, KNOWN), position first and life last, also of forgotten ones."""
        table = np.frombuffer(self._known_bytes, np.uint8).reshape(-1, KNOWN)
        return table[ids].astype(np.int64)

    def positions(self, ids: Ints) -> Ints:
        return self._facts(ids)[:, : len(self.position_names)]

    def labels(self, ids: Ints) -> Bools:
        rows = self._facts(ids)
        return labels_of(rows[:, :-1], rows[:, -1] == 1, SUB_GOALS.values())

    def snapshot(self) -> dict[str, Any]:
        """All that a resumed run needs. Nearly all of it is the frames in memory, 7 kB per state."""
        saved = [emulator.save() for emulator in self._emulators]
        stacks = [*self._ring, *(each.seen for each in saved)]
        frames = {id(frame): frame for frame in chain.from_iterable(stacks)}  # each once, by its address
        row = {address: number for number, address in enumerate(frames)}
        rows = [row[id(frame)] for frame in chain.from_iterable(stacks)]
        return {
            **super().snapshot(),
            "known": np.frombuffer(self._known_bytes, np.uint8).copy(),
            "frames": np.stack(list(frames.values())),
            "stacks": np.array(rows, np.int32).reshape(-1, game.STACK),
            "states": [np.frombuffer(each.state.serialize(), np.uint8) for each in saved],
            "screens": np.stack([each.screen for each in saved]),
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Continue from a ``snapshot`` of an engine made with the same arguments."""
        from ale_py import ALEState

        super().restore(snapshot)
        self._known_bytes = bytearray(snapshot["known"].tobytes())
        frames = [frame.copy() for frame in snapshot["frames"]]  # copies, which can be freed one by one
        stacks = [itemgetter(*rows)(frames) for rows in snapshot["stacks"].tolist()]
        self._ring = stacks[: -self.count]
        playing = zip(self._emulators, snapshot["states"], stacks[-self.count :], snapshot["screens"], strict=True)
        for emulator, state, seen, screen in playing:
            emulator.restore(game.Snapshot(ALEState(state.tobytes()), seen, screen.copy()))
