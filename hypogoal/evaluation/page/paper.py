"""The paper's Figures 2 to 9, each by itself with its caption, or what it would need (Spec F1-F6)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.figure import Figure

from hypogoal.evaluation.page.agents import curves_section
from hypogoal.evaluation.page.blocks import Block, Material, fixed, texts
from hypogoal.evaluation.page.choices import choices_section
from hypogoal.evaluation.page.distance import distance_section, stops_section
from hypogoal.evaluation.page.hypotheses import hypotheses_section
from hypogoal.evaluation.page.rooms import rooms_section
from hypogoal.evaluation.page.saliency import KINDS
from hypogoal.evaluation.page.variants import variants, which
from hypogoal.evaluation.state_figures import (
    Explained,
    attributions_of_every_frame,
    attributions_of_members,
    termination_states,
)

NUMBERED = {"open-red-door": "figure7", "go-to-goal": "figure8"}  # the sub-goals that the paper shows
NEEDED = {
    "figure2": "an ensemble artefact with a member that calls a held-out state reached: train-ensemble",
    "figure3": "ensemble artefacts of data of 1 to 7 labelled ladder groups: run montezuma-ladders --preset figure3",
    "figure4": "options artefacts with executions.csv: train-options with --set start=LADDER",
    "figure5": "options artefacts with executions.csv, of a domain that draws its rooms",
    "figure6": "options, meta or baseline artefacts: train-meta, train-baseline",
    "figure7": "a meta artefact with learned terminations that has open-red-door: train-meta",
    "figure8": "a meta artefact with learned terminations that has go-to-goal: train-meta",
    "figure9": "an ensemble artefact with a member that calls a held-out state reached: train-ensemble",
}
# Sections of the page, the beginnings of their figures' names, and what those are called among the paper's.
SECTIONS: Sequence[tuple[Callable[[Material], Block], Mapping[str, str]]] = (
    (rooms_section, {"figure3": "figure3", "unseen": "figure3-unseen"}),
    (distance_section, {"figure4": "figure4"}),
    (stops_section, {"figure5": "figure5"}),
    (curves_section, {"reward": "figure6", "length": "figure6-length"}),
    (hypotheses_section, {"members": "members"}),
    (choices_section, {"preference": "preference"}),
)


@dataclass(frozen=True)
class Drawn:
    """A figure to be written: the file's name without its ending, and the caption."""

    name: str
    caption: str
    figure: Figure


def paper_figures(material: Material) -> tuple[list[Drawn], list[str]]:
    """Figures 2 to 9 and those beside them that the run has artefacts for; a line for each of 2 to 9 that it has not.

    Args:
        material: the evaluation's numbers and arrays; its ``figures`` are filled on the way.
    """
    drawn = [*_attributions(material), *_from_sections(material), *_terminations(material)]
    drawn.sort(key=lambda one: one.name)
    missing = [
        f"{name.replace('figure', 'Figure ')}: not drawn. It needs {needed}."
        for name, needed in NEEDED.items()
        if not any(one.name == name or one.name.startswith(f"{name}-") for one in drawn)
    ]
    return drawn, missing


def _from_sections(material: Material) -> Iterable[Drawn]:
    for make, names in SECTIONS:
        if make is hypotheses_section and not material.metrics["hypotheses"]:
            continue
        blocks = make(material)["blocks"]
        for block in blocks:
            if block["kind"] == "figure" and block["svg"]:
                identity = block["id"].removeprefix("figure-")
                start = max((start for start in names if identity.startswith(start)), key=len)
                name = names[start] + identity.removeprefix(start)
                yield Drawn(name, block["caption"], material.figures[identity])


def _attributions(material: Material) -> Iterable[Drawn]:
    """Figures 2 and 9: of each sub-goal the first state that is explained, a true positive where there is one."""
    found = material.metrics["saliency"]
    goals = [goal for goal in (found["sub_goals"] if found else ()) if goal["states"]]
    for goal in goals:
        arrays = {key: material.arrays[f"saliency/{goal['sub_goal']}/{key}"] for key in _KEYS}
        state = Explained(
            arrays["observations"][0],
            arrays["seen"][0],
            arrays["attributions"][0],
            arrays["probabilities"][0],
            arrays["verdicts"][0],
            bool(arrays["labels"][0]),
        )
        suffix = f"-{goal['sub_goal']}" if len(goals) > 1 else ""
        place = texts(arrays["places"])[0]
        error = max(member["completeness_error"] for member in goal["states"][0]["members"])
        about = (
            f"DeepLift attributions of each member of {found['ensemble']} (seed {found['seed']}) on a held-out state "
            f"of {goal['sub_goal']}{f' ({place})' if place else ''}: {KINDS[goal['states'][0]['kind']]}. Against "
            f"{found['baseline']}. Orange speaks for 'reached', blue against it; each picture has a scale of its own. "
            f"They add up to the difference in log-odds within {error:.0e}."
        )
        every = "Colour by colour." if state.seen.shape[-1] == 3 else "Every frame that members see."
        last = " Of the stack of frames the last." if state.seen.shape[-1] != 3 else ""
        yield Drawn(f"figure2{suffix}", f"Figure 2 of the paper. {about}{last}", attributions_of_members(state))
        yield Drawn(f"figure9{suffix}", f"Figure 9 of the paper. {about} {every}", attributions_of_every_frame(state))


_KEYS = ("observations", "seen", "attributions", "probabilities", "verdicts", "labels", "places")


def _terminations(material: Material) -> Iterable[Drawn]:
    """Figures 7 and 8, and the other sub-goals', of the agent's first run."""
    selection = material.metrics["selection"]
    agent = next(iter(variants(selection)), None)
    if agent is None:
        return
    run = agent["runs"][0]
    for goal in run["sub_goals"]:
        sides = [_side(material, run["path"], goal, word) for word in ("most", "least") if goal[word] is not None]
        if not sides:
            continue
        name = NUMBERED.get(goal["sub_goal"], f"terminations-{goal['sub_goal']}")
        number = name.replace("figure", "Figure ") if name in NUMBERED.values() else "As Figures 7 and 8"
        caption = (
            f"{number} of the paper: overlaid termination states of {goal['sub_goal']}, of the member that the agent "
            f"prefers most and of the one it prefers least ({run['path']}, layout seed {run['layout_seed']}, run seed "
            f"{run['seed']}); the last states, 128 at most, in which the member's classifier ended its option. "
            "Preference: chosen / expected under uniform choice; match: balanced accuracy on that layout. "
            f"{which(agent, selection)}"
        ).rstrip()
        yield Drawn(name, caption, termination_states(sides))


def _side(material: Material, path: str, goal: Mapping[str, Any], word: str) -> tuple[str, Any]:
    member = goal["members"][goal[word]]
    title = f"{word} preferred: member {goal[word]}\npreference {fixed(member['preference'], 2)}, match "
    return title + fixed(member["match"], 2), material.arrays.get(f"terminations/{path}/{member['option']}")
