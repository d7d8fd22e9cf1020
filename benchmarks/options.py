"""Option learning: updates against a plain one, all members at once; in one run, one thread.

    python -m benchmarks.options [--short] [--json PATH]

The plain update is the paper's network and Double-DQN as one would write them down, anew: the images of every step of
32 executions up to the sampled step, float32 NCHW, three passes (the online network before and after the step, the
target after it), Adam as it comes. Ours is ``PaperLearner``: features of distinct images once; with
``recurrence=1`` the sampled steps alone. The light update is that of all members at once, with its own batch of 128.
All are fed executions of random play.
"""

from __future__ import annotations

import copy
import statistics
from typing import Any

from benchmarks import timing

timing.alone()

import numpy as np  # noqa: E402
import torch  # noqa: E402
from numpy.typing import NDArray  # noqa: E402
from torch import Tensor, nn  # noqa: E402

from hypogoal.core.config import assigned, resolve  # noqa: E402
from hypogoal.core.presets import preset as read_preset  # noqa: E402
from hypogoal.core.processes import prepare  # noqa: E402
from hypogoal.core.seeding import rng_for  # noqa: E402
from hypogoal.domains.doorkey.engine import DoorKeyEngine  # noqa: E402
from hypogoal.meta.config import TrainOptionsConfig  # noqa: E402
from hypogoal.options.choosers import RandomChooser  # noqa: E402
from hypogoal.options.conv_gru import PaperLearner  # noqa: E402
from hypogoal.options.light import LightLearner  # noqa: E402
from hypogoal.options.loop import OptionLoop  # noqa: E402
from hypogoal.options.recording import Recorder  # noqa: E402
from hypogoal.options.replay import PrioritisedReplay  # noqa: E402
from hypogoal.options.termination import Terminations  # noqa: E402

LAYOUT = 100
MEMBERS = (1, 5, 15, 30)
WANTED = {"paper's network, ours": 17.5, "light, 15 members at once": 10.0}  # 2.1 s to 120 ms


class PlainNetwork(nn.Module):
    """The paper's network of one member, as one would write it down."""

    def __init__(self, actions: int):
        super().__init__()
        self.features = nn.Sequential(
            nn.Conv2d(3, 16, 3), nn.BatchNorm2d(16), nn.ReLU(), nn.MaxPool2d(2),
            nn.Conv2d(16, 32, 3), nn.BatchNorm2d(32), nn.ReLU(), nn.MaxPool2d(2),
            nn.Flatten(),
        )  # fmt: skip
        self.gru = nn.GRU(32 * 14 * 14, 512, batch_first=True)
        self.values = nn.Sequential(nn.Linear(512, 128), nn.ReLU(), nn.Linear(128, actions))

    def forward(self, images: Tensor) -> Tensor:
        """float32 (N, T, C, H, W) -> values (N, T, actions)."""
        embedded = self.features(images.flatten(0, 1)).view(*images.shape[:2], -1)
        return self.values(self.gru(embedded)[0])


class PlainLearner:
    """One member's Double DQN on sampled executions of a replay."""

    def __init__(self, engine: DoorKeyEngine, replay: PrioritisedReplay, reached: Terminations):
        torch.manual_seed(0)
        self.engine, self.replay, self.reached = engine, replay, reached
        self.online = PlainNetwork(engine.n_actions)
        self.target = copy.deepcopy(self.online).eval()
        self.adam = torch.optim.Adam(self.online.parameters(), lr=2.5e-4)
        self.rng = np.random.default_rng(0)

    def _images(self, ids: NDArray[np.int64]) -> Tensor:
        images = self.engine.images(ids.ravel()).reshape(*ids.shape, 64, 64, 3)
        return torch.from_numpy(np.ascontiguousarray(images.transpose(0, 1, 4, 2, 3))).float() / 255.0

    def update(self) -> None:
        """One update with 32 transitions."""
        indices, weights = self.replay.sample(32, self.rng)
        steps = self.replay.data.at(indices)
        last = torch.from_numpy(steps.length.astype(np.int64) - 1)
        paths = steps.path.astype(np.int64)
        here, after = paths[:, :-1], paths[:, 1:]
        row = torch.arange(32)
        self.online.train()
        values = self.online(self._images(here))[row, last]
        following = self._images(after)
        with torch.no_grad():
            best = self.online(following)[row, last].argmax(1)
            ahead = self.target(following)[row, last].gather(1, best[:, None])[:, 0]
        reached = torch.from_numpy(self.reached.of(paths[np.arange(32), steps.length])[:, 0])
        end = reached | torch.from_numpy(steps.terminated)
        goal = reached.float() + 0.95 * ahead * ~end
        taken = values.gather(1, torch.from_numpy(steps.action.astype(np.int64))[:, None])[:, 0]
        errors = nn.functional.huber_loss(taken, goal, reduction="none")
        loss = (errors * torch.from_numpy(weights)).mean()
        self.adam.zero_grad()
        loss.backward()
        self.adam.step()
        self.replay.set_priorities(indices, (taken - goal).detach().abs().numpy())


def config_of(*changes: str, preset: str | None = None) -> TrainOptionsConfig:
    """Settings of option learning."""
    return resolve(TrainOptionsConfig, read_preset(preset, "train-options"), assigned(changes), stage="train-options")


def terminations(engine: DoorKeyEngine, options: int) -> Terminations:
    """So many options that end at the true sub-goals, in turn."""
    return Terminations.of_predictions(
        lambda ids: np.resize(engine.labels(ids).T, (options, len(ids))).T.copy(),
        options,
    )


def played(config: TrainOptionsConfig, options: int, steps: int) -> OptionLoop:
    """A loop after ``steps`` of random play, nothing learned."""
    engine = DoorKeyEngine(LAYOUT, config.environments)
    verdicts = terminations(engine, options)
    learner = (PaperLearner if config.network == "paper" else LightLearner)(engine, verdicts, config, 0)
    chooser = RandomChooser(rng_for(0, "choice"))
    loop = OptionLoop(engine, verdicts, learner, chooser, Recorder(options, engine), config, gamma=1.0)
    while loop.recorder.steps < steps:
        loop.advance()
    return loop


def update(loop: OptionLoop) -> float:
    """CPU seconds of one update."""
    learner = loop.learner
    if isinstance(learner, PaperLearner):
        learner.members[0].due = learner.settings.update_interval
    else:
        assert isinstance(learner, LightLearner)
        learner.due = learner.settings.update_interval
    return timing.cpu_seconds(learner.learn)


def learning(loop: OptionLoop, updates: int) -> float:
    """CPU seconds of an update: the median of some, the first left out."""
    times = [update(loop) for _ in range(updates + 1)]
    return statistics.median(times[1:])


def updates(repeats: int, count: int) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """The literal and the light update against the plain one; the light one by number of members."""
    paper = played(config_of("warm_up=100", preset="paper"), 1, 2_000)
    alone = played(config_of("warm_up=100", "recurrence=1", preset="paper"), 1, 2_000)
    learner = paper.learner
    assert isinstance(learner, PaperLearner) and isinstance(paper.engine, DoorKeyEngine)
    plain = PlainLearner(paper.engine, copy.deepcopy(learner.members[0].replay), paper.terminations)
    light = {members: played(config_of("warm_up=100"), members, 4_000) for members in MEMBERS}

    def plainly() -> float:
        times = [timing.cpu_seconds(plain.update) for _ in range(count + 1)]
        return statistics.median(times[1:])

    found = timing.alternated(
        {
            "paper's network, plain": plainly,
            "paper's network, ours": lambda: learning(paper, count),
            "the same, recurrence=1": lambda: learning(alone, count),
            "light, 15 members at once": lambda: learning(light[15], 20 * count),
        },
        repeats,
    )
    rows = timing.rows_of(found, "paper's network, plain", WANTED)
    by_members = timing.alternated(
        {
            f"light, {members} members": lambda loop=loop: learning(loop, 20 * count)  # type: ignore[misc]
            for members, loop in light.items()
        },
        repeats,
    )
    return rows, timing.rows_of(by_members, f"light, {MEMBERS[-1]} members", {})


def main() -> None:
    """Measure, print, write."""
    given = timing.arguments(__doc__, "options")
    repeats, count = (1, 2) if given.short else (5, 10)
    prepare()
    about = timing.machine("torch", "numpy")
    rows, members = updates(repeats, count)
    timing.show("\na Double-DQN update", rows)
    timing.show("\nthe light update by number of members, all learning from every transition", members)
    timing.write(given.json, about, {"updates": rows, "members": members, "repeats": repeats})


if __name__ == "__main__":
    main()
