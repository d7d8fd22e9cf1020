"""Several evaluated runs side by side: whether they can be compared, what differs, and who wins (Spec F5, F7)."""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import pandas as pd

from hypogoal.core.errors import UserError
from hypogoal.evaluation import curves, distance, hypotheses, rooms
from hypogoal.evaluation.house import over, pairs
from hypogoal.evaluation.page import DASH, Drawn, Results, displayed, draw_page, module, section
from hypogoal.evaluation.provenance import domains_of
from hypogoal.evaluation.questions import name_of, paired_runs

Runs = Mapping[str, Results]  # by a run's label
QUESTIONS: tuple[ModuleType, ...] = (curves, hypotheses, rooms, distance)


def labels_of(paths: Sequence[str]) -> list[str]:
    """Short names of runs: what their paths have not in common."""
    common = os.path.commonpath([os.path.dirname(path) for path in paths])
    return [os.path.relpath(path, common) for path in paths]


def shared(runs: Runs) -> list[ModuleType]:
    """The questions of which every run has results."""
    questions = []
    for question in QUESTIONS:
        counts = [len(question.runs(results)) for results in runs.values()]
        if min(counts) > 0:
            questions.append(question)
    return questions


def why_not(runs: Runs) -> str | None:
    """Why runs cannot be compared, in a few words; None where they can.

    They must be of one domain and have at least one kind of result in common.
    """
    domains = {label: ", ".join(domains_of(results.facts)) for label, results in runs.items()}
    if len(set(domains.values())) > 1:
        each = "; ".join(f"{label}: {domain}" for label, domain in domains.items())
        return f"they are of different domains ({each})"
    return None if shared(runs) else "they have no kind of result in common"


def differences(runs: Runs) -> pd.DataFrame:
    """What was not the same, a column per run: settings by the kind of artefact, seeds, data and versions."""
    rows = []
    for label, results in runs.items():
        for kind, settings in _settings(results):
            for name, value in settings.items():
                text = value if isinstance(value, str) else json.dumps(value, sort_keys=True)
                rows.append((kind, name, label, text))
    every = pd.DataFrame(rows, columns=["of", "setting", "run", "text"]).drop_duplicates().sort_values("text")
    texts = every.groupby(["of", "setting", "run"])["text"].agg(", ".join)
    by_run = texts.unstack()[[*runs]].fillna(DASH)
    return by_run[by_run.nunique(axis=1) > 1].rename_axis(columns=None).reset_index()


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
    for question in shared(runs):
        values = []
        for label, results in runs.items():
            of_run = paired_runs(question, results)
            values.append(of_run.assign(run=label, artefact=f"{label}/" + of_run["artefact"]))
        for method, alike in pd.concat(values).groupby("method", sort=False):
            if alike["run"].nunique() == len(runs):
                parts.append(pairs(alike.assign(method=alike["run"])).assign(of=method))
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
    compared = compare_runs(runs)
    tables = {"pairs": compared, "differences": differences(runs)}
    figures = list(_curves(runs))
    first = next(iter(runs.values()))
    parts = []
    for question in shared(runs):
        name = name_of(question)
        of_runs = [over(question.runs(results), question.BY).assign(run=label) for label, results in runs.items()]
        tables[name] = pd.concat(of_runs).sort_values(question.BY, kind="stable")
        words = module(name, {"results": first, "table": of_runs[0], "pairs": pd.DataFrame(), "figures": []})
        shown = displayed(tables[name], words.by | {"run": "run"}, words.columns)
        parts.append({"name": name, "title": question.TITLE, "table": shown})
    context = {
        "paths": paths,
        "domains": domains_of(first.facts),
        "differences": tables["differences"].set_index(["of", "setting"]),
        "parts": parts,
        "figures": figures,
        "pairs": compared.assign(quantity=compared["of"] + ": " + compared["quantity"]),
    }
    part = section("compared", context)
    title = f"hypogoal: {len(runs)} runs compared"
    return draw_page(title, [("compared", "What is compared", part, False)], "page.html"), figures, tables


def _curves(runs: Runs) -> Iterator[Drawn]:
    """Of each agent that every run has its reward and length, a line per run."""
    points = []
    for label, results in runs.items():
        of_agents = results.of(method=[*results.facts["agents"]], quantity=[*curves.FIGURES]).dropna(subset="step")
        points.append(of_agents.assign(run=label, artefact=f"{label}/" + of_agents["artefact"]))
    for (name, quantity), drawn in pd.concat(points).groupby(["method", "quantity"]):
        if drawn["run"].nunique() == len(runs) and drawn["value"].nunique() > 1:
            _, label, _ = curves.FIGURES[str(quantity)]
            figure = curves.learning_curves(drawn.assign(method=drawn["run"]), label)
            yield Drawn(f"{quantity}-{name}", f"{name}: {label.lower()}", figure)
