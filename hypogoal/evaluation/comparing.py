"""Several evaluated runs side by side: whether they can be compared, what differs, and who wins (Spec F5, F7)."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.evaluation.comparisons import (
    Rows,
    compare_agents,
    compare_distances,
    compare_hypotheses,
    compare_rooms,
)

Metrics = Mapping[str, Any]
TABLES: Mapping[str, Callable[[Metrics], Sequence[Any]]] = {
    "agents": lambda metrics: metrics["agents"],
    "hypotheses": lambda metrics: metrics["hypotheses"],
    "rooms": lambda metrics: metrics["rooms"],
    "distance": lambda metrics: metrics["distance"]["over_ladders"],
}


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


def domains_of(metrics: Metrics) -> list[str]:
    """The domains of a run's data and artefacts."""
    about = metrics["provenance"]
    named = [data["domain"] for data in about["data"]]
    named += [artefact["config"]["domain"] for artefact in about["artefacts"] if "domain" in artefact["config"]]
    return sorted(set(named))


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


def compare_runs(runs: Mapping[str, Metrics]) -> Rows:
    """Spec F5: the first run against each other, agent by agent and method by method, over what they share.

    Args:
        runs: numbers by label, the first being the one that the others are compared with.

    Returns:
        Rows of ``comparisons``, with the agent or the method in ``where``.
    """
    rows: Rows = []
    for name in common_names([metrics["agents"] for metrics in runs.values()]):
        own = [
            {**agent, "name": label}
            for label, metrics in runs.items()
            for agent in metrics["agents"]
            if agent["name"] == name
        ]
        rows += [{**row, "where": name} for row in compare_agents(own)]
    for compare, key, judged in ((compare_hypotheses, "name", False), (compare_rooms, "method", True)):
        names = [[one for one in metrics["ensembles"] if _by_room(one) == judged] for metrics in runs.values()]
        for name in common_names(names, key):
            own = [
                {**one, key: label}
                for label, ensembles in zip(runs, names, strict=True)
                for one in ensembles
                if one[key] == name
            ]
            rows += [{**row, "where": _where(name, row["where"])} for row in compare(own, ranked=False)]
    options = [metrics["distance"]["options"] for metrics in runs.values()]
    for name in common_names(options, "method"):
        own = [
            {**one, "method": label}
            for label, found in zip(runs, options, strict=True)
            for one in found
            if one["method"] == name
        ]
        rows += [{**row, "where": _where(name, row["where"])} for row in compare_distances(own, ranked=False)]
    return rows


def _by_room(ensemble: Mapping[str, Any]) -> bool:
    return any("rooms" in goal for goal in ensemble["sub_goals"])


def _where(name: str, where: str) -> str:
    return f"{name}, {where}" if where else name


def common_names(tables: Sequence[Sequence[Mapping[str, Any]]], key: str = "name") -> list[str]:
    """The names that every table has, in the first one's order."""
    first, *others = tables
    names = dict.fromkeys(row[key] for row in first)
    return [name for name in names if all(any(row[key] == name for row in other) for other in others)]


def on_grid(values: NDArray[np.float64], own: NDArray[np.int64], grid: NDArray[np.int64]) -> NDArray[np.float64]:
    """Curves (R, G) known at steps ``own`` (G,) at those of ``grid`` (H,): the last value known; NaN past the end."""
    index = np.searchsorted(own, grid, side="right") - 1
    return np.where((index >= 0) & (grid <= own[-1]), values[:, np.maximum(index, 0)], np.nan)
