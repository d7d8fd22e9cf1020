"""Several evaluated runs side by side: whether they can be compared, what differs, and who wins (Spec F5, F7)."""

from __future__ import annotations

import json
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.evaluation import curves, distance, hypotheses, rooms
from hypogoal.evaluation.numbers import Metrics, Rows
from hypogoal.evaluation.page import (
    Block,
    Column,
    Drawn,
    Entry,
    Material,
    comparison_tables,
    label,
    listed,
    pick,
    section,
    shown,
    table,
)
from hypogoal.evaluation.plots import PALETTE
from hypogoal.evaluation.provenance import domains_of

Runs = Mapping[str, Metrics]  # a run's label -> its metrics
Curves = Mapping[str, Mapping[str, NDArray[Any]]]  # a run's label -> the arrays of its learning curves
TABLES: Mapping[str, Callable[[Metrics], Sequence[Any]]] = {
    "agents": lambda metrics: metrics["agents"],
    "hypotheses": lambda metrics: metrics["hypotheses"],
    "rooms": lambda metrics: metrics["rooms"],
    "distance": lambda metrics: metrics["distance"]["over_ladders"],
}
MOST_LINES = len(PALETTE)  # in one figure
POINTS = 151
RUN = label("run", "run")


def labels_of(paths: Sequence[str]) -> list[str]:
    """Short names of runs: the last parts of their paths, as many as it takes to tell them apart."""
    parts = [path.rstrip("/").split("/") for path in paths]
    for count in range(1, max(map(len, parts)) + 1):
        names = ["/".join(part[-count:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    return list(paths)


def why_not(runs: Mapping[str, Metrics]) -> str | None:
    """Why runs cannot be compared, in a few words; None where they can.

    They must be of one domain, evaluated with the same settings, and have at least one kind of result in common.
    """
    domains = {label: domains_of(metrics) for label, metrics in runs.items()}
    if len({tuple(names) for names in domains.values()}) > 1:
        return "they are of different domains (" + _told(domains) + ")"
    common = set.intersection(*(set(metrics["settings"]) for metrics in runs.values()))
    for key in sorted(common):
        values = {label: [str(metrics["settings"][key])] for label, metrics in runs.items()}
        if len({own[0] for own in values.values()}) > 1:
            return f"they were evaluated with different {key} (" + _told(values) + ")"
    if not shared(runs):
        has = {label: [name for name in TABLES if TABLES[name](metrics)] for label, metrics in runs.items()}
        return "they have no kind of result in common (" + _told(has) + ")"
    return None


def _told(values: Mapping[str, Sequence[str]]) -> str:
    return "; ".join(f"{label}: {', '.join(own) or 'nothing'}" for label, own in values.items())


def shared(runs: Mapping[str, Metrics]) -> list[str]:
    """The kinds of results that every run has."""
    return [name for name, table in TABLES.items() if all(table(metrics) for metrics in runs.values())]


def differences(runs: Mapping[str, Metrics]) -> list[dict[str, Any]]:
    """What was not the same: settings by the kind of artefact, seeds, layouts, data and versions.

    Returns:
        Rows with ``of`` (an artefact's kind, ``data`` or ``versions``), ``setting`` and ``values``, one text per run.
    """
    told = {label: _settings(metrics) for label, metrics in runs.items()}
    keys = list(dict.fromkeys(key for own in told.values() for key in own))
    rows = []
    for of, name in sorted(keys):
        values = {label: ", ".join(sorted(own.get((of, name), {"–"}))) for label, own in told.items()}
        if len(set(values.values())) > 1:
            rows.append({"of": of, "setting": name, "values": values})
    return rows


def _settings(metrics: Metrics) -> dict[tuple[str, str], set[str]]:
    """(kind, setting) -> every value that the run's artefacts have."""
    found: dict[tuple[str, str], set[str]] = {}

    def add(of: str, name: str, value: Any) -> None:
        text = value if isinstance(value, str) else json.dumps(value, sort_keys=True)
        found.setdefault((of, name), set()).add(text)

    about = metrics["provenance"]
    for artefact in about["artefacts"]:
        kind = artefact["kind"]
        add(kind, "seed", artefact["seed"])
        for name, value in artefact["config"].items():
            if name == "domain_config":
                continue  # the data's own settings, told below
            add(kind, name, value)
        for package, version in artefact["versions"].items():
            add("versions", package, version)
        for entry in artefact["inputs"]:
            if entry["kind"] == "data":
                add("data", "sha256", entry["sha256"][:10])
    for data in about["data"]:
        add("data", "seed", data["seed"])
        for name, value in data["config"].items():
            add("data", name, value)
    return found


def compare_runs(runs: Runs) -> Rows:
    """Spec F5: the first run against each other, agent by agent and method by method, over what they share.

    Args:
        runs: numbers by label, the first being the one that the others are compared with.

    Returns:
        Rows of ``numbers.pairs``, with the agent or the method in ``where``.
    """

    def ensembles(metrics: Metrics, *, by_room: bool) -> list[Entry]:
        return [one for one in metrics["ensembles"] if any("rooms" in goal for goal in one["sub_goals"]) == by_room]

    kinds: list[tuple[str, Callable[[Metrics], Sequence[Entry]], Callable[[Sequence[Entry]], Rows]]] = [
        ("name", lambda metrics: metrics["agents"], curves.against),
        ("name", lambda metrics: ensembles(metrics, by_room=False), lambda own: hypotheses.against(own, ranked=False)),
        ("method", lambda metrics: ensembles(metrics, by_room=True), lambda own: rooms.against(own, ranked=False)),
        ("method", lambda metrics: metrics["distance"]["options"], lambda own: distance.against(own, ranked=False)),
    ]
    found: Rows = []
    for key, of, against in kinds:
        tables = {run: of(metrics) for run, metrics in runs.items()}
        for name in common_names(list(tables.values()), key):
            own = [{**one, key: run} for run, entries in tables.items() for one in entries if one[key] == name]
            found += [{**row, "where": ", ".join(filter(None, [name, row["where"]]))} for row in against(own)]
    return found


def common_names(tables: Sequence[Sequence[Mapping[str, Any]]], key: str = "name") -> list[str]:
    """The names that every table has, in the first one's order."""
    first, *others = tables
    names = dict.fromkeys(row[key] for row in first)
    return [name for name in names if all(any(row[key] == name for row in other) for other in others)]


def on_grid(values: NDArray[np.float64], own: NDArray[np.int64], grid: NDArray[np.int64]) -> NDArray[np.float64]:
    """Curves (R, G) known at steps ``own`` (G,) at those of ``grid`` (H,): the last value known; NaN past the end."""
    index = np.searchsorted(own, grid, side="right") - 1
    return np.where((index >= 0) & (grid <= own[-1]), values[:, np.maximum(index, 0)], np.nan)


def beside(runs: Runs, rows: Callable[[Metrics], Sequence[Entry]], *keys: str) -> list[Entry]:
    """Entries of all runs with their ``run``, those alike in the keys next to each other."""
    found = [{**one, "run": run} for run, metrics in runs.items() for one in rows(metrics)]
    order = list(dict.fromkeys(_alike(one, *keys) for one in found))
    return sorted(found, key=lambda one: order.index(_alike(one, *keys)))


def _alike(one: Entry, *keys: str) -> tuple[Hashable, ...]:
    return tuple(one[key] for key in keys)


def once(columns: Sequence[Column], *keys: str) -> list[Column]:
    """Columns that are shown where an entry is not like the one before it in the keys."""
    return [column._replace(once=lambda one: _alike(one, *keys)) for column in columns]


def compared_sections(runs: Runs, arrays: Curves, about: Mapping[str, Any], material: Material) -> list[Block]:
    """The page's sections; of results only those that every run has.

    Args:
        runs: in the order given; the first is the one that the others are compared with.
        arrays: of their learning curves.
        about: the comparison's own numbers: ``runs``, ``shared``, ``differences``, ``comparisons``.
        material: figures are added to it.
    """
    parts: dict[str, Callable[[], Block]] = {
        "agents": lambda: _agents(runs, arrays, material),
        "hypotheses": lambda: _hypotheses(runs),
        "rooms": lambda: _rooms(runs, material),
        "distance": lambda: _distance(runs),
    }
    results = [make() for name, make in parts.items() if name in about["shared"]]
    return [_runs(about), _differences(about), *results, _pairs(about)]


def _runs(about: Entry) -> Block:
    columns = [
        label("run", "label"),
        label("folder", "path"),
        label("artefacts", lambda one: str(one["artefacts"])),
        label("seeds", lambda one: listed(one["seeds"])),
        label("layouts", lambda one: listed(one["layout_seeds"])),
    ]
    text = (
        f"Evaluated runs of {listed(about['domains'])}: {listed([one['label'] for one in about['runs']])}. The first "
        "is the one that the others are compared with. Each run's own report has everything else."
    )
    found = table(columns, about["runs"], wrap=True, main=lambda one: bool(one is about["runs"][0]))
    return section("summary", "What is compared", [text], [found])


def _differences(about: Entry) -> Block:
    labels = [one["label"] for one in about["runs"]]
    own = [label(run, lambda one, run=run: one["values"][run]) for run in labels]
    lines = about["differences"]
    text = (
        "Settings, seeds, data and versions that are not the same in all runs; several values are of several artefacts "
        "in one run. What is not here is the same."
        if lines
        else "Nothing: settings, seeds, data and versions are the same."
    )
    columns = [label("of", "of", once=True), label("setting", "setting"), *own]
    return section("differences", "What differs", [text], [table(columns, lines, wrap=True)] if lines else [])


def _agents(runs: Runs, arrays: Curves, material: Material) -> Block:
    blocks = []
    for index, name in enumerate(common_names([metrics["agents"] for metrics in runs.values()])):
        for quantity in ("reward", "length"):
            wanted = [(run, name, run) for run in runs]
            blocks.append(shown(material, _curve(runs, arrays, f"{quantity}-{index}", quantity, wanted, name)))
    if not blocks:
        wanted = [(run, agent["name"], f"{run}: {agent['name']}") for run in runs for agent in runs[run]["agents"]]
        for quantity in ("reward", "length"):
            blocks.append(shown(material, _curve(runs, arrays, quantity, quantity, wanted, "every agent")))
    caption = (
        "Over the last 100 training episodes of each run of an agent: mean ± standard error. 95 % at: median number of "
        "environment steps at which 95 of the last 100 episodes succeeded, or how many runs got there."
    )
    columns = [*once([curves.AGENT], "name"), RUN, *curves.HEADLINE]
    entries = beside(runs, lambda metrics: metrics["agents"], "name")
    return section("agents", "Agents", [], [table(columns, entries, caption=caption), *blocks])


def _curve(
    runs: Runs, arrays: Curves, identity: str, quantity: str, wanted: Sequence[tuple[str, str, str]], name: str
) -> Drawn:
    """A figure with a line for each (run, agent, what it is called)."""
    drawn = wanted[:MOST_LINES]
    end = max(int(arrays[run]["curves/grid"][-1]) for run, _, _ in drawn)
    grid = np.linspace(0, end, POINTS).round().astype(np.int64)
    lines = []
    for index, (run, agent, called) in enumerate(drawn):
        place = [one["name"] for one in runs[run]["agents"]].index(agent)
        own = arrays[run]
        values = on_grid(own[f"curves/{place}/{quantity}"], own["curves/grid"], grid)
        lines.append(curves.Line(called, values, PALETTE[index], dashed=index % 2 == 1))
    axis = "reward per episode" if quantity == "reward" else "episode length (steps)"
    bounds = curves.reward_bounds(lines) if quantity == "reward" else (0.0, None)
    counts = "; ".join(f"{run}, {_count(runs[run], agent)}" for run, agent, _ in drawn)
    more = f" Not drawn: {listed([called for _, _, called in wanted[MOST_LINES:]])}." if wanted[MOST_LINES:] else ""
    caption = (
        f"{name}: {axis}, mean over the last 100 episodes known at each step. Lines: mean over layouts and seeds; "
        f"bands: ± one standard error over them ({counts}).{more}"
    )
    title = f"{'Undiscounted reward' if quantity == 'reward' else 'Episode length'}: {name}"
    return Drawn(identity, title, curves.learning_curves(grid, lines, axis, (), bounds), caption, heading=title)


def _count(metrics: Mapping[str, Any], agent: str) -> str:
    found = pick(metrics["agents"], "name", agent)["runs"]
    layouts, seeds = (sorted({run[key] for run in found}) for key in ("layout_seed", "seed"))
    count = f"{len(found)} run{'s' if len(found) > 1 else ''}"
    return f"{count}: layout seeds {listed(layouts)}, run seeds {listed(seeds)}"


def _hypotheses(runs: Runs) -> Block:
    caption = (
        "Balanced accuracy on held-out layouts of the best, mean and worst member, and the share of held-out states on "
        "which two members disagree; mean over ensemble seeds ± standard error."
    )
    columns = [
        hypotheses.ENSEMBLE,
        *once([label("sub-goal", "sub_goal")], "name", "sub_goal"),
        RUN,
        *hypotheses.SCORES,
        hypotheses.DISAGREE,
        hypotheses.SEEDS,
    ]
    entries = beside(runs, lambda metrics: metrics["hypotheses"], "name", "sub_goal")
    return section("hypotheses", "Hypotheses", [], [table(columns, entries, tight=True, caption=caption)])


def _rooms(runs: Runs, material: Material) -> Block:
    blocks = []
    for index, name in enumerate(common_names([metrics["rooms"] for metrics in runs.values()], "method")):
        rows = [
            {**one, "method": run} for run, metrics in runs.items() for one in metrics["rooms"] if one["method"] == name
        ]
        if all(one["groups"] is None for one in rows) or len({one["sub_goal"] for one in rows}) > 1:
            continue
        panels = [
            rooms.panel(rows, f"{which} member, unseen rooms", "unseen", "balanced_accuracy", which)
            for which in ("best", "validated")
        ]
        caption = (
            f"{name}: balanced accuracy on rooms that training never saw, against labelled ladder groups. Lines: mean "
            f"over ensemble seeds; {rooms.bands(rows)}: ± one standard deviation over seeds. Dotted: chance."
        )
        title, drawn = f"Scores on unseen rooms: {name}", rooms.scores_over_groups(panels, list(runs))
        blocks.append(shown(material, Drawn(f"rooms-{index}", title, drawn, caption, heading=title)))
    caption = (
        "Balanced accuracy on unseen rooms of the best, the validated, the mean and the worst member; accuracy of the "
        "best member on all rooms (the paper's Figure 3). Mean over ensemble seeds ± standard deviation."
    )
    columns = [*once([rooms.METHOD, rooms.N], "method", "groups"), RUN, *rooms.UNSEEN]
    entries = beside(runs, lambda metrics: metrics["rooms"], "method", "groups")
    blocks.append(table(columns, entries, tight=True, caption=caption))
    return section("rooms", "Hypotheses against labelled ladders", [], blocks)


def _distance(runs: Runs) -> Block:
    caption = (
        "Distance (units of position, lower is better) from where options stop to the nearest true base, mean over the "
        "ladders named: of the best, the validated, the mean and the worst member; share of the best member's "
        "executions that got to one. Mean over seeds ± standard deviation. Runs with other ladders are not alike."
    )
    columns = [
        *once([rooms.METHOD, rooms.N], "method", "groups"),
        RUN,
        label("ladders", lambda one: ", ".join(one["ladders"])),
        *distance.STOPPED,
        distance.SHARED[0],
        distance.SEEDS,
    ]
    entries = beside(runs, lambda metrics: metrics["distance"]["over_ladders"], "method", "groups")
    return section("distance", "Options on ladders", [], [table(columns, entries, tight=True, caption=caption)])


def _pairs(about: Mapping[str, Any]) -> Block:
    first = about["runs"][0]["label"]
    digits = {"length": 0, "success": 2, "discounted_return": 2, "distance, best member": 1}
    rows = about["comparisons"]
    blocks = comparison_tables(rows, "seed, and layout, sub-goal or ladder", "layouts, or seeds of ensembles,", digits)
    text = (
        f"{first} against each other run, over what both have with the same seed."
        if blocks
        else "No two runs share a seed (and layout, sub-goal or ladder) of the same agent or method: no pairs."
    )
    return section("pairs", "Who wins, seed by seed", [text], blocks)
