"""Montezuma's Revenge from the top of a ladder or elsewhere, as a Gymnasium environment, and its start states.

This environment is the reference, with which tests compare the training engine (``engine.py``).
"""

from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces

from hypogoal.core.arrays import Bytes
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.domains.montezuma import emulator as game
from hypogoal.domains.montezuma.emulator import Position
from hypogoal.domains.montezuma.ladders import LADDERS, MEASURED
from hypogoal.domains.montezuma.sub_goals import SUB_GOALS, around, inside, judge_sub_goals

MAX_STEPS = 200  # agent steps of an episode, which are the time limit of an option in Table 2
START_STATES = 32
PHASES = range(2, 258)  # numbers of frames that the agent may wait before it starts
TRIES = 4  # the most phases tried per start state


class Beginning(NamedTuple):
    """A place where episodes may begin, and the script by which the agent must get alive from there to ``end``."""

    at: Position
    end: Position
    action: int = game.NOOP  # the action that the script repeats
    steps: int = 1  # the number of agent steps of the script


NEW_GAME = "game"
BEGINNINGS = {}
for _ladder in LADDERS:
    BEGINNINGS[_ladder.name] = Beginning(_ladder.top, _ladder.base, game.DOWN, _ladder.steps_down)
for _ladder in LADDERS:
    if _ladder.steps_up:
        BEGINNINGS[f"up-{_ladder.name}"] = Beginning(_ladder.base, _ladder.top, game.UP, _ladder.steps_up)
for _name, _numbers in MEASURED["starts"].items():
    _place = Position(*_numbers)
    BEGINNINGS[_name] = Beginning(_place, _place)


def make_starts(emulator: game.Emulator, name: str, count: int, seed: int) -> list[game.Snapshot]:
    """Return ``count`` states at a beginning, such as the top of a ladder, from which the agent survives the script.

    The states differ in the phase of what moves in the room, which is drawn from ``seed``. The states look different if
    ``TRIES`` phases per state offer enough different looks. The top of 14-22 has one look only, so its states differ
    out of sight. The emulator's state changes. Raises ``UserError`` if the name is unknown, or if too few states are
    found.
    """
    if name not in BEGINNINGS:
        raise UserError("unknown start", name, f"Choose one of {', '.join(BEGINNINGS)}.")
    rng = rng_for(seed, "start-states", name)
    phases = rng.permutation(PHASES)
    by_look = {}
    alike = []
    for phase in phases[: TRIES * count].tolist():
        start = _start(emulator, name, phase)
        if start is None:
            continue
        look = game.stack_frames(start.seen).tobytes()
        if look in by_look:
            alike.append(start)
        else:
            by_look[look] = start
        if len(by_look) == count:
            break
    starts = [*by_look.values(), *alike]
    if len(starts) < max(count, 1):
        raise UserError(f"only {len(starts)} of {count} start states survive the script", name, "Ask for fewer.")
    return starts[:count]


def _start(emulator: game.Emulator, name: str, phase: int) -> game.Snapshot | None:
    """Return the state at a beginning in a phase, or None if the agent does not survive the script from there."""
    beginning = BEGINNINGS[name]
    if name == NEW_GAME:
        start: game.Snapshot | None = emulator.new_game(phase)
    else:
        start = emulator.place(*beginning.at, phase=phase)
    if start is None or emulator.position() != beginning.at:
        return None
    return start if arrives(emulator, beginning) else None


def arrives(emulator: game.Emulator, beginning: Beginning) -> bool:
    """Play the script without drawing, such as DOWN from a ladder's top to its base.

    Return whether the agent arrives alive.
    """
    for _ in range(beginning.steps):
        emulator.frames(beginning.action, game.FRAME_SKIP)
        if not emulator.alive():
            return False
    end = around([beginning.end])
    facts = emulator.facts()
    return inside(end, facts[None]).item()


class MontezumaLadder(gymnasium.Env[Bytes, np.int64]):
    """Montezuma's Revenge from the top of a ladder or elsewhere.

    The Gymnasium id is ``hypogoal/MontezumaLadder-v0``. An observation is the grey frames of the last four agent steps,
    uint8 (84, 84, 4), the oldest first. Each of 18 actions is played for four frames. The reward is the game's. An
    episode terminates when the agent begins to die. ``info`` has ``labels`` (whether each sub-goal holds, by name),
    ``position`` (room, x, y in RAM units) and ``alive``.

    Args:
        start: a name among ``BEGINNINGS``, such as a ladder's.
        max_steps: the number of agent steps after which an episode is truncated.
        start_states: the number of start states, see ``make_starts``. ``reset(seed)`` draws a start state, and
            ``reset(options={"start_state": n})`` takes start state n, counted from 0.
    """

    def __init__(self, start: str = "1L", max_steps: int = MAX_STEPS, start_states: int = START_STATES):
        self.max_steps = max_steps
        self.observation_space = spaces.Box(0, 255, game.OBSERVATION_SHAPE, np.uint8)
        self.action_space = spaces.Discrete(game.N_ACTIONS)
        self.emulator = game.Emulator()
        self.starts = make_starts(self.emulator, start, start_states, 0)
        self.elapsed = 0

    def reset(
        self,
        *,
        seed: int | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Bytes, dict[str, Any]]:
        """Begin an episode in a start state."""
        super().reset(seed=seed)
        number = (options or {}).get("start_state")
        if number is None:
            number = int(self.np_random.integers(len(self.starts)))
        self.emulator.restore(self.starts[number])
        self.elapsed = 0
        return self.emulator.stack, self._info()

    def step(self, action: Any) -> tuple[Bytes, float, bool, bool, dict[str, Any]]:
        """Play four frames of an action."""
        reward = self.emulator.step(int(action))
        self.elapsed += 1
        info = self._info()
        terminated = not info["alive"]
        truncated = self.elapsed >= self.max_steps
        return self.emulator.stack, reward, terminated, truncated, info

    def _info(self) -> dict[str, Any]:
        facts = self.emulator.facts()
        [labels] = judge_sub_goals(facts[None], SUB_GOALS.values())
        named = zip(SUB_GOALS, labels.tolist(), strict=True)
        return {
            "labels": dict(named),
            "position": self.emulator.position(),
            "alive": self.emulator.alive(),
        }
