"""A success classifier as rewards are learned from, taught without hypogoal: does the agent hold the red key?

Shows what `hypogoal audit` takes. It is taught when it is loaded, some 6 s of CPU; docs/audit.md audits it.
"""

import numpy as np
import torch
from torch import nn

from hypogoal.domains.doorkey.engine import DoorKeyEngine


def played(layouts: range, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """What random play sees, each picture once, uint8 (N, 64, 64, 3), and whether the red key is held, float (N,)."""
    pictures, labels = [], []
    for layout in layouts:
        engine, rng = DoorKeyEngine(layout, 64, max_steps=80), np.random.default_rng([layout, seed])
        ids = np.unique([engine.step(rng.choice((0, 1, 2, 2, 2, 3, 5), 64)).next_ids for _ in range(80)])
        pictures.append(torch.from_numpy(engine.images(ids)))
        labels.append(torch.from_numpy(engine.labels(ids)[:, 2]).float())
    return torch.cat(pictures), torch.cat(labels)


def classify(observations: np.ndarray) -> np.ndarray:
    """Probabilities of success (N,) of pictures uint8 (N, 64, 64, 3)."""
    return logits(torch.from_numpy(observations)).sigmoid().detach().numpy()


torch.manual_seed(0)
hidden = (nn.Conv2d(3, 16, 5, 4), nn.ReLU(), nn.Conv2d(16, 32, 3, 2), nn.ReLU(), nn.Flatten())
network = nn.Sequential(*hidden, nn.Linear(32 * 49, 1))
logits, optimiser = lambda x: network(x.permute(0, 3, 1, 2) / 255)[:, 0], torch.optim.Adam(network.parameters(), 1e-3)
pictures, labels = played(range(16), seed=0)
for batch in torch.randint(len(labels), (300, 64)):
    optimiser.zero_grad()
    nn.functional.binary_cross_entropy_with_logits(logits(pictures[batch]), labels[batch]).backward()
    optimiser.step()
if __name__ == "__main__":  # how often is it right in layouts that it does not know?
    pictures, labels = played(range(900, 910), seed=1)
    print(f"{((logits(pictures) > 0) == (labels > 0.5)).float().mean():.1%} of {len(labels)} pictures")
