"""Held-out states to browse: what each member says, goes by and leads to (Spec F2, F6, F7).

Most predictions are right, so a random sample would hardly show an error. Here the kinds of outcome take turns, and
within each the places that states are from. ``templates/explorer.js`` shows those that its filters let through.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hypogoal.core.seeding import rng_for
from hypogoal.evaluation import page
from hypogoal.evaluation.curves import LEARNED, variants
from hypogoal.evaluation.judging import Judgement, Work
from hypogoal.evaluation.page import Block, Entry, Material, Question
from hypogoal.evaluation.pictures import FULL, attribution_image, brightness, flat, image_png, reduced, to_bytes
from hypogoal.evaluation.table import Row
from hypogoal.observations import PICTURE

MOST_STATES = 300  # over all sub-goals: the page of the ladders has 1.4 MB
MOST_OF_ONE = 180  # of one sub-goal
MOST_EXPLAINED = 90  # states with attributions, over all sub-goals: DeepLift takes .05 s for a state and member
MOST_INTEGRATED = 12  # where they are integrated gradients: of a large network seconds
PLACES = ("layout_seed", "room", "kind")  # origins whose values take turns
TITLE = "Explore the hypotheses"


def look(work: Work, judgement: Judgement) -> Iterable[Row]:
    """Write one sub-goal's states to browse as ``explorer/<sub-goal>``; attributions of the first of them."""
    if judgement.number != work.browsed or judgement.split.observations.dtype != PICTURE:
        return ()
    from hypogoal.hypotheses.deep_lift import DEEP_LIFT, attributed, method_of

    split, sub_goal, predictions = judgement.split, judgement.case.sub_goal, judgement.judged.predictions
    sub_goals = len(judgement.case.config["sub_goals"])
    most = min(MOST_OF_ONE, MOST_STATES // sub_goals)  # all sub-goals share the page
    places = [split.origins[name] for name in PLACES if name in split.origins]
    picked = pick_to_browse(predictions, split.labels, places, most, rng_for(0, "browse", sub_goal))
    kinds, reading = (judgement.domain.kinds, judgement.domain.reading) if judgement.domain else ((), "")
    kind = split.origins.get("kind")
    names = [kinds[kind[index]] if kind is not None and kind[index] < len(kinds) else "" for index in picked]
    group = work.arrays.create_group(f"explorer/{sub_goal}")
    judgement.write_states(group, list(zip(picked.tolist(), names, strict=True)))
    group["rows"] = picked
    ensemble, seen, baseline = judgement.see(picked[: MOST_EXPLAINED // sub_goals])
    if method_of(ensemble.members[0]) != DEEP_LIFT:
        seen = seen[: MOST_INTEGRATED // sub_goals]
    values = [to_bytes(flat(attributed(ensemble, seen[i : i + 8], baseline).values)) for i in range(0, len(seen), 8)]
    shape = (0, len(ensemble), *seen.shape[1:3])
    group["attributions"] = np.concatenate([np.zeros(shape, np.int8), *values])
    group["brightness"] = brightness(seen)
    counts = {"states": len(split.labels), "shown": len(picked), "explained": len(seen)}
    work.looked["explorer"].append({"sub_goal": sub_goal, **counts, "reading": reading})
    return ()


def pick_to_browse(
    predictions: NDArray[np.bool_],
    labels: NDArray[np.bool_],
    places: Sequence[NDArray[np.int64]],
    most: int,
    rng: np.random.Generator,
) -> NDArray[np.int64]:
    """Which states are shown, int64 (n,), n at most ``most``, by predictions (N, K), labels (N,), places (N,) each.

    States alike in all places are from the same one; ``rng`` draws among states alike.
    """
    errors = (predictions != labels[:, None]).sum(1)
    outcome = np.where(errors == 0, 0, np.where(errors == predictions.shape[1], 2, 1)) * 2 + labels
    order = rng.permutation(len(labels))
    if places:
        _, place = np.unique(np.stack(places, axis=1), axis=0, return_inverse=True)
        order = take_turns(order, place.reshape(-1))
    return take_turns(order, outcome)[:most]


def take_turns(order: NDArray[np.int64], groups: NDArray[np.int64]) -> NDArray[np.int64]:
    """Indices (n,), better ones first, reordered so that ``groups`` (N,) take turns: each one's first, second, ..."""
    groups = groups[order]
    turn = np.zeros(len(order), dtype=np.int64)
    for group in np.unique(groups):
        inside = groups == group
        turn[inside] = np.arange(inside.sum())
    return order[np.argsort(turn, kind="stable")]


def sections(material: Material) -> list[Block]:
    """A browser of held-out states, with filters."""
    explored = material.metrics["explorer"]
    if not explored:
        return []
    source = page.pick(material.metrics["ensembles"], "path", explored["ensemble"])
    shown, states = (max(goal[key] for goal in explored["sub_goals"]) for key in ("shown", "states"))
    text = (
        f"Held-out states and what each member of {explored['ensemble']} (seed {explored['seed']}) predicts. "
        "Choose a state (arrow keys work) to see what each member goes by: orange speaks for 'reached', blue against "
        f"it. Choose a member to see the options it became. {explored['sub_goals'][0]['reading']}"
    )
    sample = (
        f"{shown:,} of {states:,} states of a sub-goal, drawn so that every kind of outcome and every place comes up; "
        "how often one does means nothing. The page's address keeps the filters."
    )
    goals = [_goal(material, source, goal["sub_goal"]) for goal in explored["sub_goals"]]
    places = list(dict.fromkeys(state["place"] for goal in goals for state in goal["states"] if state["place"]))
    kinds = list(dict.fromkeys(state["kind"] for goal in goals for state in goal["states"] if state["kind"]))
    errors = [("", "any"), ("none", "all right"), ("some", "some wrong"), ("all", "all wrong")]
    if any(len(goal["members"]) != source["members"] for goal in goals):
        raise ValueError("an ensemble of other members than its sub-goals")
    choices = {
        "goal": [(goal["name"], goal["name"]) for goal in goals],
        "errors": [*errors, *((str(member), f"member {member} wrong") for member in range(source["members"]))],
        "place": _any(places),
        "kind": _any(sorted(kinds)),
    }
    block = {"kind": "explorer", "choices": choices, "data": {"goals": goals}, "caption": sample}
    return [page.section("explorer", TITLE, [text], [block])]


def _any(values: Sequence[str]) -> list[tuple[str, str]]:
    """Choices of a filter, each value's own name; none where there is nothing to choose."""
    return [("", "any"), *((value, value) for value in values)] if len(values) > 1 else []


def _goal(material: Material, source: Entry, sub_goal: str) -> dict[str, Any]:
    members = [
        {
            "facts": [
                ("balanced accuracy, held-out", page.fixed(member["balanced_accuracy"], 3)),
                ("precision", page.fixed(member["precision"], 3)),
                ("recall", page.fixed(member["recall"], 3)),
                ("positive, unlabelled states", page.percent(member["positive_unlabelled"])),
            ],
            "options": _options(material, source["path"], sub_goal, member["member"]),
        }
        for member in page.pick(source["sub_goals"], "sub_goal", sub_goal)["heldout"]["members"]
    ]
    return {"name": sub_goal, "members": members, "states": _states(material, sub_goal)}


def _states(material: Material, sub_goal: str) -> list[dict[str, Any]]:
    arrays = material.within(f"explorer/{sub_goal}")
    places, kinds, explained = page.texts(arrays["places"]), page.texts(arrays["kinds"]), len(arrays["attributions"])
    states = []
    for index in np.argsort(arrays["rows"], kind="stable"):
        saliency = []
        if index < explained:
            grey = reduced(arrays["brightness"][index] / 255)
            values = arrays["attributions"][index]
            images = [attribution_image(reduced(of_member / FULL), grey) for of_member in values]
            saliency = [page.encoded(image_png(image)) for image in images]
        states.append(
            {
                "png": page.picture(arrays["observations"][index]),
                "truth": bool(arrays["labels"][index]),
                "says": arrays["verdicts"][index].astype(bool).tolist(),
                "p": [round(float(value), 3) for value in arrays["probabilities"][index]],
                "place": places[index],
                "kind": kinds[index],
                "saliency": saliency,
            }
        )
    return states


def _options(material: Material, ensemble: str, sub_goal: str, member: int) -> list[dict[str, Any]]:
    """What a member's options came to: one entry per agent, or per ladder, that was learned with this ensemble."""
    options = []
    for agent in variants(material.metrics["selection"]):
        for run in agent["runs"]:
            goal = next((goal for goal in run["sub_goals"] if goal["sub_goal"] == sub_goal), None)
            if run["ensemble"] == ensemble and goal is not None:
                option = goal["members"][member]
                name = f"layout {run['layout_seed']}, run seed {run['seed']}{agent['name'].removeprefix(LEARNED)}"
                notes = [f"{word} preferred of its sub-goal" for word in ("most", "least") if goal[word] == member]
                facts = [
                    ("chosen", f"{option['chosen']:,} of {option['offered']:,} offers"),
                    ("preference", f"{page.fixed(option['preference'], 2)} (1: as in uniform-random choice)"),
                    ("its classifier ended it", f"{option['reached']:,} times"),
                    ("mean steps", page.fixed(option["duration"], 1)),
                    ("match on this layout", page.fixed(option["match"], 2)),
                ]
                picture = _overlay(material, run["path"], option["option"])
                options.append({"name": name, "note": "".join(notes[:1]), "facts": facts, **picture})
    for row in material.metrics["distance"]["options"]:
        if row["ensemble"] == ensemble and row["sub_goal"] == sub_goal:
            option = row["options"][member]
            picks = " and ".join(word for word in ("best", "validated") if row[word] == member)
            facts = [
                ("distance from the true sub-goal", page.fixed(option["distance"], 1)),
                ("stopped there", page.percent(option["reached_base"])),
                ("began inside", page.percent(option["inside_at_start"])),
                ("timed out", page.percent(option["timed_out"])),
                ("mean steps", page.fixed(option["duration"], 1)),
            ]
            name, note = f"ladder {row['ladder']}, seed {row['seed']}", f"{picks} member here" if picks else ""
            picture = _overlay(material, row["path"], option["option"])
            options.append({"name": name, "note": note, "facts": facts, **picture})
    return options


def _overlay(material: Material, path: str, option: int) -> dict[str, str]:
    """The picture of the states in which an option ends, and their number."""
    image, states = material.termination_states(path, option)
    return {"png": "" if image is None else page.picture(image), "states": f"ends in {states}" if states else ""}


QUESTION = Question(look=look, view=lambda work: {"explorer": work.kept("explorer", work.browsed)}, sections=sections)
