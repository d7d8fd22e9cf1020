"""Draw what labels leave open: ``python docs/ambiguous.py`` writes docs/ambiguous.png from states of rooms."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from hypogoal.domains.rooms.states import crossed_states, labelled_states

NAMES = ("shape", "place")
SHOWN = 6  # pictures in a row
MARGIN = 4  # pixels of background around a picture, which are left out


def rows() -> dict[str, np.ndarray]:
    """Pictures by what is said of them."""
    labelled = labelled_states(256, 0, NAMES)
    positive = labelled.factors[:, 0]
    crossed = crossed_states(40, 0, NAMES)
    has_shape, has_place = crossed.factors.T
    apart = [crossed.observations[has_shape & ~has_place], crossed.observations[~has_shape & has_place]]
    return {
        "labelled\n“reached”": labelled.observations[positive],
        "labelled\n“not reached”": labelled.observations[~positive],
        "no label:\nwhich is it?": np.concatenate([pictures[: SHOWN // 2] for pictures in apart]),
    }


def draw(path: Path) -> None:
    """Draw a row for each."""
    figure = Figure(figsize=(7.6, 3.75))
    shown = rows()
    places = figure.subplots(len(shown), SHOWN)
    for line, (title, pictures) in zip(places, shown.items(), strict=True):
        for place, picture in zip(line, pictures, strict=False):
            place.imshow(picture[MARGIN:-MARGIN, MARGIN:-MARGIN], interpolation="nearest")
            place.set(xticks=[], yticks=[])
            place.spines[:].set_visible(False)
        line[0].set_ylabel(title, rotation=0, ha="right", va="center", fontsize=11, labelpad=10)
    figure.subplots_adjust(left=0.19, right=0.995, top=0.995, bottom=0.005, wspace=0.05, hspace=0.06)
    figure.savefig(path, dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    draw(Path(__file__).with_name("ambiguous.png"))
