"""Adam (Kingma and Ba, 2015) by the function that ``torch.optim.Adam`` calls, so that weights get the same bytes.

``torch.optim.Adam`` itself imports torch's compiler, which takes over a second in every process that learns.
"""

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor
from torch.optim.adam import adam


class Adam:
    """An optimiser that changes weights by their gradients, as ``torch.optim.Adam(weights, lr, fused=True)`` does.

    Args:
        weights: the weights, of any shapes. Weights without a gradient stay as they are.
        lr: the step size, which may be changed later.
        eps: a number that is added to the root of the mean square.
        weight_decay: this number times a weight is added to the gradient of the weight.
    """

    def __init__(self, weights: Iterable[Tensor], lr: float, eps: float = 1e-8, weight_decay: float = 0.0):
        self.weights = [*weights]
        self.lr, self.eps, self.weight_decay = lr, eps, weight_decay
        # Running means of the gradients, and of their squares.
        self.means = [torch.zeros_like(weight) for weight in self.weights]
        self.squares = [torch.zeros_like(weight) for weight in self.weights]
        self.steps = [torch.zeros((), device=weight.device) for weight in self.weights]

    def zero_grad(self) -> None:
        """Forget all gradients."""
        for weight in self.weights:
            weight.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Change the weights by their gradients."""
        every = zip(self.weights, self.means, self.squares, self.steps, strict=True)
        changed = [state for state in every if state[0].grad is not None]
        weights, means, squares, steps = map(list, zip(*changed, strict=True))
        adam(
            weights,
            [weight.grad for weight in weights],
            means,
            squares,
            [],  # the largest squares, which only the variant amsgrad has
            steps,
            fused=True,
            amsgrad=False,
            beta1=0.9,
            beta2=0.999,
            lr=self.lr,
            weight_decay=self.weight_decay,
            eps=self.eps,
            maximize=False,
        )

    def state_dict(self) -> dict[str, Any]:
        """Return what changes with the steps, by name."""
        return {"means": self.means, "squares": self.squares, "steps": self.steps}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on with ``state``, which :meth:`state_dict` returned."""
        for name, tensors in self.state_dict().items():
            for tensor, saved in zip(tensors, state[name], strict=True):
                tensor.copy_(saved)
