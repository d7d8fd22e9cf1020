"""Several evaluated runs side by side: whether they can be compared, what differs, and who wins (Spec F5, F7)."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import pandas as pd

from hypogoal.core.errors import UserError
from hypogoal.evaluation import curves, distance, hypotheses, rooms
from hypogoal.evaluation.house import pairs
from hypogoal.evaluation.page import DASH, Drawn, Results, displayed, draw_page, pairs_displayed, section, spans
from hypogoal.evaluation.provenance import domains_of

Runs = Mapping[str, Results]  # by a run's label
PARTS: dict[str, tuple[ModuleType, dict[str, str]]] = {  # by the name of a table: its question, and columns of labels
    "agents": (curves, {"method": "agent"}),
    "hypotheses": (hypotheses, hypotheses.BY),
    "rooms": (rooms, rooms.BY),
    "distance": (distance, distance.BY),
}


def labels_of(paths: Sequence[str]) -> list[str]:
    """Short names of runs: the last parts of their paths, as many as it takes to tell them apart."""
    parts = [path.rstrip("/").split("/") for path in paths]
    for count in range(1, max(map(len, parts)) + 1):
        names = ["/".join(part[-count:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    return list(paths)


def shared(runs: Runs) -> list[str]:
    """The kinds of results that every run has."""
    names = []
    for name, (question, _) in PARTS.items():
        if all(question.context(results) is not None for results in runs.values()):
            names.append(name)
    return names


def why_not(runs: Runs) -> str | None:
    """Why runs cannot be compared, in a few words; None where they can.

    They must be of one domain, evaluated with the same settings, and have at least one kind of result in common.
    """
    domains = {label: ", ".join(domains_of(results.facts)) for label, results in runs.items()}
    if len(set(domains.values())) > 1:
        return f"they are of different domains ({_each(domains)})"
    settings = [results.facts["settings"] for results in runs.values()]
    for key in sorted(set.intersection(*map(set, settings))):
        values = {label: results.facts["settings"][key] for label, results in runs.items()}
        if len(set(values.values())) > 1:
            return f"they were evaluated with different {key} ({_each(values)})"
    return None if shared(runs) else "they have no kind of result in common"


def _each(values: Mapping[str, Any]) -> str:
    return "; ".join(f"{label}: {value}" for label, value in values.items())


def differences(runs: Runs) -> pd.DataFrame:
    """What was not the same, a column per run: settings by the kind of artefact, seeds, data and versions."""
    texts: dict[tuple[str, str], dict[str, set[str]]] = {}
    for label, results in runs.items():
        for kind, settings in _settings(results):
            for name, value in settings.items():
                text = value if isinstance(value, str) else json.dumps(value, sort_keys=True)
                texts.setdefault((kind, name), {}).setdefault(label, set()).add(text)
    rows = []
    for (kind, name), by_run in sorted(texts.items()):
        values = {label: ", ".join(sorted(by_run.get(label, DASH))) for label in runs}
        if len(set(values.values())) > 1:
            rows.append({"of": kind, "setting": name} | values)
    return pd.DataFrame(rows, columns=["of", "setting", *runs])


def _settings(results: Results) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """(kind, settings) of the run's artefacts and data; the domain's settings are the data's own."""
    provenance = results.facts["provenance"]
    for artefact in provenance["artefacts"]:
        config = {name: value for name, value in artefact["config"].items() if name != "domain_config"}
        yield artefact["kind"], {"seed": artefact["seed"]} | config
        yield "versions", artefact["versions"]
        for item in artefact["inputs"]:
            if item["kind"] == "data":
                yield "data", {"sha256": item["sha256"][:10]}
    for data in provenance["data"]:
        yield "data", {"seed": data["seed"]} | data["config"]


def compare_runs(runs: Runs) -> pd.DataFrame:
    """Spec F5: the first run against each other, ``agent`` by agent and method by method, over what they share."""
    parts = []
    for name in shared(runs):
        question, _ = PARTS[name]
        values = {label: question.compared(results) for label, results in runs.items()}
        first = next(iter(values.values()))
        for method in first["method"].unique():
            alike = []
            for label, of_run in values.items():
                same = of_run[of_run["method"] == method]
                alike.append(same.assign(method=label, artefact=f"{label}/" + same["artefact"]))
            if all(len(each) for each in alike):
                parts.append(pairs(pd.concat(alike)).assign(of=method))
    return pd.concat(parts) if parts else pd.DataFrame(columns=["of", "quantity", "first", "second"])


def read_pairs(path: Path) -> pd.DataFrame:
    """The pairs of a comparison artefact; a ``UserError`` where they are missing or damaged."""
    try:
        return pd.read_csv(path / "pairs.csv").astype({"N": "Int64"})
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"the comparison cannot be read ({error})", path, "Compare the runs again.") from None


def winners(compared: pd.DataFrame) -> list[str]:
    """Who wins, by how much, on what: a line for each of :func:`compare_runs`; a winner where its interval has one."""
    lines = []
    for _, row in compared.iterrows():
        first, second, difference = row["first"], row["second"], row["difference"]
        low, high = row["difference_low"], row["difference_high"]
        better, worse = (first, second) if (difference > 0) == row["higher"] else (second, first)
        clear = low > 0 or high < 0
        who = f"{better} beats {worse}" if clear else f"no clear winner of {first} and {second}"
        between = "" if pd.isna(low) else f", 95 % [{low:.3g}, {high:.3g}], n = {row['units']}"
        won = f"{first} wins {row['wins']} of {row['n']}, {row['ties']} tied"
        groups = "" if pd.isna(row["N"]) else f", N={row['N']}"
        subject = f"{row['of']}{groups}: {row['quantity'].replace('_', ' ')}"
        lines.append(f"{subject}: {who} ({first} {difference:+.3g}{between}; {won})")
    return lines or ["no pairs: no two runs share a seed of the same agent or method"]


def page_of(runs: Runs, paths: Sequence[str]) -> tuple[str, list[Drawn], dict[str, pd.DataFrame]]:
    """The page of a comparison, its figures, and its tables by name."""
    names = shared(runs)
    compared = compare_runs(runs)
    tables = {"pairs": compared, "differences": differences(runs)}
    figures = list(_curves(runs)) if "agents" in names else []
    of_parts = []
    for name in names:
        question, by = PARTS[name]
        of_runs = [question.tables(results)[name].assign(run=label) for label, results in runs.items()]
        tables[name] = pd.concat(of_runs).sort_values([*by], kind="stable")
        shown = displayed(tables[name], {**by, "run": "run"}, question.COLUMNS)
        of_parts.append({"name": name, "title": question.TITLE, "table": shown})
    shown_pairs = pairs_displayed(compared.assign(quantity=compared["of"] + ": " + compared["quantity"]), {})
    context = {
        "runs": _described(runs, paths),
        "labels": [*runs],
        "domains": domains_of(next(iter(runs.values())).facts),
        "differences": tables["differences"].set_index(["of", "setting"]),
        "parts": of_parts,
        "figures": figures,
        "pairs": shown_pairs,
    }
    part = section("compared", context)
    title = f"hypogoal: {len(runs)} runs compared"
    return draw_page(title, [("compared", "What is compared", part, False)], "page.html"), figures, tables


def _described(runs: Runs, paths: Sequence[str]) -> pd.DataFrame:
    rows = []
    for (label, results), path in zip(runs.items(), paths, strict=True):
        artefacts = results.facts["provenance"]["artefacts"]
        seeds = spans(artefact["seed"] for artefact in artefacts)
        layouts = [artefact["config"]["layout_seed"] for artefact in artefacts if "layout_seed" in artefact["config"]]
        numbers = {"artefacts": str(len(artefacts)), "seeds": seeds, "layouts": spans(layouts)}
        rows.append({"run": label, "folder": path} | numbers)
    return pd.DataFrame(rows).set_index(["run", "folder"])


def _curves(runs: Runs) -> Iterator[Drawn]:
    """Of each agent that every run has its reward and length, a line per run."""
    agents = [set(results.facts["agents"]) for results in runs.values()]
    for name in sorted(set.intersection(*agents)):
        for quantity, label in curves.FIGURES.items():
            parts = []
            for run, results in runs.items():
                rows = results.of(quantity=quantity, method=name)
                rows = rows[rows["step"].notna()]
                parts.append(rows.assign(method=run, artefact=f"{run}/" + rows["artefact"]))
            drawn = pd.concat(parts)
            if drawn["value"].nunique() > 1:
                figure = curves.learning_curves(drawn, label, {}, (None, None))
                yield Drawn(f"{quantity}-{name}", f"{name}: {label.lower()}", figure, {"agent": name})
