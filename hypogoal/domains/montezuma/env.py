"""Spec B4, D4: Montezuma's Revenge from the top of a ladder or elsewhere, a Gymnasium environment; its start states.

This is the reference: tests compare the training engine (``engine.py``) with it.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces

from hypogoal.core.arrays import Bytes
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.domains.montezuma import emulator as game
from hypogoal.domains.montezuma.emulator import Position
from hypogoal.domains.montezuma.ladders import LADDERS, REACH, within
from hypogoal.domains.montezuma.sub_goals import CROSSINGS, FACT_BYTES, SUB_GOALS, facts_of, labels_of

MAX_STEPS = 200  # agent steps an episode; an option's own time in Table 2
START_STATES = 32
PHASES = range(2, 258)  # frames that the agent may wait before it starts
TRIES = 4  # phases tried per start state


class Beginning(NamedTuple):
    """Where episodes may begin, and the script by which the agent must get alive from there to ``end``."""

    name: str
    at: Position
    end: Position
    action: int = game.NOOP  # of the script
    steps: int = 1  # agent steps of it


GAME = "game"
FIRST = Position(1, 77, 235)  # where the game begins
# Without 1M, from whose base the conveyor carries the agent off, and 13-21, at whose top the spider waits.
CLIMBED_UP = [ladder for ladder in LADDERS if ladder.name not in ("1M", "13-21")]


def _beginnings() -> Iterator[Beginning]:
    for ladder in LADDERS:
        yield Beginning(ladder.name, ladder.top, ladder.base, game.DOWN, ladder.steps_down)
    for ladder in CLIMBED_UP:
        yield Beginning(f"up-{ladder.name}", ladder.base, ladder.top, game.UP, ladder.steps_up)
    for name, place in CROSSINGS.items():
        yield Beginning(name, place, place)
    yield Beginning(GAME, FIRST, FIRST)


BEGINNINGS = {beginning.name: beginning for beginning in _beginnings()}


def beginning_named(name: str) -> Beginning:
    """A beginning by name; ``UserError`` if unknown."""
    if name not in BEGINNINGS:
        raise UserError("unknown start", name, f"Choose one of {', '.join(BEGINNINGS)}.")
    return BEGINNINGS[name]


@dataclass(frozen=True)
class Start:
    """Where an episode begins."""

    snapshot: game.Snapshot
    facts: tuple[int, ...]  # the bytes that labels follow from, see ``FACTS``


def make_starts(emulator: game.Emulator, beginning: Beginning, count: int, seed: int) -> list[Start]:
    """Spec D4: states at a beginning, such as the top of a ladder, from which its script survives.

    They differ in the phase of what moves, drawn from ``seed``, and look different if ``TRIES`` phases per state offer
    enough different looks. The top of 14-22 has one look only; its states differ out of sight.

    The same seed gives the same states, whatever was played before; the emulator's state is changed. Too few such
    states is a ``UserError``.
    """
    rng = rng_for(seed, "start-states", beginning.name)
    by_look: dict[bytes, Start] = {}
    alike: list[Start] = []
    for phase in rng.permutation(PHASES)[: TRIES * count].tolist():
        start = _start(emulator, beginning, phase)
        if start is None:
            continue
        look = start.snapshot.stack.tobytes()
        if look in by_look:
            alike.append(start)
        else:
            by_look[look] = start
        if len(by_look) == count:
            break
    starts = [*by_look.values(), *alike][:count]
    if len(starts) < max(count, 1):
        fault = f"only {len(starts)} of {count} start states survive the script"
        raise UserError(fault, beginning.name, "Ask for fewer.")
    return starts


def _start(emulator: game.Emulator, beginning: Beginning, phase: int) -> Start | None:
    """The beginning in a phase; None if its script does not survive from there."""
    if beginning.name == GAME:
        snapshot: game.Snapshot | None = emulator.new_game(phase)
    else:
        snapshot = emulator.place(*beginning.at, phase=phase)
    if snapshot is None or emulator.position() != beginning.at:
        return None
    start = Start(snapshot, tuple(emulator.ram()[FACT_BYTES].tolist()))
    return start if arrives(emulator, beginning) else None


def arrives(emulator: game.Emulator, beginning: Beginning) -> bool:
    """Play the script, undrawn, such as DOWN from a ladder's top to its base; whether the agent arrives alive."""
    for _ in range(beginning.steps):
        emulator.frames(beginning.action, game.FRAME_SKIP)
        if not emulator.alive():
            return False
    position = np.array([emulator.position()])
    return bool(within(position, [beginning.end], REACH))


class MontezumaLadder(gymnasium.Env[Bytes, np.int64]):
    """Montezuma's Revenge from the top of a ladder or elsewhere. Gymnasium id ``hypogoal/MontezumaLadder-v0``.

    An observation is the last four agent steps' frames, uint8 (84, 84, 4), grey, oldest first; 18 actions, each
    played for four frames; the reward is the game's; an episode terminates when the agent begins to die. ``info`` has
    ``labels`` (sub-goal: whether it holds), ``position`` (room, x, y in RAM units) and ``alive``.

    Args:
        start: a ladder or another of ``BEGINNINGS``.
        max_steps: agent steps after which an episode is truncated.
        start_states: the number of start states, see ``make_starts``. ``reset(seed)`` draws one of them,
            ``reset(options={"start_state": n})`` takes the n-th.
    """

    def __init__(self, start: str = "1L", max_steps: int = MAX_STEPS, start_states: int = START_STATES):
        self.max_steps = max_steps
        self.observation_space = spaces.Box(0, 255, game.OBSERVATION_SHAPE, np.uint8)
        self.action_space = spaces.Discrete(game.N_ACTIONS)
        self.emulator = game.Emulator()
        self.starts = make_starts(self.emulator, beginning_named(start), start_states, 0)
        self.elapsed = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Bytes, dict[str, Any]]:
        """Begin an episode with one of the start states."""
        super().reset(seed=seed)
        number = (options or {}).get("start_state")
        if number is None:
            number = int(self.np_random.integers(len(self.starts)))
        self.emulator.restore(self.starts[number].snapshot)
        self.elapsed = 0
        return self.emulator.stack, self._info()

    def step(self, action: Any) -> tuple[Bytes, float, bool, bool, dict[str, Any]]:
        """Four frames of an action."""
        reward = self.emulator.step(int(action))
        self.elapsed += 1
        info = self._info()
        truncated = self.elapsed >= self.max_steps
        return self.emulator.stack, reward, not info["alive"], truncated, info

    def _info(self) -> dict[str, Any]:
        alive = self.emulator.alive()
        facts = facts_of(self.emulator.ram()[None])
        [labels] = labels_of(facts, np.array([alive]), SUB_GOALS.values())
        named = dict(zip(SUB_GOALS, labels.tolist(), strict=True))
        return {"labels": named, "position": self.emulator.position(), "alive": alive}
