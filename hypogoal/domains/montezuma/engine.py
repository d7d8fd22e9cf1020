"""The training engine of Montezuma's Revenge: many emulators stepped together, states by id, each frame kept once.

An observation is four frames, and each step adds one, so states share frames. The newest ``memory`` states are kept;
the frames of older ones are forgotten.
"""

import json
from collections.abc import Mapping
from itertools import chain
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.domains.base import TurnEngine
from hypogoal.domains.montezuma import emulator as game
from hypogoal.domains.montezuma.env import MAX_STEPS, START_STATES, Start, beginning_named, labels_of, make_starts
from hypogoal.domains.montezuma.sub_goals import FACT_BYTES, FACTS

MEMORY = 110_000  # states; the replay of Table 2 (1e5 transitions) and those not yet in it
DYING = game.RAM["dying"]
facts_in = itemgetter(*FACT_BYTES)


class MontezumaEngine(TurnEngine):
    """Many games that begin at one ladder or elsewhere, stepped together.

    Ids 0 .. S-1 always are the S start states; every step of every environment gets a new id. Images are available for
    the newest ``memory`` of these; positions, labels and whether the agent is alive for all.

    Arguments as for ``MontezumaLadder``, and ``count``, the number of environments (E). ``start`` may also be several,
    comma-separated, with ``start_states`` each; ``seed`` also draws the one each episode begins with. A frame is 7 kB,
    allocated on first use. An unknown start, too few start states, too small a memory, or no emulator is a
    ``UserError``.
    """

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
        end_at_death: bool = True,
        memory: int = MEMORY,
        seed: int = 0,
    ):
        if memory < count or count < 1:
            do = "Give one environment or more, and memory for each."
            raise UserError("no such engine", f"count={count}, memory={memory}", do)
        self.count, self.max_steps, self.end_at_death = count, max_steps, end_at_death
        self.memory: int = memory
        self.room = memory
        self._emulators = [game.Emulator(seed + number) for number in range(count)]
        emulator, beginnings = game.Emulator(seed), map(beginning_named, start.split(","))
        starts = [make_starts(emulator, beginning, start_states, seed) for beginning in beginnings]
        self.starts: list[Start] = [*chain(*starts)]
        self._rng = rng_for(seed, "start-of-episode")
        self._ring: list[game.Frames] = []  # four states' stacks share a frame in memory
        self._facts = bytearray(b"".join(bytes(begin.facts) for begin in self.starts))
        self._alive = bytearray([True] * len(self.starts))
        self.reset()

    @property
    def n_states(self) -> int:
        return len(self._alive)

    def _begin(self, number: int) -> int:
        begin = int(self._rng.integers(len(self.starts)))
        self._emulators[number].restore(self.starts[begin].snapshot)
        return begin

    def _play(self, number: int, action: int, elapsed: int) -> tuple[int, float, bool, bool]:
        emulator, state = self._emulators[number], self.n_states
        reward = emulator.step(action)
        over, ram = emulator.ale.game_over(), emulator.ram().tobytes()
        alive = not over and ram[DYING] == 0
        self._keep(state, emulator.seen)
        self._facts += bytes(facts_in(ram))
        self._alive.append(alive)
        return state, reward, over or (self.end_at_death and not alive), elapsed >= self.max_steps

    def images(self, ids: NDArray[np.int64], out: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
        """Observations uint8 (n, 84, 84, 4) of states (n,); ``ValueError`` if one is unknown or forgotten."""
        fixed, out = len(self.starts), self.room_for(len(ids), out)
        for image, state in zip(out, self._known(ids, kept=True).tolist(), strict=True):
            seen = self.starts[state].snapshot.seen if state < fixed else self._ring[self._place(state)]
            game.stack_frames(seen, image)
        return out

    def positions(self, ids: NDArray[np.int64]) -> NDArray[np.int64]:
        return self.facts(ids)[:, : len(self.position_names)]

    def facts(self, ids: NDArray[np.int64]) -> NDArray[np.int64]:
        """The bytes that labels follow from, int64 (n, ``FACTS``), also in forgotten states; position first."""
        return np.frombuffer(self._facts, np.uint8).reshape(-1, len(FACTS))[self._known(ids)].astype(np.int64)

    def alive(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether the agent is not dying and the game is not over, bool (n,), also in forgotten states."""
        return np.frombuffer(self._alive, np.bool_)[self._known(ids)]

    def labels(self, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        return labels_of(self.facts(ids), self.alive(ids))

    def snapshot(self) -> dict[str, NDArray[Any]]:
        """All that a resumed run needs. Nearly all of it is the frames in memory, 7 kB per state."""
        saved = [emulator.save() for emulator in self._emulators]
        states = [np.frombuffer(each.state.serialize(), np.uint8) for each in saved]
        frames: dict[int, NDArray[np.uint8]] = {}  # by address, in the order of first use
        stacks = [*self._ring, *(each.seen for each in saved)]
        for seen in stacks:
            frames.update((id(frame), frame) for frame in seen)
        row = {address: number for number, address in enumerate(frames)}
        return {
            **super().snapshot(),
            "rng": np.frombuffer(json.dumps(self._rng.bit_generator.state).encode(), np.uint8),
            "facts": np.frombuffer(self._facts, np.uint8).copy(),
            "alive": np.frombuffer(self._alive, np.uint8).copy(),
            "frames": np.stack(list(frames.values())),
            "stacks": np.array([[row[id(frame)] for frame in seen] for seen in stacks], np.int32),
            "states": np.concatenate(states),
            "state_sizes": np.array([len(state) for state in states]),
            "screens": np.stack([each.screen for each in saved]),
        }

    def restore(self, snapshot: Mapping[str, NDArray[Any]]) -> None:
        """Continue from a ``snapshot`` of an engine made with the same arguments."""
        from ale_py import ALEState

        super().restore(snapshot)
        self._rng.bit_generator.state = json.loads(snapshot["rng"].tobytes())
        self._facts = bytearray(snapshot["facts"].tobytes())
        self._alive = bytearray(snapshot["alive"].tobytes())
        played = len(self._alive) - len(self.starts)
        if (
            len(self._facts) != len(FACTS) * len(self._alive)
            or len(snapshot["stacks"]) != min(played, self.memory) + self.count
        ):
            raise ValueError("its states, facts and stacks differ in number")
        frames = [frame.copy() for frame in snapshot["frames"]]  # copies, which can be freed one by one
        stacks = [tuple(frames[row] for row in rows) for rows in snapshot["stacks"].tolist()]
        self._ring = stacks[: -self.count]
        states = np.split(snapshot["states"], np.cumsum(snapshot["state_sizes"])[:-1])
        now = zip(self._emulators, states, stacks[-self.count :], snapshot["screens"], strict=True)
        for emulator, state, seen, screen in now:
            emulator.restore(game.Snapshot(ALEState(state.tobytes()), seen, screen.copy()))
