"""What members know of rooms nobody labelled, for sub-goals other than climbing down a ladder, with labels of room 1.

    python -m studies.other_subgoals docs/results/other-subgoals.csv --seeds 0-2

A cell is a sub-goal, a method and a seed, trained and scored as in ``studies.ladders``. ``--tables`` draws them.
``--options FOLDER`` learns options in room 1 there, stage by stage, and writes how their last executions ended.
``--agents FOLDER`` writes what the agents there got, and beside it (``-options.csv``) where their options ended;
``--play FOLDER`` where the agents themselves end, who play a hundred episodes without learning.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from hypogoal.cli import main as main_of
from hypogoal.core.artefacts import open_artefact
from hypogoal.core.files import write_table
from hypogoal.learners.episodes import LAST
from hypogoal.meta.episodes import agent_of
from hypogoal.options.tables import Choices, Episodes, Executions, Exploits
from studies import ladders
from studies.cells import Row, interval, parser_of, read_rows, run_cells, table

SUB_GOALS = ("climb-up-ladder", "pass-enemy-left", "pass-enemy-right", "pass-lasers")
METHODS = ("dbat", "none", "cnn")
LOOKS = (25, 100, 300)
GROUPS, HELDOUT = 1, 100
COLUMNS = ("sub_goal", *ladders.COLUMNS)


def run_cell(sub_goal: str, method: str, seed: int) -> list[Row]:
    """One ensemble of ``studies.ladders``, of another sub-goal."""
    return [{"sub_goal": sub_goal, **row} for row in ladders.run_cell(GROUPS, method, seed, LOOKS, sub_goal, HELDOUT)]


# Start, sub-goal, termination.
OPTIONS = (
    ("up-1L", "climb-up-ladder", "oracle"),
    ("skull-right", "pass-enemy-left", "oracle"),
    ("up-1L", "climb-up-ladder", "learned"),
)


ENDS = ("start", "sub_goal", "termination", "steps", "member", "executions", "reached", "died", "within_4")


def learn_options(folder: Path, out: Path, steps: int, terminations: Sequence[str]) -> None:
    """Ensembles of room 1 and options from a start, by the command line; a row an option: how its executions ended."""
    new = not out.exists()
    with out.open("a", encoding="utf-8", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        if new:
            rows.writerow(ENDS)
        for start, sub_goal, termination in OPTIONS:
            if termination not in terminations:
                continue
            names = (f"{sub_goal}.h5", sub_goal, f"{start}-{termination}-{steps}")
            data, ensemble, options = (folder / name for name in names)
            few = [f"sub_goals={sub_goal}", "unlabelled_per_room=200", "heldout_per_room=20", "workers=1"]
            short = ["members=3", "steps=100", "workers=1"]
            if not data.exists():
                stage("collect", "montezuma", out=data, settings=few)
            if not ensemble.exists():
                stage("train-ensemble", str(data), out=ensemble, settings=short)
            learning = [f"start={start}", f"termination={termination}", f"steps={steps}"]
            stage("train-options", str(ensemble), out=options, settings=learning)
            ended = Executions.read(options / Executions.FILE)
            for member in sorted(set(ended.option.tolist())):
                last = ended.of(member)
                counts = (last.reached.sum(), last.terminated.sum(), (last.distance <= 4).sum())
                rows.writerow([start, sub_goal, termination, steps, member, len(last.step), *counts])
            file.flush()


AGENTS = ("agent", "steps", "episodes", "rewarded", "first_rewarded", "rewarded_last", "length_last", "rooms")
CHOSEN = ("agent", "sub_goal", "member", "chosen", "ended", "duration", "last_ended", "near")


def gather_agents(folder: Path, out: Path) -> None:
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


def play_agents(folder: Path, out: Path, episodes: int = LAST) -> None:
    """The agents in a folder, without learning: a row an episode, where it ended and which sub-goal's option ran."""
    rows: list[list[object]] = []
    for place in sorted(path.parent for path in folder.glob("*/meta.safetensors")):
        artefact = open_artefact(place, "meta")
        goals, members = artefact.config["sub_goals"], artefact.config["members"]
        loop = agent_of(artefact, artefact.seed)
        while len(loop.recorder.episodes) < episodes:
            before = len(loop.recorder.episodes)
            moved = loop.advance(learning=False)
            for _, length, reward, died, _ in loop.recorder.episodes[before:]:
                where, goal = loop.engine.positions(moved.next_ids)[0], goals[moved.options[0] // members]
                rows.append([place.name, before, length, f"{reward:g}", died, *where, goal])
    write_table(out, ENDED, rows)


def stage(name: str, given: str, *, out: Path, settings: list[str]) -> None:
    """A command of hypogoal."""
    words = [word for setting in settings for word in ("--set", setting)]
    if code := main_of([name, given, "--out", str(out), "-q", *words]):
        raise SystemExit(code)


def tables(path: Path) -> Iterator[str]:
    """The table of the page, or of gathered agents, as lines of Markdown."""
    rows = read_rows(path)
    if "agent" in rows[0]:
        yield from table([*rows[0]], (list(row.values()) for row in rows))
        return
    titles = [
        "",
        "",
        "mean member's ranking",
        "picked: steps",
        "its ranking",
        "its balanced accuracy",
        "D-BAT ahead in",
    ]
    yield from table(titles, (row for goal in SUB_GOALS for row in _rows(goal, ladders.read(path, GROUPS, goal))))


def _rows(sub_goal: str, numbers: ladders.Numbers) -> Iterator[list[str]]:
    for method, seeds in numbers.items():
        means = np.array([looks[LOOKS[-1]]["ranking_unseen"].mean() for looks in seeds.values()])
        steps = f"{ladders.picked(seeds, 'first')}, {ladders.picked(seeds, 'second')}"
        rankings, dbat = (ladders.crossed(each, "ranking") for each in (seeds, numbers["dbat"]))
        accuracies = ladders.crossed(seeds, "balanced_accuracy")
        ahead = "-" if method == "dbat" else f"{(dbat > rankings).sum()} of {len(rankings)}"
        if np.isnan(rankings).any():  # one half of the unseen rooms has no positive
            yield [sub_goal, method, interval(means), *["-"] * 4]
        else:
            yield [sub_goal, method, interval(means), steps, interval(rankings), interval(accuracies), ahead]


def main() -> None:
    """Run the cells that are not in the file yet."""
    parser = parser_of(__doc__, "0-2")
    parser.add_argument("--sub-goals", default=",".join(SUB_GOALS), help="comma-separated; all by default")
    parser.add_argument("--options", type=Path, help="a folder: learn options there instead")
    parser.add_argument("--steps", type=int, default=8_000, help="of each option")
    parser.add_argument("--agents", type=Path, help="a folder: gather its agents instead")
    parser.add_argument("--play", type=Path, help="a folder: play its agents instead")
    parser.add_argument("--terminations", default="oracle,learned", help="comma-separated")
    arguments = parser.parse_args()
    if arguments.tables:
        print("\n".join(tables(arguments.csv)))
        return
    if arguments.options:
        learn_options(arguments.options, arguments.csv, arguments.steps, arguments.terminations.split(","))
        return
    if arguments.agents:
        gather_agents(arguments.agents, arguments.csv)
        return
    if arguments.play:
        play_agents(arguments.play, arguments.csv)
        return
    jobs: dict[tuple[str, ...], Callable[[], list[Row]]] = {
        (sub_goal, method, str(seed)): partial(run_cell, sub_goal, method, seed)
        for sub_goal in arguments.sub_goals.split(",")
        for seed in arguments.seeds
        for method in METHODS
    }
    run_cells(arguments.csv, COLUMNS, ("sub_goal", "method", "seed"), jobs, lambda _: LOOKS, arguments.workers)


if __name__ == "__main__":
    main()
