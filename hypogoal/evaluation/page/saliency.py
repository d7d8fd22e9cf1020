"""The section on what members look at: Figures 2 and 9."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import Any

from hypogoal.evaluation.page.blocks import Block, Material, picture, section, texts
from hypogoal.evaluation.pictures import attribution_png, brightness, flat

KINDS = {
    "true positive": "a true positive",
    "disagree": "members disagree",
    "false positive": "a false positive",
}


def saliency_section(material: Material) -> Block:
    """DeepLift of every member of one ensemble on a few held-out states."""
    found = material.metrics["saliency"]
    title = "What members look at"
    if found is None:
        return section("saliency", title, [], [], ["Attributions: they need an ensemble artefact: train-ensemble."])
    errors = [member["completeness_error"] for member in _members(found)]
    text = (
        f"DeepLift attributions (Figures 2 and 9 of the paper) of each member of {found['ensemble']} (seed "
        f"{found['seed']}) on a few held-out states, against {found['baseline']}: what a state has in common with the "
        "usual one gets none. Orange speaks for 'reached', blue against it, each picture on its own scale; the state "
        "shows through in grey. Of a stack of frames the last is drawn, with its share of all attribution. A member "
        "that goes by what will not be there elsewhere cannot transfer."
    )
    check = (
        f"Completeness: attributions must add up to the state's log-odds less the baseline's; the largest error is "
        f"{max(errors):.0e} (log-odds)."
        if errors
        else ""
    )
    blocks = []
    for goal in found["sub_goals"]:
        for index, state in enumerate(goal["states"]):
            blocks.append(_cards(material, goal["sub_goal"], index, state))
    missing = [] if blocks else ["No member calls any held-out state reached: there is nothing to attribute."]
    return section("saliency", title, [text, check], blocks, missing)


def _members(found: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    return [member for goal in found["sub_goals"] for state in goal["states"] for member in state["members"]]


def _cards(material: Material, sub_goal: str, index: int, state: Mapping[str, Any]) -> Block:
    arrays = {
        key: material.arrays[f"saliency/{sub_goal}/{key}"]
        for key in ("observations", "seen", "attributions", "probabilities", "verdicts", "labels", "places")
    }
    observation, truth = arrays["observations"][index], bool(arrays["labels"][index])
    place = texts(arrays["places"])[index]
    name = f"{sub_goal}: {KINDS[state['kind']]}"
    cards = [
        {
            "png": picture(observation),
            "alt": f"A held-out state; {sub_goal} is {'reached' if truth else 'not reached'}.",
            "title": f"truth: {'yes' if truth else 'no'}",
            "lines": [{"class": "no", "text": part} for part in (place,) if part],
        }
    ]
    frames = observation.shape[-1] != 3
    for member in state["members"]:
        number = member["member"]
        verdict = bool(arrays["verdicts"][index, number])
        mark = "wrong" if verdict != truth else "yes" if verdict else "no"
        said = f"{'yes' if verdict else 'no'} {arrays['probabilities'][index, number]:.2f}"
        lines = [{"class": mark, "text": said}]
        if frames and member["last_frame"] is not None:
            lines.append({"class": "no", "text": f"last frame: {100 * member['last_frame']:.0f} %"})
        values = flat(arrays["attributions"][index, number])
        cards.append(
            {
                "png": base64.b64encode(attribution_png(values, brightness(arrays["seen"][index]) / 255)).decode(
                    "ascii"
                ),
                "alt": f"Attributions of member {number}, which says {said}.",
                "title": f"member {number}",
                "lines": lines,
            }
        )
    return {"kind": "cards", "heading": name, "cards": cards, "small": True}
