"""The section that says what everything was made from and with."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from typing import Any

from hypogoal.evaluation.page.blocks import Block, Material, facts, row, section, table

SAID_ELSEWHERE = ("layout_seed", "start", "domain_config")  # settings that alone do not make another list


def provenance_section(material: Material) -> Block:
    """Data, artefacts, settings, versions and the meaning of every number."""
    about = material.metrics["provenance"]
    text = (
        "Every number above is in metrics.json of the evaluation. Each artefact's manifest holds its settings, the "
        "sha256 of its files and of its inputs' manifests."
    )
    blocks = [_data(about), _artefacts(about), *_settings(about), _versions(about), _glossary(material)]
    return section("provenance", "Data, settings, provenance", [text], [block for block in blocks if block])


def _data(about: Mapping[str, Any]) -> Block:
    rows = []
    for data in about["data"]:
        counts = data["counts"]
        for index, sub_goal in enumerate(counts["labelled"]):
            own, test = counts["labelled"][sub_goal], counts["heldout"][sub_goal]
            rows.append(
                row(
                    data["path"] if index == 0 else "",
                    sub_goal,
                    f"{own['states']:,}",
                    f"{own['positives']:,}",
                    f"{counts['unlabelled']:,}",
                    f"{test['states']:,}",
                    f"{test['positives']:,}",
                    mark="first" if index == 0 else "",
                )
            )
    columns = ("data", "sub-goal", "labelled", "positive", "unlabelled", "held-out", "positive")
    missing = "" if rows else "No data file was found: it is read through an ensemble artefact."
    return table(columns, rows, texts=2, heading="Collected states", caption=missing)


def _artefacts(about: Mapping[str, Any]) -> Block:
    rows = [
        row(
            artefact["path"],
            artefact["kind"],
            shlex.join(artefact["command"]) or "–",
            str(artefact["seed"]),
            ", ".join(f"{entry['kind']} {entry['sha256'][:10]}" for entry in artefact["inputs"]) or "–",
        )
        for artefact in about["artefacts"]
    ]
    columns = ("artefact", "kind", "command", "seed", "inputs (sha256)")
    return table(columns, rows, texts=5, folded=f"All {len(rows)} artefacts and their commands", wrap=True)


def _settings(about: Mapping[str, Any]) -> list[Block]:
    blocks = []
    for index, data in enumerate(about["data"]):
        name = f"Settings of {data['path']} ({data['domain']})"
        blocks.append(facts(name, _lines(data["config"]), heading="" if index else "Settings"))
    shown: set[str] = set()
    for artefact in about["artefacts"]:
        varying = {key: value for key, value in artefact["config"].items() if key not in SAID_ELSEWHERE}
        same = json.dumps([artefact["kind"], varying], sort_keys=True)
        if same not in shown:
            shown.add(same)
            blocks.append(facts(f"Settings of {artefact['path']} ({artefact['kind']})", _lines(artefact["config"])))
    return blocks


def _lines(config: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [(key, value if isinstance(value, str) else json.dumps(value)) for key, value in config.items()]


def _versions(about: Mapping[str, Any]) -> Block:
    found: dict[str, set[str]] = {}
    for artefact in about["artefacts"]:
        for name, version in artefact["versions"].items():
            found.setdefault(name, set()).add(version)
    return facts("Versions", [(name, ", ".join(sorted(versions))) for name, versions in sorted(found.items())])


def _glossary(material: Material) -> Block:
    rows = [(name, f"{of['meaning']} ({of['unit']})") for name, of in material.metrics["quantities"].items()]
    return facts("What each number means", rows)
