"""What ensembles and agents are called: made once, when a run is evaluated, as people read it (Spec F5).

Runs that were not made alike are never averaged: they have different names.
"""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from hypogoal.core.artefacts import Artefact
from hypogoal.evaluation.run import Contents, takes, within

# Settings that may differ between two runs that are averaged, or that follow from others.
NOT_A_VARIANT = frozenset(
    {
        *("layout_seed", "sub_goals", "observation_shape", "setting", "random_episodes", "workers", "hyperparameters"),
        *("world", "members", "observation_dtype", "groups"),  # which the names or the column N say
        *("ended_at", "until_reached", "options_ended_at", "options_steps"),  # which came out
    }
)
ON_LADDERS = frozenset({"start", "domain_config", "termination"})  # of options, said in other columns
IDLE = ("diversity", "diversity_weight", "schedule")  # settings without effect where there is one member
OBJECTIVES = {"dbat": "D-BAT", "divdis": "DivDis", "none": "no diversity"}
ONE = "one classifier"
ORACLE = "oracle termination"
LEARNED = "option agent"
RANDOM = "random choice"
PRETRAINING = "random choice while options learn"
ORACLE_AGENT = "oracle terminations"
ORACLE_RANDOM = "oracle terminations, random choice"
UNIFORM = "uniform-random choice among its own options"
METHODS = ("D-BAT", "DivDis", "no diversity", ONE)  # of ensembles
ORDER = (*METHODS, LEARNED, RANDOM, PRETRAINING, ORACLE_AGENT, ORACLE_RANDOM)  # in tables and figures


def ensemble_title(config: Mapping[str, Any]) -> str:
    """An ensemble by its objective and its number of members."""
    if config["members"] == 1:
        return ONE
    objective = OBJECTIVES.get(config["diversity"], config["diversity"])
    return f"{objective}, {config['members']} members"


def agent_title(kind: str, config: Mapping[str, Any]) -> str:
    """Spec E6, E7: an agent by how it chooses and what ends its options."""
    if kind == "baseline":
        return f"{config['agent'].upper()} {config['setting']}"
    if kind == "options":
        return PRETRAINING
    oracle = config["termination"] == "oracle"
    if config["chooser"] == "random":
        return ORACLE_RANDOM if oracle else RANDOM
    title = ORACLE_AGENT if oracle else LEARNED
    return title if config["chooser"] == "ppo" else f"{title}, chooser={config['chooser']}"


def rank(name: str) -> int:
    """The order of methods in tables and figures: the paper's method, its controls, anything else."""
    starts = [start for start in ORDER if name.startswith(start)]
    return ORDER.index(max(starts, key=len)) if starts else len(ORDER)


def names_apart(titles: Sequence[str], configs: Sequence[Mapping[str, Any]], groups: Sequence[Any] = ()) -> list[str]:
    """A name for each of n things: its title, and the settings by which it differs from most of that title.

    ``domain_config`` inside the settings is looked into. Of several ``groups`` (N) only things of the same are named
    apart. An ensemble stands without the setting's name, and in place of ``LEARNED``.
    """
    flat = [{**(config.get("domain_config") or {}), **config, "domain_config": None} for config in configs]
    kinds = list(zip(titles, groups or [None] * len(titles), strict=True))
    names = []
    for kind, config in zip(kinds, flat, strict=True):
        alike = [other for other, others_kind in zip(flat, kinds, strict=True) if others_kind == kind]
        parts = [kind[0]]
        for key in sorted({*config} - NOT_A_VARIANT, key=lambda key: (key != "ensemble", key)):
            texts = [_text(other[key]) for other in alike if key in other]
            usual, count = Counter(texts).most_common(1)[0]
            text = _text(config[key])
            if text != usual or 2 * count <= len(texts):
                parts.append(text if key == "ensemble" else f"{key}={text}")
        names.append(", ".join(parts))
    return [_with_its_ensemble(name) for name in names]


def _with_its_ensemble(name: str) -> str:
    rest = name.removeprefix(f"{LEARNED}, ")
    return rest if rest.startswith((*METHODS, *OBJECTIVES)) else name


def _text(value: Any) -> str:
    if value is None:
        return "unset"
    return value if isinstance(value, str) else json.dumps(value, sort_keys=True)


def groups_of(config: Mapping[str, Any]) -> int | None:
    """N, the number of labelled ladder groups that an ensemble's data have; None where its domain has no such thing."""
    groups = (config.get("domain_config") or {}).get("groups")
    return groups if isinstance(groups, int) else None


def places_of(contents: Contents) -> dict[str, dict[str, Any]]:
    """Of each of a run's artefacts, by path, what stands in the table of numbers: method, N, ladder, layout, seed."""
    ensembles = contents.ensembles
    settings = [_effective(artefact.config) for artefact in ensembles]
    names = names_apart([ensemble_title(artefact.config) for artefact in ensembles], settings)
    of_ensemble = dict(zip(map(contents.name, ensembles), names, strict=True))
    places = {
        contents.name(artefact): {"method": name, "N": groups_of(artefact.config)}
        for artefact, name in zip(ensembles, names, strict=True)
    }
    places |= _of_agents(contents, of_ensemble) | _of_ladders(contents, of_ensemble)
    for artefact in contents.everything():
        path = contents.name(artefact)
        places[path] |= {"seed": artefact.seed, "artefact": path}
    return places


def _effective(config: Mapping[str, Any]) -> dict[str, Any]:
    idle: tuple[str, ...] = IDLE if config["members"] == 1 else ()
    if config["diversity"] == "none":
        idle = (*idle, "diversity_weight")
    return {key: value for key, value in config.items() if key not in idle}


def _of_agents(contents: Contents, of_ensemble: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    titles = [agent_title(artefact.kind, artefact.config) for artefact in contents.agents]
    configs = []
    for artefact in contents.agents:
        more = {} if artefact.kind == "baseline" else {"ensemble": _ensemble_of(contents, artefact, of_ensemble)}
        configs.append(artefact.config | more)
    names = names_apart(titles, configs)
    return {
        contents.name(artefact): {"method": name, "layout": artefact.config["layout_seed"]}
        for artefact, name in zip(contents.agents, names, strict=True)
    }


def _of_ladders(contents: Contents, of_ensemble: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    titles, groups, configs = [], [], []
    for artefact in contents.ladders:
        learned = takes(artefact)
        titles.append(_ensemble_of(contents, artefact, of_ensemble) if learned else ORACLE)
        groups.append(groups_of(Artefact(artefact.input("ensemble")).config) if learned else None)
        configs.append({key: value for key, value in artefact.config.items() if key not in ON_LADDERS})
    names = names_apart(titles, configs, groups)
    return {
        contents.name(artefact): {"method": name, "N": number, "ladder": artefact.config["start"]}
        for artefact, name, number in zip(contents.ladders, names, groups, strict=True)
    }


def _ensemble_of(contents: Contents, artefact: Artefact, of_ensemble: Mapping[str, str]) -> str:
    source = Artefact(artefact.input("ensemble"))
    return of_ensemble.get(within(contents, source) or "", ensemble_title(source.config))
