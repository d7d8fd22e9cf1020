r"""Is the lamp on? Pictures of one's own and no environment, from two arrays to a report. A minute on one core.

In the labelled room the window is bright whenever the lamp is on, so the labels cannot tell which of the two is meant.
Unlabelled pictures of other rooms make the members differ: one goes by the lamp and the other by the window.

    python own_pictures.py
    hypogoal import pictures.npz --out runs/lamp/data.h5
    hypogoal train-ensemble runs/lamp/data.h5 --out runs/lamp/ensemble --diversity independent \
        --members 2 --set schedule=simultaneous --set steps=100
    hypogoal evaluate runs/lamp
    hypogoal report runs/lamp

"Lamp or window" and "lamp and window" fit the labels as well, and differ as often as lamp and window do. D-BAT, the
default, finds these two here. Independent members are not "or" and "and", because whoever says "and" says "or".
"""

import numpy as np

SIZE = 48  # pixels of a side


def pictures(lamp: np.ndarray, window: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Rooms, uint8 (N, SIZE, SIZE, 3), of whether the lamp is on and whether the window is bright, bool (N,) each."""
    rooms = rng.integers(0, 60, size=(len(lamp), SIZE, SIZE, 3), dtype=np.uint8)
    rooms[lamp, 8:20, 8:20] = (255, 220, 80)
    rooms[window, 24:44, 26:44] = (140, 190, 255)
    return rooms


rng = np.random.default_rng(0)
taught = np.arange(200) % 2 == 0
elsewhere, heldout = (rng.random((2, 400)) < 0.5 for _ in range(2))
np.savez(
    "pictures.npz",
    observations=pictures(taught, taught, rng),
    labels=taught,
    unlabelled=pictures(*elsewhere, rng),
    heldout_observations=pictures(*heldout, rng),
    heldout_labels=heldout[0],  # the lamp is what was meant
    sub_goals=["lamp-on"],
)
