"""Spec B4, D4: Montezuma's Revenge from the top of a ladder or elsewhere, a Gymnasium environment; its start states.

This is the reference: tests compare the training engine (``engine.py``) with it.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.core.seeding import rng_for
from hypogoal.domains.montezuma import emulator as game
from hypogoal.domains.montezuma.emulator import Position
from hypogoal.domains.montezuma.ladders import LADDERS, REACH, within
from hypogoal.domains.montezuma.sub_goals import CROSSINGS, FACT_BYTES, SUB_GOALS

MAX_STEPS = 200  # agent steps an episode; an option's own time in Table 2
START_STATES = 32
PHASES = range(2, 258)  # frames that the agent may wait before it starts
TRIES = 4  # phases tried per start state
FRAMES_PER_SECOND = 60


class Beginning(NamedTuple):
    """Where episodes may begin, and the script by which the agent must get alive from there to ``end``."""

    name: str
    at: Position
    end: Position
    action: int  # of the script
    steps: int  # agent steps of it


FIRST = Position(1, 77, 235)  # where the game begins
GAME = "game"
# Without 1M, from whose base the conveyor carries the agent off, and 13-21, at whose top the spider waits.
CLIMBED_UP = [ladder for ladder in LADDERS if ladder.name not in ("1M", "13-21")]
BEGINNINGS = {
    beginning.name: beginning
    for beginning in (
        *(Beginning(each.name, each.top, each.base, game.DOWN, each.steps_down) for each in LADDERS),
        *(Beginning(f"up-{each.name}", each.base, each.top, game.UP, each.steps_up) for each in CLIMBED_UP),
        *(Beginning(name, at, at, game.NOOP, 1) for name, at in CROSSINGS.items()),
        Beginning(GAME, FIRST, FIRST, game.NOOP, 1),
    )
}


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
    picture: NDArray[np.uint8]  # the console's, (210, 160, 3): a restored emulator has none until its first step


def make_starts(emulator: game.Emulator, beginning: Beginning, count: int, seed: int) -> list[Start]:
    """Spec D4: states at a beginning, such as the top of a ladder, from which its script survives.

    They differ in the phase of what moves, drawn from ``seed``, and look different if ``TRIES`` phases per state offer
    enough different looks. The top of 14-22 has one look only; its states differ out of sight.

    The same seed gives the same states, whatever was played before; the emulator's state is changed. Too few such
    states is a ``UserError``.
    """
    rng = rng_for(seed, "start-states", beginning.name)
    starts = _looking_different(_in_phases(emulator, beginning, TRIES * count, rng), count)
    if len(starts) < max(count, 1):
        fault = f"only {len(starts)} of {count} start states survive the script"
        raise UserError(fault, beginning.name, "Ask for fewer.")
    return starts


def _in_phases(emulator: game.Emulator, beginning: Beginning, tries: int, rng: np.random.Generator) -> Iterator[Start]:
    """The beginning in random phases from which its script survives."""
    for phase in rng.permutation(PHASES)[:tries].tolist():
        new_game = beginning.name == GAME
        snapshot = emulator.new_game(phase) if new_game else emulator.place(*beginning.at, phase=phase)
        if snapshot is None or emulator.position() != beginning.at:
            continue
        start = Start(snapshot, tuple(emulator.ram()[FACT_BYTES].tolist()), emulator.screen_rgb())
        emulator.screens = False
        survives = arrives(emulator, beginning)
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


def arrives(emulator: game.Emulator, beginning: Beginning) -> bool:
    """Play the script, such as DOWN from a ladder's top to its base. Returns whether the agent arrives alive."""
    for _ in range(beginning.steps):
        emulator.step(beginning.action)
        if not emulator.alive():
            return False
    return bool(within(np.array([emulator.position()]), [beginning.end], REACH))


def labels_of(facts: NDArray[np.int64], alive: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Spec B4: the true predicates, bool (n, G), for facts (n, ``FACTS``) and whether the agent is alive (n,)."""
    return np.stack([sub_goal.holds(facts, alive) for sub_goal in SUB_GOALS.values()], axis=1)


class MontezumaLadder(gymnasium.Env[NDArray[np.uint8], np.int64]):
    """Montezuma's Revenge from the top of a ladder or elsewhere. Gymnasium id ``hypogoal/MontezumaLadder-v0``.

    An observation is the last four agent steps' frames, uint8 (84, 84, 4), grey, oldest first; 18 actions, each
    played for four frames; the reward is the game's. ``info`` has ``labels`` (sub-goal: whether it holds),
    ``position`` (room, x, y in RAM units) and ``alive``.

    Args:
        start: a ladder or another of ``BEGINNINGS``.
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
        self.starts = make_starts(self.emulator, beginning_named(start), start_states, start_seed)
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
        """The true predicates of the current state, bool (G,)."""
        facts = self.emulator.ram()[None, FACT_BYTES].astype(np.int64)
        return labels_of(facts, np.array([self.emulator.alive()]))[0]

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
