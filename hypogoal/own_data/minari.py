"""Minari datasets: episodes, whose states a function labels. Read as files; the ``minari`` package is not needed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.core.files import read_json
from hypogoal.core.hdf5 import Foreign, find, members, open_hdf5, read_array
from hypogoal.core.seeding import rng_for
from hypogoal.own_data.parts import Parts

MAIN_FILE = Path("data") / "main_data.hdf5"
METADATA = Path("data") / "metadata.json"
DO = "Give the folder of a Minari dataset in the format 'hdf5', for example ~/.minari/datasets/NAME-v0."
SHARES = (0.4, 0.4, 0.2)

Label = Callable[[NDArray[Any]], bool]


def read_minari(
    folder: Path, labels: Sequence[Label], *, key: str = "", shares: Sequence[float] = SHARES, seed: int = 0
) -> Parts:
    """The observations of a dataset's episodes, each episode's either labelled, unlabelled or held out.

    Args:
        folder: of the dataset, the one with ``data/`` in it.
        labels: G functions from an observation to whether the sub-goal holds.
        key: of observations that are dictionaries, which part is the image.
        shares: of the episodes that are labelled, unlabelled and held out.
        seed: of which ones.

    Raises:
        UserError: no such dataset, another storage format, too few episodes, or a label function that fails.
    """
    if not labels:
        raise UserError("a Minari dataset has no labels", folder, "Give --label NAME=module:function.")
    if len(shares) != 3 or min(shares) <= 0:
        raise UserError("no such shares", ",".join(map(str, shares)), "Give three positive numbers.")
    about = read_json(folder / METADATA, "the metadata are", DO)
    stored = about.get("data_format", "hdf5") if isinstance(about, dict) else None
    if stored != "hdf5":
        raise UserError(f"the storage format {stored!r} is not read", folder, DO)
    episodes = _episodes(folder / MAIN_FILE, key)
    if len(episodes) < 3:
        raise UserError(f"{len(episodes)} episodes cannot be labelled, unlabelled and held out", folder, "Give three.")
    order = rng_for(seed, "minari").permutation(len(episodes))
    ends = np.round(np.cumsum(shares)[:2] / sum(shares) * len(episodes)).astype(int)
    ends = np.clip(ends, (1, 2), (len(episodes) - 2, len(episodes) - 1))
    labelled, unlabelled, heldout = (np.concatenate([episodes[i] for i in part]) for part in np.split(order, ends))
    return Parts(labelled, _told(labels, labelled), unlabelled, heldout, _told(labels, heldout))


def _episodes(path: Path, key: str) -> list[NDArray[Any]]:
    with open_hdf5(path, "the dataset", DO) as file:
        try:
            names = [name for name in members(file) if name.startswith("episode_")]
            place = f"observations/{key}" if key else "observations"
            if names and not key and hasattr(find(file, f"{names[0]}/observations"), "keys"):
                keys = ", ".join(members(find(file, f"{names[0]}/observations")))
                raise UserError("its observations are dictionaries", path, f"Give --key, one of {keys}.")
            return [read_array(file, f"{name}/{place}", "uif") for name in sorted(names, key=_number)]
        except Foreign as error:
            raise UserError(f"the dataset cannot be used: {error}", path, DO) from None


def _number(name: str) -> int:
    tail = name.removeprefix("episode_")
    return int(tail) if tail.isdecimal() else -1


def _told(labels: Sequence[Label], observations: NDArray[Any]) -> NDArray[np.bool_]:
    """What the functions say of each observation, bool (N, G)."""
    return np.array([[bool(label(observation)) for label in labels] for observation in observations], np.bool_)
