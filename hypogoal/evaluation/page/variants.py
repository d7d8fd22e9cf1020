"""Variants of the option agent: runs whose settings differ are agents of their own, with those added to the name."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from hypogoal.evaluation.agents import LEARNED, RANDOM
from hypogoal.evaluation.page.blocks import Material

Entry = Mapping[str, Any]  # an agent, of ``metrics["agents"]`` or of ``metrics["selection"]``


def variants(entries: Iterable[Entry], name: str = LEARNED) -> list[Entry]:
    """The entries called ``name``, also those to which settings that differ between runs were added."""
    return [entry for entry in entries if f"{entry['name']}, ".startswith(f"{name}, ")]


def control_of(material: Material, agent: Entry, entries: Sequence[Entry]) -> Entry | None:
    """The random chooser among a variant's options: the one with the same settings added to its name.

    Settings that most runs of a name share are not added to it, so a name can leave open which options were chosen
    among. Then it is the only chooser with an ensemble of this variant, if no other variant has that ensemble.

    Args:
        material: its ``selection`` tells the runs' ensembles.
        agent: one of the entries.
        entries: agents, or agents of the selection.
    """
    agents, controls = variants(entries), variants(entries, RANDOM)
    if len(agents) == len(controls) == 1:
        return controls[0]
    known = material.metrics.get("selection", ())
    ensembles = {entry["name"]: {run["ensemble"] for run in entry["runs"]} for entry in known}

    def shares(one: Entry, other: Entry) -> bool:
        return bool(ensembles.get(one["name"], set()) & ensembles.get(other["name"], set()))

    same = [control for control in controls if same_settings(agent, control)]
    if same and (shares(agent, same[0]) or not {agent["name"], same[0]["name"]} <= set(ensembles)):
        return same[0]
    near = [control for control in controls if shares(agent, control)]
    rivals = [other for other in agents for control in near if shares(other, control)]
    return near[0] if len(near) == len(rivals) == 1 else None


def same_settings(agent: Entry, control: Entry) -> bool:
    """Whether the same settings are added to both names."""
    return bool(settings_of(agent) == settings_of(control, RANDOM))


def settings_of(agent: Entry, name: str = LEARNED) -> str:
    """What is added to a variant's name; nothing where it is the usual one."""
    return str(agent["name"]).removeprefix(name).removeprefix(", ")


def which(agent: Entry, entries: Sequence[Entry]) -> str:
    """A sentence that says which variant is shown; nothing where there is only one."""
    count = len(variants(entries))
    return f"Shown is {agent['name']}, one of {count} variants of the option agent." if count > 1 else ""
