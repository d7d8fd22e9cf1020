"""Spec B6, G2: random stacks of wrappers with a bad one, and random words of commands that are printed.

``python -m tests.attacks.own_code --cases 400`` prints a row for each family. A bad wrapper's case fails where
``collect`` does not end as one line that names its file and line, or its method; a command's where ``sh`` gets other
words than were printed.
"""

from __future__ import annotations

import argparse
import inspect
import random
import subprocess
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from hypogoal.core.commands import command
from hypogoal.core.errors import UserError
from hypogoal.core.progress import Progress
from hypogoal.domains.gymnasium_domain import GymnasiumConfig, GymnasiumDomain

SIGNS = "ab .-_/$`\"'\\;&|<>(){}[]*?!#~%=:,äΩ火"
FEW = GymnasiumConfig(steps=120, heldout_seeds=(3, 4))


class Walk(gymnasium.Env[Any, int]):
    """Six cells in a row, and a number that the seed draws; the task ends at the last cell."""

    observation_space = spaces.Box(0.0, 9.0, (2,), np.float32)
    action_space = spaces.Discrete(2)  # type: ignore[assignment]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.cell, self.sign = 2, float(self.np_random.random())
        return self.seen(), {}

    def step(self, action: int) -> Any:
        self.cell = max(0, self.cell + (1 if action else -1))
        return self.seen(), float(self.cell == 5), self.cell == 5, False, {}

    def seen(self) -> Any:
        return np.array([self.cell, self.sign], np.float32)


class Plain(gymnasium.Wrapper[Any, Any, Any, Any]):
    """It changes nothing, with methods of its own."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        return self.env.reset(seed=seed, options=options)

    def step(self, action: int) -> Any:
        return self.env.step(action)


class Drops(Plain):
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        return self.env.reset(options=options)


class Counts(Plain):
    played = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.played += 1
        return self.env.reset(seed=(seed or 0) + self.played, options=options)


class TakesNone(Plain):
    def reset(self) -> Any:  # type: ignore[override]
        return self.env.reset()


class GivesOne(Plain):
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        return self.env.reset(seed=seed)[0]


class GivesFour(Plain):
    def step(self, action: int) -> Any:
        return self.env.step(action)[:4]


class Raises(Plain):
    def step(self, action: int) -> Any:
        raise RuntimeError("no more steps")


class Longer(Plain):
    def step(self, action: int) -> Any:
        observation, *rest = self.env.step(action)
        return np.append(observation, 1.0), *rest


BAD = (Drops, Counts, TakesNone, GivesOne, GivesFour, Raises, Longer)
GOOD = (Plain, gymnasium.wrappers.OrderEnforcing, lambda env: gymnasium.wrappers.TimeLimit(env, 50))


def wrappers(rng: random.Random) -> bool:
    """Whether a bad wrapper somewhere in a stack is named: by a line of its method, or by the method in the error."""
    bad = rng.choice(BAD)
    method = getattr(bad, next(name for name in ("reset", "step") if name in vars(bad)))
    layers: list[Any] = [bad, *rng.choices(GOOD, k=rng.randrange(4))]
    rng.shuffle(layers)

    def make() -> gymnasium.Env[Any, Any]:
        env: gymnasium.Env[Any, Any] = Walk()
        for layer in layers:
            env = layer(env)
        return env

    domain = GymnasiumDomain(make, {"left": lambda env: env.unwrapped.cell == 0})  # type: ignore[attr-defined]
    source, first = inspect.getsourcelines(method)
    try:
        domain.collect(FEW, rng.randrange(100), Progress("collect", 1, quiet=True))
    except UserError as error:
        places = [f"own_code.py, line {line}" for line in range(first, first + len(source))]
        places.append(f"{bad.__name__}.{method.__name__}()")
        return "\n" not in str(error) and any(place in str(error) for place in places)
    return False


def commands(rng: random.Random) -> bool:
    """Whether a shell gets the words that were printed."""
    words = ["".join(rng.choices(SIGNS, k=rng.randrange(12))) for _ in range(rng.randrange(1, 5))]
    script = f"hypogoal() {{ printf '%s\\0' \"$@\"; }}; {command('show', *words)}"
    done = subprocess.run(["sh", "-c", script], capture_output=True, text=True, check=False)
    return done.returncode == 0 and done.stdout.split("\0")[:-1] == ["show", *words]


FAMILIES = {"wrappers": wrappers, "commands": commands}


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--cases", type=int, default=400, help="of each family")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    bad = 0
    for name, family in FAMILIES.items():
        failed = [case for case in range(given.cases) if not family(random.Random(f"{given.seed} {name} {case}"))]
        print(f"{name}: {given.cases} cases, {len(failed)} bad {failed[:5]}")
        bad += len(failed)
    return int(bad > 0)


if __name__ == "__main__":
    raise SystemExit(main())
