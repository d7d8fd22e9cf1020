"""What everything was made from and with (Spec A8)."""

import json
import shlex
from collections.abc import Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

from hypogoal.data import open_dataset
from hypogoal.evaluation import page
from hypogoal.evaluation.numbers import grouped
from hypogoal.evaluation.page import Block, Entry, Material
from hypogoal.evaluation.run import Contents

SAID_ELSEWHERE = ("layout_seed", "start", "domain_config")  # settings that alone do not make another list


def provenance(contents: Contents, data: Sequence[Path]) -> dict[str, Any]:
    """Spec A8: what everything was made from and with."""
    artefacts = [
        {
            "path": contents.name(artefact),
            "kind": artefact.kind,
            "seed": artefact.seed,
            "config": artefact.config,
            "inputs": [entry.model_dump() for entry in artefact.manifest.inputs],
            "command": artefact.manifest.command,
            "versions": artefact.manifest.versions,
        }
        for artefact in (*contents.everything(), *contents.continued)
    ]
    collected = [
        {
            "path": path.name,
            "domain": dataset.domain,
            "config": dataset.config,
            "counts": dataset.counts(),
            "seed": dataset.seed,
        }
        for path, dataset in zip(data, map(open_dataset, data), strict=True)
    ]
    return {"artefacts": artefacts, "data": collected}


DATA = (
    page.label("data", "path", once=lambda line: line["place"]),
    page.label("sub-goal", "sub_goal"),
    page.number("labelled", "labelled.states", "{:,}".format),
    page.number("positive", "labelled.positives", "{:,}".format),
    page.number("unlabelled", "unlabelled", "{:,}".format),
    page.number("held-out", "heldout.states", "{:,}".format),
    page.number("positive", "heldout.positives", "{:,}".format),
)
ARTEFACTS = (
    page.label("artefact", "path"),
    page.label("kind", "kind"),
    page.label("command", lambda artefact: shlex.join(artefact["command"]) or "–"),
    page.label("seed", lambda artefact: str(artefact["seed"])),
    page.label(
        "inputs (sha256)",
        lambda artefact: ", ".join(f"{of['kind']} {of['sha256'][:10]}" for of in artefact["inputs"]) or "–",
    ),
)


def provenance_section(material: Material) -> Block:
    """Data, artefacts, settings, versions and the meaning of every number."""
    provenance = material.metrics["provenance"]
    text = (
        "Every number above is in metrics.json of the evaluation. Each artefact's manifest holds its settings, the "
        "sha256 of its files and of its inputs' manifests."
    )
    lines = []
    for place, data in enumerate(provenance["data"]):
        counts = data["counts"]
        for sub_goal, labelled in counts["labelled"].items():
            sizes = {"labelled": labelled, "unlabelled": counts["unlabelled"], "heldout": counts["heldout"][sub_goal]}
            lines.append({"place": place, "path": data["path"], "sub_goal": sub_goal, **sizes})
    missing = "" if lines else "No data file was found: it is read through an ensemble artefact."
    artefacts = provenance["artefacts"]
    versions = sorted({item for artefact in artefacts for item in artefact["versions"].items()})
    by_package = grouped(versions, itemgetter(0)).items()
    meanings = material.metrics["quantities"].items()
    blocks = [
        page.table(DATA, lines, heading="Collected states", caption=missing),
        page.table(ARTEFACTS, artefacts, folded=f"All {len(artefacts)} artefacts and their commands", wrap=True),
        *_settings(provenance),
        page.facts("Versions", [(name, ", ".join(version for _, version in items)) for name, items in by_package]),
        page.facts(
            "What each number means",
            [(name, f"{quantity['meaning']} ({quantity['unit']})") for name, quantity in meanings],
        ),
    ]
    return page.section("provenance", "Data, settings, provenance", [text], blocks, folded=True)


def _settings(provenance: Mapping[str, Any]) -> list[Block]:
    blocks = []
    for index, data in enumerate(provenance["data"]):
        name = f"Settings of {data['path']} ({data['domain']})"
        blocks.append(page.facts(name, _lines(data["config"]), heading="" if index else "Settings"))
    shown: set[str] = set()
    for artefact in provenance["artefacts"]:
        varying = {key: value for key, value in artefact["config"].items() if key not in SAID_ELSEWHERE}
        same = json.dumps([artefact["kind"], varying], sort_keys=True)
        if same not in shown:
            shown.add(same)
            name = f"Settings of {artefact['path']} ({artefact['kind']})"
            blocks.append(page.facts(name, _lines(artefact["config"])))
    return blocks


def _lines(config: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [(key, value if isinstance(value, str) else json.dumps(value)) for key, value in config.items()]


def domains_of(metrics: Entry) -> list[str]:
    """The domains of a run's data and artefacts."""
    provenance = metrics["provenance"]
    named = [data["domain"] for data in provenance["data"]]
    named += [artefact["config"]["domain"] for artefact in provenance["artefacts"] if "domain" in artefact["config"]]
    return sorted(set(named))
