"""An ensemble of K members, and its file. Each member is a hypothesis about the features that make a sub-goal."""

import copy
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from hypogoal.core.arrays import Bools, Floats
from hypogoal.core.errors import UserError
from hypogoal.core.tensors import load_fitting, load_tensors, save_tensors
from hypogoal.hypotheses import deep_lift, networks, patches, views
from hypogoal.hypotheses.thresholds import log_odds_of
from hypogoal.observations import NUMBERS, Observations, Shape, numbers_of, packed, type_of, type_text, values_in

THRESHOLD = 0.5  # the probability above which a prediction is positive, unless another threshold is set
IMAGES_AT_ONCE = 64  # images in a plain forward pass that fit a CPU's cache; a GPU takes 16 times as many
PATCH_CHUNK = 4096  # images in a pass if they have few distinct patches
FOLD_FROM = 32  # from this number of images on, folding BatchNorm into the convolutions pays
PATCHES_FROM = 256  # from this number of images on, looking for distinct patches pays

if os.name == "posix":  # torch would wait for ever for its parent's threads, which a forked process does not have
    os.register_at_fork(after_in_child=partial(torch.set_num_threads, 1))


@contextmanager
def predicting(device: torch.device) -> Iterator[None]:
    """Turn gradients and autocast off within the block, so that predictions are computed in float32."""
    kind = "cuda" if device.type == "cuda" else "cpu"
    with torch.inference_mode(), torch.autocast(kind, enabled=False):
        yield


class Ensemble(nn.Module):
    """K member networks of one sub-goal.

    A new ensemble has random weights, which a ``training.EnsembleTraining`` trains.

    Args:
        network: the name of a network in ``networks.NETWORKS``.
        observation_shape: the shape of one observation, (H, W, C) for pictures.
        members: K, the number of members, at least 1.
        generator: the random generator that draws the initial weights.
        view: what members see of an observation. With None, members see a whole picture.

    Attributes:
        members: K ``nn.Sequential``, each a function from ``networks.inputs_of`` the view (for pictures float (N, C, h,
            w) in 0..1) to logits (N, 2).
        networks: the members with their layers in the fastest order. They share weights and BatchNorm statistics with
            ``members``.
        thresholds: float32 (K,), the probabilities above which the members' predictions are positive.

    Raises:
        UserError: if the network is unknown, or if images are too small for it.
    """

    thresholds: Tensor

    def __init__(
        self,
        network: str,
        observation_shape: Shape,
        members: int,
        generator: torch.Generator,
        view: views.View | None = None,
    ):
        super().__init__()
        self.observation_shape = tuple(observation_shape)
        self.view = view or views.FullView(self.observation_shape)
        shape, dtype = self.view.shape, self.view.dtype
        self.network = networks.network_for(network, shape, dtype)
        built = [networks.build_network(self.network, shape, generator, dtype) for _ in range(members)]
        weights = []
        for member in built:
            weights += [*member.parameters(), *member.buffers()]
        if len({*weights}) < len(weights):
            raise UserError(
                "two members share weights",
                self.network,
                "Make new layers at every call, with weights from PyTorch's generator.",
            )
        self.members = nn.ModuleList(built)
        self.networks = tuple(map(networks.reordered, built))
        self.register_buffer("thresholds", torch.full((members,), THRESHOLD))
        self.train()

    def __repr__(self) -> str:
        kind = type_text(self.view.dtype)
        return f"Ensemble({len(self)} members, network {self.network!r}, observations {kind} {self.observation_shape})"

    def __len__(self) -> int:
        """Return K, the number of members."""
        return len(self.members)

    def thresholds_as_log_odds(self) -> Floats:
        """Return the thresholds as log-odds, float32 (K,). Up to rounding, predictions by log-odds do not differ."""
        return log_odds_of(self.thresholds.cpu().numpy()).astype(np.float32)

    def see(self, observations: Observations) -> Any:
        """Return what the members see of observations.

        Members see pictures uint8 (N, H, W, C) as uint8 (N, h, w, C). They see numbers as float32 (N, *shape),
        standardised. They see mixed observations as an array (N,) with a field for each key, in which the numbers are
        standardised.

        Args:
            observations: N observations, as for :meth:`predict`.

        Returns:
            The N observations in the shape and type of the members' view.

        Raises:
            UserError: if the observations have another shape or type than in training, or numbers that are not finite.
        """
        dtype = self.view.dtype
        expected = f"{type_text(dtype)} (N, {', '.join(map(str, self.observation_shape))})"
        try:
            with np.errstate(over="ignore"):  # numbers that float32 cannot hold are refused below
                if dtype.names and isinstance(observations, Mapping):
                    observations = packed(observations, dtype)
                observations = np.asarray(observations)
                if dtype == NUMBERS and observations.dtype == float:
                    observations = observations.astype(NUMBERS)
            if observations.dtype != dtype or observations.shape[1:] != self.observation_shape:
                raise ValueError(f"{observations.dtype} {observations.shape}")
        except ValueError as error:  # also raised for other keys, and for states of different shapes
            raise UserError("these observations do not fit the ensemble", error, f"Give {expected}.") from None
        are_finite = np.isfinite(numbers_of(observations)).all(axis=1)
        if not are_finite.all():
            fault = "observations have numbers that are not finite in float32"
            raise UserError(fault, f"state {are_finite.argmin()}", "Clip or replace them.")
        return np.ascontiguousarray(self.view.see(observations))  # torch takes no flipped arrays

    def predictions(self, observations: Observations) -> Bools:
        """Return whether the sub-goal holds according to every member, bool (N, K).

        Takes the observations that :meth:`predict` takes, and raises ``UserError`` where :meth:`predict` does. If a
        probability is within rounding of its threshold, about 1e-6, the prediction may depend on the other states of
        the call.
        """
        return self.predict(observations) > self.thresholds.cpu().numpy()

    def predict(self, observations: Observations) -> Floats:
        """Return every member's probability that the sub-goal holds.

        Args:
            observations: uint8 (N, H, W, C) for pictures, or float32 (N, ...) of the shape used in training, or a list
                of N observations. Mixed observations are a dictionary of such arrays.

        Returns:
            float32 (N, K). Up to rounding, the probabilities of a state do not depend on the other states.

        Raises:
            UserError: if the observations have another shape or type than in training, or numbers that are not finite.
        """
        both = torch.from_numpy(self.logits(observations))
        return np.asarray(both.softmax(dim=-1)[..., 1])

    def log_odds(self, observations: Observations) -> Floats:
        """Return every member's log-odds that the sub-goal holds, float32 (N, K).

        Takes the observations that :meth:`predict` takes, and raises ``UserError`` where :meth:`predict` does.
        """
        both = self.logits(observations)
        return both[..., 1] - both[..., 0]

    def logits(self, observations: Observations) -> Floats:
        """Return every member's logits for negative and positive, float32 (N, K, 2).

        Takes the observations that :meth:`predict` takes, and raises ``UserError`` where :meth:`predict` does.
        """
        seen = self.see(observations)
        device = self.thresholds.device
        size = PATCH_CHUNK if device.type == "cpu" else IMAGES_AT_ONCE * 16
        logits = np.empty((len(seen), len(self), 2), np.float32)
        was_training = self.training
        self.eval()
        with predicting(device):
            for start in range(0, len(seen), size):
                part = self._logits(seen[start : start + size])
                logits[start : start + size] = part.transpose(0, 1).cpu().numpy()
        self.train(was_training)
        return logits

    def attributions(
        self,
        observations: Observations,
        against: Observations,
    ) -> Floats:
        """Return what each member looks at in the observations (Figure 2), see :mod:`hypogoal.hypotheses.deep_lift`.

        A state's attributions sum to the state's log-odds minus the log-odds of the baseline. For mixed observations
        the attributions are an array (N, K), with a field for each key.

        Args:
            observations: the N observations to explain, as for :meth:`predict`.
            against: other observations, for example unlabelled ones. Their mean is the baseline.

        Returns:
            float32 (N, K, H, W, C) for pictures, else (N, K, *the shape of the view), in log-odds.

        Raises:
            UserError: if the observations have another shape or type than in training, or numbers that are not finite.
        """
        seen = self.see(observations)
        baseline = deep_lift.mean_state(self.see(against))
        fixed = copy.deepcopy(self).cpu().eval()
        values = deep_lift.attributed(fixed, seen, baseline).values.astype(np.float32)
        return deep_lift.by_key(values, self.view.dtype) if self.view.dtype.names else values

    def _logits(self, observations: Observations) -> Tensor:
        """Return logits (K, N, 2). Each distinct patch is computed once if that is faster."""
        members, device = self.networks, self.thresholds.device
        count = size = len(observations)
        if device.type == "cpu" and count >= PATCHES_FROM:
            tables = patches.make_tables(members[0], observations)
            if tables is not None:
                batch = patches.take(tables, np.arange(count))
                return torch.stack([patches.forward(member, batch) for member in members])
        if count >= FOLD_FROM:
            members = tuple(map(networks.folded, members))
        if device.type == "cpu":
            size = networks.at_once(
                IMAGES_AT_ONCE,
                (values_in(observations.shape[1:], observations.dtype),),
            )
        logits = []
        for start in range(0, count, size):
            inputs = networks.inputs_of(observations[start : start + size], device)
            logits.append(torch.stack([member(inputs) for member in members]))
        return torch.cat(logits, dim=1)


def together(ensembles: Sequence[Ensemble]) -> Ensemble | None:
    """Join ensembles with one network: return an ensemble of all their members, in order.

    Returns None if any of the ensembles has a view of its own or standardises numbers.
    """
    first = ensembles[0]
    if any(type(each.view) is not views.FullView or each.view.standard is not None for each in ensembles):
        return None
    every = Ensemble(first.network, first.observation_shape, 0, torch.Generator(), first.view)
    for each in ensembles:
        every.members.extend(each.members)
        every.networks += each.networks
    every.thresholds = torch.cat([each.thresholds for each in ensembles])
    return every.eval()


def write_ensemble(
    folder: Path,
    sub_goal: str,
    ensemble: Ensemble,
) -> None:
    """Write ``ensemble`` to ``<sub-goal>.safetensors`` in ``folder``."""
    save_tensors(folder / f"{sub_goal}.safetensors", ensemble.state_dict())


def read_ensemble(
    folder: Path,
    config: Mapping[str, Any],
    sub_goal: str,
) -> Ensemble:
    """Return the ensemble of one sub-goal, ready to predict.

    ``folder`` is the folder of an ensemble artefact, and ``config`` is the configuration in the artefact's manifest.
    Raises ``UserError`` if the sub-goal is unknown, or if the weights are missing or damaged.
    """
    if sub_goal not in config["sub_goals"]:
        raise UserError(
            "unknown sub-goal",
            sub_goal,
            f"{folder} has {', '.join(config['sub_goals'])}.",
        )
    path = folder / f"{sub_goal}.safetensors"
    state = load_tensors(path)
    try:
        shape = tuple(config["observation_shape"])
        dtype = type_of(config["observation_dtype"])
        view = views.view_of(config["view"], config.get("view_settings", ()), shape, dtype)
        make = partial(Ensemble, config["network"], shape, config["members"], torch.Generator(), view)
        return load_fitting(make, state, str(path)).eval()
    except (RuntimeError, KeyError, IndexError, TypeError, ValueError):
        raise UserError(
            "the weights do not fit the manifest",
            path,
            "Train the ensemble again.",
        ) from None
