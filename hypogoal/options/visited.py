"""Spec B7: states that a policy visited while it learned, kept to train ensembles with."""

import heapq
from collections.abc import Mapping, Sequence
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.artefacts import open_artefact
from hypogoal.core.checkpoints import Resumable
from hypogoal.core.errors import UserError
from hypogoal.core.seeding import seed_for
from hypogoal.data import Collected, Dataset, States, open_dataset, write_dataset
from hypogoal.domains.base import Domain, Engine
from hypogoal.observations import Observations

VISITED = "visited.h5"
ORIGINS = ("action", "previous_action")  # that led to a state; -1 where there was none


class Visited(Resumable):
    """A uniform sample of the distinct states visited: those whose hashes are the smallest (a bottom-k sketch).

    Whether a state is kept depends neither on when nor on how often it was visited, and no random numbers are drawn.
    At ``most`` so many are kept, which ones depends on ``seed``; their positions too, where the engine has them, or
    else their layout's seed, ``layout_seed`` where the engine does not say.
    """

    def __init__(self, engine: Engine, most: int, layout_seed: int, seed: int):
        self.engine, self.most, self.layout_seed = engine, most, layout_seed
        self._key = seed_for(seed, "visited").to_bytes(16, "little")
        self._forgets = engine.memory is not None  # and gives every step a new id
        self._known = np.zeros(1024, dtype=np.bool_)
        self._before = np.full(engine.count, -1, dtype=np.int64)
        self._kept: dict[int, tuple[Observations, NDArray[np.int64]]] = {}
        self._worst: list[int] = []  # a heap of the hashes kept, negative: the largest first

    def see(
        self,
        ids: NDArray[np.int64],
        actions: NDArray[np.int64],
        over: NDArray[np.bool_],
        layouts: Sequence[int] | None = None,
    ) -> None:
        """States (E,), the actions (E,) that led to them, whether episodes are over, bool (E,), and their layouts."""
        fresh = np.arange(len(ids)) if self._forgets else self._unknown(ids)
        if len(fresh):
            where = np.array(layouts if layouts else [self.layout_seed] * len(ids))[fresh, None]
            pictures = self.engine.images(ids[fresh])
            places = self.engine.positions(ids[fresh]) if self.engine.position_names else where
            steps = np.stack([actions[fresh], self._before[fresh]], axis=1)
            for picture, origin in zip(pictures, np.concatenate([steps, places], axis=1), strict=True):
                self._offer(picture, origin)
        self._before = np.where(over, -1, actions)

    def _unknown(self, ids: NDArray[np.int64]) -> NDArray[np.int64]:
        highest = int(ids.max()) + 1
        if highest > len(self._known):
            self._known = np.concatenate([self._known, np.zeros(max(highest, len(self._known)), np.bool_)])
        fresh = np.flatnonzero(~self._known[ids])
        self._known[ids] = True
        return fresh

    @property
    def origins(self) -> tuple[str, ...]:
        """What is kept of where states come from."""
        return (*ORIGINS, *(self.engine.position_names or ("layout_seed",)))

    def _offer(self, picture: Observations, origin: NDArray[np.int64]) -> None:
        digest = int.from_bytes(blake2b(picture.tobytes(), digest_size=7, key=self._key).digest(), "little")
        if digest in self._kept or (len(self._kept) == self.most and digest > -self._worst[0]):
            return
        self._kept[digest] = (picture.copy(), origin)
        heapq.heappush(self._worst, -digest)
        if len(self._kept) > self.most:
            del self._kept[-heapq.heappop(self._worst)]

    def states(self) -> States:
        """The states kept, in the order of their hashes; their labels are not known."""
        kept = [self._kept[digest] for digest in sorted(self._kept)]
        pictures = self.engine.room_for(len(kept), None)
        for row, (picture, _) in enumerate(kept):
            pictures[row] = picture
        columns = np.array([origin for _, origin in kept], np.int64).reshape(-1, len(self.origins)).T
        return States(pictures, np.zeros((len(kept), 0), np.bool_), dict(zip(self.origins, columns, strict=True)))

    def write(self, folder: Path, domain: Domain, ensemble_config: Mapping[str, Any], seed: int) -> None:
        """``visited.h5`` into ``folder``: a data file of unlabelled states, of the ensemble's domain."""
        sub_goals = domain.usual_sub_goals
        none = States(self.engine.room_for(0, None), np.zeros((0, len(sub_goals)), np.bool_))
        collected = Collected(self.engine.observation_shape, sub_goals, none, self.states(), none)
        named = {"domain": ensemble_config["domain"], "config": ensemble_config["domain_config"]}
        write_dataset(folder / VISITED, collected, **named, seed=seed)

    def snapshot(self) -> dict[str, Any]:
        digests = sorted(self._kept)
        return {
            "known": self._known.copy(),
            "before": self._before.copy(),
            "digests": np.array(digests, np.int64),
            "pictures": self.states().observations,
            "origins": np.array([self._kept[digest][1] for digest in digests], np.int64).reshape(-1, len(self.origins)),
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        self._known, self._before = snapshot["known"].copy(), snapshot["before"].copy()
        rows = zip(snapshot["digests"].tolist(), snapshot["pictures"], snapshot["origins"], strict=True)
        self._kept = {digest: (picture, origin) for digest, picture, origin in rows}
        self._worst = [-digest for digest in self._kept]
        heapq.heapify(self._worst)


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
