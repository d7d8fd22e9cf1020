"""HDF5 files of robomimic's layout: ``data/demo_N/obs/KEY``, ``rewards``, ``dones``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.core.hdf5 import checked, find, members, open_hdf5, read_array
from hypogoal.dataset import NUMBERS, PICTURE
from hypogoal.domains.observations import shrunk_sides
from hypogoal.own_data.parts import Resize, resize_of
from hypogoal.own_data.recordings import Frames, Recording, chosen_keys, kept, store

DO = "Give a file with data/demo_0/obs, as robomimic's dataset_states_to_obs.py writes it."
KINDS = "uifb"


class Robomimic(Recording):
    """The demonstrations of a file; ``keys`` are those of ``obs``, all if none."""

    def __init__(self, path: Path, keys: Sequence[str] = (), resize: Resize = 0):
        self.path = path
        with open_hdf5(path, "the recording", DO) as file:
            data = find(file, "data")
            demos = [name for name in (members(data) if data is not None else []) if name.startswith("demo_")]
            self.names = sorted(demos, key=lambda name: (len(name), name))
            observed = find(file, f"data/{self.names[0]}/obs") if self.names else None
            if observed is None:
                raise UserError("it has no data/demo_0/obs", path, DO)
            chosen = chosen_keys(keys, members(observed), path)
            first = {key: checked(file, f"data/{self.names[0]}/obs/{key}", KINDS) for key in chosen}
            self._shapes = {key: (each.dtype, each.shape[1:]) for key, each in first.items()}
            self.lengths = []
            for name in self.names:
                parts = [checked(file, f"data/{name}/obs/{key}", KINDS) for key in chosen]
                same = all(
                    (part.dtype, part.shape[1:]) == self._shapes[key] for key, part in zip(chosen, parts, strict=True)
                )
                if not same or len({part.shape[:1] for part in parts}) != 1 or not parts[0].shape[0]:
                    raise UserError(
                        "its observations differ in shape or number", f"{path}, {name}", "Leave a --key out."
                    )
                self.lengths.append(int(parts[0].shape[0]))
            demo = find(file, f"data/{self.names[0]}")
            self.columns = [name for name in members(demo) if len(getattr(find(demo, name), "shape", ())) == 1]
        self.fields = {}
        for key, (dtype, shape) in self._shapes.items():
            if picture := dtype == PICTURE and len(shape) == 3:
                shape = (*shrunk_sides(shape, resize_of(resize, key, picture=True)), shape[2])
            self.fields[key] = (PICTURE if picture else NUMBERS, shape or (1,))

    def column(self, episode: int, name: str) -> NDArray[Any]:
        with open_hdf5(self.path, "the recording", DO) as file:
            return read_array(file, f"data/{self.names[episode]}/{name}", KINDS)

    def fill(self, frames: Mapping[int, Frames], every: int) -> None:
        with open_hdf5(self.path, "the recording", DO) as file:
            for episode, places in frames.items():
                rows = kept(self.lengths[episode], every)
                for key, (dtype, shape) in self.fields.items():
                    values = read_array(file, f"data/{self.names[episode]}/obs/{key}", KINDS)[rows]
                    if dtype == NUMBERS:
                        places[key][:] = values.reshape(-1, *shape).astype(NUMBERS)
                    else:
                        for row, picture in enumerate(values):
                            store(places, key, row, picture, self.path)
