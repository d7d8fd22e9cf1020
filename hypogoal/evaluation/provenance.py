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
KEPT = {"kind", "seed", "config", "inputs", "command", "versions"}  # of a manifest
VARYING = ("layout_seed", "start")  # settings that the paths tell
ARTEFACTS = ["path", "kind", "command", "seed"]  # columns
DATA = ["data", "sub-goal", "labelled", "positive", "unlabelled", "held-out", "positive there"]


def provenance(contents: Contents, data: Sequence[Path]) -> dict[str, Any]:
    """Spec A8: what everything was made from and with."""
    artefacts = []
    for artefact in (*contents.everything(), *contents.continued):
        artefacts.append({"path": contents.name(artefact)} | artefact.manifest.model_dump(include=KEPT))
    collected = []
    for path in data:
        dataset = open_dataset(path)
        keys = {"domain": dataset.domain, "config": dataset.config, "counts": dataset.counts(), "seed": dataset.seed}
        collected.append({"path": path.name, **keys})
    return {"artefacts": artefacts, "data": collected}


def domains_of(facts: Mapping[str, Any]) -> list[str]:
    """The domains of a run's data and artefacts."""
    recorded = facts["provenance"]
    named = {data["domain"] for data in recorded["data"]}
    named |= {artefact["config"].get("domain") for artefact in recorded["artefacts"]}
    return sorted(named - {None})


def context(results: Results) -> dict[str, Any]:
    """For the template: data, artefacts, settings, versions."""
    recorded = results.facts["provenance"]
    rows = []
    for data in recorded["data"]:
        counts = data["counts"]
        for sub_goal, labelled in counts["labelled"].items():
            heldout = counts["heldout"][sub_goal]
            numbers = (labelled["states"], labelled["positives"], counts["unlabelled"], *heldout.values())
            rows.append([data["path"], sub_goal, *numbers])
    states = pd.DataFrame(rows, columns=DATA).set_index(DATA[:2])
    artefacts = pd.DataFrame(recorded["artefacts"], columns=ARTEFACTS)
    artefacts["command"] = artefacts["command"].map(shlex.join).replace("", DASH)
    configs = {f"{data['path']} ({data['domain']})": data["config"] for data in recorded["data"]}
    versions: set[tuple[str, str]] = set()
    for artefact in recorded["artefacts"]:
        configs[f"{artefact['path']} ({artefact['kind']})"] = artefact["config"]
        versions.update(artefact["versions"].items())
    settings: dict[str, dict[str, str]] = {}
    listed: set[tuple[str, str]] = set()
    for name, config in configs.items():
        texts = {key: value if isinstance(value, str) else json.dumps(value) for key, value in config.items()}
        settings[name] = {key: text for key, text in texts.items() if key not in VARYING and (key, text) not in listed}
        listed.update(texts.items())
    return {
        "data": states.map("{:,}".format),
        "artefacts": artefacts.set_index(ARTEFACTS),
        "versions": sorted(versions),
        "settings": settings,
    }
