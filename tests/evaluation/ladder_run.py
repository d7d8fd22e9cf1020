"""A run with ladders as the stages leave it, in small and without an emulator: real file formats, made-up contents."""

import json
from pathlib import Path

import numpy as np
from toy_data import fill, write_table

from hypogoal.core.drafts import create
from hypogoal.core.seeding import rng_for, torch_generator
from hypogoal.data import Collected, States, write_dataset
from hypogoal.domains.base import Domain
from hypogoal.domains.doorkey.domain import DOMAIN as DOORKEY
from hypogoal.hypotheses.ensemble import Ensemble, write_ensemble

SUB_GOAL = "climb-down-ladder"
SHAPE = (36, 36, 4)  # the smallest that the network takes
GROUPS = ((1,), (2, 6), (9,))
ROOMS = {1: 4, 2: 0, 6: 3, 9: 3, 18: 0, 20: 0}  # room -> positives among its states
STATES_PER_ROOM = 12
UNLABELLED_ROOMS = (18,)
COLUMNS = ("step", "option", "duration", "reached", "inside_at_start", "terminated", "room", "x", "y", "distance")
METHODS = {"dbat": ("dbat", 2), "none": ("none", 2), "cnn": ("none", 1)}


class LadderDomain(Domain):
    """What the evaluation asks of a domain with rooms; it is never collected from or played."""

    name = "ladder_run:DOMAIN"
    sub_goals = (SUB_GOAL,)
    observation_shape = SHAPE
    config_class = DOORKEY.config_class
    pictures = True
    starts = ("1L", "2-6")

    def collect(self, config, seed, progress):
        raise NotImplementedError

    def make_engine(self, layout_seed, count, max_steps, **arguments):
        raise NotImplementedError

    def picture(self, room):
        return np.full((210, 160, 3), 5 * room, np.uint8)

    def pixel(self, positions):
        return positions[:, 1:] + 0.5


DOMAIN = LadderDomain()


def seen_with(groups: int, rooms: np.ndarray) -> np.ndarray:
    """The origin ``seen`` of held-out states in these rooms, with the first groups labelled."""
    labelled = [room for group in GROUPS[:groups] for room in group]
    return np.where(np.isin(rooms, labelled), 2, np.where(np.isin(rooms, UNLABELLED_ROOMS), 1, 0))


def heldout() -> States:
    """The same states for every N: the first of each room are at a base, the others near it, on a ladder, elsewhere."""
    rng = rng_for(0, "ladder-run")
    rooms = np.repeat(list(ROOMS), STATES_PER_ROOM)
    place = np.tile(np.arange(STATES_PER_ROOM), len(ROOMS))
    labels = place < np.array(list(ROOMS.values()))[np.repeat(np.arange(len(ROOMS)), STATES_PER_ROOM)]
    kind = np.where(labels, 0, 1 + place % 3)
    observations = rng.integers(256, size=(len(rooms), *SHAPE), dtype=np.uint8)
    return States(observations, labels[:, None], {"room": rooms, "kind": kind})


def write_data(path: Path, groups: int) -> None:
    """A data file of N labelled groups."""
    test = heldout()
    seen = seen_with(groups, test.origins["room"])
    test = States(test.observations, test.labels, {**test.origins, "seen": seen})
    part = np.flatnonzero(seen == 2)
    labelled = States(test.observations[part], test.labels[part], {"room": test.origins["room"][part]})
    part = np.flatnonzero(seen == 1)
    unlabelled = States(test.observations[part], test.labels[part], {"room": test.origins["room"][part]})
    collected = Collected(SHAPE, (SUB_GOAL,), labelled, unlabelled, test)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_dataset(path, collected, domain=DOMAIN.name, config={"groups": groups}, seed=0)


def write_members(out: Path, data: Path, groups: int, method: str, seed: int, **more) -> None:
    """An ensemble artefact with fresh weights, far enough from each other to disagree."""
    diversity, members = METHODS[method]
    config = {
        "members": members,
        "diversity": diversity,
        "diversity_weight": 3e-4,
        "network": "montezuma",
        "sub_goals": [SUB_GOAL],
        "observation_shape": list(SHAPE),
        "observation_dtype": "uint8",
        "view": "full",
        "domain": DOMAIN.name,
        "domain_config": {"groups": groups},
        **more,
    }
    ensemble = Ensemble("montezuma", SHAPE, members, torch_generator(seed, method))
    with create(out, kind="ensemble", config=config, seed=seed, inputs=[data]) as draft:
        folder = draft.files
        write_ensemble(folder, SUB_GOAL, ensemble)
        fill(folder, "ensemble", config)


def write_options(out: Path, source: Path, ladder: str, seed: int, rows, members: int, **more) -> None:
    """An options artefact whose executions are ``rows``, in the order of ``COLUMNS``."""
    config = {
        "start": ladder,
        "termination": "learned",
        "members": members,
        "sub_goals": [SUB_GOAL],
        "domain": DOMAIN.name,
        "domain_config": {},
        "layout_seed": 0,
        "mask_reached": False,
        "steps": 1_000,
        **more,
    }
    with create(out, kind="options", config=config, seed=seed, inputs=[source]) as draft:
        folder = draft.files
        write_table(folder / "executions.csv", COLUMNS, rows)
        facts = {"layout_seed": 0, "shortest_path": None, "random_success": None, "random_episodes": 0}
        (folder / "layout.json").write_text(json.dumps(facts), encoding="utf-8")
        fill(folder, "options", config)


def executions(option: int, distances, *, inside: int = 0, died: int = 0, timed_out: int = 0, room: int = 1) -> list:
    """One execution of ``option`` per distance; the first begin inside, the last die, those before them time out."""
    rows = []
    for index, distance in enumerate(distances):
        left = len(distances) - index
        dead, late = left <= died, died < left <= died + timed_out
        reached = not (dead or late)
        where = (room, 20 + distance, 100)
        rows.append((10 * index, option, 7, int(reached), int(index < inside), int(dead), *where, distance))
    return rows


def write_run(
    run: Path, *, numbers=(1, 2, 3), seeds=(0, 1), methods=("cnn", "dbat", "none"), ladders=("1L", "2-6"), oracle=True
) -> None:
    """Data, ensembles and, at N=2, options: member m of seed s stops 10 (m + 1) + s away on 1L, twice that on 2-6."""
    for groups in numbers:
        data = run / f"data/groups-{groups}.h5"
        write_data(data, groups)
        for method in methods:
            for seed in seeds:
                write_members(run / f"ensemble/{method}/groups-{groups}-seed-{seed}", data, groups, method, seed)
    for ladder in ladders:
        far = 1 if ladder == "1L" else 2
        for seed in seeds:
            for method in methods:
                source = run / f"ensemble/{method}/groups-2-seed-{seed}"
                members = METHODS[method][1]
                rows = [row for m in range(members) for row in executions(m, [far * (10 * (m + 1) + seed)] * 4, room=6)]
                place = run / f"options/{method}/groups-2-ladder-{ladder}-seed-{seed}"
                write_options(place, source, ladder, seed, rows, members)
            if oracle:
                source = run / f"ensemble/{methods[0]}/groups-2-seed-{seed}"
                rows = executions(0, [0, 0, 4, 8], died=1)
                place = run / f"options/oracle/ladder-{ladder}-seed-{seed}"
                write_options(place, source, ladder, seed, rows, 1, termination="oracle")
