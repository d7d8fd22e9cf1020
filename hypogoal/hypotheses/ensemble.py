"""An ensemble of K members: each is one hypothesis about which features make a sub-goal."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hypogoal.core.errors import UserError
from hypogoal.hypotheses import patches
from hypogoal.hypotheses.networks import as_input, build_network, reordered

CHUNK = 64  # images at once in a plain forward pass: what fits a CPU's cache; on a GPU 16 times as many
PATCH_CHUNK = 4096  # images at once where few patches are distinct
PATCHES_FROM = 256  # images from which looking for distinct patches pays


class Ensemble(nn.Module):
    """K member networks of one sub-goal with fresh weights; ``training.fit`` trains them.

    Args:
        network: a name in ``networks.NETWORKS``.
        observation_shape: (H, W, C) of the uint8 observations.
        members: K, at least 1.
        generator: draws the initial weights.

    Attributes:
        members: K plain ``nn.Sequential``, float (N, C, H, W) in 0..1 (``networks.as_input``) -> logits (N,
            2).

    Raises:
        UserError: unknown network, or images too small for it.
    """

    def __init__(self, network: str, observation_shape: tuple[int, ...], members: int, generator: torch.Generator):
        super().__init__()
        self.network, self.observation_shape = network, tuple(int(size) for size in observation_shape)
        self.members = nn.ModuleList(build_network(network, self.observation_shape, generator) for _ in range(members))
        self._networks = tuple(reordered(member) for member in self.members if isinstance(member, nn.Sequential))

    def __len__(self) -> int:
        """K, the number of members."""
        return len(self.members)

    def networks(self) -> tuple[nn.Sequential, ...]:
        """The members in the order of layers that is fastest; weights and BatchNorm statistics are shared."""
        return self._networks

    def predict(self, observations: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Every member's probability that the sub-goal is reached.

        Args:
            observations: uint8 (N, H, W, C).

        Returns:
            float32 (N, K). Up to rounding a state's row does not depend on the others.

        Raises:
            UserError: observations of another shape or type.
        """
        self._check(observations)
        was_training = self.training
        if was_training:
            self.eval()
        probabilities = np.empty((len(observations), len(self)), dtype=np.float32)
        chunk = PATCH_CHUNK if self._device().type == "cpu" else CHUNK * 16
        with torch.inference_mode():
            for start in range(0, len(observations), chunk):
                some = observations[start : start + chunk]
                probabilities[start : start + chunk] = self._logits(some).softmax(dim=-1)[..., 1].T.cpu().numpy()
        if was_training:
            self.train()
        return probabilities

    def _logits(self, observations: NDArray[np.uint8]) -> Tensor:
        """(K, N, 2), each image's distinct patches computed once where that pays."""
        networks = self.networks()
        device = self._device()
        if device.type == "cpu" and len(observations) >= PATCHES_FROM:
            tables = patches.make_tables(observations, patches.windows_of(networks[0]))
            if tables is not None:
                batch = patches.take(tables, np.arange(len(observations)))
                return torch.stack([patches.forward(network, batch) for network in networks])
        chunk = CHUNK if device.type == "cpu" else len(observations)
        logits = []
        for start in range(0, len(observations), chunk):
            inputs = as_input(torch.from_numpy(observations[start : start + chunk]).to(device))
            logits.append(torch.stack([network(inputs) for network in networks]))
        return torch.cat(logits, dim=1)

    def state(self) -> dict[str, Tensor]:
        """Weights and BatchNorm statistics by name: contiguous CPU tensors, ready for safetensors."""
        return {name: tensor.detach().cpu().clone().contiguous() for name, tensor in self.state_dict().items()}

    @classmethod
    def from_state(
        cls, network: str, observation_shape: tuple[int, ...], members: int, state: Mapping[str, Tensor]
    ) -> Ensemble:
        """The ensemble that ``state()`` was taken from, in evaluation mode.

        Raises:
            UserError: the state is not one of such an ensemble, or holds NaN or Inf.
        """
        ensemble = cls(network, observation_shape, members, torch.Generator())
        wanted = ensemble.state_dict()
        where = f"network {network!r}, {members} members, observation shape {tuple(observation_shape)}"
        for name in sorted({*wanted, *state}):
            if name not in wanted or name not in state or wanted[name].shape != state[name].shape:
                raise UserError(f"the weights do not fit the ensemble (at {name})", where, "Train it again.")
            if not torch.isfinite(state[name]).all():
                raise UserError(f"the weights hold NaN or Inf (at {name})", where, "Train it again.")
        ensemble.load_state_dict(dict(state))
        return ensemble.eval()

    def _device(self) -> torch.device:
        return next(self.parameters()).device

    def _check(self, observations: NDArray[np.uint8]) -> None:
        if observations.dtype != np.uint8 or observations.shape[1:] != self.observation_shape:
            found = f"{observations.dtype} {observations.shape}"
            wanted = f"uint8 (N, {', '.join(map(str, self.observation_shape))})"
            raise UserError("these are not observations that the ensemble knows", found, f"Give {wanted}.")
