"""Figures 2 and 9: what each member goes by in a few held-out states (Spec F2)."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hypogoal.data import fixed, open_dataset
from hypogoal.evaluation import page
from hypogoal.evaluation.judging import Judgement, Work, parts_of
from hypogoal.evaluation.page import Block, Drawn, Entry, Material, Question
from hypogoal.evaluation.pictures import attribution_image, brightness, flat, image_png
from hypogoal.evaluation.plots import BLUE, PALETTE, VERMILLION, drawing, grid_of_pictures, show_picture, styled
from hypogoal.evaluation.table import Row
from hypogoal.observations import PICTURE, fields_of, spread_rows

SPREAD = "spread"  # a state as any other
KINDS = {"true positive": "a true positive", "disagree": "members disagree", "false positive": "a false positive"}
NEEDED = "an ensemble artefact on pictures with a member that calls a held-out state reached: train-ensemble"
SIGNED = LinearSegmentedColormap.from_list("against-for", [BLUE, "white", VERMILLION])
COLOURS = "Orange speaks for 'reached', blue against it; each picture has its own scale."
EXPLAINED = ("observations", "seen", "attributions", "probabilities", "verdicts", "labels")  # what figures are of
AVERAGED = 64  # states over which attributions to features are averaged
MOST_BARS = 15  # features
KEY = 0.75  # inches below all pictures


def look(work: Work, judgement: Judgement) -> Iterable[Row]:
    """Attributions of the ensemble that is shown; on states of unseen rooms where positives are in them.

    ``saliency/<sub-goal>`` is written: the states and their ``attributions``, float32 (n, K, h, w, C), in log-odds, to
    what members saw, ``seen`` uint8 (n, h, w, C), against ``baseline``. Where they are no pictures, of states spread
    over the held-out ones, with ``features``' names. Of mixed ones a picture's attributions are added up, and
    ``maps/KEY`` has them pixel by pixel, float32 (K, H, W, C), of one state.
    """
    if judgement.number != work.shown:
        return ()
    split, sub_goal, judged = judgement.split, judgement.case.sub_goal, judgement.judged
    strange = split.origins.get("seen", np.zeros(len(split.labels), dtype=np.int64)) == 0
    among = np.flatnonzero(strange) if split.labels[strange].any() else np.arange(len(strange))
    labels, probabilities, predictions = split.labels[among], judged.probabilities[among], judged.predictions[among]
    pictures = split.observations.dtype == PICTURE
    explained = pick_to_explain(probabilities, predictions, labels)
    if not pictures:
        first = explained[:1] if split.observations.dtype.names else []
        explained = first + [(at, SPREAD) for at in spread_rows(len(among), AVERAGED).tolist()]
    picked = [(int(among[index]), kind) for index, kind in explained]
    judgement.write_states(work.arrays.create_group(f"saliency/{sub_goal}"), picked)
    states: list[dict[str, Any]] = []
    if explained:
        from hypogoal.hypotheses.deep_lift import attributed, by_key, explanation

        ensemble, seen, baseline = judgement.see(among[[index for index, _ in explained]])
        explanation_of_states = attributed(ensemble, seen, baseline)
        group = work.arrays[f"saliency/{sub_goal}"]
        values = explanation_of_states.values.astype(np.float32)
        if not seen.dtype.names:
            group["baseline"] = baseline
        else:
            parts, rows = by_key(values, seen.dtype), []
            for key, (dtype, _) in fields_of((), seen.dtype).items():
                rows.append(parts[key].reshape(*values.shape[:2], -1))
                if dtype == PICTURE:
                    group[f"maps/{key}"], rows[-1] = parts[key][0], rows[-1].sum(-1, keepdims=True)
            values = np.concatenate(rows, axis=-1)
        group.create_dataset("attributions", data=values, compression="gzip", compression_opts=1)
        for name, part in parts_of(seen, "seen"):
            group[name] = part
        if not pictures:
            group["features"] = fixed(json.dumps(open_dataset(judgement.case.data).features()))
        states = explanation(explanation_of_states, explained)
    work.looked["saliency"].append({"sub_goal": sub_goal, "states": states})
    return ()


def pick_to_explain(
    probabilities: NDArray[np.float32], predictions: NDArray[np.bool_], labels: NDArray[np.bool_]
) -> list[tuple[int, str]]:
    """Figures 2 and 9: the few of N states, (index, kind), whose attributions are drawn, no state twice.

    ``true positive``: where most of K members are right and surest on average; ``disagree``: where members differ and
    their probabilities are furthest apart; ``false positive``: where most err, and are surest. Fewer where none are.
    """
    positive, mean = predictions.sum(1), probabilities.mean(1)
    spread = probabilities.max(1) - probabilities.min(1)
    picked: list[tuple[int, str]] = []
    for kind, mask, order in (
        ("true positive", labels & (positive > 0), -(positive + mean)),
        ("disagree", (positive > 0) & (positive < predictions.shape[1]), -spread),
        ("false positive", ~labels & (positive > 0), -(positive + mean)),
    ):
        free = mask.copy()
        free[[index for index, _ in picked]] = False
        if free.any():
            picked.append((int(np.where(free, order, np.inf).argmin()), kind))
    return picked


def _about(material: Material, states: Sequence[Entry]) -> str:
    saliency = material.metrics["saliency"]
    return (
        f"Attributions by {states[0]['method'] if states else 'DeepLift'} of each member of {saliency['ensemble']} "
        f"(seed {saliency['seed']}), against {saliency['baseline']}."
    )


def sections(material: Material) -> list[Block]:
    """Attributions of every member of one ensemble on a few held-out states."""
    saliency = material.metrics["saliency"]
    title = "What members look at"
    if saliency is None:
        lacking = ["Attributions: they need an ensemble artefact: train-ensemble."]
        return [page.section("saliency", title, [], [], lacking, folded=True)]
    states = [state for goal in saliency["sub_goals"] for state in goal["states"]]
    errors = [member["completeness_error"] for state in states for member in state["members"]]
    text = (
        f"{_about(material, states)} What a state shares with that mean gets no attribution. {COLOURS} The state shows "
        "through in grey. Of a stack of frames the last is drawn, with its share of all attribution. A member that "
        "goes by what other contexts lack cannot transfer."
    )
    blocks = [page.shown(material, drawn) for drawn in feature_figures(material)]
    if blocks:
        text = f"{_about(material, states)} A member that goes by what means something else elsewhere cannot transfer."
    else:
        blocks = [
            _cards(material, goal["sub_goal"], index, state)
            for goal in saliency["sub_goals"]
            for index, state in enumerate(goal["states"])
        ]
    check = (
        "Completeness: attributions must add up to the state's log-odds less the baseline's; the largest error is "
        f"{max(errors, default=0.0):.0e} (log-odds)."
    )
    missing = [] if blocks else ["No member calls any held-out state reached: there is nothing to attribute."]
    return [page.section("saliency", title, [text, check if errors else ""], blocks, missing, folded=True)]


def _cards(material: Material, sub_goal: str, index: int, state: Entry) -> Block:
    arrays = material.within(f"saliency/{sub_goal}")
    observation, truth = arrays["observations"][index], bool(arrays["labels"][index])
    place = page.texts(arrays["places"])[index]
    cards = [
        {
            "png": page.picture(observation),
            "alt": f"A held-out state; {sub_goal} is {'reached' if truth else 'not reached'}.",
            "title": f"truth: {page.label_of(truth)}",
            "lines": [{"class": "negative", "text": place}] if place else [],
        }
    ]
    for member in state["members"]:
        number = member["member"]
        prediction = page.verdict(arrays["probabilities"][index, number], arrays["verdicts"][index, number], truth)
        lines = [prediction]
        if observation.shape[-1] != 3 and member["last_frame"] is not None:
            lines.append({"class": "negative", "text": f"last frame: {100 * member['last_frame']:.0f} %"})
        values = flat(arrays["attributions"][index, number])
        drawn = image_png(attribution_image(values, brightness(arrays["seen"][index]) / 255))
        alt = f"Attributions of member {number}, which predicts {prediction['text']}."
        cards.append({"png": page.encoded(drawn), "alt": alt, "title": f"member {number}", "lines": lines})
    return {"kind": "cards", "heading": f"{sub_goal}: {KINDS[state['kind']]}", "cards": cards, "small": True}


def feature_figures(material: Material) -> Iterator[Drawn]:
    """Of observations that are no pictures: which features each member goes by, a plot for each sub-goal."""
    saliency = material.metrics["saliency"]
    for goal in (goal["sub_goal"] for goal in (saliency["sub_goals"] if saliency and material.of_numbers() else ())):
        arrays = material.within(f"saliency/{goal}")
        caption = f"Mean absolute attribution on held-out states of {goal}, the {MOST_BARS} largest at most."
        values = np.abs(arrays["attributions"]).mean(0)
        plot = bars_of_features(values.reshape(len(values), -1), page.texts(arrays["features"]))
        yield Drawn(f"features-{goal}", f"What members go by: {goal}", plot, caption, heading=goal)
        cameras = [name.removeprefix("maps/") for name in arrays if name.startswith("maps/")]
        if cameras:
            maps = attributions_of_cameras(arrays, cameras)
            yield Drawn(f"cameras-{goal}", f"Where members look: {goal}", maps, f"Attributions in one state. {COLOURS}")


def attributions_of_cameras(arrays: Mapping[str, NDArray[Any]], cameras: Sequence[str]) -> Figure:
    """A row per camera of mixed observations: its picture in one state, and what each member goes by in it."""
    state = {name: arrays[name][0] for name in ("probabilities", "verdicts", "labels")}
    panels = []
    for camera in cameras:
        grey = brightness(arrays[f"seen/{camera}"][:1])[0] / 255
        panels.append((arrays[f"observations/{camera}"][0], camera))
        for member, values in enumerate(arrays[f"maps/{camera}"]):
            title = _said(state, member) if camera == cameras[0] else ""
            panels.append((attribution_image(flat(values), grey), title))
    return _grid(panels, 1 + len(arrays["probabilities"][0]))


def bars_of_features(values: NDArray[np.floating], names: Sequence[str]) -> Figure:
    """Bars side by side, those of features that members (K, numbers) go by most."""
    order = np.argsort(-values.mean(0), kind="stable")[:MOST_BARS]
    high, places = 0.8 / len(values), np.arange(len(order))
    with drawing(0.7 + 0.35 * len(order), 4) as (figure, axes):
        for member, of_member in enumerate(values):
            colour = PALETTE[member % len(PALETTE)]
            axes.barh(places + high * member, of_member[order], high, color=colour, label=f"member {member}")
        axes.set_yticks(places + (0.8 - high) / 2, [names[feature] for feature in order])
        axes.invert_yaxis()
        axes.set_xlabel("mean absolute attribution, log-odds")
    return figure


def figures(material: Material) -> Iterator[Drawn]:
    """Figures 2 and 9: of each sub-goal the first state that is explained, a true positive where there is one."""
    if material.of_numbers():
        yield from feature_figures(material)
        return
    saliency = material.metrics["saliency"]
    goals = [goal for goal in (saliency["sub_goals"] if saliency else ()) if goal["states"]]
    for goal in goals:
        arrays = material.within(f"saliency/{goal['sub_goal']}")
        state = {name: arrays[name][0] for name in EXPLAINED}
        suffix = f"-{goal['sub_goal']}" if len(goals) > 1 else ""
        place = page.texts(arrays["places"])[0]
        error = max(member["completeness_error"] for member in goal["states"][0]["members"])
        description = (
            f"{_about(material, goal['states'])} A held-out state of {goal['sub_goal']}"
            f"{f' ({place})' if place else ''}: {KINDS[goal['states'][0]['kind']]}. {COLOURS} They add up to the "
            f"difference in log-odds within {error:.0e}."
        )
        colours = state["seen"].shape[-1] == 3
        every = "Colour by colour." if colours else "Every frame that members see."
        last = "" if colours else " Of the stack of frames the last."
        members, frames = attributions_of_members(state), attributions_of_every_frame(state)
        yield Drawn(f"figure2{suffix}", "Figure 2", members, f"Figure 2 of the paper. {description}{last}")
        yield Drawn(f"figure9{suffix}", "Figure 9", frames, f"Figure 9 of the paper. {description} {every}")


def _said(state: Mapping[str, NDArray[Any]], member: int) -> str:
    prediction = page.verdict(state["probabilities"][member], state["verdicts"][member], bool(state["labels"]))
    return f"member {member}: {prediction['text']}"


def attributions_of_members(state: Mapping[str, NDArray[Any]]) -> Figure:
    """Figure 2: what each member goes by in one state, of which ``state`` holds ``EXPLAINED``; of a stack the last."""
    grey = brightness(state["seen"]) / 255
    panels = [(state["observations"], f"truth: {page.label_of(bool(state['labels']))}")]
    for member, values in enumerate(state["attributions"]):
        panels.append((attribution_image(flat(values), grey), _said(state, member)))
    return _grid(panels, min(4, len(panels)))


def attributions_of_every_frame(state: Mapping[str, NDArray[Any]]) -> Figure:
    """Figure 9: a row per member, a column per frame, oldest first, above them the frames; of colours one of each."""
    frames = np.moveaxis(state["seen"], -1, 0)
    ages = [f"{age} step{'s' if age > 1 else ''} before" for age in range(len(frames) - 1, 0, -1)]
    names = ["red", "green", "blue"] if len(frames) == 3 else [*ages, "newest frame"]
    panels = list(zip(frames, names, strict=True))
    for member, values in enumerate(state["attributions"]):
        for channel, frame in enumerate(frames):
            title = "" if channel else _said(state, member)
            panels.append((attribution_image(values[..., channel], frame / 255), title))
    return _grid(panels, len(frames))


def _grid(panels: Sequence[tuple[NDArray[np.uint8], str]], columns: int) -> Figure:
    """Pictures with titles, and what the colours mean; each has a scale of its own, so the key has no numbers."""
    figure, places = grid_of_pictures(-(-len(panels) // columns), columns, KEY)
    for place, (image, title) in zip(places, panels, strict=False):
        show_picture(place, image, title)
    where: dict[str, Any] = {"location": "bottom", "fraction": 0.05, "shrink": 0.6, "aspect": 40}
    with styled():
        bar = figure.colorbar(ScalarMappable(Normalize(-1, 1), SIGNED), ax=places, **where)
        bar.set_ticks([-1, 0, 1], labels=["against", "0", "for 'reached'"])
        bar.set_label("attribution in log-odds, each picture on its own scale")
    return figure


QUESTION = Question(
    look=look,
    view=lambda work: {"saliency": work.kept("saliency", work.shown)},
    sections=sections,
    figures=figures,
    needed={"figure2": NEEDED, "figure9": NEEDED},
)
