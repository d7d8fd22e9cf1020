"""Figures 2 and 9, and a gallery: what each member looks at in held-out states (Spec F2, F6)."""

from collections.abc import Iterator, Mapping, Sequence
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
from hypogoal.evaluation.page import Drawn, Results
from hypogoal.evaluation.pictures import SIGNED, attribution_image, coloured

TITLE = "What members look at"
MOST_BARS = 15  # features


def context(results: Results) -> dict[str, Any] | None:
    """For the template: whose members, how they were explained, and the states of the gallery."""
    looked_at = results.facts.get("looked_at")
    if looked_at is None:
        return None
    explained, states = {}, []
    for name, facts in looked_at["sub_goals"].items():
        if facts["kinds"] or "features" in facts:
            explained[name] = facts
        arrays = results.within(f"saliency/{name}")
        if "observations" in arrays:
            states += _gallery(arrays, name, facts)
    return {
        "ensemble": looked_at["ensemble"],
        "explained": explained,
        "states": states,
    }


def _gallery(
    arrays,
    sub_goal,
    facts,
):
    """Each state with its arrays, those of attributions if it has any."""
    shared = {
        "sub_goal": sub_goal,
        "colours": facts["colours"],
        "attributions": [],
    }
    outcome = outcomes(arrays["predictions"], arrays["labels"])
    for index, place in enumerate(facts["places"]):
        of_state = {name: values[index] for name, values in arrays.items() if index < len(values)}
        yield shared | of_state | {"place": place, "outcome": outcome[index]}


def figures(context: Mapping[str, Any]) -> Iterator[Drawn]:
    """Figures 2 and 9 of each sub-goal, a true positive where there is one; of numbers, which features members use."""
    for sub_goal, facts in context["explained"].items():
        suffix = f"-{sub_goal}" if len(context["explained"]) > 1 else ""
        about = {"sub_goal": sub_goal}
        if "features" in facts:
            attributions = context["results"].arrays[f"saliency/{sub_goal}/attributions"]
            bars = bars_of_features(attributions, facts["features"])
            yield Drawn(
                f"features{suffix}",
                "What members go by",
                bars,
                about,
            )
            continue
        state = next(state for state in context["states"] if state["sub_goal"] == sub_goal)
        about |= {"kind": facts["kinds"][0], "place": state["place"]}
        figure2 = attributions_of_members(state)
        yield Drawn(
            f"figure2{suffix}",
            "Figure 2: attributions of each member",
            figure2,
            about,
        )
        figure9 = attributions_of_channels(state)
        yield Drawn(
            f"figure9{suffix}",
            "Figure 9: attributions of every frame",
            figure9,
            about,
        )


def attributions_of_members(state: Mapping[str, Any]) -> Figure:
    """Figure 2: a state and what each member goes by in it; of a stack of frames the last."""
    colours = state["colours"]
    truth = "positive" if state["labels"] else "negative"
    shown = [(coloured(state["observations"], colours), f"truth\n{truth}")]
    for title, values in _members(state):
        shown.append((attribution_image(values, state["seen"], colours), title))
    return panels(shown, min(4, len(shown)))


def attributions_of_channels(state: Mapping[str, Any]) -> Figure:
    """Figure 9: a row per member, a column per frame, oldest first, above them the frames; of one frame its colours."""
    seen = state["seen"]
    channels, names = seen.shape[-1], ["red", "green", "blue"]
    if channels != 3 or channels > state["colours"]:
        frames = channels // state["colours"]
        names = [f"{age} before" for age in range(frames - 1, 0, -1)] + ["newest frame"]
    frames = np.split(seen, len(names), axis=-1)
    shown = [(coloured(frame), name) for frame, name in zip(frames, names, strict=True)]
    for title, values in _members(state):
        for frame, part in zip(frames, np.split(values, len(names), axis=-1), strict=True):
            shown.append((attribution_image(part, frame), title))
            title = ""
    return panels(shown, len(names))


def _members(state):
    """What each member says of a state, and its attributions."""
    for member, values in enumerate(state["attributions"]):
        says = state["predictions"][member]
        wrong = "" if says == state["labels"] else ", wrong"
        probability = state["probabilities"][member]
        yield f"member {member}\n{'positive' if says else 'negative'} {probability:.2f}{wrong}", values


def panels(shown: Sequence[tuple[Bytes, str]], columns: int) -> Figure:
    """Pictures with titles, row by row; below them what the colours of attributions mean.

    Each picture has a scale of its own, so the key has no numbers.
    """
    with plots.styled():
        figure, places = plots.pictures(-(-len(shown) // columns), columns, titles=0.5)
        for place, (image, title) in zip(places, shown, strict=False):
            plots.show_picture(place, image, title)
        key = ScalarMappable(Normalize(-1, 1), SIGNED)
        bar = figure.colorbar(
            key,
            ax=places,
            location="bottom",
            fraction=0.05,
            shrink=0.6,
            aspect=40,
        )
        bar.set_ticks([-1, 0, 1], labels=["against", "0", "for 'reached'"])
        bar.set_label("attribution in log-odds, each picture on its own scale")
    return figure


def bars_of_features(attributions: Floats, names: Sequence[str]) -> Figure:
    """Bars side by side, those of the features that members go by most, of attributions (n, K, features)."""
    sizes = pd.DataFrame(np.abs(attributions).mean(axis=0).T, index=[*names]).add_prefix("member ")
    most = sizes.mean(axis=1).nlargest(MOST_BARS).index
    with plots.styled():
        figure, axes = plots.bars("barh", sizes.loc[most[::-1]], 0.7 + 0.35 * len(most))
        axes.set_xlabel("mean absolute attribution, log-odds")
    return figure
