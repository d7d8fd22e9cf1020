"""What ensembles and agents are called. Names are made once, when a run is evaluated, for people to read.

Runs that were not made alike are never averaged, because they have different names.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from hypogoal.core.artefacts import Artefact
from hypogoal.core.config import Values
from hypogoal.evaluation.run import Contents, takes

# Settings that may differ between two runs that are averaged, or that follow from others.
NOT_A_VARIANT = frozenset(
    {
        *("layout_seed", "sub_goals", "observation_shape", "setting", "random_episodes", "workers", "hyperparameters"),
        *("world", "members", "observation_dtype", "groups", "domain_config"),  # the names or the column N say them
        *("ended_at", "until_reached", "options_ended_at", "options_steps", "chosen"),  # results of training
    }
)
ON_LADDERS = dict.fromkeys(
    ("start", "domain_config", "termination"),
    "",
)  # settings of options on ladders that other columns say
OF_DIVERSITY = {"diversity_weight", "schedule", "restarts", "share"}  # settings without effect if there is no diversity
OBJECTIVES = {"dbat": "D-BAT", "divdis": "DivDis", "independent": "independence", "none": "no diversity"}
ONE = "one classifier"
ORACLE = "oracle termination"
LEARNED = "option agent"
RANDOM = "random choice"
PRETRAINING = "random choice while options learn"
ORACLE_AGENT = "oracle terminations"
ORACLE_RANDOM = "oracle terminations, random choice"
UNIFORM = "uniform-random choice among its own options"
METHODS = ("D-BAT", "DivDis", "independence", "no diversity", ONE)  # methods of ensembles
ORDER = (*METHODS, LEARNED, RANDOM, PRETRAINING, ORACLE_AGENT, ORACLE_RANDOM)  # order in tables and figures


def ensemble_title(config: Values) -> str:
    """Return an ensemble's title: its objective and its number of members."""
    if config["members"] == 1:
        return ONE
    objective = OBJECTIVES.get(config["diversity"], config["diversity"])
    return f"{objective}, {config['members']} members"


def agent_title(kind: str, config: Values) -> str:
    """Return an agent's title: how it chooses, and what ends its options."""
    if kind == "baseline":
        return f"{config['agent'].upper()} {config['setting']}"
    if kind == "options":
        return PRETRAINING
    oracle = config["termination"] == "oracle"
    if config["chooser"] == "random":
        return ORACLE_RANDOM if oracle else RANDOM
    title = ORACLE_AGENT if oracle else LEARNED
    is_own = ":" in config["chooser"]
    return f"{title}, chooser={config['chooser']}" if is_own else title


def rank(name: str) -> int:
    """Return a method's place in tables and figures: first the paper's method, then its controls, then all else."""
    starts = [start for start in ORDER if name.startswith(start)]
    return ORDER.index(max(starts, key=len)) if starts else len(ORDER)


def names_apart(
    titles: Sequence[str],
    configs: Sequence[Values],
    groups: Sequence[Any] = (),
) -> list[str]:
    """Return a name for each of n things: its title, and the settings by which it differs from most with that title.

    The settings inside ``domain_config`` count, too. If there are ``groups`` (N), only things of one N are named apart.
    An ensemble's name stands without the setting's name, and takes the place of ``LEARNED``.
    """
    names = pd.Series(titles, dtype=str)
    settings = pd.DataFrame([_texts(config) for config in configs])
    kinds = [pd.Series(titles, dtype=str), pd.Series(groups or titles)]
    for _, alike in settings.groupby(kinds, dropna=False):
        for key in sorted(alike, key=lambda key: (key != "ensemble", key)):
            texts = alike[key].dropna()
            often = 2 * texts.map(texts.value_counts()) > len(texts)
            told = texts[~often]
            label = "" if key == "ensemble" else f"{key}="
            names[told.index] += f", {label}" + told
    rest = names.str.removeprefix(f"{LEARNED}, ")
    return names.mask(rest.str.startswith(METHODS), rest).tolist()


def _texts(config):
    """Return the settings that tell runs apart, as texts."""
    flat = {**(config.get("domain_config") or {}), **config}
    unsaid = NOT_A_VARIANT
    if config.get("members") == 1:
        unsaid |= OF_DIVERSITY | {"diversity"}
    if config.get("diversity") == "none":
        unsaid |= OF_DIVERSITY
    return {key: as_text(flat[key]) for key in flat.keys() - unsaid}


def as_text(value: Any) -> str:
    """Return the value of a setting as a text."""
    if value is None:
        return "unset"
    return value if isinstance(value, str) else json.dumps(value, sort_keys=True)


def groups_of(config: Values) -> int | None:
    """Return N, the number of labelled ladder groups in an ensemble's data, or None if its domain has no ladders."""
    groups = (config.get("domain_config") or {}).get("groups")
    return groups if isinstance(groups, int) else None


def places_of(contents: Contents) -> dict[Path, dict[str, Any]]:
    """Return, by an artefact's path, its fields in the table of numbers: method, N, ladder, layout, seed, artefact."""
    configs: list[Values] = [ensemble.config for ensemble in contents.ensembles]
    names = names_apart([*map(ensemble_title, configs)], configs)
    places: list[dict[str, Any]] = [{"N": number} for number in map(groups_of, configs)]
    paths = [ensemble.path.resolve() for ensemble in contents.ensembles]
    named = dict(zip(paths, names, strict=True))
    titles, configs = [], []
    for artefact in (*contents.agents, *contents.ladders):
        config, source, number = artefact.config, "", None
        if artefact.kind != "baseline":
            ensemble = Artefact(artefact.input("ensemble"))
            source = named.get(
                ensemble.path.resolve(),
                ensemble_title(ensemble.config),
            )
            number = groups_of(ensemble.config)
        if artefact in contents.agents:
            titles.append(agent_title(artefact.kind, config))
            configs.append({**config, "ensemble": source})
            places.append({"layout": config["layout_seed"]})
        else:
            learned = takes(artefact)
            titles.append(source if learned else ORACLE)
            configs.append({**config, **ON_LADDERS})
            places.append(
                {
                    "N": number if learned else None,
                    "ladder": config["start"],
                }
            )
    groups = [place.get("N") for place in places[len(names) :]]
    names += names_apart(titles, configs, groups)
    by_path = {}
    for artefact, name, place in zip(contents.everything(), names, places, strict=True):
        by_path[artefact.path] = {
            "method": name,
            **place,
            "seed": artefact.seed,
            "artefact": contents.name(artefact),
        }
    return by_path
