"""Several evaluated runs side by side: whether they can be compared, what differs, and who wins (Spec F5, F7)."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import cycle
from operator import itemgetter
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from hypogoal.evaluation import curves, distance, hypotheses, page, rooms
from hypogoal.evaluation.numbers import Metrics, Rows, grouped, plain
from hypogoal.evaluation.page import Block, Column, Drawn, Entry, Material
from hypogoal.evaluation.plots import PALETTE, STYLES
from hypogoal.evaluation.provenance import domains_of
from hypogoal.evaluation.questions import meanings
from hypogoal.evaluation.table import Pairs, Row, compared, select

Runs = Mapping[str, Metrics]  # a run's label -> its metrics
Curves = Mapping[str, Mapping[str, NDArray[Any]]]  # a run's label -> the arrays of its learning curves
TABLES = ("agents", "hypotheses", "rooms", "distance")
LADDERS = [page.label("method", "method"), rooms.N]


@dataclass(frozen=True)
class Part:
    """A kind of result, as it stands beside other runs'."""

    title: str  # of its section
    entries: Callable[[Metrics], Sequence[Entry]]  # the rows of its table in a run's metrics
    first: Sequence[Column]  # columns before that of the run; rows alike in them stand together, and show them once
    then: Sequence[Column]  # columns behind it
    caption: str  # of the table
    pairs: Pairs  # of runs


def labels_of(paths: Sequence[str]) -> list[str]:
    """Short names of runs: the last parts of their paths, as many as it takes to tell them apart."""
    parts = [path.rstrip("/").split("/") for path in paths]
    for count in range(1, max(map(len, parts)) + 1):
        names = ["/".join(part[-count:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    return list(paths)


def why_not(runs: Runs) -> str | None:
    """Why runs cannot be compared, in a few words; None where they can.

    They must be of one domain, evaluated with the same settings, and have at least one kind of result in common.
    """
    settings = [metrics["settings"] for metrics in runs.values()]
    values = {"they are of different domains": [domains_of(metrics) for metrics in runs.values()]}
    for key in sorted(set.intersection(*map(set, settings))):
        values[f"they were evaluated with different {key}"] = [[str(of_run[key])] for of_run in settings]
    values["they have no kind of result in common"] = [shared({label: runs[label]}) or ["nothing"] for label in runs]
    for reason, texts in values.items():
        if any(text != texts[0] for text in texts) and not (reason.startswith("they have") and shared(runs)):
            return f"{reason} ({'; '.join(map(': '.join, zip(runs, map(', '.join, texts), strict=True)))})"
    return None


def comparison_of(paths: Sequence[Path], runs: Runs, rows: Mapping[str, Sequence[Row]]) -> dict[str, Any]:
    """What ``metrics.json`` of a comparison holds: what the runs are, how they differ, who wins."""
    described = []
    for (label, metrics), path in zip(runs.items(), paths, strict=True):
        artefacts = metrics["provenance"]["artefacts"]
        layouts = {artefact["config"]["layout_seed"] for artefact in artefacts if "layout_seed" in artefact["config"]}
        seeds = {artefact["seed"] for artefact in artefacts}
        counts = {"artefacts": len(artefacts), "seeds": sorted(seeds), "layout_seeds": sorted(layouts)}
        described.append({"label": label, "path": str(path), **counts})
    comparison = {
        "runs": described,
        "domains": domains_of(next(iter(runs.values()))),
        "shared": shared(runs),
        "differences": differences(runs),
        "comparisons": plain(compare_runs(rows)),
    }
    for table in TABLES:
        comparison[table] = {label: metrics[table] for label, metrics in runs.items()}
    return comparison | {"quantities": meanings()}


def shared(runs: Runs) -> list[str]:
    """The kinds of results that every run has."""
    return [name for name, part in PARTS.items() if all(part.entries(metrics) for metrics in runs.values())]


def differences(runs: Runs) -> list[dict[str, Any]]:
    """What was not the same: settings by the kind of artefact, seeds, data and versions.

    Rows have ``of`` (an artefact's kind, ``data`` or ``versions``), ``setting`` and ``values``, one text per run.
    """
    texts: dict[tuple[str, str], dict[str, set[str]]] = {}
    for label, metrics in runs.items():
        for kind, settings in _settings(metrics):
            for name, value in settings.items():
                text = value if isinstance(value, str) else json.dumps(value, sort_keys=True)
                texts.setdefault((kind, name), {}).setdefault(label, set()).add(text)
    rows = []
    for (kind, name), by_run in sorted(texts.items()):
        values = {label: ", ".join(sorted(by_run.get(label, "–"))) for label in runs}
        if len(set(values.values())) > 1:
            rows.append({"of": kind, "setting": name, "values": values})
    return rows


def _settings(metrics: Metrics) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """(kind, settings) of the run's artefacts and data; the domain's settings are the data's own."""
    for artefact in metrics["provenance"]["artefacts"]:
        config = {name: value for name, value in artefact["config"].items() if name != "domain_config"}
        yield artefact["kind"], {"seed": artefact["seed"]}
        yield artefact["kind"], config
        yield "versions", artefact["versions"]
        yield from (("data", {"sha256": item["sha256"][:10]}) for item in artefact["inputs"] if item["kind"] == "data")
    for data in metrics["provenance"]["data"]:
        yield "data", {"seed": data["seed"]}
        yield "data", data["config"]


def compare_runs(rows: Mapping[str, Sequence[Row]]) -> Rows:
    """Spec F5: the first run against each other, agent by agent and method by method, over what they share.

    ``rows`` are each run's numbers by its label. Entries are those of ``numbers.pairs``, with the agent or the method
    in ``where``.
    """
    entries: Rows = []
    for part in PARTS.values():
        wanted = {(number.quantity, number.scope) for number in part.pairs.numbers.values()}
        names = [
            dict.fromkeys(row.method for row in of_run if (row.quantity, row.scope) in wanted)
            for of_run in rows.values()
        ]
        for name in (name for name in names[0] if all(name in others for others in names)):
            alike = [
                row._replace(method=run, artefact=f"{run}/{row.artefact}")
                for run, of_run in rows.items()
                for row in select(of_run, method=name)
            ]
            compared_pairs = compared(alike, replace(part.pairs, ranked=False))
            entries += [{**entry, "where": ", ".join(filter(None, [name, entry["where"]]))} for entry in compared_pairs]
    return entries


def winners(comparisons: Rows) -> list[str]:
    """Who wins, by how much, on what: a line for each of :func:`compare_runs`; a winner where its interval has one."""
    lines = []
    for row in (row for row in comparisons if row["n"]):
        (low, high), first, second = row["difference_interval"], row["first"], row["second"]
        clear = low is not None and (low > 0 or high < 0)
        order = (first, second) if (row["difference"] > 0) == row["higher"] else (second, first)
        who = "{} beats {}".format(*order) if clear else f"no clear winner of {first} and {second}"
        between = f", 95 % [{low:.3g}, {high:.3g}], n = {row['units']}" if low is not None else ""
        won = f"{first} wins {row['wins']} of {row['n']}, {row['ties']} tied"
        subject = ": ".join(filter(None, [row["where"], row["quantity"].replace("_", " ")]))
        lines.append(f"{subject}: {who} ({first} {row['difference']:+.3g}{between}; {won})")
    return lines or ["no pairs: no two runs share a seed of the same agent or method"]


def compared_sections(runs: Runs, arrays: Curves, comparison: Mapping[str, Any], material: Material) -> list[Block]:
    """The page's sections; of results only those that every run has.

    ``comparison`` has ``runs``, ``shared``, ``differences`` and ``comparisons``; figures are added to the material.
    """
    results = [_result(name, PARTS[name], runs, arrays, material) for name in comparison["shared"]]
    return [_runs(comparison), _differences(comparison), *results, _pairs(comparison)]


def _result(name: str, part: Part, runs: Runs, arrays: Curves, material: Material) -> Block:
    """The entries of all runs in one table, and the learning curves of agents."""

    def alike(entry: Entry) -> tuple[str, ...]:
        return tuple(str(column.of(entry)) for column in part.first)

    entries = [{**entry, "run": run} for run, metrics in runs.items() for entry in part.entries(metrics)]
    together = [entry for group in grouped(entries, alike).values() for entry in group]
    columns = [*(column._replace(once=column.once or alike) for column in part.first), page.label("run", "run")]
    columns += part.then
    table = page.table(columns, together, tight=name != "agents", caption=part.caption)
    drawn = [page.shown(material, figure) for figure in _curves(runs, arrays)] if name == "agents" else []
    return page.section(name, part.title, [], [table, *drawn])


def _runs(comparison: Entry) -> Block:
    columns = [
        page.label("run", "label"),
        page.label("folder", "path"),
        page.label("artefacts", lambda run: str(run["artefacts"])),
        page.label("seeds", lambda run: page.spans(run["seeds"])),
        page.label("layouts", lambda run: page.spans(run["layout_seeds"])),
    ]
    labels = [run["label"] for run in comparison["runs"]]
    text = (
        f"Evaluated runs of {page.listed(comparison['domains'])}: {page.listed(labels)}. "
        "The first is the one that the others are compared with. Each run's own report has everything else."
    )
    runs = page.table(columns, comparison["runs"], wrap=True, main=lambda run: bool(run is comparison["runs"][0]))
    return page.section("summary", "What is compared", [text], [runs])


def _differences(comparison: Entry) -> Block:
    names = [run["label"] for run in comparison["runs"]]
    values = [page.label(name, lambda line, name=name: line["values"][name]) for name in names]  # names may have dots
    lines = comparison["differences"]
    text = (
        "Settings, seeds, data and versions that are not the same in all runs; several values are of several artefacts "
        "in one run. What is not here is the same."
        if lines
        else "Nothing: settings, seeds, data and versions are the same."
    )
    columns = [page.label("of", "of", once=True), page.label("setting", "setting"), *values]
    return page.section("differences", "What differs", [text], [page.table(columns, lines, wrap=True)] if lines else [])


def _curves(runs: Runs, arrays: Curves) -> Iterator[Drawn]:
    """Of each agent that every run has its reward and length, a line per run; of all agents where there is none."""
    agents = [(run, index, agent) for run in runs for index, agent in enumerate(runs[run]["agents"])]
    by_name = grouped(agents, lambda item: str(item[2]["name"]))
    common = {name: alike for name, alike in by_name.items() if len(alike) == len(runs)}
    for number, (name, shown) in enumerate((common or {"every agent": agents}).items()):
        for quantity, (heading, axis) in curves.AXES.items():
            lines = []
            for (run, index, agent), colour, style in zip(shown, cycle(PALETTE), cycle(STYLES)):
                values = curves.values_of(agent, arrays[run][f"curves/{index}/{quantity}"])
                label = run if common else f"{run}: {agent['name']}"
                lines.append(curves.Line(label, arrays[run]["curves/grid"], values, colour, style))
            if curves.is_flat(quantity, lines):
                continue
            counts = "; ".join(f"{run}, {curves.runs_of(agent)}" for run, _, agent in shown)
            caption = (
                f"{name}: {axis}, mean over the last 100 episodes known at each step. Lines: mean over layouts and "
                f"seeds; {curves.BANDS} over them."
            )
            title, drawn = f"{heading}: {name}", curves.learning_curves(lines, quantity)
            kind = "reward" if quantity == "reward" else "length"
            yield Drawn(f"{kind}-{number}", title, drawn, caption, f"{counts}.", heading=title)


def _pairs(comparison: Mapping[str, Any]) -> Block:
    first = comparison["runs"][0]["label"]
    shared, units = "seed, and layout, sub-goal or ladder", "layouts (or seeds of ensembles or of one layout)"
    blocks = page.comparison_tables(comparison["comparisons"], shared, units)
    text = (
        f"{first} against each other run, over what both have with the same seed."
        if blocks
        else "No two runs share a seed (and layout, sub-goal or ladder) of the same agent or method: no pairs."
    )
    return page.section("pairs", "Who wins, seed by seed", [text], blocks)


PARTS: Mapping[str, Part] = {
    "agents": Part(
        "Agents", itemgetter("agents"), [curves.AGENT], curves.HEADLINE, f"{curves.HEADLINE_CAPTION}.", curves.PAIRS
    ),
    "hypotheses": Part(
        "Hypotheses",
        itemgetter("hypotheses"),
        [hypotheses.ENSEMBLE, page.label("sub-goal", "sub_goal")],
        [*hypotheses.SCORES, hypotheses.DISAGREE, hypotheses.SEEDS],
        hypotheses.CAPTION,
        hypotheses.PAIRS,
    ),
    "rooms": Part(
        "Hypotheses in rooms without labels",
        itemgetter("rooms"),
        LADDERS,
        rooms.UNSEEN,
        "Balanced accuracy on unseen rooms of the best, the validated, the mean and the worst member; accuracy of the "
        "best member on all rooms (the paper's Figure 3). Mean over ensemble seeds ± standard deviation.",
        rooms.PAIRS,
    ),
    "distance": Part(
        "Options on ladders",
        lambda metrics: metrics["distance"]["over_ladders"],
        LADDERS,
        [
            page.label("ladders", lambda entry: ", ".join(entry["ladders"])),
            *distance.STOPPED,
            distance.SHARED[0],
            distance.SEEDS,
        ],
        "Distance from where options stop to the true sub-goal, mean over the ladders named; share of the best "
        "member's executions that got there. Mean over seeds ± standard deviation. Only the same ladders compare.",
        distance.PAIRS,
    ),
}
