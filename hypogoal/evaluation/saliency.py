"""Figures 2 and 9, and a gallery: what each member looks at in held-out states (Spec F2, F6)."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from hypogoal.core.arrays import Bytes, Floats
from hypogoal.evaluation import plots
from hypogoal.evaluation.attributing import look as look
from hypogoal.evaluation.attributing import outcomes
from hypogoal.evaluation.page import Drawn
from hypogoal.evaluation.pictures import SIGNED, attribution_image, coloured

TITLE = "What members look at"
MOST_BARS = 15  # features


def context(results):
    """For the template: whose members, how they were explained, and the states of the gallery; Figures 2 and 9."""
    looked_at = results.facts.get("looked_at")
    if looked_at is None:
        return {}
    of_goals = looked_at["sub_goals"]
    explained = {name: facts for name, facts in of_goals.items() if facts["kinds"] or "features" in facts}
    states, figures = [], []
    for name, facts in of_goals.items():
        arrays = results.within(f"saliency/{name}")  # none where only numbers are told
        suffix = f"-{name}" if len(explained) > 1 else ""
        if "observations" in arrays:
            of_goal = [*_gallery(arrays, name, facts)]
            states += of_goal
            if facts["kinds"]:
                figures += _figures(of_goal[0], facts["kinds"][0], suffix)
        elif arrays:
            draw = partial(bars_of_features, arrays["attributions"], facts["features"])
            figures.append(Drawn(f"features{suffix}", "What members go by", draw, {"sub_goal": name}))
    return {"ensemble": looked_at["ensemble"], "explained": explained, "states": states, "figures": figures}


def _gallery(arrays, sub_goal, facts):
    """Each state with its arrays, those of attributions if it has any."""
    shared = {"sub_goal": sub_goal, "colours": facts["colours"], "attributions": []}
    outcome = outcomes(arrays["predictions"], arrays["labels"])
    for index, place in enumerate(facts["places"]):
        of_state = {name: values[index] for name, values in arrays.items() if index < len(values)}
        yield shared | of_state | {"place": place, "outcome": outcome[index]}


def _figures(state, kind, suffix):
    """Figures 2 and 9 of a sub-goal's first state, a true positive where there is one."""
    about = {"sub_goal": state["sub_goal"], "kind": kind, "place": state["place"]}
    members = partial(attributions_of_members, state)
    yield Drawn(f"figure2{suffix}", "Figure 2: attributions of each member", members, about)
    frames = partial(attributions_of_channels, state)
    yield Drawn(f"figure9{suffix}", "Figure 9: attributions of every frame", frames, about)


def attributions_of_members(state: Mapping[str, Any]) -> Figure:
    """Figure 2: a state and what each member goes by in it; of a stack of frames the last."""
    colours = state["colours"]
    truth = "positive" if state["labels"] else "negative"
    shown = [(f"truth\n{truth}", coloured(state["observations"], colours))]
    for title, values in _members(state):
        shown.append((title, attribution_image(values, state["seen"], colours)))
    return with_key(shown, min(4, len(shown)))


def attributions_of_channels(state: Mapping[str, Any]) -> Figure:
    """Figure 9: a row per member, a column per frame, oldest first, above them the frames; of one frame its colours."""
    seen = state["seen"]
    channels, names = seen.shape[-1], ["red", "green", "blue"]
    if channels != 3 or channels > state["colours"]:
        frames = channels // state["colours"]
        names = [f"{age} before" for age in range(frames - 1, 0, -1)] + ["newest frame"]
    frames = np.split(seen, len(names), axis=-1)
    shown = [*zip(names, map(coloured, frames), strict=True)]
    for title, values in _members(state):
        for frame, part in zip(frames, np.split(values, len(names), axis=-1), strict=True):
            shown.append((title, attribution_image(part, frame)))
            title = ""
    return with_key(shown, len(names))


def _members(state):
    """What each member says of a state, and its attributions."""
    for member, values in enumerate(state["attributions"]):
        says = state["predictions"][member]
        wrong = "" if says == state["labels"] else ", wrong"
        probability = state["probabilities"][member]
        yield f"member {member}\n{'positive' if says else 'negative'} {probability:.2f}{wrong}", values


def with_key(shown: Sequence[tuple[str, Bytes]], columns: int) -> Figure:
    """Pictures with titles, row by row; below them what the colours of attributions mean.

    Each picture has a scale of its own, so the key has no numbers.
    """
    figure, places = plots.panels(shown, columns, titles=0.5)
    key = ScalarMappable(Normalize(-1, 1), SIGNED)
    bar = figure.colorbar(key, ax=places, location="bottom", fraction=0.05, shrink=0.6, aspect=40)
    bar.set_ticks([-1, 0, 1], labels=["against", "0", "for 'reached'"])
    bar.set_label("attribution in log-odds, each picture on its own scale")
    return figure


def bars_of_features(attributions: Floats, names: Sequence[str]) -> Figure:
    """Bars side by side, those of the features that members go by most, of attributions (n, K, features)."""
    sizes = pd.DataFrame(np.abs(attributions).mean(axis=0).T, index=[*names]).add_prefix("member ")
    most = sizes.mean(axis=1).nlargest(MOST_BARS).index
    figure, axes = plots.bars("barh", sizes.loc[most[::-1]], 0.7 + 0.35 * len(most))
    axes.set_xlabel("mean absolute attribution, log-odds")
    return figure
