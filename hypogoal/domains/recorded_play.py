"""Recorded play to collect states from: the actions of episodes, as JSON or a Minari dataset (Spec B7)."""

from pathlib import Path
from typing import Any, NamedTuple

from hypogoal.core.errors import UserError
from hypogoal.core.files import read_json
from hypogoal.core.hdf5 import attribute, find, members, open_hdf5, read_array

MINARI = Path("data") / "main_data.hdf5"  # in a dataset's folder
DO = 'Give {"layout_seed": 0, "actions": [2, 5]}, a list of these, or a Minari dataset made with reset(seed=...).'


class Recorded(NamedTuple):
    """The actions played after ``reset(seed=layout_seed)``, and the file and episode they come from."""

    layout_seed: int
    actions: tuple[int, ...]
    where: str


def read_play(path: Path) -> list[Recorded]:
    """The episodes in a JSON file or a Minari dataset's folder; anything else is a ``UserError``."""
    content: Any = _minari(path) if path.is_dir() else read_json(path, "recorded play is", DO)
    episodes = []
    for number, episode in enumerate(content if isinstance(content, list) else [content]):
        where = f"{path}, episode {number}"
        seed, actions = (episode.get(key) if isinstance(episode, dict) else None for key in ("layout_seed", "actions"))
        numbers: list[Any] = [seed, *actions] if isinstance(actions, list) and actions else []
        if not numbers or any(type(value) is not int or value < 0 for value in numbers):
            raise UserError("recorded play needs a layout seed and actions", where, DO)
        episodes.append(Recorded(numbers[0], tuple(numbers[1:]), where))
    return episodes


def _minari(path: Path) -> list[dict[str, Any]]:
    with open_hdf5(path / MINARI, "the dataset", DO) as file:
        names = [name for name in members(file) if name.startswith("episode_")]
        played = [read_array(file, f"{name}/actions", "iu").ravel().tolist() for name in names]
        seeds = [attribute(find(file, name), "seed") for name in names]
    return [{"layout_seed": seed, "actions": actions} for seed, actions in zip(seeds, played, strict=True)]
