"""Spec B7: states that a policy visited while it learned, kept to train ensembles with."""

import heapq
from collections.abc import Mapping, Sequence
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np

from hypogoal.core.artefacts import open_artefact
from hypogoal.core.checkpoints import Resumable
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import seed_for
from hypogoal.data import Collected, Dataset, States, open_dataset, write_dataset
from hypogoal.domains.base import Domain, Engine
from hypogoal.observations import Observations
from hypogoal.options.parts import Flags, Ids

VISITED = "visited.h5"
ORIGINS = ("action", "previous_action")  # that led to a state; -1 where there was none


class Visited(Resumable):
    """A uniform sample of the distinct states visited: those whose hashes are the smallest (a bottom-k sketch).

    Whether a state is kept depends neither on when nor on how often it was visited, and no random numbers are drawn.
    At ``most`` so many are kept, which ones depends on ``seed``; their positions too, where the engine has them, or
    else their layout's seed, ``layout_seed`` where the engine does not say.
    """

    def __init__(
        self,
        engine: Engine,
        most: int,
        layout_seed: int,
        seed: int,
    ):
        self.engine, self.most, self.layout_seed = engine, most, layout_seed
        self.names = (*ORIGINS, *(engine.position_names or ("layout_seed",)))  # of what is kept of origins
        self.key = seed_for(seed, "visited").to_bytes(16, "little")
        self.before = np.full(engine.count, -1, dtype=np.int64)  # the last actions
        self.kept: dict[int, tuple[Observations, Ids]] = {}  # by their hashes: pictures and origins
        self.largest: list[int] = []  # a heap of the hashes kept, negative

    def see(
        self,
        ids: Ids,
        actions: Ids,
        over: Flags,
        layouts: Sequence[int] | None = None,
    ) -> None:
        """States (E,), the actions (E,) that led to them, whether episodes are over, bool (E,), and their layouts."""
        if self.engine.position_names:
            places = self.engine.positions(ids)
        else:
            places = np.array(layouts or [self.layout_seed] * len(ids))
        origins = np.column_stack([actions, self.before, places])
        for picture, origin in zip(self.engine.images(ids), origins, strict=True):
            self._offer(picture, origin)
        self.before = np.where(over, -1, actions)

    def _offer(self, picture: Observations, origin: Ids) -> None:
        digest = int.from_bytes(blake2b(picture.tobytes(), digest_size=7, key=self.key).digest(), "little")
        full = len(self.kept) == self.most
        if digest in self.kept or (full and digest > -self.largest[0]):
            return
        self.kept[digest] = (picture.copy(), origin)
        heapq.heappush(self.largest, -digest)
        if full:
            del self.kept[-heapq.heappop(self.largest)]

    def states(self) -> States:
        """The states kept, in the order of their hashes; their labels are not known."""
        kept = [self.kept[digest] for digest in sorted(self.kept)]
        pictures = self.engine.room_for(len(kept), None)
        origins = np.empty((len(kept), len(self.names)), np.int64)
        for row, (picture, origin) in enumerate(kept):
            pictures[row] = picture
            origins[row] = origin
        return States(pictures, np.zeros((len(kept), 0), np.bool_), dict(zip(self.names, origins.T, strict=True)))

    def write(
        self,
        folder: Path,
        domain: Domain,
        ensemble_config: Mapping[str, Any],
        seed: int,
    ) -> None:
        """``visited.h5`` into ``folder``: a data file of unlabelled states, of the ensemble's domain."""
        sub_goals = domain.usual_sub_goals
        none = States(self.engine.room_for(0, None), np.zeros((0, len(sub_goals)), np.bool_))
        collected = Collected(
            self.engine.observation_shape,
            sub_goals,
            none,
            self.states(),
            none,
        )
        named = {"domain": ensemble_config["domain"], "config": ensemble_config["domain_config"]}
        write_dataset(
            folder / VISITED,
            collected,
            **named,
            seed=seed,
        )

    def snapshot(self) -> dict[str, Any]:
        states = self.states()
        return {
            "before": self.before.copy(),
            "digests": np.array(sorted(self.kept), np.int64),
            "pictures": states.observations,
            "origins": np.column_stack([states.origins[name] for name in self.names]),
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        self.before = snapshot["before"].copy()
        states = zip(snapshot["pictures"], snapshot["origins"], strict=True)
        self.kept = dict(zip(snapshot["digests"].tolist(), states, strict=True))
        self.largest = [-digest for digest in self.kept]
        heapq.heapify(self.largest)


def unlabelled_file(path: Path, dataset: Dataset) -> Path:
    """Spec B7: the file of unlabelled states: ``path``, or the file of an artefact with visited states.

    No such file, or one of another domain or shape than ``dataset``, is a ``UserError``.
    """
    file = path / VISITED if path.is_dir() else path
    if path.is_dir() and VISITED not in open_artefact(path, "options", "meta").manifest.files:
        raise UserError("no visited states", path, "Make it with --set save_visited=N.")
    source = open_dataset(file)
    for name, value, expected in (
        ("the domain", source.domain, dataset.domain),
        ("observations of shape", source.observation_shape, dataset.observation_shape),
        ("observations of type", source.observation_dtype, dataset.observation_dtype),
    ):
        if value != expected:
            do = "Give unlabelled states that fit the data."
            raise UserError(f"{name} {value}, the data have {expected}", file, do)
    return file
