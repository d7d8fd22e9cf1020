"""HDF5 files of robomimic's layout: ``data/demo_N/obs/KEY``, ``rewards``, ``dones``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from hypogoal.core.errors import UserError
from hypogoal.core.hdf5 import checked, find, members, open_hdf5, read_array
from hypogoal.domains.observations import shrunk_sides
from hypogoal.observations import NUMBERS, PICTURE, Observations
from hypogoal.own_data.parts import Resize, resize_of
from hypogoal.own_data.recordings import Recording, chosen_keys, kept

DO = "Give a file with data/demo_0/obs, as robomimic's dataset_states_to_obs.py writes it."
KINDS = "uifb"


class Robomimic(Recording):
    """The demonstrations of a file; ``keys`` are those of ``obs``, all if none."""

    def __init__(self, path: Path, keys: Sequence[str] = (), resize: Resize = 0):
        self.path, self.lengths = path, []
        with open_hdf5(path, "the recording", DO) as file:
            data = find(file, "data")
            demos = [name for name in (members(data) if data is not None else []) if name.startswith("demo_")]
            self.names = sorted(demos, key=lambda name: (len(name), name))
            observed = find(data, f"{self.names[0]}/obs") if demos else None
            if observed is None:
                raise UserError("it has no data/demo_0/obs", path, DO)
            chosen, types = chosen_keys(keys, members(observed), path), set()
            for name in self.names:
                parts = {key: checked(file, f"data/{name}/obs/{key}", KINDS) for key in chosen}
                types.add(tuple((str(part.dtype), part.shape[1:]) for part in parts.values()))
                sizes = {part.shape[:1] for part in parts.values()}
                if len(types) > 1 or len(sizes) > 1 or not all(map(all, sizes)):
                    raise UserError(
                        "its observations differ in shape or number", f"{path}, {name}", "Leave a --key out."
                    )
                self.lengths.append(int(next(iter(sizes))[0]))
            demo = find(data, self.names[0])
            self.columns = [name for name in members(demo) if len(getattr(find(demo, name), "shape", ())) == 1]
        self.fields = {}
        for key, (dtype, shape) in zip(chosen, types.pop(), strict=True):
            picture = dtype == str(PICTURE) and len(shape) == 3
            sides = shrunk_sides(shape, resize_of(resize, key, picture=True)) if picture else ()
            self.fields[key] = (PICTURE, (*sides, shape[2])) if picture else (NUMBERS, shape or (1,))

    def column(self, episode: int, name: str) -> NDArray[Any]:
        with open_hdf5(self.path, "the recording", DO) as file:
            return read_array(file, f"data/{self.names[episode]}/{name}", KINDS)

    def fill(self, states: Mapping[int, Observations], every: int) -> None:
        for episode, rows in states.items():
            for key, (dtype, shape) in self.fields.items():
                values = self.column(episode, f"obs/{key}")[kept(self.lengths[episode], every)]
                if dtype == NUMBERS:
                    rows[key] = values.reshape(-1, *shape)
                    continue
                for row, picture in enumerate(values):
                    self.store(rows, row, key, picture, self.path)
