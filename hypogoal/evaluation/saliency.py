"""Figures 2 and 9, and a gallery: what each member looks at in held-out states (Spec F2, F6)."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hypogoal.core.seeding import rng_for
from hypogoal.data import Dataset, open_dataset
from hypogoal.evaluation.house import tidy_members
from hypogoal.evaluation.judging import Judgement, Work, parts_of
from hypogoal.evaluation.page import Drawn, Results, fixed, picture, source
from hypogoal.evaluation.pictures import (
    FULL,
    attribution_image,
    brightness,
    coloured,
    flat,
    image_png,
    last_frame,
    reduced,
    to_bytes,
)
from hypogoal.evaluation.plots import BLUE, PALETTE, VERMILLION, legend_below, pictures, plot, show_picture, styled
from hypogoal.observations import PICTURE, fields_of, spread_rows

TITLE = "What members look at"
KINDS = ("true positive", "disagree", "false positive")  # of states whose attributions are drawn large
GALLERY = 40  # states of all sub-goals
EXPLAINED = 20  # of these with attributions: DeepLift takes .05 s for a state and member
INTEGRATED = 5  # where they are integrated gradients: of a large network seconds
AVERAGED = 64  # states over which attributions to features are averaged
MOST_BARS = 15  # features
PLACES = ("layout_seed", "room", "kind")  # origins whose values take turns
SIGNED = LinearSegmentedColormap.from_list("against-for", [BLUE, "white", VERMILLION])
NEEDED_BY_BOTH = "an ensemble on pictures that has positive predictions"
NEEDED = {"figure2": NEEDED_BY_BOTH, "figure9": NEEDED_BY_BOTH}


def look(work: Work, judgement: Judgement) -> Iterator[pd.DataFrame]:
    """Attributions of the ensemble whose options were learned most often, on a few states of unseen contexts.

    ``saliency/SUB_GOAL`` is written: the states and their ``attributions``, float32 (n, K, H, W, C), in log-odds, to
    what members saw, ``seen``, against the mean of the unlabelled states. Where they are no pictures, of states spread
    over the held-out ones. Of mixed ones a picture's attributions are added up, and ``maps/KEY`` has them pixel by
    pixel, (K, H, W, C), of one state. ``gallery/SUB_GOAL``: states on which members disagree.
    """
    if judgement.number != work.browsed:
        return
    from hypogoal.hypotheses.deep_lift import attributed

    split, sub_goal = judgement.split, judgement.case.sub_goal
    dataset = open_dataset(judgement.case.data)
    states, kinds = _to_explain(judgement)
    facts: dict[str, Any] = {"kinds": kinds, "states": len(split.labels)}
    looked_at = work.facts.setdefault("looked_at", {"ensemble": work.place_of(judgement), "sub_goals": {}})
    looked_at["sub_goals"][sub_goal] = facts
    if len(states):
        group = work.arrays.create_group(f"saliency/{sub_goal}")
        facts["places"] = judgement.write_states(group, states)
        ensemble, seen, baseline = judgement.see(states)
        attributions = attributed(ensemble, seen, baseline)
        _write_attributions(group, attributions.values.astype(np.float32), seen)
        error = attributions.completeness_error()
        facts |= {"how": attributions.method, "completeness_error": float(error.max())}
        if kinds:
            for row, kind in enumerate(kinds):
                columns = {"completeness_error": error[row], "log_odds": attributions.log_odds[row]}
                yield tidy_members(columns, **work.place_of(judgement), scope=f"state: {kind}")
    if split.observations.dtype == PICTURE:
        facts |= {"colours": _colours(dataset), **_write_gallery(work.arrays, judgement)}
    else:
        facts["features"] = dataset.features()


def _colours(dataset: Dataset) -> int:
    """How many colours each frame of a stack has."""
    default = 3 if dataset.observation_shape[-1] == 3 else 1
    return dataset.channels.get("", (1, default))[1]


def _to_explain(judgement: Judgement) -> tuple[NDArray[np.int64], list[str]]:
    """Which held-out states are explained, and of pictures their kinds; of unseen rooms where positives are in them."""
    split, judged = judgement.split, judgement.judged
    unseen = split.origins.get("seen", np.zeros(len(split.labels), dtype=np.int64)) == 0
    among = np.flatnonzero(unseen) if split.labels[unseen].any() else np.arange(len(unseen))
    picked = pick_to_explain(judged.probabilities[among], judged.predictions[among], split.labels[among])
    if split.observations.dtype == PICTURE:
        return among[[state for state, _ in picked]].astype(np.int64), [kind for _, kind in picked]
    first = [state for state, _ in picked[:1]] if split.observations.dtype.names else []
    return among[[*first, *spread_rows(len(among), AVERAGED).tolist()]], []


def pick_to_explain(
    probabilities: NDArray[np.float32], predictions: NDArray[np.bool_], labels: NDArray[np.bool_]
) -> list[tuple[int, str]]:
    """Figures 2 and 9: the few of N states, (index, kind), whose attributions are drawn, no state twice.

    ``true positive``: where most of K members are right and surest on average; ``disagree``: where members differ and
    their probabilities are furthest apart; ``false positive``: where most err, and are surest. Fewer where none are.
    """
    positive = predictions.sum(axis=1)
    surest = -(positive + probabilities.mean(axis=1))
    apart = probabilities.min(axis=1) - probabilities.max(axis=1)
    candidates = (
        (labels & (positive > 0), surest),
        ((positive > 0) & (positive < predictions.shape[1]), apart),
        (~labels & (positive > 0), surest),
    )
    picked: list[tuple[int, str]] = []
    for kind, (mask, order) in zip(KINDS, candidates, strict=True):
        free = mask.copy()
        free[[state for state, _ in picked]] = False
        if free.any():
            picked.append((int(np.where(free, order, np.inf).argmin()), kind))
    return picked


def _write_attributions(group: Any, values: NDArray[np.float32], seen: Any) -> None:
    from hypogoal.hypotheses.deep_lift import by_key

    if seen.dtype.names:
        parts = by_key(values, seen.dtype)
        rows = []
        for key, (dtype, _) in fields_of((), seen.dtype).items():
            of_key = parts[key].reshape(*values.shape[:2], -1)
            if dtype == PICTURE:
                group[f"maps/{key}"] = parts[key][0]
                of_key = of_key.sum(axis=-1, keepdims=True)
            rows.append(of_key)
        values = np.concatenate(rows, axis=-1)
    group.create_dataset("attributions", data=values, compression="gzip", compression_opts=1)
    for name, part in parts_of(seen, "seen"):
        group[name] = part


def _write_gallery(arrays: Any, judgement: Judgement) -> dict[str, Any]:
    """Write states to look through into ``gallery/SUB_GOAL``, with attributions of the first of them."""
    from hypogoal.hypotheses.deep_lift import DEEP_LIFT, attributed, method_of

    split, sub_goal = judgement.split, judgement.case.sub_goal
    sub_goals = len(judgement.case.config["sub_goals"])
    places = [split.origins[name] for name in PLACES if name in split.origins]
    states = pick_for_gallery(judgement.judged.predictions, split.labels, places, rng_for(0, "browse", sub_goal))
    states = states[: GALLERY // sub_goals]
    group = arrays.create_group(f"gallery/{sub_goal}")
    places_of = judgement.write_states(group, states)
    ensemble, seen, baseline = judgement.see(states[: EXPLAINED // sub_goals])
    if method_of(ensemble.members[0]) != DEEP_LIFT:
        seen = seen[: INTEGRATED // sub_goals]
    colours = _colours(open_dataset(judgement.case.data))
    if len(seen):
        values = flat(attributed(ensemble, seen, baseline).values, colours)
        group["attributions"] = to_bytes(values)
        group["brightness"] = brightness(seen, colours)
    return {"gallery_places": places_of}


def pick_for_gallery(
    predictions: NDArray[np.bool_],
    labels: NDArray[np.bool_],
    places: Sequence[NDArray[np.int64]],
    rng: np.random.Generator,
) -> NDArray[np.int64]:
    """States by how interesting they are, int64 (N,): kinds of outcome take turns, and within each the places.

    Takes predictions (N, K), labels (N,), places (N,) each. First come states on which members disagree, then those on
    which all err, then the others; ``rng`` draws among states alike.
    """
    errors = (predictions != labels[:, None]).sum(axis=1)
    outcome = np.where(errors == 0, 2, np.where(errors == predictions.shape[1], 1, 0))
    order = rng.permutation(len(labels))
    if places:
        _, place = np.unique(np.stack(places, axis=1), axis=0, return_inverse=True)
        order = take_turns(order, place.reshape(-1))
    order = take_turns(order, outcome * 2 + labels)
    return order[np.argsort(outcome[order] == 2, kind="stable")]


def take_turns(order: NDArray[np.int64], groups: NDArray[np.int64]) -> NDArray[np.int64]:
    """Indices (n,), better ones first, reordered so that ``groups`` (N,) take turns: each one's first, second, ..."""
    turn = pd.Series(order).groupby(groups[order]).cumcount().to_numpy()
    return order[np.argsort(turn, kind="stable")]


def context(results: Results) -> dict[str, Any] | None:
    """For the template: whose members, and the states of the gallery."""
    looked_at = results.facts.get("looked_at")
    if looked_at is None:
        return None
    sub_goals = looked_at["sub_goals"]
    states = []
    for name, facts in sub_goals.items():
        states += _gallery_states(results.within(f"gallery/{name}"), name, facts)
    explained = [facts for facts in sub_goals.values() if facts.get("how")]
    return {
        "ensemble": looked_at["ensemble"],
        "how": explained[0]["how"] if explained else None,
        "error": max((facts["completeness_error"] for facts in explained), default=0.0),
        "is_of_numbers": any("features" in facts for facts in sub_goals.values()),
        "states": states,
        "sub_goals": [*sub_goals],
        "total": max(facts["states"] for facts in sub_goals.values()),
        "places": sorted({state["place"] for state in states}),
    }


def _gallery_states(
    arrays: Mapping[str, NDArray[Any]], sub_goal: str, facts: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """Each state's pictures and what members predict of it."""
    states = []
    explained = arrays.get("attributions", ())
    for index in range(len(arrays.get("labels", ()))):
        truth = bool(arrays["labels"][index])
        maps = [""] * len(arrays["predictions"][index])
        if index < len(explained):
            grey = reduced(arrays["brightness"][index] / 255)
            images = [attribution_image(reduced(values / FULL), grey) for values in explained[index]]
            maps = [source(image_png(image), "png") for image in images]
        members = []
        for says, probability, attributions in zip(
            arrays["predictions"][index], arrays["probabilities"][index], maps, strict=True
        ):
            members.append({"says": bool(says), "probability": fixed(probability), "map": attributions})
        wrong = sum(member["says"] != truth for member in members)
        outcome = "all right" if wrong == 0 else "all wrong" if wrong == len(members) else "disagree"
        shown = picture(coloured(arrays["observations"][index], facts["colours"]))
        place = facts["gallery_places"][index]
        texts = {"sub_goal": sub_goal, "truth": truth, "outcome": outcome, "place": place}
        states.append({"source": shown, "members": members, **texts})
    return states


def figures(results: Results) -> Iterator[Drawn]:
    """Figures 2 and 9 of each sub-goal, a true positive where there is one; of numbers, which features members use."""
    looked_at = results.facts.get("looked_at")
    explained = {}
    for name, facts in (looked_at["sub_goals"] if looked_at else {}).items():
        if facts.get("how"):
            explained[name] = facts
    for sub_goal, facts in explained.items():
        arrays = results.within(f"saliency/{sub_goal}")
        suffix = f"-{sub_goal}" if len(explained) > 1 else ""
        if "features" in facts:
            values = np.abs(arrays["attributions"]).mean(axis=0)
            bars = bars_of_features(values.reshape(len(values), -1), facts["features"])
            yield Drawn(f"features{suffix}", "What members go by", bars, {"sub_goal": sub_goal})
            cameras = [name.removeprefix("maps/") for name in arrays if name.startswith("maps/")]
            if cameras:
                maps = attributions_of_cameras(arrays, cameras)
                yield Drawn(f"cameras{suffix}", "Where members look", maps, {"sub_goal": sub_goal})
            continue
        names = ("observations", "seen", "attributions", "probabilities", "predictions", "labels")
        state = {name: arrays[name][0] for name in names}
        details = {"sub_goal": sub_goal, "kind": facts["kinds"][0], "place": facts["places"][0]}
        details["colours"] = facts["colours"]
        figure2 = attributions_of_members(state, facts["colours"])
        figure9 = attributions_of_channels(state, facts["colours"])
        yield Drawn(f"figure2{suffix}", "Figure 2: attributions of each member", figure2, details)
        yield Drawn(f"figure9{suffix}", "Figure 9: attributions of every frame", figure9, details)


def _said(state: Mapping[str, NDArray[Any]], member: int) -> str:
    word = "positive" if state["predictions"][member] else "negative"
    right = bool(state["predictions"][member]) == bool(state["labels"])
    return f"member {member}: {word} {state['probabilities'][member]:.2f}" + ("" if right else ", wrong")


def attributions_of_members(state: Mapping[str, NDArray[Any]], colours: int) -> Figure:
    """Figure 2: a state and what each member goes by in it; of a stack of frames the last."""
    grey = brightness(state["seen"], colours) / 255
    truth = "positive" if state["labels"] else "negative"
    panels = [(coloured(state["observations"], colours), f"truth: {truth}")]
    for member, values in enumerate(state["attributions"]):
        panels.append((attribution_image(flat(values, colours), grey), _said(state, member)))
    return _grid(panels, min(4, len(panels)))


def attributions_of_channels(state: Mapping[str, NDArray[Any]], colours: int) -> Figure:
    """Figure 9: a row per member, a column per frame, oldest first, above them the frames; of one frame its colours."""
    channels = state["seen"].shape[-1]
    per_column = colours if channels > colours else 1
    starts = range(0, channels, per_column)
    if channels == colours == 3:
        names = ["red", "green", "blue"]
    else:
        names = [f"{age} before" if age else "newest frame" for age in range(len(starts) - 1, -1, -1)]
    frames = [state["seen"][..., start : start + per_column] for start in starts]
    panels = [(coloured(frame, per_column), name) for frame, name in zip(frames, names, strict=True)]
    for member, values in enumerate(state["attributions"]):
        for start, frame in zip(starts, frames, strict=True):
            part = values[..., start : start + per_column].sum(axis=-1)
            title = "" if start else _said(state, member)
            panels.append((attribution_image(part, frame.mean(axis=-1) / 255), title))
    return _grid(panels, len(frames))


def attributions_of_cameras(arrays: Mapping[str, NDArray[Any]], cameras: Sequence[str]) -> Figure:
    """A row per camera of mixed observations: its picture in one state, and what each member goes by in it."""
    state = {name: arrays[name][0] for name in ("probabilities", "predictions", "labels")}
    panels = []
    for camera in cameras:
        grey = brightness(arrays[f"seen/{camera}"][0]) / 255
        panels.append((last_frame(arrays[f"observations/{camera}"][0]), camera))
        for member, values in enumerate(arrays[f"maps/{camera}"]):
            title = _said(state, member) if camera == cameras[0] else ""
            panels.append((attribution_image(flat(values), grey), title))
    return _grid(panels, 1 + len(state["predictions"]))


def bars_of_features(values: NDArray[np.floating], names: Sequence[str]) -> Figure:
    """Bars side by side, those of features that members (K, numbers) go by most."""
    order = np.argsort(-values.mean(axis=0), kind="stable")[:MOST_BARS]
    high = 0.8 / len(values)
    places = np.arange(len(order))
    with styled():
        figure, axes = plot(0.7 + 0.35 * len(order))
        for member, of_member in enumerate(values):
            colour = PALETTE[member % len(PALETTE)]
            axes.barh(places + high * member, of_member[order], high, color=colour, label=f"member {member}")
        axes.set_yticks(places + (0.8 - high) / 2, [names[feature] for feature in order])
        axes.invert_yaxis()
        axes.set_xlabel("mean absolute attribution, log-odds")
        legend_below(figure, [axes], 4)
    return figure


def _grid(panels: Sequence[tuple[NDArray[np.uint8], str]], columns: int) -> Figure:
    """Pictures with titles, and what the colours mean; each has a scale of its own, so the key has no numbers."""
    with styled():
        figure, places = pictures(-(-len(panels) // columns), columns)
        for place, (image, title) in zip(places, panels, strict=False):
            show_picture(place, image, title)
        key = ScalarMappable(Normalize(-1, 1), SIGNED)
        bar = figure.colorbar(key, ax=places, location="bottom", fraction=0.05, shrink=0.6, aspect=40)
        bar.set_ticks([-1, 0, 1], labels=["against", "0", "for 'reached'"])
        bar.set_label("attribution in log-odds, each picture on its own scale")
    return figure
