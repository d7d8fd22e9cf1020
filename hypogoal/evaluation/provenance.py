"""Where everything in a run comes from: data, artefacts, settings and versions."""

from typing import Any

import pandas as pd

from hypogoal.data import open_dataset
from hypogoal.evaluation.names import as_text
from hypogoal.evaluation.run import Contents, Results

TITLE = "Data, settings, provenance"
KEPT = {"kind", "seed", "config", "inputs", "command", "versions"}  # fields of a manifest


def provenance(contents: Contents) -> dict[str, Any]:
    """Return what each artefact and each data file of a run was made from and with."""
    artefacts = []
    for artefact in (*contents.everything(), *contents.continued):
        kept = artefact.manifest.model_dump(include=KEPT)
        artefacts.append({"path": contents.name(artefact), **kept})
    collected = []
    for path in contents.data():
        dataset = open_dataset(path)
        facts = {"path": path.name, "config": dataset.config, "counts": dataset.counts(), "seed": dataset.seed}
        collected.append(facts)
    return {"artefacts": artefacts, "data": collected}


def domains_of(results: Results) -> list[str]:
    """Return the names of the domains of a run's artefacts, sorted."""
    artefacts = results.facts["provenance"]["artefacts"]
    return sorted({artefact["config"]["domain"] for artefact in artefacts})


def settings_of(results: Results) -> pd.DataFrame:
    """Return each value of each setting in a run: columns ``of`` (artefact's kind, data or versions), setting, text."""
    recorded = results.facts["provenance"]
    parts = [("data", {"seed": data["seed"], **data["config"]}) for data in recorded["data"]]
    for artefact in recorded["artefacts"]:
        parts.append((artefact["kind"], {"seed": artefact["seed"], **artefact["config"]}))
        parts.append(("versions", artefact["versions"]))
        for item in artefact["inputs"]:
            if item["kind"] == "data":
                parts.append(("data", {"sha256": item["sha256"][:10]}))
    rows = []
    for kind, settings in parts:
        for name in ("domain_config", "chosen"):  # the data have domain_config themselves; chosen is a result
            settings.pop(name, None)
        rows += [(kind, name, as_text(value)) for name, value in settings.items()]
    return pd.DataFrame(rows, columns=["of", "setting", "text"]).drop_duplicates()


def context(results):
    """Return what the template needs: what was collected, the artefacts, and settings."""
    return results.facts["provenance"] | {"settings": settings_of(results)}
