"""The corridor as a Gymnasium environment, and domains of it: what a user would bring (Spec B6)."""

from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces

from hypogoal.core.config import setting
from hypogoal.domains.gymnasium.domain import GymnasiumConfig, GymnasiumDomain

LENGTH, SHAPE = 6, (48, 48, 3)


class CorridorEnv(gymnasium.Env[np.ndarray, int]):
    """Cells 0..5, start at 2; action 0 goes left, 1 right; the task ends at the right end with reward 1.

    The agent's cell is white; a stripe below shows the layout, which ``seed`` draws from 0..7.
    """

    observation_space = spaces.Box(0, 255, SHAPE, np.uint8)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.cell, self.layout = 2, int(self.np_random.integers(8))
        return self.image(), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.cell = min(max(self.cell + (1 if action == 1 else -1), 0), LENGTH - 1)
        over = self.cell == LENGTH - 1
        return self.image(), float(over), over, False, {}

    def image(self) -> np.ndarray:
        picture = np.zeros(SHAPE, np.uint8)
        picture[:40, 8 * self.cell : 8 * self.cell + 8] = 255
        picture[40:, :, self.layout % 3] = 60 + 20 * self.layout
        return picture


def at_left(env: gymnasium.Env) -> bool:
    return env.unwrapped.cell == 0  # type: ignore[attr-defined]


def at_right(env: gymnasium.Env) -> bool:
    return env.unwrapped.cell == LENGTH - 1  # type: ignore[attr-defined]


SUB_GOALS = {"left-end": at_left, "right-end": at_right}
DOMAIN = GymnasiumDomain(CorridorEnv, SUB_GOALS)


class Paid(CorridorEnv):
    """Each step costs, and says when it was."""

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
        image, reward, over, cut, _ = super().step(action)
        return image, reward - 0.125, over, cut, {"cell": self.cell}


def swift(env: gymnasium.Env, info: dict[str, Any], earned: float, terminated: bool) -> bool:
    """At the right end within five steps, or at the left end when the time is up."""
    return earned >= 1 - 5 * 0.125 if terminated else bool(at_left(env) and info["cell"] == 0)


SWIFT = GymnasiumDomain(Paid, SUB_GOALS, success=swift)


class Sensed(CorridorEnv):
    """Its observations are numbers, in a dictionary: where the agent is, and of which layout this is."""

    observation_space = spaces.Dict(  # type: ignore[assignment]
        {"place": spaces.Box(-1, 1, (2,), np.float32), "layout": spaces.Discrete(8), "noise": spaces.Box(0, 9, ())}
    )

    def image(self) -> Any:
        way = self.cell / (LENGTH - 1)
        place = np.array([way, -way], np.float32)
        return {"noise": np.array(5, np.float32), "place": place, "layout": self.layout}


class Wordy(CorridorEnv):
    """Its observations are neither images nor numbers."""

    observation_space = spaces.Sequence(spaces.Discrete(2))  # type: ignore[assignment]


class Framed(CorridorEnv):
    """Its image is in a dictionary."""

    observation_space = spaces.Dict(image=spaces.Box(0, 255, SHAPE, np.uint8))  # type: ignore[assignment]

    def image(self) -> Any:
        return {"image": super().image()}


class Mixed(CorridorEnv):
    """Its image has company, without a key."""

    observation_space = spaces.Tuple((spaces.Box(0, 255, SHAPE, np.uint8), spaces.Discrete(LENGTH)))  # type: ignore[assignment]


class Steered(CorridorEnv):
    """Its actions are no numbers."""

    action_space = spaces.Box(-1, 1, (1,), np.float32)  # type: ignore[assignment]


class Restless(CorridorEnv):
    """It draws its steps from nobody's seed."""

    rng = np.random.default_rng(0)

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
        return super().step(int(self.rng.integers(2)))


class Grey(CorridorEnv):
    """Its images have no colours, and no axis for them."""

    observation_space = spaces.Box(0, 255, SHAPE[:2], np.uint8)

    def image(self) -> np.ndarray:
        return super().image()[..., 0]


class Flipped(CorridorEnv):
    """Its images are views that run backwards."""

    def image(self) -> np.ndarray:
        return super().image()[..., ::-1]


GREY = GymnasiumDomain(Grey, SUB_GOALS)
WORDY, STEERED, RESTLESS = (GymnasiumDomain(env, SUB_GOALS) for env in (Wordy, Steered, Restless))
SENSED, FRAMED, MIXED = (GymnasiumDomain(env, SUB_GOALS) for env in (Sensed, Framed, Mixed))
NEVER = GymnasiumDomain(CorridorEnv, {**SUB_GOALS, "on-the-moon": lambda env: False})
ALWAYS = GymnasiumDomain(CorridorEnv, {**SUB_GOALS, "somewhere": lambda env: True})


class MirroredConfig(GymnasiumConfig):
    """A setting of the domain's own."""

    mirrored: bool = setting(False, "action 0 goes right, 1 left")


class Mirrored(CorridorEnv):
    """Keeps a list of in which worlds episodes were played."""

    played: ClassVar[list[bool]] = []

    def __init__(self, mirrored: bool):
        self.mirrored = mirrored

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        self.played.append(self.mirrored)
        return super().reset(seed=seed)

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
        return super().step(1 - action if self.mirrored else action)


MIRRORED = GymnasiumDomain(Mirrored, SUB_GOALS, config_class=MirroredConfig)
