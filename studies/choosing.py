"""What choosing is worth, played by the agents of a sweep: the rows behind the result, and its tables.

hypogoal run choosing --out runs/choosing
python -m studies.choosing runs/choosing docs/results/choosing-doorkey.csv
hypogoal run rooms --out runs/rooms
python -m studies.choosing runs/rooms docs/results/rooms.csv
hypogoal run examples.preference:preference --out runs/preference
python -m studies.choosing runs/preference docs/results/preference-doorkey.csv
python -m studies.choosing --tables docs/results/choosing-doorkey.csv

Choosing: members learn from the plain layout 0 (150 steps); layouts are the first ten from 70100 on with no wrong key
in the way, a seed each; PPO chooses for 50,000 steps, then agent and uniform-random choice play 8,000 steps each.

Commits e4a7b5a (planned), a08a8b0 (learned), a133675 (baselines). Preference: layouts 300 to 333, seeds 3000 to 3033,
100,000 steps, commit 7f39d96; with learned options Figure 6's agents, layouts 300 to 309, and, of commit 033b90a9, 310
to 319 with seeds 3010 to 3019: hypogoal run examples.figure6:figure6 --set methods=dbat-k3 --set told= --set baselines=
--set papers= --set layouts=310 --seed 3010. Rooms: commits a2bca61, 36a0e7a (first and second setting).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.artefacts import Artefact, open_artefact
from hypogoal.evaluation.choosing import OF_CHOICE, OF_PLAY, play_agent
from hypogoal.evaluation.names import LEARNED, UNIFORM
from hypogoal.evaluation.run import find_artefacts
from studies.cells import amount, parser_of, read_rows, share, table, won, write_rows

ENSEMBLES = {
    "joint": "joint, K = 2",
    "dbat": "D-BAT, K = 3",
    "divdis": "DivDis, K = 3",
    "none": "no diversity, K = 3",
    "one": "one classifier, K = 1",
}
TRUTHS = ("shape", "place")  # what the reward asks for
IN_ROOMS = {
    f"{method}-truth-{truth}": f"{truth}: {title}" for truth, (method, title) in product(TRUTHS, ENSEMBLES.items())
}
METHODS = IN_ROOMS | {  # by what the names of artefacts have in them, the longest first
    "dbat-k3": "D-BAT, K = 3",
    "none-k3": "no diversity, K = 3",
    "dbat": "D-BAT, K = 6",
    "none": "no diversity, K = 6",
    "one": "one classifier, K = 1",
    "ppo": "PPO on primitive actions",
    "dqn": "DQN on primitive actions",
}
BASELINES = ("ppo", "dqn")
PLANNED = "planned"
POLICIES = {"learned": "learned options", PLANNED: "planned options"}  # baselines have none
# Steps in the plain world, and whether uniform-random choice solved it by then.
PRACTICE, PRACTISED = "practice", "practised"
MOST_LAYOUTS = 10  # side by side in a table; more are in the rows alone
NEWEST = "seeds 400 to 409"
ROOMS = {  # runs, by what their files' names end in
    NEWEST: "-joint",
    "third": "",
    "second": "-second",
    "first": "-first",
}
Agent = tuple[str, str]  # method, policy
ValuesOf = Callable[[Agent, str, str], NDArray[np.float64]]  # of an agent by chooser and quantity
COLUMNS = ("method", "policy", "layout", "seed", "chooser", "quantity", "value")
HIGH = 0.9
LEAST = {"within_rho": -1.0}  # of all others 0
SHOWN = {
    "success": "solved by the agent",
    "within_rho": "rank correlation of preference and quality",
    "pair": "better of two taken",
}


def collect(run: Path, path: Path, baselines: Path | None = None) -> None:
    """Play every agent of a run, frozen, and uniform-random choice among its options: a row per number.

    Of evaluated baselines it takes the last training episodes. Rows that are there of agents that the run has not stay.
    """
    rows = [row for artefact in find_artefacts(run, "meta") for row in _played(artefact)]
    if baselines:
        numbers = read_rows(baselines / "evaluation" / "numbers.csv")
        rows += [row for row in numbers if row["seed"] and not row["step"] and row["quantity"] in OF_PLAY]
    kept: list[tuple[str, ...]] = []
    for row in rows:
        method = next(name for name in METHODS if f"-{name}-" in row["artefact"])
        chooser = "uniform" if row["method"] == UNIFORM else "agent"
        value = f"{float(row['value']):.4f}"
        kept.append((method, row.get("policy", ""), row["layout"], row["seed"], chooser, row["quantity"], value))
    played = {row[:3] for row in kept}
    before = [tuple(row[column] for column in COLUMNS) for row in _read(path)] if path.exists() else []
    kept += [row for row in before if row[:3] not in played]
    names = (*METHODS, *POLICIES, "agent", "uniform", *OF_PLAY, *OF_CHOICE, PRACTICE, PRACTISED)
    order = {name: place for place, name in enumerate(("", *names))}
    kept.sort(key=lambda row: (order[row[0]], order[row[1]], int(row[2]), order[row[4]], order[row[5]]))
    write_rows(path, COLUMNS, [dict(zip(COLUMNS, row, strict=True)) for row in kept])


def _played(artefact: Artefact) -> list[dict[str, str]]:
    config, seed = artefact.config, artefact.seed
    policy = PLANNED if config["network"] == PLANNED else "learned"
    agent = {"policy": policy, "layout": str(config["layout_seed"]), "seed": str(seed), "artefact": artefact.path.name}
    played, rows = play_agent(artefact), []
    assert played is not None
    agent_numbers, uniform, _ = played
    for method, numbers in ((LEARNED, agent_numbers), (UNIFORM, uniform)):
        defined = [name for name in (*OF_PLAY, *OF_CHOICE) if not np.isnan(numbers[name])]
        rows += [agent | {"method": method, "quantity": name, "value": str(numbers[name])} for name in defined]
    if "options_ended_at" in config:
        options = open_artefact(artefact.input("options"), "options").config
        came = {PRACTICE: options["ended_at"], PRACTISED: int(options["until_reached"])}
        rows += [agent | {"method": LEARNED, "quantity": name, "value": str(value)} for name, value in came.items()]
    return rows


def _read(path: Path) -> list[dict[str, str]]:
    """The rows; in files from before there was a policy all options are planned."""
    return [{"policy": "" if row["method"] in BASELINES else PLANNED, **row} for row in read_rows(path)]


def tables(path: Path) -> Iterator[str]:
    """What the rows say, as lines of Markdown."""
    rows = _read(path)
    layouts = sorted({row["layout"] for row in rows}, key=int)
    present = {(row["method"], row["policy"]) for row in rows}
    both = set(POLICIES) <= {policy for _, policy in present}
    agents = {
        (method, policy): f"{title}, {POLICIES[policy]}" if both and policy else title
        for (method, title), policy in product(METHODS.items(), ("", *POLICIES))
        if (method, policy) in present
    }
    optioned = [agent for agent in agents if agent[0] not in BASELINES]

    def values_of(agent: tuple[str, str], chooser: str, quantity: str) -> NDArray[np.float64]:
        numbers = {
            row["layout"]: float(row["value"])
            for row in rows
            if (row["method"], row["policy"], row["chooser"], row["quantity"]) == (*agent, chooser, quantity)
        }
        return np.array([numbers.get(layout, np.nan) for layout in layouts])

    def by_layout(cells: Callable[[tuple[str, str]], Iterator[str]], shown: list[tuple[str, str]]) -> Iterator[str]:
        yield ""
        yield from table(["", *layouts], ([agents[agent], *cells(agent)] for agent in shown))

    def shares(agent: tuple[str, str]) -> Iterator[str]:
        choosers = [values_of(agent, chooser, "success") for chooser in ("agent", "uniform")]
        for solved, uniform in zip(*choosers, strict=True):
            yield "-" if np.isnan(solved) else f"{solved:.2f} / {uniform:.2f}"

    def practice(agent: tuple[str, str]) -> Iterator[str]:
        practices = [values_of(agent, "agent", quantity) for quantity in (PRACTICE, PRACTISED)]
        for steps, solved in zip(*practices, strict=True):
            yield "-" if np.isnan(steps) else f"{steps / 1000:.0f}" + ("" if solved else " (limit)")

    yield f"Mean over {len(layouts)} layouts with a 95 % interval; of choices, where they are defined.\n"
    yield from table(
        ["members and options", "solved by random choice", *SHOWN.values(), "layouts on which 95 % are solved"],
        (
            [
                title,
                _mean(values_of(agent, "uniform", "success")) if agent in optioned else "-",
                *(_mean(values_of(agent, "agent", name), LEAST.get(name, 0.0)) for name in SHOWN),
                _reached(values_of(agent, "agent", "success")),
            ]
            for agent, title in agents.items()
        ),
    )
    yield "Episodes solved, layout by layout: the median of D-BAT minus the other, and where D-BAT is above.\n"
    titles = ["D-BAT compared with", "D-BAT solves more by, median", "layouts on which it solves more"]
    yield from table(titles, _apart(agents, values_of))
    if len(layouts) <= MOST_LAYOUTS:
        yield "Share of episodes solved, layout by layout: the agent / uniform-random choice among its own options."
        yield from by_layout(shares, optioned)
    if practised := [agent for agent in optioned if not np.isnan(values_of(agent, "agent", PRACTICE)).all()]:
        yield "Practice by uniform-random choice, thousands of steps until 95 of 100 were solved, or the limit."
        yield from by_layout(practice, practised)


def _apart(agents: dict[Agent, str], values_of: ValuesOf) -> Iterator[list[str]]:
    """Rows of what an ensemble of D-BAT's solves more than others with the same kind of options."""
    for method, policy in agents:
        dbat = next((name for name, other in agents if name.startswith("dbat") and other == policy), None)
        if dbat and method != dbat:
            gaps = values_of((dbat, policy), "agent", "success") - values_of((method, policy), "agent", "success")
            defined = gaps[~np.isnan(gaps)]
            yield [agents[method, policy], amount(defined), won(defined)]


def solved_by(rows: list[dict[str, str]], method: str, chooser: str) -> NDArray[np.float64]:
    """The share of episodes solved in each room, by seed."""
    wanted = (method, chooser, "success")
    return np.array([float(r["value"]) for r in rows if (r["method"], r["chooser"], r["quantity"]) == wanted])


def _solved(rows: list[dict[str, str]]) -> Iterator[list[str]]:
    """Rows of what the agents of one run solve, and random choice among the same options."""
    for truth, (method, title) in product(TRUTHS, ENSEMBLES.items()):
        solved, uniform = (solved_by(rows, f"{method}-truth-{truth}", chooser) for chooser in ("agent", "uniform"))
        if len(solved):
            high = f"{(solved >= HIGH).sum()} of {len(solved)}"
            yield [truth, title, share(solved), high, f"{uniform.mean():.2f}"]


def rooms(path: Path) -> Iterator[str]:
    """Settings side by side, and joint beside D-BAT; every other number is in the rows."""
    settings = {which: _read(path.with_stem(path.stem + suffix)) for which, suffix in ROOMS.items()}
    newest = settings.pop(NEWEST)
    titles = ["rewarded", "members", "solved by the agent", "seeds with at least .9", "solved by random choice"]
    yield f"Share of episodes solved, {NEWEST}.\n"
    yield from table(titles, _solved(newest))
    yield "The runs before, each with settings of its own.\n"
    earlier = [[which, *cells] for which, rows in reversed(settings.items()) for cells in _solved(rows)]
    yield from table(["batch", *titles], earlier)
    rows = []
    for method, title in ENSEMBLES.items():
        if method != "joint" and len(solved_by(newest, f"{method}-truth-shape", "agent")):
            rows.append([title, *(_joint_minus(newest, method, truth) for truth in TRUTHS)])
    yield "Joint minus the other, seed by seed: median of the differences.\n"
    yield from table(["", *TRUTHS], rows)
    yield "All four runs, forty seeds: D-BAT minus the other.\n"
    runs = [newest, *settings.values()]
    titles = [
        "D-BAT compared with",
        "rewarded",
        "D-BAT solves more by, mean",
        "D-BAT solves more by, median",
        "seeds on which D-BAT solves more",
    ]
    yield from table(titles, (row for method in ("none", "one") for row in _over_runs(runs, method)))


def _over_runs(runs: list[list[dict[str, str]]], method: str) -> Iterator[list[str]]:
    """Rows of what D-BAT solves more than another method, over the seeds of all runs."""
    gaps = []
    for truth in TRUTHS:
        of_dbat = np.concatenate([solved_by(rows, f"dbat-truth-{truth}", "agent") for rows in runs])
        of_other = np.concatenate([solved_by(rows, f"{method}-truth-{truth}", "agent") for rows in runs])
        gaps.append(of_dbat - of_other)
    gaps.append(np.mean(gaps, axis=0))
    for truth, values in zip((*TRUTHS, "either, mean of both"), gaps, strict=True):
        yield [ENSEMBLES[method], truth, f"{values.mean():.3f}", amount(values), won(values)]


def _joint_minus(rows: list[dict[str, str]], method: str, truth: str) -> str:
    joint, other = (solved_by(rows, f"{name}-truth-{truth}", "agent") for name in ("joint", method))
    return amount(joint - other)


def _mean(values: NDArray[np.float64], least: float = 0.0) -> str:
    defined = values[~np.isnan(values)]
    if not len(defined):
        return "-"
    few = f" (n = {len(defined)})" if len(defined) < len(values) else ""
    return f"{share(defined, least=least)}{few}"


def _reached(shares: NDArray[np.float64]) -> str:
    return f"{(shares >= 0.95).sum()} of {(~np.isnan(shares)).sum()}"


def main() -> None:
    """Take the numbers of a run, or draw the tables."""
    parser = parser_of(__doc__, run="the folder of the sweep")
    parser.add_argument("--baselines", type=Path, help="the folder of the sweep of baselines")
    arguments = parser.parse_args()
    if not arguments.tables:
        collect(arguments.run, arguments.csv, arguments.baselines)
    if arguments.csv.stem.startswith("rooms"):
        arguments.csv, drawn = arguments.csv.with_stem("rooms"), rooms
    else:
        drawn = tables
    print("\n".join(drawn(arguments.csv)))


if __name__ == "__main__":
    main()
