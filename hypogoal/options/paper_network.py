"""The paper's network of an option, and how it sees images that are made of few distinct patches."""

import math
from collections.abc import MutableMapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from hypogoal.core.arrays import Bytes
from hypogoal.hypotheses import patches

LINE = 64  # bytes of a cache line: torch's tensors begin at a multiple of it, and NumPy's arrays need not
OF_IMAGES = "gru.weight_ih_l0"  # the name in nn.GRU, and in files, of the weights that multiply images


@dataclass(frozen=True)
class Pieces:
    """Images as distinct pairs of a place and a patch, so that a sum over an image's places is a sum over its pairs.

    Attributes:
        batch: the patches of the images.
        patch: int64 (P,), the patch of each of P pairs, in the order of their places.
        counts: for each place, the number of pairs that have the place.
        among: float32 (N, P), 1 where an image has a pair, and 0 elsewhere.
    """

    batch: patches.PatchBatch
    patch: Tensor
    counts: list[int]
    among: Tensor


class PaperQNetwork(nn.Module):
    """The paper's network: convolution, BatchNorm, ReLU and pooling, twice, then a GRU and two dense layers.

    The paper gives no sizes. 16 and 32 channels, kernels of 3 and a GRU of 512 units are in the authors' public code
    (AnitadeMelloKoch/portable_options, ``cnn_q_function.py``). ReLU comes after pooling, because that computes the same
    function at less cost.
    """

    HIDDEN = 512
    CHANNELS = 32

    def __init__(self, observation_shape: tuple[int, ...], actions: int):
        super().__init__()
        height, width, depth = observation_shape
        self.features = nn.Sequential(
            nn.Conv2d(depth, 16, 3),
            nn.BatchNorm2d(16),
            nn.MaxPool2d(2),
            nn.ReLU(),
            nn.Conv2d(16, self.CHANNELS, 3),
            nn.BatchNorm2d(self.CHANNELS),
            nn.MaxPool2d(2),
            nn.ReLU(),
        )
        places = math.prod(((side - 2) // 2 - 2) // 2 for side in (height, width))
        weights = dict(nn.GRU(self.CHANNELS * places, self.HIDDEN).named_parameters())
        # Weights are kept place by place. In nn.GRU's order, every product with a place's weights would copy them.
        self.looks = nn.Parameter(by_place(weights.pop("weight_ih_l0").detach(), self.CHANNELS).contiguous())
        self.gru = nn.ParameterDict(weights)
        self.values = nn.Sequential(
            nn.Linear(self.HIDDEN, 128),
            nn.ReLU(),
            nn.Linear(128, actions),
        )
        self.register_load_state_dict_pre_hook(_take_those_of_a_file)

    def see(self, images: Tensor | Pieces) -> Tensor:
        """Return what the GRU's gates take from each image, float32 (N, 3 * ``HIDDEN``).

        ``images`` are uint8 (N, H, W, C), or their pieces. This is nearly all of the arithmetic. It is done once for an
        image that is in many windows, which ``nn.GRU`` cannot do.
        """
        bias = self.gru["bias_ih_l0"]
        if isinstance(images, Pieces):
            contents = patches.forward(self.features, images.batch).index_select(0, images.patch)
            products = ProductsOfPlaces.apply(contents, self.looks, images.counts)
            return torch.addmm(bias, images.among, products)
        features = self.features(images.permute(0, 3, 1, 2).float() / 255.0)
        placed = features.permute(0, 2, 3, 1).flatten(1)
        return torch.addmm(bias, placed, self.looks.flatten(0, 1))

    def pieces_of(self, images: Bytes) -> Pieces:
        """Return the pieces of images uint8 (N, H, W, C) that repeat a few tiles. :meth:`see` computes a piece once."""
        windows = patches.windows_of(self.features)
        assert windows
        batch = patches.take(patches.tables_of(images, windows), np.arange(len(images)))
        places, distinct = batch.last.shape[1], len(batch.parts[-1])
        pairs, ranks = torch.unique(batch.last + distinct * torch.arange(places), return_inverse=True)
        counts = (pairs // distinct).bincount(minlength=places)
        among = torch.zeros(len(images), len(pairs)).scatter_(1, ranks, 1.0)
        return Pieces(batch, pairs % distinct, counts.tolist(), among)

    def forward(
        self,
        seen: Tensor,
        windows: Tensor,
        lengths: Tensor,
    ) -> Tensor:
        """Return the values, float32 (n, A), in the last states of windows.

        ``seen`` is what :meth:`see` returned. ``windows``, int64 (n, T), are the indices of each window's images there.
        Only the first ``lengths`` (n,) of a window's T places are real.
        """
        state = seen.new_zeros(len(windows), self.HIDDEN)
        for place, images in enumerate(windows.unbind(1)):
            (real,) = (lengths > place).nonzero(as_tuple=True)
            following = self._next(seen.index_select(0, images[real]), state.index_select(0, real))
            state = state.index_copy(0, real, following)
        return self.values(state)

    def _next(self, seen: Tensor, state: Tensor) -> Tensor:
        """Return the GRU's state (n, ``HIDDEN``) after one more image, by the equations of ``nn.GRU``."""
        remembered = linear(state, self.gru["weight_hh_l0"], self.gru["bias_hh_l0"])
        reset_of_image, update_of_image, new_of_image = seen.chunk(3, dim=1)
        reset_of_state, update_of_state, new_of_state = remembered.chunk(3, dim=1)
        reset = (reset_of_image + reset_of_state).sigmoid()
        update = (update_of_image + update_of_state).sigmoid()
        new = (new_of_image + reset * new_of_state).tanh()
        return torch.lerp(new, state, update)

    def tensors(self) -> dict[str, Tensor]:
        """Return all weights, by the names and in the order of ``nn.GRU``, as files have them."""
        tensors = self.state_dict()
        looks = tensors.pop("looks")
        return {**tensors, OF_IMAGES: looks.permute(2, 1, 0).flatten(1)}


class ProductsOfPlaces(torch.autograd.Function):
    """The products of each place's contents and weights.

    Autograd would compute the same bytes from the loop in ``forward``. But it gives each place's weights a gradient of
    their own and then copies all gradients into one, which took a tenth to a quarter of an update.
    """

    @staticmethod
    def forward(ctx: Any, contents: Tensor, looks: Tensor, counts: list[int]) -> Tensor:
        """Return the products, float32 (P, 3 * hidden).

        ``contents`` are (P, channels), in the order of their places, and ``counts`` says how many each place has.
        ``looks`` are the weights, (places, channels, 3 * hidden).
        """
        ctx.save_for_backward(contents, looks)
        ctx.counts = counts
        products = contents.new_empty(len(contents), looks.shape[2])
        for rows, weight, out in zip(contents.split(counts), looks, products.split(counts), strict=True):
            torch.mm(rows, weight, out=out)
        return products

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:
        """Return the gradients of the contents and of the weights."""
        contents, looks = ctx.saved_tensors
        of_contents = torch.empty_like(contents)
        of_looks = in_large_pages(looks.shape)
        pieces = [each.split(ctx.counts) for each in (contents, gradients[0], of_contents)]
        for rows, gradient, of_rows, weight, of_weight in zip(*pieces, looks, of_looks, strict=True):
            torch.mm(gradient, weight.T, out=of_rows)
            torch.mm(rows.T, gradient, out=of_weight)
        return of_contents, of_looks, None


def by_place(weight: Tensor, channels: int) -> Tensor:
    """Reorder weights of ``nn.GRU``, (3 * hidden, channels * places), to (places, channels, 3 * hidden)."""
    return weight.unflatten(1, (channels, -1)).permute(2, 1, 0)


def _take_those_of_a_file(network: PaperQNetwork, weights: MutableMapping[str, Any], *_of: object) -> None:
    """Put weights that are in a file's order into the network's order, before the network loads them."""
    if OF_IMAGES in weights:
        weights["looks"] = by_place(weights.pop(OF_IMAGES), network.CHANNELS)


def in_large_pages(shape: Sequence[int]) -> Tensor:
    """Return a float32 tensor whose values are arbitrary. If it is large, Linux may give it pages of 2 MB.

    The system clears each page of new memory. With pages of 4 kB that takes several times as long. NumPy asks for large
    pages, while torch asks for them for all tensors or for none.
    """
    size = math.prod(shape)
    spare = LINE // np.dtype(np.float32).itemsize
    memory = np.empty(size + spare, np.float32)
    first = -memory.ctypes.data % LINE // memory.itemsize
    return torch.from_numpy(memory[first : first + size]).view(*shape)
