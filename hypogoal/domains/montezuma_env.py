"""Spec B4, D4: Montezuma's Revenge from the top of a ladder, as a Gymnasium environment, and its start states.

This is the reference: tests compare the training engine (``montezuma_engine.py``) with it.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.domains import montezuma_emulator as game
from hypogoal.domains.montezuma_ladders import REACH, SUB_GOAL, Ladder, at_base, ladder_named, within

SUB_GOALS = (SUB_GOAL,)
MAX_STEPS = 200  # agent steps an episode; an option's own time in Table 2
START_STATES = 32
PHASES = range(2, 258)  # frames that the agent may wait before it starts
TRIES = 4  # phases tried per start state
FRAMES_PER_SECOND = 60


@dataclass(frozen=True)
class Start:
    """Where an episode begins."""

    snapshot: game.Snapshot
    position: game.Position  # of the agent
    picture: NDArray[np.uint8]  # the console's, (210, 160, 3): a restored emulator has none until its first step


def make_starts(emulator: game.Emulator, ladder: Ladder, count: int, seed: int) -> list[Start]:
    """Spec D4: states at the top of a ladder from which the scripted descent survives.

    They differ in the phase of what moves, drawn from ``seed``, and look different if ``TRIES`` phases per state offer
    enough different looks. The top of 14-22 has one look only; its states differ out of sight.

    The same seed gives the same states, whatever was played before; the emulator's state is changed. Too few such
    states is a ``UserError``.
    """
    rng = rng_for(seed, "start-states", ladder.name)
    starts = _looking_different(_tops(emulator, ladder, TRIES * count, rng), count)
    if len(starts) < max(count, 1):
        fault = f"only {len(starts)} of {count} start states survive the descent"
        raise UserError(fault, ladder.name, "Ask for fewer.")
    return starts


def _tops(emulator: game.Emulator, ladder: Ladder, tries: int, rng: np.random.Generator) -> Iterator[Start]:
    """The top in random phases from which the descent survives."""
    for phase in rng.permutation(PHASES)[:tries].tolist():
        snapshot = emulator.place(*ladder.top, phase=phase)
        if snapshot is None or emulator.position() != ladder.top:
            continue
        start = Start(snapshot, ladder.top, emulator.screen_rgb())
        emulator.screens = False
        survives = descend(emulator, ladder)
        emulator.screens = True
        if survives:
            yield start


def _looking_different(starts: Iterator[Start], count: int) -> list[Start]:
    """The first ``count`` that look different, filled up with others if there are too few."""
    chosen: dict[bytes, Start] = {}
    others: list[Start] = []
    while len(chosen) < count and (start := next(starts, None)) is not None:
        look = start.snapshot.stack.tobytes()
        if look in chosen:
            others.append(start)
        else:
            chosen[look] = start
    return [*chosen.values(), *others][:count]


def descend(emulator: game.Emulator, ladder: Ladder) -> bool:
    """The scripted descent: DOWN from the top to the base. Returns whether the agent arrives alive."""
    for _ in range(ladder.steps_down):
        emulator.step(game.DOWN)
        if not emulator.alive():
            return False
    return bool(within(np.array([emulator.position()]), [ladder.base], REACH))


def labels_of(positions: NDArray[np.int64], alive: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Spec B4: the true predicates, bool (n, 1), for positions (n, 3) of the agent and whether it is alive (n,)."""
    return (at_base(positions) & alive)[:, None]


class MontezumaLadder(gymnasium.Env[NDArray[np.uint8], np.int64]):
    """Montezuma's Revenge from the top of a ladder. Gymnasium id ``hypogoal/MontezumaLadder-v0``.

    An observation is the last four agent steps' frames, uint8 (84, 84, 4), grey, oldest first; 18 actions, each
    played for four frames; the reward is the game's. ``info`` has ``labels`` (sub-goal: whether it holds),
    ``position`` (room, x, y in RAM units) and ``alive``.

    Args:
        start: the ladder, see ``montezuma_ladders.LADDERS``.
        max_steps: agent steps after which an episode is truncated.
        end_at_death: True, an episode terminates when the agent begins to die; False, when the game is over.
        render_mode: None, or ``rgb_array``: the console's picture, uint8 (210, 160, 3).
        start_states: the number of start states, see ``make_starts``.
        start_seed: draws those states. ``reset(seed)`` draws one of them, ``reset(options={"start_state": n})`` takes
            the n-th.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FRAMES_PER_SECOND // game.FRAME_SKIP}  # noqa: RUF012

    def __init__(
        self,
        start: str = "1L",
        max_steps: int = MAX_STEPS,
        end_at_death: bool = True,
        render_mode: str | None = None,
        start_states: int = START_STATES,
        start_seed: int = 0,
    ):
        self.max_steps, self.end_at_death, self.render_mode = max_steps, end_at_death, render_mode
        self.observation_space = spaces.Box(0, 255, game.OBSERVATION_SHAPE, np.uint8)
        self.action_space = spaces.Discrete(game.N_ACTIONS)
        self.emulator = game.Emulator()
        self.starts = make_starts(self.emulator, ladder_named(start), start_states, start_seed)
        self.elapsed = 0
        self._picture: NDArray[np.uint8] | None = None

    def get_action_meanings(self) -> list[str]:
        """The actions' names, as in Gymnasium's Atari environments."""
        import ale_py

        return [ale_py.Action(number).name for number in range(game.N_ACTIONS)]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        """Begin an episode with one of the start states."""
        super().reset(seed=seed)
        number = (options or {}).get("start_state")
        if number is None:
            number = int(self.np_random.integers(len(self.starts)))
        self.emulator.restore(self.starts[number].snapshot)
        self._picture = self.starts[number].picture
        self.elapsed = 0
        return self.emulator.stack, self._info()

    def step(self, action: Any) -> tuple[NDArray[np.uint8], float, bool, bool, dict[str, Any]]:
        """Four frames of an action."""
        reward = self.emulator.step(int(action))
        self._picture = None
        self.elapsed += 1
        info = self._info()
        terminated = self.emulator.ale.game_over() or (self.end_at_death and not info["alive"])
        return self.emulator.stack, reward, terminated, self.elapsed >= self.max_steps, info

    def labels(self) -> NDArray[np.bool_]:
        """The true predicates of the current state, bool (1,)."""
        return labels_of(np.array([self.emulator.position()]), np.array([self.emulator.alive()]))[0]

    def _info(self) -> dict[str, Any]:
        return {
            "labels": dict(zip(SUB_GOALS, self.labels().tolist(), strict=True)),
            "position": self.emulator.position(),
            "alive": self.emulator.alive(),
        }

    def render(self) -> Any:
        """The console's picture, uint8 (210, 160, 3); None without a render mode."""
        if self.render_mode is None:
            return None
        return self.emulator.screen_rgb() if self._picture is None else self._picture.copy()
