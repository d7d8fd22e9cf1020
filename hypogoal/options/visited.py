"""States that a policy visited while it learned, kept to train ensembles with."""

from hashlib import blake2b
from pathlib import Path

import numpy as np

from hypogoal.core.arrays import Ints
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.checkpoints import Resumable
from hypogoal.core.config import Values
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import seed_for
from hypogoal.data import Collected, Dataset, States, open_dataset, write_dataset
from hypogoal.domains.base import Engine
from hypogoal.observations import Observations

VISITED = "visited.h5"


class Visited(Resumable):
    """A uniform sample of the distinct states visited: the states with the smallest hashes (a bottom-k sketch).

    Whether a state is kept depends neither on when nor on how often it was visited, and no random numbers are drawn.
    At most ``most`` states are kept in the end. Which states are kept depends on ``seed``.
    """

    CHANGING = ("kept",)

    def __init__(self, engine: Engine, most: int, seed: int):
        self.engine, self.most = engine, most
        self.key = seed_for(seed, "visited").to_bytes(16, "little")
        self.kept: dict[str, Observations] = {}  # pictures by their hashes, including some surplus

    def see(self, ids: Ints) -> None:
        """Take the visited states ``ids`` (E,) into the sample."""
        for picture in self.engine.images(ids):
            digest = blake2b(picture.tobytes(), digest_size=7, key=self.key).digest()
            self.kept.setdefault(digest[::-1].hex(), picture.copy())  # the order of bytes decides which are kept
        if len(self.kept) > 2 * self.most:
            self.kept = self._smallest()

    def _smallest(self) -> dict[str, Observations]:
        """Return the states kept, in the order of their hashes, without surplus."""
        return dict(sorted(self.kept.items())[: self.most])

    def states(self) -> Observations:
        """Return the states kept, (n, *obs)."""
        return np.stack([*self._smallest().values()])

    def write(
        self,
        folder: Path,
        ensemble_config: Values,
        seed: int,
    ) -> None:
        """Write ``visited.h5`` into ``folder``: a data file of unlabelled states of the ensemble's domain."""
        sub_goals = tuple(ensemble_config["sub_goals"])
        visited = States(self.states(), np.zeros((0, 0), bool))
        none = States(visited.observations[:0], np.zeros((0, len(sub_goals)), bool))
        collected = Collected(
            self.engine.observation_shape,
            sub_goals,
            none,
            visited,
            none,
        )
        write_dataset(
            folder / VISITED,
            collected,
            domain=ensemble_config["domain"],
            config=ensemble_config["domain_config"],
            seed=seed,
        )


def unlabelled_file(path: Path, dataset: Dataset) -> Path:
    """Return the file of unlabelled states: ``path`` or, if that is an artefact's folder, its file of visited states.

    Raises ``UserError`` if there is no such file, or if its domain or observations are not those of ``dataset``.
    """
    file = path / VISITED if path.is_dir() else path
    if path.is_dir() and VISITED not in open_artefact(path, "options", "meta").manifest.files:
        raise UserError("no visited states", path, "Make it with --set save_visited=N.")
    source = open_dataset(file)
    for name in ("domain", "observation_shape", "observation_dtype"):
        value, expected = getattr(source, name), getattr(dataset, name)
        if value != expected:
            raise UserError(
                f"the {name.replace('_', ' ')} is {value}, that of the data {expected}",
                file,
                "Give unlabelled states that fit the data.",
            )
    return file
