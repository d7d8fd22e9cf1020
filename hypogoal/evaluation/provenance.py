"""What everything was made from and with (Spec A8)."""

import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from hypogoal.data import open_dataset
from hypogoal.evaluation.page import DASH, Results
from hypogoal.evaluation.run import Contents

TITLE = "Data, settings, provenance"


def provenance(contents: Contents, data: Sequence[Path]) -> dict[str, Any]:
    """Spec A8: what everything was made from and with."""
    artefacts = []
    for artefact in (*contents.everything(), *contents.continued):
        manifest = artefact.manifest
        artefacts.append(
            {
                "path": contents.name(artefact),
                "kind": artefact.kind,
                "seed": artefact.seed,
                "config": artefact.config,
                "inputs": [entry.model_dump() for entry in manifest.inputs],
                "command": manifest.command,
                "versions": manifest.versions,
            }
        )
    collected = []
    for path in data:
        dataset = open_dataset(path)
        keys = {"domain": dataset.domain, "config": dataset.config, "counts": dataset.counts(), "seed": dataset.seed}
        collected.append({"path": path.name, **keys})
    return {"artefacts": artefacts, "data": collected}


def domains_of(facts: Mapping[str, Any]) -> list[str]:
    """The domains of a run's data and artefacts."""
    recorded = facts["provenance"]
    named = [data["domain"] for data in recorded["data"]]
    named += [artefact["config"]["domain"] for artefact in recorded["artefacts"] if "domain" in artefact["config"]]
    return sorted(set(named))


def context(results: Results) -> dict[str, Any]:
    """For the template: data, artefacts, settings, versions."""
    recorded = results.facts["provenance"]
    rows = []
    for data in recorded["data"]:
        counts = data["counts"]
        for sub_goal, labelled in counts["labelled"].items():
            heldout = counts["heldout"][sub_goal]
            numbers = (labelled["states"], labelled["positives"], counts["unlabelled"], heldout["states"])
            rows.append([data["path"], sub_goal, *(f"{number:,}" for number in (*numbers, heldout["positives"]))])
    titles = ["data", "sub-goal", "labelled", "positive", "unlabelled", "held-out", "positive there"]
    data = pd.DataFrame(rows, columns=titles).set_index(titles[:2])
    artefacts = pd.DataFrame(
        {
            "artefact": [artefact["path"] for artefact in recorded["artefacts"]],
            "kind": [artefact["kind"] for artefact in recorded["artefacts"]],
            "command": [shlex.join(artefact["command"]) or DASH for artefact in recorded["artefacts"]],
            "seed": [str(artefact["seed"]) for artefact in recorded["artefacts"]],
        }
    )
    versions = sorted({pair for artefact in recorded["artefacts"] for pair in artefact["versions"].items()})
    settings = [(f"{each['path']} ({each['domain']})", each["config"]) for each in recorded["data"]]
    settings += [(f"{each['path']} ({each['kind']})", each["config"]) for each in _of_each_kind(recorded["artefacts"])]
    return {
        "data": data,
        "artefacts": artefacts.set_index(["artefact", "kind", "command", "seed"]),
        "versions": versions,
        "settings": [(name, _lines(config)) for name, config in settings],
    }


def _of_each_kind(artefacts: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The first artefact of those whose settings are alike but for their layout and start."""
    first: dict[str, dict[str, Any]] = {}
    for artefact in artefacts:
        varying = {key: value for key, value in artefact["config"].items() if key not in ("layout_seed", "start")}
        first.setdefault(json.dumps([artefact["kind"], varying], sort_keys=True), artefact)
    return [*first.values()]


def _lines(config: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [(key, value if isinstance(value, str) else json.dumps(value)) for key, value in config.items()]
