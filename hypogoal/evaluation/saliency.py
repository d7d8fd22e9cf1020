"""What members look at in held-out states: Figures 2 and 9."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from math import prod
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from hypogoal.core.arrays import Bytes, Floats
from hypogoal.data import open_dataset
from hypogoal.evaluation import judging, pictures, plots
from hypogoal.evaluation.page import Drawn
from hypogoal.evaluation.parting import states_of, states_to_show
from hypogoal.evaluation.table import melted
from hypogoal.observations import PICTURE, fields_of, spread_rows

TITLE = "What members look at"
MOST_BARS = 15  # features that are drawn
GALLERY = 40  # states of all sub-goals
EXPLAINED = 20  # states of the gallery with attributions; DeepLift takes .05 s for a state and member
INTEGRATED = 5  # the number with integrated gradients, which take seconds with a large network
AVERAGED = 64  # states over which attributions to features are averaged


def look(work: judging.Work, judgement: judging.Judgement) -> Iterator[pd.DataFrame]:
    """Yield rows on what members look at in a few held-out states, of the ensemble that was learned from most often.

    ``saliency/SUB_GOAL`` is written. If observations are pictures, it has the states with what members predict,
    ``seen``, which is what members saw of the first of the states, and ``attributions`` to ``seen``, float32 (n, K, H,
    W, C), in log-odds, against the mean of the unlabelled states. Otherwise it has ``attributions`` alone, (n, K,
    features), in which those to a picture are added up.
    """
    from hypogoal.hypotheses import deep_lift
    from hypogoal.hypotheses.ensemble import read_ensemble

    artefact, data, sub_goal, judged = judgement
    if artefact.path != work.browsed or not len(judged.labels):
        return
    place, sub_goals = work.place_of(judgement), artefact.config["sub_goals"]
    looked_at = work.facts.setdefault("looked_at", {"ensemble": place, "sub_goals": {}})
    dataset, ensemble = open_dataset(data), read_ensemble(artefact.path, artefact.config, sub_goal)
    heldout, unlabelled = judging.states_of(data)
    observations = heldout[sub_goal].observations
    are_pictures = dataset.observation_dtype == PICTURE
    kinds: list[str] = []
    states = explained = spread_rows(len(judged.labels), AVERAGED)
    if are_pictures:
        kinds, states = states_to_show(judged, sub_goal, GALLERY // len(sub_goals))
        few = EXPLAINED if deep_lift.method_of(ensemble.members[0]) == deep_lift.DEEP_LIFT else INTEGRATED
        explained = states[: max(len(kinds), few // len(sub_goals))]
    seen = ensemble.see(observations[explained])
    attributions = deep_lift.attributed(ensemble, seen, deep_lift.mean_state(ensemble.see(unlabelled)))
    error = attributions.completeness_error()
    facts = {"kinds": kinds, "how": attributions.method, "completeness_error": error.max()}
    looked_at["sub_goals"][sub_goal] = facts
    values: Any = attributions.values
    group = work.arrays.create_group(f"saliency/{sub_goal}")
    if are_pictures:
        default = 3 if dataset.observation_shape[-1] == 3 else 1
        facts["colours"] = dataset.channels.get("", (1, default))[1]  # of each frame of a stack
        facts["places"] = [judging.place_of(judged.origins, state) for state in states]
        group["observations"] = observations[states]
        group["labels"] = judged.labels[states]
        group["probabilities"] = judged.probabilities[states]
        group["predictions"] = judged.predictions[states]
        group["seen"] = seen
    else:
        facts["features"] = dataset.features()
        values = of_features(values.reshape(*error.shape, -1), seen.dtype)
    group.create_dataset("attributions", data=values.astype(np.float32), compression="gzip")
    for row, kind in enumerate(kinds):
        columns = {
            "completeness_error": error[row],
            "log_odds": attributions.log_odds[row],
        }
        yield melted(columns, **place, scope=f"state: {kind}")


def of_features(values: Floats, dtype: Any) -> Floats:
    """Return attributions (n, K, D) to each number. Of mixed observations, those to a picture are added up."""
    if not dtype.names:
        return values
    features = []
    start = 0
    for kind, shape in fields_of((), dtype).values():
        of_key = values[..., start : start + prod(shape)]
        start += prod(shape)
        features.append(of_key.sum(axis=-1, keepdims=True) if kind == PICTURE else of_key)
    return np.concatenate(features, axis=-1)


def context(results):
    """Return whose members these are, how they were explained, and Figures 2 and 9."""
    looked_at = results.facts.get("looked_at")
    if looked_at is None:
        return {}
    of_goals = looked_at["sub_goals"]
    explained = {name: facts for name, facts in of_goals.items() if facts["kinds"] or "features" in facts}
    figures = []
    for name, facts in explained.items():
        suffix = f"-{name}" if len(explained) > 1 else ""
        first = next(states_of(results, name, facts), None)  # None if observations are numbers
        attributions = results.arrays.get(f"saliency/{name}/attributions")
        if first:
            figures += _figures(first, facts["kinds"][0], suffix)
        elif attributions is not None:
            draw = partial(bars_of_features, attributions, facts["features"])
            figures.append(Drawn(f"features{suffix}", "What members go by", draw, {"sub_goal": name}))
    return {"ensemble": looked_at["ensemble"], "explained": explained, "figures": figures}


def _figures(state, kind, suffix):
    """Yield Figures 2 and 9 of a sub-goal's first state, which is a true positive if there is any."""
    about = {"sub_goal": state["sub_goal"], "kind": kind, "place": state["place"]}
    members = partial(attributions_of_members, state)
    yield Drawn(f"figure2{suffix}", "Figure 2: attributions of each member", members, about)
    frames = partial(attributions_of_channels, state)
    yield Drawn(f"figure9{suffix}", "Figure 9: attributions of every frame", frames, about)


def attributions_of_members(state: Mapping[str, Any]) -> Figure:
    """Draw Figure 2: a state, and what each member goes by in it.

    Of a stack of frames, the last is drawn.
    """
    colours = state["colours"]
    truth = "positive" if state["labels"] else "negative"
    shown = [(f"truth\n{truth}", pictures.coloured(state["observations"], colours))]
    for title, values in _members(state):
        shown.append((title, pictures.attribution_image(values, state["seen"], colours)))
    return with_key(shown, min(4, len(shown)))


def attributions_of_channels(state: Mapping[str, Any]) -> Figure:
    """Draw Figure 9: a row per member, and a column per frame, oldest first. Above them are the frames.

    If there is one frame of three colours, its columns are the colours.
    """
    seen = state["seen"]
    channels, names = seen.shape[-1], ["red", "green", "blue"]
    if channels != 3 or channels > state["colours"]:
        frames = channels // state["colours"]
        names = [f"{age} before" for age in range(frames - 1, 0, -1)] + ["newest frame"]
    frames = np.split(seen, len(names), axis=-1)
    shown = [*zip(names, map(pictures.coloured, frames), strict=True)]
    for title, values in _members(state):
        for frame, part in zip(frames, np.split(values, len(names), axis=-1), strict=True):
            shown.append((title, pictures.attribution_image(part, frame)))
            title = ""
    return with_key(shown, len(names))


def _members(state):
    """Yield a title that says what each member says of a state, and the member's attributions."""
    for member, values in enumerate(state["attributions"]):
        says = state["predictions"][member]
        wrong = "" if says == state["labels"] else ", wrong"
        probability = state["probabilities"][member]
        yield f"member {member}\n{'positive' if says else 'negative'} {probability:.2f}{wrong}", values


def with_key(shown: Sequence[tuple[str, Bytes]], columns: int) -> Figure:
    """Draw pictures with titles, row by row, and below them what the colours of attributions mean.

    Each picture has a scale of its own, so the key has no numbers.
    """
    figure, places = plots.panels(shown, columns, titles=0.5)
    key = ScalarMappable(Normalize(-1, 1), pictures.SIGNED)
    bar = figure.colorbar(key, ax=places, location="bottom", fraction=0.05, shrink=0.6, aspect=40)
    bar.set_ticks([-1, 0, 1], labels=["against", "0", "for 'reached'"])
    bar.set_label("attribution in log-odds, each picture on its own scale")
    return figure


def bars_of_features(attributions: Floats, names: Sequence[str]) -> Figure:
    """Draw the size of attributions (n, K, features) as bars, members side by side.

    The features are those that the members go by most.
    """
    sizes = pd.DataFrame(np.abs(attributions).mean(axis=0).T, index=[*names]).add_prefix("member ")
    most = sizes.mean(axis=1).nlargest(MOST_BARS).index
    figure, axes = plots.bars("barh", sizes.loc[most[::-1]], 0.7 + 0.35 * len(most))
    axes.set_xlabel("mean absolute attribution, log-odds")
    return figure
