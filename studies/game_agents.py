"""Agents of Montezuma's Revenge that play from the start of the game: what they got, and where they end.

    python -m studies.game_agents docs/results/montezuma-agents.csv --gather runs/game

``--gather FOLDER`` writes a row for each agent there, and beside it (``-options.csv``) where its options ended.
``--play FOLDER`` writes where agents over options end, who play a hundred episodes without learning. ``--tables`` draws
the agents.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hypogoal.core.artefacts import open_artefact
from hypogoal.core.files import write_table
from hypogoal.core.seeding import rng_for
from hypogoal.learners.episodes import LAST
from hypogoal.meta.episodes import agent_of
from hypogoal.options.choosers import RandomChooser
from hypogoal.options.tables import Choices, Episodes, Exploits
from studies.cells import parser_of, printed, read_rows, table

AGENTS = ("agent", "steps", "episodes", "rewarded", "first_rewarded", "rewarded_last", "length_last", "rooms")
CHOSEN = ("agent", "sub_goal", "member", "chosen", "ended", "duration", "last_ended", "near")


def gather(folder: Path, out: Path) -> None:
    """The agents in a folder, a row each, with their rooms, if any; of each option where its executions ended.

    ``rewarded``: episodes with a reward, ``_last``: of the last 100; ``first_``: the step at the end of the first.
    ``ended``: executions that a positive prediction ended; ``near``: of the last ones so ended, those near the true
    sub-goal.
    """
    agents: list[list[object]] = []
    options: list[list[object]] = []
    for place in sorted(path.parent for path in folder.glob(f"*/{Episodes.FILE}")):
        episodes = Episodes.read(place / Episodes.FILE)
        config = json.loads((place / "manifest.json").read_text(encoding="utf-8"))["config"]
        rooms = json.loads((place / "layout.json").read_text(encoding="utf-8")).get("rooms", ())
        rewarded, last = episodes.reward > 0, slice(-LAST, None)
        lengths = f"{episodes.length[last].mean():.1f}"
        first = episodes.step[rewarded.argmax()] if rewarded.any() else ""
        counts = [config["steps"], len(rewarded), rewarded.sum(), first, rewarded[last].sum()]
        agents.append([place.name, *counts, lengths, " ".join(rooms)])
        if not (place / Choices.FILE).exists():
            continue
        choices = Choices.read(place / Choices.FILE)
        ends = Exploits.read(place / Exploits.FILE) if (place / Exploits.FILE).exists() else None  # true sub-goals
        for option in sorted(set(choices.option.tolist())):
            goal, member = divmod(option, config["members"])
            own = choices.option == option
            sums = [int(values[own].sum()) for values in (choices.chosen, choices.reached, choices.duration)]
            of_last = ends.reached & (ends.option == option) if ends else np.zeros(0, np.bool_)
            near = [int(of_last.sum()), int((of_last & ends.near).sum())] if ends else ["", ""]
            options.append([place.name, config["sub_goals"][goal], member, *sums, *near])
    write_table(out, AGENTS, agents)
    write_table(out.with_name(f"{out.stem}-options.csv"), CHOSEN, options)


ENDED = ("agent", "episode", "length", "reward", "died", "room", "x", "y", "sub_goal")


def play(folder: Path, out: Path, episodes: int = LAST, *, uniform: bool = False) -> None:
    """The agents in a folder, without learning: a row an episode, where it ended and which sub-goal's option ran.

    ``uniform``: uniform-random choice among their options instead.
    """
    rows: list[list[object]] = []
    for place in sorted(path.parent for path in folder.glob("*/meta.safetensors")):
        artefact = open_artefact(place, "meta")
        goals, members = artefact.config["sub_goals"], artefact.config["members"]
        loop, name = agent_of(artefact, artefact.seed), place.name
        if uniform:
            loop.chooser, name = RandomChooser(rng_for(artefact.seed, "uniform-choice")), f"{name}, uniform"
        while len(loop.recorder.episodes) < episodes:
            before = len(loop.recorder.episodes)
            moved = loop.advance(learning=False)
            for _, length, reward, died, _ in loop.recorder.episodes[before:]:
                where, goal = loop.engine.positions(moved.next_ids)[0], goals[moved.options[0] // members]
                rows.append([name, before, length, f"{reward:g}", died, *where, goal])
    write_table(out, ENDED, rows)


def tables(path: Path) -> Iterator[str]:
    """The agents, as lines of Markdown."""
    titles = ["", "steps", "episodes", "with a reward", "first at", "of the last 100", "their length", "rooms"]
    yield from table(titles, ([value or "-" for value in row.values()] for row in read_rows(path)))


def main() -> None:
    """Gather or play the agents of a folder."""
    parser = parser_of(__doc__)
    parser.add_argument("--gather", type=Path, help="a folder with artefacts of agents")
    parser.add_argument("--play", type=Path, help="the same: play those over options")
    parser.add_argument("--uniform", action="store_true", help="with --play: uniform-random choice among their options")
    arguments = parser.parse_args()
    if printed(arguments, tables):
        return
    if arguments.gather:
        gather(arguments.gather, arguments.csv)
    if arguments.play:
        play(arguments.play, arguments.csv, uniform=arguments.uniform)


if __name__ == "__main__":
    main()
