"""The experiments that come with hypogoal: the paper's figures, and whether an ensemble, and choosing, are needed.

``hypogoal run NAME --out runs/NAME`` runs an experiment; ``EXPERIMENTS`` has the names. The evaluation's 'What choosing
is worth' compares each agent with uniform-random choice among its own options.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import product
from typing import Any

from hypogoal.core.config import setting
from hypogoal.experiments.experiment import LAYOUTS, SEEDS, Columns, Command, Integers, Names, agents_of, experiment

CONTROLS = {"random": "--set chooser=random", "oracle": "--set termination=oracle"}
BASELINES = {
    "ppo-paper": "--agent ppo --set setting=paper",
    "ppo-tuned": "--agent ppo --set setting=tuned",
    "dqn-paper": "--agent dqn --set setting=paper",
    "dqn-tuned": "--agent dqn --set setting=tuned",
}
COMPARED = "agents on primitive actions"
PRETRAIN = "train-options before train-meta; false is the paper's"
LADDERS = {
    "dbat": "--set diversity=dbat",
    "none": "--set diversity=none",
    "cnn": "--set diversity=none --set members=1",
}
ENSEMBLES = "ensembles: D-BAT, the same without diversity, a single CNN"
OPTION_GROUPS = "the N whose ensembles get options; they must be among 'groups'"
CHOOSING = {
    "dbat": "--diversity dbat --members 6",
    "none": "--diversity none --members 6",
    "one": "--diversity none --members 1",
}
SOLVABLE = (70100, 70101, 70102, 70103, 70105, 70107, 70109, 70110, 70111, 70112)  # can be solved without a wrong key
IN_ROOMS = {  # one member more than there are features; joint has two
    "dbat": "--diversity dbat --members 3",
    "divdis": "--diversity divdis --members 3",
    "none": "--diversity none --members 3",
    "one": "--diversity none --members 1",
    "joint": "--diversity none --members 2 --set teacher=joint:independent",
}
EACH = "seeds: each has states, ensembles, rooms and agents of its own"


@experiment("doorkey")
def doorkey(
    stage: Callable[[str], Any],
    *,
    layout_seeds: Integers = setting((100,), LAYOUTS, source="paper, Figure 6", low=0),
    seeds: Integers = setting((0,), SEEDS, low=0),
    pretrain: bool = setting(True, PRETRAIN),
    controls: Names = setting(tuple(CONTROLS), "controls beside the agent", source="ours: controls", choices=CONTROLS),
    baselines: Names = setting(tuple(BASELINES), COMPARED, source="paper, Figure 6", choices=BASELINES),
) -> Iterator[Command]:
    """Figure 6: agents on layouts of three-key DoorKey, with their controls and baselines.

    First come the ensembles of all seeds, then for each layout and seed its options, agent, controls and baselines.
    """
    agents = agents_of(layout_seeds, seeds)
    is_one = len(agents) == 1  # if so, names are short: runs/demo/ensemble
    # What is compared with the agent plays as many steps as its options and it together.
    steps = stage("train-meta").steps + (stage("train-options").steps if pretrain else 0)
    yield Command("data", "collect doorkey")
    ensembles = {seed: "ensemble" if is_one else f"ensemble/seed-{seed}" for seed in seeds}
    for seed, ensemble in ensembles.items():
        yield Command(ensemble, f"train-ensemble @data --seed {seed}", {"agent": "ensemble", "seed": seed})
    for layout, seed in agents:
        at = "" if is_one else f"/layout-{layout}-seed-{seed}"
        meta = f"train-meta @{ensembles[seed]}"
        commands = {"meta": meta}
        if pretrain:
            commands = {"options": f"train-options @{ensembles[seed]}", "meta": f"{meta} --options @options{at}"}
        for control in controls:
            commands[f"meta-{control}"] = f"{meta} {CONTROLS[control]} --set steps={steps}"
        for baseline in baselines:
            commands[baseline] = f"train-baseline doorkey --data @data {BASELINES[baseline]} --set steps={steps}"
        for agent, words in commands.items():
            columns: Columns = {"agent": agent, "seed": seed, "layout_seed": layout}
            # An ensemble uses all cores, and gets them first. Baselines wait; other agents need the ensemble anyway.
            after = [ensembles[seed]] if agent in baselines else []
            yield Command(f"{agent}{at}", f"{words} --seed {seed} --layout-seed {layout}", columns, after)


figure6 = replace(doorkey, preset="figure6")  # of a size for a laptop


@experiment("montezuma")
def montezuma_ladders(
    *,
    groups: Integers = setting((1, 2, 3, 7), "labelled ladder groups (N)", source="Figure 3", low=1, high=7),
    seeds: Integers = setting((0,), SEEDS, low=0),
    methods: Names = setting(tuple(LADDERS), ENSEMBLES, source="Figure 3", choices=LADDERS),
    ladders: Names = setting((), "ladders to learn options on; empty for none", source="Figure 4"),
    option_groups: Integers = setting((2,), OPTION_GROUPS, low=1, high=7),
) -> Iterator[Command]:
    """Figures 3, 4 and 5: sub-goals and options on the ladders of Montezuma's Revenge.

    First come the states and ensembles of each N, then for each ladder and seed its options and their oracle.
    """
    for count in groups:
        yield Command(f"data/groups-{count}", f"collect montezuma --set groups={count}", {"groups": count})
    for count, method, seed in product(groups, methods, seeds):
        words = f"train-ensemble @data/groups-{count} {LADDERS[method]} --seed {seed}"
        columns: Columns = {"method": method, "groups": count, "seed": seed}
        yield Command(f"ensemble/{method}/groups-{count}-seed-{seed}", words, columns)
    for ladder, seed in product(ladders, seeds):
        for count, method in product(option_groups, methods):
            ensemble = f"@ensemble/{method}/groups-{count}-seed-{seed}"
            words = f"train-options {ensemble} --set start={ladder} --seed {seed}"
            place = f"options/{method}/groups-{count}-ladder-{ladder}-seed-{seed}"
            yield Command(place, words, {"method": method, "groups": count, "ladder": ladder, "seed": seed})
        if option_groups and methods:  # any ensemble will do, because these options end at the truth
            place = f"options/oracle/ladder-{ladder}-seed-{seed}"
            words = f"{words} --set termination=oracle"
            yield Command(place, words, {"method": "oracle", "ladder": ladder, "seed": seed})


# Both have a size for a laptop; figure3 has no options.
figure3 = replace(montezuma_ladders, preset="figure3", given={"ladders": ""})
figure4 = replace(montezuma_ladders, preset="figure4")


@experiment("doorkey", preset="choosing")
def choosing(
    *,
    layouts: Integers = setting(SOLVABLE, LAYOUTS, low=0),
    seeds: Integers = setting(tuple(range(920, 930)), SEEDS, low=0),
    methods: Names = setting(tuple(CHOOSING), "ensembles", choices=CHOOSING),
) -> Iterator[Command]:
    """Does choosing decide? Options are learned in the plain world, and chosen where a wrong key ends the episode.

    The preset has the worlds. Planned options beside the learned ones say what the hypotheses are worth, whatever
    learning makes of them. First come the ensembles of all seeds, then for each agent the agent with planned options,
    the learned options, and the agent with learned options.
    """
    yield Command("data", "collect doorkey", {"group": "data"})
    for seed, method in product(seeds, methods):
        words = f"train-ensemble @data {CHOOSING[method]} --seed {seed}"
        yield Command(f"ensemble/method-{method}-seed-{seed}", words, {"method": method, "seed": seed})
    for (layout, seed), method in product(agents_of(layouts, seeds), methods):
        place = f"method-{method}-layout-{layout}-seed-{seed}"
        ensemble = f"@ensemble/method-{method}-seed-{seed}"
        of_agent = f"--seed {seed} --layout-seed {layout}"
        columns: Columns = {
            "policy": "learned",
            "method": method,
            "layout_seed": layout,
            "seed": seed,
        }
        words = f"train-meta {ensemble} {of_agent} --set network=planned"
        yield Command(f"planned/{place}", words, {**columns, "policy": "planned"})
        yield Command(f"options/{place}", f"train-options {ensemble} {of_agent}", columns)
        yield Command(f"agent/{place}", f"train-meta {ensemble} --options @options/{place} {of_agent}", columns)


@experiment("rooms")
def rooms(
    *,
    seeds: Integers = setting(tuple(range(990, 1000)), EACH),
    methods: Names = setting(("dbat", "none", "one"), "ensembles", choices=IN_ROOMS),
    truths: Names = setting(("shape", "place"), "what the reward asks for", choices=("shape", "place")),
) -> Iterator[Command]:
    """Is an ensemble needed? In rooms, labels cannot tell shape from place, and the reward asks for one of the two.

    For each seed there are states and ensembles, then an agent for each ensemble and each truth.
    """
    for seed in seeds:
        yield Command(f"data/seed-{seed}", f"collect rooms --seed {seed}", {"group": "data", "seed": seed})
    for method, seed in product(methods, seeds):
        words = f"train-ensemble @data/seed-{seed} {IN_ROOMS[method]} --seed {seed}"
        yield Command(f"ensemble/method-{method}-seed-{seed}", words, {"method": method, "seed": seed})
    for method, truth, seed in product(methods, truths, seeds):
        words = f"train-meta @ensemble/method-{method}-seed-{seed} --seed {seed} --layout-seed {seed}"
        words = f"{words} --set world=truth={truth} --set steps=1000"
        place = f"agent/method-{method}-truth-{truth}-seed-{seed}"
        yield Command(place, words, {"method": method, "truth": truth, "seed": seed})
