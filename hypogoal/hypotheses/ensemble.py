"""An ensemble of K members, each a hypothesis about the features that make a sub-goal, and its file."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hypogoal.core.errors import UserError
from hypogoal.core.tensors import load_fitting, load_tensors, save_tensors
from hypogoal.hypotheses import patches
from hypogoal.hypotheses.config import FULL
from hypogoal.hypotheses.networks import (
    NETWORKS,
    as_input,
    as_tensor,
    at_once,
    build_network,
    folded,
    names_in,
    network_for,
    reordered,
)
from hypogoal.hypotheses.views import FullView, View, own_view, standard_shape
from hypogoal.observations import NUMBERS, PICTURE, Observations, packed, type_of, type_text, values_in

THRESHOLD = 0.5  # of the probability, unless another is set
IMAGES_AT_ONCE = 64  # in a plain forward pass, to fit a CPU's cache; on a GPU 16 times as many
PATCH_CHUNK = 4096  # images with few distinct patches
FOLD_FROM = 32  # images from which folding BatchNorm into the convolutions pays
PATCHES_FROM = 256  # images from which looking for distinct patches pays
NO_OBSERVATIONS = "these observations do not fit the ensemble"


class Ensemble(nn.Module):
    """K member networks of one sub-goal with fresh weights; ``training.fit`` trains them.

    Args:
        network: a name in ``networks.NETWORKS``.
        observation_shape: of one observation, (H, W, C) for pictures.
        members: K, at least 1.
        generator: draws the initial weights.
        view: what members see of an observation; None: a whole picture.

    Attributes:
        members: K ``nn.Sequential``, from ``networks.as_input`` of the view (for pictures float (N, C, h, w) in 0..1)
            to logits (N, 2).
        networks: the members with their layers in the fastest order; weights and BatchNorm statistics are shared.
        thresholds: float32 (K,), the probabilities above which members' predictions are positive.

    Raises:
        UserError: unknown network, or images too small for it.
    """

    thresholds: Tensor

    def __init__(
        self,
        network: str,
        observation_shape: tuple[int, ...],
        members: int,
        generator: torch.Generator,
        view: View | None = None,
    ):
        super().__init__()
        self.observation_shape = tuple(int(size) for size in observation_shape)
        self.view = view or FullView(self.observation_shape)
        self.network = network = network_for(network, self.view.dtype)
        shape, dtype = self.view.shape, self.view.dtype
        built = [build_network(network, shape, generator, dtype) for _ in range(members)]
        self.members = nn.ModuleList(built)
        self.networks = tuple(reordered(member) for member in built)
        self.register_buffer("thresholds", torch.full((members,), THRESHOLD))
        self.train()

    def __repr__(self) -> str:
        observations = f"observations {type_text(self.view.dtype)} {self.observation_shape}"
        return f"Ensemble({len(self)} members, network {self.network!r}, {observations})"

    def __len__(self) -> int:
        """K, the number of members."""
        return len(self.members)

    def thresholds_as_log_odds(self) -> NDArray[np.float32]:
        """The thresholds (K,) as log-odds, with the same predictions up to rounding."""
        probabilities = self.thresholds.cpu().numpy().astype(np.float64)
        log_odds: NDArray[np.float32] = (np.log(probabilities) - np.log1p(-probabilities)).astype(np.float32)
        return log_odds

    def set_thresholds(self, thresholds: NDArray[np.float32]) -> None:
        """Set the probabilities (K,) above which predictions are positive."""
        self.thresholds.copy_(torch.from_numpy(thresholds))

    def see(self, observations: Observations) -> Any:
        """The members' view of observations uint8 (N, H, W, C): uint8 (N, h, w, C); see :meth:`predict`.

        For observations other than pictures: float32 (N, *shape), standardised; mixed ones (N,), their numbers so.
        """
        if self.view.dtype.names and isinstance(observations, Mapping):
            try:
                observations = packed(observations, self.view.dtype)
            except ValueError as error:
                do = f"Give arrays (N, ...) by key: {type_text(self.view.dtype)}."
                raise UserError(NO_OBSERVATIONS, error, do) from None
        try:
            observations = np.asarray(observations)
        except ValueError:  # of different shapes
            raise UserError(NO_OBSERVATIONS, "they differ in shape", f"Give {self.view.dtype} (N, ...).") from None
        if self.view.dtype == NUMBERS and observations.dtype == np.float64:
            observations = observations.astype(NUMBERS)
        if observations.dtype != self.view.dtype or observations.shape[1:] != self.observation_shape:
            kind = f"{observations.dtype} {observations.shape}"
            expected = f"{type_text(self.view.dtype)} (N, {', '.join(map(str, self.observation_shape))})"
            raise UserError(NO_OBSERVATIONS, kind, f"Give {expected}.")
        return np.ascontiguousarray(self.view.see(observations))  # torch takes no flipped arrays

    def predictions(self, observations: Observations) -> NDArray[np.bool_]:
        """Every member's prediction, whether the sub-goal holds: bool (N, K); see :meth:`predict`.

        Within rounding of its threshold, some 1e-6, a prediction may depend on the other states of the call.
        """
        positive: NDArray[np.bool_] = self.predict(observations) > self.thresholds.cpu().numpy()
        return positive

    def predict(self, observations: Observations) -> NDArray[np.float32]:
        """Every member's probability that the sub-goal holds.

        Args:
            observations: uint8 (N, H, W, C), or float32 of any shape, as in training; or a list of N. Mixed ones: a
                dictionary of such arrays.

        Returns:
            float32 (N, K). Up to rounding, a state's row does not depend on the others.

        Raises:
            UserError: observations of another shape or type.
        """
        both = torch.from_numpy(self.logits(observations))
        probabilities: NDArray[np.float32] = both.softmax(dim=-1)[..., 1].numpy()
        return probabilities

    def log_odds(self, observations: Observations) -> NDArray[np.float32]:
        """Every member's log-odds that the sub-goal holds: float32 (N, K); see :meth:`predict`."""
        both = self.logits(observations)
        gaps: NDArray[np.float32] = both[..., 1] - both[..., 0]
        return gaps

    def logits(self, observations: Observations) -> NDArray[np.float32]:
        """Every member's logits of negative and positive: float32 (N, K, 2); see :meth:`predict`."""
        observations = self.see(observations)
        was_training = self.training
        if was_training:
            self.eval()
        logits = np.empty((len(observations), len(self), 2), dtype=np.float32)
        chunk = PATCH_CHUNK if self.thresholds.device.type == "cpu" else IMAGES_AT_ONCE * 16
        with torch.inference_mode():
            for start in range(0, len(observations), chunk):
                part = self._logits(observations[start : start + chunk])
                logits[start : start + chunk] = part.transpose(0, 1).cpu().numpy()
        if was_training:
            self.train()
        return logits

    def attributions(self, observations: Observations, against: Observations) -> NDArray[np.float32]:
        """Spec F2, Figure 2: what each member looks at in observations, see :mod:`hypogoal.hypotheses.deep_lift`.

        The baseline is the mean of ``against``: other observations, for example unlabelled ones. Returns float32
        (N, K, *the shape of the view; (H, W, C) for pictures) in log-odds: a state's sum is its log-odds minus the
        baseline's. Of mixed observations (N, K), with a field for each key. ``UserError`` as for :meth:`predict`, or
        without states.
        """
        from hypogoal.hypotheses.deep_lift import AT_ONCE, attributed, by_key, mean_state

        if not (len(observations) and len(against)):
            raise UserError("attributions need states, and others to compare with", None, "Give one or more of each.")
        seen, baseline, fixed = self.see(observations), mean_state(self.see(against)), copy.deepcopy(self).cpu().eval()
        parts = (seen[start : start + AT_ONCE] for start in range(0, len(seen), AT_ONCE))
        values = np.concatenate([attributed(fixed, part, baseline).values.astype(np.float32) for part in parts])
        return by_key(values, self.view.dtype) if self.view.dtype.names else values

    def _logits(self, observations: Observations) -> Tensor:
        """Logits (K, N, 2); computes each distinct patch once if that pays."""
        networks, device = self.networks, self.thresholds.device
        if device.type == "cpu" and len(observations) >= PATCHES_FROM:
            tables = patches.make_tables([observations], networks[0])
            if tables is not None:
                batch = patches.take(tables, np.arange(len(observations)))
                return torch.stack([patches.forward(network, batch) for network in networks])
        if len(observations) >= FOLD_FROM:
            networks = tuple(map(folded, networks))
        size = (values_in(observations.shape[1:], observations.dtype),)
        chunk = at_once(IMAGES_AT_ONCE, size) if device.type == "cpu" else len(observations)
        logits = []
        for start in range(0, len(observations), chunk):
            inputs = as_input(as_tensor(observations[start : start + chunk]).to(device), observations.dtype)
            logits.append(torch.stack([network(inputs) for network in networks]))
        return torch.cat(logits, dim=1)

    def state(self) -> dict[str, Tensor]:
        """Weights and BatchNorm statistics by name, as contiguous CPU tensors for safetensors."""
        return {name: tensor.detach().cpu().clone().contiguous() for name, tensor in self.state_dict().items()}

    @classmethod
    def from_state(
        cls,
        network: str,
        observation_shape: tuple[int, ...],
        members: int,
        state: Mapping[str, Tensor],
        view: View | None = None,
    ) -> Ensemble:
        """The ensemble with this ``state()``, in evaluation mode; a ``UserError`` if it does not fit."""
        where = f"network {network!r}, {members} members, observation shape {tuple(observation_shape)}"
        numbers = {name.split(".")[1] for name in state if name.startswith("members.")}
        if len(numbers) != members:
            fault = f"the weights do not fit the ensemble (of {len(numbers)} members)"
            raise UserError(fault, where, "Train it again.")

        def make() -> Ensemble:
            return cls(network, observation_shape, members, torch.Generator(), view)

        return load_fitting(make, state, where, custom=not NETWORKS.keys() >= {*names_in(network)}).eval()


def write_ensemble(folder: Path, sub_goal: str, ensemble: Ensemble) -> None:
    """Write ``<sub-goal>.safetensors`` to ``folder``."""
    save_tensors(folder / f"{sub_goal}.safetensors", ensemble.state())


def read_ensemble(folder: Path, config: Mapping[str, Any], sub_goal: str) -> Ensemble:
    """One sub-goal's ensemble, from an ensemble artefact's folder and its manifest's configuration.

    An unknown sub-goal, or missing or damaged weights, are a ``UserError``.
    """
    if sub_goal not in config["sub_goals"]:
        raise UserError("unknown sub-goal", sub_goal, f"{folder} has {', '.join(config['sub_goals'])}.")
    path = folder / f"{sub_goal}.safetensors"
    state = load_tensors(path)
    try:
        shape = tuple(config["observation_shape"])
        view = _view(shape, config, state)
        return Ensemble.from_state(config["network"], shape, config["members"], state, view)
    except (RuntimeError, KeyError, IndexError, TypeError, ValueError):
        raise UserError("the weights do not fit the manifest", path, "Train the ensemble again.") from None


def _view(observation_shape: tuple[int, ...], config: Mapping[str, Any], state: Mapping[str, Tensor]) -> View:
    """The view that the settings ask for, without its weights."""
    dtype = type_of(config["observation_dtype"])
    if dtype != PICTURE:
        size = standard_shape(observation_shape, dtype)
        if not prod(size):
            return FullView(observation_shape, None, dtype)
        mean, deviation = (state[f"view.{name}"].numpy() for name in ("mean", "deviation"))
        if mean.shape != size:  # a damaged manifest may ask for terabytes
            raise ValueError(observation_shape)
        return FullView(observation_shape, (mean, deviation), dtype)
    if config["view"] == FULL:
        return FullView(observation_shape)
    return own_view(config["view"], config["view_settings"], observation_shape)
