"""Initiation sets learned from executions: where an option probably reaches its sub-goal in time (Spec D7).

Beyond the paper, in which every option may start wherever its sub-goal does not hold yet. Source of the idea: the
initiation classifiers of skill chaining (Konidaris and Barto 2009); here it is one probability per option, learned for
all together.
"""

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hypogoal.core.checkpoints import Resumable
from hypogoal.core.compute import tensor
from hypogoal.core.seeding import rng_for, seed_for
from hypogoal.core.tensors import AGAIN, below, check_fit, load_fitting
from hypogoal.dataset import Observations
from hypogoal.domains.base import Engine
from hypogoal.learners.double_dqn import descend
from hypogoal.options.networks import LightQNetwork, apply_to_states, standard_in

NAME, PREFIX = "initiation.safetensors", "network."
KEPT = 8_192  # last executions; options change while they learn, so older ones are forgotten
FEWEST = 100  # executions of an option before it is ever held back
THRESHOLD = 0.05  # options less likely to succeed are held back
IGNORED = 0.1  # share of choices in which no option is held back: so it shows if one has learned since
BATCH, EXECUTIONS_PER_UPDATE, LEARNING_RATE = 128, 32, 1e-3

# From an observation (*obs) and what is offered in it, bool (O,), to what may start there.
Narrowing = Callable[[Observations, NDArray[np.bool_]], NDArray[np.bool_]]


def narrowed(
    offered: NDArray[np.bool_], probabilities: NDArray[np.float32], executions: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Of the options offered, bool (n, O), those that probably succeed; all of them where none would be left."""
    likely = offered & ((probabilities >= THRESHOLD) | (executions < FEWEST))
    return np.where(likely.any(1, keepdims=True), likely, offered)


class Narrowed:
    """What an artefact's initiation sets leave of the options offered in an observation.

    ``state`` is the tensors of ``initiation.safetensors``, a ``UserError`` where they are not of so many options on
    observations of this shape.
    """

    def __init__(self, state: Mapping[str, Tensor], shape: tuple[int, ...], options: int):
        weights = below(PREFIX, state)
        make = partial(LightQNetwork, shape, options, 1, standard_in(weights, shape))
        self.network = load_fitting(make, weights, NAME)
        others = {name: value for name, value in state.items() if not name.startswith(PREFIX)}
        check_fit({"executions": torch.zeros(options, dtype=torch.int64)}, others, NAME, AGAIN)
        self.executions = state["executions"].numpy()

    @torch.no_grad()
    def __call__(self, observation: Observations, offered: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Of what is offered in an observation (*shape), bool (O,), a part."""
        probabilities = self.network(torch.from_numpy(observation[None]))[:, :, 0].sigmoid().numpy()
        return narrowed(offered[None], probabilities, self.executions)[0]


class Initiation(Resumable):
    """The probability that an option reaches its sub-goal before its time is up, and which options it lets start.

    ``seed`` is of weights and draws.
    """

    CHANGING = ("network", "optimiser", "rng", "states", "option", "reached", "executions", "count", "_due")

    def __init__(self, engine: Engine, options: int, seed: int, device: torch.device | str = "cpu"):
        self.engine, self.options, self.device = engine, options, torch.device(device)
        self.rng = rng_for(seed, "initiation")
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed_for(seed, "initiation-weights"))
            self.network = LightQNetwork(engine.observation_shape, options, 1, engine.standard).to(self.device)
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=LEARNING_RATE, fused=True)
        self.states, self.option = np.zeros((2, KEPT), dtype=np.int64)
        self.reached = np.zeros(KEPT, dtype=np.bool_)
        self.executions = np.zeros(options, dtype=np.int64)
        self.count = self._due = 0

    def probabilities(self, ids: NDArray[np.int64]) -> NDArray[np.float32]:
        """P(sub-goal reached before the timeout | state, option), float32 (n, O)."""
        with torch.no_grad():
            logits = apply_to_states(self.network, self.engine, ids)[:, :, 0].cpu()
        probabilities: NDArray[np.float32] = logits.sigmoid().numpy()
        return probabilities

    def narrow(self, ids: NDArray[np.int64], offered: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """See :func:`narrowed`, in states (n,); in a share ``IGNORED`` of them all options are left."""
        likely = narrowed(offered, self.probabilities(ids), self.executions)
        ignored = self.rng.random(len(ids)) < IGNORED
        return np.where(ignored[:, None], offered, likely)

    def record(self, ids: NDArray[np.int64], options: NDArray[np.int64], reached: NDArray[np.bool_]) -> None:
        """Executions that ended, (n,) each: where they began, of which options, whether these got there."""
        places = (self.count + np.arange(len(ids))) % KEPT
        self.states[places], self.option[places], self.reached[places] = ids, options, reached
        np.add.at(self.executions, options, 1)
        self.count += len(ids)
        self._due += len(ids)

    def learn(self) -> dict[str, float]:
        """As many updates as are due; the last one's loss, nothing where none was."""
        numbers: dict[str, float] = {}
        while self._due >= EXECUTIONS_PER_UPDATE:
            self._due -= EXECUTIONS_PER_UPDATE
            drawn = self.rng.integers(min(self.count, KEPT), size=BATCH)
            drawn = drawn[self.engine.remembers(self.states[drawn])]
            if len(drawn):
                numbers = self._update(drawn)
        return numbers

    def _update(self, drawn: NDArray[np.int64]) -> dict[str, float]:
        logits = apply_to_states(self.network, self.engine, self.states[drawn])[:, :, 0]
        of_option = logits.gather(1, tensor(self.option[drawn], self.device)[:, None])[:, 0]
        reached = tensor(self.reached[drawn], self.device).float()
        loss = torch.nn.functional.binary_cross_entropy_with_logits(of_option, reached)
        where = f"after {self.count} executions"
        descend(loss, self.network, self.optimiser, "the initiation sets", where)
        return {"initiation_loss": float(loss.detach())}

    def state(self) -> dict[str, Tensor]:
        """Weights and how often each option was executed, for an artefact."""
        state = {f"{PREFIX}{name}": value.contiguous() for name, value in self.network.state_dict().items()}
        return state | {"executions": torch.from_numpy(self.executions.copy())}

    def load(self, state: Mapping[str, Tensor]) -> None:
        """Continue from what an artefact holds, no execution remembered; a ``UserError`` where it does not fit."""
        check_fit(self.state(), state, NAME, AGAIN)
        self.network.load_state_dict(below(PREFIX, state))
        self.executions[:] = state["executions"].numpy()
